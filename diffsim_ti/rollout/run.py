"""What a sweep takes and gives: a run that can be done again, and a loss's gradients by its frames."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.warn import warn
from diffsim_ti.inputs import Derived
from diffsim_ti.outputs import Strain
from diffsim_ti.outputs.output import Frames
from diffsim_ti.state.watch import ContactResolution


@dataclass(eq=False, repr=False)
class Run:
    """A forward run, by what it takes to do it again: the values of its inputs, and what else sets its start.

    contacts: what it noted of them, worked out when asked for.
    law_state: what the law remembers at the start; None: its initial state.
    start: called with the workspace after the values are loaded; sets another start there, the same each time.
    first_step: steps that came before, for reports.
    seen_by: the name of the sweep that looked after it to its end.
    bend: how far it took faces of ten-node tetrahedra to bend [m] (state/bending.py), once it came to its end.
    error: what stopped it, where the sweep marks runs that fail; its frames hold the last good one from there on.
    """

    values: dict
    start: Callable | None = field(default=None, repr=False)
    first_step: int = 0
    law_state: np.ndarray | None = None
    contacts: Callable[[], ContactResolution] | None = field(default=None, repr=False)
    seen_by: object | None = field(default=None, repr=False)
    bend: float | None = field(default=None, repr=False)
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


def warn_of_large_stretch(frames: Frames) -> bool:
    """Warn where a frame stretches a material beyond what is known of it, and say whether one does."""
    material = frames.scene.material
    if not np.isfinite(material.valid_to):
        return False
    strains = Strain(principal=True).settled(frames.scene).value(frames)[..., -1]
    frame, tetrahedron = np.unravel_index(np.argmax(strains), strains.shape)
    stretch = np.sqrt(1 + 2 * strains[frame, tetrahedron])
    if beyond := bool(stretch > material.valid_to):
        warn(
            f"{material!r} is valid to stretch {material.valid_to:.3g}, and tetrahedron {tetrahedron} has {stretch:.3g} at "
            f"{frames.times[frame]:.3g} s: what the material does there was not measured, or is not stable"
        )
    return beyond


def check_finite(name: str, adjoint: np.ndarray, save_every: int) -> None:
    """Raise FloatingPointError, naming the step, where a loss's gradient by some frames is not finite."""
    if not np.isfinite(adjoint).all():
        frame = int(np.argwhere(~np.isfinite(adjoint))[0][0]) if adjoint.ndim else 0
        raise FloatingPointError(
            f"the loss's gradient by {name} is not finite at step {frame * save_every} "
            f"(frame {frame}): check the loss; parameters are unchanged"
        )


def norm(x: np.ndarray) -> float:
    """Euclidean norm in float64, without overflow."""
    x = np.asarray(x, np.float64).ravel()
    square = float(x.dot(x) if x.size < 5000 else np.einsum("i,i", x, x))  # alone: threads of BLAS wait for Taichi's
    if 1e-280 < square < 1e280 or not np.count_nonzero(x):
        return square**0.5
    largest = float(np.abs(x).max(initial=0.0))  # squares vanish, overflow, or are not finite
    return largest * float(np.linalg.norm(x / largest)) if 0 < largest < np.inf else largest


@dataclass
class HostSeed:
    """Gradients by the frames as NumPy arrays of shape (frames, num_vertices, 3); see `Seed` in run.py."""

    positions: np.ndarray
    velocities: np.ndarray
    noted: dict[str, np.ndarray | None]

    def put(self, adjoint, last_frame_is_state: bool) -> tuple[float, float]:
        adjoint.start(self.positions, self.velocities, last_frame_is_state)
        return norm(self.positions), norm(self.velocities)

    def collect(self, adjoint, truncated: bool) -> tuple[Derived, tuple[float, float]]:
        derived = adjoint.collect()
        if truncated:
            derived.displacement[:], derived.velocity[:] = 0, 0
        return derived, (norm(derived.displacement), norm(derived.velocity))
