"""Bodies that slide and vibrate in explicit steps, so that friction does not point against the sliding.

Steps that damp nothing let the vibrations of a stiff body grow where it rests on an obstacle: contact opens and closes in
most substeps, vertices move to and fro as fast as the body slides, and it slides too far. A block of 1 MPa that stopped from
2 m/s on mu = 0.7 went 5 % too far, one of 10 MPa 0.5 %; with a KelvinVoigt time of a tenth of the stable step, -0.15 %.
"""

import weakref

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.warn import warn
from diffsim_ti.mesh.sets import pieces

SHAKEN, OPEN, NEAR = 0.3, 0.5, 2  # of the sliding speed; of what has touched; widths
VISCOUS = 0.1  # of the stable step


class Chatter:
    """Monitors bodies that slide on obstacles with friction, and warns once."""

    def __init__(self, workspace):
        self.ws, self.warned = weakref.proxy(workspace), False
        self.pieces = pieces(workspace.scene.mesh)
        self.fastest = np.zeros(len(workspace.watch.contacts))  # that something slid on each obstacle [m/s]

    @classmethod
    def of(cls, workspace) -> "Chatter | None":
        """For explicit steps and obstacles with friction."""
        rough = any(term.has_friction for term in workspace.watch.contacts)
        return cls(workspace) if workspace.solver.explicit and rough and not workspace.scene.reduced else None

    def check(self, now: int, num_passes: int) -> None:
        """Before pass `now`."""
        ws = self.ws
        ws.place_obstacles(now)
        arrays, touched = ws.arrays, ws.watch.rows()[::3, : ws.arrays.num_vertices]
        x, v = (runtime.fetch_row(a, 0).astype(np.float64) for a in (ws.state.u, ws.state.v))
        x = x + arrays.values.rest
        places = runtime.fetch(arrays.offsets).astype(np.float64)
        for k, term in enumerate(ws.watch.contacts):
            width = float(term.values["barrier_width"])
            own = np.flatnonzero(touched[k] < width)
            if self.warned or not term.has_friction or not own.size or not np.isfinite(v).all():
                continue
            gap = term.gap(x[own], arrays.poses.row_of(k, places))
            slide = float(np.linalg.norm(v[own].mean(0) - ws.velocity_of_obstacle(k, now, own[0])))
            self.fastest[k] = max(self.fastest[k], slide)
            few, near = (gap < width).mean() < OPEN, np.median(gap) < NEAR * width
            if not few or not near or slide < 0.2 * self.fastest[k] or slide < 10 * term.values["friction_speed"]:
                continue
            shake = float(np.sqrt((self._shaking(x, v)[own] ** 2).sum(1).mean()))
            if shake > SHAKEN * slide:
                self._warn(term, shake, slide, now, num_passes)

    def _shaking(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """What is left of velocities without the rigid motion of each piece."""
        out = np.zeros_like(v)
        for number in range(self.pieces.max() + 1):
            own = self.pieces == number
            r, w = x[own] - x[own].mean(0), v[own] - v[own].mean(0)
            inertia = (r**2).sum() * np.eye(3) - r.T @ r
            out[own] = w - np.cross(np.linalg.pinv(inertia) @ np.cross(r, w).sum(0), r)
        return out

    def _warn(self, term, shake: float, slide: float, now: int, num_passes: int) -> None:
        ws, self.warned = self.ws, True
        material, remedy = type(ws.scene.material).__name__, "contact_damping=1"
        if not (ws.scene.law.viscous or ws.scene.law.state_names):
            time = VISCOUS * float(ws.solver.stable_dt().dt)
            damped = f"KelvinVoigt({material}(...), {time:.2g}) as the material"
            remedy = f"{damped}, which damps these vibrations, or {remedy}"
        warn(
            f"{ws.when(ws.step_of(now - 1, num_passes))}: a body that slides on {term!r} at {slide:.3g} m/s vibrates at "
            f"{shake:.3g} m/s, and its contact opens and closes, because these steps have no damping: friction then does "
            f"not oppose the sliding, and sliding distances are a few per cent too long; take {remedy}"
        )
