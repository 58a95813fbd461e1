"""Pressures of held volumes in the frames of an implicit run: their changes, and adjoints that a loss gives."""

import weakref

import numpy as np


class ChamberRecord:
    """Frames being `per_frame` passes apart, the pressure of a frame is that of the pass that leads to it."""

    def __init__(self, workspace):
        self.ws = weakref.proxy(workspace)
        self.adjoints: np.ndarray | None = None  # by the frames' chamber pressures, None: zero
        self._changes: dict[int, np.ndarray] = {}

    def adjoint(self, j: int, per_frame: int) -> np.ndarray:
        """By the pressures of held volumes after pass j."""
        held = self.ws.follower.held
        if self.adjoints is None or not per_frame or (j + 1) % per_frame:
            return np.zeros(len(held))
        return self.adjoints[(j + 1) // per_frame, held]

    def note(self, j: int, per_frame: int, change: np.ndarray) -> None:
        """Change of those after pass j."""
        if (j + 1) % per_frame == 0:
            self._changes[(j + 1) // per_frame] = change

    def changes(self, num_frames: int) -> np.ndarray:
        """Of the frames, shape (frames, chambers)."""
        out = np.zeros((num_frames, len(self.ws.scene.chambers)))
        for frame, change in self._changes.items():
            out[frame, self.ws.follower.held] = change
        return out
