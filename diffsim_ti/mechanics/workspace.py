"""Device data of one run: the scene's numbers, the current state, recorded states and saved frames as needed."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.common.checked import numbers
from diffsim_ti.inputs import Derived, Mass
from diffsim_ti.mechanics.stress.law_state import LawFrames
from diffsim_ti.mechanics.surfaces.curved_pairs import pairs_of
from diffsim_ti.mechanics.surfaces.surface_pairs import SurfacePairs
from diffsim_ti.runtime import Kernel
from diffsim_ti.runtime.slots import copy_slot
from diffsim_ti.state.arrays import SceneArrays
from diffsim_ti.state.bending import Bending
from diffsim_ti.state.history import History, first_bad_vertex
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE, Moment
from diffsim_ti.state.solve_report import SolveReport
from diffsim_ti.state.watch import ContactWatch


class FrameArrays(NamedTuple):
    """Displacements and velocities of the saved frames."""

    frames_u: ti.Ndarray
    frames_v: ti.Ndarray

    @classmethod
    def of(cls, arrays: SceneArrays, *shape: int) -> "FrameArrays":
        return cls(runtime.array(arrays.vector, *shape), runtime.array(arrays.vector, *shape))


class Workspace:
    """What every solver's run needs; `advance` is the solver's own."""

    pairs_kind, arrays_kind = SurfacePairs, SceneArrays
    first_step = 0  # steps that were done before this run, for reports
    potential = None  # of implicit steps
    chambers = None  # of explicit steps
    volumes = None  # of chambers, that are held
    energy_watch = None  # counts energy that long steps add, for solvers that neither damp nor limit it
    changes = 0  # of the state from outside its passes
    last_multipliers = None  # of constrained volumes, in implicit steps
    impulses = None  # of obstacles on vertices in each frame, where a loss names them
    joints = None  # of robots
    law_frames = None  # what the law remembers in each frame, where an output reads it

    def __init__(self, solver, derived: Derived, bend: float = 0.0):
        self.solver, self.scene, self.report = solver, solver.scene, SolveReport()
        self.substep = solver.substep  # length of the passes that were last looked after [s]
        self.owner = runtime.program()
        explicit = solver.explicit
        self.arrays = self.arrays_kind(self.scene, solver.stages_contact, explicit, not explicit, bend)
        self.parallel = solver.runs_parallel()
        self.pairs = pairs_of(self.pairs_kind, self.arrays, self.parallel)
        self.state = self.history(1)
        self.record: History | None = None
        self.frames = FrameArrays.of(self.arrays, 1, 1)
        self.watch, self.bending = ContactWatch(self), Bending.of(self)
        self._launches = {}
        self.load(derived)

    def history(self, num_slots: int, record: bool = False) -> History:
        """Room for states of this run."""
        return History(self.arrays, num_slots, record)

    def load(self, derived: Derived) -> None:
        """Bring inputs to the device and set the start state."""
        runtime.check_alive(self.owner)
        if self.arrays.load(derived):
            self._launches.clear()
        self.restart()
        if self.pairs:
            self.pairs.load(self.state.u)
            self.check_surfaces()

    def restart(self) -> None:
        """Set the state to the start."""
        self.changes += 1
        runtime.fill(self.state.u, self.arrays.values.displacement[None])
        runtime.fill(self.state.v, self.arrays.values.velocity[None])
        if self.state.z is not None:
            runtime.fill(self.state.z, self.arrays.initial_state_blocks())
        self.start_joints()
        self.place_obstacles(0)
        self.watch.clear()

    def start_joints(self) -> None:
        """Joints are where they start."""
        if self.joints:
            self.state.joints[0] = self.joints.start()

    def place_obstacles(self, now: int) -> None:
        """Put obstacles where they are before pass `now`, for what looks at the state there."""
        self.arrays.place_obstacles(self.solver.schedule, now)
        if self.joints:
            rows = runtime.fetch(self.arrays.offsets)[:, :3].astype(np.float64)
            self.joints.put(rows, self.state.joints[0][0], (AT_STAGE, AT_BEGIN))
            runtime.fill(self.arrays.offsets, rows)
        if self.pairs:
            self.pairs.follow(runtime.fetch(self.arrays.offsets).astype(np.float64), AT_STAGE)

    @property
    def mass(self) -> Mass:
        """Of the vertices, as the solver has it."""
        return self.mass_of(self.arrays.values)

    def mass_of(self, values: Derived) -> Mass:
        """The same of some values, or of changes of them."""
        return values.mass[:, None]

    def kept(self, name, make):
        """make(), kept until launches must be bound again."""
        if name not in self._launches:
            self._launches[name] = make()
        return self._launches[name]

    def bound(self, kernel: Kernel, **records) -> Callable:
        """A kernel bound to the scene and other records, kept as long as the arrays are."""
        parts = [part for record in records.values() for part in (record if type(record) is tuple else (record,))]
        key = (kernel, *map(id, parts))
        return self.kept(key, lambda: (kernel.bind(self.arrays.in_vectors, scene=self.arrays, **records), parts))[0]

    def check_surfaces(self) -> None:
        """Raise Overlap where surfaces of the state touch or pass through each other; there are pairs."""
        self.pairs.check_apart(self.state.u)

    def check_apart(self) -> None:
        """Raise Overlap where the state is in an obstacle and steps could not bring it out."""

    def forget(self) -> None:
        """The state was set from outside: forget what came before it."""
        self.changes += 1
        if self.pairs:
            self.pairs.forget(self.state.u)
            self.check_surfaces()

    def checked_law_state(self, law_state) -> np.ndarray:
        """What a law shall remember, as an array; raises ValueError for another shape."""
        value, shape = numbers("law_state", law_state), self.arrays.law_state_shape
        names = self.arrays.law.state_names
        if not names:
            raise ValueError(f"law_state: {self.arrays.law.title} has no state; leave it out")
        if value.shape != shape or not np.all(np.isfinite(value)):
            raise ValueError(
                f"law_state: expected finite numbers of shape {shape}, in each tetrahedron {', '.join(names)}, "
                f"got shape {value.shape}"
            )
        return value

    def set_law_state(self, law_state: np.ndarray) -> None:
        """Let the law remember this, checked."""
        runtime.fill(self.state.z, self.arrays.to_blocks(law_state)[None])

    def step_of(self, j: int, num_passes: int) -> int:
        """The step that pass j belongs to; velocity Verlet's closing half kick belongs to the last one."""
        solver = self.solver
        return self.first_step + int(solver.schedule.row(min(j, num_passes - solver.num_passes(0) - 1)))

    def when(self, step: int) -> str:
        """A step and its time, in words."""
        return f"step {step}, t = {self.solver.schedule.time(step):.6g} s"

    def dated(self, error: Exception, j: int, num_passes: int) -> Exception:
        """The same error, which says when: in pass j of a run, before which `first_step` steps were done."""
        error.step = self.step_of(j, num_passes)
        error.args = (f"{self.when(error.step)}: {error}",)
        return error

    @property
    def rate(self) -> float:
        """The drag rate [1/s]."""
        at = self.arrays.features().drag
        return float(self.arrays.values.parameters[at]) if at >= 0 else 0.0

    def make_frames(self, count: int) -> None:
        """Room for `count` saved states."""
        self.frames = FrameArrays.of(self.arrays, count, self.arrays.num_vertices)
        self.joint_frames = [None] * count  # positions, velocities and efforts of joints, a column each
        self._launches.clear()

    def balance(self):
        """What follows the drift of the energy from now on, by `begin` and `take` (monitor/energy_balance.py); None where
        that cannot be told from what is done to the body."""

    def record_law_states(self) -> None:
        """From now on note what the law remembers in each frame; the frames are made."""
        self.law_frames = LawFrames(self)

    def record_contacts(self, wanted: frozenset) -> None:
        """From now on note, for each frame, what contact does to each vertex; the frames are made. wanted: of obstacles
        (True), of surfaces to each other ("surfaces"), or both."""
        raise NotImplementedError

    def forget_contacts(self) -> None:
        """Note them anew."""
        raise NotImplementedError

    def contact_forces(self, frame_time: np.ndarray):
        """Mean forces [N] of frames, shape (frames, obstacles and surfaces on each other, 2: by push and by friction,
        num_vertices, 3); frame_time: how long each takes [s], or all."""
        raise NotImplementedError

    def chamber_pressures(self, num_frames: int, save_every: int):
        """Pressures [Pa] of chambers whose volume is constrained, shape (frames, chambers), frames `save_every` steps
        apart."""
        raise NotImplementedError

    def make_record(self, num_slots: int) -> History:
        """Room for `num_slots` recorded states."""
        if self.record is None or self.record.num_slots < num_slots:
            self.record = self.history(num_slots, record=True)
            self._launches.clear()
            if self.pairs:
                self.pairs.unbind()
        return self.record

    def first_bad_vertex(self) -> int | None:
        """The first vertex whose state is not finite, or None."""
        return first_bad_vertex(self.state)

    def velocity_of(self, vertex: int):
        """Velocity of one vertex [m/s]."""
        return runtime.fetch(self.state.v)[0, vertex]

    def velocity_of_obstacle(self, k: int, j: int, vertex: int) -> np.ndarray:
        """At a vertex, when pass j begins [m/s]."""
        arrays, schedule = self.arrays, self.solver.schedule
        led = self.joints and k in dict(self.joints.links)
        if arrays.obstacles[k][2] < 0 and not led:
            return np.zeros(3)
        begin = schedule.begin(j)
        rows = arrays.poses.value(arrays.rows["path"], Moment(schedule, j, begin, begin))
        if led:
            self.joints.put_moving(rows, *self.state.joints[0][:2])
        position = arrays.values.rest[vertex] + runtime.fetch(self.state.u)[0, vertex]
        return arrays.poses.velocity_at(k, rows, position, self.watch.contacts[k].about)

    def restore_to_record(self) -> None:
        """Copy the current state to slot 0 of the record."""
        self.save(self.record, 0)

    def save(self, target: History, slot: int) -> None:
        """Copy the current state to a slot."""
        self.state.copy(0, target, slot)

    def restore(self, source: History, slot: int) -> None:
        """Copy a slot to the current state."""
        self.changes += 1
        source.copy(slot, self.state, 0)

    def save_frame(self, frame: int) -> None:
        """Copy the current state to a frame."""
        copy_slot(self.state.u, 0, self.frames[0], frame)
        copy_slot(self.state.v, 0, self.frames[1], frame)
        if self.law_frames:
            self.law_frames.note(frame, self.state.z)
        self.note_joints(frame, self.state, 0)

    def note_joints(self, frame: int, history: History, slot: int) -> None:
        """A frame has the joints of a slot."""
        if self.joints and frame >= 0:
            self.joint_frames[frame] = np.stack(history.joints[slot][:3], 1)
