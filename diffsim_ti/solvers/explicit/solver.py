"""What the explicit solvers share: a chain of kick-drift passes (kick_drift.py), forward, tangent and reverse."""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Literal

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.checked import between
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.chambers.gases import Chambers
from diffsim_ti.mechanics.chambers.volume_constraints import VolumeConstraints
from diffsim_ti.mechanics.constraints import Constraints, HeldRelations
from diffsim_ti.mechanics.host_force import Instant
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.mechanics.joints.explicit import JointStage
from diffsim_ti.mechanics.loads.interaction import DeadLoads
from diffsim_ti.mechanics.obstacles.contact_stage import ROWS
from diffsim_ti.mechanics.obstacles.impulse_record import ImpulseRecord
from diffsim_ti.mechanics.reduced.body_checks import check_bodies, meets_between_vertices
from diffsim_ti.mechanics.reduced.projected_sets import ProjectedSets
from diffsim_ti.mechanics.robots import Robots
from diffsim_ti.mechanics.stage import Passes
from diffsim_ti.mechanics.workspace import Workspace
from diffsim_ti.monitor.energy_balance import EnergyBalance, OwnWork
from diffsim_ti.solvers.explicit.kernels import ExplicitKernels, explicit_kernels
from diffsim_ti.solvers.explicit.stages import stages_of
from diffsim_ti.solvers.explicit.sweeps import ExplicitAdjoint, ExplicitTangent
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.solvers.substeps import Substeps
from diffsim_ti.state.pass_table import PassTable
from diffsim_ti.terms import GasChamber, Growth

if TYPE_CHECKING:
    from diffsim_ti.scene import Scene


@dataclass(frozen=True)
class Weights:
    """Numbers of passes (kick_drift.py) and their derivatives by the drag rate: one for all, or one for each.

    A kick of pass j takes the shares share0 and share1 of the external forces of the steps of passes j - lag0 and j - lag1.
    """

    lag0: int
    lag1: int
    share0: float
    share1: float
    pre: float
    post: float
    alpha: float
    decay: float
    alpha_by_rate: float
    decay_by_rate: float


CONTACT_DAMPING = 0.005  # measured: tests/README.md
MOST_PASSES = 16  # in a launch on all threads of a GPU, whose cost for the host is spread over them


