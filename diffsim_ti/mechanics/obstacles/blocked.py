"""The error of a step that obstacles block."""

import numpy as np

from diffsim_ti.common.errors import NotConverged
from diffsim_ti.terms.obstacles.barrier import slope_at


class Blocked(NotConverged):
    """A vertex or face stands before an obstacle, and no step helps. Carries its `vertices`, the obstacle (a term), the
    gap [m], the speed [m/s] at which they meet, and the stiffness [N/m] that the barrier needs, None where its own does."""

    # shares of the width: where a barrier that is stiff enough stops things; what counts as there
    firm, near = 0.02, 0.05

    def __init__(self, message: str, residuals, vertices, obstacle, gap: float, speed: float, stiffness: float | None):
        super().__init__(message, residuals)
        self.vertices, self.obstacle, self.gap, self.speed, self.stiffness = vertices, obstacle, gap, speed, stiffness

    @classmethod
    def pinched(cls, ws, u, met, left: float, speed: float) -> "Blocked":
        """An obstacle or a support has the share `left` of its motion to go, and finds no room."""
        term, h = ws.collisions.detection.terms[met.obstacle], ws.substep
        gap, width = ws.collisions.gap_of(met, u), float(term.values["barrier_width"])
        short = min(0.5 * h, width / max(speed, 1e-300))
        message = (
            f"{met} is {gap:.3g} m before {term!r}, they come together at {speed:.4g} m/s, and {left:.0%} of the "
            f"motion in a substep of {h:.4g} s finds no room: take substeps of {short:.3g} s, or give the body room to move"
        )
        return cls(message, [], met.vertices, term, gap, speed, None)

    @classmethod
    def at_an_obstacle(cls, ws, error: NotConverged, u: np.ndarray, met, speed: float) -> "NotConverged":
        """What NotConverged was about, if it happened before an obstacle; else the error itself."""
        if met is None or met.obstacle >= len(ws.collisions.detection.terms):
            return error
        term, gap = ws.collisions.detection.terms[met.obstacle], ws.collisions.gap_of(met, u)
        width = ws.collisions.detection.widths[met.obstacle]
        stiffness = ws.arrays.stiffness_of(met.obstacle, met.vertices)
        if gap > cls.near * width:
            return error
        R = ws.newton.residual_at(u)[list(met.vertices)]
        force = float(np.linalg.norm(R, axis=1).max()) - stiffness * width * slope_at(gap / width)
        needed = -force / (width * slope_at(cls.firm))
        weak = needed > stiffness
        remedy = (
            f"the barrier cannot stop it: raise its {ws.arrays.stiffer(met.obstacle, met.vertices, needed)}, or its width"
            if weak
            else f"take substeps of {ws.substep / 4:.3g} s"
        )
        message = (
            f"{met} stands {gap:.3g} m before {term!r} (width {width:.3g} m), met at {speed:.4g} m/s, and Newton's method "
            f"gets no further: {remedy}"
        )
        return cls(message, error.residuals, met.vertices, term, gap, speed, needed if weak else None)
