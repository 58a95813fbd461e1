"""An equilibrium that Newton's method does not find at once, along the equilibria that lead there.

What is out of balance at the start, R0, and the way of the held vertices are laid on in parts: a share s of both leaves
R(u) - (1 - s) R0 = 0, which the start solves for s = 0. Shares grow where solves succeed and halve where they fail.
Where no share helps, the path of equilibria may have turned back (a limit point) or branched (a bifurcation).
Allgower, Georg 2003, Introduction to Numerical Continuation Methods, doi:10.1137/1.9780898719154.
"""

import weakref

import numpy as np

from diffsim_ti.solvers.implicit.linear import NotConverged


class LaidOn:
    """Of a workspace whose passes are equilibria."""

    first, least, rounds = 0.25, 2.0**-7, 30  # shares; Newton's rounds in a part

    def __init__(self, workspace):
        self.ws = weakref.proxy(workspace)  # which holds this: no circle

    def __call__(self, u: np.ndarray, held: np.ndarray, problem: tuple, error: NotConverged) -> np.ndarray:
        """The equilibrium with held vertices as in `held`, from that at u; error: what a solve at once said.

        Raises NotConverged, which says how far the path of equilibria goes and how it ends.
        """
        ws, (mass, inertial, loads) = self.ws, problem
        newton, most = ws.newton, ws.newton.max_iterations
        out_of_balance, way = newton.residual_at(u), held - u
        done, share, place = 0.0, self.first, u
        if not np.all(np.isfinite(out_of_balance)):
            raise error
        newton.max_iterations, newton.steady = min(self.rounds, most), 0  # a smaller part costs less than more rounds
        try:
            while done < 1:
                s = min(done + share, 1.0)
                part = loads - (1 - s) * out_of_balance
                try:
                    place, done = newton.solve(place + (s - done) * way, mass, inertial, part, leave_saddles=s == 1), s
                    share *= 2
                except NotConverged:
                    share = 0.5 * min(share, 1 - done)
                    if share < self.least:
                        raise NotConverged(self._why(error, place, done), error.residuals) from None
        finally:
            newton.max_iterations = most
            del newton.steady
        return place

    def _why(self, error: NotConverged, place: np.ndarray, done: float) -> str:
        """In terms of the problem."""
        newton = self.ws.newton
        newton.residual_at(place)
        unstable = done > 0 and not newton.by_residual and newton.is_unstable()
        if unstable:
            end = (
                "and is unstable there, so that the body buckles or snaps to a state far away: give it an imperfection or "
                "a small force that chooses the way"
            )
        else:
            end = (
                "and is not seen to be unstable there: what comes next may lie beyond a limit point, the most that the body "
                "carries, or be too hard for Newton's method: lay on less"
            )
        return (
            f"no equilibrium was found: the path of equilibria from the state before goes to {done:.0%} of what is laid on "
            f"(loads, motion of what is held), {end}, or take a solver with inertia, which follows the jump "
            f"(at once: {len(error.residuals)} rounds, to a relative residual of {error.residuals[-1]:.2g})"
        )