class ExplicitSolver(Solver):
    """Explicit steps: each costs one force evaluation, and dt may not exceed 2 / omega_max.

    contact: "stage", the default: obstacles act in a stage of each substep (contact_stage.py), which no step is too large
        for; or "force": their barriers are one more force, which the step has to follow. A vertex that is driven with more
        than a barrier holds, 7 stiffness width^2, crosses in either and raises Crossing, unless much is damped. Sets that
        are `reduced` take obstacles by "force" alone (explicit.py); their friction is a stage that slows the whole set.
        SelfContact, and obstacles that act by pairs, are always a stage, in parts of each substep
        (surfaces/contact_stage.py), which keeps surfaces apart whatever the stiffness, with friction in it, also of sets
        that are `reduced`.
    contact_damping: of the stage, from 0, which keeps the energy of a contact, to 1, which damps what the step does not
        resolve and is the smoothest. A vertex that is pressed with N rests at velocity (1 - c) h N / 2 m in the
        semi-implicit solver, whose rest is exact with 1, and at -c h N / 2 m in velocity Verlet, exact with 0.
    Raises ValueError for another `contact`, or damping outside [0, 1].
    """

    explicit = moves_robots = True
    arguments = (*Solver.arguments, "contact", "contact_damping")
    check_bodies = staticmethod(check_bodies)

    def __init__(
        self,
        scene: "Scene",
        dt: float = 0.01,
        substeps: Substeps = "auto",
        parallel: bool | None = None,
        allow_unstable: bool = False,
        check_start: bool = True,
        *,
        contact: Literal["stage", "force"] = "stage",
        contact_damping: float = CONTACT_DAMPING,
    ):
        if contact not in ("stage", "force"):
            raise ValueError(f'contact must be "stage" or "force", got {contact!r}')
        self.contact, self.contact_damping = contact, between("contact_damping", contact_damping, 0, 1, ends=True)
        if getattr(scene, "reduced", False):
            self.check_bodies(scene, contact)
        super().__init__(scene, dt, substeps, parallel, allow_unstable, check_start)
        if meets_between_vertices(scene) and runtime.arch_name() == "vulkan":
            raise ValueError(
                "surfaces that meet between vertices act as a stage of explicit steps, for which Vulkan lends a kernel too "
                "few arrays: leave SelfContact out, give obstacles by_pairs=False, or take an implicit solver or another "
                "backend"
            )

    def check_contact_forces(self) -> None:
        obstacles = any(term.acts_on_surface for term in self.scene.terms)
        if obstacles and self.scene.reduced:
            raise ValueError(
                f"ContactForce and ContactTraction are not known beside reduced sets in explicit steps: this "
                f"{type(self).__name__} moves them by their own laws; take an implicit solver"
            )
        if obstacles and self.contact == "force":
            raise ValueError(
                f"ContactForce and ContactTraction are of obstacles that act as a stage, and this {type(self).__name__} "
                'takes them as forces: pass it contact="stage"'
            )

    @property
    def stages_contact(self) -> bool:
        return self.contact == "stage"

    def passes_per_launch(self) -> int:
        """How many passes one launch does at most where they run in parallel (runtime/repeated_loops.py)."""
        alone = (
            meets_between_vertices(self.scene) or any(x.apart for x in self.scene.interactions) or self.scene.reduced
        ) or self.scene.interaction(Robots)  # which act between passes
        return 1 if alone or runtime.runs_on_cpu() or not runtime.can_repeat() else MOST_PASSES

    @abstractmethod
    def weights(self, j: np.ndarray, num_passes: int, rate: float) -> Weights:
        """Numbers of the passes j of a run of `num_passes`, at a drag rate [1/s]."""

    def pass_table(self, first: int, last: int, num_passes: int, num_rows: int, save_every: int, rate: float) -> tuple:
        """The tables of passes first .. last - 1 for kernels; num_rows: of motions and paths."""
        weights = vars(self.weights(np.arange(first, last), num_passes, rate))
        return self.schedule.table(first, last, num_rows, save_every, weights)

    @abstractmethod
    def lags(self, j: int, num_passes: int) -> bool:
        """Whether before pass j the velocity is that of half a substep ago."""

    def workspace(self, derived: Derived, bend: float = 0.0) -> "ExplicitWorkspace":
        """Arrays and bound launches for runs of this solver; bend: see state/bending.py."""
        return ExplicitWorkspace(self, derived, bend)

    def adjoint(self, workspace, density: bool, shape: bool):
        """The reverse sweep of a run."""
        return ExplicitAdjoint(workspace, density, shape)

    def tangent(self, workspace, tangent: Derived):
        """The tangent of a run."""
        return ExplicitTangent(workspace, tangent)


