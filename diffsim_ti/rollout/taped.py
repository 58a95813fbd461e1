"""A rollout between Taichi kernels: its fields, and its runs as operations of a `ti.ad.Tape`."""

import weakref
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.common.checked import whole
from diffsim_ti.common.origin import warn_of_rounding
from diffsim_ti.mechanics.workspace import Workspace
from diffsim_ti.outputs import Change
from diffsim_ti.rollout import fields_on_device
from diffsim_ti.rollout.fields_on_device import STATES, field_seed
from diffsim_ti.rollout.run import Run
from diffsim_ti.rollout.set_values import gathered, per_tetrahedron, rows_of_sets, split_name, spread

if TYPE_CHECKING:
    from diffsim_ti.rollout.rollout import Rollout

START = ("initial_positions", "initial_velocities")
SPELLING = {"initial_displacements": "initial_positions"}  # less the rest positions; they keep their digits in float32


class TapeAdapter:
    """Fields of inputs and outputs of a Rollout, and which of its runs the present tape holds (of a Batch: batch/taped.py).

    Frames (but not on Vulkan) and, where nothing else depends on them, initial positions and velocities are copied on the
    device; so are, with explicit solvers, the gradients by frames. All other inputs are small: they are checked and prepared
    on the host by `Inputs`, as are the gradients by inputs, which are then added to the fields by kernels.
    """

    def __init__(self, rollout: "Rollout", runs: int | None):
        runs = runs if runs is None else whole("runs", runs)
        if runs is not None and runs < 1:
            raise ValueError(f"runs must be a whole number >= 1, or None for one run, got {runs}")
        self._rollout, self.runs = weakref.ref(rollout), runs  # the rollout holds this: no circle
        scene = rollout.scene
        self.fp, self.number = runtime.PRECISIONS[scene.precision], runtime.NUMPY[scene.precision]
        self._fields, self._constants, self._rows = {}, {}, {}
        self._tape, self._held, self._summed = None, set(), False

    @property
    def rollout(self):
        return self._rollout()

    @property
    def word(self) -> str:
        """What it is, in words."""
        return type(self.rollout).__name__.lower()

    # ---- fields -----------------------------------------------------------------------------------------------------

    def field(self, name: str):
        """See `Rollout.field`."""
        if not self._fields:
            self._program = runtime.program()
        runtime.check_alive(self._program)
        if name not in self._fields:
            rollout = self.rollout
            if name in rollout.outputs:
                shape = tuple(rollout.outputs[name].shape(rollout.num_frames))
                self._fields[name] = self._take(shape, self._output_rows())
                self._warn_if_coarse(name, "rest_positions" if name == "positions" else None)
            elif split_name(name)[1] is not None:
                self._fields[name] = self._field_of_set(name)
            elif SPELLING.get(name, name) in rollout.inputs:
                if {name, *self._fields} >= {"initial_positions", "initial_displacements"}:
                    both = "initial_positions and initial_displacements"
                    raise ValueError(f"{both} are two spellings of one input: use one")
                if {name, *self._fields} >= {"rest_positions", "initial_displacements"}:
                    reason = "displacements are those from the mesh"
                    raise ValueError(f"with rest_positions, use initial_positions: {reason}")
                self._fields[name] = self._filled(name, self._loaded(name))
                self._warn_if_coarse(name, name)
            else:
                raise ValueError(rollout.scene.inputs.no_input(name, f"this {self.word}", rollout.inputs))
        return self._fields[name]

    def _warn_if_coarse(self, name: str, of: str | None) -> None:
        """Where a field in float32 has places, those of the input `of`, far from the origin."""
        scene = self.rollout.scene
        if of in scene.inputs.described and scene.inputs.described[of].axes:
            instead = {"positions": "displacements", "initial_positions": "initial_displacements"}.get(name)
            remedy = "take precision='f64'" + (f", or the field of {instead}" if instead else "")
            value = np.asarray(self._loaded(of), self.number)
            warn_of_rounding(f"the field of {name}", value, scene.mesh, remedy)

    def _field_of_set(self, name: str):
        """The number of a named set; where the scene's differ in it, the first."""
        plain, key = split_name(name)
        rows = rows_of_sets(self.rollout.scene, plain, [*self._sets().get(plain, ()), key])[key]
        value = per_tetrahedron(self.rollout.scene, plain, self._loaded(plain))[rows[:1]].reshape(-1)
        return self._filled(name, value if value.size > 1 else value[0])

    def _sets(self) -> dict:
        """{input: {set: tetrahedra}} of the fields of named sets."""
        named = [split_name(name) for name in self._fields]
        inputs = dict.fromkeys(name for name, key in named if key is not None)
        scene = self.rollout.scene
        return {own: rows_of_sets(scene, own, [key for name, key in named if name == own and key]) for own in inputs}

    def by_sets(self, gradients: dict) -> dict:
        """Gradients by the numbers of named sets that have fields."""
        known = {name: gathered(gradients[name], rows) for name, rows in self._sets().items() if name in gradients}
        return {f"{name}[{key}]": gradient for name, of in known.items() for key, gradient in of.items()}

    def _loaded(self, name: str) -> np.ndarray:
        """The scene's value of an input."""
        values = self.rollout.values
        if name == "initial_displacements":
            return values["initial_positions"] - values["rest_positions"]
        return values[name]

    def _filled(self, name: str, value):
        """The field of an input, with its value."""
        field = self._take(np.shape(value))
        runtime.untaped(field.from_numpy)(np.asarray(value, self.number))
        return field

    def _output_rows(self) -> tuple:
        """The axes in front of an output's own."""
        return () if self.runs is None else (self.runs,)

    def _take(self, shape: tuple, rows: tuple = ()):
        components = 3 if shape[-1:] == (3,) else 0
        return runtime.fields.take(self, self.fp, (*rows, *(shape[:-1] if components else shape)), components)

    def add_gradients(self, gradients: dict) -> None:
        """Add to the .grad of the inputs' fields."""
        for name in self._fields:
            if SPELLING.get(name, name) in gradients:
                self._add(self._fields[name].grad, gradients[SPELLING.get(name, name)])

    def row(self, k: int | None, name: str) -> np.ndarray:
        """The gradient by an output of run k, in float64."""
        grad = self.field(name).grad.to_numpy().astype(np.float64)
        return grad if self.runs is None else grad[k]

    def fill_row(self, k: int | None, name: str, value: np.ndarray) -> None:
        """Put the value of an output of run k into its field."""
        if self.runs is not None:
            rows = self._rows.setdefault(name, np.zeros((self.runs, *value.shape), self.number))
            rows[k] = value
            value = rows
        self.field(name).from_numpy(np.asarray(value, self.number))

    def _add(self, grad, gradient: np.ndarray) -> None:
        gradient = np.array(gradient, self.number, order="C")
        if gradient.ndim == 0:
            grad[None] += float(gradient)
        elif gradient.shape == (3,) and grad.shape == ():
            grad.from_numpy(grad.to_numpy() + gradient)
        elif isinstance(grad, ti.MatrixField):
            fields_on_device.add_vectors(grad, gradient)
        else:
            fields_on_device.add_numbers(grad, gradient)

    # ---- runs -------------------------------------------------------------------------------------------------------

    def run(self, k: int | None) -> None:
        """See `Rollout.run`."""
        if (k is None) != (self.runs is None) or k is not None and not (int(k) == k and 0 <= k < self.runs):
            rule = f"make the {type(self.rollout).__name__} with runs=..."
            rule = rule if self.runs is None else f"give a whole number of 0 .. {self.runs - 1}"
            what = f"run({'' if k is None else k}): this {self.word}"
            raise ValueError(f"{what} has {self.runs or 'no numbered'} runs: {rule}")
        tape = runtime.current_tape()
        if tape is None or self._tape is None or self._tape() is not tape:
            self._tape, self._held = None if tape is None else weakref.ref(tape), set()
            self._summed = False
        elif k in self._held:
            raise RuntimeError(
                f"{f'this {self.word}' if k is None else f'run {k}'} already ran in this tape and would overwrite its "
                f"frames: make a second {type(self.rollout).__name__}, or one with runs=... whose run(k) has frames of its "
                "own"
            )
        self._held.add(k)
        TapedRun(self.rollout, k).forward()

    def values(self) -> tuple[dict, bool]:
        """(values of inputs from their fields, whether the start is left out because it is copied on the device)."""
        rollout = self.rollout
        if self._fields:
            runtime.check_alive(self._program)
        start = [name for name in (*START, *SPELLING) if name in self._fields]
        scene = rollout.scene
        simple = scene.motion is None and not len(scene.supports.partly_fixed) and not scene.reduced
        direct = simple and "rest_positions" not in self._fields
        out = {}
        for name, field in self._fields.items():
            if SPELLING.get(name, name) in rollout.inputs and not (direct and name in start):
                value, known = field.to_numpy(), self._loaded(name)
                value = known if np.array_equal(value, known.astype(value.dtype)) else value.astype(np.float64)
                if name == "initial_displacements":
                    value = value + rollout.values["rest_positions"]
                out[SPELLING.get(name, name)] = value
        for name, rows in self._sets().items():
            if name in self._fields:
                raise ValueError(f"{name}: fields of the whole and of named sets were asked for; use one of both")
            numbers = {key: self._fields[f"{name}[{key}]"].to_numpy() for key in rows}
            out[name] = spread(rollout.scene, name, self._loaded(name), numbers, rows)
        return out, direct and bool(start)

    def set_start(self, workspace: Workspace) -> None:
        """Set the start of a workspace from the fields; what is loaded there is that of the scene."""
        fields, state = self._fields, workspace.state
        n = self.rollout.scene.mesh.num_vertices
        if "initial_positions" in fields:
            known = self._constant("initial_positions", None, lambda: self._loaded("initial_positions")[None])
            fields_on_device.take_positions(fields["initial_positions"], known, state.u)
        if "initial_displacements" in fields:
            nowhere = self._constant("nowhere", None, lambda: np.zeros(n), ti.i32)
            fields_on_device.take_vectors(fields["initial_displacements"], nowhere, state.u)
        if "initial_velocities" in fields:
            fixed = self._constant("fixed", None, lambda: np.isin(np.arange(n), self.rollout.scene.fixed), ti.i32)
            fields_on_device.take_vectors(fields["initial_velocities"], fixed, state.v)
        bad = workspace.first_bad_vertex()
        if bad is not None:
            raise ValueError(f"initial_positions and initial_velocities must be finite: those of vertex {bad} are not")

    def show(self, k: int | None, run: Run) -> None:
        """Fill the fields of outputs with those of the run that ran last."""
        frames, rest = self.rollout.sweep.workspace.frames, run.values["rest_positions"]
        if runtime.arch_name() in ("cpu", "cuda"):
            exact = self._constant("rest", rest, lambda: rest, ti.types.vector(4, ti.f64))
            fields_on_device.show_frames(*frames, exact, k or 0, *map(self.field, STATES))
        else:  # Vulkan may lack float64
            u, v = map(runtime.fetch, frames)
            for name, value in zip(STATES, (rest + u, v, u)):
                self.fill_row(k, name, value)

    def _constant(self, name: str, source, make, dtype=None):
        """A device array made once for each source."""
        if name not in self._constants or self._constants[name][0] is not source:
            array = runtime.upload(make(), dtype or ti.types.vector(4, self.fp))
            self._constants[name] = source, array
        return self._constants[name][1]

    def forward(self, k: int | None):
        """Run from the fields and fill those of the outputs; what `backward` needs of it."""
        rollout = self.rollout
        values, direct = self.values()
        run, frames = rollout.sweep.run(values, FieldStart(self) if direct else None), None
        self.show(k, run)
        if rollout.computed:
            frames = rollout.frames_of(run)
            for name in rollout.computed:
                self.fill_row(k, name, frames[name])
        return run, frames

    def backward(self, k: int | None, ran) -> dict:
        """Gradients by the inputs, from those by outputs in their fields."""
        rollout, (run, frames) = self.rollout, ran
        seeds = {name: self.row(k, name) for name in rollout.computed}
        change = rollout.pulled_to_frames(frames, {name: x for name, x in seeds.items() if x.any()})
        if "rest_positions" in rollout.wanted:  # what displacements say of it directly
            by_rest = rollout.outputs["displacements"].vjp(None, self.row(k, "displacements"))
            change.add(Change(inputs=by_rest.inputs))
        derived = rollout.sweep.pull_back(run, field_seed(self, k, change))
        gradients = rollout.gradients_of(run, derived, change)
        return gradients | self.by_sets(gradients)

    def sum_up(self, gradients: dict) -> None:
        """Add the gradients of a run to those of the other runs of this tape."""
        rollout = self.rollout
        if self._summed:
            gradients = {name: rollout.gradients[name] + gradient for name, gradient in gradients.items()}
        rollout.gradients, self._summed = gradients, True


class FieldStart:
    """The start that the fields gave to a run, also after kernels have overwritten them."""

    def __init__(self, face: TapeAdapter):
        self.face, self._kept = face, None

    def __call__(self, workspace) -> None:
        if self._kept is None:
            self.face.set_start(workspace)
            self._kept = workspace.history(1)
            workspace.save(self._kept, 0)
        else:
            workspace.restore(self._kept, 0)


class TapedRun:
    """One run of a rollout in a tape, which holds it: it owns what its backward needs.

    `forward` and `backward` are the package's one pair for `ti.ad.grad_replaced`: such pairs must not nest.
    """

    def __init__(self, rollout: "Rollout", k: int | None):
        self.rollout, self.face, self.k = rollout, rollout.tape_face, k
        self.ran = None

    @ti.ad.grad_replaced
    def forward(self):
        self.ran = self.face.forward(self.k)

    @ti.ad.grad_for(forward)
    def backward(self):
        """Adds to the .grad of the input fields and sets the rollout's `gradients`."""
        if self.ran is None:  # the run failed, and its error is on its way
            return
        gradients = self.face.backward(self.k, self.ran)
        self.face.add_gradients(gradients)
        self.face.sum_up(gradients)
