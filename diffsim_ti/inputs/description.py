"""What an input is, said once: its value, the shapes it may have, unit, range, and how large a change of it matters."""

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import partial
from operator import le, lt
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import TypeAliasType

from diffsim_ti.common.checked import as_numbers, numbers
from diffsim_ti.common.public import Public

# lengths: numbers, or "vertices", "tetrahedra" of the mesh, "steps", "steps + 1" of a run
Shape = tuple[int | str, ...]
# of an input in the place of the scene's own: numbers of its shape, or {named set: number}
InputValue = TypeAliasType("InputValue", ArrayLike | Mapping[str, ArrayLike])
# what many scenes have, for completion; `scene.inputs` lists those of one
_MANY = Literal[
    "initial_positions", "initial_velocities", "rest_positions", "density", "youngs_modulus", "poissons_ratio"
]
InputName = TypeAliasType("InputName", _MANY | Literal["gravity", "drag_rate", "prescribed_motion"] | str)


@dataclass(frozen=True)
class RunSize:
    """How large a run is: mean length of the mesh's edges [m], number of steps, step [s]."""

    edge: float
    steps: int
    dt: float


def own_size(value: np.ndarray, run: RunSize) -> float:
    """A change that matters, of an input that is measured by its own size."""
    size = float(np.abs(value).max()) if value.size else 0.0
    return 0.1 * size if size > 0 else 0.1


def length(value: np.ndarray, run: RunSize) -> float:
    """Of a place, which has no size of its own: a share of an edge [m]."""
    return 0.1 * run.edge


def length_per_step(value: np.ndarray, run: RunSize) -> float:
    """Of places row by row, where larger changes would be jumps [m]."""
    return 0.1 * run.edge / max(run.steps, 1)


def speed(value: np.ndarray, run: RunSize) -> float:
    """Of a velocity: a share of an edge per run [m/s]."""
    return 0.1 * run.edge / max(run.steps * run.dt, run.dt)


@dataclass(frozen=True)
class Range:
    """Which values an input may have: words for an error, a test of an array, whether runs must keep to it too."""

    words: str
    holds: Callable[[np.ndarray], np.ndarray]
    in_runs: bool = True


above_0, at_least_0 = partial(lt, 0), partial(le, 0)  # 0 < x and 0 <= x, which pickle
POSITIVE = Range("> 0", above_0)
NOT_NEGATIVE = Range("one number >= 0", at_least_0, in_runs=False)  # differences about 0 step below it


