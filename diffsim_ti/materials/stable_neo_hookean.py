"""Neo-Hookean material that stays finite when inverted."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.materials.calculus import logarithm
from diffsim_ti.materials.calculus.invariants import InvariantLaw
from diffsim_ti.materials.material import Material, PerTetrahedron


@dataclass(frozen=True)
class StableNeoHookeanLaw(InvariantLaw):
    """psi = mu/2 (I_C - 3) - mu log J + lam/2 (J - 1)^2 = mu/2 s + mu (j - log(1 + j)) + lam/2 j^2."""

    J_floor: float = 0.01

    coefficient_names = ("mu", "lam")
    couples_s = False

    @ti.func
    def psi(self, j, s, q, p):
        return p[0] * (self.real(0.5) * s + logarithm.value(j, self.floor(), self.fp)) + self.real(0.5) * p[1] * j * j

    @ti.func
    def slopes(self, j, s, q, p):
        return p[0] * logarithm.slope(j, self.floor(), self.fp) + p[1] * j, self.real(0.5) * p[0], 0

    @ti.func
    def curvatures(self, j, s, q, p):
        return p[0] * logarithm.curvature(j, self.floor(), self.fp) + p[1], 0, 0

    @ti.func
    def floor(self):
        return self.real(self.J_floor - 1)


class StableNeoHookean(Material):
    """psi = mu/2 (I_C - 3) - mu log J + lam/2 (J - 1)^2 [J/m^3]; P = mu (F - F^-T) + lam (J - 1) J F^-T [Pa].

    Below `J_floor` -log J is continued by its second-order Taylor polynomial about J_floor. The promise: for every F, also
    inverted, energy, stress and differential are finite, the energy is C2, and its derivative by J is negative wherever
    J < J_floor, so that the stress pushes outwards. Above the floor the formula is exact. The limit: that is not full
    recovery. Near F = 0 no law of this form leads every inverted state back; `SmithNeoHookean` recovers from more of them.

    Arguments: see `Material`; J_floor in (0, 1), one number, part of the law (a change compiles kernels again).
    Bonet, Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed. 2008, sec. 6.4.3.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.25)  # mu = lam = E / 2.5
    >>> print([round(float(x), 6) for x in material.lame(material.values(mesh))])
    [40000.0, 40000.0]
    """

    def __init__(
        self,
        youngs_modulus: PerTetrahedron | None = None,
        poissons_ratio: PerTetrahedron | None = None,
        *,
        E: PerTetrahedron | None = None,
        nu: PerTetrahedron | None = None,
        mu: PerTetrahedron | None = None,
        lam: PerTetrahedron | None = None,
        J_floor: float = 0.01,
    ):
        super().__init__(youngs_modulus, poissons_ratio, E=E, nu=nu, mu=mu, lam=lam, J_floor=J_floor)

    def law(self, precision: str) -> StableNeoHookeanLaw:
        return StableNeoHookeanLaw(precision, self.J_floor)
