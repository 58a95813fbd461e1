"""Steps whose passes come in groups: each substep is kicked several times before it drifts."""

from dataclasses import dataclass

from diffsim_ti.state.schedule import Schedule


@dataclass(frozen=True)
class StagedSteps(Schedule):
    """Every pass of other steps as `stages` passes, each of which has the length and the place in time of that pass."""

    whole: Schedule
    stages: int

    @property
    def varies(self):
        return self.whole.varies

    @property
    def substeps(self):
        return self.stages * self.whole.substeps

    def row(self, j):
        return self.whole.row(j // self.stages)

    def first(self, step):
        return self.stages * self.whole.first(step)

    def time(self, step):
        return self.whole.time(step)

    def step_length(self, j):
        return self.whole.step_length(j // self.stages)

    def length(self, j):
        return self.whole.length(j // self.stages)

    def begin(self, j):
        return self.whole.begin(j // self.stages)

    def end(self, j):
        return self.whole.end(j // self.stages)

    @property
    def longest(self):
        return self.whole.longest

    def stretches(self, first, last):
        of_whole = self.whole.stretches(first // self.stages, -(-last // self.stages))
        return [(max(first, a * self.stages), min(last, b * self.stages)) for a, b in of_whole]
