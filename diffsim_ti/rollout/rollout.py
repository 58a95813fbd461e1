"""Rollout: n steps of a solver as one differentiable operation."""

from collections.abc import Callable, Iterable
from typing import Literal, TypedDict

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti import runtime
from diffsim_ti.accuracy.estimate import Accuracy, accuracy
from diffsim_ti.common.checked import as_numbers, instance, listed, shape_of, shown
from diffsim_ti.common.copies import made_again
from diffsim_ti.common.names import no_such
from diffsim_ti.common.origin import positions_of
from diffsim_ti.common.public import Public
from diffsim_ti.inputs import Derived
from diffsim_ti.inputs.description import InputName, InputValue
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.outputs import Change, Displacements, Output, Positions, Velocities
from diffsim_ti.outputs.output import Frames
from diffsim_ti.rollout.checkpoints import Checkpoints
from diffsim_ti.rollout.run import HostSeed, Run, check_finite, warn_of_large_stretch
from diffsim_ti.rollout.set_values import change_like, gathered, spread_all, spread_change, spread_shape, with_shape
from diffsim_ti.rollout.sweep import Sweep
from diffsim_ti.rollout.taped import TapeAdapter
from diffsim_ti.scene.scene import SceneArguments
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.state.schedule import UnequalSteps
from diffsim_ti.state.solve_report import SolveReport


class RolloutOptions(TypedDict, total=False):
    """What `Rollout` takes besides solver and steps: what `Rollout.on` replaces."""

    save_every: int | None
    checkpoint_every: int | None
    memory: float | None
    gradients: str | Iterable[str] | None
    clip: float | None
    truncate: int | None
    health: bool
    outputs: Output | Iterable[Output]
    runs: int | None
    raise_errors: bool


