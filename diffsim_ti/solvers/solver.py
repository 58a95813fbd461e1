"""What every solver is: a scene, a step, and how the step is divided."""

import math
from collections.abc import Mapping
from copy import copy
from typing import TYPE_CHECKING, Literal, TypedDict

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti import runtime
from diffsim_ti.common.checked import number, shown
from diffsim_ti.common.public import Public
from diffsim_ti.common.warn import warn
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.monitor import stability
from diffsim_ti.monitor.stability import sampled_by_runs, stiffest
from diffsim_ti.solvers.substeps import SHARE, Chosen, Substeps, checked, divided, needed
from diffsim_ti.state.schedule import EqualSteps, Schedule, UnequalSteps

if TYPE_CHECKING:
    from diffsim_ti.scene import Scene


class SolverOptions(TypedDict, total=False):
    """What solvers take besides the scene; each takes those that its constructor names."""

    dt: float
    substeps: Substeps
    load_steps: int
    parallel: bool | None
    allow_unstable: bool
    check_start: bool
    contact: Literal["stage", "force"]
    contact_damping: float
    viscous_stages: int
    tolerance: float
    max_iterations: int
    preconditioner: Literal["auto", "block_jacobi", "multigrid"]


class Solver(metaclass=Public):
    """Advances a scene by steps of dt [s], each divided into `substeps` equal substeps.

    substeps: a number, or "auto" of explicit solvers: one where dt is stable at the start (`stable_dt`), else so many that
        each is 0.7 of the stable step at the most. The first run of a Rollout or a Batch raises their number to what its
        values ask for, in a batch the stiffest scene; a later run that needs more, and one whose state outgrows the stable
        step, raises an error with the number to pass. A Simulator takes more for the steps to come, with a warning. Give the
        number itself where another process is to repeat such a run. Implicit solvers are stable with any step and take
        "auto" for one.
    parallel: each substep on all threads, or many of them in a row on one; None chooses by size.
    allow_unstable: take a step beyond the stable one all the same: neither the start nor the run is checked.
    check_start: whether the constructor checks the stable step, which a number of substeps may not exceed; False where
        `substeps` is chosen later, before each step or by `choose_substeps`. The run is checked all the same.
    Raises ValueError for dt <= 0, substeps < 1, substeps beyond the stable step, and where "auto" would take over 10 000.
    """

    explicit = False
    order = 0
    # tetrahedra up to which one thread beats two (measured): starting two costs 20 us per loop, and Taichi cuts loops
    # into pieces of at least 512 items, which are blocks of eight where the law works in lanes
    serial_limit = 3_000
    serial_limit_in_lanes = 10_000
    arguments = ("dt", "substeps", "parallel", "allow_unstable", "check_start")  # of the constructor, besides the scene
    kicks = stability.ONE  # of a substep
    moves_robots = False  # whether the joints of robots are unknowns of its passes
    stages_contact = False  # whether obstacles act as a stage of its passes, not as a force

    def __init__(
        self,
        scene: "Scene",
        dt: float = 0.01,
        substeps: Substeps = "auto",
        parallel: bool | None = None,
        allow_unstable: bool = False,
        check_start: bool = True,
    ):
        dt, substeps = number("dt", dt, unit="s"), checked(substeps, self.explicit)
        self.check_scene(scene)
        for x in scene.interactions:
            x.check_solver(self)
            if self.explicit and x.in_kernels and type(x).kernel is Interaction.kernel:
                raise ValueError(
                    f"{type(x).__name__} has no `kernel`, which explicit steps run: write it, or take an implicit solver"
                )
        self.scene = scene if self.explicit else scene.with_consistent_mass()
        self.dt, self.substeps = float(dt), substeps
        self.parallel, self.allow_unstable, self.check_start = parallel, allow_unstable, check_start
        runtime.check_host_init()
        runtime.check_backend(scene.precision)
        if not self.explicit and scene.law.in_steps().reads != ("H",):
            raise ValueError(
                f"{type(scene.law).__name__} reads {', '.join(scene.law.reads)}, but {type(self).__name__} supports forces "
                "of displacements only; take SemiImplicitSolver or VelocityVerletSolver"
            )
        self._schedule: UnequalSteps | None = None
        self._equal, self._equal_steps = None, None  # made once for dt and substeps as they are
        self._tight: stability.StepLimit | None = None
        self._deformed: bool | None = None
        if self.explicit and check_start and not allow_unstable:
            self._check_step()

    def check_scene(self, scene) -> None:
        """Raise ValueError for what is no scene."""
        if not hasattr(scene, "with_consistent_mass"):
            raise ValueError(f"{type(self).__name__}: takes a Scene, got {shown(scene)}")

    def check_contact_forces(self) -> None:
        """Raise ValueError where runs cannot note what obstacles do."""

    def __reduce__(self):
        """As it was made, for its scene."""
        own = dict(scene=self.scene) | {name: getattr(self, name) for name in self.arguments}
        return _on_schedule, (type(self), own, self._schedule)

    def for_scene(self, scene: "Scene", **changes: Unpack[SolverOptions]) -> "Solver":
        """The same solver for another scene, with some arguments replaced."""
        return type(self)(scene, **{name: getattr(self, name) for name in self.arguments} | changes)

    def unchecked_for(self, scene: "Scene") -> "Solver":
        """The same for another scene, in which an explicit step may be too long."""
        options = {name: getattr(self, name) for name in self.arguments}
        return type(self)(scene, **options | (dict(check_start=False) if self.explicit else {}))

    @property
    def schedule(self) -> Schedule:
        """Where each pass lies in time."""
        if self._schedule is not None:
            return self._unequal
        if self._equal != (self.dt, self.substeps):
            self._equal = self.dt, self.substeps
            self._equal_steps = self.passes_of(EqualSteps(self.dt, self.substeps))
        return self._equal_steps

    @property
    def unequal_steps(self) -> UnequalSteps | None:
        """The steps, where they are not equal."""
        return self._schedule

    def passes_of(self, steps: Schedule) -> Schedule:
        """The passes of this solver on these steps: one for each substep, or more."""
        return steps

    def on(self, schedule: UnequalSteps) -> "Solver":
        """The same solver on other steps. Raises ValueError for steps that it cannot take."""
        out = self.for_scene(self.scene)
        out._schedule, out._unequal = schedule, out.passes_of(schedule)
        out.check_schedule(schedule)
        return out

    def check_schedule(self, schedule: UnequalSteps) -> None:
        """Raise ValueError for steps that this solver cannot take."""
        if self.explicit and self.check_start and not self.allow_unstable:
            self._check_step()

    def lengths(self, j: ArrayLike, rate: float) -> tuple[np.ndarray, np.ndarray]:
        """(lengths h of passes j [s], exp(-rate h))"""
        j = np.asarray(j)
        if j.size == 1:  # asked for in each pass by what works on the host
            h = float(self.schedule.length(j.item()))
            return np.full(j.shape, h), np.full(j.shape, math.exp(-rate * h))
        h, place = np.unique(self.schedule.length(j), return_inverse=True)
        decay = np.array([math.exp(-rate * x) for x in h])  # whose last bit NumPy's own may have otherwise
        return h[place].reshape(np.shape(j)), decay[place].reshape(np.shape(j))

    def num_passes(self, steps: int) -> int:
        """Passes that so many steps take."""
        return int(self.schedule.first(steps))

    @property
    def substep(self) -> float:
        """Length h of a substep [s]; of unequal ones the longest."""
        return self.schedule.longest

    def runs_parallel(self) -> bool:
        """Whether passes are launched one by one on all threads."""
        if self.parallel is not None:
            return self.parallel or not runtime.runs_on_cpu()
        in_lanes = self.scene.material.law(self.scene.precision).lanes
        limit = self.serial_limit_in_lanes if in_lanes else self.serial_limit
        return not runtime.runs_on_cpu() or self.scene.mesh.num_tetrahedra > limit

    def passes_per_launch(self) -> int:
        """How many passes one launch does at most where they run in parallel."""
        return 1

    def stable_dt(self, tight: bool = False) -> stability.StepLimit:
        """Largest stable substep at the start: the safe element bound or, `tight`, the Lanczos value. Pressures of gases,
        tensions and lengths of cables are the stiffest of all keyframes and steps; functions of time are known at 0."""
        if not tight:
            return stability.element_limit(self.scene, kicks=self.kicks)
        if self._tight is None:
            self._tight = self._tight_limit(self.scene.inputs.at_times([0.0, self.dt]))
        return self._tight

    def _tight_limit(self, values: dict) -> stability.StepLimit:
        return stability.lanczos_limit(self.workspace(self.scene.inputs.derive(stiffest(self.scene, values))))

    def start_values(self):
        """What kernels read at the start; a step of motion rows if fixed vertices move."""
        return self.scene.inputs.derive(self.scene.inputs.at_step(0, self.dt))

    def starts_deformed(self, strain: float = 0.05) -> bool:
        """Whether the start is strained so much that the bound at rest may not hold."""
        if self._deformed is None:
            inputs = self.scene.inputs
            u = inputs.values["initial_positions"] - inputs.values["rest_positions"]
            H = inputs.stress_points.displacement_gradients
            self._deformed = bool(u.any() and np.abs(H(u)).max() > strain)
        return self._deformed

    @property
    def automatic(self) -> bool:
        """Whether the number of substeps was left to the solver, and may be raised."""
        looked_at = self.check_start and not self.allow_unstable
        return isinstance(self.substeps, Chosen) and self._schedule is None and looked_at

    @property
    def knows_limit(self) -> bool:
        """Whether the tight stable step of the start was asked for."""
        return self._tight is not None

    def _check_step(self) -> None:
        """Divide a step that is beyond the stable one, or refuse it."""
        if self.substep > self.stable_dt().dt or self.starts_deformed():
            tight = self.stable_dt(tight=True)
            if self.automatic and self.substep > tight.dt:
                self.substeps = Chosen(divided(self.dt, tight))
            self._refuse_beyond(tight)

    def substeps_of(self, lengths: np.ndarray) -> int | np.ndarray:
        """Substeps of steps of some lengths [s]: the solver's own, or one by one where they were left to it."""
        if not self.automatic:
            return self.substeps
        if np.max(lengths, initial=0) <= self.stable_dt().dt and not self.starts_deformed():
            return 1
        tight = self.stable_dt(tight=True)
        return np.array([divided(float(length), tight) for length in lengths])

    def with_substeps_for(self, stable: stability.StepLimit | None) -> "Solver":
        """The solver itself, or a copy with more substeps where a stable step asks for them."""
        count = self.substeps if stable is None else divided(self.dt, stable)
        return self if count <= self.substeps else self.with_substeps(count)

    def with_substeps(self, count: int) -> "Solver":
        """A copy with another number of substeps, which may be raised further."""
        out = copy(self)
        out.substeps = Chosen(count)
        return out

    def limit_at(self, values: dict) -> stability.StepLimit:
        """The tight stable step of the start at the values of a run, which has those of its steps."""
        inputs = self.scene.inputs
        return self._tight_limit(inputs.at_times([0.0, self.dt]) | values)

    def check_run(self, values: dict) -> None:
        """Raise ValueError where the substep is beyond what gases and cables over time ask for, which a run samples."""
        if not self.explicit or not self.check_start or self.allow_unstable or not sampled_by_runs(self.scene):
            return
        if not self.automatic and self.substep > stability.element_limit(self.scene, values, self.kicks).dt:
            self._refuse_beyond(self._tight_limit(values))

    def refuse_values(self, stable: stability.StepLimit) -> None:
        """Raise ValueError for values of a run that ask for more substeps than the runs before it."""
        raise ValueError(
            f"the stable step of these values is {stable}, and this run's substeps of {self.substep:.4g} s were chosen in "
            "the first run and stay, so that runs can be compared: make the solver with substeps="
            f"{needed(self.dt, stable.dt)}, or another Rollout or Batch"
        )

    def _refuse_beyond(self, tight: stability.StepLimit) -> None:
        if self.substep > tight.dt:
            what, remedy = "dt / substeps =", f"reduce dt, pass substeps={needed(self.dt, tight.dt, 0.95)}"
            if self._schedule is not None:
                what, remedy = f"of {self._schedule}, the longest:", "shorten the longest steps"
            raise ValueError(
                f"the substep {what} {self.substep:.4g} s exceeds the stable step {tight}: {remedy}, use an implicit "
                "solver, or pass allow_unstable=True to this one"
            )

    def choose_substeps(self, share: float = SHARE, values: Mapping[str, ArrayLike] | None = None) -> int:
        """Raise `substeps` to what stability asks for, with a margin, and return it; say so once if a smaller number was
        given.

        values: of the scenes of a `Batch`, inputs with their axis in front; the stiffest scene decides, which is named.
        """
        each = (
            [self.unchecked_for(scene).stable_dt(tight=True) for scene in self.scene.with_each(values)]
            if values
            else []
        )
        b = min(range(len(each)), key=lambda b: each[b].dt, default=None)
        stable = self.stable_dt(tight=True) if b is None else each[b]
        of = f" of scene {b}, the stiffest of {len(each)}," if values else ""
        count = needed(self.dt, stable.dt, share)
        if count > self.substeps:
            if not isinstance(self.substeps, Chosen):
                warn(
                    f"dt = {self.dt:g} s is divided into {count} substeps (asked for at least {self.substeps}): "
                    f"the stable step{of} is {stable}"
                )
            self.substeps = type(self.substeps)(count)
        return int(self.substeps)

    def describe(self) -> str:
        """How the scene advances, in a line."""
        number = self.passes_per_launch()
        each = "one launch per substep" if number == 1 else f"up to {number} substeps per launch"
        how = f"parallel, {each}" if self.runs_parallel() else "serial, many substeps per launch"
        return f"{type(self).__name__}: dt {self.dt:g} s, {self.substeps} substeps of {self.substep:.4g} s; {how}"

    def __repr__(self) -> str:
        return f"{type(self).__name__}(dt={self.dt:g}, substeps={self.substeps})"


def _on_schedule(kind: type, arguments: dict, schedule: UnequalSteps | None) -> Solver:
    solver = kind(**arguments)
    return solver if schedule is None else solver.on(schedule)
