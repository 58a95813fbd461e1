"""What an advice says: the way to run a scene, what to expect of it, and why."""

from dataclasses import dataclass, field

import numpy as np
from typing_extensions import Unpack

from diffsim_ti.rollout import Rollout
from diffsim_ti.rollout.rollout import RolloutOptions
from diffsim_ti.scene import Scene
from diffsim_ti.study.alternatives import Alternative
from diffsim_ti.study.elements import ElementTrial


@dataclass
class Option:
    """A way to run a scene, with what a trial run says of it."""

    solver: type
    precision: str
    substep: float  # [s]
    steps: int  # of the whole duration
    error: float = np.nan  # over the whole duration, relative to the largest displacement
    seconds: float = np.nan  # wall time of the whole duration, with its gradient if asked for
    substeps: int = 0  # per frame of the trial

    @property
    def label(self) -> str:
        return f"{self.solver.__name__}, {self.substep:.3g} s, {self.precision}"


@dataclass(repr=False)
class Recommendation:
    """What to use: `solver`, `dt` [s], `steps`, `precision`, `memory` [MB] for the checkpoints, `element`; what to expect
    of it: `seconds` of wall time, `megabytes` kept for gradients, `error` relative to the largest displacement.

    `reasons`: three lines; `left_out`: what the scene does without, and why. `rollout(scene)` makes it, of the scene as it
    is. `elements`: what its mesh makes wrong by each kind of element; `element`: the cheapest that keeps to the tolerance.
    `alternatives`: mass scaling, stiff parts that move affinely and adaptive steps beside it, where these keep to the
    tolerance.
    """

    option: Option
    duration: float
    gradients: bool
    memory: float | None
    megabytes: float
    error: float
    element: str
    reasons: list[str]
    left_out: list[str]
    tried: list[Option] = field(repr=False, default_factory=list)
    elements: list[ElementTrial] = field(repr=False, default_factory=list)
    alternatives: list[Alternative] = field(repr=False, default_factory=list)

    solver = property(lambda self: self.option.solver)
    precision = property(lambda self: self.option.precision)
    dt = property(lambda self: self.option.substep)
    steps = property(lambda self: self.option.steps)
    seconds = property(lambda self: self.option.seconds)

    def rollout(self, scene: Scene, frames: int = 1, **options: Unpack[RolloutOptions]) -> Rollout:
        """The recommended run of the scene, `frames` times saved; options are Rollout's."""
        substeps = -(-self.steps // frames)
        solver = self.solver(scene.replace(precision=self.precision), dt=self.duration / frames, substeps=substeps)
        return Rollout(solver, frames, save_every=1, memory=self.memory, **options)

    def __str__(self) -> str:
        kept = f"{self.megabytes:.3g} MB" if self.gradients else "no states"
        return "\n".join(
            [
                f"{self.solver.__name__}(scene, dt={self.dt:.4g}), {self.steps} steps, precision {self.precision}, "
                f"element {self.element}" + (f", Rollout(..., memory={self.memory:g})" if self.memory else ""),
                f"expect: {self.seconds:.3g} s of wall time, {kept} kept, "
                f"error {self.error:.2g} of the largest displacement",
                *(f"- {line}" for line in self.reasons),
                *([f"- elements: {'; '.join(map(str, self.elements))}, of the mesh alone"] if self.elements else []),
                *(f"- beside it: {other}" for other in self.alternatives),
                "left out: " + "; ".join(self.left_out),
            ]
        )

    __repr__ = __str__
