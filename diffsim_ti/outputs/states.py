"""The frames' states themselves as outputs: positions, velocities, displacements. Every rollout has them."""

import numpy as np

from diffsim_ti.outputs.output import Change, Output


class _States(Output):
    """Vectors of all vertices in all frames."""

    linear = True
    num_vertices: int
    part = "positions"  # of a Change

    def settled(self, scene) -> "Output":
        out = type(self)()
        out.num_vertices = scene.mesh.num_vertices
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, self.num_vertices, 3

    def value(self, frames) -> np.ndarray:
        return getattr(frames, self.name)

    def jvp(self, frames, change: Change) -> np.ndarray:
        change = getattr(change, self.part)
        return np.zeros(frames.positions.shape) if change is None else change

    def vjp(self, frames, seed: np.ndarray) -> Change:
        return Change(**{self.part: seed})


class Positions(_States):
    """Where the vertices are [m]."""

    name = "positions"


class Velocities(_States):
    """How fast they move [m/s]."""

    name = part = "velocities"


class Displacements(_States):
    """Positions less the rest shape [m]."""

    name = "displacements"

    def jvp(self, frames, change: Change) -> np.ndarray:
        return super().jvp(frames, change) - change.inputs.get("rest_positions", 0.0)

    def vjp(self, frames, seed: np.ndarray) -> Change:
        return Change(positions=seed, inputs={"rest_positions": -seed.sum(0)})
