"""Contact as a stage of explicit passes where obstacles have many points and edges, of which those near bodies are there."""

from collections.abc import Callable
from contextlib import contextmanager

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.mechanics.surfaces.contact_stage import FarFromAll, PairContact
from diffsim_ti.runtime.slots import copy_slot
from diffsim_ti.state.obstacle_poses import AT_BEGIN


class NearbyContact(Stage):
    """The stage of the points and edges that are there, another one where others are; each recorded pass goes back through
    the one that did it."""

    def __init__(self, make: Callable[[], PairContact]):
        self.make, self.now = make, make()
        self.by_end: dict[int, PairContact] = {}
        self.went_back: dict[PairContact, None] = {}  # all that have adjoints
        nearby = self.now.pairs.nearby  # where obstacles turn, those at hand say nothing of how far others go
        self.turning = any(nearby.all.row_of(part, AT_BEGIN) is not None for part in nearby.many)

    @property
    def work(self) -> float:
        return self.now.work

    @work.setter
    def work(self, work: float) -> None:
        self.now.work = work

    def _stage(self) -> PairContact:
        """That of what is there now."""
        earlier = self.now
        if earlier.inner is not earlier.pairs.inner:
            self.now = self.make()
            self.now.begin, self.now.work = earlier.begin, earlier.work
        return self.now

    def _cover(self, u, slot: int, more: float = 0.0) -> PairContact:
        self.now.pairs.cover(runtime.fetch_row(u, slot), more=more)
        return self._stage()

    @contextmanager
    def do(self, at: Passes):
        u, slot, stage = at.history.u, at.slot, self._stage()
        stage.follow(at, AT_BEGIN)
        anew = at.launch is None and not stage.holds(u, slot)
        if anew or self.turning:
            stage = self._cover(u, slot)
        stage.prepare(u, slot, anew or not stage.inner.fresh)
        if not at.stride:
            copy_slot(u, slot, stage.begin, 0)
        yield
        while True:
            try:
                stage.finish(at)
                break
            except FarFromAll as far:
                begin = stage.begin_of(at)
                stage.follow(at, AT_BEGIN)
                stage = self._cover(*begin, far.more)
                stage.prepare(*begin, anew=True)
        if at.stride:
            self.by_end = self.by_end if at.slot else {}  # a record begins in slot 0
            self.by_end[at.end] = stage

    def tangent(self, at: Passes):
        return self.by_end.get(at.end, self.now).tangent(at)

    def adjoint(self, at: Passes):
        stage = self.by_end.get(at.end, self.now)
        self.went_back[stage] = None
        return stage.adjoint(at)

    @property
    def _all(self) -> list[PairContact]:
        return list(dict.fromkeys([self.now, *self.by_end.values(), *self.went_back]))

    def clear(self) -> None:
        for stage in self._all:
            stage.clear()
        self.went_back = {}

    def collect(self, out: Derived) -> None:
        for stage in self._all:
            stage.collect(out)
