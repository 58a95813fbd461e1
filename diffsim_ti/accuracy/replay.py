"""Passes of an implicit run at states that are given, and what the equation leaves over there.

A pass solves R(u*) = 0, A = -dR/du, for the place u* where forces are taken. At another place u of the pass, such as the
solution of a coarser mesh, R(u) is not zero, and a number J of the run changes, to first order, by

    J(u*) - J(u) = sum over passes lambda . R(u),    A lambda = dJ/du*,

lambda being what the reverse sweep solves for in each pass.
Becker, Rannacher 2001, An optimal control approach to a posteriori error estimation, doi:10.1017/S0962492901000010.
"""

import weakref
from collections.abc import Sequence

import numpy as np

from diffsim_ti.common.errors import NotConverged
from diffsim_ti.mechanics.supports.free import held_as
from diffsim_ti.solvers.implicit.adjoint import ImplicitAdjoint
from diffsim_ti.solvers.implicit.workspace import ImplicitWorkspace


class Replay:
    """Hooks into the sweep of a rollout, which it belongs to from then on.

    given: displacements u of each pass [m], shape (num_vertices, 3), where passes are to be; None: they are solved.
    solves: begin Newton's method there, instead of staying.
    After a run `places` and `residuals` [N] have u and R of each pass, `sizes` those of the forces that meet at vertices.
    After a reverse sweep `weights` has lambda [1/N times the number].
    """

    def __init__(self, rollout, given: Sequence[np.ndarray] | None = None, solves: bool = False):
        self.rollout, self.given, self.solves, sweep = rollout, given, solves, rollout.sweep
        self.places, self.residuals, self.sizes, self.weights = {}, {}, {}, {}
        sweep.make_workspace = lambda derived: self._joined(sweep.solver.workspace(derived, sweep.bend))
        sweep.make_adjoint = lambda density, shape: _Adjoint(self, sweep.workspace, density, shape)

    def _joined(self, workspace: ImplicitWorkspace) -> ImplicitWorkspace:
        """A workspace whose passes are solved here."""
        proxy = weakref.proxy(workspace)  # no circle
        workspace.solve_pass = lambda *arguments: self._solve_pass(proxy, *arguments)
        return workspace

    def _solve_pass(self, ws, j: int, u, held, starts: list, problem: tuple, stage) -> np.ndarray:
        """See ImplicitWorkspace.solve_pass."""
        there = None
        if self.given is not None:
            there = held_as(ws.free, held, ws.rigid.nearest(self.given[j]))
        if there is not None and self.solves:
            try:
                there = ws.newton.solve(there, *problem, leave_saddles=stage.static)
            except NotConverged:
                there = None
        if there is None:
            there = ImplicitWorkspace.solve_pass(ws, j, u, held, starts, problem, stage)
        ws.potential.place(there)
        self.places[j], self.residuals[j] = there, ws.newton.residual_of(problem)
        self.sizes[j] = ws.potential.forces()[1]
        return there

    def each(self, kind: str) -> list[np.ndarray]:
        """One of these, pass by pass."""
        of = getattr(self, kind)
        return [of[j] for j in range(len(of))]

    def estimate(self) -> float:
        """sum of lambda . R."""
        return float(sum((R * z).sum() for R, z in zip(self.each("residuals"), self.each("weights"))))


class _Adjoint(ImplicitAdjoint):
    exact = 1e-5  # relative residual of its solves: an estimate of an error needs no more

    def __init__(self, replay: Replay, *arguments):
        self.replay, self.at = replay, 0
        super().__init__(*arguments)
        self.tolerance = max(self.tolerance, self.exact)

    def open(self, j, base):
        self.at = j
        super().open(j, base)

    def solve(self, b):
        found = super().solve(b)
        self.replay.weights[self.at] = found
        return found
