"""What a law remembers in the frames of a run; in the same way its changes there, or a loss's gradients by it."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.runtime.slots import add_slot, copy_slot


class LawFrames:
    """Blocks of each frame, as those of a state; frame -1 is none."""

    def __init__(self, workspace):
        self.arrays = workspace.arrays
        self.z = self.arrays.law_states(workspace.frames.frames_u.shape[0])

    def note(self, frame: int, z, slot: int = 0) -> None:
        """A frame has what is in a slot of z."""
        if frame >= 0:
            copy_slot(z, slot, self.z, frame)

    def noted_before(self, launches, z, base: int = 0, stride: int = 0):
        """Launches (`ExplicitWorkspace.launches`), before each of which the frame that it shows has what is in z; slots of z
        as in `Passes`."""
        for numbers in launches:
            self.note(numbers["shown"], z, (numbers["first"] - base) * stride)
            yield numbers

    def added_after(self, launches, z):
        """Launches of a reverse sweep, after each of which what the frame has that it shows is added to z."""
        for numbers in launches:
            yield numbers
            self.add_to(z, numbers["shown"])

    def values(self) -> np.ndarray:
        """Shape (frames, num_tetrahedra, S), or (frames, num_tetrahedra, 4, S) at the points of ten nodes, in float64."""
        return np.stack([self.arrays.law_state_of(blocks) for blocks in runtime.fetch(self.z)])

    def put(self, values: np.ndarray | None) -> None:
        """The same of others; None: zero."""
        runtime.fill(self.z, 0 if values is None else np.stack([self.arrays.to_blocks(rows) for rows in values]))

    def add_to(self, z, frame: int) -> None:
        """Add what a frame has to slot 0 of z."""
        if frame >= 0:
            add_slot(self.z, frame, z, 0)
