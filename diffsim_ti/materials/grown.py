"""Growth, swelling and thermal strain: a material whose rest state is larger or smaller than its rest shape."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.differentiation.arrays import value_of
from diffsim_ti.materials.around import Around
from diffsim_ti.materials.calculus.tensor import PAIRS, add_to_diagonal, cofactor, inner, of_six
from diffsim_ti.materials.law import Law, as_of
from diffsim_ti.materials.material import Material, PerTetrahedron, check_range
from diffsim_ti.runtime import let, traced


@dataclass(frozen=True)
class GrownLaw(Law):
    """g^3 psi(H_e), H_e = (H - (g - 1) I) / g, g = 1 + growth, the first coefficient."""

    base: Law | None = None

    lanes = as_of("base", "lanes")

    @property
    def coefficient_names(self):
        return ("growth", *self.base.coefficient_names)

    @traced
    def _parts(self, H, p):
        """(g, H_e, F, coefficients of the base)"""
        e, *own = p
        g = let(e + self.real(1))
        elastic = add_to_diagonal(H, let(self.real(0) - e)) * let(self.real(1) / g)
        return g, elastic, add_to_diagonal(H, self.real(1)), own

    @traced
    def energy_density(self, H, p):
        g, elastic, _, own = self._parts(H, p)
        return g * g * g * self.base.energy_density(elastic, own)

    @traced
    def energy_by_coefficients(self, H, p):
        g, elastic, F, own = self._parts(H, p)
        psi, P = self.base.energy_density(elastic, own), self.base.stress(elastic, own)
        by_growth = let(self.real(3) * g * g * psi - g * inner(P, F))
        cube = let(g * g * g)
        return [by_growth, *(cube * x for x in self.base.energy_by_coefficients(elastic, own))]

    @traced
    def stress(self, H, p):
        g, elastic, _, own = self._parts(H, p)
        return self.base.stress(elastic, own) * let(g * g)

    @traced
    def stress_differential(self, H, dH, p):
        g, elastic, _, own = self._parts(H, p)
        return self.base.stress_differential(elastic, dH, own) * g

    @traced
    def stress_change(self, H, p, dp):
        g, elastic, F, own = self._parts(H, p)
        twice = self.base.stress(elastic, own) * let(self.real(2) * g)
        by_growth = twice - self.base.stress_differential(elastic, F, own)
        return by_growth * dp[0] + self.base.stress_change(elastic, own, dp[1:]) * let(g * g)

    @traced
    def stress_differential_and_products(self, H, dH, p):
        g, elastic, F, own = self._parts(H, p)
        dP, products = self.base.stress_differential_and_products(elastic, dH, own)
        by_growth = let(self.real(2) * g * inner(self.base.stress(elastic, own), dH) - inner(dP, F))
        square = let(g * g)
        return dP * g, [by_growth, *(square * x for x in products)]


@dataclass(frozen=True)
class GrownByStrainLaw(Law):
    """det(G) psi((1 + H) G^-1), G = 1 + e symmetric, whose six numbers come first."""

    base: Law | None = None

    lanes = as_of("base", "lanes")

    @property
    def coefficient_names(self):
        return (*(f"strain_{'xyz'[i]}{'xyz'[j]}" for i, j in PAIRS), *self.base.coefficient_names)

    @traced
    def _parts(self, H, p):
        """(det G, G^-1, H_e, coefficients of the base)"""
        e = of_six(p[:6])
        G = add_to_diagonal(e, self.real(1))
        C = cofactor(G)
        det = let(G[0, 0] * C[0, 0] + G[0, 1] * C[0, 1] + G[0, 2] * C[0, 2])
        A = C * let(self.real(1) / det)
        return det, A, (H - e) @ A, p[6:]

    @traced
    def _by_strain(self, M, det) -> list:
        return [let(det * (M[i, j] if i == j else M[i, j] + M[j, i])) for i, j in PAIRS]

    @traced
    def energy_density(self, H, p):
        det, _, elastic, own = self._parts(H, p)
        return det * self.base.energy_density(elastic, own)

    @traced
    def energy_by_coefficients(self, H, p):
        det, A, elastic, own = self._parts(H, p)
        psi, P = let(self.base.energy_density(elastic, own)), self.base.stress(elastic, own)
        M = A * psi - add_to_diagonal(elastic, self.real(1)).transpose() @ P @ A
        return [*self._by_strain(M, det), *(det * x for x in self.base.energy_by_coefficients(elastic, own))]

    @traced
    def stress(self, H, p):
        det, A, elastic, own = self._parts(H, p)
        return self.base.stress(elastic, own) @ A * det

    @traced
    def stress_differential(self, H, dH, p):
        det, A, elastic, own = self._parts(H, p)
        return self.base.stress_differential(elastic, dH @ A, own) @ A * det

    @traced
    def stress_change(self, H, p, dp):
        det, A, elastic, own = self._parts(H, p)
        P, turned = self.base.stress(elastic, own), of_six(dp[:6]) @ A
        moved = self.base.stress_differential(elastic, add_to_diagonal(elastic, self.real(1)) @ turned, own)
        by_strain = P * turned.trace() - moved - P @ turned.transpose()
        return (by_strain + self.base.stress_change(elastic, own, dp[6:])) @ A * det

    @traced
    def stress_differential_and_products(self, H, dH, p):
        det, A, elastic, own = self._parts(H, p)
        P, change = self.base.stress(elastic, own), dH @ A
        dP, products = self.base.stress_differential_and_products(elastic, change, own)
        F = add_to_diagonal(elastic, self.real(1))
        M = A * inner(P, change) - F.transpose() @ dP @ A - A @ P.transpose() @ change
        return dP @ A * det, [*self._by_strain(M, det), *(let(det * x) for x in products)]


class Grown(Around):
    """`Grown(material, growth)`: any elastic material, free of stress where F = F_g = (1 + growth) I, not where F = I:

        psi = det(F_g) psi_material(F F_g^-1) [J/m^3], P = det(F_g) P_material(F F_g^-1) F_g^-T

    growth [-], > -1: growth or swelling (shrinkage below zero) as strain along each edge; of heat alpha (T - T_0). One
    number, one for each tetrahedron, or by named sets as all numbers of materials; of ten nodes also one at each of the four
    points of the stresses, shape (num_tetrahedra, 4), such as `mesh.at_stress_points(x)` of a field x at vertices (not
    where another material, such as KelvinVoigt, is around this one). An input with gradient, "growth". A
    free body with uniform growth takes its new size without stress, and one of ten nodes with growth that is linear in
    space its curved one. Mass stays that of the rest shape.
    `Grown(material, strain=e)`: a stretch at rest that has directions, such as of wood that swells or a membrane that was
    stretched before it was glued: F_g = 1 + e, e = (xx, yy, zz, yz, xz, xy) [-], shear as half the angle; shape (6,),
    (num_tetrahedra, 6) or by sets; input "growth_strain". Matter that was stretched to its rest shape by U has e = U^-1 - 1.
    It holds during a run; a term `Growth` adds what changes in time, to `growth`.
    volume="patches" does not support it.
    Rodriguez, Hoger, McCulloch 1994, Stress-dependent finite growth, doi:10.1016/0021-9290(94)90021-3.
    Raises ValueError for growth of -1 or less, and for a material that has a state or depends on the velocity.
    """

    units = {"growth": "-", "growth_strain": "-"}
    shapes = {"growth_strain": (6,)}
    takes_moduli = False
    at_points = ("growth",)

    def __init__(self, material: Material, growth: PerTetrahedron | None = None, strain: PerTetrahedron | None = None):
        given = {name: x for name, x in (("growth", growth), ("growth_strain", strain)) if x is not None}
        if len(given) != 1:
            raise ValueError(f"Grown: needs growth or strain, got {' and '.join(given) or 'neither'}")
        (name,) = given
        if name in getattr(material, "inputs", ()):
            raise ValueError(f"Grown: {material.name} has a {name} already; take a material without")
        self._surround(material, given)

    def _stretches(self, values) -> np.ndarray:
        """Principal stretches of F_g, along the last axis."""
        if self.own == ("growth",):
            return np.repeat(1 + np.asarray(value_of(values["growth"]))[..., None], 3, -1)
        e, place = np.asarray(value_of(values["growth_strain"])), [[0, 5, 4], [5, 1, 3], [4, 3, 2]]
        return 1 + np.linalg.eigvalsh(e[..., place])

    def check(self, values):
        super().check(values)
        name = "growth" if self.own == ("growth",) else "least principal value of growth_strain"
        check_range(
            name, self._stretches(values).min(-1) - 1, -1, np.inf, False, "a strain; -1 leaves nothing of the body"
        )

    def lame(self, values):
        stretches = self._stretches(values)
        stretches = stretches.max(1) if stretches.ndim == 3 else stretches  # of points
        most = stretches[..., 0] if self.own == ("growth",) else stretches.prod(-1) / stretches.min(-1) ** 2
        return tuple(part * np.maximum(most, 1) for part in self.material.lame(self.inner(values)))

    def law(self, precision):
        kind = GrownLaw if self.own == ("growth",) else GrownByStrainLaw
        return kind(precision, self.material.law(precision))


def grown(material: Material, volume: str) -> Material:
    """The material if it is Grown, or has a growth within, else `Grown(material, 0)`; for terms that grow it over time."""
    if volume == "patches":
        raise ValueError('Growth: volume="patches" does not support it; take volume="tetrahedra" or mesh.quadratic()')
    if "growth" in material.law("f64").coefficient_names:
        return material
    try:
        return Grown(material, 0.0)
    except ValueError as error:
        raise ValueError(f"Growth: {error}: {material.name}(Grown(material, 0), ...)") from None
