"""A batch of scenes as a node of torch's graph; all goes through the host."""

import numpy as np

from diffsim_ti.batch import Batch
from diffsim_ti.common.brief import brief
from diffsim_ti.torch_bridge.autograd import first_order_only, torch
from diffsim_ti.torch_bridge.set_tensors import as_tensors, on_host

STATES = "positions", "velocities", "displacements"


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
        out = []
        for name, tensor, need in zip(ctx.names, ctx.tensors, ctx.needs_input_grad[3:]):
            out.append(torch.tensor(gradients[name]).to(tensor.device, tensor.dtype) if need else None)
        return None, None, None, *out


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
