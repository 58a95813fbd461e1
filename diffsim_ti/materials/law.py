"""What a law offers to kernels."""

from dataclasses import dataclass
from typing import ClassVar

import taichi as ti

from diffsim_ti.common.public import Public
from diffsim_ti.runtime import number_type, traced


def as_of(part: str, name: str) -> property:
    """What a law around others has as one of them has it, its attribute `part`: a property, or a function of it."""
    return property(lambda self: getattr(getattr(self, part), name))


@dataclass(frozen=True)
class Law(metaclass=Public):
    """A constitutive formula: Taichi functions of one displacement gradient H = grad u (F = I + H), a `Tensor`.

    `p` is a list of the K coefficients named by `coefficient_names`: moduli [Pa], exponents, components of a direction.
    A law whose energy is linear in p needs no derivative by it: stress(H, e_k) is the derivative of the stress by
    coefficient k, and stress(H, dp) its change for a change dp. Others write `stress_change` and `energy_by_coefficients`
    as well, or their energy alone (`EnergyLaw`), from which everything follows.
    The differential is exact and symmetric, and indefinite where the energy is not convex.

    `reads` lists what the stress depends on: ("H",), or ("H", "H_dot") with the rate of H, the velocity's gradient. What a
    law does not read costs nothing. Kernels call `stress_at`, `stress_jvp_at` and `stress_vjp_at`, whose `x` are
    Tensors in the order of `reads`.

    `state_names` names S numbers z of each tetrahedron that remember (viscous strains, damage); they begin at
    `initial_state`, zero by default. All functions then take [*p, *z] for p, and give derivatives by all of these. z is
    held during a pass of a solver, at whose end it becomes `next_state_at(H, [*p, *z], h)`: h [s] is the length of the
    pass, H that of the displacement at which an explicit pass takes its forces, or at which an implicit one ends. The step
    is thus split, which is of first order in h.

    A law is compile-time data: constants only, equal laws share compiled kernels. precision: "f32" or "f64".
    In its functions constants are integers, or `self.real(0.5)`, and no integer is divided or divides: Taichi computes a
    bare 0.5, x / 2 and 1 / x in f64, which makes f32 kernels slow. No unary minus on numbers: lanes have none.
    """

    precision: str

    coefficient_names: ClassVar[tuple[str, ...]] = ()
    state_names: ClassVar[tuple[str, ...]] = ()
    initial_state = ()  # one number for each of them, or none: zero
    reads: ClassVar[tuple[str, ...]] = ("H",)
    last_without_lam = ()  # factors f: with lam = 0 the last coefficient is sum_k f_k p_k; empty: zero
    plastic = False  # whether its state is a flow that keeps the volume, and moves on with the strain alone
    viscous = False  # whether it has a `viscous_differential`
    linear = False  # whether its stress is linear in H, so that its stiffness is that at rest
    # numbers of each tetrahedron that are held in an implicit pass, and a rate, see `in_steps`
    frozen_names: ClassVar[tuple[str, ...]] = ()
    short = False  # whether its kernels are so short that Taichi's own passes over them pay (runtime/launch.py)
    lanes = True  # written with + - * / and max alone, so that a number may be a vector of lanes

    @property
    def title(self) -> str:
        """Its name, and those of the laws within."""
        within = [x.title for x in vars(self).values() if isinstance(x, Law)]
        return type(self).__name__.removesuffix("Law") + (f"({within[0]})" if within else "")

    @property
    def stored(self) -> "Law":
        """The law whose energy is what is stored, where the potential of a pass is more than that."""
        return self

    @property
    def dissipated(self) -> "Law | None":
        """The law whose energy is what has been dissipated; None where a potential has no part of that."""
        return None

    fp = number_type

    @ti.func
    def real(self, x: ti.template()):
        """A constant in the law's precision."""
        return ti.cast(x, self.fp)

    @ti.func
    def energy_density(self, H, p):
        """psi [J/m^3], zero at rest."""

    @ti.func
    def stress(self, H, p):
        """First Piola-Kirchhoff stress P = dpsi/dF [Pa], a Tensor."""

    @ti.func
    def stress_differential_and_products(self, H, dH, p):
        """(dP, products): dP = d2psi/dF2 : dH, a Tensor, and dH : dP/dp_k, a list of K, from the same scalars."""

    @property
    def has_dilatation(self) -> bool:
        """Whether the law says which part of it resists a change of volume, as volume="patches" needs."""
        return type(self).dilatation is not Law.dilatation

    @traced
    def dilatation(self, H):
        """theta, the change of volume of which lam resists lam/2 theta^2 [-]; tr(e) for small strains e."""

    @traced
    def dilatation_gradient(self, H):
        """dtheta/dF, a Tensor."""

    @traced
    def dilatation_gradient_differential(self, H, dH):
        """Its change for a change dH, a Tensor."""

    def in_steps(self) -> "Law":
        """The law as implicit passes take it, of the displacement gradient alone. One that reads rates can be an energy
        there, of the change from what is held in a pass, numbers of `frozen_names`, and of a rate [1/s]: they follow
        the state in p. Itself, where it has no other form."""
        return self

    @traced
    def viscous_differential(self, H, dH, p):
        """Change of the stress for a change dH of the velocity's gradient [Pa s], a Tensor."""

    @traced
    def stress_differential(self, H, dH, p):
        """dP = d2psi/dF2 : dH [Pa], a Tensor."""
        dP, _ = self.stress_differential_and_products(H, dH, p)
        return dP

    @traced
    def stress_change(self, H, p, dp):
        """The stress's change for changes dp of the coefficients [Pa], a Tensor."""
        return self.stress(H, dp)

    @traced
    def stress_jvp(self, H, dH, p, dp):
        """The stress's change for changes dH and dp [Pa], a Tensor."""
        return self.stress_differential(H, dH, p) + self.stress_change(H, p, dp)

    @traced
    def stress_at(self, x, p):
        """P of all that the law reads [Pa], a Tensor."""
        return self.stress(*x, p)

    @traced
    def stress_jvp_at(self, x, dx, p, dp):
        """Its change for changes dx and dp, a Tensor."""
        return self.stress_jvp(*x, *dx, p, dp)

    @traced
    def stress_vjp_at(self, x, W, p):
        """(adjoints of x, a list of Tensors, and W : dP/dp_k, a list of K) for the adjoint W of P."""
        dP, products = self.stress_differential_and_products(*x, W, p)  # d2psi/dF2 is symmetric
        return [dP], products

    @traced
    def stress_and_jvp_at(self, x, dx, p, dp):
        """(P, its change), for who wants both."""
        return self.stress_at(x, p), self.stress_jvp_at(x, dx, p, dp)

    @traced
    def stress_and_vjp_at(self, x, W, p):
        """(P, adjoints of x, W : dP/dp_k), for who wants P too."""
        return self.stress_at(x, p), *self.stress_vjp_at(x, W, p)

    @traced
    def next_state_at(self, H, q, h):
        """The state after a pass of length h, a list of S; q = [*p, *z]."""
        raise NotImplementedError(
            f"{type(self).__name__} has a state ({', '.join(self.state_names)}): write next_state_at"
        )

    @traced
    def next_state_jvp(self, H, dH, q, dq, h):
        """Its change for changes dH and dq, a list of S."""
        raise NotImplementedError(f"{type(self).__name__} has a state: write next_state_jvp, beside next_state_at")

    @traced
    def next_state_vjp(self, H, q, h, z_adj):
        """(adjoint of H, a Tensor, adjoints of q, a list) for the adjoint z_adj of the state after the pass."""
        raise NotImplementedError(f"{type(self).__name__} has a state: write next_state_vjp, beside next_state_at")

    @traced
    def energy_by_coefficients(self, H, p):
        """dpsi/dp_k, a list of K."""
        return [self.energy_density(H, self.unit(k)) for k in range(len(self.coefficient_names))]

    @traced
    def unit(self, k: int) -> list:
        """Coefficients that are 1 at k and 0 elsewhere."""
        return [ti.cast(int(i == k), self.fp) for i in range(len(self.coefficient_names))]
