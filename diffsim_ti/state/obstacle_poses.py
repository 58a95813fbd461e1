"""Where obstacles are in a pass, rows of three numbers that kernels read, with tangent and adjoint, on the host.

Obstacle k has rows 3 k, 3 k + 1 and 3 k + 2: its displacement where forces are taken, that where the pass begins, its
velocity. Those that turn have six more behind all of these: modified Rodrigues parameters of both rotations, the angular
velocity, and, as the last, (tau, 0, 0), the time of the chord of its velocity (turned.py). Changes of rotations are theta,
dR = [theta]x R. Every third row is where obstacles are: `places`; how they go from there is `drifts`, of rotations psi.
"""

from typing import NamedTuple

import numpy as np

from diffsim_ti.common import rotations
from diffsim_ti.differentiation.arrays import Recorded, forward, made, reverse, value_of
from diffsim_ti.state.schedule import Schedule

MORE = 6  # rows of an obstacle that turns
AT_STAGE, AT_BEGIN, RATE = range(3)  # rows of displacements, and of rotations
TAU = 5  # of those of one that turns


def _at_share(s: np.ndarray, phi: np.ndarray, share: float) -> np.ndarray:
    """Modified Rodrigues parameters of R(share phi) R, from those of R; in kernels turning.py. Of arrays that record, too:
    changes of rotations are theta."""
    now, way = value_of(s), share * value_of(phi)
    turn, J = rotations.quaternion(way), lambda: share * rotations.left_jacobian(way)
    back = lambda by: rotations.turned(rotations.conjugate(turn), by)  # noqa: E731
    parents = (s, lambda theta: rotations.turned(turn, theta), back), (phi, lambda d: J() @ d, lambda by: J().T @ by)
    return made(rotations.rodrigues(rotations.product(turn, rotations.from_rodrigues(now))), *parents)


class Moment(NamedTuple):
    """Pass j, the shares of its step at which forces are taken and at which it begins, and tau [s]."""

    schedule: Schedule
    j: int
    at_stage: float
    begin: float
    tau: float = 0.0


class ObstaclePoses:
    """obstacles: as `SceneArrays.obstacles`; rows of paths are columns of `inputs/poses.py`. away: what each obstacle's
    displacements have less, shape (obstacles, 3) [m] (origin.py)."""

    def __init__(self, obstacles: list[tuple], away: np.ndarray):
        self.away = away
        self.columns = [(k, c) for k, (_, _, c) in enumerate(obstacles) if c >= 0]
        turning = [(k, c) for k, (force, _, c) in enumerate(obstacles) if force.turns]
        rows = [3 * len(obstacles) + MORE * n for n in range(len(turning))]
        self.turning = [(row, c) for row, (_, c) in zip(rows, turning) if c >= 0]  # robots write those of others
        self.size = 3 * len(obstacles) + MORE * len(turning)
        self.place_of = {k: row // 3 for (k, _), row in zip(turning, rows)}  # of obstacle k among places

    def check(self, path: np.ndarray | None, at: Moment | None) -> None:
        """Raise ValueError for a pass in which an obstacle turns farther than its motion is resolved."""
        for _, c in self.turning:
            most = np.linalg.norm(path[at.schedule.row_of(path, at.j), c + 2]) * (at.schedule.end(at.j) - at.begin)
            if most > 3.1:
                raise ValueError(
                    f"an obstacle turns by {most:.3g} rad in a substep, which must be less than half a turn: take "
                    "smaller steps"
                )

    def value(self, path: np.ndarray | None, at: Moment | None) -> np.ndarray:
        """The rows, shape (size, 3); without a path all zero."""
        out = np.zeros((self.size, 3))
        if path is not None:
            out = [*out]
            schedule, s = at.schedule, at.schedule.row_of(path, at.j)
            moments = (
                schedule.place(path, at.j, at.at_stage),
                schedule.place(path, at.j, at.begin),
                schedule.rate(path, at.j),
            )
            for k, c in self.columns:
                out[3 * k : 3 * k + 3] = (x[c] for x in moments)
            for row, c in self.turning:
                phi = path[s, c + 2]
                for m, share in ((AT_STAGE, at.at_stage), (AT_BEGIN, at.begin)):
                    out[row + m] = _at_share(path[s, c + 1], phi, share)
                out[row + RATE] = phi / schedule.step_length(at.j)
                out[row + TAU] = np.array([at.tau, 0.0, 0.0])
            out = np.stack(out)
        return out

    def row_of(self, k: int, rows: np.ndarray) -> np.ndarray:
        """Where obstacle k is where forces are taken: 3 numbers, or 7 of a pose."""
        shift = rows[3 * k] + self.away[k]
        if k not in self.place_of:
            return shift
        return np.concatenate([shift, rotations.from_rodrigues(rows[3 * self.place_of[k]])])

    def velocity_at(self, k: int, rows: np.ndarray, point: np.ndarray, about: np.ndarray) -> np.ndarray:
        """Of obstacle k at a point [m/s]."""
        if k not in self.place_of:
            return rows[3 * k + RATE]
        return rows[3 * k + RATE] + np.cross(
            rows[3 * self.place_of[k] + RATE], point - rows[3 * k] - self.away[k] - about
        )

    # ---- places ------------------------------------------------------------------------------------------------------

    def drift(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """How obstacles go from places to others, the short way."""
        out = after - before
        for at in self.place_of.values():
            a, b = rotations.from_rodrigues(before[at]), rotations.from_rodrigues(after[at])
            out[at] = rotations.vector(rotations.product(b, rotations.conjugate(a)))
        return out

    def moved(self, places: np.ndarray, drift: np.ndarray, share: float) -> np.ndarray:
        """Where they are when the share of a drift is done."""
        out = places + share * drift
        for at in self.place_of.values():
            out[at] = _at_share(places[at], drift[at], share)
        return out

    def displacement_of(
        self, k: int, places: np.ndarray, drift: np.ndarray, points: np.ndarray, about: np.ndarray
    ) -> np.ndarray:
        """How far obstacle k takes points [m] that it holds on a drift, shape (points, 3)."""
        out = np.tile(drift[k], (len(points), 1))
        if k in self.place_of:
            arm = points - places[k] - self.away[k] - about
            out += rotations.turned(rotations.quaternion(drift[self.place_of[k]]), arm) - arm
        return out

    # ------------------------------------------------------------------------------------------------------------------

    def jvp(self, path: np.ndarray | None, dpath: np.ndarray | None, at: Moment) -> np.ndarray:
        """Change of the rows."""
        leaf = None if dpath is None else Recorded(path)
        return forward(self.value(leaf, at), [(leaf, dpath)])

    def vjp(self, path: np.ndarray, poses_adj: np.ndarray, at: Moment, path_adj: np.ndarray) -> None:
        """Add the adjoints of the rows of paths for those of the rows here."""
        leaf = Recorded(path, zeros=lambda: path_adj)
        reverse(self.value(leaf, at), poses_adj, [leaf])
