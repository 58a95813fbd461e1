"""Friction of pairs whose vertices are sums over nodes, x = C X + g, g of corners of obstacles (curved_pairs.py).

In implicit passes all is a potential of the points, and friction on nodes C^T that on points. In explicit ones the pairs see
velocities C v, and impulses j of points change those of nodes by M^-1 C^T j. The bound of friction_kernels.py that no
friction adds energy is then made of the nodes' masses: with G = |C| M^-1 |C|^T, pairs take

    c = h sum_k |w_k| (G S)_k,    S_k = sum |w_k| mu N

over points k in place of h sum (|w_k| / m_k) S_k. That bounds W of |sum_p r_p C^T w_p|^2 / m as there, for
|C^T w| <= |C|^T |w|.
"""

from contextlib import nullcontext

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.lagged_friction import LaggedFriction
from diffsim_ti.mechanics.surfaces.pair_friction import ratio_by_rate
from diffsim_ti.runtime.slots import VertexRows
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE


class CurvedLaggedFriction:
    """As LaggedFriction, of nodes."""

    def __init__(self, pairs):
        self.pairs, self.inner, self.C = pairs, pairs.inner.friction, pairs.matrix

    def begin(self, u: np.ndarray, x: np.ndarray, per_gamma: float) -> None:
        """With obstacles where the pass begins; their corners have x = g - v / per_gamma, g where forces are taken."""
        self.given, there = 0.0, self.C @ x
        if self.pairs.obstacles:
            obstacles, first = self.pairs.obstacles, self.pairs.finer.mesh.first
            self.given = np.zeros_like(there)
            self.given[first:] = obstacles.displacements_at(obstacles.rows)
            there[first:] = self.given[first:] - obstacles.velocities() / per_gamma
        self.inner.begin(self.pairs.spread(u), there, per_gamma)

    def without(self):
        return self.inner.without()

    def bounded(self, which):
        return self.inner.bounded(which)

    def turns(self, u: np.ndarray, there: np.ndarray) -> np.ndarray:
        return self.inner.turns(self._fine(u), self._fine(there))

    def _fine(self, u: np.ndarray) -> np.ndarray:
        return self.C @ u + self.given

    def energies(self, u: np.ndarray) -> np.ndarray:
        return self.inner.energies(self._fine(u))

    def forces(self, u: np.ndarray, only: int | None = None) -> np.ndarray:
        return self.C.T @ self.inner.forces(self._fine(u), only)

    def sizes(self, u: np.ndarray) -> np.ndarray:
        return abs(self.C).T @ self.inner.sizes(self._fine(u))

    def clear_sums(self) -> None:
        """The finer surface has them."""

    def blocks(self, u: np.ndarray) -> np.ndarray:
        """Those of points by squares of what nodes have of them."""
        of_points = self.inner.blocks(self._fine(u))
        return (self.C.power(2).T @ of_points.reshape(-1, 9)).reshape(-1, 3, 3)

    def jvp(self, u, du, dx, du_begin, numbers, poses_dot=None, only: int | None = None) -> np.ndarray:
        """poses_dot: changes of the rows of poses, None: zero."""
        C, obstacles = self.C, self.pairs.obstacles
        changes = [C @ du, C @ dx, C @ du_begin]
        if obstacles:
            given = obstacles.changes(self.pairs.parameters_of(numbers), poses_dot)
            for change, corners in zip(changes, (given[0], given[0] - given[2] / self.inner.per_gamma, given[1])):
                change[self.pairs.finer.mesh.first :] = corners
        return C.T @ self.inner.jvp(self._fine(u), *changes, self.pairs.fine_numbers(numbers), only)

    def vjp(self, u: np.ndarray, forces_adj: np.ndarray, only: int | None = None) -> tuple[np.ndarray, ...]:
        found, obstacles = self.inner.vjp(self._fine(u), self.C @ forces_adj, only), self.pairs.obstacles
        if obstacles:
            by_u, by_x, by_begin = (by[self.pairs.finer.mesh.first :] for by in found)
            obstacles.add_places(by_u + by_x, AT_STAGE)
            obstacles.add_places(by_begin, AT_BEGIN)
            obstacles.add_velocities(-by_x / self.inner.per_gamma)
        return tuple(self.C.T @ by for by in found)


