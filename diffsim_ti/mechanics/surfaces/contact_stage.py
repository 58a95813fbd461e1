"""Contact of surfaces with themselves and each other as a stage of explicit passes, which no step is too large for.

After the kick by all other forces and the drift, pairs that are near before it or would be after it act on what moved: the
pass is gone through in parts (contact_parts.py) that move near surfaces by a share of the width, and not farther than half
way to each other, where contact damping is that of the solver; or shorter ones with full damping, each of which leaves
surfaces apart. Vertices of no near pair keep what they had, bit by bit.
"""

from contextlib import contextmanager, nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.mechanics.surfaces.buffers import whole
from diffsim_ti.mechanics.surfaces.contact_parts import NearPairs, Part, total
from diffsim_ti.mechanics.surfaces.contact_pass import ContactPass
from diffsim_ti.mechanics.surfaces.near_set import NearSet
from diffsim_ti.mechanics.surfaces.pair_numbers import PairNumbers
from diffsim_ti.mechanics.surfaces.part_kernels import TAKEN
from diffsim_ti.mechanics.surfaces.sets_in_contact import RigidInContact, SetInContact
from diffsim_ti.mechanics.surfaces.surface_pairs import Tunnelling
from diffsim_ti.runtime.slots import VertexRows, copy_slot
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE, Moment

MOST_LISTS = 6  # made for one pass
MOST_TRIES = 12  # at a pass with one list, each with the pairs that came near in the one before
PASSES = 1.5, 15  # like this one, that a list made for it should hold for, at least and at most
SHORTEST = 2.0**-14  # share of a pass
CLOSE = 2  # widths up to which pairs are taken into the set before they are near, so that it is seldom extended


class FarFromAll(Exception):
    """A list asks for corners of obstacles that are not there, `more` [m] than its longest reach away."""

    def __init__(self, more: float):
        super().__init__(more)
        self.more = more


def moment_of(at: Passes) -> Moment:
    """Obstacles at the end of a pass, and where it begins."""
    schedule = at.ws.solver.schedule
    return Moment(schedule, at.j, schedule.end(at.j), schedule.begin(at.j))


