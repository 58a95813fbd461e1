"""Laws written by their energy alone."""

from dataclasses import dataclass

from diffsim_ti.differentiation import Graph, Number
from diffsim_ti.materials.calculus.tensor import Tensor
from diffsim_ti.materials.law import Law
from diffsim_ti.runtime import spread, traced


@dataclass(frozen=True)
class EnergyLaw(Law):
    """A law that writes `psi(H, p)`; stress, differential and derivatives by the coefficients follow from it.

    H (a `Tensor` of the displacement gradient, F = I + H) and p (a list of the coefficients named by `coefficient_names`)
    are made of `Number`s, which know + - * / ** and the functions of `diffsim_ti.differentiation`, and take any Python
    numbers as constants. Coefficients may enter in any way: factors, exponents, limits, the components of a direction.
    `calculus.tensor` has what an energy is made of: `invariants(H)` is accurate near rest, where F - I is;
    `calculus.stretches` has energies of principal stretches, which may coincide.

    volume="patches" needs `theta(H)`, and the last coefficient as the factor of theta^2 / 2 and nowhere else.

    A law with a state (`state_names`, law.py) writes `psi(H, p, z)` and `next_state(H, p, z, h)`, z being a list of the S
    numbers: z is held while psi gives stresses, and next_state is what it becomes in a substep of length h [s]. Write that
    as the exact solution for a frozen H where there is one: relaxation towards H within a time tau is
    z + (1 - exp(-h / tau)) (H - z). `lame` of its material says the moduli of what is fast, all springs together.

    The graph is Griewank, Walther, Evaluating Derivatives, ch. 3 and 5, doi:10.1137/1.9780898717761.
    """

    def __post_init__(self):
        if self.reads not in (("H",), ("H", "H_dot")):
            raise ValueError(f'{type(self).__name__}: reads must be ("H",) or ("H", "H_dot"), got {self.reads}')
        if self.initial_state and len(self.initial_state) != len(self.state_names):
            raise ValueError(
                f"{type(self).__name__}: initial_state has {len(self.initial_state)} numbers for {len(self.state_names)} "
                "state_names; give one for each, or none for zeros"
            )
        if self.state_names and type(self).next_state is EnergyLaw.next_state:
            raise ValueError(
                f"{type(self).__name__} has a state ({', '.join(self.state_names)}) that nothing moves on: write "
                "next_state(H, p, z, h), or make them coefficients"
            )

    def psi(self, H: Tensor, p: list) -> Number:
        """psi [J/m^3], zero at rest; psi(H, p, z) where the law has a state. None of a law that dissipates alone."""
        raise NotImplementedError(f"{type(self).__name__} writes psi(H, p)")

    def next_state(self, H: Tensor, p: list, z: list, h: Number) -> list:
        """What the state z becomes in a substep of length h [s]: one number for each of `state_names`."""

    def dissipation(self, H: Tensor, H_dot: Tensor, p: list) -> Number:
        """phi [W/m^3] of a law that reads ("H", "H_dot"): its stress is dpsi/dF + dphi/dF_dot, F_dot = H_dot.

        For explicit solvers, which take the velocity before the kick; their stable step does not include phi. What shows
        stresses shows those of psi.
        """
        raise NotImplementedError(f"{type(self).__name__} reads H_dot: it writes dissipation(H, H_dot, p)")

    def theta(self, H: Tensor) -> Number:
        """The change of volume of which the last coefficient resists theta^2 / 2 [-]."""

    @property
    def has_dilatation(self) -> bool:
        return type(self).theta is not EnergyLaw.theta

    # ---- recording --------------------------------------------------------------------------------------------------

    def _parted(self, numbers: list) -> list:
        """[p], or [p, z] where the law has a state."""
        K = len(self.coefficient_names)
        return [numbers[:K], numbers[K:]] if self.state_names else [numbers]

    @traced
    def _record(self, H, p):
        """(graph, leaves of p, psi)"""
        g = Graph(self.fp, waits=True)
        numbers = [g.leaf(x) for x in p]
        return g, numbers, self.psi(Tensor(g.leaf(x) for x in H.numbers), *self._parted(numbers))

    @traced
    def _record_stress(self, x, p):
        """(graph, leaves of x and p, P); x holds H alone, for the stress of psi, or H and H_dot."""
        g = Graph(self.fp, waits=True)
        read, numbers = [Tensor(g.leaf(number) for number in one.numbers) for one in x], [g.leaf(c) for c in p]
        parted = self._parted(numbers)
        psi = self.psi(read[0], *parted)
        P = [] if psi is None else g.gradient(psi, read[0].numbers)
        if len(read) > 1:
            viscous = g.gradient(self.dissipation(*read, parted[0]), read[1].numbers)
            P = [a + b for a, b in zip(P, viscous)] or viscous
        return g, [*_numbers(read), *numbers], P

    @traced
    def _record_next_state(self, H, q, h):
        """(graph, leaves of H and q, next state)"""
        g = Graph(self.fp, waits=True)
        read, numbers = Tensor(g.leaf(x) for x in H.numbers), [g.leaf(x) for x in q]
        following = list(self.next_state(read, *self._parted(numbers), g.leaf(h)))
        if len(following) != len(self.state_names):
            raise ValueError(
                f"{type(self).__name__}: next_state must give {len(self.state_names)} numbers, one for each of "
                f"{', '.join(self.state_names)}, got {len(following)}"
            )
        return g, [*read.numbers, *numbers], [g.number(x) for x in following]

    @traced
    def _record_dilatation(self, H):
        g = Graph(self.fp, waits=True)
        h = Tensor(g.leaf(x) for x in H.numbers)
        theta = self.theta(h)
        return g, h.numbers, theta, g.gradient(theta, h.numbers)

    # ---- what kernels call ------------------------------------------------------------------------------------------

    @traced
    def energy_density(self, H, p):
        return spread(self._record(H, p)[2].value, H[0, 0])

    @traced
    def energy_by_coefficients(self, H, p):
        g, numbers, psi = self._record(H, p)
        return _spread(g.reverse([(psi, g.one())], numbers), H)

    @traced
    def stress_at(self, x, p):
        return _tensor([number.value for number in self._record_stress(x, p)[2]], x[0])

    @traced
    def stress_and_jvp_at(self, x, dx, p, dp):
        g, leaves, P = self._record_stress(x, p)
        stress = _tensor([number.value for number in P], x[0])
        return stress, _tensor(g.forward([*zip(leaves, [*_numbers(dx), *dp])], P), x[0])

    @traced
    def stress_and_vjp_at(self, x, W, p):
        g, leaves, P = self._record_stress(x, p)
        return _tensor([number.value for number in P], x[0]), *self._pulled(x, W, g, leaves, P)

    @staticmethod
    def _pulled(x, W, g, leaves, P):
        by = _spread(g.reverse([*zip(P, W.numbers)], leaves), x[0])
        return [Tensor(by[9 * k : 9 * k + 9]) for k in range(len(x))], by[9 * len(x) :]

    @traced
    def stress_jvp_at(self, x, dx, p, dp):
        g, leaves, P = self._record_stress(x, p)
        return _tensor(g.forward([*zip(leaves, [*_numbers(dx), *dp])], P), x[0])

    @traced
    def stress_vjp_at(self, x, W, p):
        return self._pulled(x, W, *self._record_stress(x, p))

    @traced
    def stress(self, H, p):
        return self.stress_at([H], p)

    @traced
    def stress_differential(self, H, dH, p):
        g, leaves, P = self._record_stress([H], p)
        return self._pulled([H], dH, g, leaves[:9], P)[0][0]  # symmetric; a sweep forwards takes a third more numbers

    @traced
    def stress_change(self, H, p, dp):
        g, leaves, P = self._record_stress([H], p)
        return _tensor(g.forward([*zip(leaves[9:], dp)], P), H)

    @traced
    def stress_jvp(self, H, dH, p, dp):
        return self.stress_jvp_at([H], [dH], p, dp)

    @traced
    def stress_differential_and_products(self, H, dH, p):
        (dP,), products = self.stress_vjp_at([H], dH, p)  # d2psi/dF2 is symmetric
        return dP, products

    @traced
    def next_state_at(self, H, q, h):
        return _spread([x.value for x in self._record_next_state(H, q, h)[2]], H)

    @traced
    def next_state_jvp(self, H, dH, q, dq, h):
        g, leaves, following = self._record_next_state(H, q, h)
        return _spread(g.forward([*zip(leaves, [*dH.numbers, *dq])], following), H)

    @traced
    def next_state_vjp(self, H, q, h, z_adj):
        g, leaves, following = self._record_next_state(H, q, h)
        by = _spread(g.reverse([*zip(following, z_adj)], leaves), H)
        return Tensor(by[:9]), by[9:]

    @traced
    def dilatation(self, H):
        return spread(self._record_dilatation(H)[2].value, H[0, 0])

    @traced
    def dilatation_gradient(self, H):
        return _tensor([x.value for x in self._record_dilatation(H)[3]], H)

    @traced
    def dilatation_gradient_differential(self, H, dH):
        g, h, _, gradient = self._record_dilatation(H)
        return _tensor(g.forward([*zip(h, dH.numbers)], gradient), H)


def _numbers(tensors) -> list:
    return [number for one in tensors for number in one.numbers]


def _spread(numbers: list, H) -> list:
    """With as many lanes as H has: what does not depend on H or p is a single constant."""
    return [spread(x, H[0, 0]) for x in numbers]


def _tensor(numbers: list, H) -> Tensor:
    return Tensor(_spread(numbers, H))
