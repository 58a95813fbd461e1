"""Contact of surfaces with themselves and each other as a stage of explicit passes, which no step is too large for.

After the kick by all other forces and the drift, pairs that are near before it or would be after it act on what moved: the
pass is gone through in parts (contact_parts.py) that move near surfaces by a share of the width, and not farther than half
way to each other, where contact damping is that of the solver; or shorter ones with full damping, each of which leaves
surfaces apart. Vertices of no near pair keep what they had, bit by bit.
"""

from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.mechanics.surfaces.buffers import whole
from diffsim_ti.mechanics.surfaces.contact_parts import NearPairs, Part, PartSolver
from diffsim_ti.mechanics.surfaces.host_geometry import dot, nearest
from diffsim_ti.mechanics.surfaces.surface_pairs import Tunnelling
from diffsim_ti.runtime.slots import VertexRows
from diffsim_ti.terms.self_contact import SelfContact

LONGEST, RESOLVED = 0.2, 0.02  # of the width that near surfaces move in a part; and where it need not be resolved
HALF = 0.5  # share of a distance by which a resolved part may close it before normals are taken
MOST_LISTS = 6  # made for one pass
MOST_LOOKS = 200  # at the pairs of a pass
SHORTEST = 2.0**-14  # share of a pass
INDEX = SelfContact.index


@dataclass
class ContactPass:
    """What was done in a recorded pass: to which nodes, from where, and the state that the drift had led to."""

    solver: PartSolver
    nodes: np.ndarray
    pairs: np.ndarray
    start: np.ndarray
    u: np.ndarray
    v: np.ndarray
    parts: list[Part]
    b: np.ndarray  # what velocities gained
    rest: tuple  # of pairs: plane and weights at rest, which coefficient of friction


