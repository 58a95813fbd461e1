"""A rollout, or a batch, as a node of torch's graph, and each further output of a rollout as another."""

from typing import NamedTuple

import numpy as np

from diffsim_ti.batch import Batch
from diffsim_ti.common.brief import brief
from diffsim_ti.common.origin import START_NEARER, warn_of_rounding
from diffsim_ti.common.public import Public
from diffsim_ti.rollout import Rollout
from diffsim_ti.rollout.set_values import spread_shape
from diffsim_ti.torch_bridge.autograd import first_order_only, refuse_transforms, torch, uncompiled
from diffsim_ti.torch_bridge.tensors import TensorRollout, as_tensors, on_host

REMEDY = "use verify.hessian_product or verify.gauss_newton_product"
STATES = "positions", "velocities", "displacements"


class _States(NamedTuple):
    positions: torch.Tensor
    velocities: torch.Tensor
    displacements: torch.Tensor


class TorchFrames(_States, metaclass=Public):
    """Saved states as tensors of shape (frames, num_vertices, 3): positions [m] (far from the origin in float64), velocities
    [m/s], displacements [m].

    `outputs` has what the Rollout was asked to compute besides, by name; `frames["name"]` gives any of them. `alive`:
    whether the run came to its end (`Rollout(..., raise_errors=False)`).
    """

    outputs: dict[str, torch.Tensor]

    def __new__(cls, positions, velocities, displacements, outputs=None, alive=True):
        frames = super().__new__(cls, positions, velocities, displacements)
        frames.outputs, frames.alive = outputs or {}, alive
        return frames

    def __repr__(self) -> str:
        return f"TorchFrames({brief(self._asdict() | self.outputs)[1:-1]})"

    def __getitem__(self, key):
        if isinstance(key, str):
            return getattr(self, key) if key in self._fields else self.outputs[key]
        return super().__getitem__(key)


class _RolloutNode(torch.autograd.Function):
    """Inputs of a rollout -> displacements and velocities of its frames, and what else its runs note; the
    gradient by the first is that by positions."""

    @staticmethod
    def forward(ctx, rollout: Rollout, names: tuple, kept: list, *tensors):
        run, *frames = rollout.torch_face.forward(dict(zip(names, tensors)))
        if rollout.computed:
            kept.append(rollout.frames_of(run))
            frames += [torch.from_numpy(getattr(kept[0], name)).to(frames[0]) for name in rollout.sweep.noted]
        ctx.run, ctx.rollout, ctx.names, ctx.tensors = run, rollout, names, tensors
        return tuple(x.to(tensors[0].device) if tensors else x for x in frames)

    @staticmethod
    @first_order_only(REMEDY)
    def backward(ctx, *adjoints):
        needed = ctx.needs_input_grad[3:]
        wanted = [n for n, need in zip(ctx.names, needed) if need]
        gradients = ctx.rollout.torch_face.vjp(ctx.run, *adjoints, wanted=wanted)
        return None, None, None, *_as_tensors(gradients, ctx.names, ctx.tensors, needed)


class _OutputNode(torch.autograd.Function):
    """Frames and inputs of a rollout -> one of its outputs, on the host."""

    @staticmethod
    def forward(ctx, rollout: Rollout, name: str, frames, names: tuple, *tensors):
        ctx.rollout, ctx.name, ctx.frames, ctx.names, ctx.tensors = rollout, name, frames, names, tensors
        dtype = torch.float64 if rollout.scene.origin.any() else tensors[0].dtype
        return torch.from_numpy(np.array(frames[name])).to(tensors[0].device, dtype)

    @staticmethod
    @first_order_only(REMEDY)
    def backward(ctx, seed):
        seeds = {ctx.name: seed.detach().to("cpu", torch.float64).numpy()}
        change = ctx.rollout.pulled_to_frames(ctx.frames, seeds)
        states = dict(positions=change.positions, velocities=change.velocities)
        gradients = states | change.noted | change.inputs
        if "initial_positions" in gradients:
            gradients["initial_displacements"] = gradients["initial_positions"]
        return None, None, None, None, *_as_tensors(gradients, ctx.names, ctx.tensors, ctx.needs_input_grad[4:])


def _as_tensors(gradients: dict, names, tensors, needed) -> list:
    out = []
    for name, tensor, need in zip(names, tensors, needed):
        value = gradients.get(name) if need else None
        if isinstance(value, np.ndarray | np.floating):
            value = torch.tensor(value)  # a copy: gradients may be read-only
        out.append(None if value is None else value.to(tensor.device, tensor.dtype))
    return out


class TorchBatchFrames(dict):
    """Outputs of all scenes by name, tensors (scenes, ...): "positions", "velocities", "displacements" and the batch's own.

    alive: (scenes,), whether each came to its end; the gradient of one that did not is zero.
    """

    def __init__(self, outputs: dict, alive: np.ndarray):
        super().__init__(outputs)
        self.alive = torch.from_numpy(alive.copy())

    def __repr__(self) -> str:
        return f"TorchBatchFrames({len(self.alive)} scenes, {brief(dict(self))[1:-1]})"

    positions, velocities, displacements = (property(lambda self, name=name: self[name]) for name in STATES)


