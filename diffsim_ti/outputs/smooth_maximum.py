"""One number for the greatest of many, such as the stress that a design is to keep below a limit."""

from copy import copy
from typing import Literal

import numpy as np

from diffsim_ti.common.checked import number
from diffsim_ti.differentiation.arrays import value_of, with_slopes
from diffsim_ti.outputs.output import NOTED, Frames, Output, taken_from
from diffsim_ti.scene import Scene


class SmoothMaximum(Output):
    """The greatest value of another output in each frame, made smooth so that it has a gradient everywhere, shape (frames,).

        kind="p-norm":  (sum |y|^p)^(1/p), between the greatest |y| and n^(1/p) times it
        kind="ks":      s/p log sum exp(p y/s), between the greatest y and s log(n)/p above it (Kreisselmeier, Steinhauser)

    of: an output, such as Stress(von_mises=True) or Stress(principal=True, at="recovered"), of n values in a frame.
    sharpness p: the larger, the nearer to the greatest and the less smooth. scale s: of "ks", in the unit of y, such as
    the stress that is allowed. name: how a loss calls it. Gradients are exact, by those of the other output.
    Raises ValueError for another kind, and for sharpness below 1 or a scale that is not above zero.
    Duysinx, Sigmund 1998, doi:10.2514/6.1998-4906; Kreisselmeier, Steinhauser 1979, doi:10.1016/S1474-6670(17)65584-8.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=3)
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], fixed="ymin", precision="f64")
    >>> stress = ds.Stress(von_mises=True)
    >>> outputs = [stress, ds.SmoothMaximum(stress, sharpness=30)]
    >>> frames = ds.Rollout(ds.StaticSolver(scene), steps=1, outputs=outputs).forward()
    >>> print(f"{frames['smooth_maximum'][-1] / frames['stress'][-1].max():.2f}")
    1.07
    """

    def __init__(
        self,
        of: Output,
        sharpness: float = 16.0,
        kind: Literal["p-norm", "ks"] = "p-norm",
        scale: float | None = None,
        name: str = "smooth_maximum",
    ):
        if not isinstance(of, Output):
            raise ValueError(f"SmoothMaximum: of must be an output such as Stress(von_mises=True), got {of!r}")
        if kind not in ("p-norm", "ks"):
            raise ValueError(f'SmoothMaximum: kind must be "p-norm" or "ks", got {kind!r}')
        if (scale is None) == (kind == "ks"):
            raise ValueError(
                'SmoothMaximum: scale= goes with kind="ks", which needs it: a value of the size of y, such as the stress '
                "that is allowed"
            )
        self.of, self.kind, self.name = of, kind, name
        self.sharpness = number("SmoothMaximum: sharpness", sharpness)
        self.scale = 1.0 if scale is None else number("SmoothMaximum: scale", scale)
        if not (self.sharpness >= 1 and self.scale > 0):
            raise ValueError(
                f"SmoothMaximum: sharpness must be at least 1 and scale above zero, got {sharpness}, {scale}"
            )
        for flag in ("unit", "cumulative", *(f"reads_{what}" for what in NOTED)):
            setattr(self, flag, getattr(of, flag))

    def settled(self, scene: Scene) -> "SmoothMaximum":
        out = copy(self)
        out.of = self.of.settled(scene)
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,)

    def value(self, frames: Frames) -> np.ndarray:
        given = taken_from(self.of, frames)
        shape, y, p = np.shape(given), value_of(given).reshape(len(given), -1), self.sharpness
        if self.kind == "ks":
            most = y.max(1, keepdims=True)
            shares = np.exp(p * (y - most) / self.scale)
            total = shares.sum(1, keepdims=True)
            values, slope = most + self.scale / p * np.log(total), shares / total
        else:
            most = np.abs(y).max(1, keepdims=True)
            part = np.divide(np.abs(y), most, out=np.zeros_like(y), where=most > 0)
            norm = np.where(most > 0, (part**p).sum(1, keepdims=True), 1.0) ** (1 / p)
            values, slope = most * norm, np.sign(y) * (part / norm) ** (p - 1)
        return with_slopes(values[:, 0], (given, lambda: slope.reshape(shape)))
