"""Pressures of constrained volumes in the frames of a run: their changes, and adjoints that a loss gives."""

import numpy as np

from diffsim_ti.terms import Chamber


class ChamberRecord:
    """The pressure of a frame is that of the pass that leads to it."""

    def __init__(self, solver, held: list[int]):
        self.solver, self.held = solver, held  # places of these chambers among the scene's
        self.adjoints: np.ndarray | None = None  # by the frames' chamber pressures, None: zero
        self._changes: dict[int, np.ndarray] = {}

    def _frame(self, j: int, save_every: int) -> int:
        """The frame that the state after pass j is, or -1."""
        return int(self.solver.schedule.shown(j + 1, save_every))

    def adjoint(self, j: int, save_every: int) -> np.ndarray:
        """By the pressures of constrained volumes after pass j."""
        frame = self._frame(j, save_every)
        return np.zeros(len(self.held)) if self.adjoints is None or frame < 0 else self.adjoints[frame, self.held]

    def note(self, j: int, save_every: int, change: np.ndarray) -> None:
        """Change of those after pass j."""
        frame = self._frame(j, save_every)
        if frame >= 0:
            self._changes[frame] = change

    def changes(self, num_frames: int) -> np.ndarray:
        """Of the frames, shape (frames, chambers)."""
        out = np.zeros((num_frames, len(self.solver.scene.terms_of(Chamber))))
        for frame, change in self._changes.items():
            out[frame, self.held] = change
        return out
