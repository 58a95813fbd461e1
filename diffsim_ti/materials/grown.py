"""Growth, swelling and thermal strain: a material whose rest state is larger or smaller than its rest shape."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.materials.around import Around
from diffsim_ti.materials.calculus.tensor import add_to_diagonal, inner
from diffsim_ti.materials.law import Law
from diffsim_ti.materials.material import Material, PerTetrahedron, check_range
from diffsim_ti.runtime import let, traced


@dataclass(frozen=True)
class GrownLaw(Law):
    """g^3 psi(H_e), H_e = (H - (g - 1) I) / g, g = 1 + growth, the first coefficient."""

    base: Law | None = None

    @property
    def coefficient_names(self):
        return ("growth", *self.base.coefficient_names)

    @property
    def lanes(self):
        return self.base.lanes

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


class Grown(Around):
    """`Grown(material, growth)`: any elastic material, free of stress where F = F_g = (1 + growth) I, not where F = I:

        psi = det(F_g) psi_material(F F_g^-1) [J/m^3], P = det(F_g) P_material(F F_g^-1) F_g^-T

    growth [-], > -1: growth or swelling (shrinkage below zero) as strain along each edge; of heat alpha (T - T_0). One
    number, one for each tetrahedron, or by named sets as all numbers of materials; an input with gradient, "growth". A free
    body with uniform growth takes its new size without stress. Mass stays that of the rest shape.
    It holds during a run; a term `Growth` adds what changes in time.
    volume="patches" does not support it.
    Rodriguez, Hoger, McCulloch 1994, Stress-dependent finite growth, doi:10.1016/0021-9290(94)90021-3.
    Raises ValueError for growth of -1 or less, and for a material that has a state or depends on the velocity.
    """

    units = {"growth": "-"}
    takes_moduli = False

    def __init__(self, material: Material, growth: PerTetrahedron):
        if "growth" in getattr(material, "inputs", ()):
            raise ValueError(f"Grown: {material.name} has a growth already; take a material without")
        self._surround(material, dict(growth=growth))

    def check(self, values):
        super().check(values)
        check_range("growth", values["growth"], -1, np.inf, False, "a strain; -1 leaves nothing of the body")

    def lame(self, values):
        mu, lam = self.material.lame(self.inner(values))
        return tuple(part * np.maximum(1 + np.asarray(values["growth"]), 1) for part in (mu, lam))

    def law(self, precision):
        return GrownLaw(precision, self.material.law(precision))


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