class PairContact(Stage):
    """The stage, of the pairs of a workspace (surface_pairs.py, curved_pairs.py)."""

    def __init__(self, pairs, damping: float):
        self.damping = damping
        self.pairs, self.inner, self.a = pairs, getattr(pairs, "inner", pairs), pairs.a
        a, mesh = self.a, self.a.mesh
        self.matrix = getattr(pairs, "matrix", None)
        self.rows = VertexRows(a, mesh.surface_vertices)
        self.node_place = np.full(mesh.num_vertices, -1)
        self.node_place[mesh.surface_vertices] = np.arange(len(mesh.surface_vertices))
        self.kept: dict[int, ContactPass | None] = {}
        self.partly_fixed = bool(len(a.supports.partly_fixed))
        self.free = a.supports.freedom(a.num_vertices) if self.partly_fixed else None
        labels, rows = self.inner.term.labels(self.inner.mesh)
        self.label = np.zeros(self.inner.mesh.num_vertices, int)
        self.label[self.inner.mesh.surface_vertices] = labels
        self.row_of, self.rough = rows, self.inner.term.has_friction
        runtime.fill(a.corner, 0)
        corners = self.inner.a.first_contact_corner + self.inner.list.num_surface
        self.scratch = runtime.array(self.inner.kernels.vec4, corners)  # for forces, which are not looked at
        self.begin = runtime.array(a.vector, 1, a.num_vertices)
        runtime.fill(self.begin, 0)
        self.clear()

    # ---- passes --------------------------------------------------------------------------------------------------------

    @contextmanager
    def do(self, at: Passes):
        pairs, inner, u, now = self.pairs, self.inner, at.history.u, at.now
        if at.launch is None:
            pairs.ensure(u, at.slot)
        fine = self._fine(u, at.slot)
        inner.forces(*fine, self.scratch)
        start = self.rows.get(u, at.slot)
        yield
        if at.stride:
            self.kept[at.end] = None
        try:
            if now.alpha > 0:
                self._act(at, start)
            inner.check_pass(*self._fine(u, at.end), now.h)
        except Tunnelling as error:
            raise at.ws.dated(error, at.j, at.num_passes) from None

    def _fine(self, u, slot: int) -> tuple:
        return (u, slot) if self.matrix is None else (self.pairs.fine(u, slot), 0)

    def _look(self, u, slot: int) -> tuple[bool, bool]:
        """(whether the list does not hold where the pass led, whether pairs of it may be near)"""
        inner = self.inner
        inner.near = inner.list.buffers.take("near", ti.i32, inner.list.count)
        bodies = dict(num_bodies=inner.num_bodies, markers=inner.markers, lost=0.0, **inner.sizes_of_sums)
        inner.run(inner.motion.find, dict(u=u), slot=slot, **bodies)
        flags = runtime.view(inner.flags)
        stale, _, near = runtime.fetch(inner.flags) if flags is None else flags
        return bool(stale), bool(near)

    def _act(self, at: Passes, start: np.ndarray) -> None:
        """What contact does to a pass from `start`; anew with a longer list where one does not hold to the end."""
        inner, history, surface = self.inner, at.history, self.inner.mesh.surface_vertices
        u, v = self.rows.get(history.u, at.end), self.rows.get(history.v, at.end)
        stale, any_near = self._look(*self._fine(history.u, at.end))
        wanted, lists = 0.0, MOST_LISTS if stale or any_near else 0
        for _ in range(lists):
            if stale:
                moved = runtime.fetch_row(*self._fine(history.u, at.end))[surface] - runtime.fetch(inner.before)
                wanted = np.maximum(wanted, 1.1 * inner.travel(moved))
                self.rows.put(history.u, at.end, u)
                self.rows.put(history.v, at.end, v)
                self.rows.put(self.begin, 0, start)
                begin = self._fine(self.begin, 0)
                inner.age = 0  # the slacks are those wanted, whatever the pace before
                inner.build(*begin, wanted=wanted)
                inner.forces(*begin, self.scratch)
                _, any_near = self._look(*self._fine(history.u, at.end))
            one = self._contact(at, start, u, v) if any_near else None
            if at.stride:
                self.kept[at.end] = one
            _, stale, _ = inner.check(*self._fine(history.u, at.end), 0, 0)
            if not stale:
                break

    def _contact(self, at: Passes, start, u, v) -> ContactPass | None:
        """The stage, with the list as it is: of the pairs that would come near, and of those that do by what it does."""
        one, u_next, flagged = None, u, self._flagged()
        chosen, seen = np.zeros(self.inner.list.count, bool), flagged
        for _ in range(MOST_LISTS):
            more = flagged[self._comes_near(self._pass(flagged, start, u_next, v), at.now)]
            if np.all(chosen[more]):
                break
            chosen[more] = True
            one = self._pass(np.flatnonzero(chosen), start, u, v)
            e, one.b = self._go(one, self._numbers(one, at.now))
            u_next, v_next = u.copy(), v.copy()
            u_next[one.nodes] += e
            v_next[one.nodes] += at.now.decay * one.b
            self.rows.put(at.history.u, at.end, u_next)
            self.rows.put(at.history.v, at.end, v_next)
            self._look(*self._fine(at.history.u, at.end))
            flagged = self._flagged()
            seen = np.union1d(seen, flagged)
        self._mark_done(seen)
        return one

    def _flagged(self) -> np.ndarray:
        """Numbers of the pairs that may come near, as `_look` found them."""
        return np.flatnonzero(whole(self.inner.near)[: self.inner.list.count])

    def _comes_near(self, one: ContactPass, now) -> np.ndarray:
        """Which pairs come nearer than their width from `start` to `u`, by looks so often that none misses a crossing: of
        the state alone, however old the list is."""
        near, of = one.solver.near, self._numbers(one, now)
        begin, motion = near.relative(near.points(of.x)), near.relative(near.points(of.motion))
        looks = 1 + np.minimum(MOST_LOOKS, 2 * np.sqrt((motion**2).sum(-1)).max(1, initial=0) / of.width).astype(int)
        out, left = np.zeros(len(one.pairs), bool), np.arange(len(one.pairs))
        for k in range(int(looks.max(initial=0)) + 1):
            left = left[(looks[left] >= k) & ~out[left]]
            if not left.size:
                break
            y = begin[left] + (k / looks[left])[:, None, None] * motion[left]
            _, r, _ = nearest(y, near.edges[left])
            out[left] = dot(r, r) < of.width[left] ** 2
        return out

    def _mark_done(self, near: np.ndarray) -> None:
        """The stage has looked after these: `check_pass` need not."""
        plane = whole(self.inner.plane)
        plane[near, 3] = 1e30
        if runtime.view(self.inner.plane) is None:
            runtime.fill(self.inner.plane, plane)

    def _pass(self, near: np.ndarray, start, u, v) -> ContactPass:
        inner = self.inner
        corners = runtime.fetch(inner.list.pairs)[: 4 * inner.list.count].reshape(-1, 4)[near]
        edges = near >= inner.list.num_vt
        scale = np.zeros(len(near))
        scale[edges] = whole(inner.list.scale)[near[edges] - inner.list.num_vt]
        points, local = np.unique(corners, return_inverse=True)
        C, nodes = None, points
        if self.matrix is not None:
            C = self.matrix[points]
            nodes = np.unique(C.indices)
            C = C[:, nodes].tocsr()
        free = None if self.free is None else self.free[nodes]
        own = NearPairs(local.reshape(-1, 4), edges, scale, len(points), C, free)
        rest = whole(inner.rest_plane)[near].astype(float), whole(inner.rest_weights)[near].astype(float)
        row = self.row_of[self.label[corners[:, 0]], self.label[corners[:, 2]]]
        place = self.node_place[nodes]
        return ContactPass(PartSolver(own), place, corners, start[place], u, v, [], None, (*rest, row))

    def _numbers(self, one: ContactPass, now, changes=None) -> SimpleNamespace:
        """What parts read; changes: of it, as imaginary parts of the size `TINY`."""
        a, first = self.a, self.inner.first
        nodes = self.a.mesh.surface_vertices[one.nodes]
        numbers, rest, mass = a.values.parameters.astype(float), a.values.rest, a.values.mass
        start, end, h_alpha, D = one.start, one.u[one.nodes], now.alpha, one.rest[0][:, 3]
        if changes is not None:
            numbers, rest, mass = numbers + changes.parameters, rest + changes.rest, mass + changes.mass
            start, end, h_alpha = start + changes.start, end + changes.end, h_alpha + changes.alpha
            D = D + np.einsum("pd,pk,pkd->p", one.rest[0][:, :3], one.rest[1], changes.fine_rest[one.pairs])
        k, W = numbers[first + INDEX.stiffness], numbers[first + INDEX.width]
        half = 0.5 * D / W
        share = np.where(half.real < 1, half, 1)
        inverse = np.where(self.inverse[nodes] > 0, 1 / np.where(mass[nodes] > 0, mass[nodes], 1), 0)
        mu, row = np.zeros(len(one.pairs), numbers.dtype), one.rest[2]
        if self.rough:
            mu[row >= 0] = numbers[first + INDEX.friction + row[row >= 0]]
        speed = numbers[first + INDEX.friction_speed] if self.rough else 1.0
        return SimpleNamespace(
            x=rest[nodes] + start, motion=end - start, inverse=inverse, h=now.h, alpha=h_alpha, stiffness=k / share,
            width=share * W, mu=mu, speed=speed, wall=mass[self.a.mesh.surface_vertices].mean(), rough=self.rough,
            share=share, k=k, W=W, D=D,
        )  # fmt: skip

    @property
    def inverse(self) -> np.ndarray:
        return self.a.inverse_of(self.a.values.mass)

    def _go(self, one: ContactPass, of) -> tuple[np.ndarray, np.ndarray]:
        """(e, b) of the pass, whose parts are noted."""
        solver, e = one.solver, np.zeros_like(of.motion)
        b, begin, share, shortened = e.copy(), 0.0, 1.0, False
        while begin < 1:
            share = min(share, 1 - begin)
            tried = self._try(solver, of, begin, share, e, b)
            if tried is None:
                share, shortened = 0.5 * share, True
                if share < SHORTEST:
                    self._refuse(one, of)
                continue
            part, e, b = tried
            one.parts.append(part)
            begin, share, shortened = begin + share, share if shortened else 2 * share, False
        return e, b

    def _try(self, solver: PartSolver, of, begin, share, e, b):
        """(the part, e, b after it), or None where it is too long."""
        part, near = Part(begin, share, self.damping, e, b), solver.near
        move = near.relative(near.points(share * (of.motion + of.alpha * b)))
        farthest = np.sqrt((move**2).sum(-1).max(1) / of.width**2).max()
        if farthest > LONGEST:
            return None
        X = near.points(of.x + begin * of.motion + e)
        at = solver.look(part, of)
        if self.damping < 1:
            before = near.parted(at.n, X)
            if not np.all((before > 0) & (at.d > HALF * before)):
                if farthest > RESOLVED:
                    return None
                part.c = 1.0
                at = solver.look(part, of)
        part.xi = solver.solve(part, of, at)
        if part.xi is None:
            return None
        e_next, b_next = solver.take(part, of, at)
        end = near.points(of.x + (begin + share) * of.motion + e_next)
        if not self._stays_apart(near, at, X, end):
            return None
        return part, e_next, b_next

    def _stays_apart(self, near: NearPairs, at, X: np.ndarray, end: np.ndarray) -> bool:
        """Whether a plane parts each pair where a part begins and where it ends, and so all the way."""
        room = self.rounding * (1 + np.abs(end).max())
        doubtful = np.flatnonzero(~(near.parted(at.n, X, end) > room))
        if not doubtful.size:
            return True
        some = NearPairs(
            near.corners[doubtful], near.edges[doubtful], near.scale[doubtful], near.num_points, None, None
        )
        best = np.full(doubtful.size, -np.inf)
        for x in (X, end):
            _, r, _ = nearest(some.relative(x), some.edges)
            d = np.sqrt((r * r).sum(1))
            best = np.maximum(best, some.parted(r / np.maximum(d, 1e-300)[:, None], X, end))
        return bool(np.all(best > room))

    def _refuse(self, one: ContactPass, of) -> None:
        near = one.solver.near
        move = near.relative(near.points(of.motion))
        speed = float(np.sqrt((move**2).sum(-1)).max()) / of.h
        corners = one.pairs[int((move**2).sum(-1).max(1).argmax())]
        self.inner.fresh = False
        error = Tunnelling(
            f"contact of width {of.W:.3g} m does not keep surfaces apart near vertices {corners.tolist()}, which meet at "
            f"{speed:.3g} m/s: take substeps of {0.25 * of.h:.3g} s"
        )
        error.stable_dt, error.stiffness = 0.25 * of.h, None
        raise error

    @property
    def rounding(self) -> float:
        return 1e-6 * 2.0**-3 if self.a.precision == "f32" else 1e-15

    # ---- tangent -------------------------------------------------------------------------------------------------------

    def _alone(self, at: Passes, one: ContactPass | None):
        """The record without what the stage did."""
        return nullcontext() if one is None else self.rows.replaced(at.history, at.end, one.u, one.v)

    @contextmanager
    def tangent(self, at: Passes):
        one, run, now = self.kept.get(at.end), at.run, at.now
        before = self.rows.get(run.u, 0) if one else None
        with self._alone(at, one):
            yield
        if one is None:
            return
        tiny, t = 1e-30j, run.tangent
        after, change = self.rows.get(run.u, 0), self.rows.get(run.v, 0)
        rest = runtime.fetch(run.numbers.rest).astype(float) if t.rest is None else np.asarray(t.rest, float)
        parameters = np.asarray(t.parameters, float)
        rate = run.rate_dot
        dots = SimpleNamespace(
            parameters=tiny * parameters[: len(self.a.values.parameters)], rest=tiny * rest, mass=tiny * t.mass,
            start=tiny * before[one.nodes], end=tiny * after[one.nodes], alpha=tiny * rate * now.alpha_by_rate,
            fine_rest=tiny * (rest if self.matrix is None else self.matrix @ rest),
        )  # fmt: skip
        of = self._numbers(one, now, dots)
        e = b = np.zeros_like(of.motion)
        for part in one.parts:
            own = Part(part.begin, part.share, part.c, e, b, part.xi)
            e, b = one.solver.take(own, of, one.solver.look(own, of))
        decay = now.decay + tiny * rate * now.decay_by_rate
        after[one.nodes] += e.imag / 1e-30
        change[one.nodes] += (decay * b).imag / 1e-30
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
        p, q = self.rows.get(run.u, 0), self.rows.get(run.v, 0)
        of = self._numbers(one, now)
        nodes = one.nodes
        adj = SimpleNamespace(
            x=np.zeros_like(of.motion), motion=np.zeros_like(of.motion), inverse=np.zeros(len(nodes)), alpha=0.0,
            stiffness=np.zeros(len(one.pairs)), width=np.zeros(len(one.pairs)), mu=np.zeros(len(one.pairs)),
            speed=0.0, wall=0.0,
        )  # fmt: skip
        e_adj, b_adj = p[nodes], now.decay * q[nodes]
        by_decay = float((q[nodes] * one.b).sum())
        for part in one.parts[::-1]:
            e_adj, b_adj = one.solver.back(part, of, e_adj, b_adj, adj)
        self.by_rate += now.alpha_by_rate * adj.alpha + now.decay_by_rate * by_decay
        by_start = adj.x - adj.motion
        p[nodes] += adj.motion
        self.rows.put(run.u, 0, p)
        self._add(one, of, adj)
        with self._alone(at, one):
            yield
        p = self.rows.get(run.u, 0)
        p[nodes] += by_start
        self.rows.put(run.u, 0, p)

    def _add(self, one: ContactPass, of, adj) -> None:
        """Adjoints of the numbers, of masses and of the rest shape."""
        surface = self.a.mesh.surface_vertices
        nodes = surface[one.nodes]
        self.by_mass[nodes] -= of.inverse**2 * adj.inverse
        self.by_mass[surface] += adj.wall / len(surface)
        self.by_rest[nodes] += adj.x
        # stiffness k / share, width share W, share = min(1, D / (2 W))
        by_share = np.where(of.share < 1, of.W * adj.width - of.k / of.share**2 * adj.stiffness, 0)
        self.by_numbers[INDEX.stiffness] += (adj.stiffness / of.share).sum()
        self.by_numbers[INDEX.width] += (of.share * adj.width - by_share * of.share / of.W).sum()
        by_D = 0.5 * by_share / of.W
        if by_D.any():
            plane, weights = one.rest[:2]
            at_corners = (by_D[:, None] * weights)[:, :, None] * plane[:, None, :3]
            np.add.at(self.by_fine_rest, one.pairs, at_corners)
        if self.rough:
            self.by_numbers[INDEX.friction_speed] += adj.speed
            rows = one.rest[2]
            np.add.at(self.by_numbers, INDEX.friction + rows[rows >= 0], adj.mu[rows >= 0])

    def clear(self) -> None:
        a, own = self.a, self.a.parameters_of_self_contact
        self.by_numbers, self.by_mass, self.by_rate = np.zeros(own.stop - own.start), np.zeros(a.num_vertices), 0.0
        self.by_rest, self.by_fine_rest = np.zeros((a.num_vertices, 3)), np.zeros((self.inner.mesh.num_vertices, 3))

    def collect(self, out: Derived) -> None:
        out.parameters[self.a.parameters_of_self_contact] = self.by_numbers
        by_fine = self.by_fine_rest if self.matrix is None else self.matrix.T @ self.by_fine_rest
        out.rest = self.by_rest + by_fine + out.rest
        out.mass = out.mass + self.by_mass
        drag = self.a.features().drag
        if drag >= 0:
            out.parameters[drag] += self.by_rate
