"""Stages of an explicit step: each says what it does, its tangent and its adjoint.

A step is a list of stages, the outermost first (solvers/explicit/stages.py). Each acts before the stages within it, after
them, or both: forces of surfaces on each other are written before the kick and drift, which is the innermost stage; what
corrects where a body went acts after it. Forward, tangent and reverse go through the same list (`Passes.go`), so that the
order is said once: in the adjoint a stage first goes back through what it did last.
"""

from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any, ClassVar

from diffsim_ti.inputs import Derived
from diffsim_ti.state.history import History


class Stage:
    """A stage of a step: context managers `do`, `tangent` and `adjoint`, which take `Passes`; stages within act meanwhile.

    Where its tangent and adjoint need buffers, other objects have these two, which `with_buffers` makes.
    """

    in_kicks: ClassVar[bool] = False  # whether it acts in a kick alone, too

    def with_buffers(self, way: str, run) -> "Stage":
        """What has its "tangent" or "adjoint" along a run."""
        return self

    def clear(self) -> None:
        """A reverse sweep begins."""

    def collect(self, out: Derived) -> None:
        """Add the adjoints that were summed."""


@dataclass
class Passes:
    """Passes that are done one launch after the other.

    run: the workspace, or the tangent or adjoint that holds changes or adjoints of the state. A pass begins with the state
    in slot `slot` of `history` and leads to that in `end`: the same slot, or with stride 1 the next one, slot 0 holding the
    state before pass `base`.
    halt: the pass at whose state a reverse sweep stops, between its two kicks, or -1; kick: forces and the kick before a
    state alone, without what comes after it.
    """

    ws: Any
    run: Any
    history: History
    base: int
    stride: int
    num_passes: int
    save_every: int
    halt: int = -1
    kick: bool = False
    numbers: dict | None = None  # of the launch, by name
    launch: Callable | None = None  # of the kick and drift, bound by the first pass

    def go(self, way: str, stages: Iterable[Stage], launches: Iterable[dict]) -> None:
        """way: "do", "tangent" or "adjoint"; launches: their numbers."""
        ways = [getattr(stage, way) for stage in stages if stage.in_kicks or not self.kick]
        for self.numbers in launches:
            vars(self).pop("now", None)
            with ExitStack() as within:
                for act in ways:
                    within.enter_context(act(self))

    @property
    def j(self) -> int:
        """The first pass of the launch, the only one where stages besides the kick and drift act."""
        return self.numbers["first"]

    @property
    def slot(self) -> int:
        return (self.j - self.base) * self.stride

    @property
    def end(self) -> int:
        return self.slot + self.stride

    @cached_property
    def now(self) -> SimpleNamespace:
        """Length [s] and weights of pass j."""
        return self.ws.numbers_of(self.j, self.num_passes)
