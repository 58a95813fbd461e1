"""A run of an implicit solver: its passes, what they are told of obstacles, motion and loads."""

import time

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.blas_threads import one_blas_thread
from diffsim_ti.common.errors import NotConverged
from diffsim_ti.inputs import ConsistentMass, Mass, kinetic_energy
from diffsim_ti.mechanics.energy.potential import Potential
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.mechanics.joints.joints import Joints
from diffsim_ti.mechanics.obstacles.approach import Approach
from diffsim_ti.mechanics.obstacles.contact_record import ContactRecord, Shares
from diffsim_ti.mechanics.obstacles.obstacle_collisions import ObstacleCollisions
from diffsim_ti.mechanics.obstacles.obstacle_shares import ObstacleShares
from diffsim_ti.mechanics.reduced.rigid_sets import RigidSets
from diffsim_ti.mechanics.robots import Robots
from diffsim_ti.mechanics.stress.frozen_strains import FrozenStrains
from diffsim_ti.mechanics.stress.law_state import LawStateKernels
from diffsim_ti.mechanics.supports.free import FreeBodies, FreeDirections, held_as, linear_of, mask_of, projectors_of
from diffsim_ti.mechanics.surfaces.implicit_pairs import ImplicitPairs
from diffsim_ti.mechanics.surfaces.pair_shares import PairShares
from diffsim_ti.mechanics.surfaces.surface_pairs import Overlap
from diffsim_ti.monitor.energy_balance import EnergyWatch
from diffsim_ti.runtime import kernels_of
from diffsim_ti.runtime.slots import copy_slot
from diffsim_ti.solvers.implicit.closing import Closing
from diffsim_ti.solvers.implicit.load_stepping import LoadStepping
from diffsim_ti.solvers.implicit.multigrid import Following
from diffsim_ti.solvers.implicit.newton import Newton
from diffsim_ti.solvers.implicit.noted import Noted
from diffsim_ti.solvers.implicit.overlap import pressed_apart
from diffsim_ti.solvers.implicit.preconditioned import Preconditioners
from diffsim_ti.solvers.implicit.prescribed import PrescribedInPasses
from diffsim_ti.state.history import History
from diffsim_ti.state.stage import Stage
from diffsim_ti.terms import Growth


class TwoStepHistory(History):
    """States with the one before each, for two-step solvers; fresh[k]: slot k has none. In a record it is in the slot
    before, but for the first."""

    def __init__(self, arrays, num_slots: int, record: bool):
        super().__init__(arrays, num_slots, record=False)
        self.is_record, self.fresh = record, [True] * num_slots
        self.before = History(arrays, 1 if record else num_slots, record=False, remembers=False)

    def before_slot(self, slot: int) -> tuple[History, int]:
        """Where the state before that of a slot is: (history, slot)."""
        return (self, slot - 1) if self.is_record and slot > 0 else (self.before, slot)

    def copy(self, slot, target, to):
        super().copy(slot, target, to)
        target.fresh[to] = self.fresh[slot]
        if not (target.is_record and to > 0):
            source, s = self.before_slot(slot)
            copy_slot(source.u, s, target.before.u, to)
            copy_slot(source.v, s, target.before.v, to)


GIVEN = {"displacement", "velocity", "forces", "motion", "path", "growths"}  # other numbers leave a body what it is


