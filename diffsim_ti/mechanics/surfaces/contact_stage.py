"""Contact of surfaces with themselves and each other as a stage of explicit passes, which no step is too large for.

After the kick by all other forces and the drift, pairs that are near before it or would be after it act on what moved: the
pass is gone through in parts (contact_parts.py) that move near surfaces by a share of the width, and not farther than half
way to each other, where contact damping is that of the solver; or shorter ones with full damping, each of which leaves
surfaces apart. Vertices of no near pair keep what they had, bit by bit.
"""

from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from math import fsum
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.mechanics.surfaces.buffers import whole
from diffsim_ti.mechanics.surfaces.contact_parts import NearPairs, Part, PartSolver
from diffsim_ti.mechanics.surfaces.near_set import NearSet
from diffsim_ti.mechanics.surfaces.pair_numbers import PairNumbers
from diffsim_ti.mechanics.surfaces.part_kernels import TAKEN
from diffsim_ti.mechanics.surfaces.surface_pairs import Tunnelling
from diffsim_ti.runtime.slots import VertexRows, copy_slot
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE, Moment

MOST_LISTS = 6  # made for one pass
MOST_TRIES = 12  # at a pass with one list, each with the pairs that came near in the one before
PASSES = 1.5, 15  # like this one, that a list made for it should hold for, at least and at most
SHORTEST = 2.0**-14  # share of a pass


def moment_of(at: Passes) -> Moment:
    """Obstacles at the end of a pass, and where it begins."""
    schedule = at.ws.solver.schedule
    return Moment(schedule, at.j, schedule.end(at.j), schedule.begin(at.j))


@dataclass
class ContactPass:
    """What was done in a recorded pass: to which nodes, from where, and the state that the drift had led to."""

    near: NearPairs
    numbers: np.ndarray  # of the pairs in the list
    nodes: np.ndarray
    pairs: np.ndarray
    rest: tuple  # of pairs: plane and weights at rest, which coefficient of friction
    start: np.ndarray
    u: np.ndarray | None = None
    v: np.ndarray | None = None
    parts: list[Part] = field(default_factory=list)
    b: np.ndarray | None = None  # what velocities gained

    @property
    def solver(self) -> PartSolver:
        return PartSolver(self.near)

    def of(self, chosen: np.ndarray, start, u, v) -> "ContactPass":
        """Of some of the pairs, in a pass between these states of all nodes."""
        near = replace(self.near, **{x: getattr(self.near, x)[chosen] for x in ("corners", "edges", "scale")})
        plane, weights, own = self.rest
        own = SimpleNamespace(**{name: x[chosen] for name, x in vars(own).items()})
        rest = plane[chosen], weights[chosen], own
        return ContactPass(near, self.numbers[chosen], self.nodes, self.pairs[chosen], rest, start[self.nodes], u, v)


