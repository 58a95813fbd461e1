"""Where each pass of a run lies in time: its step, its share of it, its length. One description for host and kernels.

A motion, a path or a force is given by rows, one for each step's end; within step r it goes linearly from row r to row
r + 1. Pass j begins at the share `begin` of its step and ends at the share `end`, so that a row's value there is

    (1 - share) row[r] + share row[r + 1],        its rate of change (row[r + 1] - row[r]) / (length of the step).

Rows may be arrays of any shape; nothing here says that they are three numbers.
"""

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.common.public import Public
from diffsim_ti.state.pass_table import FLOATS, INTS, between


class Schedule(metaclass=Public):
    """Steps, each of equal passes; j may be a number or an array of passes, which may end one beyond the last.

    varies: whether passes may differ in length.
    """

    varies = False

    @abstractmethod
    def row(self, j):
        """The step that pass j lies in."""

    @abstractmethod
    def first(self, step):
        """Passes before a step; also how many so many steps take."""

    @abstractmethod
    def time(self, step):
        """When a step begins [s]."""

    @abstractmethod
    def step_length(self, j):
        """Length of the step of pass j [s]."""

    @abstractmethod
    def length(self, j):
        """Length h of pass j [s]."""

    @abstractmethod
    def begin(self, j):
        """Share of its step at which pass j begins."""

    @abstractmethod
    def end(self, j):
        """Share of its step at which pass j ends."""

    @property
    @abstractmethod
    def longest(self) -> float:
        """The longest pass [s]."""

    @abstractmethod
    def stretches(self, first: int, last: int) -> list[tuple[int, int]]:
        """Passes first .. last - 1 in parts, (first, last), within which all have one length."""

    # ---- frames, one every so many steps -----------------------------------------------------------------------------

    def shown(self, j, every: int):
        """The frame that the state before pass j is, or -1; every: 0 for no frames."""
        row = self.row(j)
        if isinstance(j, int):  # as host passes ask
            return row // every if every and j == self.first(row) and row % every == 0 else -1
        return np.where((every > 0) & (j == self.first(row)) & (row % max(every, 1) == 0), row // max(every, 1), -1)

    def counted(self, j, every: int):
        """The frame that pass j leads to, or -1."""
        return self.row(j) // every + 1 if every else -1 + 0 * j

    def ends_frame(self, j: int, every: int) -> bool:
        """Whether the state after pass j is a frame."""
        return bool(self.shown(j + 1, every) >= 0)

    def frame_time(self, frame: int, every: int) -> float:
        """Time between a frame and the one before [s]."""
        return float(self.time(frame * every) - self.time((frame - 1) * every))

    # ---- rows of a motion: all that is read of rows is linear in them ------------------------------------------------

    def place(self, rows: np.ndarray, j: int, share: float) -> np.ndarray:
        """The value at a share of the step of pass j; beyond the last row it stays."""
        r, after = self._rows(rows, j)
        return between(rows[r], rows[after], share)

    def rate(self, rows: np.ndarray, j: int) -> np.ndarray:
        """The rate of change in the step of pass j [1/s]."""
        r, after = self._rows(rows, j)
        return (rows[after] - rows[r]) / self.step_length(j)

    def row_of(self, rows: np.ndarray, j: int) -> int:
        """The row at which the step of pass j begins."""
        return self._rows(rows, j)[0]

    # ---- loads: rows of steps, with their values at the beginning and at the end -------------------------------------

    def load_row(self, rows: np.ndarray, j: int) -> int:
        """The row of pass j among those of loads, of which one may serve all steps."""
        return min(int(self.row(j)), len(rows) - 1) if len(rows) > 1 else 0

    def load(self, rows: np.ndarray, j: int, share: float, keyed: bool) -> np.ndarray:
        """Forces at a share of the step of pass j; keyed: rows have those at the beginning and at the end in turn."""
        row = rows[self.load_row(rows, j)]
        return between(row[0::2], row[1::2], share) if keyed else row

    def pressure(self, rows: np.ndarray, j: int, share: float) -> np.ndarray:
        """Pressures of loads at a share of the step of pass j."""
        row = rows[self.load_row(rows, j)]
        return between(row[:, 0], row[:, 1], share)

    def growth(self, rows: np.ndarray, j: int, share: float) -> np.ndarray:
        """What tetrahedra have grown by, of rows (steps, 2, m), at a share of the step of pass j."""
        return between(*rows[self.load_row(rows, j)], share)

    def lines(self, rows: np.ndarray, j: int, share: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(tension, slack, stiffness) of springs and cables (inputs/lines.py) at a share of the step of pass j."""
        row = rows[self.load_row(rows, j)]
        tension, slack = (between(part[:, 0], part[:, 1], share) for part in (row[0::2], row[1::2]))
        return tension, slack, row[0::2, 2]

    def _rows(self, rows, j):
        r = min(self.row(j), len(rows) - 1)
        return r, min(r + 1, len(rows) - 1)

    # ---- for kernels -------------------------------------------------------------------------------------------------

    def table(
        self, first: int, last: int, num_rows: int, save_every: int, weights: dict
    ) -> tuple[np.ndarray, np.ndarray]:
        """(INTS, FLOATS) of passes first .. last - 1, one row each; weights: the solver's numbers by name (explicit/);
        save_every: steps between frames."""
        j = np.arange(first, last)
        row = np.minimum(self.row(j), num_rows - 1)
        ints = {
            "row": row,
            "next": np.minimum(row + 1, num_rows - 1),
            "force0": self.row(j - weights["lag0"]),
            "force1": self.row(j - weights["lag1"]),
            "frame": self.shown(j, save_every),
            "counted": self.counted(j, save_every),
            "opens": j == self.first(self.row(j)),
        }
        floats = dict(begin=self.begin(j), end=self.end(j), per_step=1 / self.step_length(j), h=self.length(j))
        floats |= {name: weights[name] for name in FLOATS if name in weights}
        return tuple(
            np.stack([np.broadcast_to(columns[name], len(j)) for name in names], 1)
            for names, columns in ((INTS, ints), (FLOATS, floats))
        )


@dataclass(frozen=True)
class EqualSteps(Schedule):
    """As many steps as asked for, each of dt [s] and of `substeps` passes."""

    dt: float
    substeps: int

    def row(self, j):
        return j // self.substeps

    def first(self, step):
        return step * self.substeps

    def time(self, step):
        return step * self.dt

    def step_length(self, j):
        return self.dt + 0 * j

    def length(self, j):
        return self.dt / self.substeps + 0 * j

    def begin(self, j):
        return j % self.substeps / self.substeps

    def end(self, j):
        return (j % self.substeps + 1) / self.substeps

    @property
    def longest(self):
        return self.dt / self.substeps

    def stretches(self, first, last):
        return [(first, last)] if first < last else []


class UnequalSteps(Schedule):
    """Steps of lengths [s] of one's own, shape (steps,), each divided into `substeps` equal passes: a number, or one for
    each step.

    Pass it as `steps` of a `Rollout`. Forces per step, motions and paths go by these steps, and frames stand at their ends.
    Gradients are those of the steps as they are: exact, for nothing here depends on the state.
    Symplectic solvers keep energy for long times with equal steps alone; each change of the step moves the energy that
    they keep, by the order of the solver. Hairer, Lubich, Wanner, Geometric Numerical Integration, VIII.1,
    doi:10.1007/3-540-30666-8.
    Raises ValueError for lengths that are not > 0, and for substeps that are not whole numbers >= 1.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], precision="f64")
    >>> steps = ds.UnequalSteps([1e-3, 2e-3, 7e-3], substeps=[1, 2, 7])
    >>> frames = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-3), steps).forward()
    >>> print(f"{frames.times[-1]:.3f} s, {frames.displacements[-1, 0, 1]:.7f} m")
    0.010 s, -0.0004905 m
    """

    varies = True

    def __init__(self, lengths: ArrayLike, substeps: ArrayLike = 1):
        lengths, parts = np.atleast_1d(numbers("lengths of steps", lengths)), np.asarray(substeps)
        if lengths.ndim != 1 or not (np.all(np.isfinite(lengths)) and np.all(lengths > 0)):
            raise ValueError("lengths of steps must be > 0 [s], one number for each step")
        if lengths.size == 0:
            raise ValueError(
                "lengths of steps: expected one number [s] for each step, got none; Rollout(solver, 0) runs none"
            )
        whole = parts.dtype.kind in "iuf" and np.all((parts == np.floor(parts)) & (parts >= 1) & np.isfinite(parts))
        if not whole or parts.shape not in ((), lengths.shape):
            raise ValueError(
                f"substeps must be whole numbers >= 1, one for all steps or one for each of {len(lengths)}, got shape "
                f"{parts.shape}"
            )
        self.lengths, self.substeps = lengths, np.broadcast_to(parts, lengths.shape).astype(np.int64)
        self._first = np.concatenate([[0], np.cumsum(self.substeps)])
        self._time = np.concatenate([[0.0], np.cumsum(lengths)])
        for kept in (self.lengths, self.substeps, self._first, self._time):
            kept.setflags(write=False)

    def __len__(self) -> int:
        return len(self.lengths)

    def __repr__(self) -> str:
        h = self.lengths / self.substeps
        return (
            f"UnequalSteps({len(self)} steps, {self._first[-1]} substeps of {h.min(initial=np.inf):.4g} to "
            f"{h.max(initial=0):.4g} s, {self._time[-1]:.6g} s)"
        )

    def _step(self, j):
        return np.minimum(self.row(j), len(self) - 1)

    def row(self, j):
        return np.searchsorted(self._first, j, side="right") - 1

    def first(self, step):
        return self._first[step]

    def time(self, step):
        return self._time[step]

    def step_length(self, j):
        return self.lengths[self._step(j)]

    def length(self, j):
        k = self._step(j)
        return self.lengths[k] / self.substeps[k]

    def begin(self, j):
        k = self.row(j)
        return (j - self._first[k]) / self.substeps[np.minimum(k, len(self) - 1)]

    def end(self, j):
        return (j - self._first[self.row(j)] + 1) / self.substeps[self._step(j)]

    @property
    def longest(self):
        return float((self.lengths / self.substeps).max())

    def stretches(self, first, last):
        h = self.length(np.arange(first, last))
        ends = np.flatnonzero(np.abs(np.diff(h)) > 1e-12 * h[1:]) + 1 + first if last > first else []
        bounds = [first, *(int(e) for e in ends), last]
        return [(a, b) for a, b in zip(bounds, bounds[1:]) if a < b]


def _of_whole(method: str):
    """A method of pass j: that of other steps for the pass which it is a part of."""
    return lambda self, j: getattr(self.whole, method)(j // self.stages)


@dataclass(frozen=True)
class StagedSteps(Schedule):
    """Every pass of other steps as `stages` passes, each of which has the length and the place in time of that pass: each
    substep is kicked several times before it drifts."""

    whole: Schedule
    stages: int

    row, step_length, length, begin, end = map(_of_whole, ("row", "step_length", "length", "begin", "end"))
    varies, longest = (property(lambda self, name=name: getattr(self.whole, name)) for name in ("varies", "longest"))
    substeps = property(lambda self: self.stages * self.whole.substeps)

    def first(self, step):
        return self.stages * self.whole.first(step)

    def time(self, step):
        return self.whole.time(step)

    def stretches(self, first, last):
        of_whole = self.whole.stretches(first // self.stages, -(-last // self.stages))
        return [(max(first, a * self.stages), min(last, b * self.stages)) for a, b in of_whole]
