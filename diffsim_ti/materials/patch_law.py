"""A law whose resistance to a change of volume is averaged over patches of tetrahedra."""

from dataclasses import dataclass, replace

from diffsim_ti.materials.calculus.tensor import sum_of
from diffsim_ti.materials.law import Law, as_of
from diffsim_ti.runtime import let, traced


@dataclass(frozen=True)
class PatchLaw(Law):
    """psi(H; p) = psi(H; p') + lam/2 theta^2, where theta(H) is the law's own measure of the change of volume and p' its
    coefficients p with lam = 0, split: psi(H; p') stays in each tetrahedron, the patch's mean of theta takes the rest.

    So a tetrahedron of a patch with pressure pi = lam theta_patch (positive in tension) [Pa] has the numbers
    q = [*p', *z, pi], z its state if the law has one, which theta does not read; the stress P(H; p') + pi dtheta/dF and, as
    its share of the patch's energy, pi theta / 2.
    """

    base: Law

    def __post_init__(self):
        if self.base.reads != ("H",):
            raise ValueError(
                f'volume="patches" averages energies, but {type(self.base).__name__} reads {", ".join(self.base.reads)}; '
                'take volume="tetrahedra"'
            )
        if not self.base.has_dilatation:
            law = self.base
            while hasattr(law, "base"):
                law = law.base
            name = type(law).__name__
            raise ValueError(
                f'volume="patches" averages the part lam/2 theta^2 of an energy, but {name} does not say what its theta is; '
                'write theta(H) and make lam its last coefficient, or take volume="tetrahedra"'
            )

    coefficient_names, state_names = as_of("base", "coefficient_names"), as_of("base", "state_names")
    initial_state, plastic, lanes = as_of("base", "initial_state"), as_of("base", "plastic"), as_of("base", "lanes")
    # of q = [*p, *z]: no pressure moves the state on
    next_state_at, next_state_jvp = as_of("base", "next_state_at"), as_of("base", "next_state_jvp")
    next_state_vjp = as_of("base", "next_state_vjp")

    @property
    def stored(self) -> "PatchLaw":
        return replace(self, base=self.base.stored)

    @traced
    def split(self, p) -> tuple:
        """(p', lam): lam is the last coefficient less what the others make of it at lam = 0."""
        parts = [p[k] * self.real(factor) for k, factor in enumerate(self.base.last_without_lam) if factor]
        last = let(sum_of(parts)) if parts else let(p[-1] * 0)
        return [*p[:-1], last], let(p[-1] - last)

    @traced
    def split_vjp(self, by_rest: list, by_lam) -> list:
        """Adjoint of p for adjoints of p' and lam."""
        out = [*by_rest[:-1], by_lam]
        for k, factor in enumerate(self.base.last_without_lam):
            if factor:
                out[k] = let(out[k] + (by_rest[-1] - by_lam) * self.real(factor))
        return out

    @traced
    def energy_density(self, H, q):
        return self.base.energy_density(H, q[:-1]) + q[-1] * self.base.dilatation(H) * self.real(0.5)

    @traced
    def stress(self, H, q):
        return self.base.stress(H, q[:-1]) + self.base.dilatation_gradient(H) * q[-1]

    @traced
    def stress_differential_and_products(self, H, dH, q):
        """At a fixed pressure; the products are those of p'."""
        dP, products = self.base.stress_differential_and_products(H, dH, q[:-1])
        return dP + self.base.dilatation_gradient_differential(H, dH) * q[-1], products

    @traced
    def stress_jvp(self, H, dH, q, dq):
        by_rest = self.base.stress_change(H, q[:-1], dq[:-1])
        return self.stress_differential(H, dH, q) + by_rest + self.base.dilatation_gradient(H) * dq[-1]

    @traced
    def stress_and_jvp_at(self, x, dx, q, dq):
        P, dP = self.base.stress_and_jvp_at(x, dx, q[:-1], dq[:-1])
        G, turned = self.base.dilatation_gradient(*x), self.base.dilatation_gradient_differential(*x, *dx)
        return P + G * q[-1], dP + turned * q[-1] + G * dq[-1]

    @traced
    def stress_and_vjp_at(self, x, W, q):
        """At a fixed pressure; the products are those of p' and z."""
        P, (dP,), products = self.base.stress_and_vjp_at(x, W, q[:-1])
        G, turned = self.base.dilatation_gradient(*x), self.base.dilatation_gradient_differential(*x, W)
        return P + G * q[-1], [dP + turned * q[-1]], products
