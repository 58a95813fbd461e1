"""What obstacles did in each frame of an explicit run, per vertex, on the device; also its changes and its adjoints."""

import numpy as np

from diffsim_ti import runtime


class ImpulseRecord:
    """Impulses [N s] of obstacles on vertices: those of the contact stage in `impulse` (contact_impulses.py), and
    those of pairs with points and edges of obstacles in `of_pairs`, shape (frames, obstacles by pairs, 2: by push and by
    friction, surface vertices, 3).

    Raises ValueError where obstacles act as forces.
    """

    def __init__(self, workspace):
        self.arrays, a, features = workspace.arrays, workspace.arrays, workspace.arrays.features()
        if len(features.staged) < len(features.groups):
            raise ValueError(
                "explicit solvers note what obstacles with a distance do, and one of this scene is a force alone: take an "
                "implicit solver for ContactForce and ContactTraction"
            )
        obstacles = workspace.pairs.obstacles if workspace.pairs else None
        self.by_pairs = [part.k for part in obstacles.corners.parts] if obstacles else []
        self.surface = a.mesh.surface_vertices
        self.num_frames, self.num_obstacles = workspace.frames.frames_u.shape[0], len(a.obstacles)
        self.impulse = runtime.array(a.vector, 2 * self.num_frames * self.num_obstacles, a.num_vertices)
        self.clear()

    @property
    def _shape(self) -> tuple:
        return self.num_frames, self.num_obstacles, 2, self.arrays.num_vertices, 3

    def clear(self) -> None:
        runtime.fill(self.impulse, 0)
        self.of_pairs = np.zeros((self.num_frames, len(self.by_pairs), 2, len(self.surface), 3))

    def put(self, impulses: np.ndarray) -> None:
        """Set them; shape as `collect` gives."""
        runtime.fill(self.impulse, impulses.reshape(-1, *self._shape[3:]))
        self.of_pairs = impulses[:, self.by_pairs][:, :, :, self.surface].copy()

    def collect(self) -> np.ndarray:
        """Shape (frames, obstacles, 2: by push and by friction, num_vertices, 3), float64; the first frame has none."""
        out = runtime.fetch(self.impulse).astype(np.float64).reshape(self._shape)
        for k, o in enumerate(self.by_pairs):
            out[:, o][:, :, self.surface] += self.of_pairs[:, k]
        return out

    def frame_of(self, numbers: dict) -> int | None:
        """The frame that counts the pass of a launch, if one does."""
        return numbers["counted"] if numbers["counted"] >= 0 else None