class PairContact(Stage):
    """The stage, of the pairs of a workspace (surface_pairs.py, curved_pairs.py)."""

    def __init__(self, pairs, damping: float):
        self.damping = damping
        self.pairs, self.inner, self.a = pairs, getattr(pairs, "inner", pairs), pairs.a
        a, mesh = self.a, self.a.mesh
        self.matrix, self.obstacles = getattr(pairs, "matrix", None), pairs.obstacles
        self.rows, num_nodes = VertexRows(a, mesh.surface_vertices), mesh.num_vertices
        self.num_own = len(mesh.surface_vertices)
        self.nodes = mesh.surface_vertices  # of bodies; corners of obstacles, of infinite mass, follow all vertices
        if self.obstacles:
            num_nodes += self.obstacles.corners.count
            self.matrix = self.pairs.finer.mesh.with_corners
            self.nodes = np.append(self.nodes, np.arange(mesh.num_vertices, num_nodes))
        self.node_place = np.full(num_nodes, -1)
        self.node_place[self.nodes] = np.arange(len(self.nodes))
        self.kept: dict[int, ContactPass | None] = {}
        self.work = 0.0  # done by what moves obstacles and held vertices, as they press [J]
        self.partly_fixed = bool(len(a.supports.partly_fixed))
        self.free = a.supports.freedom(num_nodes) if self.partly_fixed else None
        self.numbers, self.rough = PairNumbers(self.inner), self.inner.has_friction
        runtime.fill(a.corner, 0)
        corners = self.inner.a.first_contact_corner + self.inner.list.num_surface
        self.scratch = runtime.array(self.inner.kernels.vec4, corners)  # for forces, which are not looked at
        self.begin = runtime.array(a.vector, 1, a.num_vertices)
        self.set, self.whole = NearSet(self.inner), None  # pairs that have been near, and what there is to know of them
        runtime.fill(self.begin, 0)
        self.clear()

    # ---- passes --------------------------------------------------------------------------------------------------------

    @contextmanager
    def do(self, at: Passes):
        pairs, inner, u = self.pairs, self.inner, at.history.u
        self._follow(at, AT_BEGIN)
        if at.launch is None:
            pairs.ensure(u, at.slot)
        fine = self._fine(u, at.slot)
        inner.forces(*fine, self.scratch)
        corners = self.obstacles.displacements if self.obstacles else None
        if not at.stride:
            copy_slot(u, at.slot, self.begin, 0)  # which the drift replaces
        yield
        self._follow(at, AT_STAGE)
        if at.stride:
            self.kept[at.end] = None
        try:
            self._act(at, corners)
        except Tunnelling as error:
            raise at.ws.dated(error, at.j, at.num_passes) from None

    def _follow(self, at: Passes, m: int) -> None:
        """Obstacles are where a pass begins (AT_BEGIN), or at its end."""
        if self.obstacles:
            self.pairs.follow(self.a.poses.value(self.a.rows["path"], moment_of(at)), m)

    def _fine(self, u, slot: int) -> tuple:
        return (u, slot) if self.matrix is None else (self.pairs.fine(u, slot), 0)

    def _look(self, u, slot: int) -> tuple[bool, bool, bool]:
        """Whether the list does not hold where the pass led, whether pairs beyond it may have crossed, and whether pairs of
        it may be near."""
        inner = self.inner
        inner.near = inner.list.buffers.take("near", ti.i32, inner.list.count)
        inner.look_at(inner.motion.find, u, slot)
        return tuple(bool(x) for x in whole(inner.flags))

    def _act(self, at: Passes, corners: np.ndarray | None) -> None:
        """What contact does to a pass, anew with a longer list where one does not hold to the end. corners: displacements of
        those of obstacles where it begins."""
        inner, history, own = self.inner, at.history, slice(self.num_own)
        stale, lost, any_near = self._look(*self._fine(history.u, at.end))
        now, acts = at.now if stale or any_near else None, False
        if now and now.alpha > 0:
            before = (history.u, at.slot) if at.stride else (self.begin, 0)
            start = self.rows.get(*before)
            u, v = self.rows.get(history.u, at.end), self.rows.get(history.v, at.end)
            if self.obstacles:
                start, u = np.concatenate([start, corners]), np.concatenate([u, self.obstacles.displacements])
            acts = bool(np.isfinite(u).all())  # else the guard of the run will say so
        one, needed = None, 0.0
        for _ in range(MOST_LISTS if acts else 0):
            if stale:
                moved = runtime.fetch_row(*self._fine(history.u, at.end))[inner.mesh.surface_vertices]
                needed = np.maximum(needed, 1.1 * inner.travel(moved - runtime.fetch(inner.before)))
                self.rows.put(history.u, at.end, u[own])
                self.rows.put(history.v, at.end, v)
                self._follow(at, AT_BEGIN)
                begin = self._fine(*before)
                inner.build(*begin, wanted=self._passes(needed) * needed, needed=needed)
                inner.forces(*begin, self.scratch)
                self._follow(at, AT_STAGE)
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
        if one and at.ws.impulses:
            of = self._numbers(one, now)
            self._note(at.ws.impulses, at, one, of, [(part, one.solver.look(part, of)) for part in one.parts])

    def _passes(self, travel: np.ndarray) -> float:
        """How many passes of such lengths of vertices' ways a list should hold for."""
        share = self.inner.typical_slack * self.inner.width
        return float(np.clip(share / max(float(np.median(travel.max(1))), 1e-300), *PASSES))

    def _contact(self, at: Passes, now, start, u, v, lost: bool) -> tuple[ContactPass | None, bool]:
        """The stage, with the list as it is, of the pairs that would come near, and of those that do by what it does;
        (what was done, whether pairs beyond the list may have crossed)."""
        near, recording = self.set, bool(at.stride or at.ws.impulses)
        one, parts, b, led_to = None, [], None, u
        for tries in range(MOST_TRIES):
            flagged = np.flatnonzero(whole(self.inner.near)[: self.inner.list.count])
            if not near.holds(flagged):
                self._extend(flagged, now)
            place = self.whole.nodes
            motion, own = u[place] - start[place], place < self.num_own
            near.begin(self.rest + start[place], anew=tries == 0)
            if not near.choose(led_to[place] - start[place]):
                break
            near.start(motion)
            parts = self._go(at, now, recording)
            e, b = near.moved
            led_to, v_next = u.copy(), v.copy()
            led_to[place[own]] += e[own]
            v_next[place[own]] += now.decay * b[own]
            self.rows.put(at.history.u, at.end, led_to[: self.num_own])
            self.rows.put(at.history.v, at.end, v_next)
            _, lost, _ = self._look(*self._fine(at.history.u, at.end))
        else:
            self._refuse(at, now)
        if b is not None and recording:
            one = self.whole.of(near.chosen > 0, start, u, v)
            one.parts, one.b = parts, b
        return one, lost

    def _extend(self, numbers: np.ndarray, now) -> None:
        """Take more pairs of the list into the set of those that have been near since it was made."""
        inner = self.inner
        close = whole(inner.plane)[: inner.list.count, 3] < 2 * inner.width  # so that it is seldom extended
        close[numbers] = True
        if self.set.builds == inner.builds:
            close[self.set.numbers] = True
        numbers = np.flatnonzero(close)
        self.whole, a = self._pass(numbers), self.a
        rest = a.values.rest - a.origin
        if self.obstacles:
            rest = np.concatenate([rest, self.obstacles.corners.made(a.values.parameters.astype(float))])
        self.rest = rest[self.nodes[self.whole.nodes]]
        self.whole.u = np.zeros((len(self.nodes), 3))
        self.whole.start = self.whole.u[self.whole.nodes]
        self.set.fill(self.whole, self._numbers(self.whole, now))

    def _of_obstacles(self, impulses, at: Passes, one: ContactPass):
        """(frame, place among the obstacles by pairs, which pairs are its) of each that is noted."""
        frame = impulses.frame_of(at.numbers)
        for k in range(len(impulses.by_pairs) if frame is not None else 0):
            own = one.rest[2].contact == k + 1
            if own.any():
                yield frame, k, own

    def _note(self, impulses, at: Passes, one: ContactPass, of, taken: list, changes: bool = False) -> None:
        """Note what each obstacle did; taken: (part, where it looked), which are taken here unless changes are noted."""
        for frame, k, own in self._of_obstacles(impulses, at, one):
            bodies = one.nodes < self.num_own
            for part, look in taken:
                if not changes:
                    one.solver.take(part, of, look)
                for side, given in enumerate(one.solver.impulses(look, own, of)):
                    given = given.imag / 1e-30 if changes else given
                    impulses.of_pairs[frame, k, side, one.nodes[bodies]] += given[bodies]

    def _seeds(self, impulses, at: Passes, one: ContactPass) -> list:
        """Adjoints of what each obstacle did."""
        out, bodies = [], one.nodes < self.num_own
        for frame, k, own in self._of_obstacles(impulses, at, one) if impulses else ():
            seeds = np.zeros((2, len(one.nodes), 3))
            seeds[:, bodies] = impulses.of_pairs[frame, k][:, one.nodes[bodies]]
            out.append((own, *seeds))
        return out

    def _pass(self, numbers: np.ndarray) -> ContactPass:
        """Pairs of the list, without a state."""
        inner = self.inner
        corners = runtime.fetch(inner.list.pairs)[: 4 * inner.list.count].reshape(-1, 4)[numbers]
        edges = numbers >= inner.list.num_vt
        scale = np.zeros(len(numbers))
        scale[edges] = whole(inner.list.scale)[numbers[edges] - inner.list.num_vt]
        points, local = np.unique(corners, return_inverse=True)
        C, nodes = None, points
        if self.matrix is not None:
            C = self.matrix[points]
            nodes = np.unique(C.indices)
            C = C[:, nodes].tocsr()
        free = None if self.free is None else self.free[nodes]
        near = NearPairs(local.reshape(-1, 4), edges, scale, len(points), C, free)
        rest = whole(inner.rest_plane)[numbers].astype(float), whole(inner.rest_weights)[numbers].astype(float)
        place = self.node_place[nodes]
        return ContactPass(near, numbers, place, corners, (*rest, self.numbers.of(numbers, corners)), None)

    def _numbers(self, one: ContactPass, now, changes=None) -> SimpleNamespace:
        """What parts read; changes: of it, as imaginary parts of the size `TINY`."""
        a, own = self.a, one.rest[2]
        nodes, numbers = self.nodes[one.nodes], a.values.parameters.astype(float)
        rest, mass, inverse_mass, radius = a.values.rest - a.origin, a.values.mass, self.inverse, 0.0
        if self.obstacles:
            corners = self.obstacles.corners
            rest, radius = np.concatenate([rest, corners.made(numbers)]), np.append(0.0, corners.radii(numbers))
            mass, inverse_mass = (np.append(x, np.zeros(corners.count)) for x in (mass, inverse_mass))
            radius = radius[own.contact]
        start, end, h_alpha, D = one.start, one.u[one.nodes], now.alpha, one.rest[0][:, 3]
        if changes is not None:
            numbers, rest, mass = numbers + changes.parameters, rest + changes.rest, mass + changes.mass
            start, end, h_alpha = start + changes.start, end + changes.end, h_alpha + changes.alpha
            radius = radius + changes.radius[own.contact]
            D = D + np.einsum("pd,pk,pkd->p", one.rest[0][:, :3], one.rest[1], changes.fine_rest[one.pairs])
        k, W = own.area * numbers[own.stiffness], numbers[own.width]
        half = 0.5 * D / W
        share = np.where(half.real < 1, half, 1)
        inverse = np.where(inverse_mass[nodes] > 0, 1 / np.where(mass[nodes] > 0, mass[nodes], 1), 0)
        mu, with_friction = np.zeros(len(one.pairs), numbers.dtype), own.mu >= 0
        mu[with_friction] = numbers[own.mu[with_friction]]
        speed = np.where(with_friction, numbers[own.speed], 1.0)
        return SimpleNamespace(
            x=rest[nodes] + start, motion=end - start, inverse=inverse, h=now.h, alpha=h_alpha, stiffness=k / share,
            width=share * W, mu=mu, speed=speed, wall=mass[self.a.mesh.surface_vertices].mean(), rough=self.rough,
            share=share, k=k, W=W, D=D, radius=radius, seeds=(),
        )  # fmt: skip

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
                parts.append(Part(begin, share, damping, *before, self.set.solution))
            begin, share, shortened = begin + share, share if shortened else 2 * share, False
        return parts

    def _refuse(self, at: Passes, now) -> None:
        inner, surface = self.inner, self.inner.mesh.surface_vertices
        moved = runtime.fetch_row(*self._fine(at.history.u, at.end))[surface] - runtime.fetch(inner.before)
        ways = np.linalg.norm(moved - moved.mean(0), axis=1)
        i, h = int(ways.argmax()), now.h
        inner.fresh = False
        error = Tunnelling(
            f"contact of width {inner.width:.3g} m does not keep surfaces apart that move by {ways[i]:.3g} m in a substep "
            f"of {h:.3g} s, {ways[i] / h:.3g} m/s at vertex {surface[i]}: take substeps of {0.25 * h:.3g} s"
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
        self._follow(at, AT_STAGE)
        before = self.rows.get(run.u, 0) if one else None
        with self._alone(at, one):
            yield
        if one is None:
            return
        tiny, t = 1e-30j, run.tangent
        after, change = self.rows.get(run.u, 0), self.rows.get(run.v, 0)
        rest = runtime.fetch(run.numbers.rest).astype(float) if t.rest is None else np.asarray(t.rest, float)
        parameters = np.asarray(t.parameters, float)[: len(self.a.values.parameters)]
        rate, first, last, mass, radius = run.rate_dot, before, after, t.mass, np.zeros(1)
        if self.obstacles:
            poses = self.a.poses.jvp(self.a.rows["path"], t.path, moment_of(at))
            at_end, at_begin, _ = self.obstacles.changes(parameters, poses)
            first, last = np.concatenate([before, at_begin]), np.concatenate([after, at_end])
            rest, mass = (np.concatenate([x, np.zeros((len(at_end), *x.shape[1:]))]) for x in (rest, mass))
            radius = np.append(0.0, self.obstacles.corners.radii_jvp(self.a.values.parameters, parameters))
        dots = SimpleNamespace(
            parameters=tiny * parameters, rest=tiny * rest, mass=tiny * mass, radius=tiny * radius,
            start=tiny * first[one.nodes], end=tiny * last[one.nodes], alpha=tiny * rate * now.alpha_by_rate,
            fine_rest=tiny * (rest if self.matrix is None else self.matrix @ rest),
        )  # fmt: skip
        of = self._numbers(one, now, dots)
        e = b = np.zeros_like(of.motion)
        looks = []
        for part in one.parts:
            own = Part(part.begin, part.share, part.c, e, b, part.xi)
            looks.append((own, one.solver.look(own, of)))
            e, b = one.solver.take(own, of, looks[-1][1])
        if run.impulses:
            self._note(run.impulses, at, one, of, looks, changes=True)
        decay = now.decay + tiny * rate * now.decay_by_rate
        own = one.nodes < self.num_own
        after[one.nodes[own]] += e[own].imag / 1e-30
        change[one.nodes[own]] += (decay * b[own]).imag / 1e-30
        self.rows.put(run.u, 0, after)
        self.rows.put(run.v, 0, change)

    # ---- adjoint -------------------------------------------------------------------------------------------------------

    @contextmanager
    def adjoint(self, at: Passes):
        one, run, now = self.kept.get(at.end), at.run, at.now
        if one is None:
            yield
            return
        run.complete()
        self._follow(at, AT_STAGE)
        p, q = self.rows.get(run.u, 0), self.rows.get(run.v, 0)
        of = self._numbers(one, now)
        of.seeds = self._seeds(run.impulses, at, one)
        own, count = one.nodes < self.num_own, len(one.nodes)
        nodes = one.nodes[own]
        adj = SimpleNamespace(
            x=np.zeros_like(of.motion), motion=np.zeros_like(of.motion), inverse=np.zeros(count), alpha=0.0,
            stiffness=np.zeros(len(one.pairs)), width=np.zeros(len(one.pairs)), mu=np.zeros(len(one.pairs)),
            speed=np.zeros(len(one.pairs)), radius=np.zeros(len(one.pairs)), wall=0.0,
        )  # fmt: skip
        e_adj, b_adj = np.zeros((2, count, 3))
        e_adj[own], b_adj[own] = p[nodes], now.decay * q[nodes]
        by_decay = fsum((q[nodes] * one.b[own]).ravel())  # whatever other nodes the set has, which add zeros
        for part in one.parts[::-1]:
            e_adj, b_adj = one.solver.back(part, of, e_adj, b_adj, adj)
        self.by_rate += now.alpha_by_rate * adj.alpha + now.decay_by_rate * by_decay
        by_start = (adj.x - adj.motion)[own]
        p[nodes] += adj.motion[own]
        self.rows.put(run.u, 0, p)
        self._add(one, of, adj, own)
        if self.obstacles:
            self._add_obstacles(at, one, adj, own)
        with self._alone(at, one):
            yield
        p = self.rows.get(run.u, 0)
        p[nodes] += by_start
        self.rows.put(run.u, 0, p)

    def _add_obstacles(self, at: Passes, one: ContactPass, adj, own: np.ndarray) -> None:
        """Adjoints of where corners of obstacles were, and of radii."""
        obstacles, place = self.obstacles, one.nodes[~own] - self.num_own
        by_begin, by_end = np.zeros((2, obstacles.corners.count, 3))
        by_begin[place], by_end[place] = (adj.x - adj.motion)[~own], adj.motion[~own]
        obstacles.add_places(by_begin, AT_BEGIN)
        obstacles.add_places(by_end, AT_STAGE)
        by_radii = np.zeros(1 + len(obstacles.corners.parts))
        np.add.at(by_radii, one.rest[2].contact, adj.radius)
        obstacles.corners.add_radii(self.a.values.parameters, by_radii[1:], self.by_numbers)
        by_rows = obstacles.take_rows()
        if self.by_path is not None:
            self.a.poses.vjp(self.a.rows["path"], by_rows, moment_of(at), self.by_path)

    def _add(self, one: ContactPass, of, adj, own: np.ndarray) -> None:
        """Adjoints of the numbers, of masses and of the rest shape."""
        surface = self.a.mesh.surface_vertices
        nodes, numbers = self.nodes[one.nodes[own]], one.rest[2]
        self.by_mass[nodes] -= (of.inverse**2 * adj.inverse)[own]
        self.by_mass[surface] += adj.wall / len(surface)
        self.by_rest[nodes] += adj.x[own]
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
        self.by_rest, self.by_fine_rest = np.zeros((a.num_vertices, 3)), np.zeros((self.inner.mesh.num_vertices, 3))
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
        out.rest = self.by_rest + by_fine + out.rest
        out.mass = out.mass + self.by_mass
        drag = self.a.features().drag
        if drag >= 0:
            out.parameters[drag] += self.by_rate