class Rollout(metaclass=Public):
    """n steps of a solver from given inputs, with saved frames and gradients of everything that went in.

    solver: any solver; its scene names the inputs (`rollout.inputs`): initial_positions, initial_velocities,
        the material's numbers, density, the terms' numbers, prescribed_motion, rest_positions.
    steps: number of steps of solver.dt; or the length of each [s], or `UnequalSteps` with substeps for each;
        or a function of the solver that returns one of these, such as one that calls `adaptive_steps`.
    save_every: a frame every so many steps, besides the start; must divide `steps`. Default: only the end.
    checkpoint_every: keep a state every so many steps and compute the rest again in the reverse sweep.
    memory: or a budget [MB] from which they are chosen (default 1000). The gradient is bitwise the same.
    gradients: names of inputs whose gradient is wanted; default all but rest_positions, which costs extra. "shape": of the
        whole body's, with its supports (`vjp`).
    clip: largest norm of the running adjoint; it is scaled back when it exceeds that (the gradient is then no gradient).
    truncate: differentiate only the last so many steps.
    health: keep a report of the adjoint's norm per step (`rollout.health`).
    outputs: what losses use besides positions, velocities and displacements, such as ContactForce, Reaction, Stress,
        MaterialPoints (outputs/).
    runs: how many runs one tape may hold, each with frames of its own; see `run`.
    raise_errors: False marks a run that goes wrong instead of raising: `frames.alive`, and of the last run `rollout.alive`,
        are False, frames hold the last good state from there on, `frames.error` says what stopped it, and gradients of
        that run are zero, with a warning; tangents raise what stopped it.

    Two ways to use it. With arrays: `frames = rollout.forward(youngs_modulus=...)`, then `rollout.vjp(frames, ...)`.
    In Taichi: `rollout.run()` under `ti.ad.Tape`, with fields `rollout.positions`, `rollout.velocities` (frames x
    vertices) and, for the inputs, `rollout.field(name)`; after the tape `rollout.gradients[name]` or the fields' .grad.

    Raises ValueError for inputs that do not fit, FloatingPointError if the run diverges or the adjoint is not finite.
    Griewank, Walther, Evaluating Derivatives, ch. 3 and 12, doi:10.1137/1.9780898717761.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], precision="f64")
    >>> rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-3), steps=10)
    >>> frames = rollout.forward(gravity=(0.0, -1.62, 0.0))
    >>> gradients = rollout.vjp(frames, positions=frames.positions[-1:].repeat(2, 0) * 0 + 1)
    >>> print(f"{frames.displacements[-1, 0, 1]:.2e} {gradients['gravity'][1]:.2e}")  # g t^2 / 2, and 8 t^2 / 2
    -8.10e-05 4.00e-04
    """

    def __init__(
        self,
        solver: Solver,
        steps: int | ArrayLike | UnequalSteps | Callable[[Solver], UnequalSteps],
        save_every: int | None = None,
        checkpoint_every: int | None = None,
        memory: float | None = None,
        gradients: str | Iterable[str] | None = None,
        clip: float | None = None,
        truncate: int | None = None,
        health: bool = False,
        outputs: Output | Iterable[Output] = (),
        runs: int | None = None,
        raise_errors: bool = True,
    ):
        instance("Rollout", "solver", solver, Solver, "a solver such as SemiImplicitSolver(scene)")
        solver, steps = self._stepped(solver, steps)
        self.scene = solver.scene
        options = dict(save_every=save_every, checkpoint_every=checkpoint_every, memory=memory, gradients=gradients)
        options |= dict(clip=clip, truncate=truncate, health=health, raise_errors=raise_errors)
        given = (outputs,) if isinstance(outputs, Output) else tuple(listed("outputs", outputs, "Outputs"))
        contacts = frozenset(getattr(output, "reads_contact_forces", False) for output in given) - {False}
        chambers = any(getattr(output, "reads_chamber_pressures", False) for output in given)
        law_states = any(getattr(output, "reads_law_state", False) for output in given)
        noted = dict(contacts=contacts, chambers=chambers, law_states=law_states)
        self.sweep = sweep = Sweep(solver, steps, **options, **noted)
        self.steps, self.save_every, self.num_frames = sweep.steps, sweep.save_every, sweep.num_frames
        self.values, self.inputs, self.wanted = sweep.values, sweep.inputs, sweep.wanted
        self.outputs = self._check_outputs((Positions(), Velocities(), Displacements(), *given))
        self.given_outputs = given  # as they were given, for whatever scene
        self.computed = {output.name: self.outputs[output.name] for output in given}  # besides the states themselves
        self._options = options | dict(outputs=given, runs=runs)
        self.gradients: dict[str, np.ndarray] = {}
        self.tape_face = TapeAdapter(self, runs)
        self.torch_face = None  # made by the first run from tensors (torch_bridge/tensors.py)

    def __reduce__(self):
        """As it was made; values of its fields, and frames, are not in it."""
        steps = self.steps if self.schedule is None else self.schedule
        return made_again, (Rollout, dict(solver=self.solver, steps=steps) | self._options)

    @staticmethod
    def _stepped(solver: Solver, steps) -> tuple[Solver, int]:
        """The solver that takes these steps, and how many they are."""
        steps = steps(solver) if callable(steps) else steps
        if not isinstance(steps, UnequalSteps) and len(shape_of("steps", steps)) == 1:
            steps = UnequalSteps(steps)
            steps = UnequalSteps(steps.lengths, solver.substeps_of(steps.lengths))
        if isinstance(steps, UnequalSteps):
            return solver.on(steps), len(steps)
        if not isinstance(steps, int | float | np.integer) or not (steps >= 0 and steps == int(min(steps, 1e18))):
            remedy = "or pass lengths of steps [s], or UnequalSteps"
            raise ValueError(f"steps must be a whole number >= 0, got {steps!r}; {remedy}")
        return solver, int(steps)

    def _check_outputs(self, outputs) -> dict[str, Output]:
        out: dict[str, Output] = {}
        for output in outputs:
            if not isinstance(output, Output):
                raise ValueError(f"outputs: expected an Output such as MaterialPoints(points), got {output!r}")
            name, taken = output.name, (*out, *self.inputs)
            if not isinstance(name, str) or not name.isidentifier() or name in taken:
                rule = "need names of their own without blanks"
                raise ValueError(f"outputs: {rule}, got {shown(name)}; taken: {', '.join(taken)}")
            out[output.name] = output.settled(self.scene)
        return out

    def __repr__(self) -> str:
        own = [repr(self.solver), f"{self.steps} steps, {self.num_frames} frames"]
        own += [f"outputs {', '.join(self.computed)}"] if self.computed else []
        return f"Rollout({', '.join(own)}, gradients by {', '.join(self.wanted) or 'nothing'})"

    def with_scene(self, **changes: Unpack[SceneArguments]) -> "Rollout":
        """The same rollout of a scene with some arguments replaced, such as precision="f64"."""
        return self.on(self.solver.for_scene(self.scene.replace(**changes)))

    def on(self, solver: Solver, **options: Unpack[RolloutOptions]) -> "Rollout":
        """As many steps of another solver, with some of the options replaced."""
        steps = self.steps if self.schedule is None else self.schedule
        return Rollout(solver, steps, **self._options | options)

    @property
    def solver(self) -> Solver:
        """The solver, with the substeps that runs take."""
        return self.sweep.solver

    @property
    def schedule(self) -> UnequalSteps | None:
        """The steps, where they are not equal."""
        return self.solver.unequal_steps

    @property
    def times(self) -> np.ndarray:
        """Times of the frames [s]."""
        return self.solver.schedule.time(np.arange(self.num_frames) * self.save_every)

    @property
    def checkpoints(self) -> Checkpoints:
        """Which states are kept for the reverse sweep."""
        return self.sweep.checkpoints

    @property
    def memory(self) -> float:
        """What the reverse sweep keeps [MB]: snapshots, recorded states."""
        return self.checkpoints.states() * self.sweep.state_bytes / 1e6

    @property
    def report(self) -> SolveReport:
        """What the solves of the last forward run took: iterations, residuals, cuts, saddles, time, by step."""
        return SolveReport() if self.sweep.workspace is None else self.sweep.workspace.report

    @property
    def alive(self) -> bool:
        """Whether the last run came to its end; see `raise_errors`."""
        return self.sweep.last_error is None

    @property
    def health(self) -> list[dict]:
        """Norms of the adjoint in the steps of the last reverse sweep, last step first, if asked for."""
        return self.sweep.health

    # ---- with arrays ------------------------------------------------------------------------------------------------

    def forward(self, law_state: ArrayLike | None = None, **values: InputValue) -> Frames:
        """Run from the scene's inputs, with some of them replaced, and return the saved frames.

        values: by the names of inputs, which `scene.inputs` lists with shapes and units.

        law_state: what the law remembers at the start, in the shape of `Simulator.law_state`; gradients are by all else.

        A material's numbers and others per tetrahedron may be given by named sets, `youngs_modulus={"soft": 2e4}`; gradients
        by them have the same names, and so may tangents (set_values.py). `shape` [m], (num_vertices, 3), moves initial and
        rest positions together, and supports with them.
        """
        values, sets = spread_all(self.scene, self.values, spread_shape(values, self.values))
        frames = self.frames_of(self.sweep.run(values, law_state=law_state))
        frames.sets = sets
        return frames

    def frames_of(self, run: Run) -> Frames:
        """The frames of the run that the sweep ran last, with all outputs; the last good one stands for those after it."""
        rows = np.minimum(np.arange(self.num_frames), self.sweep.last_good(run))
        u, v = (runtime.fetch(x)[rows] for x in self.sweep.workspace.frames)
        positions = positions_of(self.scene, run.values["rest_positions"], u)
        inputs = run.values
        if run.start is not None:
            start = dict(initial_positions=positions[0], initial_velocities=v[0])
            inputs = inputs | {name: x.astype(np.float64) for name, x in start.items()}
        frames = Frames(positions, v, u, self.times, inputs, run.contact_resolution, run=run)
        frames.computed, frames.scene = self.computed, self.scene
        frames.steps = np.arange(self.num_frames) * self.save_every
        frames.error = run.error
        for name, x in self.sweep.noted_values().items():
            setattr(frames, name, x[rows])
        for name, output in self.computed.items():
            value, shape = np.asarray(output.value(frames)), tuple(output.shape(self.num_frames))
            if value.shape != shape:
                raise ValueError(f"output {name!r}: its value has shape {value.shape}, but it says {shape}")
            frames.outputs[name] = value
        warn_of_large_stretch(frames)
        return frames

    def vjp(
        self,
        frames: Frames,
        positions: ArrayLike | None = None,
        velocities: ArrayLike | None = None,
        **seeds: ArrayLike | None,
    ) -> dict[str, np.ndarray]:
        """Gradients of a loss by every wanted input, from its gradients by positions, velocities and other outputs.

        Float64 arrays of the inputs' shapes; None for a part that the loss does not depend on. Further seeds of the same
        frames cost a reverse sweep each: no pass runs forward again unless too few states are kept.
        That by `rest_positions` is of a body whose start, and with it its supports, stay where they are: the gradient by the
        shape of a body that is held is the sum of this and that by `initial_positions`, which a Rollout made with
        gradients="shape" has under the name "shape".
        """
        instance("Rollout.vjp", "frames", frames, Frames, "what forward returned")
        change = self.pulled_to_frames(frames, dict(positions=positions, velocities=velocities) | seeds)
        zero = np.zeros(frames.positions.shape)
        at_frames = [zero if x is None else x for x in (change.positions, change.velocities)]
        seed = HostSeed(*at_frames, change.noted)
        self.gradients = self.gradients_of(frames.run, self.sweep.pull_back(frames.run, seed), change)
        for name in self.gradients.keys() & frames.sets.keys():
            self.gradients[name] = gathered(self.gradients[name], frames.sets[name])
        self.gradients = with_shape(self.gradients, self.sweep.wants_shape)
        return self.gradients

    def pulled_to_frames(self, frames: Frames, seeds: dict) -> Change:
        """Gradients of a loss by the frames' states and, directly, by inputs, from those by outputs."""
        out = Change()
        for name, seed in seeds.items():
            if name not in self.outputs:
                raise ValueError(no_such("output", name, self.outputs, "this rollout"))
            if seed is not None:
                seed = as_numbers(f"gradient by the frames' {name}", seed)
                shape = tuple(self.outputs[name].shape(self.num_frames))
                if seed.shape != shape:
                    raise ValueError(f"gradient by the frames' {name}: expected shape {shape}, got {seed.shape}")
                check_finite(name, seed, self.save_every)
                out.add(self.outputs[name].vjp(frames, seed))
        return out

    def gradients_of(
        self, run: Run, derived: Derived, change: Change, wanted: Iterable[str] | None = None
    ) -> dict[str, np.ndarray]:
        """Gradients by the wanted inputs from adjoints of what kernels read, and those by inputs directly."""
        out = self.scene.inputs.derive_vjp(run.values, derived, self.wanted if wanted is None else wanted)
        for name, direct in change.inputs.items():
            if name in out and run.error is None:
                out[name] = out[name] + direct
        return out

    def jvp(self, frames: Frames, **tangents: InputValue) -> tuple[np.ndarray, np.ndarray]:
        """Changes (positions, velocities) of the frames for changes of inputs, to first order, float64."""
        change = self._pushed_to_frames(frames, tangents)
        return change.positions, change.velocities

    def tangents(self, frames: Frames, **tangents: InputValue) -> dict[str, np.ndarray]:
        """Changes of all outputs, by name, for changes of inputs, to first order, float64."""
        return self.changes_of(frames, self._pushed_to_frames(frames, tangents))

    def changes_of(self, frames: Frames, change: Change) -> dict[str, np.ndarray]:
        """Changes of all outputs from those of the frames' states and of inputs."""
        return {name: output.jvp(frames, change) for name, output in self.outputs.items()}

    def _pushed_to_frames(self, frames: Frames, tangents: dict) -> Change:
        tangents = spread_change(tangents)
        unknown = [name for name in tangents if name not in self.inputs]
        if unknown:
            raise ValueError(f"jvp: {self.scene.inputs.no_input(unknown[0], 'this rollout', self.inputs)}")
        values = instance("Rollout.tangents", "frames", frames, Frames, "what forward returned").inputs
        zero = {name: np.zeros_like(values[name]) for name in tangents}
        tangents, _ = spread_all(self.scene, zero, tangents, frames.sets)
        tangents = {name: change_like(name, x, values[name].shape) for name, x in tangents.items()}
        derived = self.scene.inputs.derive_jvp(values, tangents)
        moved = self.sweep.push_forward(frames.run, derived)
        return Change(*moved, tangents, **self.sweep.noted_changes)

    def accuracy(
        self,
        output: str,
        weights: ArrayLike | Callable | None = None,
        finer: Callable[[TetrahedralMesh], TetrahedralMesh] | None = None,
        **values: InputValue,
    ) -> Accuracy:
        """The estimated error of a number of this run: what mesh, steps, solver and rounding cost (accuracy/estimate.py).

        output: name of an output. weights: products with it add up to the number, in the last frame (its shape there) or in
            all frames; default 1 where it is one number. Or a loss: a function of its values that returns a number and its
            derivative by them.
        finer: function from the mesh to the one whose solution stands for the truth, `TetrahedralMesh.quadratic` of linear
            tetrahedra, `TetrahedralMesh.refined` of ten nodes by default.
        values: of inputs, as in `forward`.

        Implicit passes of the finer mesh are solved from the run's states on, explicit steps are run anew. Forces that are
        out of balance where these are put on it, times the adjoint of the number, are the error to first order, and say the
        share of each tetrahedron. Shares of explicit steps, of robots and of what is held exactly are by volume alone.
        Where the error is small beside those of other components and frames the bar is wider; `Accuracy.doubts` say so, and
        what else makes the estimate unsure. Steps of half the length say what steps cost.
        Raises ValueError for what a finer mesh cannot have, FloatingPointError where it finds no state.
        Becker, Rannacher 2001, doi:10.1017/S0962492901000010.

        >>> import diffsim_ti as ds
        >>> mesh = ds.TetrahedralMesh.create_box((3, 2, 2), (2.0, 1.0, 1.0))
        >>> scene = ds.Scene(mesh, ds.LinearElastic(1e6, 0.0), terms=ds.Gravity((9.81, 0, 0)), fixed="xmin", precision="f64")
        >>> end = ds.MaterialPoints([[2.0, 0.5, 0.5]], name="end")
        >>> found = ds.Rollout(ds.StaticSolver(scene), 1, outputs=end).accuracy("end", weights=(1.0, 0.0, 0.0))
        >>> print(f"{found.value - 2:.5f} m, off by {found.error:.5f} m")  # rho g L^2 / (2 E) = 0.01962 m
        0.01962 m, off by 0.00000 m
        """
        return accuracy(self, output, weights, finer, values)

    # ---- under ti.ad.Tape -------------------------------------------------------------------------------------------

    def field(self, name: InputName | Literal["positions", "velocities", "displacements"]):
        """The Taichi field of an input or of an output ("positions", "velocities", ...), with .grad.

        Input fields hold the scene's values until a kernel or `from_numpy` writes others; `run` reads them. Those of outputs
        have shape (frames, num_vertices), and (runs, frames, num_vertices) in a Rollout of several `runs`.
        "youngs_modulus[soft]" is the number of a named set. "initial_displacements" is another spelling of
        "initial_positions", which keeps its digits in float32.
        """
        return self.tape_face.field(name)

    @property
    def positions(self):
        """Taichi field of the frames' positions [m], shape (frames, num_vertices) of 3-vectors, with .grad."""
        return self.field("positions")

    @property
    def velocities(self):
        """Taichi field of the frames' velocities [m/s], shape (frames, num_vertices) of 3-vectors, with .grad."""
        return self.field("velocities")

    def run(self, k: int | None = None) -> None:
        """Run from the input fields and fill the outputs' fields; in a `ti.ad.Tape`, the tape will pull gradients back.

        In a Rollout of several `runs`, run k fills row k of these fields: kernels may write the inputs of run k + 1 from the
        frames of run k, in one tape. Input fields are read immediately, and may be overwritten for the next run. The device
        keeps what the reverse sweep needs of one run: all but the last run once more when the tape goes back.
        Gradients add to the .grad of the input fields; `gradients` has their sum over the runs of the tape.
        Raises RuntimeError for a run that this tape already holds, ValueError for k outside 0 .. runs - 1.
        """
        self.tape_face.run(k)