class PairContact(Stage):
    """The stage, of the pairs of a workspace (surface_pairs.py, curved_pairs.py).

    Nodes are vertices of surfaces and of reduced sets, corners of obstacles, and in a pass what stands for the numbers of
    sets (sets_in_contact.py).
    """

    def __init__(self, pairs, damping: float, reduced=()):
        self.damping = damping
        self.pairs, self.inner, self.a = pairs, getattr(pairs, "inner", pairs), pairs.a
        a, mesh = self.a, self.a.mesh
        self.matrix, self.obstacles = getattr(pairs, "matrix", None), pairs.obstacles
        own = np.unique(np.concatenate([mesh.surface_vertices, *(x.vertices for x in reduced)]))
        self.rows, self.num_own = VertexRows(a, own), len(own)
        num_nodes = mesh.num_vertices
        if self.obstacles:
            num_nodes, self.matrix = num_nodes + self.obstacles.corners.count, self.pairs.finer.mesh.with_corners
        self.nodes = np.append(own, np.arange(mesh.num_vertices, num_nodes))  # numbers of the others follow vertices
        self.node_place = np.full(num_nodes, -1)
        self.node_place[self.nodes] = np.arange(len(self.nodes))
        self.sets = [(RigidInContact if x.rigid else SetInContact)(x, self.node_place[x.vertices]) for x in reduced]
        self.set_of, self.member = np.full((2, len(self.nodes)), -1)
        for k, x in enumerate(self.sets):
            self.set_of[x.at], self.member[x.at] = k, np.arange(len(x.at))
        self.kept: dict[int, ContactPass | None] = {}
        self.work = 0.0  # done by what moves obstacles and held vertices, as they press [J]
        self.partly_fixed = bool(len(a.supports.partly_fixed))
        self.free = a.supports.freedom(num_nodes) if self.partly_fixed else None
        self.numbers, self.rough = PairNumbers(self.inner), self.inner.has_friction
        corners = self.inner.a.first_contact_corner + self.inner.list.num_surface
        self.scratch = runtime.array(self.inner.kernels.vec4, corners)  # for forces, which are not looked at
        self.begin = runtime.array(a.vector, 1, a.num_vertices)
        self.set, self.whole = NearSet(self.inner), None  # pairs that have been near, and what there is to know of them
        runtime.fill(self.begin, 0)
        self.clear()

    # ---- nodes ---------------------------------------------------------------------------------------------------------

    def _all(self, own: np.ndarray, corners: np.ndarray | None) -> np.ndarray:
        """Of all nodes, from displacements of vertices and of corners of obstacles."""
        return np.concatenate([own, corners]) if self.obstacles else own

    def _alone_among(self, places: np.ndarray) -> np.ndarray:
        """Which of some nodes are vertices of no set."""
        return (places < self.num_own) & (self.set_of[places] < 0)

    def _settle(self, one: ContactPass, given: tuple, u, v, start, e, b, decay, mass, rest=None) -> None:
        """Add to displacements and velocities of all nodes what contact has done in a pass, e and b, without which they are
        those given."""
        alone = np.flatnonzero(self._alone_among(one.nodes))
        u[one.nodes[alone]] += e[alone]
        v[one.nodes[alone]] += decay * b[alone]
        for near, places in zip(one.near.sets, self._places(one, start, given[0], mass, rest)):
            x, at = self.sets[near.set], self.sets[near.set].at
            numbers = near.at[len(near.here) :]
            if not (e[numbers].any() or b[numbers].any()):  # bit by bit, though others have pairs beside it
                continue
            moved, v[at] = x.settle(*places[:2], given[1][at], e[numbers], b[numbers], decay, places[2])
            u[at] += moved

    def _places(self, one: ContactPass, start, end, mass, rest=None) -> list:
        """(places where the pass begins, where it would end, masses) of the sets that are near something."""
        rest = self.a.values.rest - self.a.origin if rest is None else rest
        every = (self.sets[near.set] for near in one.near.sets)
        return [(rest[x.vertices] + start[x.at], rest[x.vertices] + end[x.at], mass[x.vertices]) for x in every]

    # ---- passes --------------------------------------------------------------------------------------------------------

    @contextmanager
    def do(self, at: Passes):
        self.follow(at, AT_BEGIN)
        self.prepare(at.history.u, at.slot, anew=at.launch is None)
        if not at.stride:
            copy_slot(at.history.u, at.slot, self.begin, 0)  # which the drift replaces
        yield
        self.finish(at)

    def holds(self, u, slot: int) -> bool:
        """Whether the list holds at u[slot]."""
        return self.inner.holds(*self._fine(u, slot))

    def prepare(self, u, slot: int, anew: bool) -> None:
        """A pass begins at u[slot], obstacles being where it does; anew: what was before says nothing of the list."""
        fine = self._fine(u, slot)
        if anew:
            self.inner.ensure(*fine)
        self.inner.forces(*fine, self.scratch)
        self.corners = self.obstacles.displacements if self.obstacles else None

    def finish(self, at: Passes) -> None:
        """It ends."""
        self.follow(at, AT_STAGE)
        if at.stride:
            self.kept[at.end] = None
        try:
            self._act(at, self.corners)
        except Tunnelling as error:
            raise at.ws.dated(error, at.j, at.num_passes) from None

    def begin_of(self, at: Passes) -> tuple:
        """Array and slot of the displacements where a pass begins."""
        return (at.history.u, at.slot) if at.stride else (self.begin, 0)

    def follow(self, at: Passes, m: int) -> None:
        """Obstacles are where a pass begins (AT_BEGIN), or at its end."""
        if self.obstacles and self.obstacles.moves:
            self.obstacles.follow(self.a.poses.value(self.a.rows["path"], moment_of(at)), m)

    def _fine(self, u, slot: int) -> tuple:
        return (u, slot) if self.pairs is self.inner else (self.pairs.fine(u, slot), 0)

    def _look(self, u, slot: int) -> tuple[bool, bool, bool]:
        """Whether the list does not hold where the pass led, pairs beyond it may have crossed, pairs of it may be near."""
        inner = self.inner
        inner.near = inner.list.buffers.take("near", ti.i32, inner.list.count)
        return inner.look_at(inner.motion.find, u, slot)

    def _act(self, at: Passes, corners: np.ndarray | None) -> None:
        """What contact does to a pass, anew with a longer list where one does not hold to the end. corners: displacements of
        those of obstacles where it begins."""
        inner, history, own = self.inner, at.history, slice(self.num_own)
        stale, lost, any_near = self._look(*self._fine(history.u, at.end))
        now, acts = at.now if stale or any_near else None, False
        if now and now.alpha > 0:
            before = self.begin_of(at)
            start = self._all(self.rows.get(*before), corners)
            u, v = self.rows.get(history.u, at.end), self.rows.get(history.v, at.end)
            u = self._all(u, self.obstacles.displacements if self.obstacles else None)
            acts = bool(np.isfinite(u).all())  # else the guard of the run will say so
        one, needed = None, 0.0
        for _ in range(MOST_LISTS if acts else 0):
            if stale:
                moved = runtime.fetch_row(*self._fine(history.u, at.end))[inner.mesh.surface_vertices]
                needed = np.maximum(needed, 1.1 * inner.travel(moved - runtime.fetch(inner.before)))
                self.rows.put(history.u, at.end, u[own])
                self.rows.put(history.v, at.end, v)
                self.follow(at, AT_BEGIN)
                begin, more = self._fine(*before), 2 * float(needed.max())
                if self.obstacles and not self.pairs.is_covered(runtime.fetch_row(*before), more=more):
                    raise FarFromAll(more)
                inner.build(*begin, wanted=self._passes(needed) * needed, needed=needed)
                inner.forces(*begin, self.scratch)
                self.follow(at, AT_STAGE)
                _, lost, any_near = self._look(*self._fine(history.u, at.end))
            if any_near:
                one, lost = self._contact(at, now, start, u, v, lost)
            stale = lost
            if not lost:
                break
        inner.age += 1
        self.work += self.set.work if acts and any_near else 0.0
        if lost and acts:
            self._refuse(at, now)
        if at.stride:
            self.kept[at.end] = one
        if one and self._frame_of(at.ws.impulses, at) is not None:
            of = self._numbers(one, now)
            self._note(at.ws.impulses, at, one, of, [(part, one.solver.look(part, of)) for part in one.parts])

    def _passes(self, travel: np.ndarray) -> float:
        """How many passes of such lengths of vertices' ways a list should hold for."""
        share = self.inner.typical_slack * self.inner.width
        return float(np.clip(share / max(float(np.median(travel.max(1))), 1e-300), *PASSES))

    def _contact(self, at: Passes, now, start, u, v, lost: bool) -> tuple[ContactPass | None, bool]:
        """The stage, with the list as it is, of the pairs that would come near, and of those that do by what it does;
        (what was done, whether pairs beyond the list may have crossed)."""
        near, recording = self.set, bool(at.stride or self._frame_of(at.ws.impulses, at) is not None)
        one, parts, b, led_to = None, [], None, u
        for tries in range(MOST_TRIES):
            flagged = np.flatnonzero(whole(self.inner.near)[: self.inner.list.count])
            if extended := not near.holds(flagged):
                self._extend(flagged, now)
            mass = self.a.values.mass
            near.begin(self.whole.vectors(start), anew=tries == 0)
            if (tries == 0 or extended) and any(self.sets[x.set].follows_places for x in self.whole.near.sets):
                near.put_sets(self._factors(self.whole, self._places(self.whole, start, u, mass)))
            if not near.choose(self.whole.vectors(led_to - start)):
                break
            near.start(self.whole.vectors(u - start))
            parts = self._go(at, now, recording)
            e, b = near.moved
            led_to, v_next = u.copy(), v.copy()
            self._settle(self.whole, (u, v), led_to, v_next, start, e, b, now.decay, mass)
            self.rows.put(at.history.u, at.end, led_to[: self.num_own])
            self.rows.put(at.history.v, at.end, v_next)
            _, lost, _ = self._look(*self._fine(at.history.u, at.end))
        else:
            self._refuse(at, now)
        if b is not None and recording:
            one = self.whole.of(near.chosen > 0, start, u, v, parts, e, b)
        return one, lost

    def _extend(self, numbers: np.ndarray, now) -> None:
        """Take more pairs of the list into the set of those that have been near since it was made."""
        inner = self.inner
        close = whole(inner.plane)[: inner.list.count, 3] < CLOSE * inner.width
        close[numbers] = True
        if self.set.builds == inner.builds:
            close[self.set.numbers] = True
        numbers = np.flatnonzero(close)
        self.whole = self._pass(numbers)
        self.whole.u = np.zeros((len(self.nodes), 3))
        self.whole.start = self.whole.u if self.whole.near.sets else self.whole.u[self.whole.nodes]
        self.set.fill(self.whole, self._numbers(self.whole, now))

    @staticmethod
    def _frame_of(impulses, at: Passes) -> int | None:
        """The frame that counts what pairs do in a pass, if one does."""
        counted = at.numbers["counted"] if impulses and impulses.contacts else -1
        return counted if counted >= 0 else None

    def _of_contacts(self, impulses, at: Passes, one: ContactPass):
        """(frame, place among the contacts, which pairs are its) of each that is noted."""
        frame = self._frame_of(impulses, at)
        for k, number in enumerate(impulses.contacts if frame is not None else ()):
            own = one.rest[2].contact == number
            if own.any():
                yield frame, k, own

    def _bodies(self, one: ContactPass) -> tuple[np.ndarray, np.ndarray]:
        """(which nodes are vertices, their numbers)"""
        own = np.flatnonzero(one.nodes < self.num_own)
        return own, self.nodes[one.nodes[own]]

    def _note(self, impulses, at: Passes, one: ContactPass, of, taken: list, changes: bool = False) -> None:
        """Note what each contact did; taken: (part, where it looked), which are taken here unless changes are noted."""
        own, vertices = self._bodies(one)
        for part, look in taken if not changes else ():
            one.solver.take(part, of, look)
        for frame, k, which in self._of_contacts(impulses, at, one):
            for _, look in taken:
                for side, given in enumerate(one.solver.impulses(look, which, of)):
                    impulses.of_pairs[frame, k, side, vertices] += (given.imag / 1e-30 if changes else given)[own]

    def _seeds(self, impulses, at: Passes, one: ContactPass) -> list:
        """Adjoints of what each contact did."""
        out, (own, vertices) = [], self._bodies(one)
        for frame, k, which in self._of_contacts(impulses, at, one) if impulses else ():
            seeds = np.zeros((2, *one.parts[0].e.shape))
            seeds[:, own] = impulses.of_pairs[frame, k][:, vertices]
            out.append((which, *seeds))
        return out

    def _pass(self, numbers: np.ndarray) -> ContactPass:
        """Pairs of the list, without a state."""
        from scipy.sparse import csr_matrix, identity

        inner = self.inner
        corners = runtime.fetch(inner.list.pairs)[: 4 * inner.list.count].reshape(-1, 4)[numbers]
        edges = numbers >= inner.list.num_vt
        scale = np.zeros(len(numbers))
        scale[edges] = whole(inner.list.scale)[numbers[edges] - inner.list.num_vt]
        points, local = np.unique(corners, return_inverse=True)
        C, nodes, sets, free, count = None, points, [], None, len(points)
        if self.matrix is not None:
            C = self.matrix[points]
            nodes = np.unique(C.indices)
        place = self.node_place[nodes]
        if (self.set_of[place] >= 0).any():
            nodes = nodes[np.argsort(self.set_of[place], kind="stable")]  # those of a set together
            place = self.node_place[nodes]
            C = identity(len(self.node_place), format="csr")[points] if C is None else C
        if C is not None:
            C, count = C[:, nodes].tocsr(), len(nodes)
        for k in np.unique(self.set_of[place][self.set_of[place] >= 0]):
            at, more = np.flatnonzero(self.set_of[place] == k), np.arange(count, count + self.sets[k].count)
            twist = more[-1] if self.sets[k].twist else None
            sets.append(SimpleNamespace(set=k, here=self.member[place[at]], at=np.append(at, more), twist=twist))
            count = count + len(more)
        if sets:
            C = csr_matrix((C.data, C.indices, C.indptr), (len(points), count))
        if C is not None:
            C.sort_indices()
        if self.free is not None:
            free = np.concatenate([self.free[nodes], np.broadcast_to(np.eye(3), (count - len(nodes), 3, 3))])
        near = NearPairs(local.reshape(-1, 4), edges, scale, len(points), C, free, sets)
        rest = whole(inner.rest_plane)[numbers].astype(float), whole(inner.rest_weights)[numbers].astype(float)
        return ContactPass(near, numbers, place, points, corners, (*rest, self.numbers.of(numbers, corners)), None)

    def _numbers(self, one: ContactPass, now, changes=None) -> SimpleNamespace:
        """What parts read; changes: of it, as imaginary parts that are tiny."""
        a, own, near = self.a, one.rest[2], one.near
        nodes, numbers = self.nodes[one.nodes], np.asarray(a.values.parameters, float)
        rest, mass, inverse_mass, radius = a.values.rest - a.origin, a.values.mass, self.inverse, 0.0
        if self.obstacles:
            corners = self.obstacles.corners
            rest, radius = np.concatenate([rest, corners.made(numbers)]), np.append(0.0, corners.radii(numbers))
            mass = np.append(mass, np.zeros(corners.count))
            radius = radius[own.contact]
        inverse_mass = np.append(inverse_mass, np.zeros(len(mass) - len(inverse_mass)))
        start, end, h_alpha, D = one.start, one.u if near.sets else one.u[one.nodes], now.alpha, one.rest[0][:, 3]
        if changes is not None:
            rest, mass = rest + changes.rest, mass + changes.mass
            start, end, h_alpha = start + changes.start, end + changes.end, h_alpha + changes.alpha
            radius = radius + changes.radius[own.contact]
            D = D + np.einsum("pd,pk,pkd->p", one.rest[0][:, :3], one.rest[1], changes.fine_rest[one.pairs])
        of = lambda rows: numbers[rows] if changes is None else numbers[rows] + 1e-30j * changes.parameters[rows]  # noqa: E731
        k, W = own.area * of(own.stiffness), of(own.width)
        half = 0.5 * D / W
        share = np.where(half.real < 1, half, 1)
        inverse, sets = np.where(inverse_mass[nodes] > 0, 1 / np.where(mass[nodes] > 0, mass[nodes], 1), 0), []
        if near.sets:
            inverse[self.set_of[one.nodes] >= 0] = 0
            sets = self._factors(one, self._places(one, start, end, mass, rest))
            start, end = one.vectors(start), one.vectors(end)
            inverse = np.append(inverse, np.zeros(len(start) - len(inverse)))
        mu, with_friction = np.zeros(len(one.pairs), W.dtype), own.mu >= 0
        mu[with_friction] = of(own.mu[with_friction])
        speed = np.where(with_friction, of(own.speed), 1.0)
        rest = rest[one.points] if self.matrix is None else self.matrix[one.points] @ rest
        wall = mass[self.a.mesh.surface_vertices].mean()
        return SimpleNamespace(
            x=start, rest=rest, motion=end - start, inverse=inverse, sets=sets, h=now.h, alpha=h_alpha, wall=wall,
            stiffness=k / share, rough=self.rough,
            width=share * W, mu=mu, speed=speed,
            share=share, k=k, W=W, D=D, radius=radius, seeds=(),
        )  # fmt: skip

    def _factors(self, one: ContactPass, places: list) -> list:
        """Inverse masses of the sets."""
        return [self.sets[near.set].factors(near.here, *at) for near, at in zip(one.near.sets, places)]

    @property
    def inverse(self) -> np.ndarray:
        return self.a.inverse_of(self.a.values.mass)

    def _go(self, at: Passes, now, recording: bool) -> list[Part]:
        """The parts of a pass, which are noted if it is recorded."""
        parts, begin, share, shortened = [], 0.0, 1.0, False
        numbers = dict(h=now.h, alpha=now.alpha, damping=self.damping, rounding=self.rounding)
        while begin < 1:
            share = min(share, 1 - begin)
            before = self.set.moved if recording else None
            came_of, damping = self.set.take(begin=begin, share=share, **numbers)
            if came_of != TAKEN:
                share, shortened = 0.5 * share, True
                if share < SHORTEST:
                    self._refuse(at, now)
                continue
            if recording:
                parts.append(Part(begin, share, damping, *before, self.set.pushes))
            begin, share, shortened = begin + share, share if shortened else 2 * share, False
        return parts

    def _refuse(self, at: Passes, now) -> None:
        """Raise Tunnelling, the state's displacements being those where the pass begins."""
        inner, surface = self.inner, self.inner.mesh.surface_vertices
        moved = runtime.fetch_row(*self._fine(at.history.u, at.end))[surface] - runtime.fetch(inner.before)
        ways = np.linalg.norm(moved - moved.mean(0), axis=1)
        i, h = int(ways.argmax()), now.h
        where = inner.part("vertex", surface[i : i + 1])
        inner.fresh = False
        copy_slot(*self.begin_of(at), at.ws.state.u, 0)
        error = Tunnelling(
            f"contact of width {inner.width:.3g} m does not keep surfaces apart that move by {ways[i]:.3g} m in a substep "
            f"of {h:.3g} s, {ways[i] / h:.3g} m/s at {where}: take substeps of {0.25 * h:.3g} s"
        )
        error.stable_dt = 0.25 * h
        raise error

    @property
    def rounding(self) -> float:
        return 1e-6 * 2.0**-3 if self.a.precision == "f32" else 1e-15

    # ---- tangent -------------------------------------------------------------------------------------------------------

    def _alone(self, at: Passes, one: ContactPass | None):
        """The record without what the stage did."""
        return nullcontext() if one is None else self.rows.replaced(at.history, at.end, one.u[: self.num_own], one.v)

    @contextmanager
    def tangent(self, at: Passes):
        one, run, now = self.kept.get(at.end), at.run, at.now
        self.follow(at, AT_STAGE)
        before = self.rows.get(run.u, 0) if one else None
        with self._alone(at, one):
            yield
        if one is None:
            return
        tiny, t = 1e-30j, run.tangent
        after, change = self.rows.get(run.u, 0), self.rows.get(run.v, 0)
        rest = runtime.fetch(run.numbers.rest).astype(float) if t.rest is None else np.asarray(t.rest, float)
        parameters = np.asarray(t.parameters, float)[: len(self.a.values.parameters)]
        rate, at_begin, at_end, mass, radius = run.rate_dot, None, None, t.mass, np.zeros(1)
        if self.obstacles:
            poses = self.a.poses.jvp(self.a.rows["path"], t.path, moment_of(at))
            at_end, at_begin, _ = self.obstacles.changes(parameters, poses)
            rest, mass = (np.concatenate([x, np.zeros((len(at_end), *x.shape[1:]))]) for x in (rest, mass))
            radius = np.append(
                0.0, self.obstacles.corners.jvp("radii", self.a.values.parameters, parameters, 0.0, None)
            )
        first, last = self._all(before, at_begin), self._all(after, at_end)
        at_nodes = (lambda x: x) if one.near.sets else (lambda x: x[one.nodes])
        dots = SimpleNamespace(
            parameters=parameters, rest=tiny * rest, mass=tiny * mass, radius=tiny * radius,
            start=tiny * at_nodes(first), end=tiny * at_nodes(last), alpha=tiny * rate * now.alpha_by_rate,
            fine_rest=tiny * (rest if self.matrix is None else self.matrix @ rest),
        )  # fmt: skip
        of = self._numbers(one, now, dots)
        e = b = np.zeros_like(of.motion)
        looks = []
        for part in one.parts:
            own = replace(part, e=part.e + 1j * e.imag, b=part.b + 1j * b.imag)  # from where the run was
            looks.append((own, one.solver.look(own, of)))
            e, b = one.solver.take(own, of, looks[-1][1])
        if run.impulses:
            self._note(run.impulses, at, one, of, looks, changes=True)
        decay = now.decay + tiny * rate * now.decay_by_rate
        u, v = one.u + tiny * last, one.v + tiny * change
        given, start = (u.copy(), v.copy()), one.start + dots.start
        mass, rest = (x[: self.a.num_vertices] for x in (dots.mass, dots.rest))
        mass, rest = self.a.values.mass + mass, self.a.values.rest - self.a.origin + rest
        e, b = one.e + 1j * e.imag, one.b + 1j * b.imag
        self._settle(one, given, u, v, start, e, b, decay, mass, rest)
        self.rows.put(run.u, 0, u.imag[: self.num_own] / 1e-30)
        self.rows.put(run.v, 0, v.imag / 1e-30)

    # ---- adjoint -------------------------------------------------------------------------------------------------------

    @contextmanager
    def adjoint(self, at: Passes):
        one, run, now = self.kept.get(at.end), at.run, at.now
        if one is None:
            yield
            return
        run.complete()
        self.follow(at, AT_STAGE)
        p, q = self.rows.get(run.u, 0), self.rows.get(run.v, 0)
        of = self._numbers(one, now)
        of.seeds = self._seeds(run.impulses, at, one)
        count = len(of.inverse)
        adj = SimpleNamespace(
            x=np.zeros_like(of.motion), motion=np.zeros_like(of.motion), inverse=np.zeros(count), alpha=0.0,
            rest=np.zeros_like(of.rest), sets=[x.zeros() for x in of.sets],
            stiffness=np.zeros(len(one.pairs)), width=np.zeros(len(one.pairs)), mu=np.zeros(len(one.pairs)),
            speed=np.zeros(len(one.pairs)), radius=np.zeros(len(one.pairs)), wall=0.0,
        )  # fmt: skip
        e_adj, b_adj, alone = np.zeros((count, 3)), np.zeros((count, 3)), np.flatnonzero(self._alone_among(one.nodes))
        e_adj[alone], b_adj[alone] = p[one.nodes[alone]], q[one.nodes[alone]]
        by_decay = total(b_adj * one.b)
        b_adj = now.decay * b_adj
        at_begin, places = np.zeros_like(p), []
        if one.near.sets:
            places = self._places(one, one.start, one.u, self.a.values.mass)
            by_decay += self._settle_vjp(one, places, now.decay, p, q, at_begin, e_adj, b_adj)
        for part in one.parts[::-1]:
            e_adj, b_adj = one.solver.back(part, of, e_adj, b_adj, adj)
        self.by_rate += now.alpha_by_rate * adj.alpha + now.decay_by_rate * by_decay
        for near, where, own, by in zip(one.near.sets, places, of.sets, adj.sets):
            x = self.sets[near.set]
            by_places, by_mass = x.factors_vjp(near.here, *where, own, by)
            self._add_of_set(x, by_places, by_places, by_mass, at_begin, p)
        own = one.nodes < self.num_own
        at_begin[one.nodes[own]] += (adj.x - adj.motion)[: len(own)][own]
        p[one.nodes[own]] += adj.motion[: len(own)][own]
        self.rows.put(run.u, 0, p)
        if one.near.sets:
            self.rows.put(run.v, 0, q)
        self._add_numbers(one, of, adj)
        if self.obstacles:
            self._add_obstacles(at, one, adj)
        with self._alone(at, one):
            yield
        self.rows.put(run.u, 0, self.rows.get(run.u, 0) + at_begin)

    def _settle_vjp(self, one: ContactPass, places: list, decay, p, q, at_begin, e_adj, b_adj) -> float:
        """From the adjoints of where the pass led to those of sets without contact, and of what it did, e and b; the adjoint
        of the decay."""
        e, b, by_decay = one.e, one.b, 0.0
        for near, at in zip(one.near.sets, places):
            x, numbers = self.sets[near.set], near.at[len(near.here) :]
            by_x, by_v = p[x.at], q[x.at]
            by = x.settle_vjp(*at[:2], one.v[x.at], e[numbers], b[numbers], decay, at[2], by_x, by_v)
            e_adj[numbers], b_adj[numbers], q[x.at] = by.e, by.b, by.v
            self.by_rest[x.vertices] -= by_x  # displacements are places less these
            p[x.at] = 0
            self._add_of_set(x, by.x0, by.x1, by.m, at_begin, p)
            by_decay += by.decay
        return by_decay

    def _add_of_set(self, x: SetInContact, by_x0, by_x1, by_mass, at_begin, p) -> None:
        """Adjoints by places where a pass begins and would end, which a set's mobility is of, and by masses."""
        at_begin[x.at] += by_x0
        p[x.at] += by_x1
        self.by_rest[x.vertices] += by_x0 + by_x1
        self.by_mass[x.vertices] += by_mass

    def _add_obstacles(self, at: Passes, one: ContactPass, adj) -> None:
        """Adjoints of where corners of obstacles were, and of radii."""
        theirs = np.flatnonzero(one.nodes >= self.num_own)
        obstacles, place = self.obstacles, one.nodes[theirs] - self.num_own
        by_begin, by_end = np.zeros((2, obstacles.corners.count, 3))
        by_begin[place], by_end[place] = (adj.x - adj.motion)[theirs], adj.motion[theirs]
        obstacles.add_places(by_begin, AT_BEGIN)
        obstacles.add_places(by_end, AT_STAGE)
        by_radii = np.zeros(1 + len(obstacles.corners.parts))
        np.add.at(by_radii, one.rest[2].contact, adj.radius)
        obstacles.corners.vjp("radii", self.a.values.parameters, 0.0, by_radii[1:], self.by_numbers, None)
        by_rows = obstacles.take_rows()
        if self.by_path is not None:
            self.a.poses.vjp(self.a.rows["path"], by_rows, moment_of(at), self.by_path)

    def _add_numbers(self, one: ContactPass, of, adj) -> None:
        """Adjoints of the numbers, of masses and of the rest shape."""
        surface, own = self.a.mesh.surface_vertices, one.nodes < self.num_own
        nodes, numbers = self.nodes[one.nodes[own]], one.rest[2]
        self.by_mass[nodes] -= (of.inverse**2 * adj.inverse)[: len(own)][own]
        self.by_mass[surface] += adj.wall / len(surface)
        self.by_fine_rest[one.points] += adj.rest
        # stiffness k / share, width share W, share = min(1, D / (2 W))
        by_share = np.where(of.share < 1, of.W * adj.width - of.k / of.share**2 * adj.stiffness, 0)
        np.add.at(self.by_numbers, numbers.stiffness, numbers.area * adj.stiffness / of.share)
        np.add.at(self.by_numbers, numbers.width, of.share * adj.width - by_share * of.share / of.W)
        by_D = 0.5 * by_share / of.W
        if by_D.any():
            plane, weights = one.rest[:2]
            at_corners = (by_D[:, None] * weights)[:, :, None] * plane[:, None, :3]
            np.add.at(self.by_fine_rest, one.pairs, at_corners)
        if self.rough:
            with_friction = numbers.mu >= 0
            np.add.at(self.by_numbers, numbers.speed[with_friction], adj.speed[with_friction])
            np.add.at(self.by_numbers, numbers.mu[with_friction], adj.mu[with_friction])

    def clear(self) -> None:
        a, path = self.a, self.a.rows.get("path")
        self.by_numbers, self.by_mass, self.by_rate = np.zeros(len(a.values.parameters)), np.zeros(a.num_vertices), 0.0
        self.by_fine_rest, self.by_rest = np.zeros((self.inner.mesh.num_vertices, 3)), np.zeros((a.num_vertices, 3))
        self.by_path = np.zeros(path.shape) if self.obstacles and path is not None else None
        if self.obstacles:
            self.obstacles.clear()

    def collect(self, out: Derived) -> None:
        out.parameters += self.by_numbers
        by_fine = (
            self.by_fine_rest if self.matrix is None else (self.matrix.T @ self.by_fine_rest)[: self.a.num_vertices]
        )
        if self.obstacles:
            out.parameters += self.obstacles.by_parameters
        if self.by_path is not None:
            out.path += self.by_path
        out.rest = by_fine + self.by_rest + out.rest
        out.mass = out.mass + self.by_mass
        drag = self.a.features().drag
        if drag >= 0:
            out.parameters[drag] += self.by_rate
