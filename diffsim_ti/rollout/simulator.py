"""Simulator: the step-by-step interface of a solver."""

import weakref
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti import runtime
from diffsim_ti.common.answers import answered
from diffsim_ti.common.checked import between, instance, numbers, whole
from diffsim_ti.common.origin import positions_of
from diffsim_ti.common.public import Public
from diffsim_ti.common.warn import warn
from diffsim_ti.inputs.step_values import StepValues
from diffsim_ti.materials import Material
from diffsim_ti.mechanics.surfaces.surface_pairs import Overlap
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.monitor import quantities
from diffsim_ti.monitor.guard import Guard
from diffsim_ti.monitor.quantities import Energy, TetrahedronFields
from diffsim_ti.outputs import Output
from diffsim_ti.outputs.output import Frames
from diffsim_ti.rollout.run import warn_of_large_stretch
from diffsim_ti.solvers import SemiImplicitSolver
from diffsim_ti.solvers.implicit.multigrid import Following
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.solvers.substeps import MOST, needed
from diffsim_ti.state.bending import FacesBend
from diffsim_ti.state.solve_report import SolveReport
from diffsim_ti.state.watch import ContactResolution
from diffsim_ti.terms import ExternalForce


@answered
class Simulator(metaclass=Public):
    """Advances a scene step by step and shows its state.

    `Simulator(solver)`, or, for a solver made without a scene, `Simulator(mesh, material, solver)`. contact_forces: note in
    each step what contact does, for `output(ContactForce(...))`; "surfaces": what surfaces do to each other alone.

    positions, displacements [m] and velocities [m/s] are NumPy copies of shape (num_vertices, 3) in the scene's
    precision (positions far from the origin in float64, origin.py); time [s] and step_count say where it is. A run that
    goes wrong raises Divergence (a FloatingPointError) and leaves the state before the step that failed.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], precision="f64")
    >>> simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=1e-3))
    >>> simulator.step()
    >>> simulator.run(9)
    >>> print(f"{simulator.time:.2f} s, {simulator.velocities[0, 1]:.4f} m/s, {simulator.compute_energy():.1f} J")
    0.01 s, -0.0981 m/s, 4905.0 J
    """

    @overload
    def __init__(self, solver: Solver, *, contact_forces: bool | Literal["surfaces"] = False): ...

    @overload
    def __init__(
        self,
        mesh: TetrahedralMesh,
        material: Material,
        solver: SemiImplicitSolver,
        *,
        contact_forces: bool | Literal["surfaces"] = False,
    ): ...

    def __init__(
        self,
        mesh: TetrahedralMesh | Solver | None = None,
        material: Material | None = None,
        solver: Solver | None = None,
        *,
        contact_forces: bool | Literal["surfaces"] = False,
    ):
        if material is None and solver is None:
            mesh, solver = None, mesh
        if solver is None or (mesh is None) != (material is None):
            raise TypeError("Simulator takes a solver, or a mesh, a material and a solver")
        instance("Simulator", "its last argument", solver, Solver, "a solver such as SemiImplicitSolver(scene)")
        if mesh is not None:
            solver.bind(mesh, material)
        if solver.scene is None:
            raise ValueError(
                "the solver has no scene: use Simulator(mesh, material, solver), or a solver made from a Scene"
            )
        self.solver, self.scene = solver, solver.scene
        self._first_solver = solver  # whose substeps a reset goes back to
        solver.simulator = weakref.ref(self)
        self._start = solver.start_values()
        if contact_forces not in (True, False, "surfaces"):
            raise ValueError(f'contact_forces must be True, False or "surfaces", got {contact_forces!r}')
        self._notes = frozenset({True, "surfaces"} if contact_forces is True else {contact_forces}) - {False}
        self._settled = {}
        self._changes = self.scene.inputs.change_in_time
        if True in self._notes:
            solver.check_contact_forces()
        self._make_workspace()
        self.reset()

    def _make_workspace(self, bend: float = 0.0) -> None:
        self.workspace = self.solver.workspace(self._start, bend)
        if self._notes:
            self.workspace.make_frames(2)
            self.workspace.record_contacts(self._notes)
        self._guard = Guard(self.workspace)
        self._before = self.workspace.history(1)

    def _take_bent(self, bend: float) -> None:
        """Go on from before the step with faces that bend by so much [m]."""
        old, before = self.workspace, self._before
        old.report.substeps -= self.solver.num_passes(1)  # which are done again
        self._make_workspace(bend)
        self.workspace.restore(before, 0)
        self.workspace.report, self.workspace.watch.earlier = old.report, [old.watch.resolution()]
        self._stale = True
        self._load_step()
        self.workspace.place_obstacles(0)
        try:
            if self.workspace.pairs:
                self.workspace.pairs.forget(self.workspace.state.u)
                self.workspace.check_surfaces()
            self.workspace.check_apart()
        except Overlap:
            raise Overlap(
                f"{self.workspace.when(self.step_count)}: {FacesBend(bend / 2)} where they touch, and the smaller triangles "
                "that this asks for are not apart there: reset() the simulator, which keeps them, and run it again"
            ) from None

    def __reduce__(self):
        raise TypeError(
            "a Simulator owns memory of the device and does not pickle: pickle its solver and its state, and there "
            "Simulator(solver), resume(state)"
        )

    def __repr__(self) -> str:
        return f"Simulator({self.solver!r}, {self.scene.mesh!r}, step {self.step_count}, t = {self.time:.6g} s)"

    def reset(self) -> None:
        """Back to the start of the scene, and to the substeps of its solver. Ten-node faces that touch are taken to bend as
        they did."""
        self._take_solver(self._first_solver)
        self.step_count = 0
        self._set: dict[str, np.ndarray] = {}  # inputs that were given since, as a run of the last step has them
        self._stale = True  # whether the device may have rows of other steps than `arrays.rows`
        self._step_values = StepValues(self.scene.inputs, self.solver.dt)
        self._beyond = False  # whether a step stretched the material beyond what is known of it
        self.workspace.load(self._start)
        self.workspace.report.clear()
        self._guard.restart_with_solver()
        if self._notes:
            self.workspace.forget_contacts()

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.step_count * self.solver.dt

    def step(self, **values: ArrayLike) -> None:
        """Advance by solver.dt, with other values of inputs that can change in time, by the scene's names: forces,
        tractions, pressures, tensions, activations, growth, motions and paths (`step_inputs` lists them).

        What a term has as a constant, or for each step, is held during the step: one value in its shape, such as
        `step(activation=0.3)`. What it has by a function or by keyframes, as motions and paths are, goes linearly within the
        step to the value given, from where it was: `step(path=(0.0, 0.1, 0.0))`; or two values, as the step begins and ends.
        Values stay, as they end, in the steps to come, until others are given or the simulator is reset. A run of a
        Rollout with the same rows has the same states, unless ten-node faces that touch bend more on the way than they were
        taken for: a run takes them so from its start on. For gradients of control loops see `diff_simulator.TorchSimulator`.
        Raises ValueError for unknown names and for shapes, before anything moves.
        """
        before = self._set
        self._set = self._step_values.next(self.step_count, values, before)
        self._stale = self._stale or bool(values)
        try:
            while not self._advance():
                pass
        except BaseException:
            self._set, self._stale = before, True
            raise
        self.step_count += 1
        self.workspace.place_obstacles(int(self.solver.schedule.first(1)))
        if np.isfinite(self.scene.material.valid_to) and not self._beyond:
            self._beyond = warn_of_large_stretch(self._frames())

    @property
    def step_inputs(self) -> tuple[str, ...]:
        """Names of the inputs that `step` takes."""
        return self._step_values.names

    def _advance(self) -> bool:
        """Try to take a step; False where it is to be tried again, from where it began."""
        self._load_step()
        self.workspace.first_step = self.step_count
        passes = self.solver.num_passes(1)
        self.workspace.save(self._before, 0)
        if self._notes:
            self.workspace.forget_contacts()
        try:
            with self.workspace.report.of_passes(passes):
                self._guard.advance(0, passes, passes, int(bool(self._notes)))
        except FacesBend as bent:
            self._take_bent(bent.bend)
            return False
        except FloatingPointError as error:
            self.workspace.restore(self._before, 0)
            if self._notes:
                self.workspace.forget_contacts()
            self._take_more_substeps(error)
            return False
        return True

    def _take_solver(self, solver: Solver) -> None:
        self.solver = self.workspace.solver = solver

    def _take_more_substeps(self, error: FloatingPointError) -> None:
        """Go on with more substeps where their number was left to the solver and these help; else raise the error."""
        enough = getattr(error, "enough", None)
        if not self.solver.automatic or enough is None or not enough < self.solver.substep:
            raise error
        count = needed(self.solver.dt, enough, 1.0)
        if count > MOST:
            raise error
        if self.solver is self._first_solver:
            warn(
                f"{self.workspace.when(self.step_count)}: steps are divided into more than {self.solver.substeps} substeps "
                f"from here on, {count} in this one: pass substeps={count} for the same number from the start ({error})"
            )
        self.workspace.report.substeps -= self.solver.num_passes(1)  # which are done again
        self._take_solver(self.solver.with_substeps(count))
        self.workspace.forget()

    def run(self, steps: int) -> None:
        """Advance by so many steps."""
        for _ in range(whole("steps", steps)):
            self.step()

    def set_substeps(self, substeps: int) -> None:
        """Divide the steps to come into so many substeps; a step that is too long then raises Divergence."""
        self.solver.substeps = whole("substeps", substeps, 1)

    def _load_step(self) -> None:
        """Bring what depends on the step to the device: motions, paths, loads."""
        inputs, arrays = self.scene.inputs, self.workspace.arrays
        if not (self._stale or self._changes):
            return
        now = inputs.derive(inputs.at_step(self.step_count, self.solver.dt, self._set))
        made = {name: getattr(now, name) for name in ("motion", "path", "forces", "growths", *arrays.rows_of_steps)}
        if made["forces"] is not None and len(made["forces"]) > 1:  # a single ExternalForce's, as they are given
            rows = made["forces"]
            if self.step_count >= len(rows):
                raise ValueError(f"external_forces are given for {len(rows)} steps, this is step {self.step_count}")
            made["forces"] = rows[self.step_count][None]
        known = arrays.rows
        new = {name: x for name, x in made.items() if x is not None and (self._stale or x is not known[name])}
        arrays.load_rows(**new)
        self._stale = False

    @property
    def displacements(self) -> np.ndarray:
        """Displacement from the rest shape [m]."""
        return runtime.fetch(self.workspace.state.u)[0]

    @property
    def positions(self) -> np.ndarray:
        """Positions [m]."""
        return positions_of(self.scene, self._start.rest, self.displacements)

    @property
    def velocities(self) -> np.ndarray:
        """Velocities [m/s]."""
        return runtime.fetch(self.workspace.state.v)[0]

    @property
    def law_state(self) -> np.ndarray:
        """What the law remembers of each tetrahedron, shape (num_tetrahedra, S), or (num_tetrahedra, 4, S) at the points of
        ten-node tetrahedra, in the order of its `state_names`."""
        arrays, z = self.workspace.arrays, self.workspace.state.z
        return np.zeros(arrays.law_state_shape) if z is None else arrays.law_state_of(runtime.fetch(z)[0])

    @property
    def joint_states(self) -> np.ndarray | None:
        """Positions, velocities and efforts of the joints of all robots, shape (joints, 3); None without robots."""
        joints = self.workspace.state.joints[0]
        return None if joints is None else np.stack(joints[:3], 1)

    @property
    def _has_before(self) -> bool:
        return getattr(self.solver, "multistep", False)

    @property
    def state(self) -> dict[str, np.ndarray]:
        """All that the run needs to go on, for `resume`: displacements [m], velocities [m/s], law_state, step_count, of
        two-step solvers the displacements and velocities before, pressures of constrained volumes in implicit steps and
        what multigrid has learned there, joint_states of robots with positions and velocities before (joints, 5), what
        steps were given over time, substeps where more were taken than at the start, and how far faces of ten nodes that
        touch are taken to bend [m]. `np.savez(file, **simulator.state)` keeps it, to the bit."""
        state = self.workspace.state
        out = dict(displacements=self.displacements, velocities=self.velocities, step_count=np.array(self.step_count))
        if state.z is not None:
            out["law_state"] = self.law_state
        if self.joint_states is not None:
            out["joint_states"] = np.stack(state.joints[0], 1)
        if self._has_before and not state.fresh[0]:
            before = (runtime.fetch(x)[0] for x in (state.before.u, state.before.v))
            out["displacements_before"], out["velocities_before"] = before
        if self.workspace.last_multipliers is not None:
            out["constraint_pressures"] = self.workspace.last_multipliers
        if state.beside[0] is not None and state.beside[0].usual is not None:
            out["preconditioner"] = state.beside[0].numbers()
        if self.solver is not self._first_solver:
            out["substeps"] = np.array(int(self.solver.substeps))
        if self.workspace.arrays.bend:
            out["bend"] = np.array(self.workspace.arrays.bend)
        return out | self._set

    def resume(self, state: dict) -> None:
        """Go on from a `state` of this scene and solver with the same bits, as if the run had not stopped.

        state: the dictionary, or what np.load makes of its file. The scene, the solver and its substeps must be as they
        were. Raises ValueError for parts that are missing, unknown, or of other shapes.
        """
        given, known = {name: np.asarray(state[name]) for name in state}, self.state
        two_step = {"displacements_before", "velocities_before"} if self._has_before else set()
        over_time = set(self._step_values.names)
        held = {"constraint_pressures"} if self.workspace.volumes and not self.solver.explicit else set()
        more_substeps = {"substeps"} if self._first_solver.automatic else set()
        matrices = set() if self.solver.explicit else {"preconditioner"}
        optional = two_step | over_time | held | more_substeps | matrices | {"bend"}
        lacking, more = known.keys() - optional - given.keys(), given.keys() - known.keys() - optional
        if lacking or more or len(given.keys() & two_step) == 1:
            raise ValueError(
                f"resume: this run has the state {', '.join(known)}, got {', '.join(given) or 'nothing'}: "
                "make the simulator of the same scene and solver"
            )
        shape, count = known["displacements"].shape, given["step_count"]
        if count.shape or count != int(count) or count < 0:
            raise ValueError(f"resume: step_count must be a whole number >= 0, got {count!r}")
        joints = {"joint_states"} & known.keys()
        for name in ("displacements", "velocities", *(two_step & given.keys()), *joints):
            value, usual = given[name], known.get(name, known["displacements"])
            if value.shape != usual.shape or value.dtype != usual.dtype or not np.all(np.isfinite(value)):
                raise ValueError(
                    f"resume: {name}: expected finite numbers, {usual.dtype} of shape {usual.shape}, got {value.dtype} of "
                    f"{value.shape}"
                )
        law_state = self.workspace.checked_law_state(given["law_state"]) if "law_state" in given else None
        following = Following.of(given["preconditioner"], shape) if matrices & given.keys() else None
        if (bend := between("resume: bend", given.get("bend", 0.0), 0, np.inf, True)) != self.workspace.arrays.bend:
            self._make_workspace(bend)
        self.reset()
        kept = {name: given[name] for name in over_time & given.keys()}
        self._set = self._step_values.next(int(count), kept, {})
        now = self.workspace.state
        runtime.fill(now.u, given["displacements"][None])
        runtime.fill(now.v, given["velocities"][None])
        if law_state is not None:
            self.workspace.set_law_state(law_state)
        if joints:
            now.joints[0] = tuple(given["joint_states"].T.copy())
        self.step_count = int(count)
        self._place_obstacles()
        self.workspace.forget()
        if two_step & given.keys():
            runtime.fill(now.before.u, given["displacements_before"][None])
            runtime.fill(now.before.v, given["velocities_before"][None])
            now.fresh[0] = False
        now.beside[0] = following
        if more_substeps & given.keys():
            self._take_solver(self.solver.with_substeps(whole("substeps", given["substeps"], 1)))
        if held & given.keys():
            self.workspace.go_on_from(given["constraint_pressures"].copy(), self.step_count)

    def _place_obstacles(self) -> None:
        """Put them where they are at the end of the last step, of rows that are loaded anew in the next."""
        inputs, last = self.scene.inputs, max(self.step_count - 1, 0)
        path = inputs.derive(inputs.at_step(last, self.solver.dt, self._set)).path
        if path is not None:
            self.workspace.arrays.load_rows(path=path)
        self.workspace.place_obstacles(int(self.solver.schedule.first(1)) if self.step_count else 0)

    @property
    def values(self) -> dict[str, np.ndarray]:
        """The values of the scene's inputs, with those that were set since, and of what is given over time, now."""
        ends = {name: x[-1:] if self._step_values.is_ramp(name) else x for name, x in self._set.items()}
        return self.scene.inputs.at_times([self.time]) | ends

    @property
    def values_of_step(self) -> dict[str, np.ndarray]:
        """The values of the scene's inputs in the last step, or in the first before it is taken, as a run of one step has
        them; those that were set since the start included."""
        return self.scene.inputs.at_step(max(self.step_count - 1, 0), self.solver.dt, self._set)

    def output(self, output: Output) -> np.ndarray:
        """Value of an output such as `Reaction("left")` or `Stress()` at the present state, as a Rollout's frame has it.

        ContactForce, SelfContactForce and ContactTraction are the mean over the last step, zero before the first, and need
        `Simulator(solver, contact_forces=True)`; SelfContactForce alone "surfaces".
        Raises ValueError for one without, and as the output does.
        """
        reads = output.reads_contact_forces
        if reads and reads not in self._notes:
            raise ValueError(
                f"{output!r} is of a step: make the simulator with Simulator(solver, contact_forces={reads!r})"
            )
        if output.cumulative:
            raise ValueError(f"{output!r} counts from the start of a run: pass it to Rollout(..., outputs=[...])")
        frames = self._frames()
        frames.law_state = self.law_state[None]
        if output.reads_joint_states:
            frames.joint_states = self.joint_states[None]
        if self._notes:
            frames.contact_forces = self.workspace.contact_forces(self.solver.dt)[1:]
        if output.reads_chamber_pressures and self.scene.holds_volumes:
            frames.chamber_pressures = self.workspace.last_chamber_pressures()[None]
        return self.settled(output).value(frames)[0]

    def _frames(self) -> Frames:
        """The present state."""
        now = (x[None] for x in (self.positions, self.velocities, self.displacements))
        frames = Frames(*now, np.array([self.time]), self.values_of_step, scene=self.scene)
        frames.steps = np.array([self.step_count])
        return frames

    def settled(self, output: Output) -> Output:
        """The output as it is for the scene, made once."""
        if output not in self._settled:
            self._settled[output] = output.settled(self.scene)
        return self._settled[output]

    def set_state(
        self,
        positions: ArrayLike | None = None,
        velocities: ArrayLike | None = None,
        law_state: ArrayLike | None = None,
    ) -> None:
        """Put the body elsewhere: positions [m], velocities [m/s], shape (num_vertices, 3), and what the law remembers, in
        the shape of `law_state`; None leaves a part as it is.

        Fixed vertices keep no velocity; of sets that are `reduced` what they can do is taken. Joints of robots stay where
        they are. `reset` goes back to the start; a run that was saved goes on by `resume`.
        Raises ValueError for other shapes, and for positions of vertices that links hold elsewhere.
        """
        law_state = None if law_state is None else self.workspace.checked_law_state(law_state)
        state, shape = self.workspace.state, (self.scene.mesh.num_vertices, 3)
        displaced, moving = self.scene.inputs.start_links()
        for name, value in (("positions", positions), ("velocities", velocities)):
            if value is not None:
                if name == "positions":
                    self.scene.inputs.warn_if_coarse("initial_positions", value)
                value = numbers(name, value)
                if value.shape != shape or not np.all(np.isfinite(value)):
                    raise ValueError(f"{name}: expected finite numbers of shape {shape}, got shape {value.shape}")
                if name == "positions":
                    self._check_held(value)
                    runtime.fill(state.u, displaced.value(value, self._start.rest)[0][None])
                else:
                    given = dict(initial_velocities=value, rest=self._start.rest)
                    given["displacement"] = runtime.fetch_row(state.u, 0)
                    runtime.fill(state.v, moving.value(*(given[part] for part in moving.reads))[0][None])
        if law_state is not None:
            self.workspace.set_law_state(law_state)
        self.workspace.forget()

    def _check_held(self, positions: np.ndarray) -> None:
        joints = self.workspace.joints
        if joints and len(joints.at):
            off = np.abs(positions[joints.at] - joints.carried(self.workspace.state.joints[0][0])).max()
            if off > 1e-5 * np.ptp(self.scene.mesh.vertices, 0).max():
                raise ValueError(
                    f"positions: links of a robot hold some vertices {off:.3g} m elsewhere: leave those of attached= where "
                    "they are"
                )

    def set_forces(self, forces: ArrayLike) -> None:
        """Other external forces [N] from now on, in the shape of the scene's constant ExternalForce, until a reset."""
        term, forces = self.scene.term(ExternalForce), numbers("forces", forces)
        given = None if term is None else term.values.get("external_forces")
        if given is None or given.ndim == 3:
            remedy = "add one of zeros"
            raise ValueError(f"set_forces needs a scene with a constant ExternalForce, of shape (k, 3); {remedy}")
        if forces.shape != given.shape or not np.all(np.isfinite(forces)):
            raise ValueError(f"forces: expected finite numbers of shape {given.shape}, got shape {forces.shape}")
        self._set = self._set | {self.scene.input_names(term)["external_forces"]: forces}
        self._stale = True

    @property
    def contact_resolution(self) -> ContactResolution:
        """Smallest gap [m] since the start and how finely the substeps resolve contacts; obstacles only."""
        return self.workspace.watch.resolution()

    @property
    def report(self) -> SolveReport:
        """What the solves took since the start: iterations, residuals, cuts, saddles, time (state.solve_report.py)."""
        return self.workspace.report

    def compute_energy(self) -> Energy:
        """Total energy [J], a float with `.parts`: kinetic, elastic, gravity, contact."""
        return quantities.energy(self.workspace)

    def smallest_gap(self) -> float:
        """Smallest distance [m] of surface primitives that share no vertex, and to points and edges of obstacles that act by
        pairs; infinite beyond the reach of SelfContact and of these."""
        if self.workspace.pairs is None:
            raise ValueError(
                "this scene has no SelfContact: add it to the scene's terms to measure gaps between surfaces"
            )
        return self.workspace.pairs.look(self.workspace.state.u)[1]

    def check_surfaces(self) -> None:
        """Raise ValueError, naming primitives, if surfaces touch or pass through each other (scenes with SelfContact)."""
        self.smallest_gap()
        self.workspace.pairs.check_apart(self.workspace.state.u)

    def tetrahedron_fields(self) -> TetrahedronFields:
        """Energy density [J/m^3], von Mises stress [Pa] and volume ratio J of each tetrahedron."""
        return quantities.tetrahedron_fields(self.workspace)

    def describe(self) -> str:
        """What is simulated, how, and what was built for it."""
        a = self.workspace.arrays
        built = [type(t).__name__ for t in self.scene.terms] + ["prescribed motion"] * (a.values.motion is not None)
        moduli = "one set of moduli" if a.features().uniform else "moduli per tetrahedron"
        what = f"{type(a.law).__name__} ({self.scene.precision}, {runtime.arch_name()}), {moduli}"
        return (
            f"{self.scene.describe()}\n{self.solver.describe()}\nbuilt: {what}, terms {', '.join(built) or 'none'}; "
            f"{runtime.allocated_megabytes():.1f} MB on the device"
        )