@dataclass(frozen=True, eq=False)
class Input(metaclass=Public):
    """An input of a scene: a number or an array that a gradient can be asked for.

    name: of the argument that gives it. plain: the input's name where its term has none; default `name`.
    value: float64; None if it is sampled at the steps of each run.
    shapes: those it may have, () for one number; default that of the value alone. A length "steps" means a run's number of
        steps at least, "steps + 1" exactly; other words stand for any length until a scene says it (`Term.sizes`).
    change: (value, RunSize) -> how large a change of it matters, for `verify`.
    unit: "-" of a number without dimension, "" where it is not said.
    label: how errors of a constructor call it; default `plain`. The unit stands behind if not in it.
    axes: of places, the axis of each of its numbers, "xyz" or such as "y" of a height; "" of all else (origin.py).
    single: whether the value was given in float32.
    given: what the value was given as, if that is a tensor with a graph; the interface to its library takes it from here.
    """

    name: str
    value: np.ndarray | None
    shapes: tuple[Shape, ...] = ()
    unit: str = ""
    range: Range | None = None
    change: Callable[[np.ndarray, RunSize], float] = own_size
    plain: str = ""
    label: str = ""
    axes: str = ""
    single: bool = False
    given: object = field(default=None, init=False)

    def __post_init__(self):
        if hasattr(self.value, "detach"):
            object.__setattr__(self, "given", self.value)
            object.__setattr__(self, "value", self.value.detach().cpu().numpy())
        if self.value is not None:
            object.__setattr__(self, "single", self.single or getattr(self.value, "dtype", None) == np.float32)
            object.__setattr__(self, "value", frozen(numbers(self.plain or self.name, self.value)))
            object.__setattr__(self, "shapes", self.shapes or (self.value.shape,))
        object.__setattr__(self, "plain", self.plain or self.name)

    @property
    def in_brackets(self) -> str:
        """The unit behind a blank; nothing where it is not said."""
        return f" [{self.unit}]" if self.unit else ""

    def check_value(self, kind: str) -> None:
        """Raise ValueError unless the value that a constructor was given (`kind`: its class) is finite and fits."""
        value, label = self.value, f"{kind}: {self.label or self.plain}"
        unit = "" if "[" in label else self.in_brackets
        if not np.all(np.isfinite(value)):
            raise ValueError(f"{kind}: {self.plain} must be finite, got {value}{self.in_brackets}")
        if not self.fits(value.shape, {}):
            if len(self.shapes) > 1:
                *others, last = map(_spelled, self.shapes)
                raise ValueError(f"{label} must have shape {', '.join(others)} or {last}, got {value.shape}")
            raise ValueError(f"{label} must be {_counted(self.shapes[0])}{unit}, got shape {value.shape}")
        if self.range and not np.all(self.range.holds(value)):
            raise ValueError(f"{label} must be {self.range.words}{unit}, got {value.min():g}")

    def shift(self, origin: np.ndarray) -> np.ndarray:
        """What its numbers have less where places are measured from `origin` [m], shape (size,)."""
        out = [origin["xyz".index(axis)] for axis in self.axes] or [0.0]
        return np.resize(out, self.value.size)

    def known(self, sizes: Mapping[str, int]) -> "Input":
        """The same, with numbers for the words of lengths that `sizes` knows."""
        out = copy(self)
        shapes = tuple(tuple(sizes.get(a, a) if isinstance(a, str) else a for a in rule) for rule in self.shapes)
        object.__setattr__(out, "shapes", shapes)
        return out

    def checked(self, name: str, value: ArrayLike, sizes: Mapping[str, int]) -> np.ndarray:
        """A value for a run as a float64 array, or ValueError; sizes: what the words for lengths mean."""
        value = frozen(as_numbers(name, value))
        finite = np.isfinite(value)
        if not finite.all():
            unit = f"; its unit is {self.unit}" if self.unit else ""
            raise ValueError(f"{name} must be finite: {(~finite).sum()} of {value.size} values are not{unit}")
        if not self.fits(value.shape, sizes):
            raise ValueError(f"{name}: expected {self.expected(sizes)}, got {value.shape}")
        if self.range and self.range.in_runs and not self.range.holds(value).all():
            raise ValueError(f"{name} must be {self.range.words}{self.in_brackets}, got {value.min():g}")
        return value

    def allows(self, values: np.ndarray) -> bool:
        """Whether all numbers are such that `checked` has nothing against them but, perhaps, their shape."""
        held = self.range is None or not self.range.in_runs or self.range.holds(values).all()
        return bool(np.isfinite(values).all() and held)

    def fits(self, shape: tuple[int, ...], sizes: Mapping[str, int]) -> bool:
        """Whether a shape is among those allowed."""
        return shape in self.shapes or any(
            len(rule) == len(shape)
            and all(sizes.get(a, b) == b if isinstance(a, str) else a == b for a, b in zip(rule, shape))
            for rule in self.shapes
        )

    def expected(self, sizes: Mapping[str, int]) -> str:
        """The shapes allowed, in words."""
        known = [tuple(sizes.get(a, a) if isinstance(a, str) else a for a in rule) for rule in self.shapes]
        return " or ".join(f"shape {_spelled(rule)}" if rule else "one number" for rule in known)

    @property
    def is_per_step(self) -> bool:
        """Whether a shape that it may have depends on a run's number of steps."""
        return any(word in rule for rule in self.shapes for word in ("steps", "steps + 1"))

    def check_steps(self, name: str, shape: tuple[int, ...], steps: int) -> None:
        """Raise ValueError unless a run of so many steps finds its rows."""
        for rule in self.shapes:
            if len(rule) == len(shape):
                for word, size in zip(rule, shape):
                    if word == "steps" and size < steps:
                        raise ValueError(f"{name}: {steps} steps need as many rows, got {size}")
                    if word == "steps + 1" and size != steps + 1:
                        raise ValueError(f"{name}: expected {self.expected({word: steps + 1})}, got {shape}")


def frozen(value: ArrayLike) -> np.ndarray:
    """A float64 array that cannot be written to, so that what was made of it may be kept."""
    value = np.asarray(value, np.float64)
    if value.flags.writeable:
        value = value.view()
        value.flags.writeable = False
    return value


def _spelled(rule: Shape) -> str:
    return f"({', '.join(map(str, rule))}{',' * (len(rule) == 1)})"


def _counted(rule: Shape) -> str:
    if not rule:
        return "one number"
    return f"{rule[0]} numbers" if len(rule) == 1 else f"numbers of shape {_spelled(rule)}"
