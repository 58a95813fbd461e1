"""What contacts did during a run, noted by the passes: smallest gaps, and how finely the steps resolve them."""

import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.terms.obstacles.barrier import beta

# What keeps the gradient of a bounce within 10 %, measured over 400 starting heights (tests/test_contact_gradients.py): for
# bounces that use a tenth of the width or more, and a flight of a few widths after them. An error in velocity grows with
# the time that is left, and grazing bounces are the worst.
LARGEST_OMEGA_DT, LARGEST_SHARE = 0.5, 0.1

DEPTHS = 1 - np.linspace(1, 1e-3, 4096)  # in a barrier, in widths, and the energy that it takes to come there
STOPPED = beta(1 - DEPTHS)


def limits(solver) -> tuple[float, float]:
    """Largest omega dt, and largest share, at which gradients of a bounce stay within 10 %, measured likewise.

    A stage that keeps the energy resolves a bounce in two steps; what it damps grows with both.
    """
    if not solver.stages_contact:
        return LARGEST_OMEGA_DT, LARGEST_SHARE
    c = max(solver.contact_damping, 1e-12)
    return min(2.0, 0.05 / c), min(1.0, 0.02 / c)


@dataclass(frozen=True)
class ContactResolution:
    """How well a run's substeps resolve its contacts, over all of its passes.

    omega_dt: largest h sqrt(b''(d) / m), the barrier's stiffness against the vertex's mass.
    travel: largest approach to an obstacle in one substep, as a share of its width.
    share: the same as a share of the depth at which the barrier alone would stop the vertex.
    The last two are the largest of these at which gradients of a bounce stay within 10 %, with these solver's contacts.
    smallest_gap [m], with the vertex and obstacle that reached it; infinite if no barrier acted.
    substep [s]: the substep h; advised_substep [s]: one at which gradients of a bounce stay within 10 %.
    """

    omega_dt: float
    travel: float
    share: float
    smallest_gap: float
    vertex: int | None
    obstacle: str | None
    substep: float
    largest_omega_dt: float = LARGEST_OMEGA_DT
    largest_share: float = LARGEST_SHARE

    @property
    def coarseness(self) -> float:
        """How many times larger the substep is than advised; gradients may be off by more than 10 % above 1."""
        return max(self.omega_dt / self.largest_omega_dt, self.share / self.largest_share)

    @property
    def advised_substep(self) -> float:
        return self.substep / self.coarseness if self.coarseness > 0 else float("inf")

    @property
    def resolved(self) -> bool:
        """Whether gradients through the contacts can be trusted to 10 %."""
        return self.coarseness <= 1

    def __str__(self) -> str:
        if self.obstacle is None:
            return "contact: none"
        return (
            f"contact: smallest gap {self.smallest_gap:.4g} m, of vertex {self.vertex} to {self.obstacle}; "
            f"omega dt {self.omega_dt:.3g} (advised {self.largest_omega_dt:.3g}), |v| dt {self.travel:.3g} of the width and "
            f"{self.share:.3g} of the depth (advised {self.largest_share:.3g})"
        )


def worst(seen: list[ContactResolution]) -> ContactResolution:
    """The coarsest of several, with the smallest gap of all."""
    coarsest, nearest = max(seen, key=lambda one: one.coarseness), min(seen, key=lambda one: one.smallest_gap)
    where = {name: getattr(nearest, name) for name in ("smallest_gap", "vertex", "obstacle")}
    return replace(coarsest, **where)