class _BatchNode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, batch: Batch, names: tuple, kept: list, *tensors):
        rest = batch.scene.inputs.values["rest_positions"]
        frames = batch.forward(**dict(on_host(name, x, rest) for name, x in zip(names, tensors)))
        kept.append(frames.alive)
        ctx.batch, ctx.names, ctx.tensors, ctx.frames = batch, names, tensors, frames
        like = tensors[0] if tensors else torch.empty(0, dtype=torch.float64)
        return tuple(torch.from_numpy(np.array(frames[name])).to(like.device) for name in (*STATES, *frames.outputs))

    @staticmethod
    @first_order_only("take tangents of the batch, and reverse products along them")
    def backward(ctx, *adjoints):
        arrays = (x.detach().to("cpu", torch.float64).numpy() for x in adjoints)
        seeds = dict(zip((*STATES, *ctx.frames.outputs), arrays))
        by_displacements = seeds.pop("displacements")
        seeds["positions"] = seeds["positions"] + by_displacements
        gradients = ctx.batch.vjp(ctx.frames, **seeds)
        if "rest_positions" in gradients:  # u = x - X
            away = by_displacements.sum(1)
            own = gradients["rest_positions"].ndim == 3
            gradients["rest_positions"] = gradients["rest_positions"] - (away if own else away.sum(0))
        gradients["initial_displacements"] = gradients.get("initial_positions")
        return None, None, None, *_as_tensors(gradients, ctx.names, ctx.tensors, ctx.needs_input_grad[3:])


def batch_frames(batch: Batch, tensors: dict) -> TorchBatchFrames:
    """Run a batch with some inputs given as tensors, see `rollout_frames`."""
    tensors = as_tensors(batch.scene, batch.one.values, tensors, batch.num_scenes)
    for name, tensor in tensors.items():
        known = "initial_positions" if name == "initial_displacements" else name
        if tensor.requires_grad and known in batch.inputs and known not in batch.wanted:
            raise ValueError(f"{name} requires a gradient: name it in Batch(gradients=[...]), or pass gradients='all'")
    kept = []
    outputs = _BatchNode.apply(batch, tuple(tensors), kept, *tensors.values())
    return TorchBatchFrames(dict(zip((*STATES, *batch.one.computed), outputs)), kept[0])


@uncompiled
def rollout_frames(rollout: Rollout | Batch, **tensors: torch.Tensor) -> TorchFrames | TorchBatchFrames:
    """Functional interface: run a Rollout with some inputs given as tensors; one autograd node, gradients to all of them.

    Names are those of `rollout.inputs`, whose numbers per tetrahedron {named set: tensor} may give; also
    "initial_displacements" instead of "initial_positions" (which keeps its digits in float32), and "shape", which moves
    initial and rest positions together. Numbers of the scene's terms that were given as tensors, as in
    `Sphere(radius=tensor)`, are inputs by themselves. Two runs before one backward are right. Second derivatives are
    refused (see `verify.hessian_product`).

    Frames are copied between tensors and the device by one kernel, and so are, with explicit solvers, initial displacements
    and velocities and the gradients by all of these (tensors.py); all other inputs are small and go through the host, as do
    further outputs, gradients with implicit solvers, prescribed motion, rest_positions, and everything on Vulkan, whose
    memory torch cannot see.
    Raises ValueError for unknown names, wrong shapes, types that are not floating point, and tensors that require a
    gradient by density or rest_positions which the Rollout was asked not to compute.

    A `Batch` in place of the Rollout gives tensors of all its scenes. `torch.compile` breaks its graph here.
    """
    refuse_transforms(tensors.values())
    tensors = spread_shape(tensors, (rollout.one if isinstance(rollout, Batch) else rollout).values)
    if isinstance(rollout, Batch):
        return batch_frames(rollout, tensors)
    if "initial_positions" in tensors and "initial_displacements" in tensors:
        raise ValueError("initial_positions and initial_displacements are two spellings of one input: give one")
    for name, value in rollout.scene.input_tensors().items():
        tensors.setdefault(name, value.expand(rollout.values[name].shape))
    tensors = as_tensors(rollout.scene, rollout.values, tensors)
    for name, tensor in tensors.items():
        costs_extra = name in ("density", "rest_positions") and name not in rollout.wanted
        if tensor.requires_grad and costs_extra and torch.is_grad_enabled():
            raise ValueError(
                f"{name} requires a gradient, but this rollout computes {', '.join(rollout.wanted)}: name it in "
                'Rollout(gradients=[...]), or pass gradients="all"'
            )
    if rollout.torch_face is None:
        rollout.torch_face = TensorRollout(rollout)
    names, kept = tuple(tensors), []
    states, outputs = _RolloutNode.apply(rollout, names, kept, *tensors.values()), {}
    displacements, velocities = states[:2]
    for name in rollout.computed:
        around = ("positions", "velocities", *rollout.sweep.noted, *names)
        outputs[name] = _OutputNode.apply(rollout, name, kept[0], around, *states, *tensors.values())
    warn_of_rounding("displacements", displacements.detach(), rollout.scene.mesh, START_NEARER)
    like = displacements.double() if rollout.scene.origin.any() else displacements
    if "rest_positions" not in tensors:
        rest = torch.from_numpy(np.array(rollout.values["rest_positions"])).to(like)
        return TorchFrames(rest + displacements, velocities, displacements, outputs, rollout.alive)
    rest = tensors["rest_positions"].to(like)  # the reverse sweep gives the gradient of positions = rest + u
    displacements, moved = displacements + (rest.detach() - rest), rest.detach() + displacements
    return TorchFrames(moved, velocities, displacements, outputs, rollout.alive)
