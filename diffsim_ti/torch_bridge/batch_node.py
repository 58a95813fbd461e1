"""A batch of scenes as a node of torch's graph; all goes through the host."""

from collections.abc import Mapping

import numpy as np

from diffsim_ti.batch import Batch
from diffsim_ti.common.checked import numbers
from diffsim_ti.torch_bridge.autograd import first_order_only, torch
from diffsim_ti.torch_bridge.set_tensors import spread_tensors

STATES = "positions", "velocities", "displacements"


class TorchBatchFrames(dict):
    """Outputs of all scenes by name, tensors (scenes, ...): "positions", "velocities", "displacements" and the batch's own.

    alive: (scenes,), whether each came to its end; the gradient of one that did not is zero.
    """

    def __init__(self, outputs: dict, alive: np.ndarray):
        super().__init__(outputs)
        self.alive = torch.from_numpy(alive.copy())

    positions, velocities, displacements = (property(lambda self, name=name: self[name]) for name in STATES)


class _BatchNode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, batch: Batch, names: tuple, kept: list, *tensors):
        values = {}
        for name, tensor in zip(names, tensors):
            value = tensor.detach().to("cpu", torch.promote_types(tensor.dtype, torch.float32)).numpy()
            if name == "initial_displacements":
                name, value = "initial_positions", batch.scene.inputs.values["rest_positions"] + value
            values[name] = value
        frames = batch.forward(**values)
        kept.append(frames.alive)
        ctx.batch, ctx.names, ctx.tensors, ctx.frames = batch, names, tensors, frames
        like = tensors[0] if tensors else torch.empty(0, dtype=torch.float64)
        return tuple(torch.from_numpy(np.array(frames[name])).to(like.device) for name in (*STATES, *frames.outputs))

    @staticmethod
    @first_order_only("take tangents of the batch, and reverse products along them")
    def backward(ctx, *adjoints):
        seeds = dict(
            zip((*STATES, *ctx.frames.outputs), (x.detach().to("cpu", torch.float64).numpy() for x in adjoints))
        )
        by_displacements = seeds.pop("displacements")
        seeds["positions"] = seeds["positions"] + by_displacements
        gradients = ctx.batch.vjp(ctx.frames, **seeds)
        if "rest_positions" in gradients:  # u = x - X
            away = by_displacements.sum(1)
            own = gradients["rest_positions"].ndim == 3
            gradients["rest_positions"] = gradients["rest_positions"] - (away if own else away.sum(0))
        gradients["initial_displacements"] = gradients.get("initial_positions")
        out = []
        for name, tensor, need in zip(ctx.names, ctx.tensors, ctx.needs_input_grad[3:]):
            out.append(torch.tensor(gradients[name]).to(tensor.device, tensor.dtype) if need else None)
        return None, None, None, *out


def batch_frames(batch: Batch, tensors: dict) -> TorchBatchFrames:
    """Run a batch with some inputs given as tensors, see `rollout_frames`."""
    if "rest_positions" in tensors and "initial_displacements" in tensors:
        raise ValueError("with rest_positions, give initial_positions: initial_displacements are those from the mesh")
    known, scenes = batch.one.values, batch.num_scenes
    tensors = {
        name: spread_tensors(batch.scene, name, known.get(name), x, scenes) if isinstance(x, Mapping) else x
        for name, x in tensors.items()
    }
    tensors = {
        name: x if isinstance(x, torch.Tensor) else torch.from_numpy(numbers(name, x)) for name, x in tensors.items()
    }
    for name, tensor in tensors.items():
        known = "initial_positions" if name == "initial_displacements" else name
        if not tensor.is_floating_point():
            raise ValueError(f"{name}: expected a floating point tensor, got {tensor.dtype}")
        if tensor.requires_grad and known in batch.inputs and known not in batch.wanted:
            raise ValueError(f"{name} requires a gradient: name it in Batch(gradients=[...]), or pass gradients='all'")
    kept = []
    outputs = _BatchNode.apply(batch, tuple(tensors), kept, *tensors.values())
    return TorchBatchFrames(dict(zip((*STATES, *batch.one.computed), outputs)), kept[0])
