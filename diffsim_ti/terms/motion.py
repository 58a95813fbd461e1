"""A motion that is given over time, read at some times."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import TypeAliasType

from diffsim_ti.common.checked import numbers, shown

# a function of time [s], or keyframes (times [s], displacements [m])
Motion = TypeAliasType("Motion", Callable[[float], ArrayLike] | tuple[ArrayLike, ArrayLike])


def sampled(name: str, motion: Motion, times: ArrayLike, k: int) -> np.ndarray:
    """A motion of k points at each time [s], shape (len(times), k, 3) [m].

    motion: a function of time that returns 3 numbers or shape (k, 3), or keyframes (times, displacements).
    """
    if callable(motion):
        out = np.array([np.broadcast_to(np.asarray(motion(float(t)), np.float64), (k, 3)) for t in times])
    else:
        if not isinstance(motion, tuple | list) or len(motion) != 2:
            raise ValueError(f"{name}: a function of time, or keyframes (times, displacements), got {shown(motion)}")
        at, to = (numbers(name, part) for part in motion)
        to = np.broadcast_to(to[:, None, :] if to.ndim == 2 else to, (len(at), k, 3))
        if np.any(np.diff(at) <= 0):
            raise ValueError(f"{name}: keyframe times must increase")
        out = np.stack([np.interp(times, at, column) for column in to.reshape(len(at), -1).T], -1).reshape(-1, k, 3)
    if not np.all(np.isfinite(out)):
        raise ValueError(f"{name}: displacements must be finite")
    return out
