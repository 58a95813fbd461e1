"""A rollout between torch tensors and device arrays: start, frames and their adjoints are copied by one kernel each way.

There is no NumPy between them, and on the GPU no host. What is small (moduli, also per tetrahedron, density, the terms'
numbers, those of named sets spread over tetrahedra) is still checked and prepared on the host by `Inputs`, and its gradients
come from there.
"""

import weakref
from collections.abc import Mapping
from functools import lru_cache

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.batch.batch_inputs import own_sets
from diffsim_ti.common.checked import numbers as as_array
from diffsim_ti.outputs import Change
from diffsim_ti.rollout.run import HostSeed, Run, check_finite
from diffsim_ti.rollout.set_values import per_tetrahedron, rows_of_sets
from diffsim_ti.runtime.slots import copy_slot
from diffsim_ti.scene import Scene
from diffsim_ti.torch_bridge.autograd import torch

DTYPES = {"f32": torch.float32, "f64": torch.float64}
START = ("initial_displacements", "initial_velocities")  # what can be copied; all else goes through Inputs


@lru_cache(maxsize=None)
def _copy_kernel(way: str, serial: bool):
    """Copies two tensors (k, n, 3) "in" to two arrays of four-vectors (k, n), whose last component stays, or "out"."""
    tensors, arrays = ti.types.ndarray(ndim=3), ti.types.ndarray(ndim=2)

    @runtime.untaped
    @runtime.kernel
    def copy(p: tensors, q: tensors, u: arrays, v: arrays):
        ti.loop_config(serialize=serial)
        for k, i in ti.ndrange(p.shape[0], p.shape[1]):
            for d in ti.static(range(3)):
                if ti.static(way == "in"):
                    u[k, i][d], v[k, i][d] = p[k, i, d], q[k, i, d]
                else:
                    p[k, i, d], q[k, i, d] = u[k, i][d], v[k, i][d]

    return copy


def shares_memory() -> bool:
    """Whether torch sees the device's memory; on Vulkan the host stands between, with the same numbers."""
    return runtime.arch_name() in ("cpu", "cuda")


def is_direct(rollout, names) -> bool:
    """Whether the start of a run with these inputs, and the gradients by its frames, can be copied directly.

    Not with implicit solvers, whose adjoint is on the host; not where the start also sets what fixed vertices or the rest
    shape are measured from. The host then stands between, with the same numbers.
    """
    scene = rollout.scene
    copies = shares_memory() and rollout.solver.explicit and not len(scene.supports.partly_fixed)
    return copies and scene.motion is None and "rest_positions" not in names


class TensorStart:
    """Initial displacements and velocities as tensors of the run's own, to be put into a workspace."""

    def __init__(self, face: "TensorRollout", start: dict):
        self.face, self.start = face, {name: face.checked(name, tensor) for name, tensor in start.items()}
        self.device = next(iter(self.start.values())).device

    def __call__(self, workspace) -> None:
        given, values, pair = next(iter(self.start.values())), workspace.arrays.values, []
        for name, loaded in zip(START, (values.displacement, values.velocity)):
            pair.append(self.start[name] if name in self.start else torch.tensor(loaded).to(given).contiguous())
        self.face.copy("in", [x[None] for x in pair], (workspace.state.u, workspace.state.v))


