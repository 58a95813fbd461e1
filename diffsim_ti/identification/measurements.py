"""What was measured: values of an output of a rollout, some of them missing, at the frames or at times of their own."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.brief import brief
from diffsim_ti.common.checked import numbers, shown, wholes
from diffsim_ti.common.names import no_such
from diffsim_ti.common.origin import rounding_of
from diffsim_ti.common.public import Public
from diffsim_ti.common.warn import warn
from diffsim_ti.differentiation.arrays import Recorded, forward, made, reverse, value_of
from diffsim_ti.rollout import Frames, Rollout


class Measurement(metaclass=Public):
    """Values d of an output y of a rollout, with independent normal noise of standard deviation `noise`.

    output: "positions", "velocities", "displacements" or the name of one of the rollout's outputs. values: NaN where a
    sample is missing. noise: in the output's unit, > 0, one number or an array that fits the values.
    at: indices along the output's second axis (vertices, points) of those that were measured; default all.
    times: of the values' rows [s], where they are not the frames'; y is then a cubic spline through the frames, and may be
    shifted by the unknown "time_offset".
    De Boor, A Practical Guide to Splines, 1978, ch. IV.
    """

    def __init__(
        self,
        output: str,
        values: ArrayLike,
        noise: ArrayLike,
        at: ArrayLike | None = None,
        times: ArrayLike | None = None,
    ):
        self.output, self.values, self.noise = output, numbers("values", values), numbers("noise", noise)
        self.at = None if at is None else wholes("at", at)
        self.times = None if times is None else numbers("times [s]", times)
        if not np.all(self.noise > 0):
            raise ValueError(f"{output}: noise must be > 0, a standard deviation in the output's unit")
        self.seen = np.isfinite(self.values)
        if rounding_of(values) > self.noise.min(initial=np.inf):
            coarse = f"float32 rounds values by {rounding_of(values):.2g}, more than the noise"
            warn(f"{output}: {coarse}: give them in float64")
        if np.any(np.isinf(self.values)):
            raise ValueError(f"{output}: values must be finite, or NaN where a sample is missing")
        if self.noise.ndim > self.values.ndim or any(
            n not in (1, m) for n, m in zip(self.noise.shape[::-1], self.values.shape[::-1])
        ):
            raise ValueError(
                f"{output}: noise of shape {self.noise.shape} does not fit values of shape {self.values.shape}"
            )
        self.deviation = np.broadcast_to(self.noise, self.values.shape)[self.seen]

    def __repr__(self) -> str:
        at = "" if self.at is None else f", at {len(self.at)} items"
        return f"Measurement({self.output!r}, {brief(self.values)}, noise={brief(self.noise)}{at})"

    def check(self, rollout: Rollout) -> None:
        """Raise ValueError unless this is a measurement of that rollout."""
        if self.output not in rollout.outputs:
            raise ValueError("data: " + no_such("output", self.output, rollout.outputs, "this rollout"))
        shape = list(rollout.outputs[self.output].shape(rollout.num_frames))
        if self.at is not None:
            if len(shape) < 2:
                raise ValueError(f"{self.output}: values have one axis, of which `at` chooses nothing: leave it out")
            if self.at.ndim != 1 or np.any((self.at < -shape[1]) | (self.at >= shape[1])):
                raise ValueError(
                    f"{self.output}: at must be a list of indices in 0..{shape[1] - 1}, got {shown(self.at)}"
                )
            shape[1] = len(self.at)
        if self.times is not None:
            if rollout.num_frames < 2:
                raise ValueError(f"{self.output}: values are of one instant, which has no times: leave `times` out")
            if self.times.ndim != 1 or not np.all(np.isfinite(self.times)):
                raise ValueError(f"{self.output}: times must be a list of finite numbers [s], got {shown(self.times)}")
            shape[0] = len(self.times)
        if self.values.shape != tuple(shape):
            raise ValueError(f"{self.output}: expected values of shape {tuple(shape)}, got {self.values.shape}")

    def check_times(self, rollout: Rollout, offset: float) -> None:
        """Raise ValueError where a time is none of the run, by more than rounding."""
        (first, last), at = rollout.times[[0, -1]], self.times
        slight = 1e-12 * (last - first)
        if at is not None and np.any((at + offset < first - slight) | (at + offset > last + slight)):
            moved = f", with time_offset = {offset:g} s," if offset else ""
            raise ValueError(
                f"{self.output}: times{moved} must lie within those of the run, {first:g} to {last:g} s; got "
                f"{at.min() + offset:g} to {at.max() + offset:g} s: simulate longer, begin with another time_offset, or "
                "leave these rows out"
            )

    def when(self, rollout: Rollout) -> np.ndarray:
        """The share of the run that had passed at each of the values that are not missing."""
        first, last = rollout.times[0], rollout.times[-1]
        share = (np.asarray(rollout.times if self.times is None else self.times) - first) / ((last - first) or 1.0)
        rows = np.nonzero(self.seen)[0]
        return share[rows] if len(share) > 1 else np.zeros(len(rows))

    def _rows(self, times: np.ndarray, offset) -> np.ndarray:
        """Weights of the frames in each row of values, shape (rows, frames)."""
        from scipy.interpolate import CubicSpline  # half a second to import

        spline, at = CubicSpline(times, np.eye(len(times))), self.times + value_of(offset)
        return made(spline(at), (offset, lambda d: d * spline(at, 1), lambda seed: (seed * spline(at, 1)).sum()))

    def _taken(self, frames: Frames, y: np.ndarray, offset) -> np.ndarray:
        """Of an output; of numbers that record, too."""
        y = y if self.at is None else y[:, self.at]
        if self.times is not None:
            y = (self._rows(frames.times, offset) @ y.reshape(len(y), -1)).reshape(len(self.times), *y.shape[1:])
        return y[self.seen] / self.deviation

    def residual(self, frames: Frames, offset: float) -> np.ndarray:
        """(y - d) / noise, of what is not missing."""
        y = np.asarray(frames[self.output], np.float64)
        return self._taken(frames, y, offset) - self.values[self.seen] / self.deviation

    def _recorded(self, frames: Frames, offset: float) -> tuple:
        y, at = Recorded(np.asarray(frames[self.output], np.float64)), Recorded(offset)
        return self._taken(frames, y, at), y, at

    def change(self, frames: Frames, change: np.ndarray | None, offset: float, d_offset: float) -> np.ndarray:
        """Change of the residual for changes of the output and of the offset of time [s]."""
        residual, *leaves = self._recorded(frames, offset)
        return forward(residual, zip(leaves, (change, d_offset)))

    def pulled(self, frames: Frames, seed: np.ndarray, offset: float) -> tuple[np.ndarray, float]:
        """Gradients by the output and by the offset of time, from that by the residual."""
        residual, *leaves = self._recorded(frames, offset)
        by_output, by_offset = reverse(residual, seed, leaves)
        return by_output, float(by_offset or 0.0)


def measurements(data, noise) -> list[Measurement]:
    """The data of one experiment as a list."""
    if isinstance(data, Measurement):
        return [data]
    if isinstance(data, dict) and data:
        if noise is None:
            raise ValueError("identify: data given as {output: values} need noise, a number or {output: deviation}")
        each = noise if isinstance(noise, dict) else dict.fromkeys(data, noise)
        if not set(data) <= set(each):  # it may name more, of other experiments
            raise ValueError(f"identify: noise is of {', '.join(each)}, data of {', '.join(data)}: name each of these")
        return [Measurement(k, x, each[k]) for k, x in data.items()]
    out = list(data)
    if not out or not all(isinstance(one, Measurement) for one in out):
        raise ValueError("identify: data are {output: values}, a Measurement, or a list of those, for each experiment")
    return out
