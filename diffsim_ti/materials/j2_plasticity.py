"""Metals: elastic at small strains, plastic beyond a yield stress, at any strain."""

from dataclasses import dataclass, replace

import numpy as np
import taichi as ti

from diffsim_ti.differentiation import exp, expm1, expm1_minus_x, log1p, maximum, sqrt
from diffsim_ti.materials.calculus.logarithmic_strain import exponential_less_one, logarithmic_strain
from diffsim_ti.materials.calculus.tensor import SIX, Tensor, add_to_diagonal, inner, invariants, of_six, six
from diffsim_ti.materials.energy_law import EnergyLaw
from diffsim_ti.materials.material import Material, PerTetrahedron, check_range
from diffsim_ti.runtime import assign, each_lane, let, traced, variable

ROUNDS = 10  # of Newton's method for a flow stress that is curved


@dataclass(frozen=True)
class J2Law(EnergyLaw):
    """The potential of a pass, whose minimum over the plastic flow it is, for the state z before:

        psi = K/2 log(J)^2 + mu |dev e - A|^2 + k/3 |b + A|^2 + D(a + x),   |A| = sqrt(3/2) x,

    e = 1/2 log(F_e^T F_e) of F_e = F F_p^-1, z = [F_p^-1 - I, a, b]: a the equivalent plastic strain, b the back strain. Its
    derivative is the stress after the pass, and the second one the consistent tangent. D(a), the integral of the flow
    stress, is what has been dissipated; of psi `part` is "all", what is "stored", or this.
    """

    saturating: bool = False
    kinematic: bool = False
    part: str = "all"

    plastic = True
    # in patches a tetrahedron resists by itself a change of volume as little as of shape, but does not turn inside out
    last_without_lam = (0.0, 1.0)

    @property
    def lanes(self):
        return not (self.kinematic and self.fp == ti.f32)  # LLVM fails on the adjoint in lanes of float32

    @property
    def coefficient_names(self):
        own = ("saturation_stress", "saturation_exponent") * self.saturating + ("kinematic_hardening",) * self.kinematic
        return ("mu", "yield_stress", "hardening", *own, "bulk_modulus")

    @property
    def state_names(self):
        of_flow = tuple(f"f_{i}{j}" for i in "xyz" for j in "xyz")
        return (*of_flow, "plastic_strain", *((f"b_{pair}" for pair in SIX) if self.kinematic else ()))

    @property
    def stored(self):
        return replace(self, part="stored")

    @property
    def dissipated(self):
        return replace(self, part="dissipated")

    def theta(self, H):
        return log1p(invariants(H)[1])

    def flow_stress(self, p, a):
        """(Y, dY/da, its integral D) at an equivalent plastic strain a."""
        _, first, slope, *rest = p
        Y, dY, D = first + slope * a, slope, a * (first + slope * a * 0.5)
        if self.saturating:
            rise, x = rest[0] - first, 0 - rest[1] * a
            Y, dY, D = Y - rise * expm1(x), dY + rise * rest[1] * exp(x), D + rise / rest[1] * expm1_minus_x(x)
        return Y, dY, D

    def _flow(self, H, p, z):
        """(N, dev e, xi, b, c, x, q, stiffness, D), tensors in the basis N: the flow is A = c xi, xi = 2 mu dev e - 2/3 k b
        the trial stress less the back stress, x the change of a. q = sqrt(3/2) |xi|, or the flow stress where that is
        less."""
        graph, mu = H.numbers[0].graph, p[0]
        f, alpha = Tensor(z[:9]), z[9]
        N, L = logarithmic_strain(H + f + H @ f, coaxial=not self.kinematic)
        dev = add_to_diagonal(L, L.trace() * (-1 / 3))
        back, xi, stiffness = None, dev * (2 * mu), 3 * mu
        if self.kinematic:
            back = N.transpose() @ (of_six(z[10:]) @ N)
            xi, stiffness = xi - back * (p[-2] * (2 / 3)), stiffness + p[-2]
        before = self.flow_stress(p, alpha)[0]
        q = sqrt(maximum(inner(xi, xi) * 1.5, before * before))
        start = self._root(graph, p, alpha, q, stiffness) if self.saturating else graph.constant(0)
        x = graph.leaf(start)
        Y, slope, _ = self.flow_stress(p, alpha + x)
        x = x + (q - stiffness * x - Y) / (stiffness + slope)  # exact where Y is linear, and derivatives at a root
        return N, dev, xi, back, 1.5 * x / q, x, q, stiffness, self.flow_stress(p, alpha + x)[2]

    @traced
    def _root(self, graph, p, alpha, q, stiffness):
        numbers = [let(x.value) for x in (*p[1:5], alpha, q, stiffness)]
        x = variable(0 * numbers[-2])
        _find_root(self, x, numbers)
        return let(x)

    @traced
    def improve(self, x, numbers) -> None:
        """A round of Newton's method for q = stiffness x + Y(alpha + x), which is convex or concave: it does not fail."""
        first, linear, last, rate, alpha, q, stiffness = numbers
        a = let(alpha + x)
        left = let((last - first) * each_lane(ti.exp, let(ti.cast(-1, self.fp) * rate * a)))
        rest = q - stiffness * x - (last + linear * a - left)
        assign(x, x + rest / (stiffness + linear + rate * left))

    def psi(self, H, p, z):
        _, dev, xi, back, _, x, q, stiffness, D = self._flow(H, p, z)
        if self.part == "dissipated":
            return D
        theta = self.theta(H)
        stored = p[-1] * 0.5 * theta * theta + p[0] * inner(dev, dev) + x * (stiffness * x * 0.5 - q)
        if self.kinematic:
            stored = stored + p[-2] * (1 / 3) * inner(back, back)
        return stored if self.part == "stored" else stored + D

    def next_state(self, H, p, z, h):
        N, _, xi, _, c, x, *_ = self._flow(H, p, z)
        A = xi * c
        change = N @ exponential_less_one(A * -1, coaxial=not self.kinematic) @ N.transpose()
        f = Tensor(z[:9])
        f = f + change + f @ change
        back = [a + b for a, b in zip(z[10:], six(N @ A @ N.transpose()))] if self.kinematic else []
        return [*f.numbers, z[9] + x, *back]


