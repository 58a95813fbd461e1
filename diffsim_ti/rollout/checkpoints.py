"""Which states a rollout keeps for its reverse sweep, and which it computes again."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Checkpoints:
    """`num_passes` passes cut into segments of `segment` passes; `snapshots` of their starts are kept at a time.

    With a snapshot for every segment each pass runs once more in the reverse sweep; with fewer, the binomial
    checkpointing of Griewank (1992, Optimization Methods and Software 1, 35-54, doi:10.1080/10556789208805505) applies.
    """

    num_passes: int
    segment: int
    snapshots: int
    law_state: float = 0.0  # size of what the law remembers, in arrays of (num_vertices, 3) numbers

    @property
    def num_segments(self) -> int:
        return -(-self.num_passes // self.segment)

    def bounds(self, k: int) -> tuple[int, int]:
        """First pass of segment k and of the next."""
        return k * self.segment, min((k + 1) * self.segment, self.num_passes)

    def path(self, begin: int, end: int, free: int) -> list[int]:
        """Segments whose starts to keep on the way from segment `begin` (kept already) to the last one before `end`."""
        out = []
        while free > 0 and end - begin > 1:
            begin = _split(begin, end, free)
            out.append(begin)
            free -= 1
        return out

    def states(self) -> int:
        """Stored arrays of (num_vertices, 3) numbers: two for a snapshot, three for a recorded pass, and the law's."""
        return (2 + self.law_state) * self.snapshots + (3 + self.law_state) * (self.segment + 1)


def _split(begin: int, end: int, free: int) -> int:
    """The next segment to keep between `begin` and `end` with `free` snapshots left."""
    length = end - begin
    if length - 1 <= free:
        return begin + 1
    repeats = 1
    while math.comb(free + 1 + repeats, repeats) < length:
        repeats += 1
    # both parts then need no more repeats than they must: the least work there is
    return begin + min(math.comb(free + repeats, free + 1), length - math.comb(free + repeats - 1, free))


def choose_checkpoints(
    num_passes: int, state_bytes: int, every: int | None, memory: float | None, law_state: float = 0.0
) -> Checkpoints:
    """What to keep, from the user's wish.

    every: passes per segment, all segment starts kept. memory: budget [MB] for all that is kept; `state_bytes` is the
    size of one (num_vertices, 3) array, law_state that of the law's state in such arrays. Neither: 1000 MB. Raises
    ValueError if the budget is too small for any choice.
    """
    kept, recorded = 2 + law_state, 3 + law_state

    def made(segment: int, snapshots: int) -> Checkpoints:
        return Checkpoints(num_passes, segment, snapshots, law_state)

    if num_passes == 0:
        return made(1, 1)
    if every is not None:
        every = min(every, num_passes)
        full = made(every, -(-num_passes // every))
        if memory is None or full.states() * state_bytes <= memory * 1e6:
            return full
        snapshots = int((memory * 1e6 / state_bytes - recorded * (every + 1)) // kept)
        if snapshots < 1:
            least = made(every, 1).states() * state_bytes / 1e6
            raise ValueError(
                f"memory = {memory:g} MB is too little for segments of {every} passes: {least:.3g} MB needed"
            )
        return made(every, snapshots)
    budget = (1000.0 if memory is None else memory) * 1e6 / state_bytes
    everything = made(num_passes, 1)
    if everything.states() <= budget:
        return everything
    root = max(1, round(math.sqrt(kept * num_passes / recorded)))
    two_levels = made(root, -(-num_passes // root))
    if two_levels.states() <= budget:
        return two_levels
    segment = max(1, min(root, int(budget / (2 * recorded)) - 1))
    snapshots = int((budget - recorded * (segment + 1)) // kept)
    if snapshots < 1:
        least = made(1, 1).states() * state_bytes / 1e6
        raise ValueError(f"memory = {memory:g} MB is too little to differentiate at all: {least:.3g} MB is the least")
    return made(segment, min(snapshots, -(-num_passes // segment)))
