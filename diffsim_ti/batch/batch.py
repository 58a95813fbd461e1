"""Many scenes of one mesh, law and list of terms, whose numbers differ: forward, gradients and tangents together."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.batch.batch_inputs import change_of, checked_values, gathered_scenes, spread_given
from diffsim_ti.batch.frames import BatchFrames, LazyFrames
from diffsim_ti.batch.joined_workspace import JoinedSweep
from diffsim_ti.batch.layouts import why_not
from diffsim_ti.batch.sweep import BatchSweep, Own, value_of
from diffsim_ti.batch.taped import BatchTapeAdapter
from diffsim_ti.common.checked import as_numbers, instance, whole
from diffsim_ti.common.copies import made_again
from diffsim_ti.common.names import no_such
from diffsim_ti.common.origin import positions_of
from diffsim_ti.common.public import Public
from diffsim_ti.common.warn import warn
from diffsim_ti.inputs import Derived
from diffsim_ti.inputs.description import InputName, InputValue
from diffsim_ti.mesh.face_points import bow, bows
from diffsim_ti.outputs import Change, Output
from diffsim_ti.outputs.output import Frames
from diffsim_ti.rollout.rollout import Rollout
from diffsim_ti.rollout.run import HostSeed, Run, check_finite, warn_of_large_stretch
from diffsim_ti.rollout.set_values import spread_change, spread_shape, with_shape
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.state.bending import FAR, FacesBend
from diffsim_ti.state.schedule import UnequalSteps
from diffsim_ti.terms import Drag


class Batch(metaclass=Public):
    """`scenes` runs of a solver's scene simultaneously, with numbers of their own where they are given with a leading axis.

    solver, steps, save_every, outputs, gradients, truncate, memory: as of `Rollout`; memory [MB] is that of all scenes.
    scenes: how many, >= 1.
    lanes: None, side by side where the scene allows it, else one after the other. Explicit steps: eight scenes
    simultaneously in the lanes of vector units on CPUs, each on threads of its own on GPUs, neighbouring scenes on
    neighbouring ones. Implicit and static ones: all scenes in one Newton's method, each with its own line search and end.
    True: ValueError, which says why, where it does not; False: one after the other. `lanes` then says which it is, and
    `why_not` what keeps the scene from it.
    runs: as of `Rollout`, for `run` under `ti.ad.Tape`.

    Every input of `forward` is given once for all scenes, in a shape that `Rollout.forward` takes, or with one more axis of
    length `scenes` in front. Gradients and tangents of inputs that were given once have their shape, gradients being summed
    over scenes in their order; of others they have the leading axis. Numbers of tetrahedra may be given by named sets, each
    set once or with the axis, `youngs_modulus={"soft": [1e4, 2e4], "stiff": 1e6}`; gradients have the same names. At equal
    steps the states of a scene are those of a `Rollout` of it alone: of explicit solvers bit for bit, whatever its
    neighbours, its place among them and the number of threads, of others to the solver's tolerance.

    Scenes fail alone (`BatchFrames.alive`): the gradient of one that did is zero, with a warning. Side by side a failure is
    a frame that is not finite or whose vertices cross the body within a substep, or a vertex behind an obstacle; gains of
    energy that a `Rollout` warns of are not looked for. Where a solve of all implicit scenes gives one up, it is run alone
    (`BatchFrames.alone`).

    Freeman et al. 2021, Brax (leading axes of scenes), arXiv:2106.13281.
    Raises ValueError for shapes that fit neither, or both, saying which there are.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], precision="f64")
    >>> batch = ds.Batch(ds.VelocityVerletSolver(scene, dt=1e-3), steps=10, scenes=2)
    >>> frames = batch.forward(gravity=[[0.0, -9.81, 0.0], [0.0, -1.62, 0.0]])  # on earth and on the moon
    >>> frames.displacements[:, -1, 0, 1].round(7).tolist()
    [-0.0004905, -8.1e-05]
    """

    def __init__(
        self,
        solver: Solver,
        steps: int | ArrayLike | UnequalSteps,
        scenes: int,
        save_every: int | None = None,
        outputs: Output | Iterable[Output] = (),
        gradients: str | Iterable[str] | None = None,
        truncate: int | None = None,
        memory: float | None = None,
        lanes: bool | None = None,
        runs: int | None = None,
    ):
        self.num_scenes = whole("scenes", scenes, 1)
        options = dict(save_every=save_every, gradients=gradients, truncate=truncate, memory=memory)
        self.one = Rollout(solver, steps, outputs=outputs, **options)
        self._lanes_asked = lanes
        self.scene, self.inputs, self.wanted = self.one.scene, self.one.inputs, self.one.wanted
        self.frames: BatchFrames | None = None  # of the last `run`
        self.gradients: dict[str, np.ndarray] = {}
        self.tape_face = BatchTapeAdapter(self, runs)
        self.steps, self.save_every, self.num_frames = self.one.steps, self.one.save_every, self.one.num_frames
        alone = [name for name in self.one.sweep.noted if name != "contact_forces"]
        self.why_not = why_not(self.solver) or (f"an output reads {' and '.join(alone)} of frames" if alone else None)
        if lanes and self.why_not:
            raise ValueError(f"scenes cannot be computed side by side: {self.why_not}; leave out lanes=True")
        self.lanes = self.why_not is None if lanes is None else bool(lanes)
        kind, options["contacts"] = BatchSweep if self.solver.explicit else JoinedSweep, self.one.sweep.contacts
        self.sweep = kind(self.solver, self.steps, self.num_scenes, **options) if self.lanes else None
        if self.sweep:
            self.sweep.run_substeps = self.one.sweep.run_substeps

    def __reduce__(self):
        """As it was made; frames and values of its fields are not in it."""
        given = self.one.__reduce__()[1][1]
        names = ("solver", "steps", "save_every", "outputs", "gradients", "truncate", "memory")
        own = {name: given[name] for name in names} | dict(scenes=self.num_scenes, lanes=self._lanes_asked)
        own["runs"] = self.tape_face.runs
        return made_again, (Batch, own)

    def __repr__(self) -> str:
        why = f", for {self.why_not}," if self.why_not else ""
        how = "side by side" if self.lanes else f"one after another{why}"
        return f"Batch({self.num_scenes} scenes {how} of {self.one!r})"

    @property
    def solver(self) -> Solver:
        """The solver, with the substeps that runs take."""
        return self.one.solver

    @property
    def outputs(self) -> dict[str, Output]:
        """The outputs of one scene."""
        return self.one.outputs

    # ---- forward -----------------------------------------------------------------------------------------------------

    def forward(self, raise_errors: bool = False, **inputs: InputValue) -> BatchFrames:
        """Run all scenes, with some inputs replaced. raise_errors: raise what stopped the first one that died."""
        inputs = spread_shape(inputs, self.one.values)
        inputs, sets = spread_given(self.scene, inputs, self.one.values, self.num_scenes)
        values = checked_values(self.one, inputs, self.num_scenes)
        self._fit(values)
        run = (self._side_by_side if self.lanes and self._share_steps(values) else self._by_turns)(values)
        run.sets = sets
        dead = np.flatnonzero(~run.alive)
        if raise_errors and dead.size:
            raise run.error(int(dead[0]))
        return run

    def _share_steps(self, values: dict) -> bool:
        """Whether the steps of all scenes are one equation: implicit ones have one rate of drag."""
        drag = None if self.solver.explicit else self.scene.term(Drag)
        name = self.scene.input_names(drag)["drag_rate"] if drag else None
        if drag and isinstance(values[name], Own) and np.ptp(values[name]) > 0:
            if self._lanes_asked:
                raise ValueError(
                    f"scenes cannot be computed side by side: implicit steps have one {name}; give it once for all, or "
                    "leave out lanes=True"
                )
            warn(f"scenes that differ in {name} take implicit steps one after the other")
            return False
        return True

    def _fit(self, values: dict) -> None:
        """Let the stiffest scene choose substeps that were left to the solver, and refuse values that need more."""
        if self.solver.automatic:
            matters = self.one.sweep.run_substeps.matters
            own = any(isinstance(x, Own) and matters(name) for name, x in values.items())
            each = [{n: value_of(x, b) for n, x in values.items()} for b in range(self.num_scenes if own else 1)]
            for sweep in (self.one.sweep, *([self.sweep] if self.sweep else [])):
                sweep.fit(each)

    def _side_by_side(self, values: dict) -> BatchFrames:
        run, times = self.sweep.run(values), self.one.times
        u, v = self.sweep.states()
        self._warn_of_bent_faces(self._positions(values, u))
        last_good, crossed = np.full(self.num_scenes, self.num_frames - 1), self.sweep.crossed()
        broken = np.flatnonzero(~self._sound(u[:, -1], v[:, -1])) if self.solver.explicit else ()
        for b in {*broken, *crossed}:
            good = self._sound(u[b], v[b])
            if b in crossed:
                good[crossed[b] // self.save_every + 1 :] = False
            last_good[b] = max(0, int(np.argmin(good)) - 1) if not good.all() else last_good[b]
        noted = self.sweep.noted_values()
        for b in np.flatnonzero(last_good < self.num_frames - 1):
            for x in (u, v, *noted.values()):
                x[b, last_good[b] + 1 :] = x[b, last_good[b]]
        alone, errors = {}, {}
        for b in self.sweep.left:  # which the solves of all together gave up
            alone[b], error = self._one_by_one(values, b)
            errors |= {b: error} if error else {}
            u[b], v[b], last_good[b] = alone[b].displacements, alone[b].velocities, self._last_good(error)
        resolution = self.sweep.resolutions()
        states = self._positions(values, u), v, u
        make = lambda b: alone.get(b) or self._frames_of(values, b, states, noted, times, resolution(b))  # noqa: E731
        frames = LazyFrames(self.num_scenes, make)
        if np.isfinite(self.scene.material.valid_to):
            any(warn_of_large_stretch(frames[b]) for b in range(self.num_scenes))
        out = BatchFrames(self, values, frames, last_good, run, errors, states)
        out.alone = tuple(alone)
        return out

    def _warn_of_bent_faces(self, positions: np.ndarray) -> None:
        """Where faces of some frame lie farther from the triangles of their nodes than contact there may be taken for
        (state/bending.py)."""
        mesh, widths = self.scene.mesh, [float(t.values["barrier_width"]) for t in self.scene.obstacles]
        if mesh.order == 1 or not widths:
            return
        off = max(bows(x[mesh.surface_faces]).max(initial=0) for x in positions.reshape(-1, mesh.num_vertices, 3))
        resolution = self.sweep.resolutions() if off > FAR * min(widths) + 2 * bow(mesh) else None
        if resolution and any(np.isfinite(resolution(b).smallest_gap) for b in range(self.num_scenes)):
            warn(
                f"{FacesBend(off)} where obstacles act at their nodes alone: refine the mesh there, or take a width of "
                f"{2.2 * off:.3g} m or more"
            )

    def _positions(self, values: dict, u: np.ndarray) -> np.ndarray:
        """Those of all scenes from displacements (scenes, frames, n, 3)."""
        rest = values["rest_positions"]
        rest = np.stack(rest)[:, None] if isinstance(rest, Own) else rest
        return positions_of(self.scene, rest, u)

    def _sound(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Whether states (k, n, 3) are finite and no vertex crosses the body within a substep."""
        with np.errstate(all="ignore"):
            spread = np.ptp(v, axis=1).max(1) * self.solver.substep
            return np.isfinite(u.sum((1, 2))) & (spread <= 2 * np.ptp(self.scene.mesh.vertices, axis=0).max())

    def _frames_of(self, values: dict, b: int, states: tuple, noted: dict, times, resolution) -> Frames:
        own = self.sweep.values_of(values, b)
        run, noted = Run(own, contacts=lambda: resolution), {n: x[b] for n, x in noted.items()}
        frames = Frames(*(x[b] for x in states), times, own, resolution, run=run, **noted)
        frames.computed, frames.steps = self.one.computed, np.arange(self.num_frames) * self.save_every
        frames.scene = self.scene
        for name, output in self.one.computed.items():
            frames.outputs[name] = np.asarray(output.value(frames))
        return frames

    def _by_turns(self, values: dict) -> BatchFrames:
        found = [self._one_by_one(values, b) for b in range(self.num_scenes)]
        last_good = np.array([self._last_good(error) for _, error in found])
        errors = {b: error for b, (_, error) in enumerate(found) if error}
        return BatchFrames(self, values, [frames for frames, _ in found], last_good, None, errors)

    def _one_by_one(self, values: dict, b: int) -> tuple[Frames, Exception | None]:
        """(frames of scene b, run alone, what stopped it)"""
        own = {name: value_of(value, b) for name, value in values.items()}
        try:
            return self.one.forward(**own), None
        except FloatingPointError as error:
            run = Run(own, contacts=self.one.sweep.workspace.watch.seen_so_far(), error=error)
            return self.one.frames_of(run), error
        except ValueError as error:
            error.args = (f"scene {b}: {error}",)
            raise

    def _last_good(self, error: Exception | None) -> int:
        """The last frame before an error."""
        return self.num_frames - 1 if error is None else max(0, getattr(error, "step", 0)) // self.save_every

    def error_alone(self, frames: BatchFrames, b: int) -> Exception:
        """What a run of scene b alone raises."""
        try:
            self.one.forward(**{name: value_of(value, b) for name, value in frames.values.items()})
        except FloatingPointError as error:
            return error
        step = int(frames.last_good[b]) * self.save_every
        return FloatingPointError(f"scene {b}: its state is not finite after step {step}, though alone it runs through")

    # ---- gradients ---------------------------------------------------------------------------------------------------

    def vjp(
        self,
        frames: BatchFrames,
        positions: ArrayLike | None = None,
        velocities: ArrayLike | None = None,
        **seeds: ArrayLike | None,
    ) -> dict[str, np.ndarray]:
        """Gradients of a loss by every wanted input, from its gradients by outputs of all scenes, (scenes, ...)."""
        instance("Batch.vjp", "frames", frames, BatchFrames, "what forward returned")
        seeds = {"positions": positions, "velocities": velocities} | seeds
        given = {name: as_numbers(f"gradient by the frames' {name}", x) for name, x in seeds.items() if x is not None}
        for name, x in given.items():
            if name not in self.outputs:
                raise ValueError(no_such("output", name, self.outputs, "this batch"))
            shape = (self.num_scenes, *self.outputs[name].shape(self.num_frames))
            if x.shape != shape:
                raise ValueError(f"gradient by the frames' {name}: expected shape {shape}, got {x.shape}")
            check_finite(name, x[frames.alive], self.save_every)
        self._warn_of_dead(frames, "gradients")
        out = (self._vjp_by_turns if frames.run is None else self._vjp_side_by_side)(frames, given)
        for name in out.keys() & frames.sets.keys():
            out[name] = gathered_scenes(out[name], frames.values[name], *frames.sets[name])
        return with_shape(out, self.one.sweep.wants_shape)

    @staticmethod
    def _warn_of_dead(frames: BatchFrames, what: str) -> None:
        dead = np.flatnonzero(~frames.alive)
        if dead.size:
            warn(f"scenes {dead.tolist()} did not come to their end: their {what} are zero")

    def _vjp_side_by_side(self, frames: BatchFrames, given: dict) -> dict[str, np.ndarray]:
        shape, alive = (self.num_scenes, *frames.positions.shape[1:]), frames.alive.copy()
        alive[list(frames.alone)] = False
        by_u, by_v, direct, by_noted = np.zeros(shape), np.zeros(shape), [], dict.fromkeys(self.sweep.noted)
        of_states = given.keys() <= {"positions", "velocities"}  # which say nothing of inputs but by the states
        if of_states:
            for name, target in (("positions", by_u), ("velocities", by_v)):
                if name in given:
                    target[alive] = given[name][alive]
        for b in () if of_states else np.flatnonzero(alive):
            change = self.one.pulled_to_frames(frames[b], {name: x[b] for name, x in given.items()})
            direct.append((b, change.inputs))
            for name in by_noted:
                if (part := getattr(change, name)) is not None:
                    if by_noted[name] is None:
                        by_noted[name] = np.zeros((self.num_scenes, *part.shape))
                    by_noted[name][b] = part
            for target, part in ((by_u, change.positions), (by_v, change.velocities)):
                if part is not None:
                    target[b] = part
        derived = self.sweep.pull_back(frames.run, HostSeed(by_u, by_v, by_noted))
        alone = {*frames.alone, *self.sweep.left}  # the second: whose linear solve did not come to its end
        alive[list(alone)] = False
        for part in derived.parts().values():
            if part is not None:
                part[~alive] = 0  # they have left no trace in others
        direct = [(b, by_inputs) for b, by_inputs in direct if b not in alone]
        out = self._by_inputs(frames, derived.mapped(np.asarray), direct)
        for b in sorted(alone.intersection(np.flatnonzero(frames.alive).tolist())):
            by_one = self.one.vjp(frames[b], **{name: x[b] for name, x in given.items()})
            for name in self.wanted:
                target = out[name] = np.array(out[name])
                target[b if isinstance(frames.values[name], Own) else ...] += by_one[name]
        return out

    def _by_inputs(self, frames: BatchFrames, adjoint: Derived, direct: list) -> dict[str, np.ndarray]:
        """Gradients by the wanted inputs; what meets no number that scenes have of their own is summed over them first."""
        inputs, values, wanted = self.scene.inputs, frames.values, self.wanted
        own = tuple(name for name, x in values.items() if isinstance(x, Own))
        alike = {name for name in wanted if name not in own and not inputs.chain.meets(name, own)}
        each = tuple(name for name in wanted if name not in alike)
        out = dict.fromkeys(wanted)
        if alike:
            total = adjoint.mapped(lambda x: x.sum(0))
            out |= inputs.derive_vjp(self.sweep.values_of(values, 0), total, tuple(n for n in wanted if n in alike))
        if each:
            of_each = (adjoint.mapped(lambda x, b=b: x[b]) for b in range(self.num_scenes))
            rows = [inputs.derive_vjp(self.sweep.values_of(values, b), own, each) for b, own in enumerate(of_each)]
            out |= self._joined(values, rows, each)
        for b, by_inputs in direct:
            for name in set(by_inputs).intersection(wanted):
                out[name] = np.array(out[name])
                out[name][b if name in own else ...] += by_inputs[name]
        return out

    def _vjp_by_turns(self, frames: BatchFrames, given: dict) -> dict[str, np.ndarray]:
        rows = []
        for b, alive in enumerate(frames.alive):
            zero = {name: np.zeros_like(value_of(frames.values[name], b)) for name in self.wanted}
            seeds = {name: x[b] for name, x in given.items()}
            rows.append(self.one.vjp(frames[b], **seeds) if alive else zero)
        return self._joined(frames.values, rows, self.wanted)

    def _joined(self, values: dict, rows: list[dict], names: Iterable[str]) -> dict[str, np.ndarray]:
        """Those of each scene where it had a value of its own, else their sum in the order of scenes."""
        gradients = {name: [row[name] for row in rows] for name in names}
        return {n: np.stack(x) if isinstance(values[n], Own) else sum(x[1:], x[0]) for n, x in gradients.items()}

    # ---- tangents ----------------------------------------------------------------------------------------------------

    def tangents(self, frames: BatchFrames, **tangents: InputValue) -> dict[str, np.ndarray]:
        """Changes of all outputs, (scenes, ...), for changes of inputs, to first order, float64; zero, with a warning, of
        scenes that did not come to their end."""
        tangents = spread_change(tangents)
        unknown = [name for name in tangents if name not in self.inputs]
        if unknown:
            raise ValueError(f"tangents: {self.scene.inputs.no_input(unknown[0], 'this batch', self.inputs)}")
        instance("Batch.tangents", "frames", frames, BatchFrames, "what forward returned")
        zero = {name: np.zeros_like(value_of(frames.values[name], 0)) for name in tangents}
        tangents, _ = spread_given(self.scene, tangents, zero, self.num_scenes)
        own = [
            {name: change_of(name, x, frames.values[name], b, self.num_scenes) for name, x in tangents.items()}
            for b in range(self.num_scenes)
        ]
        self._warn_of_dead(frames, "changes")
        out = {name: np.zeros((self.num_scenes, *x.shape(self.num_frames))) for name, x in self.outputs.items()}
        if self.lanes and self.solver.explicit:
            inputs = self.scene.inputs
            derived = [inputs.derive_jvp(frames[b].inputs, own[b]) for b in range(self.num_scenes)]
            du, dv = self.sweep.push_forward(frames.run, derived)
            noted = self.sweep.noted_changes
        by_one = not self.lanes or not self.solver.explicit
        for b in np.flatnonzero(frames.alive):
            changes = self.one.tangents(frames[b], **own[b]) if by_one else None
            if not by_one:
                change = Change(du[b], dv[b], own[b], **{n: x[b] for n, x in noted.items()})
                changes = self.one.changes_of(frames[b], change)
            for name, change in changes.items():
                out[name][b] = change
        return out

    # ---- under ti.ad.Tape --------------------------------------------------------------------------------------------

    def field(self, name: InputName, shared: bool = False):
        """The Taichi field of an input or of an output ("positions", "velocities", ...), with .grad, as of `Rollout.field`.

        Fields of outputs have shape (scenes, frames, num_vertices), and (runs, scenes, ...) in a Batch of several `runs`;
        those of inputs have the axis of scenes in front, or are `shared` by all, whose .grad is then the sum over scenes.
        Raises ValueError for a field that is already there in the other way.
        """
        return self.tape_face.field(name, shared)

    @property
    def positions(self):
        """Taichi field of the frames' positions [m], (scenes, frames, num_vertices) of 3-vectors, with .grad."""
        return self.field("positions")

    @property
    def velocities(self):
        """Taichi field of the frames' velocities [m/s], (scenes, frames, num_vertices) of 3-vectors, with .grad."""
        return self.field("velocities")

    def run(self, k: int | None = None) -> None:
        """Run all scenes from the input fields and fill those of outputs, also in a `ti.ad.Tape`, as `Rollout.run` does.

        `frames` are then those of this run, which say what is `alive`; `gradients` has sums over the runs of a tape, those
        by named sets under their fields' names, "youngs_modulus[soft]".
        """
        self.tape_face.run(k)
