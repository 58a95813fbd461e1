"""What a run of an implicit solver asks of obstacles on the way of a step, and how it says what they stopped."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.errors import NotConverged
from diffsim_ti.mechanics.obstacles.blocked import Blocked
from diffsim_ti.mechanics.surfaces.surface_pairs import Tunnelling
from diffsim_ti.state.stage import Stage


class ObstacleWays:
    """A part of ImplicitWorkspace: ways past obstacles, at rest and in motion."""

    def way_past_obstacles(self, u, step, most: float = 1.0) -> tuple:
        """(how far along a step no obstacle is met where obstacles are in the pass, what would be met then)."""
        share = self.way.share(u, step, self._walls[::3], most=most)
        return share, self.way.met

    def put_obstacles(self, places: np.ndarray) -> None:
        """Take forces with obstacles elsewhere."""
        self._walls[::3] = places
        if len(places):
            runtime.fill(self.potential.walls, self._walls)

    def check_apart(self) -> None:
        """Raise Overlap if a face is in an obstacle, which vertices alone do not show."""
        u, walls = runtime.fetch_row(self.state.u, 0), runtime.fetch(self.arrays.offsets)[::3].astype(np.float64)
        faces = self.potential.faces
        if faces is None:
            self.way.check_apart(u, walls)
        else:
            faces.begin(self.way.check_apart(u, walls, 2 * faces.reach.max(initial=0)))

    def _walls_at_end(self, j: int) -> np.ndarray:
        """Displacements of the obstacles at the end of pass j."""
        return self.walls(self.arrays.rows["path"], j, Stage(1.0))[::3]

    def _check_end(self, j: int, u_star, u_next) -> None:
        """Raise Tunnelling where surfaces, or a surface and an obstacle, meet beyond the middle of a step."""
        if self.pairs:
            self.pairs.check_end(u_star, u_next)
        drift = self.arrays.walls.drift(self._walls[::3], self._walls_at_end(j))
        if self.way.share(u_star, u_next - u_star, self._walls[::3], drift) == 1:
            return
        met = self.way.met
        speed = self._speed(met, u_star, u_next - u_star, self._walls[::3], drift) / 0.5
        raise Tunnelling(
            f"beyond the middle of a step, where its forces were taken, {met} meets "
            f"{self.way.terms[met.obstacle]!r} at {speed:.4g} m/s: take a solver whose steps end where forces are "
            "taken, ImplicitEulerSolver or BDF2Solver"
        )

    def _speed(self, met, u, step, places, drift) -> float:
        """How fast a vertex or face and an obstacle meet that do so in a pass [m/s]."""
        own = list(met.vertices)
        carried = self.carried(met.obstacle, u[own], places, drift, own)
        return float(np.linalg.norm(step[own] - carried, axis=1).max() / self.substep)

    def carried(self, obstacle: int, u, places, drift, vertices=slice(None)) -> np.ndarray:
        """How far an obstacle takes vertices that it holds at displacements u."""
        points, about = self.arrays.values.rest[vertices] + u, self.way.terms[obstacle].about
        return self.arrays.walls.way_at(obstacle, places, drift, points, about)

    def _explained(self, error: NotConverged, u) -> NotConverged:
        """The error, or what stood in the way."""
        report = self.newton.report
        if isinstance(error, Blocked) or report.place is None or not report.cuts:
            return error
        met = self.way.nearest(report.place, self._walls[::3], self.way.widest)
        if met is None:
            return error
        drift = self.arrays.walls.drift(self.walls_before, self.walls_at_stage)
        speed = self._speed(met, u, report.place - u, self.walls_before, drift)
        return Blocked.at_an_obstacle(self, error, report.place, met, speed)

    def gap_of(self, met, u) -> float:
        """Distance [m] of what stands before an obstacle."""
        near = self.way.nearest(u, self._walls[::3], self.way.widest)
        return near.value if near is not None else self.way.widest

    def width_of(self, obstacle: int) -> float:
        """The width [m] of an obstacle's barrier, as loaded."""
        return self.way.widths[obstacle]
