"""Pressures of held volumes in the frames of an implicit run: their changes, and adjoints that a loss gives."""

import weakref

import numpy as np


class ChamberRecord:
    """The pressure of a frame is that of the pass that leads to it."""

    def __init__(self, workspace):
        self.ws = weakref.proxy(workspace)
        self.adjoints: np.ndarray | None = None  # by the frames' chamber pressures, None: zero
        self._changes: dict[int, np.ndarray] = {}

    def _frame(self, j: int, save_every: int) -> int:
        """The frame that the state after pass j is, or -1."""
        return int(self.ws.solver.schedule.shown(j + 1, save_every))

    def adjoint(self, j: int, save_every: int) -> np.ndarray:
        """By the pressures of held volumes after pass j."""
        held, frame = self.ws.follower.held, self._frame(j, save_every)
        return np.zeros(len(held)) if self.adjoints is None or frame < 0 else self.adjoints[frame, held]

    def note(self, j: int, save_every: int, change: np.ndarray) -> None:
        """Change of those after pass j."""
        frame = self._frame(j, save_every)
        if frame >= 0:
            self._changes[frame] = change

    def changes(self, num_frames: int) -> np.ndarray:
        """Of the frames, shape (frames, chambers)."""
        out = np.zeros((num_frames, len(self.ws.scene.chambers)))
        for frame, change in self._changes.items():
            out[frame, self.ws.follower.held] = change
        return out
