"""What obstacles did in each frame of an explicit run, per vertex, on the device; also its changes and its adjoints."""

import numpy as np

from diffsim_ti import runtime


class ImpulseRecord:
    """Impulses [N s] of obstacles on vertices: those of the contact stage in `impulse` (contact_impulses.py), those of
    points within faces in `of_faces`, shape (frames, obstacles that reach there, num_vertices, 3), those of friction there
    in `of_friction`, of obstacles with friction, on the surface's vertices.

    Raises ValueError where obstacles act as forces, and while it runs where two of them push on the faces around one vertex.
    """

    def __init__(self, workspace):
        self.arrays, a, features = workspace.arrays, workspace.arrays, workspace.arrays.features()
        if len(features.staged) < len(features.groups):
            raise ValueError(
                "explicit solvers note what obstacles with a distance do, and one of this scene is a force alone: take an "
                "implicit solver for ContactForce and ContactTraction"
            )
        if workspace.pairs and workspace.pairs.obstacles:
            names = sorted({type(x.term).__name__ for x in workspace.pairs.obstacles.corners.parts})
            raise ValueError(
                f"explicit solvers do not note what edges and points of obstacles ({', '.join(names)}) do to faces: for "
                "ContactForce and ContactTraction take an implicit solver, or pass these obstacles by_pairs=False"
            )
        reaching = [g.number + k for g in features.groups if features.reaches(g) for k in range(g.count)]
        self.reaching = reaching if workspace.faces else []
        self.with_friction = list(workspace.faces.friction.number) if workspace.faces else []
        self.surface = a.mesh.surface_vertices
        self.num_frames, self.num_obstacles = workspace.frames.frames_u.shape[0], len(a.obstacles)
        self.impulse = runtime.array(a.vector, 2 * self.num_frames * self.num_obstacles, a.num_vertices)
        self.clear()

    @property
    def _shape(self) -> tuple:
        return self.num_frames, self.num_obstacles, 2, self.arrays.num_vertices, 3

    def clear(self) -> None:
        runtime.fill(self.impulse, 0)
        self.of_faces = np.zeros((self.num_frames, len(self.reaching), self.arrays.num_vertices, 3))
        self.of_friction = np.zeros((self.num_frames, len(self.with_friction), len(self.surface), 3))

    def put(self, impulses: np.ndarray) -> None:
        """Set them; shape as `collect` gives."""
        runtime.fill(self.impulse, impulses.reshape(-1, *self._shape[3:]))
        self.of_faces = impulses[:, self.reaching, 0].copy()
        self.of_friction = impulses[:, self.with_friction, 1][:, :, self.surface].copy()

    def collect(self) -> np.ndarray:
        """Shape (frames, obstacles, 2: by push and by friction, num_vertices, 3), float64; the first frame has none."""
        out = runtime.fetch(self.impulse).astype(np.float64).reshape(self._shape)
        out[:, self.reaching, 0] += self.of_faces
        for k, o in enumerate(self.with_friction):
            out[:, o, 1, self.surface] += self.of_friction[:, k]
        return out

    # ---- of faces ----------------------------------------------------------------------------------------------------

    def frame_of(self, numbers: dict) -> int | None:
        """The frame that counts the pass of a launch, if one does."""
        return numbers["counted"] if numbers["counted"] >= 0 else None

    def _shares(self, pushes: np.ndarray) -> np.ndarray:
        """Of the obstacles that reach there in what faces do to each vertex, shape (obstacles, num_vertices, 1): all of it
        is the one's that pushes.

        pushes: as FaceContactPoints has it. Raises ValueError where two push on one vertex.
        """
        own = pushes[self.reaching]
        if len(own) > 1 and np.any(own.sum(0) > 1):
            i = int(np.argmax(own.sum(0)))
            names = " and ".join(type(self.arrays.contacts[o]).__name__ for o in np.array(self.reaching)[own[:, i]])
            raise ValueError(
                f"{names} push on the faces around vertex {i} in one substep, where explicit steps record only what they do "
                "together: take an implicit solver, narrower barriers, or a finer surface, for the force of each"
            )
        own = own.astype(float) if len(own) > 1 else np.ones((len(own), pushes.shape[1]))
        return own[:, :, None]

    def add(self, numbers: dict, change: np.ndarray, pushes: np.ndarray) -> None:
        """Add what faces did in a pass; change: of the velocity by them [m/s]."""
        frame = self.frame_of(numbers)
        if frame is not None:
            self.of_faces[frame] += self._shares(pushes) * self.arrays.values.mass[:, None] * change

    def add_friction(self, numbers: dict, impulses: np.ndarray | None) -> None:
        """Add what friction within faces did in a pass, or the change of it, of each obstacle with friction."""
        frame = self.frame_of(numbers)
        if frame is not None and impulses is not None:
            self.of_friction[frame] += impulses

    def seed_friction(self, numbers: dict) -> np.ndarray | None:
        """Adjoint of these impulses."""
        frame = self.frame_of(numbers)
        return None if frame is None else self.of_friction[frame]

    def add_jvp(
        self, numbers: dict, speed: np.ndarray, change: np.ndarray, mass_dot: np.ndarray, pushes: np.ndarray
    ) -> None:
        """Its change; speed: the change of velocity by faces, change: that of it."""
        self.add(numbers, change, pushes)
        frame = self.frame_of(numbers)
        if frame is not None:
            self.of_faces[frame] += self._shares(pushes) * mass_dot[:, None] * speed

    def seed(self, numbers: dict, pushes: np.ndarray) -> np.ndarray | None:
        """Adjoint of the velocity after faces, by their impulse; that before them has the opposite."""
        frame = self.frame_of(numbers)
        return None if frame is None else self.arrays.values.mass[:, None] * self._felt(frame, pushes)

    def _felt(self, frame: int, pushes: np.ndarray) -> np.ndarray:
        return (self._shares(pushes) * self.of_faces[frame]).sum(0)

    def by_mass(self, numbers: dict, speed: np.ndarray, pushes: np.ndarray) -> np.ndarray:
        """Adjoint of the masses."""
        return (self._felt(self.frame_of(numbers), pushes) * speed).sum(1)
