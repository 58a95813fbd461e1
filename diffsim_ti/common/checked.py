"""What public entries check of what they are given: rule, value, remedy, before anything is computed."""

import math
from collections.abc import Iterable
from typing import Literal, get_args

import numpy as np


def shown(value) -> str:
    """A value in a message, never a whole array."""
    if isinstance(value, np.ndarray) and value.size > 6:
        return f"an array of shape {value.shape}"
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _float(value) -> float:
    """A number, nan for what is none."""
    try:
        return math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def number(name: str, value, low: float = 0.0, unit: str = "") -> float:
    """A finite number above `low`."""
    if not low < (out := _float(value)) < math.inf:
        raise ValueError(f"{name} must be > {low:g}{f' [{unit}]' if unit else ''}, got {shown(value)}")
    return out


def between(name: str, value, low: float, high: float, ends: bool) -> float:
    """A number from `low` to `high`; ends: these too."""
    out = _float(value)
    if not (low <= out <= high if ends else low < out < high):
        raise ValueError(f"{name} must lie between {low:g} and {high:g}, got {shown(value)}")
    return out


def whole(name: str, value, least: int = 0) -> int:
    """A whole number, at least so large."""
    try:
        out = int(value)
        if isinstance(value, bool | str) or out != value or not least <= out < 2**53:
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be a whole number >= {least}, got {shown(value)}") from None
    return out


def instance(owner: str, name: str, value, kind: type | tuple, remedy: str):
    """A value of a kind."""
    if not isinstance(value, kind):
        raise ValueError(f"{owner}: {name} must be {remedy}, got {shown(value)}")
    return value


def listed(name: str, value, of: str) -> Iterable:
    """Several of something."""
    if not isinstance(value, Iterable) or isinstance(value, str | bytes):
        raise ValueError(f"{name} must be one or several {of}, got {shown(value)}")
    return value


def numbers(name: str, value) -> np.ndarray:
    """A new float64 array."""
    return np.array(as_numbers(name, value), np.float64)


def as_numbers(name: str, value) -> np.ndarray:
    """A float64 array, the value itself if it is one."""
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    if getattr(value, "requires_grad", False):
        raise ValueError(
            f"{name} is a tensor with a graph, which arrays would cut off: take diffsim_ti.rollout_frames, through "
            f"which gradients flow, or give {name}.detach()"
        )
    try:
        array = np.asarray(value)
        if array.dtype.kind in "cSUVMm":  # NumPy would drop what is imaginary, and read letters
            raise ValueError
        return array.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be numbers, got {shown(value)}") from None


Up = Literal["x", "y", "z", "-x", "-y", "-z"]


def upwards(owner: str, up: Up) -> tuple[int, int]:
    """(axis, sign) of the direction that points up."""
    if not isinstance(up, str) or up not in get_args(Up):
        raise ValueError(f"{owner}: up must be one of {', '.join(map(repr, get_args(Up)))}, got {shown(up)}")
    return "xyz".index(up[-1]), -1 if up[0] == "-" else 1


def wholes(name: str, value) -> np.ndarray:
    """A new int64 array of whole numbers."""
    out = numbers(name, value)
    if not np.all(np.abs(out) < 2.0**53) or not np.all(out == np.rint(out)):
        raise ValueError(f"{name} must be whole numbers, got {shown(value)}")
    return out.astype(np.int64)


def present(name: str, value) -> None:
    """Something, not None."""
    if value is None:
        raise ValueError(f"{name} must be given, got None")


def shape_of(name: str, value) -> tuple:
    """Shape of what is given as an array, rows of one length."""
    try:
        return np.shape(value)
    except ValueError:
        raise ValueError(f"{name} must be an array whose rows have one length, got {shown(value)}") from None
