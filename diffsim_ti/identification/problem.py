"""Residuals of several experiments as one function of the free variables, with products by its Jacobian both ways."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from diffsim_ti.identification.measurements import Measurement
from diffsim_ti.identification.modal_test import ModalTest
from diffsim_ti.identification.unknowns import TIME_OFFSET, Free, Unknown
from diffsim_ti.outputs.modes import Modes
from diffsim_ti.rollout import Frames, Rollout

Experiment = Rollout | ModalTest


@dataclass
class Point:
    """Free variables t, the frames of each experiment there, and the residuals of all, in deviations."""

    t: np.ndarray
    frames: list[Frames | Modes]
    residual: np.ndarray


def experiments(rollout, data, noise) -> tuple[list, list, list]:
    """Experiments, and the data and the noise of each."""
    if isinstance(rollout, Experiment):
        return [rollout], [data], [noise]
    rollouts, data = list(rollout), list(data)
    noises = list(noise) if isinstance(noise, list | tuple) else [noise] * len(rollouts)
    if not len(rollouts) == len(data) == len(noises):
        raise ValueError(
            f"identify: {len(rollouts)} rollouts need as many data, got {len(data)}, and as many noises, got {len(noises)}"
        )
    return rollouts, data, noises


class Problem:
    """r(t): what is measured less what is simulated, over the noise, of all experiments; counts its simulations."""

    def __init__(self, rollouts: list[Experiment], data: list[list[Measurement]], unknowns: dict):
        if not unknowns:
            raise ValueError("identify: nothing is unknown; name an input, such as {'youngs_modulus': 1e5}")
        for rollout, given in zip(rollouts, data):
            for measurement in given:
                measurement.check(rollout)
        self.rollouts, self.data, self.simulations = rollouts, data, 0
        given = {k: x if isinstance(x, Unknown) else _plain(k, x) for k, x in unknowns.items()}
        self.unknowns = [Free(unknown, label, rollouts) for label, unknown in given.items()]
        for k in range(len(rollouts)):
            self._check_unknowns(k)
        ends = np.cumsum([0, *(free.size for free in self.unknowns)])
        self.parts, self.size = [slice(a, b) for a, b in zip(ends, ends[1:])], int(ends[-1])
        self.labels = [f"{f.label}[{i}]" if f.size > 1 else f.label for f in self.unknowns for i in range(f.size)]
        self.reach = np.concatenate([self._reach(free) for free in self.unknowns], 1)
        self.num_data = sum(int(m.seen.sum()) for given in data for m in given)
        when = [m.when(rollout) for rollout, given in zip(rollouts, data) for m in given]
        self.when, self.counts = np.concatenate([np.zeros(0), *when]), np.ones(())  # whether a datum does

    def _check_unknowns(self, k: int) -> None:
        """Raise ValueError where unknowns share a number of experiment k, or an offset of time moves nothing there."""
        seen: dict[str, list[Free]] = {}
        for free in self.unknowns:
            if k not in free.experiments:
                continue
            if free.is_offset and all(m.times is None for m in self.data[k]):
                raise ValueError(
                    f"{free.label}: time_offset moves measurements with times of their own, and experiment {k} has none: "
                    "give its Measurement times, or choose other experiments"
                )
            for other in seen.setdefault(free.input, []):
                if np.any((free.rows[k] >= 0) & (other.rows[k] >= 0)):
                    raise ValueError(
                        f"{other.label} and {free.label} are both the same numbers of {free.input!r} in experiment {k}: "
                        "keep one, or tell them apart by regions (-1 for what is fixed) or experiments"
                    )
            seen[free.input].append(free)

    def _reach(self, free: Free) -> np.ndarray:
        """The least and the largest t of an unknown; times that an offset is added to stay within those of their runs."""
        reach = free.reach()
        if not free.is_offset:
            return reach
        timed = [
            (self.rollouts[k].times, m.times) for k in free.experiments for m in self.data[k] if m.times is not None
        ]
        least = max(run[0] - at.min(initial=np.inf) for run, at in timed)
        most = min(run[-1] - at.max(initial=-np.inf) for run, at in timed)
        with np.errstate(invalid="ignore", divide="ignore"):  # of what the unknown itself cannot be
            low, high = free.free(least), free.free(most)
        low, high = (low, high) if free.slopes(np.zeros(1)) > 0 else (high, low)
        return np.stack([np.minimum(np.fmax(reach[0], low), 0.0), np.maximum(np.fmin(reach[1], high), 0.0)])

    def _of(self, k: int) -> Iterable[tuple[Free, slice]]:
        return [(free, part) for free, part in zip(self.unknowns, self.parts) if k in free.experiments]

    def check_gradients(self) -> None:
        """For searches by J^T w."""
        for k, rollout in enumerate(self.rollouts):
            for free, _ in self._of(k):
                if not free.is_offset and free.input not in getattr(rollout, "wanted", (free.input,)):
                    raise ValueError(
                        f"{free.label}: the rollout has no gradient by {free.input!r}; name it in gradients="
                    )

    def inputs(self, k: int, t: np.ndarray) -> dict[str, np.ndarray]:
        """Inputs of experiment k, offset of time too."""
        out = {}
        for free, part in self._of(k):
            base = 0.0 if free.is_offset else out.get(free.input, self.rollouts[k].values.get(free.input))
            out[free.input] = free.spread(k, free.numbers(t[part]), base)
        return out

    @contextmanager
    def until(self, share: float) -> Iterator[int]:
        """For a while only data of the first share of each run count; how many there are."""
        self.counts = self.when <= share
        try:
            yield int(self.counts.sum())
        finally:
            self.counts = np.ones(())

    def run(self, t: np.ndarray) -> Point:
        """A run of each experiment."""
        inputs, frames, residual = [self.inputs(k, t) for k in range(len(self.rollouts))], [], []
        offsets = [float(values.pop(TIME_OFFSET, 0.0)) for values in inputs]
        for rollout, given, offset in zip(self.rollouts, self.data, offsets):
            for m in given:
                m.check_times(rollout, offset)
        for k, (rollout, values, offset) in enumerate(zip(self.rollouts, inputs, offsets)):
            frames.append(rollout.forward(**values))
            self.simulations += 1
            residual += [m.residual(frames[-1], offset) for m in self.data[k]]
        return Point(np.array(t), frames, self.counts * np.concatenate(residual))

    def product(self, point: Point, d: np.ndarray) -> np.ndarray:
        """J d: a tangent run of each experiment whose inputs change."""
        out = []
        for k, rollout in enumerate(self.rollouts):
            offset, d_offset, tangents = 0.0, 0.0, {}
            for free, part in self._of(k):
                dx = free.slopes(point.t[part]) * d[part]
                if free.is_offset:
                    offset, d_offset = float(free.numbers(point.t[part])[0]), float(dx[0])
                elif np.any(dx):
                    tangents[free.input] = tangents.get(free.input, 0.0) + free.spread(k, dx, np.zeros(()))
            changes = {}
            if tangents:
                changes = rollout.tangents(point.frames[k], **tangents)
                self.simulations += 1
            out += [m.change(point.frames[k], changes.get(m.output), offset, d_offset) for m in self.data[k]]
        return self.counts * np.concatenate(out)

    def transposed(self, point: Point, w: np.ndarray) -> np.ndarray:
        """J^T w: a reverse sweep of each experiment."""
        out, begin, w = np.zeros(self.size), 0, self.counts * w
        for k, rollout in enumerate(self.rollouts):
            values, seeds, by_offset = self.inputs(k, point.t), {}, 0.0
            offset = float(values.get(TIME_OFFSET, 0.0))
            for m in self.data[k]:
                end = begin + len(m.deviation)
                seed, direct = m.pulled(point.frames[k], w[begin:end], offset)
                seeds[m.output], by_offset, begin = seeds.get(m.output, 0.0) + seed, by_offset + direct, end
            gradients = rollout.vjp(point.frames[k], **seeds)
            self.simulations += 1
            for free, part in self._of(k):
                by_x = [by_offset] if free.is_offset else free.gathered(k, gradients[free.input])
                out[part] += free.slopes(point.t[part]) * by_x
        return out

    def jacobian(self, point: Point) -> np.ndarray:
        """J, shape (data, variables), a tangent run for each column."""
        return np.stack([self.product(point, column) for column in np.eye(self.size)], 1)

    def numbers(self, t: np.ndarray) -> dict[str, np.ndarray | float]:
        """{unknown: its numbers}"""
        found = {free.label: free.numbers(t[part]) for free, part in zip(self.unknowns, self.parts)}
        return {name: float(x[0]) if x.size == 1 else x for name, x in found.items()}

    def all_numbers(self, t: np.ndarray) -> np.ndarray:
        return np.concatenate([free.numbers(t[part]) for free, part in zip(self.unknowns, self.parts)])


def _plain(label: str, start) -> Unknown:
    """An unknown given by its start alone; Poisson's ratio keeps to its range."""
    return Unknown(start, range=(-1.0, 0.5)) if label == "poissons_ratio" else Unknown(start)
