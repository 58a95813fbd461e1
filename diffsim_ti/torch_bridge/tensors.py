"""A rollout between torch tensors and device arrays: start, frames and their adjoints are copied by one kernel each way.

There is no NumPy between them, and on the GPU no host. What is small (moduli, also per tetrahedron, density, the terms'
numbers) is still checked and prepared on the host by `Inputs`, and its gradients come from there.
"""

import weakref
from functools import lru_cache

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.state.arrays import copy_slot
from diffsim_ti.torch_bridge.autograd import torch

DTYPES = {"f32": torch.float32, "f64": torch.float64}
START = ("initial_displacements", "initial_velocities")  # what is copied; all else goes through Inputs


@lru_cache(maxsize=None)
def _kernels(serial: bool):
    """Copies of two tensors (k, n, 3) to and from two arrays of four-vectors (k, n), whose last component stays."""

    @ti.kernel
    def copy_in(
        p: ti.types.ndarray(ndim=3),
        q: ti.types.ndarray(ndim=3),
        u: ti.types.ndarray(ndim=2),
        v: ti.types.ndarray(ndim=2),
    ):
        ti.loop_config(serialize=serial)
        for k, i in ti.ndrange(p.shape[0], p.shape[1]):
            for d in ti.static(range(3)):
                u[k, i][d] = p[k, i, d]
                v[k, i][d] = q[k, i, d]

    @ti.kernel
    def copy_out(
        p: ti.types.ndarray(ndim=3),
        q: ti.types.ndarray(ndim=3),
        u: ti.types.ndarray(ndim=2),
        v: ti.types.ndarray(ndim=2),
    ):
        ti.loop_config(serialize=serial)
        for k, i in ti.ndrange(p.shape[0], p.shape[1]):
            for d in ti.static(range(3)):
                p[k, i, d] = u[k, i][d]
                q[k, i, d] = v[k, i][d]

    return {"in": copy_in, "out": copy_out}


def is_direct(rollout, names) -> bool:
    """Whether a run with these inputs can be copied directly.

    Not with implicit solvers, which work on the host; not where the start also sets what fixed vertices or the rest shape
    are measured from; not on Vulkan, whose memory torch cannot see. The host then stands between, with the same numbers.
    """
    shared = runtime.arch_name() in ("cpu", "cuda")
    return shared and rollout.solver.explicit and rollout.scene.motion is None and "rest_positions" not in names


def checked_device(device) -> torch.device:
    """torch's device of that name; "cuda" is the card that Taichi computes on, which `runtime.use_device` sees to."""
    runtime.use_device(device)
    device = torch.device(device or "cpu")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise RuntimeError(
            f"this build of torch ({torch.__version__}) sees no card, and device={str(device)!r} puts tensors there: "
            "install torch for CUDA, or pass device='cpu' after diffsim_ti.init('cuda')"
        )
    return device