@ti.func
def _find_root(law: ti.template(), x: ti.template(), numbers: ti.template()):
    for _ in range(ROUNDS):
        law.improve(x, numbers)


class J2Plasticity(Material):
    """A metal: elastic by Hencky's energy, and beyond von Mises's yield stress plastic, at any strain, F = F_e F_p:

        tau = K log(J) 1 + 2 mu dev(e),  e = 1/2 log(F_e F_e^T),  sqrt(3/2) |dev tau - back stress| <= Y(a) [Pa],
        Y(a) = yield_stress + hardening a + (saturation_stress - yield_stress) (1 - exp(-saturation_exponent a)),

    tau = J sigma Kirchhoff's stress, a the equivalent plastic strain. Plastic flow is in the direction of dev tau - back
    stress and keeps the volume; it is found by a return mapping with the exponential, which is exact for a proportional
    strain however long the step, and otherwise of first order in the strain of a step. Y is linear without saturation_stress
    (Voce). kinematic_hardening k: a back stress 2/3 k times the integral of the rate of plastic strain, in the unloaded
    configuration, which has no spin (Prager).

    `J2Plasticity(E, nu, yield_stress=y, hardening=h)`, or with mu= and lam=. Each is one number, one per tetrahedron or by
    sets, and an input with gradient [Pa; the exponent -]. hardening, kinematic_hardening >= 0, saturation_stress >=
    yield_stress: what softens would flow in a band as narrow as the mesh lets it.

    A law with a state (law.py): F_p^-1 - I, the equivalent plastic strain, and with kinematic hardening the back strain, six
    numbers. The stress of a step has a potential, whose Hessian is the consistent tangent of implicit and static solves; the
    latter follow the steps of a run, whatever their dt. Gradients are exact but where a point just reaches its yield stress:
    there the slope jumps from that of elastic to that of plastic loading, and one of both is given.
    Linear tetrahedra lock in plastic flow: take mesh.quadratic(), alone where flow is large and narrow, or volume="patches".
    `PlasticStrain`, `Dissipation` and `ElasticEnergy` show what a run has done.
    Simo, Hughes, Computational Inelasticity, 1998, ch. 9, doi:10.1007/b98904; Eterovic, Bathe 1990, A hyperelastic-based
    large strain elasto-plastic constitutive formulation with combined isotropic-kinematic hardening,
    doi:10.1002/nme.1620300602.
    Raises ValueError for numbers out of range.

    >>> import diffsim_ti as ds
    >>> copper = ds.J2Plasticity(E=117e9, nu=0.35, yield_stress=400e6, hardening=100e6)
    >>> copper.inputs
    ('youngs_modulus', 'poissons_ratio', 'yield_stress', 'hardening')
    """

    units = {"saturation_exponent": "-"}
    positive = dict(
        yield_stress="the stress [Pa] at which flow begins", saturation_exponent="leave both out, or raise it"
    )
    not_negative = dict.fromkeys(
        ("hardening", "kinematic_hardening"), "what softens flows in a band of the mesh's width"
    )

    def __init__(
        self,
        youngs_modulus: PerTetrahedron | None = None,
        poissons_ratio: PerTetrahedron | None = None,
        yield_stress: PerTetrahedron | None = None,
        hardening: PerTetrahedron = 0.0,
        *,
        saturation_stress: PerTetrahedron | None = None,
        saturation_exponent: PerTetrahedron | None = None,
        kinematic_hardening: PerTetrahedron | None = None,
        E: PerTetrahedron | None = None,
        nu: PerTetrahedron | None = None,
        mu: PerTetrahedron | None = None,
        lam: PerTetrahedron | None = None,
    ):
        self.saturating = saturation_stress is not None or saturation_exponent is not None
        self.kinematic = kinematic_hardening is not None
        own = ("yield_stress", "hardening")
        own += ("saturation_stress", "saturation_exponent") * self.saturating
        own += ("kinematic_hardening",) * self.kinematic
        self.spellings = tuple((*moduli, *own) for moduli in Material.spellings)
        # coefficients are mu, these and the bulk modulus
        self.from_own = np.eye(len(own) + 2)[[0, *range(2, len(own) + 2), 1]]
        self.from_own[-1, 0] = 2 / 3
        beyond = dict(saturation_stress=saturation_stress, saturation_exponent=saturation_exponent)
        named = dict(hardening=hardening, kinematic_hardening=kinematic_hardening, E=E, nu=nu, mu=mu, lam=lam)
        super().__init__(youngs_modulus, poissons_ratio, yield_stress, **beyond, **named)

    def check(self, values):
        super().check(values)
        if self.saturating:
            last, first = values["saturation_stress"], values["yield_stress"]
            if last.shape == first.shape or 1 in (last.size, first.size):  # else of sets, not on a mesh yet
                rise = last - first
                check_range("saturation_stress - yield_stress", rise, 0, np.inf, True, "raise saturation_stress")

    def law(self, precision):
        return J2Law(precision, saturating=self.saturating, kinematic=self.kinematic)
