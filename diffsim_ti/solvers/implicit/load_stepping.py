"""Load stepping of a pass that Newton's method does not solve in one solve, along the solutions that lead there.

The load of the pass comes in parts: at a share s, static solves take that share of the change of loads, pressures,
growth and times, and all passes that of the motion of fixed vertices and obstacles. What is out of balance where the pass
begins all the same, R0 (inertia; loads that jump from step to step), is applied with it: R(u, s) - (1 - s) R0 = 0,
which the start solves for s = 0. Shares grow where solves succeed and halve where they fail. Where no share helps, the
path of equilibria may have turned back (a limit point) or branched (a bifurcation).
Allgower, Georg 2003, Introduction to Numerical Continuation Methods, doi:10.1137/1.9780898719154.
"""

import weakref

import numpy as np

from diffsim_ti.common.errors import NotConverged
from diffsim_ti.state.stage import Stage


class LoadStepping:
    """Of a workspace."""

    first, rounds = 0.25, 30  # share; Newton's rounds in a part
    nearly, least, in_motion = 0.005, 2.0**-13, 2.0**-5  # smallest: of what is reached, of statics, of others

    def __init__(self, workspace):
        self.ws = weakref.proxy(workspace)  # which holds this: no circle

    def __call__(self, j: int, stage: Stage, u, held, problem: tuple, error: NotConverged) -> np.ndarray:
        """The solution of pass j with fixed vertices as in `held`, from u; error: what the solve without load stepping said.

        Raises it or, in statics, NotConverged, which says how far the path of equilibria goes and how it ends.
        """
        ws, newton, (mass, inertial, loads) = self.ws, self.ws.newton, problem
        most, poses = newton.max_iterations, (ws.collisions.before, ws.collisions.at_stage)
        drift, way = ws.arrays.poses.drift(*poses), held - u
        done, share, place = 0.0, self.first, u

        def apply_loads(s: float) -> tuple:
            ws.collisions.put(ws.arrays.poses.moved(poses[0], drift, s))
            ws.apply_loads(j, stage, s)
            return mass, inertial, ws.loads(j, stage) if stage.static else loads

        newton.max_iterations, newton.steady = min(self.rounds, most), 0  # a smaller part costs less than more rounds
        try:
            ws.start_multipliers(j, u)
            ws.potential.place(u)
            out_of_balance = newton.residual_of(apply_loads(0.0))
            if not np.all(np.isfinite(out_of_balance)):
                raise error
            while done < 1:
                s = min(done + share, 1.0)
                part = apply_loads(s)
                part = *part[:2], part[2] - (1 - s) * out_of_balance
                ws.collisions.before, ws.collisions.at_stage = (
                    ws.arrays.poses.moved(poses[0], drift, x) for x in (done, s)
                )
                try:
                    near = ws.approach(place, place + (s - done) * way, [], part)
                    there = newton.solve(near, *part, leave_saddles=stage.static and s == 1)
                    ws.check_upright(place, there)
                    place, done, share = there, s, 2 * share
                except NotConverged:
                    share = 0.5 * min(share, 1 - done)
                    if stage.static and share < max(self.nearly * ws.reached(j, stage, done), self.least):
                        shares = self._share_of_loads(j, stage, done)
                        ws.potential.place(place)
                        newton.residual_of(apply_loads(done))
                        why = self._why(error, *shares)
                        raise NotConverged(why, error.residuals) from None
                    if not stage.static and share < self.in_motion:
                        raise error from None
        finally:
            newton.max_iterations = most
            del newton.steady
            ws.collisions.before, ws.collisions.at_stage = poses
            apply_loads(1.0)
        return place

    def _share_of_loads(self, j: int, stage: Stage, done: float) -> tuple[float, float]:
        """(of the load that its step ends with, of what the step adds). In the first step loads that change in time, too,
        grow faster than its share."""
        ws, schedule = self.ws, self.ws.solver.schedule
        added, row = ws.reached(j, stage, done), schedule.row(j)
        first, now = int(schedule.first(row)), self._load(int(schedule.first(row + 1)) - 1, stage)
        if ws.volumes or not now.any() or ws.pass_of_all(j) != j and not first:
            return added, added  # motions alone, or a step whose load before is not known
        if first:
            before = self._load(first - 1, stage)
            here = before + added * (now - before)
        else:
            here = self._load(j, stage, done)
        return float(np.linalg.norm(here) / np.linalg.norm(now)), added

    def _load(self, j: int, stage: Stage, share: float = 1.0) -> np.ndarray:
        """Loads [N] at a share of pass j, those that follow the surface as at rest."""
        self.ws.apply_loads(j, stage, share)
        forces = self.ws.loads(j, stage)
        return forces + self.ws.newton.others.forces(np.zeros_like(forces))

    def _why(self, error: NotConverged, reached: float, added: float) -> str:
        """What the path of equilibria means for the problem; at which shares it ends, as `_share_of_loads` has them."""
        newton = self.ws.newton
        if reached > 0 and not newton.by_residual and newton.is_unstable():
            end = (
                "and is unstable there, so that the body buckles or snaps to a state far away: give it an imperfection or "
                "a small force that chooses the direction"
            )
        else:
            end = (
                "and is not seen to be unstable there: what comes next may lie beyond a limit point, the most that the body "
                "carries, which `load_path` finds and passes, or be too hard for Newton's method: apply a smaller load"
            )
        more = "" if abs(added - reached) < 1e-3 else f" ({100 * added:.3g}% of what the step adds to them)"
        return (
            f"no equilibrium was found: the path of equilibria from the state before goes to {100 * reached:.3g}% of the "
            f"step's loads and prescribed motion{more}, {end}, or take a solver with inertia, which follows the jump "
            f"(without load stepping: {len(error.residuals)} rounds, to a relative residual of {error.residuals[-1]:.2g})"
        )
