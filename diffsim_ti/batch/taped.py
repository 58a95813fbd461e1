"""A batch between Taichi kernels: its fields, and its runs as operations of a `ti.ad.Tape`."""

from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.batch.sweep import Own
from diffsim_ti.rollout.fields_on_device import STATES
from diffsim_ti.rollout.set_values import split_name
from diffsim_ti.rollout.taped import SPELLING, TapeAdapter

if TYPE_CHECKING:
    from diffsim_ti.batch.batch import Batch
    from diffsim_ti.batch.frames import BatchFrames


class BatchTapeAdapter(TapeAdapter):
    """As TapeAdapter; fields of outputs, and of inputs that are not shared, have the scenes as an axis in front.

    Values and frames go by way of the host, where those of scenes are taken apart.
    """

    def __init__(self, batch: "Batch", runs: int | None):
        super().__init__(batch, runs)
        self._shared: dict[str, bool] = {}

    def field(self, name: str, shared: bool = False):
        """See `Batch.field`."""
        if self._shared.setdefault(name, shared) != shared and name not in self.rollout.outputs:
            was = "one for all scenes" if self._shared[name] else "one for each scene"
            raise ValueError(f"{name}: its field is already {was}: ask for it with shared={self._shared[name]}")
        try:
            return super().field(name)
        except ValueError:
            del self._shared[name]
            raise

    def _loaded(self, name: str) -> np.ndarray:
        values = self.rollout.one.values
        if name == "initial_displacements":
            return values["initial_positions"] - values["rest_positions"]
        return values[name]

    def _filled(self, name: str, value):
        shape, scenes = np.shape(value), () if self._shared[name] else (self.rollout.num_scenes,)
        field = self._take(shape, scenes)
        runtime.untaped(field.from_numpy)(np.array(np.broadcast_to(value, (*scenes, *shape)), self.number))
        return field

    def _output_rows(self) -> tuple:
        return (*super()._output_rows(), self.rollout.num_scenes)

    def values(self) -> dict:
        """Values of inputs from their fields, as `Batch.forward` takes them, those of scenes as `Own`."""
        if self._fields:
            runtime.check_alive(self._program)
        for name in {split_name(name)[0] for name in self._fields if split_name(name)[1] is not None}:
            if name in self._fields:
                raise ValueError(f"{name}: fields of the whole and of named sets were asked for; use one of both")
        out: dict = {}
        for name, field in self._fields.items():
            plain, key = split_name(name)
            if SPELLING.get(plain, plain) not in self.rollout.inputs:
                continue
            value, known = field.to_numpy(), self._loaded(plain)
            if key is not None:
                out.setdefault(plain, {})[key] = value.astype(np.float64)
                continue
            one = known.astype(value.dtype)
            value = known if self._shared[name] and np.array_equal(value, one) else value.astype(np.float64)
            if name == "initial_displacements":
                value = value + self.rollout.one.values["rest_positions"]
            out[SPELLING.get(name, name)] = value if self._shared[name] else Own(value)
        return out

    def forward(self, k: int | None) -> "BatchFrames":
        batch = self.rollout
        batch.frames = frames = batch.forward(**self.values())
        for name in (*STATES, *batch.one.computed):
            self.fill_row(k, name, frames[name])
        return frames

    def backward(self, k: int | None, ran: "BatchFrames") -> dict:
        batch, out = self.rollout, {}
        seeds = {name: self.row(k, name) for name in (*STATES, *batch.one.computed)}
        for name, gradient in batch.vjp(ran, **{name: x for name, x in seeds.items() if x.any()}).items():
            if isinstance(gradient, dict):
                out |= {f"{name}[{key}]": x for key, x in gradient.items()}
            else:
                out[name] = gradient
        return out
