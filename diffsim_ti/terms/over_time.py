"""An amount that is the same all the time, given for each step, or by a function or keyframes."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import TypeAliasType

from diffsim_ti.common.checked import shape_of
from diffsim_ti.inputs import Input

# what holds all the time, one for each step, a function of time [s], or keyframes (times [s], values)
OverTime = TypeAliasType("OverTime", ArrayLike | Callable[[float], ArrayLike] | tuple[ArrayLike, ArrayLike])


class GivenOverTime:
    """The part of a term whose first input is an amount over time, of a `shape`."""

    shape: tuple = ()

    def _give(self, given: OverTime) -> None:
        self.given, self.keyed = given, is_keyed(given)
        if self.keyed:
            self.rows([0.0])  # refuses what does not fit

    @property
    def plain(self) -> str:
        """Plain name of the input."""
        return self.described[0].plain

    def rows(self, times: ArrayLike) -> np.ndarray:
        """The amount at each time [s], where it is keyed."""
        return rows_at(f"{type(self).__name__}: {self.plain}", self.given, times, self.shape)


def is_keyed(given: OverTime) -> bool:
    """Whether a load is given by a function or by keyframes, and so changes within steps."""
    return callable(given) or (isinstance(given, tuple) and len(given) == 2 and len(shape_of("times", given[0])) == 1)


def amount(argument: str, given: OverTime, shape: tuple, unit: str, plain: str) -> Input:
    """The input of an amount of a shape: its value, or rows that are sampled at the ends of each run's steps."""
    if is_keyed(given):
        return Input(argument, None, (("steps + 1", *shape),), unit, plain=plain)
    return Input(argument, given, (shape, ("steps", *shape)), unit, plain=plain, label=argument)


def rows_at(name: str, given: OverTime, times: ArrayLike, shape: tuple) -> np.ndarray:
    """A keyed amount at each time [s], shape (len(times), *shape); beyond the first and last keyframe it stays.

    Raises ValueError for keyframes that do not fit, and for what is not finite.
    """
    if callable(given):
        out = np.array([np.asarray(given(float(t)), np.float64) for t in times])
    else:
        at, to = (np.asarray(part, np.float64) for part in given)
        if len(to) != len(at) or to.shape[1:] != shape:
            raise ValueError(
                f"{name}: keyframes (times, values) need values of shape {(len(at), *shape)} for {len(at)} times, got "
                f"{to.shape}; what is given for each step is an array, not a tuple"
            )
        if np.any(np.diff(at) <= 0):
            raise ValueError(f"{name}: keyframe times must increase, got {at.tolist()}")
        columns = to.reshape(len(at), -1).T
        out = np.stack([np.interp(times, at, column) for column in columns], -1).reshape(len(times), *shape)
    if out.shape != (len(times), *shape) or not np.all(np.isfinite(out)):
        raise ValueError(f"{name}: must be finite and of shape {shape} at each time, got shape {out.shape[1:]}")
    return out