class ExplicitWorkspace(Workspace):
    """A run of an explicit solver: one launch for many passes, or one per pass on all threads."""

    work_per_launch = 4_000_000  # tetrahedra x passes in one launch: a tenth of a second, so that Ctrl-C is heard

    def __init__(self, solver, derived: Derived, bend: float = 0.0):
        self.table = PassTable(runtime.PRECISIONS[solver.scene.precision])
        super().__init__(solver, derived, bend)
        self.in_parallel = solver.passes_per_launch()
        self.repeated = self.parallel and self.in_parallel > 1
        features, a = self.arrays.features(), self.arrays
        self.chambers = Chambers(self) if self.scene.term(GasChamber) else None
        self.volumes = VolumeConstraints(self) if self.scene.holds_volumes else None
        self.relations = HeldRelations(self) if self.scene.interaction(Constraints) else None
        self.projected = ProjectedSets(self) if self.scene.reduced.by_basis else None
        self.joint_stage = JointStage(self) if self.scene.interaction(Robots) else None
        self.stages = stages_of(self)
        noted = ROWS * len(a.obstacles), a.num_vertices
        self.contact = SimpleNamespace(
            stage=runtime.array(a.vector, *(noted if features.staged else (1, 1))),
            # done on each vertex from outside [J] (outside_work.py)
            work=runtime.array(a.fp, a.num_vertices * (1 + features.pulled) if features.driven else 1),
            own_work=runtime.array(a.fp, a.num_vertices),
        )
        if self.joint_stage:
            self.joints = self.joint_stage.joints
            self.start_joints()
            self.place_obstacles(0)
            if features.led:  # contact acts on joints
                self.record_contacts(frozenset())
        self.hosts = host_forces(self.scene)  # for what is evaluated between passes
        self.probe = None  # room for a pass that is not taken
        unwatched = self.scene.term(Growth) or self.has_unnoted_work or self.joints
        self.energy_watch = EnergyBalance(self) if EnergyBalance.knows(a.law) and not unwatched else None

    @property
    def has_unnoted_work(self) -> bool:
        """Whether forces without an energy act vertex by vertex, whose work passes do not note."""
        on_host = (x for x in self.scene.interactions if x.on_host)
        return any(x.in_kernels and not len(x.vertices) and not f.has_energy for x, f in zip(on_host, self.hosts))

    def balance(self) -> OwnWork | None:
        if self.joints or not OwnWork.serves(self):
            return None
        self.arrays.count_own_work()
        self._launches.clear()
        return OwnWork(self)

    def record_contacts(self, wanted: frozenset) -> None:
        if True in wanted or self.arrays.features().led:
            self.arrays.record_contacts()
            self._launches.clear()
        self.impulses = ImpulseRecord(self, wanted)
        self.contact.impulse = self.impulses.impulse

    def forget_contacts(self) -> None:
        self.impulses.clear()

    def contact_forces(self, frame_time: np.ndarray) -> np.ndarray:
        return self.impulses.collect() / frame_time

    def chamber_pressures(self, num_frames: int, save_every: int) -> np.ndarray:
        return self.volumes.of_all(num_frames)

    def last_chamber_pressures(self) -> np.ndarray:
        """Those of chambers whose volume is constrained after the last pass, shape (chambers,); zero before the first."""
        return self.volumes.spread(self.volumes.last)

    def forces_at(self, j: int, num_passes: int) -> np.ndarray:
        """Forces [N] on each vertex in the current state, gravity and stages left out, as pass j of a run takes them."""
        if self.probe is None:
            self.probe = self.history(2, record=True)
        self.state.copy(0, self.probe, 0)
        seen, counted = self.watch.rows(), runtime.fetch(self.contact.own_work)  # of passes that are taken alone
        at = Passes(self, self, self.probe, j, 1, num_passes, 0, kick=True)
        at.go("do", self.stages, self.launches(j, j + 1, num_passes, 0, 1))
        self.watch.put(seen)
        runtime.fill(self.contact.own_work, counted)
        return runtime.fetch(self.probe.f)[0].astype(np.float64)

    def loads_at(self, j: int, num_passes: int, pulls: bool = True) -> np.ndarray:
        """External forces [N] on each vertex, as pass j of a run takes them; pulls: those of cables too."""
        a, schedule, u = self.arrays, self.solver.schedule, runtime.fetch_row(self.state.u, 0)
        out, kicks = np.zeros_like(u, np.float64), self.kicks(j, num_passes)
        if a.rows["forces"] is not None:
            dead = self.scene.interaction(DeadLoads)
            out[dead.acts_at] = sum(w * schedule.load(a.rows["forces"], *k, dead.keyed) for w, k in kicks)
        v = runtime.fetch_row(self.state.v, 0)
        for x, force in zip((x for x in self.scene.interactions if x.on_host), self.hosts):
            if x.first_load < len(x.vertices) and (pulls or not x.pulls):
                for w, k in kicks:
                    out += w * force.take(a.now, Instant(schedule, *k, origin=u - v, gamma=1.0)).loads(u)
        return out

    def kicks(self, j: int, num_passes: int) -> list[tuple[float, tuple[int, float]]]:
        """(its share, (pass, share of its step)) of the loads that the two kicks of pass j take."""
        schedule, w = self.solver.schedule, self.solver.weights(np.array([j]), num_passes, self.rate)
        of_kicks = (w.share0, w.lag0), (w.share1, w.lag1)
        kicks = [(float(np.ravel(share)[0]), int(np.ravel(lag)[0])) for share, lag in of_kicks]
        return [(share, (j - lag, schedule.end(j - lag) if lag else schedule.begin(j))) for share, lag in kicks]

    def share_at_stage(self, j: int, stage) -> float:
        """Share of the step at which joints of robots take targets in pass j."""
        return self.solver.schedule.end(j)

    def numbers_of(self, j: int, num_passes: int) -> SimpleNamespace:
        """h [s] of pass j, and its weights as numbers."""
        weights = vars(self.solver.weights(np.array([j]), num_passes, self.rate))
        numbers = {name: float(np.ravel(x)[0]) for name, x in weights.items()}
        return SimpleNamespace(h=float(self.solver.schedule.length(j)), **numbers)

    def kernels(self, features) -> ExplicitKernels:
        """The kernels for some features of the scene."""
        options = self.parallel, self.arrays.in_lanes, self.repeated
        name = "kernels", features.density, features.shape  # the rest is the scene's
        return self.kept(name, lambda: explicit_kernels(self.arrays.law, features, *options))

    def most_passes(self, work: int) -> int:
        """How many passes a launch may take; work: of a pass, in those of tetrahedra."""
        if self.parallel or len(self.stages) > 1:
            return self.in_parallel
        return max(1, self.work_per_launch // work)

    def _sizes(self) -> dict:
        """Numbers that all launches take."""
        a = self.arrays
        out = dict(num_items=a.num_items, num_vertices=a.num_vertices, num_bodies=len(self.scene.reduced.by_few))
        return out | a.counts

    def _rows(self) -> int:
        """How many rows what is given by steps has."""
        return self.arrays.num_step_rows([self.arrays.values])

    def launches(self, first: int, last: int, num_passes: int, save_every: int, most: int, backwards=False) -> Iterator:
        """Numbers of the launches that passes first .. last - 1 take, for each of which their table is shown.

        most: passes that a launch takes. backwards: from the last passes to the first.
        """
        solver, schedule = self.solver, self.solver.schedule
        num_rows = self.kept("rows", self._rows)
        run = num_passes, num_rows, save_every, self.rate, schedule
        turn, sizes = -1 if backwards else 1, self.kept("sizes", self._sizes)
        sizes = sizes | dict(contact_damping=solver.contact_damping)
        for window, begin, end in self._windows(first, last, save_every)[::turn]:
            self.table.show(window, run, lambda first, last: solver.pass_table(first, last, *run[:4]))
            number = -(-(end - begin) // most)
            chunk = -(-(end - begin) // number)  # launches of one size
            stops = [*range(end, begin, -chunk), begin][::-1] if backwards else [*range(begin, end, chunk), end]
            for start, stop in list(zip(stops, stops[1:]))[::turn]:
                counted = int(schedule.counted(start, save_every)) if save_every else -1
                own = dict(counted=counted, window=window, first=start, count=stop - start, times=chunk)
                own["shown"] = int(schedule.shown(start, save_every)) if self.law_frames else -1
                yield sizes | own

    def _windows(self, first: int, last: int, save_every: int) -> list[tuple[int, int, int]]:
        """(window, first pass, last pass) of what launches lie in: where frames note what the law remembers, each pass that
        shows one begins a launch."""
        edges = [first, last]
        if self.law_frames and save_every:
            later = np.arange(first + 1, last)
            edges[1:1] = later[self.solver.schedule.shown(later, save_every) >= 0].tolist()
        return [part for stretch in zip(edges, edges[1:]) for part in self.table.windows(*stretch)]

    def advance(self, first: int, last: int, num_passes: int, save_every: int = 0, base: int | None = None) -> None:
        """Passes first .. last - 1 from the current state; or recorded: slot j - base holds the state before pass j."""
        recording = base is not None
        history, most = self.record if recording else self.state, self.most_passes(self.arrays.num_tetrahedra)
        at = Passes(self, self, history, base or 0, int(recording), num_passes, save_every)
        launches = self.launches(first, last, num_passes, save_every, most)
        if self.law_frames:
            launches = self.law_frames.noted_before(launches, history.z, at.base, at.stride)
        at.go("do", self.stages, launches)
