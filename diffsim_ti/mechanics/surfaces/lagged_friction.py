"""Friction between surfaces in implicit passes: a force with a potential, from what presses where the pass begins."""

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import Parts, put, whole
from diffsim_ti.mechanics.surfaces.friction_kernels import FrictionKernels
from diffsim_ti.mechanics.surfaces.friction_product import FrictionProduct
from diffsim_ti.runtime import kernels_of
from diffsim_ti.terms.obstacles.friction import ARRAYS, slip
from diffsim_ti.terms.self_contact import SelfContact

TINY = 1e-300


class LaggedFriction:
    """Of the pairs that press with N at the first displacement of a pass, with the weights w and the normal n there.

    A pair slides with t = (I - n n^T) sum_i w_i v_i, v = (u - x) / gamma, and on its corners act
    -w_i mu N f(|t| / eps) t / |t| (terms/obstacles/friction.py). Displacements, directions and
    results are NumPy arrays, shape (num_vertices, 3).
    """

    def __init__(self, pairs):
        self.pairs, a = pairs, pairs.a
        self.a, self.num_surface = a, len(a.mesh.surface_vertices)
        labels, rows = np.zeros(self.num_surface, int), np.full((1, 1), -1)
        if pairs.term and pairs.term.has_friction:
            labels, rows = pairs.term.labels(a.mesh)
        self.num_rows, row_of = int(rows.max()) + 1, rows.ravel()
        if pairs.contacts:
            self.num_rows, row_of = len(pairs.contacts.mu), np.concatenate([row_of, pairs.contacts.row_of])
        self.kernels = kernels_of(FrictionKernels, a.precision, pairs.first, pairs.parallel, len(rows))
        self.own = SimpleNamespace(label=runtime.upload(labels, ti.i32), row_of=runtime.upload(row_of, ti.i32))
        self.adjoints = None
        self.corners, self.w, self.n = np.zeros((0, 4), int), np.zeros((0, 4)), np.zeros((0, 3))
        self.L, self.x, self.per_gamma = np.zeros(0), np.zeros((self.a.num_vertices, 3)), 1.0
        self.by_speed, self.u_begin = np.zeros(len(self.speeds_at)), None
        self.contact = np.zeros(0, int)  # its number of each pair
        self._product, self._at = FrictionProduct(pairs), None  # where forces were last found

    def take(self, *names: str, scalar: bool = False) -> None:
        """Arrays of all pairs of the list, by name."""
        for name in names:
            dtype = self.a.fp if scalar else self.pairs.kernels.vec4
            setattr(self.own, name, self.pairs.list.buffers.take(f"{name} of friction", dtype, self.pairs.list.count))

    def begin(self, u: np.ndarray, x: np.ndarray, per_gamma: float, presses: bool) -> None:
        """A pass from u, where `pairs.begin` has been; x, 1 / gamma: as above; presses: whether anything does there."""
        self.u_begin, self.per_gamma = u, per_gamma
        self._measure_here()
        pressing, count = whole(self.own.pressing), self.pairs.list.count
        self.pressed = pressed = np.flatnonzero(presses & (pressing[:count, 3] > 0))
        self.corners = runtime.fetch(self.pairs.list.pairs)[: 4 * count].reshape(-1, 4)[pressed]
        self.w, pressing = whole(self.own.weights)[pressed].astype(np.float64), pressing[pressed].astype(np.float64)
        self.n, self.L = pressing[:, :3], pressing[:, 3]
        surface = self.pairs.kinematic
        self.contact = surface.numbers[self.corners[:, [0, 2]]].max(1) if surface else np.zeros(len(pressed), int)
        self._product.begin(self.corners, self.w, pressing, self.speed, per_gamma)
        self.pairs.make_room()
        self.lag(x)

    def lag(self, x: np.ndarray) -> None:
        """Velocities are measured from x."""
        self.x = x
        runtime.fill(self._product.of.origin, x)

    @property
    def count(self) -> int:
        """Of pairs that press."""
        return len(self.corners)

    def settle(self) -> None:
        """No friction is turned round."""
        runtime.fill(self._product.of.turned, 0)

    @contextmanager
    def without(self):
        """As if nothing pressed."""
        try:
            self._press(0 * self.L)
            yield
        finally:
            self._press(self.L)

    def _press(self, load: np.ndarray) -> None:
        """With other mu N, where forces were last found."""
        put(self._product.of.pressing, np.column_stack([self.n, load]))
        if self._at is not None:
            self.pairs.launch(self.pairs.placing(self._at))

    def _measure_here(self) -> None:
        pairs = self.pairs
        pairs.forces(pairs.next, 0, self.a.corner)
        if pairs.list.count:
            pairs.run(self.kernels.measure, dict(u=pairs.next), self.own, slot=0)

    @property
    def speed(self) -> np.ndarray:
        """The friction speed [m/s] of each pair."""
        return self.a.values.parameters[self.speeds_at][self.contact]

    def _sliding(self, u: np.ndarray) -> tuple:
        """(velocities of the corners, their difference across the gap, t, |t|, t / |t|, f / |t|, df / d|t|)"""
        v, eps = (self.per_gamma * (u - self.x))[self.corners], self.speed
        relative = np.einsum("pk,pkd->pd", self.w, v)
        t = self._across(relative)
        s = np.linalg.norm(t, axis=1)
        kappa, _, _, slope = slip(s, 0, eps, ARRAYS)
        return v, relative, t, s, t / np.maximum(s, TINY)[:, None], kappa, slope

    def _across(self, x: np.ndarray) -> np.ndarray:
        return x - self.n * _dot(self.n, x)

    def _scatter(self, at_corners: np.ndarray, only: int | None = None) -> np.ndarray:
        out, own = np.zeros((self.a.num_vertices, *at_corners.shape[2:])), self._of(only)
        np.add.at(out, self.corners[own], at_corners[own])
        return out

    def _of(self, only: int | None) -> slice | np.ndarray:
        """Pairs of a contact, or all."""
        return slice(None) if only is None else self.contact == only

    def _pulls(self, u: np.ndarray) -> np.ndarray:
        _, _, t, _, _, kappa, _ = self._sliding(u)
        return (-self.L * kappa)[:, None] * t

    def forces(self, u: np.ndarray, only: int | None = None) -> np.ndarray:
        """[N]; only: of the pairs of one contact."""
        return self._scatter(self.w[:, :, None] * self._pulls(u)[:, None], only)

    # ---- in kernels (friction_product.py), as of ImplicitPairs -------------------------------------------------------

    def measuring(self, u) -> Parts:
        self._at = u
        own = self._product
        return own.part(own.kernels.measure, u=u, out=self.a.corner, energy=self.pairs.energy)

    def turning(self, u, w) -> Parts:
        return self._product.part(self._product.kernels.compare, u=u, w=w)

    def multiplying(self, w) -> Parts:
        return self._product.part(self._product.kernels.products, w=w, out=self.a.corner)

    def stiffness(self) -> np.ndarray:
        """Of each pair between its corners, where `measuring` has been, shape (count, 4, 4, 3, 3) [N/m]."""
        S = whole(self._product.of.stiffness)[: 3 * self.count].reshape(-1, 3, 4)[..., :3]
        return np.einsum("pa,pb,pij->pabij", self.w, self.w, S)

    def adding_blocks(self, out) -> Parts:
        return self._product.part(self._product.kernels.blocks, out=out)

    # ---- derivatives -------------------------------------------------------------------------------------------------

    def _back_to_begin(self) -> None:
        """The list of pairs, and what presses, where the pass begins; `potential.place` leads away again."""
        self.pairs.begin(self.u_begin)
        self._measure_here()

    def _change_here(self, numbers) -> None:
        """Changes of what presses, for those of where the pass begins, pairs.step, and `numbers`."""
        self.take("weights_dot", "pressing_dot")
        at = dict(u=self.pairs.next, w=self.pairs.step, rest_dot=numbers.rest, parameters_dot=numbers.parameters)
        if self.pairs.contacts:
            parameters = runtime.fetch(numbers.parameters)[: len(self.a.values.parameters)].astype(np.float64)
            self.pairs.contacts.load_change(self.a.values.parameters, parameters)
            at |= dict(numbers_dot=self.pairs.contacts.numbers_dot)
        self.pairs.run(self.kernels.measure_jvp, at, self.own, slot=0)

    def jvp(self, u: np.ndarray, du, dx, du_begin, numbers, poses_dot=None, only: int | None = None) -> np.ndarray:
        """Change of the forces for those of u, of x, of where the pass begins, and of `numbers`, a Tangent."""
        self._back_to_begin()
        runtime.fill(self.pairs.step, du_begin[None])
        self._change_here(numbers)
        d_pressing = whole(self.own.pressing_dot)[self.pressed].astype(np.float64)
        dw, dn, dL = whole(self.own.weights_dot)[self.pressed].astype(np.float64), d_pressing[:, :3], d_pressing[:, 3]
        d_speed = runtime.fetch(numbers.parameters)[self.speeds_at][self.contact]
        v, relative, t, s, e, kappa, slope = self._sliding(u)
        dv = (self.per_gamma * (du - dx))[self.corners]
        d_relative = np.einsum("pk,pkd->pd", self.w, dv) + np.einsum("pk,pkd->pd", dw, v)
        dt = self._across(d_relative) - dn * _dot(self.n, relative) - self.n * _dot(dn, relative)
        ds = _dot(e, dt)[:, 0]
        df = slope * (ds - s / self.speed * d_speed)
        r, dr = (-self.L * kappa)[:, None] * t, (-dL * kappa)[:, None] * t
        dr -= self.L[:, None] * ((df - kappa * ds)[:, None] * e + kappa[:, None] * dt)
        return self._scatter(self.w[:, :, None] * dr[:, None] + dw[:, :, None] * r[:, None], only)

    def vjp(self, u: np.ndarray, forces_adj: np.ndarray, only: int | None = None) -> tuple[np.ndarray, ...]:
        """Adjoints of u, of x, of where the pass begins; adds those of the numbers and of the rest shape."""
        v, relative, t, s, e, kappa, slope = self._sliding(u)
        g = np.zeros((*self.corners.shape, 3))
        g[self._of(only)] = forces_adj[self.corners[self._of(only)]]
        r, r_adj = (-self.L * kappa)[:, None] * t, np.einsum("pk,pkd->pd", self.w, g)
        by_f = -self.L * _dot(e, r_adj)[:, 0]
        t_adj = (-self.L * kappa)[:, None] * r_adj + (by_f * (slope - kappa))[:, None] * e
        np.add.at(self.by_speed, self.contact, -by_f * slope * s / self.speed)
        relative_adj = self._across(t_adj)
        n_adj = -t_adj * _dot(self.n, relative) - relative * _dot(self.n, t_adj)
        w_adj = np.einsum("pkd,pd->pk", g, r) + np.einsum("pkd,pd->pk", v, relative_adj)
        by_u = self._scatter(self.per_gamma * self.w[:, :, None] * relative_adj[:, None])
        self._back_to_begin()
        pressing_adj = np.concatenate([n_adj, -kappa[:, None] * _dot(t, r_adj)], 1)
        by_begin = np.zeros_like(by_u)
        by_begin[self.a.mesh.surface_vertices] = self._pull_back(w_adj, pressing_adj)
        return by_u, -by_u, by_begin

    def _pull_back(self, w_adj: np.ndarray, pressing_adj: np.ndarray) -> np.ndarray:
        """Adjoint of where the pass begins at surface vertices for those of the weights and of (n, mu N) of the pairs that
        press; adds those of the numbers and of the rest shape."""
        self.take("weights_adj", "pressing_adj")
        self.take("mu_adj", scalar=True)
        for array, data in ((self.own.weights_adj, w_adj), (self.own.pressing_adj, pressing_adj)):
            every = np.zeros((array.shape[0], 4))
            every[self.pressed] = data
            runtime.fill(array, every)
        at = dict(u=self.pairs.next, **self.adjoints)
        self.pairs.run(self.kernels.measure_vjp, at, self.own, slot=0, num_rows=self.num_rows)
        return runtime.fetch(self.adjoints["by_place"])

    def clear_sums(self) -> None:
        """Begin a reverse sweep."""
        if self.adjoints is None:
            n, a = self.num_surface, self.a
            self.adjoints = dict(by_mu=runtime.array(a.fp, n * self.num_rows), by_place=runtime.array(a.vector, n))
        runtime.fill(self.adjoints["by_mu"], 0)
        self.by_speed[:] = 0

    @property
    def speeds_at(self) -> np.ndarray:
        """Where the friction speed of each contact stands among the parameters."""
        if self.pairs.contacts:
            return self.pairs.contacts.rows[:, 2]
        return np.array([self.pairs.first + SelfContact.index.friction_speed])

    def collect(self, out: np.ndarray) -> None:
        """Adds the adjoints of friction speeds and coefficients to those of all parameters, float64."""
        by_mu = whole(self.adjoints["by_mu"]).astype(np.float64)[: self.num_surface * self.num_rows]
        contacts, first = self.pairs.contacts, self.pairs.first + SelfContact.index.friction
        out[contacts.mu if contacts else slice(first, first + self.num_rows)] += by_mu.reshape(-1, self.num_rows).sum(0)
        np.add.at(out, self.speeds_at, self.by_speed)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Shape (k, 1)."""
    return (a * b).sum(1, keepdims=True)