class TensorSeed:
    """Gradients by the frames as tensors, copied on the device; see `Seed` in rollout/run.py."""

    def __init__(self, face: "TensorRollout", pair: list, with_positions: bool, noted: dict):
        self.face, self.pair, self.with_positions, self.noted = face, pair, with_positions, noted

    def put(self, adjoint, last_frame_is_state: bool) -> tuple[float, float]:
        norms = []
        for name, x in zip(("positions", "velocities"), self.pair):
            norms.append(float(x.double().norm()))
            if not np.isfinite(norms[-1]):
                check_finite(name, x.cpu().numpy(), self.face.rollout.save_every)
        adjoint.clear()
        self.face.copy("in", self.pair, adjoint.frames)
        if last_frame_is_state:
            for frames, running in zip(adjoint.frames, (adjoint.u, adjoint.v)):
                copy_slot(frames, len(self.pair[0]) - 1, running, 0)
        return tuple(norms)

    def collect(self, adjoint, truncated: bool):
        pair = self.pair
        out = tuple(torch.empty_like(x[:1]) for x in pair)
        self.face.copy("out", out, (adjoint.u, adjoint.v))
        if truncated:
            out[0].zero_(), out[1].zero_()
        self.start = tuple(x[0] for x in out)
        derived = adjoint.collect(state=self.with_positions)
        if truncated:
            derived.displacement[:], derived.velocity[:] = 0, 0
        return derived, tuple(float(x.double().norm()) for x in out)


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

    def copy(self, way: str, pair, arrays) -> None:
        """Between two tensors of shape (k, n, 3), contiguous and of the scene's precision, and two device arrays."""
        key = (way, *map(id, arrays))
        known = self._launches.get(key)
        if known is None:  # the arrays are kept, so that their ids stay theirs
            kernel = _copy_kernel(way, runtime.runs_on_cpu() and not self.rollout.solver.runs_parallel())
            if len(self._launches) > 8:  # of arrays that runs have replaced
                self._launches.pop(next(iter(self._launches)))
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

    def checked(self, name: str, tensor: torch.Tensor) -> torch.Tensor:
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

    def forward(self, tensors: dict) -> tuple[Run, torch.Tensor, torch.Tensor]:
        """(the run, displacements, velocities of its frames)."""
        sweep, direct, values, start = self.rollout.sweep, is_direct(self.rollout, tensors), {}, {}
        for name, tensor in tensors.items():
            if direct and name in START:
                start[name] = tensor
                continue
            name, value = on_host(name, tensor, self.rollout.values["rest_positions"])
            values[name] = value
        from_tensors = TensorStart(self, start) if start else None
        run = sweep.run(values, from_tensors)
        if not shares_memory():
            return run, *(torch.from_numpy(runtime.fetch(x)) for x in sweep.workspace.frames)
        device = from_tensors.device if from_tensors else torch.device("cpu")
        frames = tuple(torch.empty(self.shape, dtype=self.dtype, device=device) for _ in range(2))
        self.copy("out", frames, sweep.workspace.frames)
        return run, *frames

    def vjp(self, run: Run, by_displacements: torch.Tensor, by_velocities: torch.Tensor, *more, wanted) -> dict:
        """Gradients by the wanted inputs from those by the frames: tensors for START if direct, NumPy arrays else.

        more: those by what else the sweep notes.
        """
        rollout, adjoints = self.rollout, (by_displacements, by_velocities)
        noted = dict(zip(rollout.sweep.noted, (x.detach().to("cpu", torch.float64).numpy() for x in more)))
        direct = is_direct(rollout, wanted)
        others = [name for name in wanted if not (direct and name in START)]
        others = ["initial_positions" if name == "initial_displacements" else name for name in others]
        if direct:
            seed = TensorSeed(self, [self._ready(x) for x in adjoints], "initial_positions" in others, noted)
        else:
            seed = HostSeed(*(x.detach().to("cpu", torch.float64).numpy() for x in adjoints), noted)
            for name, x in (("positions", seed.positions), ("velocities", seed.velocities)):
                check_finite(name, x, rollout.save_every)
        derived = rollout.sweep.pull_back(run, seed)
        out = rollout.gradients = rollout.gradients_of(run, derived, Change(), others)
        if "initial_displacements" in wanted and not direct:
            out = out | {"initial_displacements": out["initial_positions"]}
        if direct:
            if len(self._fixed):
                seed.start[1][self._fixed.to(seed.start[1].device)] = 0
            out = out | dict(zip(START, seed.start))
        return out


def as_tensors(scene: Scene, values: dict, given: dict, scenes: int | None = None) -> dict[str, torch.Tensor]:
    """Inputs as tensors, those of named sets spread; scenes: as in `spread_tensors`.

    Raises ValueError for what is no floating point number, and for displacements beside another rest shape.
    """
    if "rest_positions" in given and "initial_displacements" in given:
        raise ValueError("with rest_positions, give initial_positions: initial_displacements are those from the mesh")
    out = {}
    for name, x in given.items():
        x = spread_tensors(scene, name, values.get(name), x, scenes) if isinstance(x, Mapping) else x
        out[name] = x if isinstance(x, torch.Tensor) else torch.from_numpy(as_array(name, x))
        if not out[name].is_floating_point():
            raise ValueError(f"{name}: expected a floating point tensor, got {out[name].dtype}")
    return out


def on_host(name: str, tensor: torch.Tensor, rest: np.ndarray) -> tuple[str, np.ndarray]:
    """(name of an input, its value) of a tensor; rest: places that "initial_displacements" are from."""
    value = tensor.detach().to("cpu", torch.promote_types(tensor.dtype, torch.float32)).numpy()
    return ("initial_positions", rest + value) if name == "initial_displacements" else (name, value)


def spread_tensors(
    scene: Scene, name: str, base: np.ndarray, numbers: Mapping, scenes: int | None = None
) -> torch.Tensor:
    """The values of all tetrahedra from tensors of named sets, whose gradients torch sums.

    scenes: of a batch, where numbers of sets may have that axis in front; the values have it if one has.
    """
    rows = rows_of_sets(scene, name, numbers)
    given = [x for x in numbers.values() if isinstance(x, torch.Tensor) and x.is_floating_point()]
    like = given[0] if given else torch.zeros((), dtype=torch.float64)
    numbers = {key: x if isinstance(x, torch.Tensor) else like.new_tensor(x) for key, x in numbers.items()}
    own = own_sets(scene, name, base, numbers, scenes) if scenes else ()
    out = torch.as_tensor(per_tetrahedron(scene, name, base)).to(like)
    if own:
        out = out.expand(scenes, *out.shape)
    first = 1 if own else 0  # the axis of tetrahedra
    for key, places in rows.items():
        at = torch.tensor(places.tolist(), device=out.device)
        number = numbers[key].to(out)
        number = number.unsqueeze(1) if key in own else number
        out = out.index_copy(first, at, number.expand(*out.shape[:first], len(at), *out.shape[first + 1 :]))
    return out
