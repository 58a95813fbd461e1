"""An output, which losses use like positions: a function of a run's frames and inputs, with its derivatives beside it."""

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.common.public import Public
from diffsim_ti.terms import Growth

if TYPE_CHECKING:
    from diffsim_ti.rollout.frames import Frames
    from diffsim_ti.scene import Scene


NOTED = ("contact_forces", "chamber_pressures", "law_state")  # what runs note besides states, where outputs read it


@dataclass
class Change:
    """A change of frames and inputs, or the gradient of a loss by them; None, and inputs left out, are zero.

    positions [m], velocities [m/s]: shape (frames, num_vertices, 3); inputs: name -> array of the input's shape.
    contact_forces [N], chamber_pressures [Pa], law_state: of the frames' arrays of that name, where an output says that it
    reads them.
    positions are those of the frames, which move with rest_positions where displacements are kept, and the other way
    round: they are the variable of the chain rule, and displacements are positions less rest_positions.
    """

    positions: np.ndarray | None = None
    velocities: np.ndarray | None = None
    inputs: dict[str, np.ndarray] = field(default_factory=dict)
    contact_forces: np.ndarray | None = None
    chamber_pressures: np.ndarray | None = None
    law_state: np.ndarray | None = None

    @property
    def noted(self) -> dict[str, np.ndarray | None]:
        """Those of what runs note besides states, by name."""
        return {name: getattr(self, name) for name in NOTED}

    def add(self, other: "Change") -> None:
        """Add another one."""
        for name in ("positions", "velocities", *NOTED):
            mine, theirs = getattr(self, name), getattr(other, name)
            setattr(self, name, mine if theirs is None else theirs if mine is None else mine + theirs)
        for name, value in other.inputs.items():
            self.inputs[name] = self.inputs[name] + value if name in self.inputs else value


class Output(metaclass=Public):
    """A function y(positions, velocities, inputs) of a run's frames, for `Rollout(..., outputs=[...])`.

    Write one outside the package by giving it `name`, `shape`, `value`, `jvp` and `vjp`, in NumPy and float64; it is then
    in `frames[name]` and `Rollout.tangents`, takes a seed in `Rollout.vjp(frames, name=...)`, and has a field under
    `ti.ad.Tape` and a tensor in torch. `frames` (rollout/frames.py) holds the states and, in `frames.inputs`, the values of
    all inputs. Rollout.tangents and Rollout.vjp must agree in <w, J d> = <J^T w, d>: check a new output by that and by
    differences.
    Griewank, Walther, Evaluating Derivatives, ch. 3, doi:10.1137/1.9780898717761.
    """

    name: str
    unit = ""  # for pictures
    linear = False  # whether it is linear in positions and velocities
    cumulative = False  # whether it counts from the first frame on, and so is of no state by itself
    # whether runs must note frames.contact_forces for it: what obstacles do (True), or "surfaces" to each other
    reads_contact_forces: bool | str = False
    reads_chamber_pressures = False  # the same of frames.chamber_pressures
    reads_law_state = False  # the same of frames.law_state, where the law remembers

    @staticmethod
    def refuse_growth(output: str, scene: "Scene") -> None:
        """Raise ValueError where tetrahedra grow over time: an output knows frames, not what they had grown by."""
        if scene.term(Growth):
            raise ValueError(
                f"{output} evaluates the law and does not support Growth over time; take Grown(material, growth), or strains"
            )

    def remembered(self, frames: "Frames", scene: "Scene") -> np.ndarray:
        """What the law remembers at each point in frames, shape (frames, num_tetrahedra, points, S), S being 0 where it
        remembers nothing, or this output does not read it. Raises ValueError for frames of a run that did not note it."""
        law, mesh = scene.law, scene.mesh
        count = len(law.state_names) if self.reads_law_state else 0
        shape = len(frames.positions), mesh.num_tetrahedra, mesh.reference.num_points, count
        if not count:
            return np.zeros(shape)
        if frames.law_state is None:
            raise ValueError(
                f"these frames do not have what {law.title} remembers: pass {type(self).__name__} to "
                "Rollout(..., outputs=[...]), which then notes it"
            )
        return frames.law_state.reshape(shape)

    @staticmethod
    def remembered_jvp(change: Change, z: np.ndarray) -> np.ndarray:
        """The change of the same, z, in `change`."""
        return change.law_state.reshape(z.shape) if z.size and change.law_state is not None else np.zeros_like(z)

    @staticmethod
    def remembered_vjp(frames: "Frames", z_adj: np.ndarray) -> np.ndarray | None:
        """The gradient by frames.law_state for that by the same, z."""
        return z_adj.reshape(frames.law_state.shape) if z_adj.size else None

    def settled(self, scene: "Scene") -> "Output":
        """This output for a scene: checked, with what depends on the scene alone; raises ValueError if it does not fit."""
        return self

    @abstractmethod
    def shape(self, num_frames: int) -> tuple[int, ...]:
        """Shape of the value; three numbers at the end make vectors of a Taichi field."""

    @abstractmethod
    def value(self, frames: "Frames") -> np.ndarray:
        """y."""

    @abstractmethod
    def jvp(self, frames: "Frames", change: Change) -> np.ndarray:
        """Change of y for a change of frames and inputs, to first order."""

    @abstractmethod
    def vjp(self, frames: "Frames", seed: np.ndarray) -> Change:
        """Gradient by frames and inputs of a loss whose gradient by y is `seed`."""
