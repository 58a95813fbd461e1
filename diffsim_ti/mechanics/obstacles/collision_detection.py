"""Collision detection along the motion of a surface's vertices past obstacles."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.obstacles.swept import SweptKernels
from diffsim_ti.mechanics.surfaces.surface_pairs import Overlap
from diffsim_ti.runtime import kernels_of


@dataclass(frozen=True)
class Met:
    """What of a surface is nearest to an obstacle, or stopped first: a vertex, or those of a pair (curved_pairs.py); which
    obstacle it is, and the distance [m] or the free share of a step."""

    vertices: tuple[int, ...]
    obstacle: int
    value: float

    def __str__(self) -> str:
        if len(self.vertices) == 1:
            return f"vertex {self.vertices[0]}"
        return f"what is between vertices ({', '.join(map(str, self.vertices))})"


class CollisionDetection:
    """Vertices of a surface against the obstacles of a scene, whose numbers are those that are loaded.

    places, drifts: where obstacles are, and how they go meanwhile (state/obstacle_poses.py).
    """

    far, kept = 1e30, 0.1  # of the distance, or of the width if that is less, where an obstacle is met
    kernels_kind = SweptKernels

    def __init__(self, arrays, parallel: bool):
        self.a, a = arrays, arrays
        self.terms, mesh = a.contacts, a.mesh
        self.kernels = kernels_of(self.kernels_kind, a.features().of_state(), a.precision, parallel)
        self.vertices, self.count = mesh.surface_vertices, len(mesh.surface_vertices)
        self.way = SimpleNamespace(
            vertices=runtime.upload(self.vertices, ti.i32),
            step=runtime.array(a.vector, 1, a.num_vertices),
            places=runtime.array(a.vector, a.poses.size // 3),
            drifts=runtime.array(a.vector, a.poses.size // 3),
        )
        self._at = SimpleNamespace(u=runtime.array(a.vector, 1, a.num_vertices))
        self.found = SimpleNamespace(found=runtime.array(a.fp, self.count), blocker=runtime.array(ti.i32, self.count))
        self._launches = {}
        self.met: Met | None = None  # what the last detection found

    of_one = property(lambda self: self.kernels, doc="As of the potential.")

    def share(
        self, u: np.ndarray, step: np.ndarray, places: np.ndarray, drifts=0.0, most: float = 1.0, kept=kept
    ) -> float:
        """A share of the step from u, at most `most`, on which no vertex meets an obstacle. Where one would, the
        share `kept` of its distance (or of the width, if that is less) is kept. `met` says what stopped it."""
        if not self.terms or not (np.any(step) or np.any(drifts)):
            self.met = None
            return most
        runtime.fill(self.way.step, step[None])
        runtime.fill(self.way.drifts, drifts)
        self._check("shares", u, places, most, kept)
        return most if self.met is None else self.met.value

    def nearest(self, u: np.ndarray, places: np.ndarray, within: float = 0.0) -> Met | None:
        """What is in an obstacle, or `within` [m] of one; where all is farther away, None."""
        if not self.terms:
            return None
        runtime.fill(self.way.step, 0)
        runtime.fill(self.way.drifts, 0)
        self._check("distances", u, places, max(within, 1e-30))
        return self.met

    def check_apart(self, u: np.ndarray, places: np.ndarray) -> None:
        """Raises Overlap if a vertex is in an obstacle. A state that is not finite is looked at elsewhere."""
        met = self.nearest(u, places) if np.all(np.isfinite(u)) else None
        if met is not None:
            raise Overlap(
                f"{self.terms[met.obstacle]!r} reaches {-met.value:.3g} m into {met} of the body: move the body or the "
                "obstacle"
            )

    def _check(self, name: str, u, places, most: float, kept: float = 0.0) -> None:
        if name not in self._launches:
            own = dict(scene=self.a, way=self.way, at=self._at, out=self.found)
            self._launches[name] = getattr(self.kernels, name).bind(**own)
        runtime.fill(self._at.u, u[None])
        runtime.fill(self.way.places, places)
        self._launches[name](count=self.count, most=most, kept=kept)
        self.read()

    def put(self, places: np.ndarray) -> None:
        """Obstacles stand at places, for kernels that are launched elsewhere."""
        runtime.fill(self.way.places, places)
        runtime.fill(self.way.drifts, 0)

    def read(self) -> Met | None:
        """What the kernels have found, which is `met` then."""
        found, blocker = runtime.fetch(self.found.found), runtime.fetch(self.found.blocker)
        j = int(found.argmin())
        self.met = Met((int(self.vertices[j]),), int(blocker[j]), float(found[j])) if blocker[j] >= 0 else None
        return self.met

    @property
    def widths(self) -> list[float]:
        """The distance at which each obstacle begins to act [m]."""
        return [
            float(self.a.values.parameters[first + counterpart.index.width])
            for counterpart, first, _ in self.a.obstacles
        ]

    @property
    def widest(self) -> float:
        return max(self.widths, default=0.0)

    @property
    def narrowest(self) -> float:
        return min(self.widths, default=0.0)

    def unbind(self) -> None:
        """Let go of the arrays that kernels were bound to."""
        self._launches.clear()
