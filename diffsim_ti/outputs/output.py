"""An output, which losses use like positions: a function of a run's frames and inputs; and the states themselves as
outputs, which every rollout has."""

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.public import Public
from diffsim_ti.differentiation.arrays import Node, Recorded, forward, jointly, made, reverse
from diffsim_ti.inputs import Derived, DerivedNode
from diffsim_ti.scene import Scene
from diffsim_ti.state.watch import ContactResolution
from diffsim_ti.terms import Growth

if TYPE_CHECKING:
    from diffsim_ti.rollout.run import Run


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

    `joint_states`, of scenes with robots: joint positions, velocities and efforts, shape (frames, joints of all robots, 3).

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
    joint_states: np.ndarray | None = field(default=None, repr=False)
    steps: np.ndarray | None = field(default=None, repr=False)  # of the run that are done in each frame
    run: "Run | None" = field(default=None, repr=False)
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


# what runs note besides states, where outputs read it
NOTED = ("contact_forces", "chamber_pressures", "law_state", "joint_states")
STATES = ("positions", "velocities", *NOTED)


@dataclass
class Change:
    """A change of frames and inputs, or the gradient of a loss by them; None, and inputs left out, are zero.

    positions [m], velocities [m/s]: shape (frames, num_vertices, 3); inputs: name -> array of the input's shape.
    contact_forces [N], chamber_pressures [Pa], law_state, joint_states: of the frames' arrays of that name, where an output
    says that it reads them.
    positions are those of the frames, which move with rest_positions where displacements are kept, and the other way
    round: they are the variable of the chain rule, and displacements are positions less rest_positions.
    """

    positions: np.ndarray | None = None
    velocities: np.ndarray | None = None
    inputs: dict[str, np.ndarray] = field(default_factory=dict)
    contact_forces: np.ndarray | None = None
    chamber_pressures: np.ndarray | None = None
    law_state: np.ndarray | None = None
    joint_states: np.ndarray | None = None

    @property
    def noted(self) -> dict[str, np.ndarray | None]:
        """Those of what runs note besides states, by name."""
        return {name: getattr(self, name) for name in NOTED}

    def add(self, other: "Change") -> None:
        """Add another one."""
        for name in STATES:
            theirs = getattr(other, name)
            if theirs is not None:
                mine = getattr(self, name)
                setattr(self, name, theirs if mine is None else mine + theirs)
        for name, value in other.inputs.items():
            self.inputs[name] = self.inputs[name] + value if name in self.inputs else value


def _add_to(into: dict, more: dict) -> None:
    for name, x in more.items():
        into[name] = into[name] + x if name in into else x


class _Recording:
    """Frames whose states and inputs record what outputs do to them."""

    def __init__(self, frames: Frames):
        self.frames = frames
        self.leaves: dict[str, Recorded] = {}  # of what was asked for
        self.numbers = Node(frames.inputs, (), dict)

    def __getattr__(self, name: str):
        x = self.leaves.get(name)
        if x is None:
            x = getattr(self.frames, name)
            if name in STATES and x is not None:
                x = self.leaves[name] = Recorded(np.asarray(x, np.float64))
        return x

    def __getitem__(self, name: str):
        return getattr(self, name) if name in ("positions", "velocities", "displacements") else self.outputs

    @property
    def outputs(self):
        raise TypeError(
            "another output has no derivative here: compute it from states, or write jvp and vjp beside value"
        )

    @cached_property
    def inputs(self) -> dict[str, Recorded]:
        def leaf(name, x):
            return made(
                x, (self.numbers, lambda changes: changes.get(name), lambda s: lambda into: _add_to(into, {name: s}))
            )

        return {name: leaf(name, x) for name, x in self.frames.inputs.items()}

    @cached_property
    def displacements(self) -> Recorded:
        """Of the frames' own digits; they change as positions less the rest shape do."""
        of_places = self.positions, lambda dx: dx, lambda seed: seed
        of_rest = self.inputs["rest_positions"], lambda dX: -dX, lambda seed: -seed.sum(0)
        return made(self.frames.displacements.astype(np.float64), of_places, of_rest)

    def tangent(self, y, change: "Change") -> np.ndarray:
        """Change of what was made of the frames."""
        changes = [(leaf, getattr(change, name)) for name, leaf in self.leaves.items()]
        return forward(y, [*changes, (self.numbers, change.inputs or None)])

    def adjoint(self, y, seed: np.ndarray) -> "Change":
        """Gradient for that by what was made of them."""
        *states, inputs = reverse(y, seed, [*self.leaves.values(), self.numbers])
        return Change(**dict(zip(self.leaves, states)), inputs=inputs or {})


