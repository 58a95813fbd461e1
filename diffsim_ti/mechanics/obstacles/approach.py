"""What comes to a body within a pass: obstacles on their paths, and the body's own vertices where they are held.

Where they are at the end of the pass the body may be in their way, and no minimum of the pass is to be found from there. So
they come as far as the way is free, the incremental potential is lowered for them there, which makes room, and so on. The
pass is solved when they have come; what was found on the way is but where it starts.
Li et al. 2020, Incremental Potential Contact, supplement C, doi:10.1145/3386569.3392425.
"""

import weakref

import numpy as np

from diffsim_ti.common.errors import NotConverged
from diffsim_ti.mechanics.obstacles.blocked import Blocked
from diffsim_ti.mechanics.surfaces.listed_pair import SAFE


class Approach:
    """Brings a workspace's body in front of what comes to it."""

    most_parts, rounds = 300, 12  # of a pass; Newton's in a part
    kept = 0.5  # of the gap in a part: Newton's method doubles a small gap in a round, more or less
    longer = 4.0  # times the part before that a part may be where the body gives way on
    least, patience = 1e-4, 5  # share of the pass below which a part leads nowhere; so many in a row

    def __init__(self, workspace):
        self.ws = weakref.proxy(workspace)  # which holds this: no circle

    def __call__(self, u, held, starts: list, problem: tuple) -> np.ndarray:
        """Displacements with fixed vertices where they get, in front of the obstacles where forces are taken in the pass.

        u: where the pass begins; held: the same with fixed vertices where they get; starts: where the body may be led;
        problem: mass, inertial, loads of `Newton.solve`.
        Raises Blocked where no room is left.
        """
        ws = self.ws
        before, after = ws.collisions.before, ws.collisions.at_stage
        step, drift = held - u, ws.arrays.poses.drift(before, after)
        if not (step.any() or drift.any()):
            return held
        if not self._meets_pairs:
            ws.check_pairs(u, step)
        try:
            if self._share(u, step, before, drift)[0] == 1:
                return held
            for start in starts:
                if self._share(u, start - u, before, drift)[0] == 1 and self._is_sound(u, start):
                    ws.collisions.put(before)
                    if ws.newton.rises_from(held, problem)([start])[0] <= 0:
                        return start
            return self._in_parts(u, step, before, drift, problem)
        finally:
            ws.collisions.put(after)

    @property
    def _meets_pairs(self) -> bool:
        """Whether obstacles act by pairs, which are then looked at together with distances."""
        return bool(self.ws.pairs and self.ws.pairs.obstacles)

    def _share(self, u, step, places, drift, kept: float = 0.1) -> tuple:
        """(share of a step on which nothing meets an obstacle, what would be met then); kept: as in detection."""
        way = self.ws.collisions.detection
        share, met = way.share(u, step, places, drift, kept=kept), way.met
        if self._meets_pairs:
            free, met_by_pairs = self.ws.collisions.pairs_share(u, step, places, drift, share)
            if free < share:
                return free * min(1, (1 - kept) / SAFE), met_by_pairs
        return share, met

    def _in_parts(self, place, step, before, drift, problem):
        ws, done, stuck, part, gave_way, met = self.ws, 0.0, 0, 0.0, None, None
        moved = ws.arrays.poses.moved
        for _ in range(self.most_parts):
            left, poses, begun, way = 1 - done, moved(before, drift, done), place, step
            if gave_way is not None:  # it gives way on as in the part before
                ahead = min(left, self.longer * part)
                along = ahead * (step + gave_way / part)
                share, found = self._share(place, along, poses, ahead * drift, self.kept)
                if share * ahead > part and self._is_sound(place, place + share * along):
                    left, way, met = ahead, along / ahead, found or met
            if way is step:
                share, met = self._share(place, left * step, poses, left * drift, self.kept)
            part = share * left
            is_last, place, done = part == 1 - done, place + part * way, done + part
            if is_last:
                return place
            stuck = stuck + 1 if part < self.least else 0
            if stuck > self.patience:
                break
            poses = moved(before, drift, done)
            carried = (
                self._carried(place, (1 - done) * step, poses, (1 - done) * drift, met.obstacle) if share < 1 else None
            )
            if carried is not None:
                return carried
            ws.collisions.put(poses)
            place = ws.newton.solve(place, *problem, rounds=self.rounds)
            gave_way = (place - begun - part * step) * ws.linear if part > 0 else None
        ws.collisions.put(poses)
        if met.obstacle is None:
            raise NotConverged("prescribed motion drives surfaces through each other: take smaller steps", [])
        own = list(met.vertices)
        carried = ws.collisions.carried(met.obstacle, place[own], poses, drift, own)
        speed = np.linalg.norm(carried - step[own], axis=1).max() / ws.substep
        raise Blocked.pinched(ws, place, met, 1 - done, float(speed))

    def _carried(self, place, step, poses, drift, obstacle: int | None):
        """All that moves freely goes along with an obstacle; None where that way is not free."""
        if obstacle is None:
            return None
        along = step + self.ws.collisions.carried(obstacle, place, poses, drift) * self.ws.linear
        along = self.ws.rigid.nearest(place + along) - place if self.ws.rigid else along
        if not (along - step).any() or self._share(place, along, poses, drift)[0] < 1:
            return None
        return place + along if self._is_sound(place, place + along) else None

    def _is_sound(self, u, there) -> bool:
        """Whether nothing turns inside out or meets itself on the way."""
        J0, J = self.ws.volume_ratios(u), self.ws.volume_ratios(there)
        upright = not np.any((J0 > 0) & ~(J > 0.1 * J0))
        return upright and (self._meets_pairs or self.ws.pairs_share(u, there - u) == 1)
