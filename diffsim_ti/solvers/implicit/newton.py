"""Newton's method on the incremental potential, of which an implicit step is a minimum.

    Phi(u) = c/2 sum_i m_i |u_i - a_i|^2 + E(u) - sum_i b_i . u_i - W(u),    R = -dPhi/du

W: work of forces without an energy of their own, such as follower pressures. Where these are not symmetric (pressure on
an open surface, drag) there is no Phi, but R: directions come from GMRES, and a step is taken that lowers |R| or, in the
first rounds, along which -R does negative work.
a: where inertia alone would lead [m]; b: dead loads [N]; c = 1 / gamma^2 [1/s^2], zero for statics. Directions come from
conjugate gradients on the exact Hessian. Where that is met to be indefinite they stop with what they have (buckling needs
that), or, if that is early, each tetrahedron's d2psi/dF2 is made positive definite and the direction computed again (crushed
starts need that).
Kane, Marsden, Ortiz, West 2000, doi:10.1002/1097-0207(20001210)49:10<1295::AID-NME993>3.0.CO;2-W.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from diffsim_ti.common.errors import NotConverged
from diffsim_ti.inputs import diagonal_of
from diffsim_ti.mechanics.host_force import NONE, HostForces
from diffsim_ti.mechanics.stress.projection import Projection
from diffsim_ti.mechanics.supports.free import Free, cleaned, linear_of, mask_of
from diffsim_ti.solvers.implicit.linear import Operator, conjugate_gradients, gmres
from diffsim_ti.solvers.implicit.newton_kernels import DONE, MANY
from diffsim_ti.solvers.implicit.rounds import Rounds


@dataclass
class NewtonReport:
    """What a solve took: relative residual before each round, products of the Hessian, rounds with an indefinite
    Hessian, saddles that were left, evaluations of the energy, halvings in line searches, directions that an obstacle, or
    the surface itself, cut short."""

    residuals: list = field(default_factory=list)
    products: int = 0
    indefinite: int = 0
    saddles: int = 0
    trials: int = 0
    halvings: int = 0
    cuts: int = 0
    place: np.ndarray | None = None  # where a solve that failed ended


class Newton:
    """Minimises Phi from a start. From iterate to iterate the surface meets no obstacle
    (obstacles/collision_detection.py) and does not pass through itself. If the start has no J <= 0, J falls by a factor
    of ten at most, so that the energy's own resistance acts in time; only where no share of a direction down to
    `insist` lowers Phi so (a law that is finite at J = 0, pressed beyond it) may it fall further.

    tolerance: |R| over the size of the forces that meet at the vertices (corner by corner, so that it does not vanish
    at equilibrium), loads and inertia, all of the present round: where a solve began is no measure of where it ends. Beyond
    it goes only what rounding allows, of displacements as large as those that the solve began with or has come to.
    """

    insist = 2.0**-10
    trusted = 10  # iterations after which the direction before an indefinite one is good enough
    slight = 0.01, 0.0  # which negative eigenvalues of tetrahedra may stay (projection.py), the second where that fails
    # relative residual of the linear solves of the last rounds, or the root of the round's own if that is less; of those
    # before at most (`NewtonKernels.force`)
    inexact, rough = 1e-3, 0.1
    roughly = 0.03
    patience = 6  # times as many rounds as asked for, at most (`_goes_on`)
    steady = 10  # rounds that halve the residual while more than asked for are taken; 0: none are
    by_work = 30  # rounds in which work may stand for a potential that is not there; later it might lead in circles
    shortest = 2.0**-40  # fraction of a direction below which a line search gives up
    indefinite = False  # whether the Hessian of the host's last direction was, or is taken for it again
    going = True  # which bodies are looked at

    def __init__(
        self,
        potential,
        free: Free,
        way,
        preconditioners,
        tolerance: float,
        max_iterations: int,
        eps: float,
        others: HostForces = NONE,
        volumes=None,
    ):
        self.volumes = volumes  # of chambers, that are held (multipliers.py), or None
        self.others = others  # host forces without an energy
        self.moves = mask_of(free)  # in some direction
        self.potential, self.free, self.collisions, self.preconditioners = potential, free, way, preconditioners
        self.tolerance, self.max_iterations, self.eps = tolerance, max_iterations, eps
        self.reach = 0.01 * float(np.ptp(potential.arrays.values.rest, 0).max())  # of the first step away from a saddle
        self.report, self.reports = NewtonReport(), []  # of the last solve, of all since the last report
        self.rigid = potential.rigid  # sets that do not deform

    @property
    def by_residual(self) -> bool:
        """Whether there is no potential: of forces, or of rigid sets whose forces are not taken where a pass ends."""
        return not self.operator().symmetric

    def solve(
        self,
        start: np.ndarray,
        mass: np.ndarray,
        inertial: np.ndarray,
        loads: np.ndarray,
        leave_saddles: bool = False,
        rounds: int | None = None,
    ) -> np.ndarray:
        """The minimiser; mass = c m, shape (num_vertices, 1). The potential stays placed there.

        rounds: stop after so many, wherever that is, or once it is `roughly` there.

        leave_saddles: where Phi is stationary but falls in some direction (a column beyond its buckling load), go on
        that way; `report.saddles` counts it.

        Raises NotConverged.
        """
        self.report = report = NewtonReport()
        self.reports.append(report)
        self.indefinite = False
        self.pose((mass, inertial, loads))
        u = self.potential.place(start)
        if self.volumes:
            self.volumes.place(u, self.volumes.multipliers)
        most, done, here = self.max_iterations if rounds is None else rounds, report.residuals, self.loop
        here.start(self, 0.0 if rounds is None else self.roughly, most)
        while True:
            phase, norm, floor, solved = here.run(most)
            if phase == DONE:
                downhill = self._downhill() if leave_saddles and not self.by_residual else None
                if downhill is None:
                    return here.end()
                report.saddles += 1
                here.go(*downhill)
            elif phase == MANY:
                last = done.pop()
                if not self._goes_on(most, rounds is None):
                    break
                done.append(last)
                here.go_on()
            elif not np.isfinite(norm) or not self.volumes or not here.stiffen():
                break
        u = here.end()
        near = norm <= 100 * floor and (not self.volumes or self.volumes.met(u, 100.0))
        if solved or near or (rounds is not None and np.isfinite(norm)):  # rounding has the last word
            return u
        report.place = u
        raise NotConverged(self._why(done), done)

    @property
    def loop(self) -> Rounds:
        """What takes the rounds with the present preconditioner."""
        if self.preconditioner.rounds is None:
            self.preconditioner.rounds = Rounds(self, self.preconditioner)
        return self.preconditioner.rounds

    def _why(self, done: list) -> str:
        """What a solve that failed says, and what helps: more rounds where they gained to the last."""
        statics, gains = not diagonal_of(self.mass).any(), len(done) < 2 or done[-1] < 0.5 * done[-2]
        remedy = f"pass max_iterations={max(4 * len(done), 50)}, " if len(done) >= self.max_iterations and gains else ""
        if statics:
            remedy += (
                "take more load steps or a smaller load; where the equilibrium is unstable (it buckles or snaps) follow the "
                "motion to the next one instead, by ImplicitEulerSolver with Drag"
            )
        else:
            remedy += "take smaller steps"
        history = ", ".join(f"{r:.2g}" for r in done[-8:])
        return (
            f"Newton's method stopped after {len(done)} rounds at a relative residual of {done[-1]:.2g} (asked for "
            f"{self.tolerance:g}; the last ones: {history}): {remedy}"
        )

    def _goes_on(self, most: int, to_the_end: bool) -> bool:
        """Whether there is another round: those that obstacles cut short do not count, and those that gain are not the last
        where the solve is to reach its tolerance."""
        done, many = self.report.residuals, len(self.report.residuals)
        if many < min(most + self.report.cuts, self.patience * most):
            return True
        slow = self.steady and to_the_end and self.steady < many < self.patience * most
        return bool(slow and done[-1] < 0.5 * done[-1 - self.steady])

    def is_unstable(self) -> bool:
        """Whether Phi falls in some direction where the potential stands."""
        return self._downhill() is not None

    def follows(self, u: np.ndarray, change: np.ndarray, way: np.ndarray, tolerance: float = 0.01) -> np.ndarray | None:
        """How the equilibrium at u goes on for a change of loads [N] and a motion of fixed vertices, linearised there, with
        the mass of the last solve; None where it is not stable."""
        self.potential.place(u)
        A = self.operator()
        self.preconditioner.update(u)
        R = (change - A.of_places(way)) * self.free
        d, *_, negative = conjugate_gradients(A, R, self.preconditioner, tolerance, 10 * len(R), self.eps)
        return d + way if negative is None else None

    def residual_at(self, u: np.ndarray) -> np.ndarray:
        """-dPhi/du of the last solve [N]."""
        self.potential.place(u)
        return self.residual(u)[0]

    def residual_of(self, problem: tuple) -> np.ndarray:
        """The same where the potential stands, of mass, inertial and loads of `solve`."""
        self.mass, self.inertial, self.loads = problem
        return self.residual(self.potential.held_at)[0]

    def operator(self) -> Operator:
        """The Hessian of Phi where the potential stands."""
        return Operator(self.potential, self.mass, self.free, self.others)

    def system(self) -> tuple | None:
        """(diagonal mass, SciPy matrix of blocks or None) that join the potential's Hessian; None where a product needs the
        host, or more than Newton's direction is looked for."""
        found = None if self.volumes else self.operator().on_device()
        return found and found[:2]

    def balance(self, u, mass, inertial, loads):
        """(-dPhi/du of a problem where the potential stands, of all vertices [N]; sizes of the forces that meet at each)."""
        f, sizes = self.potential.forces()
        if self.others:
            f, sizes = f + self.others.forces(u), sizes + self.others.sizes(u)
        return f + loads - mass * (u - inertial), sizes

    def residual(self, u) -> tuple[np.ndarray, np.ndarray]:
        """(R, shape (num_vertices, 3); the root of the squares of the forces at each vertex that it is measured by)"""
        R, sizes = self.balance(u, self.mass, self.inertial, self.loads)
        inertia = self.mass * (u - self.inertial)
        self.rigid.take_forces(R)
        return R * self.free, np.sqrt(sizes**2 + (self.loads**2 + inertia**2 * self.moves).sum(1))

    def step(self, u, R, forcing):
        """(direction, R): Newton's, towards the volumes that are held, and the residual that it goes down by."""
        direction, R = self._direction_of(u, R, forcing)
        direction, joints = cleaned(linear_of(self.free), direction), self.potential.joints
        return joints.extended(direction) if joints else direction, R

    def _direction_of(self, u, R, forcing):
        A = self.operator()
        balanced = self.volumes.predicted(u, R, self.stiffness) * self.free if self.volumes else R
        direction = self._direction(A, balanced, forcing)
        if self.volumes:
            done = A.products
            least, limit = min(forcing, self.inexact), 10 * len(R)

            def solve(g):
                g = g * self.free
                if self.by_residual:
                    return self.rigid.motion(gmres(A, g, self.preconditioner, least, limit)[0])
                return conjugate_gradients(A, g, self.preconditioner, least, limit, self.eps)[0]

            direction, change, self._rise = self.volumes.bordered(u, direction, solve)
            self.report.products, R = self.report.products + A.products - done, R + change
        return direction, R

    def recount(self, u, step, direction) -> None:
        """Multipliers go as far as a step from u along a direction that was found."""
        share = float((step * direction).sum()) / max(float((direction * direction).sum()), 1e-300)
        self.volumes.arrive(u + step, min(max(share, 0.0), 1.0), self._rise)

    def _direction(self, A, R, forcing):
        limit = 10 * len(R)
        if self.by_residual:
            self.indefinite = False
            d, *_ = gmres(A, R, self.preconditioner, forcing, limit)
            self.report.products += A.products
            return self.rigid.motion(d)
        count, negative = 0, self.indefinite
        if not self.indefinite:
            d, _, count, negative = conjugate_gradients(A, R, self.preconditioner, forcing, limit, self.eps)
            self.indefinite = negative is not None
            self.report.indefinite += self.indefinite
        if self.indefinite:
            if count <= self.trusted and not A.saddle_is_known:
                for slight in self.slight:
                    A.correction = Projection(self.potential, slight)
                    d, *_, negative = conjugate_gradients(A, R, self.preconditioner, forcing, limit, self.eps)
                    if negative is None:
                        break
        self.report.products += A.products
        return d

    def _downhill(self):
        """A direction of negative curvature, found by solving for something random, and a slope for its search."""
        self.potential.place(self.potential.held_at)  # with the stiffness of friction as it is
        probe = np.random.default_rng(0).standard_normal((len(self.moves), 3)) * self.free
        A = self.operator()
        self.preconditioner.update(self.potential.held_at)
        _, _, _, p = conjugate_gradients(A, probe, self.preconditioner, 1e-3, 10 * len(probe), self.eps)
        self.report.products += A.products
        if p is None:
            return None
        p, self.indefinite = p * (self.reach / np.abs(p).max()), True
        return p, -p * float((p * A(p)).sum()) / float((p * p).sum())

    def is_free(self, u, step) -> bool:
        """Whether nothing is met on the way of a step."""
        pairs = self.potential.pairs
        return self.collisions(u, step, 1.0)[0] == 1 and (not pairs or pairs.safe_share(u, step) == 1)

    def rises_from(self, u: np.ndarray, problem: tuple) -> Callable[[list], np.ndarray]:
        """places -> how much higher Phi of each body is there than at u (`Rounds.rises`). Forces without an energy do no
        more work on the way than at u."""
        self.pose(problem)
        here = self.loop
        here.stand(self, u)
        return here.rises

    def pose(self, problem: tuple) -> None:
        """What is solved: mass, inertial and loads of `solve`."""
        self.mass, self.inertial, self.loads = problem
        if self.potential.joints:
            self.potential.joints.take(problem)
        self.preconditioner, self.stiffness = self.preconditioners(self.mass)
