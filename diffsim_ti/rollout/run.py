"""What a sweep takes and gives: a run that can be done again, and a loss's gradients by its frames."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.inputs import Derived
from diffsim_ti.state.watch import ContactResolution


@dataclass(eq=False, repr=False)
class Run:
    """A forward run, by what it takes to do it again: the values of its inputs, and what else sets its start.

    contacts: what it noted of them, worked out when asked for.
    law_state: what the law remembers at the start; None: its initial state.
    start: called with the workspace after the values are loaded; sets another start there, the same each time.
    first_step: steps that came before, for reports.
    seen_by: the name of the sweep that looked after it to its end.
    error: what stopped it, where the sweep marks runs that fail; its frames hold the last good one from there on.
    """

    values: dict
    start: Callable | None = field(default=None, repr=False)
    first_step: int = 0
    law_state: np.ndarray | None = None
    contacts: Callable[[], ContactResolution] | None = field(default=None, repr=False)
    seen_by: object | None = field(default=None, repr=False)
    error: FloatingPointError | None = None

    __repr__ = brief_fields

    @cached_property
    def contact_resolution(self) -> ContactResolution:
        """How near it came to obstacles, and how finely its substeps resolved that."""
        return self.contacts()


class Seed(Protocol):
    """Gradients of a loss by the frames' positions and velocities, wherever they lie; of what else was
    noted (outputs/output.py), by name, on the host."""

    noted: dict[str, np.ndarray | None]

    def put(self, adjoint, last_frame_is_state: bool) -> tuple[float, float]:
        """Set a solver's adjoint to them and everything else in it to zero; their norms, or FloatingPointError."""

    def collect(self, adjoint, truncated: bool) -> tuple[Derived, tuple[float, float]]:
        """Adjoints of what kernels read, and the norms of those of the start's displacement and velocity.

        truncated: the sweep did not come to the start, whose adjoints are then zero.
        """