class ImplicitWorkspace(PrescribedInPasses):
    """A run of an implicit solver. Vectors of vertices are worked on in float64 on the host, tetrahedra on the device."""

    pairs_kind, potential_kind, newton_kind = ImplicitPairs, Potential, Newton
    collisions_kind, preconditioners_kind, shares_kind = ObstacleCollisions, Preconditioners, ObstacleShares
    enough = 20  # rounds with which a solution that was not found is found by load stepping

    def __init__(self, solver, derived, bend=0.0):
        self.newton, self._length, self.hosts = None, solver.substep, host_forces(solver.scene)
        watched = solver.may_gain_energy and not (solver.scene.term(Growth) or solver.scene.interaction(Robots))
        self.energy_watch = EnergyWatch(self) if watched else None
        super().__init__(solver, derived, bend)

    def history(self, num_slots, record=False):
        kind = TwoStepHistory if self.solver.multistep else History
        return kind(self.arrays, num_slots, record and self.solver.multistep)

    def load(self, derived) -> None:
        self.overlaps = {}  # where equilibria are looked for from, as bytes: what was found there
        newton, self.newton = self.newton, None  # until all is there: of a load that is interrupted nothing is kept
        if newton and self._has_bodies_of(derived) and not self.arrays.load(derived):  # a control loop
            self.newton = newton
            self.restart()
        else:
            self.load_bodies(derived)
        self.approach, self.closing = Approach(self), Closing(self)
        self.check_apart()

    def _has_bodies_of(self, values) -> bool:
        """Whether only states and what is given by steps are other than those that are loaded."""
        if self.pairs or self.joints or self.volumes or self.scene.reduced:
            return False
        known = self.arrays.values.parts()
        return all(name in GIVEN or np.array_equal(x, known[name]) for name, x in values.parts().items())

    def load_bodies(self, derived) -> None:
        """All of `load`."""
        self._launches.clear()
        super().load(derived)
        self.potential = self.potential_kind(self.arrays, self.scene.mesh.tetrahedra, self.parallel, self.pairs)
        self.joints = self.potential.joints = Joints(self) if self.scene.interaction(Robots) else None
        self.start_joints()
        self.place_obstacles(0)
        self.strains = FrozenStrains(self) if self.potential.held is not None else None
        a = self.arrays
        self._mass, self._inertia = self.mass_of(derived), (None, None)
        self.free = (runtime.fetch(a.inverse_mass)[:, None] > 0).astype(np.float64)
        if self.joints:
            self.free[self.joints.at] = 0.0
        self.rigid = self.potential.rigid = RigidSets(self.scene.reduced, derived.rest)
        if self.scene.reduced:
            self.free = FreeBodies(
                self.free, a.supports.partly_fixed, a.supports.sliding_supports, self.scene.reduced, self.rigid
            )
        elif a.features().partly_fixed:
            self.free = FreeDirections(self.free, a.supports.partly_fixed, a.supports.sliding_supports)
        self.linear = linear_of(self.free)
        eps = np.finfo(runtime.NUMPY[self.scene.precision]).eps
        tolerance, rounds = self.solver.tolerance, self.solver.max_iterations
        self.hosts.restrict(projectors_of(self.free), derived.rest)
        self.potential.hosts, others = self.hosts.with_energy, self.hosts.without_energy
        if self.joints:
            self.joints.check_forces(others)
        self.volumes = self.volume_constraints(eps)
        self.multipliers = {}  # the pressures [Pa] that each pass ended with
        self.preconditioner, self.noted = self.preconditioners_kind(self), Noted(self)
        self.collisions = self.collisions_kind(self)
        finders, more = (self.collisions.past, self.preconditioner), (others, self.volumes)
        newton = self.newton_kind(self.potential, self.free, *finders, tolerance, rounds, eps, *more)
        newton.detection, self.newton = self.collisions.detection, newton

    @property
    def mass(self) -> Mass:
        return self._mass

    def inertia_of(self, stage: Stage) -> Mass:
        """c m of a stage, the same array for as long as c is the same."""
        if self._inertia[0] != stage.inertia:
            self._inertia = stage.inertia, stage.inertia * self.mass
        return self._inertia[1]

    def mass_of(self, values) -> Mass:
        """Consistent of ten-node tetrahedra, lumped of linear ones."""
        if values.element_masses is None:
            return super().mass_of(values)
        return ConsistentMass.of(self.scene.mesh, values.element_masses)

    @property
    def is_static(self) -> bool:
        """Whether passes look for equilibria."""
        return self.solver.stage(self.rate, True, 0).static

    def balance(self) -> EnergyWatch | None:
        if self.scene.term(Growth) or self.scene.law.state_names or self.is_static or self.joints:
            return None
        self.energy_watch = self.energy_watch or EnergyWatch(self)
        return self.energy_watch

    def restart(self) -> None:
        super().restart()
        self.multipliers = {}
        self._restart()
        if self.energy_watch:
            self.energy_watch.clear()

    def forget(self) -> None:
        """The state was set from outside: there is none before it."""
        super().forget()
        self._restart()
        self.check_apart()

    def _restart(self) -> None:
        self.state.beside[0] = None
        if self.solver.multistep:
            self.state.fresh[0] = True

    # ---- a pass -----------------------------------------------------------------------------------------------------

    @one_blas_thread
    def advance(self, first: int, last: int, num_passes: int, save_every: int = 0, base: int | None = None) -> None:
        """Passes first .. last - 1 from the current state; or recorded: slot j - base holds the state before pass j."""
        if base is not None:
            self.restore(self.record, first - base)
        if self.solver.substep != self._length:
            self._length = self.solver.substep
            self._restart()
        for j in range(first, last):
            frame = int(self.solver.schedule.shown(j, save_every))
            if frame >= 0:
                self.save_frame(frame)
            u, v, before = self.read(self.state, 0)
            self.potential.hold(self.state, 0)
            self.preconditioner.following = self.state.beside[0] or Following()
            begin, self.newton.reports = time.perf_counter(), []
            try:
                if self.joints:
                    self.joints.now = self.state.joints[0]
                u_next, v_next = self._pass(j, u, v, before)
                if self.bending:
                    self.bending.check(j + 1, u_next)
                self.note_contacts(j, save_every)
                self.noted.note(j, num_passes, time.perf_counter() - begin, self.begun)
            except FloatingPointError as error:
                raise self.dated(error, j, num_passes) from None
            if self.solver.multistep:
                copy_slot(self.state.u, 0, self.state.before.u, 0)
                copy_slot(self.state.v, 0, self.state.before.v, 0)
                self.state.fresh[0] = False
            runtime.fill(self.state.u, u_next[None])
            runtime.fill(self.state.v, v_next[None])
            if self.joints:
                self.state.joints[0] = self.joints.now
            if self.state.z is not None:
                self.launch_law_state("forward", self.arrays.features(), j, 0, 0, at=self.state)
            self.state.beside[0] = self.preconditioner.following
            if base is not None:
                self.state.copy(0, self.record, j + 1 - base)

    def launch_law_state(self, name: str, features, j: int, slot: int, end: int, **records) -> None:
        """Launch one of the LawStateKernels for pass j, from z in `slot` and u in slot `end`."""
        a = self.arrays
        kernels = kernels_of(LawStateKernels, a.law, features.of_elements(), self.parallel, a.in_lanes)
        sizes = dict(num_items=a.num_items, num_vertices=a.num_vertices, slot=slot, end=end)
        self.bound(getattr(kernels, name), **records)(**sizes, h=float(self.solver.schedule.length(j)))

    def read(self, history, slot: int) -> tuple:
        """(u, v, (u-, v-) or None) of a slot, in float64."""
        get, before = runtime.fetch_row, None
        if self.solver.multistep and not history.fresh[slot]:
            source, s = history.before_slot(slot)
            before = get(source.u, s), get(source.v, s)
        return get(history.u, slot), get(history.v, slot), before

    def inertial(self, stage: Stage, u, v, before) -> tuple:
        """(x, y): where inertia starts from."""
        if before is None:
            return stage.a0 * u, stage.b0 * v
        return stage.a0 * u + stage.a1 * before[0], stage.b0 * v + stage.b1 * before[1]

    def _pass(self, j, u, v, before):
        stage = self.solver.stage(self.rate, before is None, j)
        x, y = self.inertial(stage, u, v, before)
        place, speed = self.prescribed(j, self.arrays.values)
        problem = self.problem(j, stage, x, y)
        if self.joints:
            self.joints.take(problem)
        self.rigid.begin(u, stage.c0)
        starts = [] if stage.static else [problem[1], x + stage.gamma * y]
        held = (
            u if place is None else self.with_frozen(u, u[self.arrays.held] + (place - u[self.arrays.held]) / stage.c0)
        )
        self.begun = u, held, problem
        if self.strains:  # before matrices are made
            self.strains.hold(stage, u, before)
        self.begin(j, stage, u, x, None if stage.static else self.linear * (problem[1] - u))
        self.start_multipliers(j, u)
        start = u
        if overlap := self.overlaps and self.overlaps.get(u.tobytes()):
            start = pressed_apart(self, u, overlap)
            held = held + (start - u)
        elif stage.static and (held != u).any():
            starts = self._led(u, held, problem)
        try:
            u_star = self.solve_pass(j, start, held, starts, problem, stage)
        except NotConverged as error:
            raise self.collisions.explained(error, u) from None
        self.u_star = u_star
        if self.joints:
            u_star = self.u_star = self.potential.place(u_star)
            self.joints.end()
        self.keep_multipliers(j)
        v_star = (u_star - x) / stage.gamma
        u_next = stage.c0 * u_star + (1 - stage.c0) * u
        v_next = stage.e0 * v_star + stage.e1 * y
        held = self.arrays.held
        place, speed = (u[held], v[held]) if place is None else (place, speed)
        u_next, v_next = self.with_frozen(u_next, place), self.with_frozen(v_next, speed)
        # without what rounding adds
        u_next, v_next = self.rigid.end(self.scene.reduced.of(u_next)), self.scene.reduced.of(v_next)
        if stage.c0 != 1:
            self.collisions.check_end(j, u_star, u_next)
        if self.energy_watch:
            places = self.collisions.before, self.collisions.at_stage, self.collisions.at_end(j)
            keeps = self.solver.may_gain_energy and not self.solver.multistep  # the midpoint rule, kinetic energy
            undamped = self.inertial(self.solver.stage(0.0, before is None, j), u, v, before)[1]
            added = 0.0 if keeps else self._kinetic_added(u, v, u_next, v_star, undamped, stage)
            self.energy_watch.note(u, u_star, u_next, v_next, places, added)
        return u_next, np.zeros_like(v) if stage.static else v_next

    def _led(self, u, held, problem: tuple) -> list:
        """Where the equilibrium at u leads, linearised there, for motions of fixed vertices; nowhere if it is not stable."""
        self.potential.place(u)
        R = self.newton.residual_of(problem)
        self.newton.preconditioner, self.newton.stiffness = self.preconditioner(problem[0])
        way = self.newton.follows(u, R, held - u, self.newton.inexact)
        return [] if way is None else [u + way]

    def problem(self, j: int, stage: Stage, x: np.ndarray, y: np.ndarray) -> tuple:
        """Mass, inertial and loads of `Newton.solve` in pass j, inertia starting from (x, y)."""
        mass, inertial = self.inertia_of(stage), x + stage.gamma * y
        if stage.static:
            return mass, inertial, self.loads(j, stage)
        return mass, *self.led_by_loads(j, stage, inertial, mass)

    def _kinetic_added(self, u, v, u_next, v_star, y, stage: Stage) -> float:
        """Kinetic energy [J] that a pass has added beyond the work of what accelerates the free vertices, of which drag is a
        part, for y is what inertia would lead to without; what keeps a shape does none."""
        way = self.rigid.resultants(u_next - u)
        after, before, way, rate = (x * mask_of(self.free) for x in (v_star, v, way, (v_star - y) / stage.gamma))
        added = kinetic_energy(self.mass, after) - kinetic_energy(self.mass, before)
        return added - float((rate * (self.mass * way)).sum())

    def solve_pass(self, j, u, held, starts: list, problem: tuple, stage: Stage) -> np.ndarray:
        """The minimum of the pass that descends from `held`, where the body was, with fixed vertices where they get.

        starts: where inertia leads, and where velocities do; problem: mass, inertial, loads of `Newton.solve`.
        """
        if self.joints and stage.static:
            self.potential.place(u)
            self.joints.check_stable(self.newton.balance(u, *problem)[0])
        starts = [held_as(self.free, held, self.rigid.nearest(u + self.linear * (start - u))) for start in starts]
        near = self.approach(u, held, starts, problem)
        near = self.closing.approached(near, problem) if self.solver.loose else near
        parts = self.newton.max_iterations >= self.enough
        try:
            there = self.newton.solve(self.admissible(near, starts, problem), *problem, leave_saddles=stage.static)
            if parts:
                self.check_upright(u, there)
            return there
        except NotConverged as error:
            if not parts or self.newton.report.cuts and not stage.static:
                raise
            if self.joints and stage.static:  # which nothing has come to hold
                self.potential.place(u)
                self.joints.check_stable(0 * u)
            return LoadStepping(self)(j, stage, u, held, problem, error)

    def check_upright(self, u, there) -> None:
        """Raise NotConverged where the last solve has turned a tetrahedron inside out that was far from that at u."""
        if not self.newton.upright and np.any((self.volume_ratios(u) > 0.1) & ~(self.volume_ratios(there) > 0)):
            raise NotConverged(
                "tetrahedra turn inside out: take smaller steps or a smaller load", self.newton.report.residuals
            )

    def admissible(self, u: np.ndarray, starts: list, problem: tuple) -> np.ndarray:
        """Where Newton's method begins: u or, if Phi is lower there, one of `starts`, or less far where something would turn
        inside out or meet an obstacle. The solution of a pass is the minimum that descends from u: where inertia or loads
        would lead what is stiff or light there are others."""
        best, least, apart = u, 0.0, self.pairs or self.joints
        rise_of = self.newton.rises_from(u, problem) if starts else None
        # surfaces are looked at together where they have not passed through each other
        rises = rise_of(starts)[:, 0] if starts and not apart else [-np.inf] * len(starts)
        for start, rise in zip(starts, rises):
            if not rise < least:
                continue
            longest = min(self.collisions.past(u, start - u)[0], self.pairs_share(u, start - u))
            at = self.rigid.nearest(u + longest * (start - u))
            rise = rise_of([at])[0, 0] if apart or longest < 1 else rise
            if rise < least and not (self.rigid and not self.newton.is_free(u, at - u)):  # it turns on another way
                best, least = at, rise
        return best

    def volume_ratios(self, u: np.ndarray) -> np.ndarray:
        """J of each tetrahedron at a displacement."""
        self.potential.place(u)
        return self.potential.energy()[1]

    # ---- what obstacles do -------------------------------------------------------------------------------------------

    def check_surfaces(self) -> None:
        """As of all solvers; equilibria are looked for where surfaces have been pressed apart."""
        try:
            super().check_surfaces()
        except Overlap as error:
            if not self.is_static or self.scene.reduced or self.scene.interaction(Robots):
                raise
            self.overlaps[runtime.fetch_row(self.state.u, 0).tobytes()] = error

    def check_apart(self) -> None:
        """Raise Overlap if a vertex is in an obstacle."""
        self.collisions.check_apart()

    def record_contacts(self, wanted: frozenset) -> None:
        self.forget_contacts()

    def forget_contacts(self) -> None:
        self.impulses = ContactRecord(self)

    def contact_forces(self, frame_time: np.ndarray) -> np.ndarray:
        return self.impulses.forces

    def note_contacts(self, j: int, save_every: int) -> None:
        """What obstacles, and surfaces to each other, did in pass j, where it is asked for."""
        if self.impulses and save_every:
            self.potential.place(self.u_star)
            shares = self.kept("shares", lambda: Shares(self)) if len(self.arrays.obstacles) else None
            made = [x.forces for x in (shares, self.pair_shares) if x]
            self.impulses.add(j, save_every, self.is_static, *made)

    @property
    def pair_shares(self) -> PairShares | None:
        """What contact by pairs does; None where there is none."""
        return self.kept("pair shares", lambda: PairShares(self.potential)) if self.pairs else None

    # ---- what stands in the way --------------------------------------------------------------------------------------

    def check_pairs(self, u, step) -> None:
        """Prescribed vertices have to get where they are held."""
        if self.pairs and not self.pairs.is_collision_free(u, step):
            raise NotConverged("prescribed motion drives surfaces through each other: take smaller steps", [])

    def pairs_share(self, u, step) -> float:
        """How far along a step no surfaces meet."""
        return self.pairs.safe_share(u, step) if self.pairs else 1.0

    # ---- what a pass is told -----------------------------------------------------------------------------------------

    def begin(self, j: int, stage: Stage, u: np.ndarray, x: np.ndarray, ahead: np.ndarray | None = None) -> None:
        """Tell the potential where obstacles are in pass j, where friction is measured from, which step is expected."""
        self.collisions.begin(j, stage)
        presses = not self.overlaps or u.tobytes() not in self.overlaps
        self.potential.begin(u, x, 1 / stage.gamma, self.collisions.rows, ahead, presses)
        self.origin = x
        self.apply_loads(j, stage)
        if self.volumes:  # after all that the stiffness at rest is made of
            self.volumes.stiffen(self.preconditioner(self.inertia_of(stage))[1])

    def share_at_stage(self, j: int, stage: Stage) -> float:
        """Share of the step at which pass j takes its forces."""
        schedule = self.solver.schedule
        return schedule.begin(j) + (schedule.end(j) - schedule.begin(j)) * self.applied_share / stage.c0