class TensorRollout:
    """Runs of one Rollout from tensors, and their gradients."""

    def __init__(self, rollout):
        self._rollout, self._launches = weakref.ref(rollout), {}  # the rollout holds this: no circle
        precision, n = rollout.scene.precision, rollout.scene.mesh.num_vertices
        self.dtype, self.shape = DTYPES[precision], (rollout.num_frames, n, 3)
        self._fixed = torch.from_numpy(np.array(rollout.scene.fixed, np.int64))

    @property
    def rollout(self):
        return self._rollout()

    def _copy(self, way: str, pair, arrays) -> None:
        """Between two tensors of shape (k, n, 3), contiguous and of the scene's precision, and two device arrays."""
        key = (way, *map(id, arrays))
        known = self._launches.get(key)
        if known is None:  # the arrays are kept, so that their ids stay theirs
            kernel = _kernels(runtime.runs_on_cpu() and not self.rollout.solver.runs_parallel())[way]
            known = self._launches[key] = (runtime.TensorLaunch(kernel, *arrays), arrays)
        if pair[0].is_cuda:  # torch and Taichi order their work on streams of their own
            torch.cuda.current_stream(pair[0].device).synchronize()
        known[0](*pair)
        if pair[0].is_cuda:
            ti.sync()

    def _ready(self, tensor: torch.Tensor) -> torch.Tensor:
        device = tensor.device if runtime.arch_name() == "cuda" else "cpu"
        runtime.use_device(device)  # a tensor on another card than Taichi's
        return tensor.detach().to(device, self.dtype).contiguous()

    def forward(self, tensors: dict) -> tuple[dict, torch.Tensor, torch.Tensor]:
        """(what `vjp` needs, displacements, velocities of the frames)."""
        rollout = self.rollout
        loaded, start, values = rollout._loaded or {}, {}, {}
        for name, tensor in tensors.items():
            if name in START:
                start[name] = self._checked(name, tensor)
            else:
                value = tensor.detach().to("cpu", torch.float64).numpy()
                known = loaded.get(name)
                same = known is not None and known.shape == value.shape and np.array_equal(known, value)
                values[name] = known if same else value.copy()  # what is loaded already need not be prepared again
        run = dict(values=values, start=start)
        self._run(run)
        device = next((t.device for t in start.values()), torch.device("cpu"))
        frames = tuple(torch.empty(self.shape, dtype=self.dtype, device=device) for _ in range(2))
        self._copy("out", frames, rollout._workspace.frames)
        return run, *frames

    def _checked(self, name: str, tensor: torch.Tensor) -> torch.Tensor:
        """A copy of the node's own: the caller may change his tensor before backward."""
        if tuple(tensor.shape) != self.shape[1:]:
            raise ValueError(f"{name}: expected shape {self.shape[1:]}, got {tuple(tensor.shape)}")
        if not torch.isfinite(tensor).all():
            bad = int((~torch.isfinite(tensor)).sum())
            raise ValueError(f"{name} must be finite: {bad} of {tensor.numel()} values are not")
        own = self._ready(tensor)
        own = own.clone() if own.data_ptr() == tensor.data_ptr() else own
        if name == "initial_velocities" and len(self._fixed):
            own[self._fixed.to(own.device)] = 0
        return own

    def _run(self, run: dict) -> None:
        rollout = self.rollout
        rollout._start(run["values"])
        state = rollout._workspace.state
        if run["start"]:
            pair = [run["start"].get(name) for name in START]
            given = next(x for x in pair if x is not None)
            missing = ("displacement", "velocity")
            pair = [
                torch.tensor(getattr(rollout._workspace.arrays.values, missing[k])).to(given) if x is None else x
                for k, x in enumerate(pair)
            ]
            self._copy("in", [x[None] for x in pair], (state.u, state.v))
        rollout._sweep_forward()
        rollout._current = run

    def vjp(self, run: dict, by_displacements: torch.Tensor, by_velocities: torch.Tensor, wanted) -> dict:
        """Gradients by the wanted inputs from those by the frames: tensors for START, NumPy arrays for the rest."""
        rollout = self.rollout
        if rollout._current is not run:  # another run came between: bring this one back
            self._run(run)
        pair = [self._ready(x) for x in (by_displacements, by_velocities)]
        rollout._warn_if_coarse(rollout._workspace.watch.resolution())
        norms = [self._norm(name, x) for name, x in zip(("positions", "velocities"), pair)]
        careful = rollout.wants_health or rollout.clip is not None
        adjoint = rollout._mirror(lambda adjoint: self._start_adjoint(adjoint, pair), careful)
        out = tuple(torch.empty((1, *self.shape[1:]), dtype=self.dtype, device=pair[0].device) for _ in range(2))
        self._copy("out", out, (adjoint.u, adjoint.v))
        if rollout.truncates:
            out[0].zero_(), out[1].zero_()
        ends = [float(x.double().norm()) for x in out]
        on_host = [name for name in wanted if name not in START]
        derived = adjoint.collect(state="initial_positions" in on_host)
        if not np.isfinite(sum(ends) + derived.coefficients.sum()):
            if careful:
                raise FloatingPointError("the adjoint is not finite at the start of the run")
            rollout._mirror(lambda adjoint: self._start_adjoint(adjoint, pair), True)  # raises where it happens
            raise FloatingPointError("the adjoint is not finite at the start of the run")
        rollout._warn_if_exploded(norms, ends)
        values = rollout.values | rollout.scene.inputs.check(run["values"])
        rollout.gradients = rollout.scene.inputs.derive_vjp(values, derived, on_host)
        velocity = out[1][0]
        if len(self._fixed):
            velocity[self._fixed.to(velocity.device)] = 0
        return rollout.gradients | dict(zip(START, (out[0][0], velocity)))

    def _start_adjoint(self, adjoint, pair) -> None:
        adjoint.clear()
        self._copy("in", pair, adjoint.frames)
        if self.rollout.solver.last_frame_is_state:
            for frames, running in zip(adjoint.frames, (adjoint.u, adjoint.v)):
                copy_slot(frames, self.shape[0] - 1, running, 0)

    def _norm(self, name: str, adjoint: torch.Tensor) -> float:
        norm = float(adjoint.double().norm())
        if not np.isfinite(norm):
            self.rollout.check_adjoint(name, adjoint.cpu().numpy())
        return norm
