"""What is given in the passes of an implicit run: prescribed places, dead loads, when host forces act, volumes."""

from functools import cached_property

import numpy as np

from diffsim_ti.differentiation.arrays import add_transposed
from diffsim_ti.inputs import ConsistentMass, Derived, Mass
from diffsim_ti.mechanics.chambers.multipliers import HeldPressure, Multipliers
from diffsim_ti.mechanics.constraints import ConstraintForce
from diffsim_ti.mechanics.host_force import Instant
from diffsim_ti.mechanics.loads.interaction import DeadLoads
from diffsim_ti.mechanics.workspace import Workspace
from diffsim_ti.state.stage import Stage
from diffsim_ti.terms import Chamber


class PrescribedInPasses(Workspace):
    """The part of ImplicitWorkspace that knows what passes are told, but for obstacles."""

    applied_share = 1.0  # share of the load of a static pass that is applied (load_stepping.py)

    # ---- supports ----------------------------------------------------------------------------------------------------

    def with_frozen(self, x: np.ndarray, held: np.ndarray) -> np.ndarray:
        """x with what is held of each held vertex replaced; held: shape (num_held, 3)."""
        a, out = self.arrays, np.array(x)
        if not a.features().partly_fixed:
            out[a.held] = held
            return out
        out[a.held] += np.einsum("kij,kj->ki", a.supports.held, held - out[a.held])
        return out

    def of_held(self, x: np.ndarray) -> np.ndarray:
        """What is held of vectors of the fixed vertices, shape (num_held, 3)."""
        a = self.arrays
        return np.einsum("kij,kj->ki", a.supports.held, x) if a.features().partly_fixed else x

    def prescribed(self, j: int, of: Derived) -> tuple:
        """(displacement [m], velocity [m/s]) of the fixed vertices after pass j; None where they are held.

        of: the values of the run, or their tangent: what is prescribed is linear in them.
        """
        motion = self.arrays.rows["motion"] if of is self.arrays.values else of.motion
        if motion is None:
            return None, None
        schedule, anchor = self.solver.schedule, of.displacement[self.arrays.held]
        return anchor + schedule.place(motion, j, schedule.end(j)), schedule.rate(motion, j)

    # ---- loads -------------------------------------------------------------------------------------------------------

    def apply_loads(self, j: int, stage: Stage, share: float = 1.0) -> None:
        """Set host forces and growth of pass j; of statics a share of what it lays on."""
        self.applied_share = share if stage.static else 1.0
        if self.joints and stage.static:
            self.joints.load(j, stage)
        if self.hosts:
            self.hosts.take(self._host_values(), self.instant(j, stage))
        self.grow(j, stage)

    def _host_values(self) -> Derived:
        """What host forces take their numbers from."""
        return self.arrays.now

    def reached(self, j: int, stage: Stage, share: float) -> float:
        """Share of its step to which a share of pass j leads."""
        schedule = self.solver.schedule
        return float(schedule.begin(j) + share * (schedule.end(j) - schedule.begin(j)))

    def instant(self, j: int, stage: Stage) -> Instant:
        """When host forces act in pass j."""
        gamma = np.inf if stage.static else stage.gamma
        shares = self.share_at_stage(j, stage), self.load_share(j, stage), self.applied_share
        return Instant(self.solver.schedule, j, *shares, self.origin, gamma)

    def growth_of(self, rows: np.ndarray, j: int, stage: Stage) -> np.ndarray:
        """What tetrahedra have grown by in pass j, of rows (steps, 2, m); linear in these."""
        return self.load_share(j, stage) * self.solver.schedule.growth(rows, j, self.share_at_stage(j, stage))

    def grow(self, j: int, stage: Stage) -> None:
        """Set what tetrahedra have grown by in pass j."""
        if self.arrays.values.growths is not None:
            self.arrays.hold_growth(self.growth_of(self.arrays.rows["growths"], j, stage))

    @property
    def constrained_chambers(self) -> list[int]:
        """Places of those that hold a volume among the scene's."""
        return self.volumes.places if self.volumes else []

    def volume_constraints(self, eps: float) -> Multipliers | None:
        """The scene's chambers that hold a volume, and relations without a stiffness."""
        forces = [force for force in self.hosts if isinstance(force, HeldPressure | ConstraintForce) and force.laws]
        given = self.linear, self.arrays.values.rest, self.solver.tolerance, eps
        return Multipliers(forces, *given) if forces else None

    def start_multipliers(self, j: int, u: np.ndarray) -> None:
        """Begin pass j with the pressures of constrained volumes that the pass before it ended with."""
        if self.volumes:
            now = self.pass_of_all(j)
            if j == 0:  # steps that come one by one are not to fill the memory
                self.multipliers = {k: kept for k, kept in self.multipliers.items() if k >= now - 1}
            before = self.multipliers.get(now - 1)
            self.volumes.place(u, np.zeros(len(self.volumes.laws)) if before is None else before)

    def keep_multipliers(self, j: int) -> None:
        """Note those that pass j ended with."""
        if self.volumes:
            self.multipliers[self.pass_of_all(j)] = self.volumes.multipliers

    def take_multipliers(self, j: int, u: np.ndarray) -> None:
        """Stand where pass j ended, at u."""
        if self.volumes:
            self.volumes.place(u, self.multipliers[self.pass_of_all(j)])

    def chamber_pressures(self, num_frames: int, save_every: int) -> np.ndarray:
        out = np.zeros((num_frames, len(self.scene.terms_of(Chamber))))
        for frame in range(1, num_frames):
            last = self.solver.num_passes(frame * save_every) - 1
            reached = self.multipliers.get(self.pass_of_all(last))  # None where it did not come to it
            out[frame, self.constrained_chambers] = self._of_chambers(reached)
        return out

    def last_chamber_pressures(self) -> np.ndarray:
        """Those of chambers whose volume is constrained after the last pass, shape (chambers,); zero before the first."""
        out = np.zeros(len(self.scene.terms_of(Chamber)))
        if self.multipliers:
            out[self.constrained_chambers] = self._of_chambers(self.multipliers[max(self.multipliers)])
        return out

    def _of_chambers(self, multipliers: np.ndarray | None) -> np.ndarray | float:
        return 0.0 if multipliers is None else multipliers[: len(self.constrained_chambers)]

    @property
    def last_multipliers(self) -> np.ndarray | None:
        """Those that the last pass ended with; None before the first, and without such chambers."""
        return self.multipliers[max(self.multipliers)] if self.multipliers else None

    def go_on_from(self, multipliers: np.ndarray, step: int) -> None:
        """Begin a step with these."""
        self.first_step = step
        self.multipliers = {self.pass_of_all(0) - 1: multipliers}

    def pass_of_all(self, j: int) -> int:
        """Number of pass j, also of the steps of a run that come one by one."""
        return self.first_step * int(np.max(self.solver.schedule.substeps)) + j if self.first_step else j

    def loads(self, j: int, stage: Stage) -> np.ndarray:
        """Dead loads on each vertex [N]: weight and external forces; statics lay them on in substeps."""
        values = self.arrays.values
        out = np.zeros_like(values.displacement) + self.mass * self.arrays.gravity_of(values)
        out = self._add_forces(self.arrays.rows["forces"], out, j, stage)
        return out * self.load_share(j, stage)

    def led_by_loads(self, j: int, stage: Stage, inertial: np.ndarray, mass: Mass) -> tuple:
        """(where inertia leads, loads that are left): dead loads act like a shift of where it leads, so that free flight is
        exact; of consistent masses weight does, for which M need not be inverted."""
        if not isinstance(mass, ConsistentMass):
            loads = self.loads(j, stage)
            shift = np.divide(loads, mass, out=np.zeros_like(loads), where=mass > 0)
            return inertial + shift, np.zeros_like(loads)
        inertial = inertial + self.arrays.gravity_of(self.arrays.values) / stage.inertia
        return inertial, self.applied_forces(self.arrays.rows["forces"], j, stage)

    def _add_forces(self, rows: np.ndarray | None, out: np.ndarray, j: int, stage: Stage) -> np.ndarray:
        if rows is not None:
            share, keyed = self.share_at_stage(j, stage), self.dead_loads.keyed
            out[self.dead_loads.acts_at] += self.solver.schedule.load(rows, j, share, keyed)
        return out

    def add_loads(self, rows_adj: np.ndarray, j: int, stage: Stage, by_vertices: np.ndarray) -> None:
        """Adjoint of `_add_forces`."""
        share, keyed = self.share_at_stage(j, stage), self.dead_loads.keyed
        read = lambda rows: self.solver.schedule.load(rows, j, share, keyed)  # noqa: E731
        add_transposed(rows_adj, read, by_vertices[self.dead_loads.acts_at])

    def applied_forces(self, rows: np.ndarray | None, j: int, stage: Stage) -> np.ndarray:
        """Given forces on each vertex in pass j [N], from rows of them or of their tangent, without weight."""
        out = np.zeros_like(self.arrays.values.displacement)
        return self._add_forces(rows, out, j, stage) * self.load_share(j, stage)

    def load_share(self, j: int, stage: Stage) -> float:
        """Share of the loads in pass j."""
        if not stage.static:
            return 1.0
        return min(1.0, (self.pass_of_all(j) + self.applied_share) / self.solver.substeps)

    @cached_property
    def dead_loads(self) -> DeadLoads | None:
        return self.scene.interaction(DeadLoads)
