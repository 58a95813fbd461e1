"""Stages of an explicit step: what it does one after the other, with tangents and adjoints.

A step is a list of stages, the outermost first. Each acts before the stages within it, after them, or both: forces of
surfaces on each other are written before the kick and drift, which is the innermost stage; what constrains or corrects
where a body went comes after it. Forward, tangent and reverse run such lists (`run`), and each stage stands at the same
place of all three (solvers/explicit/stages.py), so that the order is said once. In the adjoint a stage goes back first
through what it did last.
"""

from collections.abc import Callable, Iterable
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

from diffsim_ti.inputs import Derived
from diffsim_ti.state.history import History


@dataclass
class Passes:
    """Passes that are done one launch after the other; numbers: of the launch that comes next or is done, by name.

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
    numbers: dict
    halt: int = -1
    kick: bool = False
    launch: Callable | None = None  # of the kick and drift

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

    @property
    def now(self) -> SimpleNamespace:
        """Length [s] and weights of pass j."""
        return self.ws.numbers_of(self.j, self.num_passes)


class Stage:
    """A stage of a step, of its tangent, or of its adjoint, whose sums are its own."""

    in_kicks: ClassVar[bool] = False  # whether it acts in a kick alone, too

    def prepare(self, at: Passes) -> None:
        """Launches of these passes come next."""

    @contextmanager
    def do(self, at: Passes):
        """Act; the stages within this one act at its `yield`."""
        yield

    def clear(self) -> None:
        """Of an adjoint: a reverse sweep begins."""

    def collect(self, out: Derived) -> None:
        """Of an adjoint: add what was summed."""


def run(stages: Iterable[Stage], at: Passes, launches: Iterable[dict]) -> None:
    """Do the passes of launches with these numbers."""
    acting = [stage for stage in stages if stage.in_kicks or not at.kick]
    for stage in acting:
        stage.prepare(at)
    for at.numbers in launches:
        with ExitStack() as within:
            for stage in acting:
                within.enter_context(stage.do(at))
