"""Tetrahedra whose change of volume is averaged over patches, so that they do not lock as nu approaches 0.5.

    E = sum_e V_e psi(F_e; lam = 0) + sum_p W_p lam_p / 2 theta_p^2
    W_p = sum_e V_e,  lam_p = sum_e V_e lam_e / W_p,  theta_p = sum_e V_e theta_e / W_p     over the points e of patch p

A patch of linear tetrahedra is a block of eight (mesh/patches.py; rows left over have no volume), so that sums over a patch
are sums over lanes. A tetrahedron of ten nodes is a patch by itself: the sums go over its points.
Its pressure pi = lam_p theta_p takes the place of lam theta at each of its points: forces are those of an energy.
Nagtegaal, Parks, Rice 1974, doi:10.1016/0045-7825(74)90032-2 (mean dilatation); de Souza Neto, Andrade Pires, Owen 2005,
F-bar-based linear triangles and tetrahedra for finite strain analysis of nearly incompressible solids, doi:10.1002/nme.1187.
"""

from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti.materials.calculus.tensor import inner, sum_of
from diffsim_ti.materials.patch_law import PatchLaw
from diffsim_ti.mechanics.stress.tetrahedron import Tetrahedron
from diffsim_ti.runtime import LANES, A, Bundle, let, traced
from diffsim_ti.runtime import at as entry
from diffsim_ti.state.features import Features

MOST = 6  # numbers of an item that its patch sums up


@dataclass(frozen=True)
class ElementKernels:
    """What kernels of elements are compiled for. parallel: loops run on all threads; lanes: items are blocks."""

    law: object
    features: Features
    parallel: bool
    lanes: bool

    @cached_property
    def element(self) -> Tetrahedron:
        return functions_of(self.law, self.features, self.lanes)


