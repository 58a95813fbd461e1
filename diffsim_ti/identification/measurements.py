"""What was measured: values of an output of a rollout, some of them missing, at the frames or at times of their own."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.brief import brief
from diffsim_ti.common.checked import numbers, wholes
from diffsim_ti.common.names import no_such
from diffsim_ti.common.origin import rounding_of
from diffsim_ti.common.public import Public
from diffsim_ti.common.warn import warn
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
            shape[1] = len(self.at)
        if self.times is not None:
            first, last = rollout.times[0], rollout.times[-1]
            if self.times.ndim != 1 or self.times.min() < first or self.times.max() > last:
                raise ValueError(f"{self.output}: times must lie within those of the run, {first:g} to {last:g} s")
            shape[0] = len(self.times)
        if self.values.shape != tuple(shape):
            raise ValueError(f"{self.output}: expected values of shape {tuple(shape)}, got {self.values.shape}")

    def when(self, rollout: Rollout) -> np.ndarray:
        """The share of the run that had passed at each of the values that are not missing."""
        first, last = rollout.times[0], rollout.times[-1]
        share = (np.asarray(rollout.times if self.times is None else self.times) - first) / ((last - first) or 1.0)
        rows = np.nonzero(self.seen)[0]
        return share[rows] if len(share) > 1 else np.zeros(len(rows))

    def _rows(self, times: np.ndarray, offset: float, order: int = 0) -> np.ndarray:
        """Weights of the frames in each row of values, shape (rows, frames)."""
        from scipy.interpolate import CubicSpline  # half a second to import

        return CubicSpline(times, np.eye(len(times)))(self.times + offset, order)

    def _taken(self, frames: Frames, y: np.ndarray, offset: float, order: int = 0) -> np.ndarray:
        y = np.asarray(y, np.float64)
        y = y if self.at is None else y[:, self.at]
        if self.times is not None:
            y = np.tensordot(self._rows(frames.times, offset, order), y, 1)
        return y[self.seen] / self.deviation

    def residual(self, frames: Frames, offset: float) -> np.ndarray:
        """(y - d) / noise, of what is not missing."""
        return self._taken(frames, frames[self.output], offset) - self.values[self.seen] / self.deviation

    def change(self, frames: Frames, change: np.ndarray | None, offset: float, d_offset: float) -> np.ndarray:
        """Change of the residual for changes of the output and of the offset of time [s]."""
        out = np.zeros(len(self.deviation)) if change is None else self._taken(frames, change, offset)
        if d_offset and self.times is not None:
            out = out + d_offset * self._taken(frames, frames[self.output], offset, 1)
        return out

    def pulled(self, frames: Frames, seed: np.ndarray, offset: float) -> tuple[np.ndarray, float]:
        """Gradients by the output and by the offset of time, from that by the residual."""
        by_values = np.zeros(self.values.shape)
        by_values[self.seen] = seed / self.deviation
        by_offset = 0.0
        if self.times is not None:
            by_offset = float(seed @ self._taken(frames, frames[self.output], offset, 1))
            by_values = np.tensordot(self._rows(frames.times, offset).T, by_values, 1)
        if self.at is None:
            return by_values, by_offset
        out = np.zeros(frames[self.output].shape)
        np.add.at(out, (slice(None), self.at), by_values)
        return out, by_offset


def measurements(data, noise) -> list[Measurement]:
    """The data of one experiment as a list."""
    if isinstance(data, Measurement):
        return [data]
    if isinstance(data, dict):
        if noise is None:
            raise ValueError("identify: data given as {output: values} need noise, a number or {output: deviation}")
        return [Measurement(k, x, noise[k] if isinstance(noise, dict) else noise) for k, x in data.items()]
    out = list(data)
    if not out or not all(isinstance(one, Measurement) for one in out):
        raise ValueError("identify: data are {output: values}, a Measurement, or a list of those, for each experiment")
    return out
