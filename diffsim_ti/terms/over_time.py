"""An amount or a motion that is the same all the time, given for each step, or by a function or keyframes."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import TypeAliasType

from diffsim_ti.common.checked import numbers, shape_of, shown
from diffsim_ti.inputs import Input
from diffsim_ti.mesh import TetrahedralMesh

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

    def rows_in_time(self, own: str) -> list[str]:
        """Names of the rows of its numbers, of which `own` is the beginning."""
        return [f"{own} in time"]


def is_keyed(given: OverTime) -> bool:
    """Whether a load is given by a function or by keyframes, and so changes within steps."""
    return callable(given) or (isinstance(given, tuple) and len(given) == 2 and len(shape_of("times", given[0])) == 1)


def amount(argument: str, given: OverTime, shape: tuple, unit: str, plain: str) -> Input:
    """The input of an amount of a shape: its value, or rows that are sampled at the ends of each run's steps."""
    if is_keyed(given):
        return Input(argument, None, (("steps + 1", *shape),), unit, plain=plain)
    return Input(argument, given, (shape, ("steps", *shape)), unit, plain=plain, label=argument)


def between_keyframes(name: str, at: np.ndarray, values: np.ndarray, times: ArrayLike) -> np.ndarray:
    """Values of keyframes at times `at`, linear between; ValueError unless these increase."""
    if np.any(np.diff(at) <= 0):
        raise ValueError(f"{name}: keyframe times must increase, got {at.tolist()}")
    columns = values.reshape(len(at), -1).T
    return np.stack([np.interp(times, at, column) for column in columns], -1).reshape(len(times), *values.shape[1:])


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
        out = between_keyframes(name, at, to, times)
    if out.shape != (len(times), *shape) or not np.all(np.isfinite(out)):
        raise ValueError(f"{name}: must be finite and of shape {shape} at each time, got shape {out.shape[1:]}")
    return out


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
        out = between_keyframes(name, at, to, times)
    if not np.all(np.isfinite(out)):
        raise ValueError(f"{name}: displacements must be finite")
    return out


PER = ("all", "set", "tetrahedron")


class OfTetrahedra(GivenOverTime):
    """The part of a term that gives tetrahedra an amount over time; `tetrahedra` and `per` as the terms say."""

    def _take(
        self, argument: str, given: OverTime, plain: str, tetrahedra: str | Sequence[str] | ArrayLike | None, per: str
    ) -> tuple[Input, tuple]:
        """The input of the amount, and the shape of one row of it."""
        kind = type(self).__name__
        if per not in PER:
            raise ValueError(f"{kind}: per must be one of {', '.join(map(repr, PER))}, got {per!r}")
        if per == "set" and (isinstance(tetrahedra, str) or not all(isinstance(s, str) for s in tetrahedra or [0])):
            raise ValueError(f'{kind}: per="set" takes tetrahedra=["left", "right"], names of sets, got {tetrahedra!r}')
        shape = () if per == "all" else (len(tetrahedra),) if per == "set" else ("k",)
        self.given, self.keyed, self.per, self.tetrahedra = given, is_keyed(given), per, tetrahedra
        self.ndim, self._called = len(shape) + 1, f"{kind}: {argument}"
        return amount(argument, given, shape, "-", plain), shape

    def rows(self, times: ArrayLike) -> np.ndarray:
        at = self.given(0.0) if callable(self.given) else np.asarray(self.given[1])[0]
        return rows_at(self._called, self.given, times, np.shape(at))

    def groups(self, mesh: TetrahedralMesh) -> tuple[np.ndarray, np.ndarray]:
        """(tetrahedra, which number of a row each has)"""
        if self.per == "set":
            each = [mesh.tetrahedron_indices(own) for own in self.tetrahedra]
            return np.concatenate(each), np.repeat(np.arange(len(each)), [len(own) for own in each])
        every = np.arange(mesh.num_tetrahedra)
        chosen = every if self.tetrahedra is None else mesh.tetrahedron_indices(self.tetrahedra)
        return chosen, np.arange(len(chosen)) if self.per == "tetrahedron" else np.zeros(len(chosen), np.int64)

    def sizes(self, mesh: TetrahedralMesh) -> dict[str, int]:
        """How many tetrahedra "k" stands for."""
        return {"k": len(self.groups(mesh)[0])}

    def _shapes(self, chosen: np.ndarray) -> tuple[tuple, tuple]:
        """(the shape that a row must have for these tetrahedra, the one that is given)"""
        count = () if self.per == "all" else (len(self.tetrahedra) if self.per == "set" else len(chosen),)
        if self.keyed:
            return count, self.rows([0.0]).shape[1:]
        value = self.described[0].value
        return count, value.shape[value.ndim - len(count) :]
