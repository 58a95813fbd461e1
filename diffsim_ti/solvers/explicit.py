"""What the explicit solvers share: a chain of kick-drift passes (kick_drift.py), forward, tangent and reverse."""

from abc import abstractmethod
from dataclasses import dataclass

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.solvers.arrays import History, SceneArrays, copy_slot, first_bad_vertex
from diffsim_ti.solvers.kick_drift import kick_drift_kernels
from diffsim_ti.solvers.solver import Solver


@dataclass(frozen=True)
class Weights:
    """Numbers of a pass (kick_drift.py) and their derivatives by the drag rate."""

    lag0: int
    lag1: int
    pre: float
    post: float
    alpha: float
    decay: float
    alpha_by_rate: float = 0.0
    decay_by_rate: float = 0.0


class ExplicitSolver(Solver):
    """Explicit steps: each costs one force evaluation, and dt may not exceed 2 / omega_max."""

    explicit = True
    # tetrahedra up to which one thread beats two (measured): starting two costs 20 us per loop, and Taichi cuts loops
    # into pieces of at least 512 items, which are blocks of eight where the law works in lanes
    serial_limit = 3_000
    serial_limit_in_lanes = 10_000

    @abstractmethod
    def groups(self, first: int, last: int, num_passes: int, rate: float) -> list[tuple[int, int, Weights]]:
        """Passes first .. last - 1 as runs (first, count, weights) of equal weights."""

    @abstractmethod
    def num_passes(self, steps: int) -> int:
        """Passes that `steps` steps take."""

    def workspace(self, derived: Derived) -> "ExplicitWorkspace":
        """Arrays and bound launches for runs of this solver."""
        return ExplicitWorkspace(self, derived)


class ExplicitWorkspace:
    """Device data of one run: the scene's numbers, the current state, recorded states and saved frames as needed."""

    work_per_launch = 4_000_000  # tetrahedra x passes in one launch: a tenth of a second, so that Ctrl-C is heard

    def __init__(self, solver: ExplicitSolver, derived: Derived):
        self.solver, self.scene = solver, solver.scene
        self.owner = runtime.program()
        self.arrays = SceneArrays(self.scene)
        self.parallel = solver.runs_parallel()
        self.state = History(self.arrays, 1, record=False)
        self.record: History | None = None
        self.frames = (runtime.array(self.arrays.vector, 1, 1), runtime.array(self.arrays.vector, 1, 1))
        self._launches = {}
        self.load(derived)

    def load(self, derived: Derived) -> None:
        """Bring inputs to the device and set the start state."""
        runtime.check_alive(self.owner)
        if self.arrays.load(derived):
            self._launches.clear()
        self.restart()

    def restart(self) -> None:
        """Set the state to the start."""
        runtime.fill(self.state.u, self.arrays.values.displacement[None])
        runtime.fill(self.state.v, self.arrays.values.velocity[None])

    @property
    def rate(self) -> float:
        """The drag rate [1/s]."""
        at = self.arrays.features().drag
        return float(self.arrays.values.parameters[at]) if at >= 0 else 0.0

    def make_frames(self, count: int) -> None:
        """Room for `count` saved states."""
        self.frames = tuple(runtime.array(self.arrays.vector, count, self.arrays.num_vertices) for _ in range(2))
        self._launches.clear()

    def make_record(self, num_slots: int) -> History:
        """Room for `num_slots` recorded states."""
        if self.record is None or self.record.num_slots < num_slots:
            self.record = History(self.arrays, num_slots, record=True)
            self._launches.clear()
        return self.record

    def _launch(self, name: str, kernel, *arrays) -> runtime.Launch:
        if name not in self._launches:
            self._launches[name] = runtime.Launch(kernel, *arrays, vectorized=self.arrays.in_lanes)
        return self._launches[name]

    def advance(self, first: int, last: int, num_passes: int, save_every: int = 0, base: int | None = None) -> None:
        """Passes first .. last - 1 from the current state; or recorded: slot j - base holds the state before pass j."""
        a, recording = self.arrays, base is not None
        history = self.record if recording else self.state
        kernels = kick_drift_kernels(a.law, a.features(), self.parallel, a.in_lanes)
        launch = self._launch(
            f"step {recording}", kernels.step, *a.topology(), a.force_slot, a.motion_slot, a.forces, a.motion, a.anchor,
            a.corner, history.u, history.v, history.f, *self.frames,
        )  # fmt: skip
        stride, substeps, inverse_dt = int(recording), self.solver.substeps, 1 / self.solver.dt
        chunk = 1 if self.parallel else max(1, self.work_per_launch // a.num_tetrahedra)
        for start, count, w in self.solver.groups(first, last, num_passes, self.rate):
            for j in range(start, start + count, chunk):
                launch(a.num_items, a.num_vertices, j, min(chunk, start + count - j), base or 0, stride, substeps,
                       save_every,
                       w.lag0, w.lag1, w.pre, w.post, w.alpha, w.decay, inverse_dt)  # fmt: skip

    def first_bad_vertex(self) -> int | None:
        """The first vertex whose state is not finite, or None."""
        return first_bad_vertex(self.state)

    def velocity_of(self, vertex: int):
        """Velocity of one vertex [m/s]."""
        return runtime.fetch(self.state.v)[0, vertex]

    def restore_to_record(self) -> None:
        """Copy the current state to slot 0 of the record."""
        self.save(self.record, 0)

    def save(self, target: History, slot: int) -> None:
        """Copy the current state to a slot."""
        copy_slot(self.state.u, 0, target.u, slot)
        copy_slot(self.state.v, 0, target.v, slot)

    def restore(self, source: History, slot: int) -> None:
        """Copy a slot to the current state."""
        copy_slot(source.u, slot, self.state.u, 0)
        copy_slot(source.v, slot, self.state.v, 0)

    def save_frame(self, frame: int) -> None:
        """Copy the current state to a frame."""
        copy_slot(self.state.u, 0, self.frames[0], frame)
        copy_slot(self.state.v, 0, self.frames[1], frame)
