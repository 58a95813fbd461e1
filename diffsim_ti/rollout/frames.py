"""Checks of the saved states of a run, and gradients of a loss by them as NumPy arrays."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.common.warn import warn
from diffsim_ti.inputs import Derived
from diffsim_ti.outputs import Strain
from diffsim_ti.outputs.frames import Frames


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
    if not np.all(np.isfinite(adjoint)):
        frame = int(np.argwhere(~np.isfinite(adjoint))[0][0]) if adjoint.ndim else 0
        raise FloatingPointError(
            f"the loss's gradient by {name} is not finite at step {frame * save_every} "
            f"(frame {frame}): check the loss; parameters are unchanged"
        )


def norm(x: np.ndarray) -> float:
    """Euclidean norm in float64, without overflow."""
    x = np.asarray(x, np.float64).ravel()
    square = float(x.dot(x) if x.size < 5000 else np.einsum("i,i", x, x))  # alone: threads of BLAS wait for Taichi's
    if 1e-280 < square < 1e280 or not x.any():
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
