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

    def _cover(self, at: Passes, u, slot: int, more: float = 0.0) -> PairContact:
        now = self._stage()
        now.follow(at, AT_BEGIN)
        now.pairs.cover(runtime.fetch_row(u, slot), more=more)
        return self._stage()

    @contextmanager
    def do(self, at: Passes):
        u, slot, anew = at.history.u, at.slot, at.launch is None
        stage = self._cover(at, u, slot) if anew else self._stage()
        stage.prepare(at, u, slot, anew or not stage.inner.fresh)
        if not at.stride:
            copy_slot(u, slot, stage.begin, 0)
        yield
        while True:
            try:
                stage.finish(at)
                break
            except FarFromAll as far:
                begin = stage.begin_of(at)
                stage = self._cover(at, *begin, far.more)
                stage.prepare(at, *begin, anew=True)
        if at.stride:
            self.by_end[at.end] = stage

    def tangent(self, at: Passes):
        return self.by_end.get(at.end, self.now).tangent(at)

    def adjoint(self, at: Passes):
        return self.by_end.get(at.end, self.now).adjoint(at)

    @property
    def _all(self) -> list[PairContact]:
        return list(dict.fromkeys([self.now, *self.by_end.values()]))

    def clear(self) -> None:
        for stage in self._all:
            stage.clear()

    def collect(self, out: Derived) -> None:
        for stage in self._all:
            stage.collect(out)
