"""Where obstacles are in a pass of an implicit run, what is asked of them on the way of a step, and what they stopped."""

import weakref

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.errors import NotConverged
from diffsim_ti.mechanics.obstacles.blocked import Blocked
from diffsim_ti.mechanics.obstacles.collision_detection import CollisionDetection, Met
from diffsim_ti.mechanics.surfaces.surface_pairs import Tunnelling
from diffsim_ti.state.obstacle_poses import AT_STAGE, Moment
from diffsim_ti.state.stage import Stage


class ObstacleCollisions:
    """Of a workspace. rows: of its obstacles in the pass (state/obstacle_poses.py); before, at_stage: displacements of
    theirs where the pass begins and where it takes forces."""

    detection_kind = CollisionDetection

    def __init__(self, workspace):
        self.ws = weakref.proxy(workspace)  # which holds this: no circle
        self.detection = self.detection_kind(workspace.arrays, workspace.parallel)

    # ---- in a pass ---------------------------------------------------------------------------------------------------

    def begin(self, j: int, stage: Stage) -> None:
        """Pass j."""
        poses, path, joints = self.ws.arrays.poses, self.ws.arrays.rows["path"], self.ws.joints
        moment = None if path is None else self.moment(j, stage)
        poses.check(path, moment)
        self.rows = poses.value(path, moment)
        if joints:
            joints.begin(j, stage, self.rows)
        self.at_stage, self.before = self.rows[::3].copy(), self.rows[1::3].copy()

    def moment(self, j: int, stage: Stage) -> Moment:
        """Where pass j lies for obstacles; a chord of two passes about its end for a solver of two steps."""
        schedule, at_stage = self.ws.solver.schedule, self.ws.share_at_stage(j, stage)
        begin = schedule.begin(j)
        tau = (at_stage - begin) * float(schedule.step_length(j)) * (2 if stage.a1 else 1)
        return Moment(schedule, j, at_stage, begin, tau)

    def jvp(self, dpath: np.ndarray | None, j: int, stage: Stage) -> np.ndarray:
        """Change of the rows."""
        return self.ws.arrays.poses.jvp(self.ws.arrays.rows["path"], dpath, self.moment(j, stage))

    def vjp(self, rows_adj: np.ndarray, j: int, stage: Stage, path_adj: np.ndarray) -> None:
        """Add the adjoints of the rows of paths."""
        self.ws.arrays.poses.vjp(self.ws.arrays.rows["path"], rows_adj, self.moment(j, stage), path_adj)

    def at_end(self, j: int) -> np.ndarray:
        """Displacements of the obstacles at the end of pass j."""
        arrays = self.ws.arrays
        return arrays.poses.value(arrays.rows["path"], self.end_of(j))[::3]

    def end_of(self, j: int) -> Moment:
        """The end of pass j."""
        return self.moment(j, Stage(1.0))

    # ---- on the way of a step ----------------------------------------------------------------------------------------

    def past(self, u, step, most: float = 1.0) -> tuple:
        """(how far along a step no obstacle is met where obstacles are in the pass, what would be met then)."""
        drift = self.ws.joints.drift(u, step) if self.ws.joints else 0.0
        share = self.detection.share(u, step, self.rows[::3], drift, most)
        return share, self.detection.met

    def pairs_share(self, u, step, places, drift, most: float) -> tuple[float, Met | None]:
        """How far along a step, at most `most`, pairs stay apart while obstacles go from places by a drift, and what would
        meet then."""
        pairs = self.ws.pairs
        share = pairs.safe_share(u, step, most, self._pairs_go(places, drift))
        met = pairs.met if share < most else None
        return share, met and Met(*met, share)

    def _pairs_go(self, places, drift) -> np.ndarray:
        """Put obstacles that act by pairs to where they begin: the rows to where they go."""
        rows, to = np.zeros_like(self.rows), np.zeros_like(self.rows)
        rows[::3], to[::3] = places, self.ws.arrays.poses.moved(places, drift, 1.0)
        self.ws.pairs.follow(rows, AT_STAGE)
        return to

    def put(self, places: np.ndarray) -> None:
        """Take forces with obstacles elsewhere."""
        self.rows[::3] = places
        if self.ws.joints:
            self.ws.joints.forget()
        if len(places):
            runtime.fill(self.ws.potential.poses, self.rows)
        if self.ws.pairs:
            self.ws.pairs.follow(self.rows, AT_STAGE)

    def check_apart(self) -> None:
        """Raise Overlap if a vertex is in an obstacle."""
        u, poses = runtime.fetch_row(self.ws.state.u, 0), runtime.fetch(self.ws.arrays.offsets)[::3].astype(np.float64)
        self.detection.check_apart(u, poses)

    def check_end(self, j: int, u_star, u_next) -> None:
        """Raise Tunnelling where surfaces, or a surface and an obstacle, meet beyond the middle of a step."""
        pairs, drift = self.ws.pairs, self.ws.arrays.poses.drift(self.rows[::3], self.at_end(j))
        if pairs:
            along = dict(to=self._pairs_go(self.rows[::3], drift)) if pairs.obstacles else {}
            pairs.check_end(u_star, u_next, **along)
        if self.detection.share(u_star, u_next - u_star, self.rows[::3], drift) == 1:
            return
        met = self.detection.met
        speed = self._speed(met, u_star, u_next - u_star, self.rows[::3], drift) / 0.5
        raise Tunnelling(
            f"beyond the middle of a step, where its forces were taken, {met} meets "
            f"{self.detection.terms[met.obstacle]!r} at {speed:.4g} m/s: take a solver whose steps end where forces are "
            "taken, ImplicitEulerSolver or BDF2Solver"
        )

    def _speed(self, met, u, step, places, drift) -> float:
        """How fast a vertex or face and an obstacle meet that do so in a pass [m/s]."""
        own = list(met.vertices)
        carried = self.carried(met.obstacle, u[own], places, drift, own)
        return float(np.linalg.norm(step[own] - carried, axis=1).max() / self.ws.substep)

    def carried(self, obstacle: int, u, places, drift, vertices=slice(None)) -> np.ndarray:
        """How far an obstacle takes vertices that it holds at displacements u."""
        points, about = self.ws.arrays.values.rest[vertices] + u, self.detection.terms[obstacle].about
        return self.ws.arrays.poses.displacement_of(obstacle, places, drift, points, about)

    def explained(self, error: NotConverged, u) -> NotConverged:
        """The error, or what stood in the way."""
        report = self.ws.newton.report
        if isinstance(error, Blocked) or report.place is None or not report.cuts:
            return error
        met = self.detection.nearest(report.place, self.rows[::3], self.detection.widest)
        if met is None:
            return error
        drift = self.ws.arrays.poses.drift(self.before, self.at_stage)
        speed = self._speed(met, u, report.place - u, self.before, drift)
        return Blocked.at_an_obstacle(self.ws, error, report.place, met, speed)

    def gap_of(self, met, u) -> float:
        """Distance [m] of what stands before an obstacle."""
        near = self.detection.nearest(u, self.rows[::3], self.detection.widest)
        return near.value if near is not None else self.detection.widest