def derived(scene: Scene, frames: "Frames | _Recording") -> Derived:
    """What kernels read of the inputs of frames."""
    if not isinstance(frames, _Recording):
        return scene.inputs.derive(frames.inputs)
    read, values = scene.inputs, frames.frames.inputs

    def pull(adjoint):
        return lambda into: _add_to(into, read.derive_vjp(values, adjoint, tuple(values)))

    return DerivedNode(read.derive(values), (frames.numbers, lambda changes: read.derive_jvp(values, changes), pull))


class Output(metaclass=Public):
    """A function y(positions, velocities, inputs) of a run's frames, for `Rollout(..., outputs=[...])`.

    Write one outside the package by giving it `name`, `shape` and `value`, in NumPy and float64; it is then in
    `frames[name]` and `Rollout.tangents`, takes a seed in `Rollout.vjp(frames, name=...)`, and has a field under
    `ti.ad.Tape` and a tensor in torch. `frames` (`Frames`) holds the states and, in `frames.inputs`, the values of
    all inputs. Derivatives are found from `value` (differentiation/arrays.py), where an error says what has none; there
    write `jvp` and `vjp` beside it. Both branches of `np.where` are differentiated, so that the one which is not taken has
    to be finite, with its slope; `np.linalg.eigvalsh` is of arrays that stay symmetric. Rollout.tangents and
    Rollout.vjp must then agree in <w, J d> = <J^T w, d>: check that, and differences.
    Griewank, Walther, Evaluating Derivatives, ch. 3, doi:10.1137/1.9780898717761.
    """

    name: str
    _shown: tuple[str, ...] = ()  # arguments that `repr` shows, beside the name
    unit = ""  # for pictures
    cumulative = False  # whether it counts from the first frame on, and so is of no state by itself
    # whether runs must note frames.contact_forces for it: what obstacles do (True), or "surfaces" to each other
    reads_contact_forces: bool | Literal["surfaces"] = False
    reads_chamber_pressures = False  # the same of frames.chamber_pressures
    reads_law_state = False  # the same of frames.law_state, where the law remembers
    reads_joint_states = False  # whether it reads frames.joint_states, which runs of robots note

    def __repr__(self) -> str:
        given = [repr(getattr(self, argument)) for argument in self._shown]
        return f"{type(self).__name__}({', '.join([*given, f'name={self.name!r}'])})"

    @staticmethod
    def refuse_growth(output: str, scene: Scene) -> None:
        """Raise ValueError where tetrahedra grow over time: an output knows frames, not what they had grown by."""
        if scene.term(Growth):
            raise ValueError(
                f"{output} evaluates the law and does not support Growth over time; take Grown(material, growth), or strains"
            )

    def remembered(self, frames: Frames, scene: Scene) -> np.ndarray:
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

    def settled(self, scene: Scene) -> "Output":
        """This output for a scene: checked, with what depends on the scene alone; raises ValueError if it does not fit."""
        return self

    @abstractmethod
    def shape(self, num_frames: int) -> tuple[int, ...]:
        """Shape of the value; three numbers at the end make vectors of a Taichi field."""

    @abstractmethod
    def value(self, frames: Frames) -> np.ndarray:
        """y."""

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        """Change of y for a change of frames and inputs, to first order."""
        at = _Recording(frames)
        return at.tangent(self.value(at), change)

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        """Gradient by frames and inputs of a loss whose gradient by y is `seed`."""
        at = _Recording(frames)
        return at.adjoint(self.value(at), seed)


def taken_from(output: Output, frames: "Frames | _Recording") -> np.ndarray:
    """The value of an output for another one, also where it has derivatives of its own."""
    if not isinstance(frames, _Recording) or type(output).vjp is Output.vjp:
        return output.value(frames)
    plain, found = frames.frames, []

    def push(inputs, *states):
        return output.jvp(plain, Change(inputs=inputs or {}, **dict(zip(STATES, states))))

    def by_inputs(seed):
        found[:] = [output.vjp(plain, seed)]
        return lambda into: _add_to(into, found[0].inputs)

    states = [(getattr(frames, name), lambda _, name=name: getattr(found[0], name)) for name in STATES]
    return jointly(output.value(plain), push, (frames.numbers, by_inputs), *states)


def force_or_moment(forces: np.ndarray, places: np.ndarray, about: np.ndarray | None) -> np.ndarray:
    """Sum of forces on vertices in each frame, shape (frames, 3), or sum_i (x_i - about) x f_i."""
    return forces.sum(1) if about is None else np.cross(places.astype(np.float64) - about, forces).sum(1)


class _States(Output):
    """Vectors of all vertices in all frames."""

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
