"""Tetrahedra whose change of volume is averaged over patches, so that they do not lock as nu approaches 0.5.

    E = sum_e V_e psi(F_e; lam = 0) + sum_p W_p lam_p / 2 theta_p^2
    W_p = sum_e V_e,  lam_p = sum_e V_e lam_e / W_p,  theta_p = sum_e V_e theta_e / W_p     over the tetrahedra e of patch p

A patch is a block of eight (mesh/patches.py; rows left over have no volume), so that sums over a patch are sums over lanes.
Its pressure pi = lam_p theta_p takes the place of lam theta in each of its tetrahedra: forces are those of an energy.
Nagtegaal, Parks, Rice 1974, doi:10.1016/0045-7825(74)90032-2 (mean dilatation); de Souza Neto, Andrade Pires, Owen 2005,
F-bar-based linear triangles and tetrahedra for finite strain analysis of nearly incompressible solids, doi:10.1002/nme.1187.
"""

from dataclasses import dataclass
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.elements.tetrahedron import A, Tetrahedron
from diffsim_ti.materials.calculus.tensor import inner, sum_of
from diffsim_ti.materials.patch_law import PatchLaw
from diffsim_ti.runtime import LANES, Bundle, let, traced
from diffsim_ti.runtime import at as entry

MOST = 6  # numbers of an item that its patch sums up


def functions_of(law, uniform: bool, lanes: bool) -> Tetrahedron:
    """The element of a law; patches for a PatchLaw."""
    return (PatchedTetrahedron if isinstance(law, PatchLaw) else Tetrahedron)(law, uniform, lanes)


