"""Inputs that can change in time, given step by step."""

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.common.checked import as_numbers

if TYPE_CHECKING:
    from diffsim_ti.inputs.inputs import Inputs

ROWS = "steps", "steps + 1"


class StepValues:
    """Makes of what steps are given the values of runs of one step, and keeps them until others are given.

    What a term has as a constant, or for each step, is held during the step. What it has by a function or by keyframes, as
    motions and paths are, goes linearly to the value that it is given, from where it was.

    join: np.stack, or that of tensors, which may then be given. scenes: how many, where values may have an axis of scenes
    in front.
    """

    def __init__(self, inputs: "Inputs", dt: float, join: Callable = np.stack, scenes: int | None = None):
        self.inputs, self.dt, self.join, self.scenes = inputs, dt, join, scenes
        self.takes_tensors = join is not np.stack
        self.names = tuple(name for name, described in inputs.described.items() if described.is_per_step)
        self._own: set[str] = set()  # inputs that scenes have of their own

    def next(self, step: int, given: Mapping, last: Mapping) -> dict:
        """Values for step number `step`: those given, and the `last` ones, which stay as they ended.

        Raises ValueError, before anything is computed, for names and shapes that no step takes.
        """
        for name in given:
            if name not in self.names:
                raise ValueError(self._unknown(name))
        out = dict(last)
        for name in filter(self.is_ramp, last):
            out[name] = self.join([self._end(name, last[name])] * 2, int(name in self._own))
        for name, value in given.items():
            tensor = self.takes_tensors and hasattr(value, "detach")
            if getattr(value, "requires_grad", False) and not tensor:
                raise ValueError(
                    f"step: {name} is a tensor with a graph, which a Simulator would cut off: take "
                    f"diff_simulator.TorchSimulator, or give {name}.detach()"
                )
            out[name] = self._of_step(name, value if tensor else np.array(as_numbers(name, value)), step, last)
            if not self.takes_tensors:  # others are checked where they run
                out |= self.inputs.check({name: out[name]})
        return out

    def _unknown(self, name: str) -> str:
        known = ", ".join(self.names) or "none"
        if name in self.inputs.described:
            return f"step: {name} is one value of the whole run; inputs of this scene that can change in time: {known}"
        near = get_close_matches(str(name), self.names, 1, 0.5)
        meant = f": did you mean {near[0]!r}?" if near else ";"
        return f"step: no input named {name!r} can change in time{meant} This scene has: {known}"

    def is_ramp(self, name: str) -> bool:
        """Whether an input goes linearly within steps."""
        return any("steps + 1" in rule for rule in self.inputs.described[name].shapes)

    def _end(self, name: str, rows):
        return rows[:, -1] if name in self._own else rows[-1]

    def _of_step(self, name: str, value, step: int, last: Mapping):
        described, ramp = self.inputs.described[name], self.is_ramp(name)
        rules = [tuple(self.inputs.sizes.get(a, a) for a in rule if a not in ROWS) for rule in described.shapes]
        item, rows = (lambda s: any(_fits(s, rule) for rule in rules)), 2 if ramp else 1
        takes = lambda s: item(s) or s[:1] == (rows,) and item(s[1:])  # noqa: E731
        shape, own = tuple(value.shape), False
        if self.scenes and shape[:1] == (self.scenes,) and takes(shape[1:]):
            own = True
            if takes(shape):
                raise ValueError(
                    f"step: {name} of shape {shape} may be one value for all scenes or one for each of {self.scenes}: give "
                    f"both rows of each scene, shape {(self.scenes, *shape)}"
                )
        elif not takes(shape):
            one = " or ".join(map(str, dict.fromkeys(rules)))
            how = f"at the end of the step, or {rows} of them, as it begins and ends," if ramp else "for the step"
            scenes = f", maybe with an axis of {self.scenes} scenes in front" if self.scenes else ""
            raise ValueError(f"step: {name}: expected a value of shape {one} {how}{scenes}, got shape {shape}")
        alone = item(shape[own:])
        if not ramp:
            self._own = self._own | {name} if own else self._own - {name}
            lacks = alone and not described.fits(shape[own:], self.inputs.sizes)  # it is known for each step alone
            return self.join([value], int(own)) if lacks else value
        if alone:
            begin = self._end(name, last[name]) if name in last else self._begin(name, step)
            if own and name not in self._own:
                begin = self.join([begin] * self.scenes, 0)
            elif name in self._own and not own:
                value, own = self.join([value] * self.scenes, 0), True
            value = self.join([begin, value], int(own))
        self._own = self._own | {name} if own else self._own - {name}
        return value

    def _begin(self, name: str, step: int) -> np.ndarray:
        """What the scene has of it when a step begins."""
        return self.inputs.at_times([step * self.dt, (step + 1) * self.dt])[name][0]


def _fits(shape: tuple, rule: tuple) -> bool:
    return len(shape) == len(rule) and all(isinstance(b, str) or a == b for a, b in zip(shape, rule))