class CurvedFriction:
    """As PairFriction, of nodes, which are worked on in float64 on the host."""

    takes_pending = False

    def __init__(self, pairs):
        self.pairs, self.a, self.inner = pairs, pairs.a, pairs.inner.friction
        a, surface, points = pairs.a, pairs.a.mesh.surface_vertices, pairs.finer.mesh.surface_vertices
        self.rows, self.points = VertexRows(a, surface), points
        self.C = pairs.matrix[points][:, surface].tocsr()
        self.size = abs(self.C)
        self.free = a.supports.freedom(a.num_vertices)[surface]
        n = pairs.finer.num_vertices
        self.v, self.dv, self.unread = (runtime.array(a.vector, 1, n) for _ in range(3))
        self.unit, self.no_mass = runtime.array(a.fp, n), runtime.array(a.fp, n)
        self.no_state = runtime.array(a.vector, 1, len(points))
        for array in (self.unread, self.no_mass, self.no_state):
            runtime.fill(array, 0)
        self.kept: dict[int, tuple | None] = {}  # of recorded passes, by slots: u and v before the stage, what v gained
        self._mass, self.obstacles, self.v_dot = None, pairs.obstacles, 0.0

    # ---- what points feel of the nodes' masses -----------------------------------------------------------------------

    def _weigh(self) -> None:
        """Take the masses that the scene has loaded."""
        if self._mass is self.a.values.mass:
            return
        self._mass = self.a.values.mass
        self.inverse = self.a.inverse_of(self._mass)[self.rows.nodes, None]
        self.lightness = float(self.inverse.mean()) or 1.0  # of all points, as kernels have it
        runtime.fill(self.unit, self.lightness)

    def _spread(self, load: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """|C| inverse |C|^T load, as kernels have it."""
        return self.size @ (inverse[:, 0] * (self.size.T @ load)) / self.lightness

    def _where_friction_acts(self, of_points) -> np.ndarray:
        """Numbers of points, of which others are left over from earlier passes."""
        return np.where(runtime.fetch(self.inner.own.in_friction) > 0, runtime.fetch(of_points).astype(np.float64), 0.0)

    def freed(self, x: np.ndarray) -> np.ndarray:
        """What nodes may do of vectors."""
        return np.einsum("nij,nj->ni", self.free, x)

    def _at_points(self, of_nodes: np.ndarray, of_corners=0.0) -> np.ndarray:
        """Of all vertices of the finer surface, from vectors of the surface's nodes, and of corners of obstacles."""
        out = np.zeros((1, self.pairs.finer.num_vertices, 3))
        out[0, self.points] = self.C @ of_nodes
        if self.obstacles:
            out[0, self.pairs.finer.mesh.first :] = of_corners
        return out

    def _velocities(self, v: np.ndarray) -> np.ndarray:
        """Of all vertices of the finer surface."""
        return self._at_points(v, self.obstacles.velocities() if self.obstacles else 0.0)

    def _of_points(self, array) -> np.ndarray:
        """Sums for the surface's nodes, from vectors of all vertices of the finer surface."""
        return self.C.T @ runtime.fetch_row(array, 0)[self.points]

    # ---- passes ------------------------------------------------------------------------------------------------------

    def keep(self, num_slots: int) -> None:
        """Room for recorded passes is made as they come."""

    def measure(self, u, slot: int) -> None:
        """As there, after `pairs.forces` at u[slot]."""
        self._weigh()
        own = self.inner.own
        self.inner.measure(self.pairs.fine(u, slot), 0)
        self.in_friction = bool(runtime.fetch(own.any)[0])
        if self.in_friction:
            self.load = self._where_friction_acts(own.load)
            runtime.fill(own.load, self._spread(self.load, self.inverse))

    def _state(self) -> dict:
        return dict(u=self.unread, v=self.v, inverse_mass=self.unit, kept_u=self.no_state, kept_v=self.no_state)

    def slide(self, history, slot: int, plan, recording: bool) -> None:
        if recording:
            self.kept[slot] = None
        if not (plan.alpha > 0 and self.in_friction):
            return
        u, v = self.rows.get(history.u, slot), self.rows.get(history.v, slot)
        before = self._velocities(v)
        runtime.fill(self.v, before)
        self.inner.run(self.inner.kernels.slide, self._state(), slot=0, keep=-1, **self.inner.pass_numbers(plan))
        gained = self.inverse * self.freed(self._impulses(self.v, before))
        if recording:
            self.kept[slot] = u, v, gained
        self.rows.put(history.v, slot, v + gained)
        self.rows.put(history.u, slot, u + plan.alpha / plan.decay * gained)

    def _impulses(self, changed, before: np.ndarray) -> np.ndarray:
        """On nodes, from what kernels have added to vectors of points."""
        return self.C.T @ (runtime.fetch_row(changed, 0) - before[0])[self.points] / self.lightness

    def alone(self, history, slot: int):
        """A recorded pass to a slot without friction; then the record is what it was."""
        kept = self.kept.get(slot)
        return nullcontext() if kept is None else self.rows.replaced(history, slot, *kept[:2])

    def _begin(self, history, slot: int) -> None:
        """Measure again where a recorded pass began."""
        self.pairs.ensure(history.u, slot)
        self.pairs.forces(history.u, slot, self.a.corner)
        self.measure(history.u, slot)

    # ---- tangent -----------------------------------------------------------------------------------------------------

    def begin_jvp(self, history, slot: int, u_dot, numbers, poses_dot=None) -> None:
        self._begin(history, slot)
        if not self.in_friction:
            return
        own, moved = self.inner.own, self.pairs.fine_numbers(numbers)
        given = "unmoved"
        if self.obstacles:
            parameters_dot, given = self.pairs.parameters_of(numbers), "given_dot"
            self.obstacles.change(parameters_dot, poses_dot)
            self.v_dot = self.obstacles.changes(parameters_dot, poses_dot)[2]
        self.inner.changes(self.pairs.fine(history.u, slot), 0, self.pairs.fine_change(u_dot, given), moved)
        change = self._where_friction_acts(own.load_dot)
        self.inverse_dot = -(self.inverse**2) * runtime.fetch(numbers.mass).astype(np.float64)[self.rows.nodes, None]
        spread = self._spread(change, self.inverse) + self._spread(self.load, self.inverse_dot)
        runtime.fill(own.load_dot, spread)

    def slide_jvp(self, history, slot: int, plan, rate_dot: float, u_dot, v_dot, numbers) -> None:
        kept = self.kept.get(slot)
        if kept is None:
            return
        dv = self.rows.get(v_dot, 0)
        before = self._at_points(dv, self.v_dot)
        runtime.fill(self.v, self._velocities(kept[1]))
        runtime.fill(self.dv, before)
        at = dict(du=self.unread, dv=self.dv, mass_dot=self.no_mass, parameters_dot=numbers.parameters)
        of_pass = self.inner.pass_numbers(plan)
        self.inner.run(self.inner.kernels.slide_jvp, self._state() | at, slot=0, keep=0, ratio_dot=0.0, **of_pass)
        pushed, gained = self.freed(self._impulses(self.dv, before)), kept[2]
        # what was gained is inverse * pushes
        per_inverse = np.divide(gained, self.inverse, out=np.zeros_like(gained), where=self.inverse > 0)
        change = self.inverse * pushed + self.inverse_dot * per_inverse
        self.rows.put(v_dot, 0, dv + change)
        du = self.rows.get(u_dot, 0)
        self.rows.put(u_dot, 0, du + of_pass["ratio"] * change + rate_dot * ratio_by_rate(plan) * gained)

    # ---- adjoint -----------------------------------------------------------------------------------------------------

    def clear_sums(self) -> None:
        n = len(self.rows.nodes)
        self.by_mass, self.by_rate, self.by_place = np.zeros((n, 1)), 0.0, np.zeros((n, 3))

    def slide_vjp(self, history, slot: int, plan, adjoint) -> None:
        """As there; the adjoints are complete."""
        self.by_place, kept, inner = np.zeros_like(self.by_place), self.kept.get(slot + 1), self.inner
        if kept is None:
            return
        self._begin(history, slot)
        own, of_pass, gained = inner.own, inner.pass_numbers(plan), kept[2]
        p, q = self.rows.get(adjoint.u, 0), self.rows.get(adjoint.v, 0)
        by_gained = q + of_pass["ratio"] * p
        self.by_rate += ratio_by_rate(plan) * float((p * gained).sum())
        self.by_mass -= self.inverse * (by_gained * gained).sum(1, keepdims=True)
        inner.take("weights_adj", "pressing_adj")
        inner.take("mu_adj", scalar=True)
        runtime.fill(own.pulled, self.C @ (self.inverse * self.freed(by_gained)))
        runtime.fill(self.v, self._velocities(kept[1]))
        runtime.fill(self.dv, 0)
        at = self._state() | inner.adjoints | dict(v_adj=self.dv)
        inner.run(inner.kernels.pairs_vjp, at, slot=0, keep=0, **of_pass)
        self.rows.put(adjoint.v, 0, q + self._of_points(self.dv))
        if self.obstacles:
            self.obstacles.add_velocities(runtime.fetch_row(self.dv, 0)[self.pairs.finer.mesh.first :])
        by_load = self._where_friction_acts(own.load_adj)
        by_inverse = (self.size.T @ by_load) * (self.size.T @ self.load) / self.lightness
        self.by_mass[:, 0] -= self.inverse[:, 0] ** 2 * by_inverse
        runtime.fill(own.load_adj, self._spread(by_load, self.inverse))
        at = dict(place=self.pairs.fine(history.u, slot), **{k: inner.adjoints[k] for k in ("by_place", "by_mu")})
        inner.run(inner.kernels.measure_vjp, at, slot=0, begin=0, num_rows=inner.num_rows)
        by_place = runtime.fetch(inner.adjoints["by_place"]).astype(np.float64)
        self.by_place = self.C.T @ by_place
        if self.obstacles:
            self.obstacles.add_places(by_place[len(self.pairs.finer.mesh.body.surface_vertices) :])

    def add_place(self, adjoint) -> None:
        self.rows.put(adjoint.u, 0, self.rows.get(adjoint.u, 0) + self.by_place)

    def collect_pass(self) -> tuple[np.ndarray, float]:
        mass = np.zeros(self.a.num_vertices)
        mass[self.rows.nodes] = self.by_mass[:, 0]
        return mass, self.by_rate


def friction_of(pairs):
    """Of CurvedPairs whose pairs have friction; else None."""
    if pairs.inner.friction is None:
        return None
    kind = CurvedLaggedFriction if isinstance(pairs.inner.friction, LaggedFriction) else CurvedFriction
    return kind(pairs)
