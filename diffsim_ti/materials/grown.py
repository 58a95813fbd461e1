"""Growth, swelling and thermal strain: a material whose rest state is larger or smaller than its rest shape."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.materials.calculus.tensor import add_to_diagonal, inner
from diffsim_ti.materials.law import Law
from diffsim_ti.materials.material import Material, _all_values, check_range
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


class Grown(Material):
    """`Grown(material, growth)`: any elastic material, free of stress where F = F_g = (1 + growth) I, not where F = I:

        psi = det(F_g) psi_material(F F_g^-1) [J/m^3], P = det(F_g) P_material(F F_g^-1) F_g^-T

    growth [-], > -1: growth or swelling (shrinkage below zero) as strain along each edge; of heat alpha (T - T_0). One
    number, one for each tetrahedron, or by named sets as all numbers of materials; an input with gradient, "growth". A free
    body with uniform growth takes its new size without stress. Mass stays that of the rest shape.
    It holds during a run; what changes in time takes it as an input of each step.
    volume="patches" does not know it.
    Rodriguez, Hoger, McCulloch 1994, Stress-dependent finite growth, doi:10.1016/0021-9290(94)90021-3.
    Raises ValueError for growth of -1 or less, and for a material that has a state or depends on the velocity.
    """

    def __init__(self, material: Material, growth):
        if not isinstance(material, Material):
            raise ValueError(f"Grown: material must be a material such as StableNeoHookean, got {material!r}")
        law = material.law("f64")
        if law.state_names or law.reads != ("H",) or "growth" in material.inputs:
            raise ValueError(
                f"Grown: {material.name} has a state, a viscosity or a growth; take an elastic one without"
            )
        self.material, self._extra = material, ""
        self._numbers = dict(growth=growth) | material._numbers
        self.check({name: _all_values(name, number, self.shape_of(name)) for name, number in self._numbers.items()})

    def shape_of(self, name):
        return () if name == "growth" else self.material.shape_of(name)

    def unit_of(self, name):
        return "-" if name == "growth" else self.material.unit_of(name)

    def _of_material(self, values: dict) -> dict:
        return {name: values[name] for name in self.material.inputs if name in values}

    def check(self, values):
        super().check({"growth": values["growth"]})
        self.material.check(self._of_material(values))
        check_range("growth", values["growth"], -1, np.inf, False, "a strain; -1 leaves nothing of the body")

    @property
    def isotropic(self):
        return self.material.isotropic

    def lame(self, values):
        mu, lam = self.material.lame(self._of_material(values))
        return tuple(part * np.maximum(1 + np.asarray(values["growth"]), 1) for part in (mu, lam))

    def _joined(self, growth, of_material: np.ndarray) -> np.ndarray:
        growth = np.asarray(growth, np.float64)[..., None]
        shape = np.broadcast_shapes(growth.shape[:-1], of_material.shape[:-1])
        return np.concatenate([np.broadcast_to(x, (*shape, x.shape[-1])) for x in (growth, of_material)], -1)

    def coefficients(self, values):
        self.check(values)
        return self._joined(values["growth"], self.material.coefficients(self._of_material(values)))

    def coefficients_jvp(self, values, tangents):
        growth = np.broadcast_to(tangents.get("growth", 0.0), np.shape(values["growth"]))
        own = self.material.coefficients_jvp(self._of_material(values), self._of_material(tangents))
        return self._joined(growth, own)

    def coefficients_vjp(self, values, coefficients_adj):
        adj = np.asarray(coefficients_adj, np.float64)
        by_growth = adj[..., 0] if np.ndim(values["growth"]) else adj[..., 0].sum()
        return dict(growth=by_growth) | self.material.coefficients_vjp(self._of_material(values), adj[..., 1:])

    def law(self, precision):
        return GrownLaw(precision, self.material.law(precision))

    def __repr__(self):
        return f"{super().__repr__()[:-1]}, material={self.material.name})"
