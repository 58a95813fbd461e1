"""Saved states of a run, and gradients of a loss by them, as NumPy arrays."""

from dataclasses import dataclass, field

import numpy as np

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.public import Public
from diffsim_ti.common.warn import warn
from diffsim_ti.inputs import Derived
from diffsim_ti.outputs import Strain
from diffsim_ti.rollout.run import Run
from diffsim_ti.scene import Scene
from diffsim_ti.state.watch import ContactResolution


@dataclass(eq=False, repr=False)
class Frames(metaclass=Public):
    """Saved states of one run: positions [m] (far from the origin in float64), velocities [m/s], displacements from the rest
    shape [m] (which keep their digits in float32), each of shape (frames, num_vertices, 3), and times [s].

    `outputs` has what the Rollout was asked to compute besides, by name; `frames["name"]` gives any of them.

    `contact_resolution` says how near the body came to obstacles and how finely the steps resolve that (state/watch.py).

    `contact_forces` [N], where an output reads them: what each obstacle did to each vertex, on average since the frame
    before, by its barrier and by friction; shape (frames, obstacles, 2, num_vertices, 3), obstacles as in
    `scene.obstacles`; with SelfContact a row more has what surfaces did to each other. The first frame has none.

    `computed` are these outputs themselves, as settled for the scene; `sets`: those of inputs that were given by named sets.

    `chamber_pressures` [Pa], where an output reads them: those in chambers whose volume is constrained, shape (frames,
    chambers), of the substep that ends in the frame; others, and the first frame, have none (0).

    `law_state`, where an output reads it: what the law remembers of each tetrahedron, shape (frames, num_tetrahedra, S), or
    (frames, num_tetrahedra, 4, S) at the points of ten-node tetrahedra, in the order of the law's `state_names`.

    `error`: what stopped a run of `Rollout(..., raise_errors=False)`, None where it is `alive`; from there on frames hold
    the last good one.

    `scene`: of which they are.

    `inputs` are the values that the run started from, so that its gradient can be taken whenever it is wanted.
    """

    positions: np.ndarray
    velocities: np.ndarray
    displacements: np.ndarray
    times: np.ndarray
    inputs: dict = field(repr=False)
    contact_resolution: ContactResolution | None = field(default=None, repr=False)
    outputs: dict[str, np.ndarray] = field(default_factory=dict)
    contact_forces: np.ndarray | None = field(default=None, repr=False)
    computed: dict = field(default_factory=dict, repr=False)
    chamber_pressures: np.ndarray | None = field(default=None, repr=False)
    sets: dict = field(default_factory=dict, repr=False)  # of inputs given by named sets, by input (set_values.py)
    law_state: np.ndarray | None = field(default=None, repr=False)
    steps: np.ndarray | None = field(default=None, repr=False)  # of the run that are done in each frame
    run: Run | None = field(default=None, repr=False)
    error: FloatingPointError | None = None
    scene: Scene | None = field(default=None, repr=False)

    __repr__ = brief_fields

    @property
    def alive(self) -> bool:
        """Whether the run came to its end."""
        return self.error is None

    def __getstate__(self) -> dict:
        """Without the run, which lives on the device, and the scene: a copy by pickle has no gradient and no picture."""
        return vars(self) | dict(run=None, scene=None)

    def __getitem__(self, name: str) -> np.ndarray:
        if name in ("positions", "velocities", "displacements"):
            return getattr(self, name)
        if name not in self.outputs:
            known = ", ".join(("positions", "velocities", "displacements", *self.outputs))
            raise KeyError(f"no output named {name!r}; there are {known}: pass others to Rollout(..., outputs=[...])")
        return self.outputs[name]


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