class ContactWatch:
    """Three rows for each contact term (gap, (omega dt)^2, travel), which each vertex keeps for itself in the passes."""

    def __init__(self, workspace):
        self.ws, arrays = weakref.proxy(workspace), workspace.arrays  # which holds this: no circle
        self.contacts, self._obstacles = arrays.contacts, arrays.obstacles
        self._shown = [repr(term) for term in self.contacts]
        n = arrays.num_vertices if self.contacts else 1
        self.seen = runtime.array(arrays.fp, 3 * len(self.contacts), n)
        self.clear()

    def clear(self) -> None:
        """Forget what was seen."""
        self.earlier: list[ContactResolution] = []  # of the same run, in other arrays
        self.parts: list[tuple[np.ndarray, float]] = []  # what was seen in passes of other lengths, and these [s]
        self._clear()

    def _clear(self) -> None:
        if self.contacts:
            rows = np.zeros(self.seen.shape)
            rows[::3] = np.inf
            runtime.fill(self.seen, rows)

    def close(self, h: float) -> None:
        """Passes of length h [s] are over: keep what was seen in them apart from what is seen next."""
        rows = self.rows()
        if self.contacts and np.isfinite(rows[::3]).any():
            self.parts.append((rows, h))
            self._clear()

    def rows(self) -> np.ndarray:
        """What was seen, to be put back by `put`."""
        return runtime.fetch(self.seen)

    def put(self, rows: np.ndarray) -> None:
        runtime.fill(self.seen, rows)

    def crossing(self) -> tuple[int, int, float] | None:
        """(contact, vertex, depth [m]) of the deepest vertex on or behind an obstacle, or None."""
        if not self.contacts:
            return None
        host = runtime.view(self.seen)
        gaps = (runtime.fetch(self.seen) if host is None else host)[::3]
        k, i = np.unravel_index(np.argmin(gaps), gaps.shape)
        return (int(k), int(i), -float(gaps[k, i])) if gaps[k, i] <= 0 else None

    def largest_omega_dt(self) -> float:
        """Largest h sqrt(b''(d) / m) of vertices since the run's start."""
        host = runtime.view(self.seen)
        return float(np.sqrt((runtime.fetch(self.seen) if host is None else host)[1::3].max()))

    def resolution(self) -> ContactResolution:
        """What was seen since the run's start."""
        return self.seen_so_far()()

    def seen_so_far(self) -> Callable[[], ContactResolution]:
        """The same, worked out when it is asked for: most runs never are."""
        values, largest = self.ws.arrays.values, limits(self.ws.solver)
        parts = [*self.parts, (self.rows(), self.ws.substep)]
        return partial(self._worst_of, values, largest, parts)

    def _worst_of(self, values: Derived, largest: tuple[float, float], parts: list) -> ContactResolution:
        seen = [*self.earlier, *(self.resolution_of(rows, values, h, largest) for rows, h in parts)]
        return worst(seen) if self.contacts else seen[-1]

    def resolution_of(
        self, rows: np.ndarray, values: Derived, h: float, largest: tuple[float, float]
    ) -> ContactResolution:
        """What such rows say, of passes of length h [s]."""
        if not self.contacts:
            return ContactResolution(0.0, 0.0, 0.0, float("inf"), None, None, h, *largest)
        rows = rows.astype(np.float64)
        gaps, travel = rows[::3], rows[2::3]
        k, i = (int(x) for x in np.unravel_index(np.argmin(gaps), gaps.shape))
        seen = np.isfinite(gaps[k, i])
        return ContactResolution(
            float(np.sqrt(rows[1::3].max())),
            float(travel.max()),
            float((travel / self._depths(travel, values, h)).max()),
            float(gaps[k, i]),
            i if seen else None,
            self._shown[k] if seen else None,
            h,
            *largest,
        )

    def _depths(self, travel: np.ndarray, values: Derived, h: float) -> np.ndarray:
        """Depths in the barriers, in widths, that stop vertices with these speeds: m v^2 / 2 = k w^2 beta(1 - depth)."""
        area = np.where(values.surface > 0, values.surface, 1.0)
        stiffness = [
            (values.parameters[first + counterpart.index.stiffness] if counterpart.watched else 1.0)
            * (area if counterpart.per_area else np.ones_like(area))
            for counterpart, first, _ in self._obstacles
        ]
        with np.errstate(over="ignore"):  # of runs that blow up
            energy = values.mass * travel**2 / (2 * h * h * np.array(stiffness))
        return np.interp(energy, STOPPED, DEPTHS) + 1e-12
