"""Rollout: n steps of a solver as one differentiable operation."""

import warnings
import weakref
from dataclasses import dataclass, field

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.rollout.sweep import Sweeps
from diffsim_ti.state.watch import ContactResolution


@dataclass(eq=False)
class Frames:
    """Saved states of one run: positions [m], velocities [m/s], displacements from the rest shape [m] (which
    keep their digits in float32), each of shape (frames, num_vertices, 3), and times [s].

    `contact_resolution` says how near the body came to obstacles and how finely the steps resolve that (state/watch.py).

    `inputs` are the values that the run started from, so that its gradient can be taken whenever it is wanted.
    """

    positions: np.ndarray
    velocities: np.ndarray
    displacements: np.ndarray
    times: np.ndarray
    inputs: dict = field(repr=False)
    contact_resolution: ContactResolution | None = None


class Rollout(Sweeps):
    """n steps of a solver from given inputs, with saved frames and gradients of everything that went in.

    solver: any solver; its scene names the inputs (`rollout.inputs`): initial_positions, initial_velocities,
        the material's numbers, density, the terms' numbers, prescribed_motion, rest_positions.
    steps: number of steps of solver.dt.
    save_every: a frame every so many steps, besides the start; must divide `steps`. Default: only the end.
    checkpoint_every: keep a state every so many steps and compute the rest again in the reverse sweep.
    memory: or a budget [MB] from which a schedule is chosen (default 1000). The gradient is bitwise the same.
    gradients: names of inputs whose gradient is wanted; default all but rest_positions, which costs extra.
    clip: largest norm of the running adjoint; it is scaled back when it exceeds that (the gradient is then no gradient).
    truncate: differentiate only the last so many steps.
    health: keep a report of the adjoint's norm per step (`rollout.health`).

    Two ways to use it. With arrays: `frames = rollout.forward(youngs_modulus=...)`, then `rollout.vjp(frames, ...)`.
    In Taichi: `rollout.run()` under `ti.ad.Tape`, with fields `rollout.positions`, `rollout.velocities` (frames x
    vertices) and, for the inputs, `rollout.field(name)`; after the tape `rollout.gradients[name]` or the fields' .grad.

    Raises ValueError for inputs that do not fit, FloatingPointError if the run diverges or the adjoint is not finite.
    Griewank, Walther, Evaluating Derivatives, ch. 3 and 12, doi:10.1137/1.9780898717761.
    """

    def __init__(
        self,
        solver,
        steps: int,
        save_every: int | None = None,
        checkpoint_every: int | None = None,
        memory: float | None = None,
        gradients=None,
        clip: float | None = None,
        truncate: int | None = None,
        health: bool = False,
    ):
        super().__init__(solver, steps, save_every, checkpoint_every, memory)
        self.wanted = self._check_names(gradients)
        self._options = dict(
            save_every=self.save_every,
            checkpoint_every=checkpoint_every,
            memory=memory,
            gradients=self.wanted,
            clip=clip,
            truncate=truncate,
            health=health,
        )
        self.clip, self.truncate, self.wants_health = clip, truncate, health
        self.gradients: dict[str, np.ndarray] = {}
        self._warned = False
        self._fields, self._tape, self._taped = {}, None, None
        self.face = None  # of torch (tensors.py)

    def _check_names(self, names) -> tuple[str, ...]:
        if names is None:
            return tuple(name for name in self.inputs if name != "rest_positions")
        names = self.inputs if names == "all" else tuple([names] if isinstance(names, str) else names)
        unknown = [name for name in names if name not in self.inputs]
        if unknown:
            raise ValueError(f"gradients: no input named {unknown[0]!r}; this rollout has {', '.join(self.inputs)}")
        return names

    def twin(self, **changes) -> "Rollout":
        """The same rollout of a scene with some arguments replaced, such as precision="f64"."""
        return Rollout(self.solver.twin(self.scene.replace(**changes)), self.steps, **self._options)

    # ---- with arrays ------------------------------------------------------------------------------------------------

    def forward(self, **values) -> Frames:
        """Run from the scene's inputs, with some of them replaced, and return the saved frames."""
        own = self.values  # callers may change their arrays later: keep copies
        run = self._start({name: x if x is own.get(name) else np.array(x, np.float64) for name, x in values.items()})
        self._sweep_forward()
        u, v = (runtime.fetch(x) for x in self._workspace.frames)
        rest = run["rest_positions"]
        frames = Frames((rest + u).astype(u.dtype), v, u, self.times, run, self._workspace.watch.resolution())
        self._current = run
        return frames

    def vjp(self, frames: Frames, positions=None, velocities=None) -> dict[str, np.ndarray]:
        """Gradients of a loss by every wanted input, from its gradients by the frames' positions and velocities.

        Float64 arrays of the inputs' shapes; None for a part that the loss does not name.
        """
        if self._current is not frames.inputs:  # another run came between: bring this one back
            self._start(frames.inputs)
            self._sweep_forward()
            self._current = frames.inputs
        shape = (self.num_frames, self.scene.mesh.num_vertices, 3)
        adjoints = []
        for name, adjoint in (("positions", positions), ("velocities", velocities)):
            adjoint = np.zeros(shape) if adjoint is None else np.asarray(adjoint)
            if adjoint.shape != shape:
                raise ValueError(f"gradient by the frames' {name}: expected shape {shape}, got {adjoint.shape}")
            self.check_adjoint(name, adjoint)
            adjoints.append(adjoint)
        self._warn_if_coarse(frames.contact_resolution)
        self.gradients = self._sweep_reverse(*adjoints, self.wants_health or self.clip is not None)
        return self.gradients

    def _warn_if_coarse(self, seen: ContactResolution) -> None:
        """Once per rollout."""
        if not seen.resolved and not self._warned:
            self._warned = True
            warnings.warn(
                f"gradients through contacts may be off by more than 10 %: {seen}; take substeps of at most "
                f"{seen.advised_substep:.3g} s instead of {seen.substep:.3g} s, or a softer or wider barrier",
                stacklevel=3,
            )

    def check_adjoint(self, name: str, adjoint: np.ndarray) -> None:
        """Raise FloatingPointError naming the step at which a loss's gradient by the frames is not finite."""
        if not np.all(np.isfinite(adjoint)):
            frame = int(np.argwhere(~np.isfinite(adjoint))[0][0])
            raise FloatingPointError(
                f"the loss's gradient by {name} is not finite at step {frame * self.save_every} "
                f"(frame {frame}): look at the loss; parameters are unchanged"
            )

    def jvp(self, frames: Frames, **tangents) -> tuple[np.ndarray, np.ndarray]:
        """Changes (positions, velocities) of the frames for changes of inputs, to first order, float64."""
        unknown = [name for name in tangents if name not in self.inputs]
        if unknown:
            raise ValueError(f"jvp: no input named {unknown[0]!r}; this rollout has {', '.join(self.inputs)}")
        values = frames.inputs
        ws = self._start(values) and self._workspace
        dots = {k: np.broadcast_to(np.asarray(x, np.float64), values[k].shape) for k, x in tangents.items()}
        tangent = self.solver.tangent(ws, self.scene.inputs.derive_jvp(values, dots))
        ws.make_record(self.schedule.segment + 1)
        save = self.save_every * self.solver.substeps
        for k in range(self.schedule.num_segments):
            first, last = self.schedule.bounds(k)
            self._record(first, last)
            tangent.advance(first, last, self.num_passes, save)
            ws.restore(ws.record, last - first)
        if self.solver.last_frame_is_state:
            tangent.save_frame(self.num_frames - 1)
        self._current = None
        return tangent.collect()

    # ---- under ti.ad.Tape -------------------------------------------------------------------------------------------

    def field(self, name: str):
        """The Taichi field of an input (with .grad), or of the frames' "positions" or "velocities".

        Input fields hold the scene's values until a kernel or `from_numpy` writes others; `run` reads them.
        """
        if not self._fields:
            self._program = runtime.program()
        runtime.check_alive(self._program)
        if name not in self._fields:
            fp = runtime.PRECISIONS[self.scene.precision]
            if name in ("positions", "velocities"):
                shape, components = (self.num_frames, self.scene.mesh.num_vertices), 3
                self._fields[name] = runtime.fields.take(self, fp, shape, components)
            elif name in self.inputs:
                value = self.values[name]
                components = 3 if value.shape[-1:] == (3,) else 0
                shape = value.shape[:-1] if components else value.shape
                self._fields[name] = runtime.fields.take(self, fp, shape, components)
                self._fields[name].from_numpy(np.asarray(value, runtime.NUMPY[self.scene.precision]))
            else:
                raise ValueError(f"no input named {name!r}; this rollout has {', '.join(self.inputs)}")
        return self._fields[name]

    @property
    def positions(self):
        """Taichi field of the frames' positions [m], shape (frames, num_vertices) of 3-vectors, with .grad."""
        return self.field("positions")

    @property
    def velocities(self):
        """Taichi field of the frames' velocities [m/s], shape (frames, num_vertices) of 3-vectors, with .grad."""
        return self.field("velocities")

    @ti.ad.grad_replaced
    def run(self):
        """Run from the input fields and fill the frames; inside a `ti.ad.Tape`, the tape will call `run_vjp`."""
        tape = runtime.current_tape()
        if tape is not None and self._tape is not None and tape is self._tape():
            raise RuntimeError(
                "this rollout already ran in this tape and would overwrite its frames: make a second Rollout"
            )
        self._tape = None if tape is None else weakref.ref(tape)  # a tape holds its rollouts: no circle
        self._taped = None
        self._taped = frames = self.forward(**self._field_values())
        for name in ("positions", "velocities"):
            self.field(name).from_numpy(getattr(frames, name))

    @ti.ad.grad_for(run)
    def run_vjp(self):
        """Mirror of `run`: adds to the .grad of the input fields and sets `gradients`."""
        if self._taped is None:  # the run failed, and its error is on its way
            return
        gradients = self.vjp(self._taped, *(self.field(name).grad.to_numpy() for name in ("positions", "velocities")))
        for name in self.inputs:
            if name in self._fields and name in gradients:
                grad = self._fields[name].grad
                grad.from_numpy(np.asarray(grad.to_numpy() + gradients[name], runtime.NUMPY[self.scene.precision]))

    def _field_values(self) -> dict:
        if self._fields:
            runtime.check_alive(self._program)
        exact = {}
        for name, taichi_field in self._fields.items():
            if name in self.inputs:
                value = taichi_field.to_numpy()
                known = self.values[name].astype(value.dtype)
                exact[name] = self.values[name] if np.array_equal(value, known) else value.astype(np.float64)
        return exact


for _method, _name in ((Rollout.run, "run"), (Rollout.run_vjp, "run_vjp")):
    _method.__name__ = _name
