"""Lengths and tensions of springs and cables."""

from copy import copy

import numpy as np

from diffsim_ti.common.deprecated import renamed_arguments
from diffsim_ti.mechanics.lines.interaction import SpringsAndCables
from diffsim_ti.outputs.forces_at_frames import at_end
from diffsim_ti.outputs.output import Frames, Output, derived
from diffsim_ti.scene import Scene
from diffsim_ti.terms.lines import LineTerm


class _OfLines(Output):
    """One number for each spring or cable of a term, from the state in each frame and the loads at the end of the step that
    leads to it; shape (frames,) of a cable or a single spring, else (frames, k).

    quantity: which the host form of lines has under this name.
    """

    quantity: str
    _shown = ("of",)

    def __init__(self, of: LineTerm | str, name: str):
        self.of, self.name = of, name

    def settled(self, scene: Scene) -> "_OfLines":
        out = copy(self)
        lines = scene.interaction(SpringsAndCables)
        number = scene.place_among(lines.terms if lines else (), self.of, "spring or cable")
        out.scene, out.own, out.lines = scene, lines.places(number), lines.host()
        out.count = out.own.stop - out.own.start
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,) if self.count == 1 else (num_frames, self.count)

    def value(self, frames: Frames) -> np.ndarray:
        of, out = derived(self.scene, frames), []
        for step, x in zip(frames.steps, frames.positions.astype(np.float64)):
            lines = self.lines.take(of, at_end(int(step)))
            out.append(getattr(lines, self.quantity)(x - of.rest)[self.own])
        return np.stack(out).reshape(self.shape(len(out)))


class Length(_OfLines):
    """Length L [m] of a cable along its points, or of springs between theirs, in each frame; shape (frames,), or
    (frames, k) of a `Spring` term with k springs.

    of: the name of the `Spring` or `Cable`, or the term as the scene lists it. name: what losses call the output.
    The gradient is exact with respect to all inputs; that of a spring of zero length is set to 0.
    Raises ValueError for a spring or cable that is not in the scene.
    Zienkiewicz, Taylor 2000, The Finite Element Method, vol. 2, 5th ed., sec. 10.2.
    """

    unit, quantity = "m", "lengths"

    @renamed_arguments(tie="of")
    def __init__(self, of: LineTerm | str, name: str = "length"):
        super().__init__(of, name)


class Tension(_OfLines):
    """Tension T [N] of a cable or of springs (negative in compression), in each frame; shape (frames,), or (frames, k) of a
    `Spring` term with k springs. A prescribed tension is that at the end of the step that leads to the frame.

    of: the name of the `Spring` or `Cable`, or the term as the scene lists it. name: what losses call the output.
    The gradient is exact with respect to all inputs; it is 0 for a slack cable. In single precision the tension has
    the error of the positions, about 1e-7 of them, times the stiffness.
    Raises ValueError for a spring or cable that is not in the scene.
    Zienkiewicz, Taylor 2000, The Finite Element Method, vol. 2, 5th ed., sec. 10.2.
    """

    unit, quantity = "N", "tensions"

    @renamed_arguments(tie="of")
    def __init__(self, of: LineTerm | str, name: str = "tension"):
        super().__init__(of, name)
