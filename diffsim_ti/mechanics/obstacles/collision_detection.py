"""Collision detection along the motion of a scene's surface past its obstacles."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.obstacles.face_lattice import nodes_of_faces
from diffsim_ti.mechanics.obstacles.swept import swept_kernels
from diffsim_ti.mechanics.surfaces.surface_pairs import Overlap


@dataclass(frozen=True)
class Met:
    """The vertex or face of a surface that is nearest to an obstacle, or stopped first: its vertices, which obstacle it
    is, and the distance [m] or the free share of a step."""

    vertices: tuple[int, ...]
    obstacle: int
    value: float

    def __str__(self) -> str:
        if len(self.vertices) == 1:
            return f"vertex {self.vertices[0]}"
        return f"face ({', '.join(map(str, self.vertices))})"


class CollisionDetection:
    """Vertices and faces of a surface against the obstacles of a scene, whose numbers are those that are loaded.

    places, drifts: where obstacles are, and how they go meanwhile (state/obstacle_poses.py).
    """

    far = 1e30

    def __init__(self, arrays, parallel: bool):
        self.a, a = arrays, arrays
        self.terms, mesh = a.contacts, a.mesh
        self._kernels = swept_kernels(a.features(), a.precision, parallel)
        faces = nodes_of_faces(a)
        vertices = np.repeat(mesh.surface_vertices[:, None], faces.shape[1], 1)
        any_reaches = any(a.features().reaches(group) for group in a.features().groups)
        self.corners_of = np.concatenate([vertices, faces if any_reaches else faces[:0]])
        self.num_vertices, self.count = len(vertices), len(self.corners_of)
        self._way = SimpleNamespace(
            corners=runtime.upload(self.corners_of.ravel(), ti.i32),
            step=runtime.array(a.vector, 1, a.num_vertices),
            places=runtime.array(a.vector, a.poses.size // 3),
            drifts=runtime.array(a.vector, a.poses.size // 3),
        )
        self._at = SimpleNamespace(u=runtime.array(a.vector, 1, a.num_vertices))
        self._out = SimpleNamespace(found=runtime.array(a.fp, self.count), blocker=runtime.array(ti.i32, self.count))
        self._launches = {}
        self.met: Met | None = None  # what the last detection found

    def share(
        self, u: np.ndarray, step: np.ndarray, places: np.ndarray, drifts=0.0, most: float = 1.0, kept=0.1
    ) -> float:
        """A share of the step from u, at most `most`, on which no vertex or face meets an obstacle. Where one would, the
        share `kept` of its distance (or of the width, if that is less) is kept. `met` says what stopped it."""
        if not self.terms or not (np.any(step) or np.any(drifts)):
            self.met = None
            return most
        runtime.fill(self._way.step, step[None])
        runtime.fill(self._way.drifts, drifts)
        self._check("shares", u, places, most, kept)
        return most if self.met is None else self.met.value

    def nearest(self, u: np.ndarray, places: np.ndarray, within: float = 0.0) -> Met | None:
        """What is in an obstacle, or `within` [m] of one; where all is farther away, None."""
        if not self.terms:
            return None
        runtime.fill(self._way.step, 0)
        runtime.fill(self._way.drifts, 0)
        self._check("distances", u, places, max(within, 1e-30))
        return self.met

    def check_apart(self, u: np.ndarray, places: np.ndarray, within: float = 0.0) -> np.ndarray:
        """Distances [m] of faces to what is nearest, or `within` of those that are farther away; from half of it on they are
        what is known to be free. Raises Overlap if a vertex or a face is in an obstacle. A state that is not finite is
        looked at elsewhere."""
        if not np.all(np.isfinite(u)):
            return np.full(self.count - self.num_vertices, within)
        met = self.nearest(u, places, within)
        if met is not None and met.value <= 1e-30:
            raise Overlap(
                f"{self.terms[met.obstacle]!r} reaches {-met.value:.3g} m into {met} of the body: move the body or the "
                "obstacle"
            )
        return self.found[self.num_vertices :] if self.terms else np.zeros(0)

    def _check(self, name: str, u, places, most: float, kept: float = 0.0) -> None:
        if name not in self._launches:
            own = dict(scene=self.a, way=self._way, at=self._at, out=self._out)
            self._launches[name] = getattr(self._kernels, name).bind(**own)
        runtime.fill(self._at.u, u[None])
        runtime.fill(self._way.places, places)
        self._launches[name](num_vertices=self.num_vertices, count=self.count, most=most, kept=kept)
        found, blocker = runtime.fetch(self._out.found), runtime.fetch(self._out.blocker)
        j = int(found.argmin())
        self.found, self.met = found.astype(np.float64), None
        if blocker[j] >= 0:
            self.met = Met(
                tuple(int(i) for i in dict.fromkeys(self.corners_of[j, :3])), int(blocker[j]), float(found[j])
            )

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