@dataclass(frozen=True)
class PatchedTetrahedron(Tetrahedron):
    """The functions of `Tetrahedron`, with the same meaning. In all of them q = [*p', pi] (patch_law.py)."""

    # ---- what a patch knows -----------------------------------------------------------------------------------------

    @traced
    def _own(self, item, job) -> SimpleNamespace:
        """What an item knows by itself; `numbers` are what its patch sums up."""
        t, scene, base = SimpleNamespace(), job.scene, self.law.base
        t.B, t.V = self.gradients_of(item, scene.gradients), self.volume_of(item, scene.volumes)
        t.p, t.lam = self.law.split(self.coefficients_of(item, scene.coefficients))
        t.D = self.edges(item, scene, job.at.u, job.s)
        t.H = t.D @ t.B
        t.theta = base.dilatation(t.H)
        t.numbers = [t.V, let(t.V * t.lam), let(t.V * t.theta)]
        if job.w is None:
            return t
        t.W, t.gradient = self.edges(item, scene, job.w, 0), base.dilatation_gradient(t.H)
        t.dH = t.W @ t.B
        if job.dots is None:
            t.dtheta = inner(t.gradient, t.dH)
            t.numbers.append(let(t.V * t.dtheta))
            return t
        t.dB, t.dV = self.gradients_of(item, job.dots.gradients), self.volume_of(item, job.dots.volumes)
        t.dp, dlam = self.law.split(self.coefficients_of(item, job.dots.coefficients))
        t.dH = t.dH + t.D @ t.dB
        t.dtheta = inner(t.gradient, t.dH)
        t.numbers += [t.dV, let(t.dV * t.lam + t.V * dlam), let(t.dV * t.theta + t.V * t.dtheta)]
        return t

    @traced
    def _row(self, item, job):
        numbers = self._own(item, job).numbers
        return ti.types.vector(MOST, self.fp)(*numbers, *[ti.cast(0, self.fp)] * (MOST - len(numbers)))

    @ti.func
    def _sum_one_by_one(self, item, job: A):
        total = ti.types.vector(MOST, self.fp)(0)
        first = item // LANES * LANES
        for lane in range(LANES):
            total += self._row(first + lane, job)
        return total

    @traced
    def _patch_of(self, item, scene, at, s, w=None, dots=None) -> SimpleNamespace:
        """What an item knows, with its patch's W, lam_p, theta_p, pi and, for changes w of u, their changes."""
        job = Bundle(scene=scene, at=at, s=s, w=w, dots=dots)
        t = self._own(item, job)
        if self.lanes:
            sums = [self.items.broadcast(let(sum_of(entry(x, lane) for lane in range(LANES)))) for x in t.numbers]
        else:
            total = let(self._sum_one_by_one(item, job))
            sums = [let(entry(total, k)) for k in range(len(t.numbers))]
        volume, stiff, swollen, *changes = sums
        t.lam_p, t.theta_p = let(stiff / volume), let(swollen / volume)
        t.q = [*t.p, let(t.lam_p * t.theta_p)]
        if len(changes) == 1:
            t.dtheta_p = let(changes[0] / volume)
            t.dpi = let(t.lam_p * t.dtheta_p)
        elif changes:
            dvolume, dstiff, dswollen = changes
            dlam_p, dtheta_p = (dstiff - t.lam_p * dvolume) / volume, (dswollen - t.theta_p * dvolume) / volume
            t.dpi = let(dlam_p * t.theta_p + t.lam_p * dtheta_p)
        return t

    @traced
    def numbers_at(self, item, scene, at, s) -> list:
        return self._patch_of(item, scene, at, s).q

    # ---- forces and their derivatives -------------------------------------------------------------------------------

    @traced
    def forces(self, item, scene, at, s, corner) -> None:
        t = self._patch_of(item, scene, at, s)
        self.store(item, corner, (self.law.stress(t.H, t.q) * t.V) @ t.B.transpose())

    @traced
    def pressure_forces(self, item, scene, at, s, corner) -> None:
        """Corner forces of a unit pressure: the derivatives of -W_p theta_p by the displacement of the corners."""
        t = self._own(item, Bundle(scene=scene, at=at, s=s, w=None, dots=None))
        self.store(item, corner, (self.law.base.dilatation_gradient(t.H) * t.V) @ t.B.transpose())

    @traced
    def stiffness(self, item, scene, at, s, corner) -> None:
        t = self._patch_of(item, scene, at, s, at.w)
        dP = self.law.stress_differential(t.H, t.dH, t.q) + t.gradient * t.dpi
        self.store(item, corner, (dP * t.V) @ t.B.transpose())

    @traced
    def forces_jvp(self, item, scene, at, s, change, corner, dots) -> None:
        t = self._patch_of(item, scene, at, s, change.u, dots)
        dP = self.law.stress_jvp(t.H, t.dH, t.q, [*t.dp, t.dpi])
        change = t.B * t.dV + t.dB * t.V
        self.store(item, corner, (dP * t.V) @ t.B.transpose() + self.law.stress(t.H, t.q) @ change.transpose())

    @traced
    def forces_vjp(self, item, scene, at, s, w, corner, adjoint, shape: bool, add: bool = False) -> None:
        """The work of a patch's pressure on w is -W_p lam_p theta_p dtheta_p, with dtheta_p the change of theta_p for w."""
        t = self._patch_of(item, scene, at, s, w)
        dP, products = self.law.stress_differential_and_products(t.H, t.dH, t.q)
        dP = dP + t.gradient * t.dpi
        self.store(item, corner, (dP * t.V) @ t.B.transpose(), add)
        minus = let(ti.cast(-1, self.fp) * t.V)
        by = self.law.split_vjp([let(minus * x) for x in products], let(minus * t.theta_p * t.dtheta_p))
        self.items.add(adjoint.coefficients, len(products), item, by)
        if shape:
            self._shape_vjp(item, t, dP, adjoint)

    @traced
    def _shape_vjp(self, item, t, dP, adjoint) -> None:
        P, minus = self.law.stress(t.H, t.q), ti.cast(-1, self.fp)
        by_B = (t.D.transpose() @ dP + t.W.transpose() @ P) * let(minus * t.V)
        self.items.add(adjoint.gradients, 9, item, by_B.numbers)
        in_patch = t.dtheta_p * (t.theta_p * (t.lam - t.lam_p - t.lam_p) + t.lam_p * t.theta)
        self.items.add(adjoint.volumes, 1, item, [minus * (inner(P, t.dH) + in_patch)])
