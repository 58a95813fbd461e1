"""What is noted of the solves of an implicit run: what they took, and whether statics left a branch of equilibria."""

import weakref

import numpy as np

from diffsim_ti.common.warn import warn
from diffsim_ti.state.solve_report import Buckled


class Noted:
    """Of a workspace."""

    explained, softened = 2.0, 10.0  # times what tangents at both ends, or before, say: farther is another branch
    usual = 8  # rounds of a solve that leaves no branch

    def __init__(self, workspace):
        self.ws = weakref.proxy(workspace)  # which holds this: no circle

    def note(self, j: int, num_passes: int, seconds: float, begin: tuple) -> None:
        """What pass j took; statics say where they left a branch of stable equilibria. begin: where the pass began, the same
        with fixed vertices where they got, and its problem."""
        step, solves = self.ws.step_of(j, num_passes), self.ws.newton.reports
        self.ws.report.note(step, seconds, solves)
        saddles, unstable = (sum(getattr(solve, name) for solve in solves) for name in ("saddles", "indefinite"))
        rounds = [max(len(solve.residuals) - 1, 0) for solve in solves]
        far = unstable or max(rounds, default=0) > self.usual  # full steps may leap over the states that are not stable
        # whose curved barriers, and states beside the volumes that are held, are indefinite where nothing buckles
        if self.ws.arrays.contacts or self.ws.pairs or self.ws.volumes:
            far = False
        if self.ws.is_static and (saddles or far) and self._left_a_branch(j, *begin, saddles):
            left = f"{saddles} saddle{'s' * (saddles > 1)} left: the body was in balance and not stable, as when it buckles"
            if not saddles:
                left = (
                    "the body went much farther than its stiffness explains: it has buckled or snapped on the way "
                    f"({unstable} of {sum(rounds)} rounds of Newton's method met states that are not stable; follow it by "
                    "more load_steps)"
                )
            went = "it went to a lower equilibrium, which may be one of several, and gradients are of it"
            said = f"step {step}: {left}; {went}"
            warn(Buckled(said, step, saddles, unstable))

    def _left_a_branch(self, j: int, u, held, problem: tuple, saddles: int) -> bool:
        """Whether the equilibrium of pass j is farther from that before it than the tangents at both explain. On one smooth
        branch it is as far as the tangents between are long in the mean, so that somewhere between it was much softer than
        at both ends: near a limit point or a bifurcation. Where a saddle was left, or the tangent before says next to
        nothing, that alone decides: just beyond a bifurcation the tangent is long."""
        newton, here = self.ws.newton, self.ws.u_star
        self.ws.potential.place(u)
        change, far = newton.residual_of(problem), np.linalg.norm(here - u)
        for place in (u, here):
            way = newton.follows(place, change, held - u)
            if way is None and place is u and self.ws.pass_of_all(j) == 0 and not self._was_stable(j):
                return False
            size = np.inf if way is None else np.linalg.norm(way)
            if way is not None and far <= self.explained * size:
                return False
            if place is u and (saddles or far > self.softened * size):
                return True
        return True

    def _was_stable(self, j: int) -> bool:
        """Whether the potential stands at a stable state before pass j applies any load."""
        stage = self.ws.solver.stage(self.ws.rate, True, j)
        self.ws.apply_loads(j, stage, 0.0)
        stable = not self.ws.newton.is_unstable()
        self.ws.apply_loads(j, stage)
        return stable
