"""Simulator: the step-by-step interface of a solver."""

import weakref

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti import runtime
from diffsim_ti.common.checked import instance, numbers, whole
from diffsim_ti.common.origin import positions_of
from diffsim_ti.inputs.poses import PoseColumns
from diffsim_ti.monitor import quantities
from diffsim_ti.monitor.guard import Guard
from diffsim_ti.monitor.quantities import Energy, TetrahedronFields
from diffsim_ti.outputs import Output
from diffsim_ti.rollout.frames import Frames
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.state.bending import FacesBend
from diffsim_ti.state.solve_report import SolveReport
from diffsim_ti.state.watch import ContactResolution
from diffsim_ti.terms import ExternalForce


class Simulator:
    """Advances a scene step by step and shows its state.

    `Simulator(solver)`, or, for a solver made without a scene, `Simulator(mesh, material, solver)`. contact_forces: note in
    each step what obstacles do, for `output(ContactForce(...))`.

    positions, displacements [m] and velocities [m/s] are NumPy copies of shape (num_vertices, 3) in the scene's
    precision (positions far from the origin in float64, origin.py); time [s] and step_count say where it is. A run that
    goes wrong raises Divergence (a FloatingPointError) and leaves the state before the step that failed.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity()], precision="f64")
    >>> simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=1e-3))
    >>> simulator.step()
    >>> simulator.run(9)
    >>> print(f"{simulator.time:.2f} s, {simulator.velocities[0, 1]:.4f} m/s, {simulator.compute_energy():.1f} J")
    0.01 s, -0.0981 m/s, 4905.0 J
    """

    def __init__(self, *arguments, contact_forces: bool = False):
        solver = arguments[-1] if arguments else None
        if len(arguments) == 3:
            solver.bind(arguments[0], arguments[1])
        elif len(arguments) != 1:
            raise TypeError("Simulator takes a solver, or a mesh, a material and a solver")
        instance("Simulator", "its last argument", solver, Solver, "a solver such as SemiImplicitSolver(scene)")
        if solver.scene is None:
            raise ValueError(
                "the solver has no scene: use Simulator(mesh, material, solver), or a solver made from a Scene"
            )
        self.solver, self.scene = solver, solver.scene
        solver.simulator = weakref.ref(self)
        self._start = solver.start_values()
        self._notes, self._settled = bool(contact_forces), {}
        if contact_forces:
            solver.check_contact_forces()
        self._make_workspace()
        self.reset()

    def _make_workspace(self, bend: float = 0.0) -> None:
        self.workspace = self.solver.workspace(self._start, bend)
        if self._notes:
            self.workspace.make_frames(2)
            self.workspace.record_contacts()
        self._guard = Guard(self.workspace)
        self._before = self.workspace.history(1)

    def _take_bent(self, bend: float) -> None:
        """Go on from before the step with faces that bend by so much [m]."""
        old, before = self.workspace, self._before
        old.report.substeps -= self.solver.num_passes(1)  # which are done again
        self._make_workspace(bend)
        self.workspace.restore(before, 0)
        self.workspace.report, self.workspace.watch.earlier = old.report, [old.watch.resolution()]
        if old.arrays.rows["forces"] is not None:
            self.workspace.arrays.load_rows(forces=old.arrays.rows["forces"])
        self._load_step()
        self.workspace.place_obstacles(0)
        if self.workspace.pairs:
            self.workspace.pairs.forget(self.workspace.state.u)
        self.workspace.check_apart()

    def __reduce__(self):
        raise TypeError(
            "a Simulator owns memory of the device and does not pickle: pickle its solver and its state, and there "
            "Simulator(solver), resume(state)"
        )

    def reset(self) -> None:
        """Back to the start of the scene."""
        self.step_count = 0
        self._set: dict[str, np.ndarray] = {}  # inputs that were set since
        self.workspace.load(self._start)
        self.workspace.report.clear()
        if self._notes:
            self.workspace.forget_contacts()
        if self._start.forces is not None and len(self._start.forces) == 1:
            self.workspace.arrays.load_rows(forces=self._start.forces)  # set_forces may have changed them

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.step_count * self.solver.dt

    def step(self) -> None:
        """Advance by solver.dt."""
        self._load_step()
        self.workspace.first_step = self.step_count
        passes = self.solver.num_passes(1)
        self.workspace.save(self._before, 0)
        if self._notes:
            self.workspace.forget_contacts()
        try:
            with self.workspace.report.of_passes(passes):
                self._guard.advance(0, passes, passes, int(self._notes))
        except FacesBend as bent:
            self._take_bent(bent.bend)
            return self.step()
        except FloatingPointError:
            self.workspace.restore(self._before, 0)
            if self._notes:
                self.workspace.forget_contacts()
            raise
        self.step_count += 1
        self.workspace.place_obstacles(int(self.solver.schedule.first(1)))

    def run(self, steps: int) -> None:
        """Advance by so many steps."""
        for _ in range(whole("steps", steps)):
            self.step()

    def set_substeps(self, substeps: int) -> None:
        """Divide the steps to come into so many substeps; a step that is too long then raises Divergence."""
        self.solver.substeps = whole("substeps", substeps, 1)

    def _load_step(self) -> None:
        """Bring what depends on the step to the device: motion of fixed vertices, forces per step."""
        arrays, values = self.workspace.arrays, self._start
        if values.motion is not None:
            times, inputs = [self.time, self.time + self.solver.dt], self.scene.inputs
            posed = inputs.derive(inputs.at_times(times)).motion if self.scene.posed_supports else None
            arrays.load_rows(motion=self.scene.motion_rows(times) if posed is None else posed)
        if values.path is not None:
            rows, away = self.scene.path_rows([self.time, self.time + self.solver.dt]), self.scene.inputs.away.values()
            arrays.load_rows(path=PoseColumns(rows, "path", away).value(*rows.values())[0])
        inputs = self.scene.inputs
        if inputs.makes_rows:
            now = inputs.derive(inputs.at_step(self.step_count, self.solver.dt, self._set))
            made = {name: getattr(now, name) for name in ("forces", "growths", *arrays.rows_of_steps)}
            arrays.load_rows(**{name: rows for name, rows in made.items() if rows is not None})
        elif values.forces is not None and len(values.forces) > 1:
            rows = values.forces
            if self.step_count >= len(rows):
                raise ValueError(f"external_forces are given for {len(rows)} steps, this is step {self.step_count}")
            arrays.load_rows(forces=rows[self.step_count][None])

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
    def _has_before(self) -> bool:
        return getattr(self.solver, "multistep", False)

    @property
    def state(self) -> dict[str, np.ndarray]:
        """All that the run needs to go on, for `resume`: displacements [m], velocities [m/s], law_state, step_count, of
        two-step solvers the displacements and velocities before, pressures of constrained volumes in implicit steps,
        and the forces that `set_forces` gave. `np.savez(file, **simulator.state)` keeps it, to the bit."""
        state = self.workspace.state
        out = dict(displacements=self.displacements, velocities=self.velocities, step_count=np.array(self.step_count))
        if state.z is not None:
            out["law_state"] = self.law_state
        if self._has_before and not state.fresh[0]:
            before = (runtime.fetch(x)[0] for x in (state.before.u, state.before.v))
            out["displacements_before"], out["velocities_before"] = before
        if self.workspace.last_multipliers is not None:
            out["constraint_pressures"] = self.workspace.last_multipliers
        return out | self._set

    def resume(self, state: dict) -> None:
        """Go on from a `state` of this scene and solver with the same bits, as if the run had not stopped.

        state: the dictionary, or what np.load makes of its file. The scene, the solver and its substeps must be as they
        were. Raises ValueError for parts that are missing, unknown, or of other shapes.
        """
        given, known = {name: np.asarray(state[name]) for name in state}, self.state
        two_step = {"displacements_before", "velocities_before"} if self._has_before else set()
        term = self.scene.term(ExternalForce)
        forces = set() if term is None else {self.scene.input_names(term)["external_forces"]}
        held = {"constraint_pressures"} if self.workspace.volumes and not self.solver.explicit else set()
        optional = two_step | forces | held
        lacking, more = known.keys() - optional - given.keys(), given.keys() - known.keys() - optional
        if lacking or more or len(given.keys() & two_step) == 1:
            raise ValueError(
                f"resume: this run has the state {', '.join(known)}, got {', '.join(given) or 'nothing'}: "
                "make the simulator of the same scene and solver"
            )
        shape, count = known["displacements"].shape, given["step_count"]
        if count.shape or count != int(count) or count < 0:
            raise ValueError(f"resume: step_count must be a whole number >= 0, got {count!r}")
        for name in ("displacements", "velocities", *(two_step & given.keys())):
            value, own = given[name], known["displacements"].dtype
            if value.shape != shape or value.dtype != own or not np.all(np.isfinite(value)):
                raise ValueError(
                    f"resume: {name}: expected finite numbers, {own} of shape {shape}, got {value.dtype} of {value.shape}"
                )
        law_state = self.workspace.checked_law_state(given["law_state"]) if "law_state" in given else None
        self.reset()
        for name in forces & given.keys():
            self.set_forces(given[name])
        now = self.workspace.state
        runtime.fill(now.u, given["displacements"][None])
        runtime.fill(now.v, given["velocities"][None])
        if law_state is not None:
            self.workspace.set_law_state(law_state)
        self.workspace.forget()
        if two_step & given.keys():
            runtime.fill(now.before.u, given["displacements_before"][None])
            runtime.fill(now.before.v, given["velocities_before"][None])
            now.fresh[0] = False
        self.step_count = int(count)
        if held & given.keys():
            self.workspace.go_on_from(given["constraint_pressures"].copy(), self.step_count)
        self.workspace.place_obstacles(int(self.solver.schedule.first(1)) if count else 0)

    @property
    def values(self) -> dict[str, np.ndarray]:
        """The values of the scene's inputs, with those that were set since, and of what is given over time, now."""
        return self.scene.inputs.at_times([self.time]) | self._set

    @property
    def values_of_step(self) -> dict[str, np.ndarray]:
        """The values of the scene's inputs in the last step, or in the first before it is taken, as a run of one step has
        them; those that were set since the start included."""
        return self.scene.inputs.at_step(max(self.step_count - 1, 0), self.solver.dt, self._set)

    def output(self, output: Output) -> np.ndarray:
        """Value of an output such as `Reaction("left")` or `Stress()` at the present state, as a Rollout's frame has it.

        ContactForce and ContactTraction are the mean over the last step, zero before the first, and need
        `Simulator(solver, contact_forces=True)`, as friction of SelfContactForce does in implicit and static solvers.
        Raises ValueError for one without, and as the output does.
        """
        if output.needs_contact_forces(self.solver) and not self._notes:
            raise ValueError(f"{output!r} is of a step: make the simulator with Simulator(solver, contact_forces=True)")
        if output.cumulative:
            raise ValueError(f"{output!r} counts from the start of a run: pass it to Rollout(..., outputs=[...])")
        now = (x[None] for x in (self.positions, self.velocities, self.displacements))
        frames = Frames(*now, np.array([self.time]), self.values_of_step)
        frames.steps = np.array([self.step_count])
        frames.law_state = self.law_state[None]
        if self._notes:
            frames.contact_forces = self.workspace.contact_forces(self.solver.dt)[1:]
        if output.reads_chamber_pressures and self.scene.holds_volumes:
            frames.chamber_pressures = self.workspace.last_chamber_pressures()[None]
        return self.settled(output).value(frames)[0]

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

        Fixed vertices keep no velocity; of sets that are `reduced` what they can do is taken. `reset` goes back to the
        start; a run that was saved goes on by `resume`.
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
                    runtime.fill(state.u, displaced.value(value, self._start.rest)[0][None])
                else:
                    given = dict(initial_velocities=value, rest=self._start.rest)
                    given["displacement"] = runtime.fetch_row(state.u, 0)
                    runtime.fill(state.v, moving.value(*(given[part] for part in moving.reads))[0][None])
        if law_state is not None:
            self.workspace.set_law_state(law_state)
        self.workspace.forget()

    def set_forces(self, forces: ArrayLike) -> None:
        """Other external forces [N] from now on, in the shape of the scene's constant ExternalForce, until a reset."""
        term, forces = self.scene.term(ExternalForce), numbers("forces", forces)
        given = None if term is None else term.values.get("external_forces")
        if given is None or given.ndim == 3:
            remedy = "add one of zeros"
            raise ValueError(f"set_forces needs a scene with a constant ExternalForce, of shape (k, 3); {remedy}")
        if forces.shape != given.shape or not np.all(np.isfinite(forces)):
            raise ValueError(f"forces: expected finite numbers of shape {given.shape}, got shape {forces.shape}")
        self._set[self.scene.input_names(term)["external_forces"]] = forces
        if not self.scene.inputs.makes_rows:  # else with others, when a step is loaded
            self.workspace.arrays.load_rows(forces=forces[None])

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