class PatchCoupling:
    """sum_p c_p g_p (x) g_p, what patches add to d2E/du2 beyond their tetrahedra at fixed pressure.

    g_p: the change of W_p theta_p for displacements of the patch's vertices [m^2], c_p = lam_p / W_p [Pa/m^3]
    (above). A row for each pair of a patch and one of its vertices.
    """

    def __init__(self, arrays):
        self._place, self._n = arrays.place, arrays.num_vertices
        values, factors, elements = arrays.values, arrays.law.base.last_without_lam, arrays.mesh.elements
        self._nodes = elements.shape[1]
        pairs, row_of = np.unique(arrays.patches[:, None] * self._n + elements, return_inverse=True)
        self._row_of, self.patches, self.vertices = row_of.ravel(), pairs // self._n, pairs % self._n
        p = np.broadcast_to(values.coefficients, (len(elements), values.coefficients.shape[-1]))
        lam = p[:, -1] - sum(f * p[:, k] for k, f in enumerate(factors))
        own = values.volumes if arrays.points == 1 else values.volumes.sum(1)
        volumes = np.bincount(arrays.patches, own)
        self.c = np.bincount(arrays.patches, lam * own) / volumes**2

    def rows(self, corner: np.ndarray) -> np.ndarray:
        """g by rows, shape (num_rows, 3), from the corner forces of unit pressures."""
        at_corners = corner.reshape(-1, self._nodes, 3)[self._place].reshape(-1, 3)
        return np.stack([np.bincount(self._row_of, at_corners[:, d], len(self.vertices)) for d in range(3)], 1)

    def diagonal(self, g: np.ndarray) -> np.ndarray:
        """Its 3x3 diagonal blocks [N/m], shape (num_vertices, 3, 3)."""
        blocks = (self.c[self.patches, None, None] * g[:, :, None] * g[:, None, :]).reshape(-1, 9)
        return np.stack([np.bincount(self.vertices, blocks[:, k], self._n) for k in range(9)], 1).reshape(-1, 3, 3)

    def entries(self, g: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(row vertex, column vertex, block [N/m] of shape (count, 3, 3)) of all its blocks; some meet."""
        sizes = np.bincount(self.patches)
        first = np.cumsum(sizes) - sizes
        count = sizes[self.patches]  # of the partners of each row
        i = np.repeat(np.arange(len(self.patches)), count)
        j = np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + first[self.patches[i]]
        blocks = self.c[self.patches[i], None, None] * g[i][:, :, None] * g[j][:, None, :]
        return self.vertices[i], self.vertices[j], blocks


def functions_of(law, features, lanes: bool) -> Tetrahedron:
    """The element of a law and a scene's features; patches for a PatchLaw."""
    kind = PatchedTetrahedron if isinstance(law, PatchLaw) else Tetrahedron
    growth = (features.growth_per_step, features.growth_uniform) if features.growing else None
    return kind(law, features.uniform, lanes, features.order, growth, features.by_points)


@dataclass(frozen=True)
class PatchedTetrahedron(Tetrahedron):
    """The functions of `Tetrahedron`, with the same meaning. In all of them q = [*p', *z, pi] (patch_law.py)."""

    @property
    def is_short(self) -> bool:
        return self.law.base.short

    # ---- what a patch knows -----------------------------------------------------------------------------------------

    @traced
    def _own(self, item, job) -> list[SimpleNamespace]:
        """What an item knows by itself at each of its points; `numbers` are what its patch sums up."""
        scene, base = job.scene, self.law.base
        p, lam = self.law.split(self.coefficients_of(item, scene.coefficients))
        D = self.edges(item, scene, job.at.u, job.s)
        W = D if job.w is None else self.edges(item, scene, job.w, 0)
        if job.dots is not None:
            dp, dlam = self.law.split(self.coefficients_of(item, job.dots.coefficients))
        out = []
        for q in self.points:
            t = SimpleNamespace(p=p, lam=lam, D=D[q], W=W[q])
            t.B, t.V = self.gradients_of(item, scene.gradients, q), self.volume_of(item, scene.volumes, q)
            t.H = t.D @ t.B
            t.theta = base.dilatation(t.H)
            t.numbers = [t.V, let(t.V * t.lam), let(t.V * t.theta)]
            out.append(t)
            if job.w is None:
                continue
            t.gradient, t.dH = base.dilatation_gradient(t.H), t.W @ t.B
            if job.dots is None:
                t.dtheta = inner(t.gradient, t.dH)
                t.numbers.append(let(t.V * t.dtheta))
                continue
            t.dB = self.gradients_of(item, job.dots.gradients, q)
            t.dV, t.dp = self.volume_of(item, job.dots.volumes, q), dp
            t.dH = t.dH + t.D @ t.dB
            t.dtheta = inner(t.gradient, t.dH)
            t.numbers += [t.dV, let(t.dV * t.lam + t.V * dlam), let(t.dV * t.theta + t.V * t.dtheta)]
        return out

    @traced
    def _row(self, item, job):
        (t,) = self._own(item, job)
        return ti.types.vector(MOST, self.fp)(*t.numbers, *[ti.cast(0, self.fp)] * (MOST - len(t.numbers)))

    @ti.func
    def _sum_one_by_one(self, item, job: A):
        total = ti.types.vector(MOST, self.fp)(0)
        first = item // LANES * LANES
        for lane in range(LANES):
            total += self._row(first + lane, job)
        return total

    @traced
    def _sums(self, item, job, known) -> list:
        """What the points of the item's patch sum up."""
        if self.order == 2:
            return [let(sum_of(numbers)) for numbers in zip(*(t.numbers for t in known))]
        (t,) = known
        if self.lanes:
            return [self.items.broadcast(let(sum_of(entry(x, lane) for lane in range(LANES)))) for x in t.numbers]
        total = let(self._sum_one_by_one(item, job))
        return [let(entry(total, k)) for k in range(len(t.numbers))]

    @traced
    def _patch_of(self, item, scene, at, s, w=None, dots=None) -> list[SimpleNamespace]:
        """What an item knows at its points, with its patch's lam_p, theta_p, pi and, for changes w of u, their changes."""
        job = Bundle(scene=scene, at=at, s=s, w=w, dots=dots)
        known, of_patch = self._own(item, job), {}
        volume, stiff, swollen, *changes = self._sums(item, job, known)
        lam_p, theta_p = of_patch["lam_p"], of_patch["theta_p"] = let(stiff / volume), let(swollen / volume)
        pressure = let(lam_p * theta_p)
        if len(changes) == 1:
            of_patch["dtheta_p"] = let(changes[0] / volume)
            of_patch["dpi"] = let(lam_p * of_patch["dtheta_p"])
        elif changes:
            dvolume, dstiff, dswollen = changes
            dlam_p, dtheta_p = (dstiff - lam_p * dvolume) / volume, (dswollen - theta_p * dvolume) / volume
            of_patch["dpi"] = let(dlam_p * theta_p + lam_p * dtheta_p)
        return [SimpleNamespace(**vars(t), **of_patch, pressure=pressure) for t in known]

    @traced
    def _numbers_in(self, t, item, at, s, q) -> list:
        """What the law takes at point q of a patch, of which t is a point."""
        return [*t.p, *self.state_of(item, at.z, s, q), t.pressure] if self.has_state else [*t.p, t.pressure]

    @traced
    def each_seen(self, item, scene, at, s, body) -> None:
        known = self._patch_of(item, scene, at, s)

        def see(q, H):
            return body(q, H, self._numbers_in(known[0], item, at, s, q)) or ((), ())

        self.each_point([[t.H for t in known]], see, tensors=0)

    # ---- forces and their derivatives -------------------------------------------------------------------------------

    @traced
    def forces(self, item, scene, at, s, corner) -> None:
        known = self._patch_of(item, scene, at, s)

        def push(q, H, B):
            P = self.law.stress(H, self._numbers_in(known[0], item, at, s, q))
            return [(P * self.volume_of(item, scene.volumes, q)) @ B.transpose()], ()

        self.store(item, corner, self.each_point([[t.H for t in known], [t.B for t in known]], push)[0][0])

    @traced
    def pressure_forces(self, item, scene, at, s, corner) -> None:
        """Corner forces of a unit pressure: the derivatives of -W_p theta_p by the displacement of the corners."""
        known = self._own(item, Bundle(scene=scene, at=at, s=s, w=None, dots=None))
        dilatation = self.law.base.dilatation_gradient
        self.store(item, corner, [(dilatation(t.H) * t.V) @ t.B.transpose() for t in known])

    @traced
    def stiffness(self, item, scene, at, s, corner) -> None:
        known = self._patch_of(item, scene, at, s, at.w)

        def push(q, H, dH, gradient, B):
            numbers = self._numbers_in(known[0], item, at, s, q)
            dP = self.law.stress_differential(H, dH, numbers) + gradient * known[0].dpi
            return [(dP * self.volume_of(item, scene.volumes, q)) @ B.transpose()], ()

        lists = [[getattr(t, name) for t in known] for name in ("H", "dH", "gradient", "B")]
        self.store(item, corner, self.each_point(lists, push)[0][0])

    @traced
    def forces_jvp(self, item, scene, at, s, change, corner, dots) -> None:
        known = self._patch_of(item, scene, at, s, change.u, dots)

        def push(q, H, dH, B, dB):
            numbers = self._numbers_in(known[0], item, at, s, q)
            dz = self.state_of(item, change.z, 0, q) if self.has_state else []
            P, dP = self.law.stress_and_jvp_at([H], [dH], numbers, [*known[0].dp, *dz, known[0].dpi])
            volume = self.volume_of(item, scene.volumes, q)
            turned = B * self.volume_of(item, dots.volumes, q) + dB * volume
            return [(dP * volume) @ B.transpose() + P @ turned.transpose()], ()

        lists = [[getattr(t, name) for t in known] for name in ("H", "dH", "B", "dB")]
        self.store(item, corner, self.each_point(lists, push)[0][0])

    @traced
    def forces_vjp(self, item, scene, at, s, w, corner, adjoint, shape: bool, add: bool = False) -> None:
        """The work of a patch's pressure on w is -W_p lam_p theta_p dtheta_p, with dtheta_p the change of theta_p for w."""
        known = self._patch_of(item, scene, at, s, w)
        patch = known[0]

        def push(q, H, dH, gradient, B, D, W):
            numbers, volume = self._numbers_in(patch, item, at, s, q), self.volume_of(item, scene.volumes, q)
            both = self.law.stress_and_vjp_at if shape else self.law.stress_vjp_at
            *P, (dP,), products = both([H], dH, numbers)  # only the rest shape's adjoint reads the stress itself
            dP = dP + gradient * patch.dpi
            minus = let(ti.cast(-1, self.fp) * volume)
            by_p, by_z = self._parted([let(minus * x) for x in products])
            if self.has_state:
                before = self.state_of(item, adjoint.z, 0, q)
                self.put_state(item, adjoint.z, 0, [a + b for a, b in zip(before, by_z)], q)
            if shape:
                (P,), theta = P, self.law.base.dilatation(H)
                by_B = (D.transpose() @ dP + W.transpose() @ P) * minus
                in_patch = patch.dtheta_p * (
                    patch.theta_p * (patch.lam - patch.lam_p - patch.lam_p) + patch.lam_p * theta
                )
                self.add_shape(item, adjoint, q, by_B, ti.cast(-1, self.fp) * (inner(P, dH) + in_patch))
            by = self.law.split_vjp(by_p, let(minus * patch.theta_p * patch.dtheta_p))
            return [(dP * volume) @ B.transpose()], by

        count = len(self.law.coefficient_names)
        lists = [[getattr(t, name) for t in known] for name in ("H", "dH", "gradient", "B", "D", "W")]
        (pushes,), by_p = self.each_point(lists, push, sums=count)
        self.store(item, corner, pushes, add)
        self.items.add(adjoint.coefficients, count, item, by_p)
