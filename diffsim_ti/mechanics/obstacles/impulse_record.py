"""What obstacles, and surfaces to each other, did in each frame of an explicit run, per vertex; its changes and adjoints."""

import numpy as np

from diffsim_ti import runtime


def check_staged(features) -> None:
    """Raise ValueError where obstacles act as forces, whose impulses are not noted."""
    if len(features.staged) < len(features.groups):
        raise ValueError(
            "explicit solvers note what obstacles with a distance do, and one of this scene is a force alone: take an "
            "implicit solver for ContactForce and ContactTraction"
        )


class ImpulseRecord:
    """Impulses [N s] on vertices: those of obstacles in the contact stage in `impulse` (contact_impulses.py), on the device,
    and those of pairs in `of_pairs`, shape (frames, contacts by pairs, 2: by push and by friction, num_vertices, 3), whose
    `rows` are those of obstacles, and a row behind them for surfaces on each other; `contacts`: their numbers.

    wanted: whether those of obstacles (True), where these act as forces a ValueError; of "surfaces", or of both. The others
    are NaN in what is collected. Where robots move obstacles `impulse` is of a single pass, which their joints read, and
    `of_frames` on the host sums it up.
    """

    def __init__(self, workspace, wanted: frozenset):
        self.arrays, a, features = workspace.arrays, workspace.arrays, workspace.arrays.features()
        self.wanted, of_obstacles, self.in_passes = wanted, True in wanted, features.led
        if of_obstacles:
            check_staged(features)
        obstacles = workspace.pairs.obstacles if workspace.pairs and of_obstacles else None
        self.rows = [part.k for part in obstacles.corners.parts] if obstacles else []
        self.contacts = [*range(1, 1 + len(self.rows))]
        if a.self_contact and "surfaces" in wanted:
            self.rows, self.contacts = [*self.rows, len(a.obstacles)], [*self.contacts, 0]
        self.num_frames, self.num_obstacles = (
            workspace.frames.frames_u.shape[0],
            len(a.obstacles) if of_obstacles or self.in_passes else 0,
        )
        frames = 1 if self.in_passes else self.num_frames
        self.impulse = runtime.array(a.vector, max(1, 2 * frames * self.num_obstacles), a.num_vertices)
        self.clear()

    @property
    def _shape(self) -> tuple:
        return self.num_frames, self.arrays.num_contact_rows, 2, self.arrays.num_vertices, 3

    def clear(self) -> None:
        runtime.clear([self.impulse])
        self.of_pairs = np.zeros((self.num_frames, len(self.rows), *self._shape[2:]))
        if self.in_passes and True in self.wanted:
            self.of_frames = np.zeros((self.num_frames, 2 * self.num_obstacles, *self._shape[3:]))

    def of_frame(self, frame: int) -> np.ndarray | float:
        """Those of obstacles in the frame that counts a pass, shape (2 obstacles, num_vertices, 3); 0 where none does."""
        return self.of_frames[frame] if frame >= 0 and True in self.wanted else 0.0

    def note_pass(self, frame: int) -> None:
        """Add those of the pass to it."""
        if frame >= 0 and True in self.wanted:
            self.of_frames[frame] += runtime.look(self.impulse)

    def put(self, impulses: np.ndarray) -> None:
        """Set them; shape as `collect` gives."""
        own = impulses[:, : self.num_obstacles].reshape(self.num_frames, -1, *self._shape[3:])
        if self.in_passes:
            self.of_frames = own
        elif self.num_obstacles:
            runtime.fill(self.impulse, own.reshape(-1, *self._shape[3:]))
        self.of_pairs = impulses[:, self.rows]

    def collect(self) -> np.ndarray:
        """Shape (frames, obstacles and surfaces on each other, 2: by push and by friction, num_vertices, 3), float64; the
        first frame has none."""
        out = np.full(self._shape, np.nan)
        if True in self.wanted:
            out[:, : len(self.arrays.obstacles)] = 0.0
        if self.num_obstacles and True in self.wanted:
            own = out[:, : self.num_obstacles]
            of_frames = self.of_frames if self.in_passes else runtime.fetch(self.impulse).astype(np.float64)
            own += of_frames.reshape(own.shape)
        for k, row in enumerate(self.rows):
            out[:, row] = np.nan_to_num(out[:, row]) + self.of_pairs[:, k]
        return out
