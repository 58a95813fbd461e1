"""How far an optimiser may move a number: bounds that keep the way back, a step for each number, steps that are refused."""

import gc
from collections.abc import Iterator

from diffsim_ti.common.warn import warn
from diffsim_ti.torch_bridge.autograd import torch


class _Bounded(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, low, high):
        ctx.save_for_backward(x)
        ctx.range = low, high
        return x.clamp(low, high)

    @staticmethod
    def backward(ctx, grad):
        (x,), (low, high) = ctx.saved_tensors, ctx.range
        leads_out = ((x < low) & (grad > 0)) | ((x > high) & (grad < 0))  # where a step down the gradient goes
        return torch.where(leads_out, torch.zeros_like(grad), grad), None, None


def bounded(x: torch.Tensor, low: float, high: float, name: str = "") -> torch.Tensor:
    """x within [low, high]; outside it has the gradient of x itself where a descent leads back, and zero where it leads on.

    With a name, a warning says once that the range is used. A projected gradient: Bertsekas, Nonlinear Programming, 1999,
    sec. 2.3.
    """
    least, largest = map(torch.Tensor.item, x.detach().aminmax())
    if low <= least <= largest <= high:
        return x
    if name and (least < low or largest > high):
        message = f"{name} has left [{low:g}, {high:g}] and is taken at that bound; its gradient leads back"
        warn(message + ": smaller steps come from material.parameter_groups(relative=...)")
    return _Bounded.apply(x, low, high)


def _learning_rates(parameter: torch.nn.Parameter) -> Iterator[float]:
    """Of the optimisers alive that hold a parameter and normalise its gradient, whose steps are as long as their lr."""
    for holder in gc.get_referrers(parameter):
        if isinstance(holder, list):
            for group in gc.get_referrers(holder):
                if isinstance(group, dict) and group.get("params") is holder and "betas" in group:
                    yield float(group["lr"])


def refuse_steps(rooms: dict[str, tuple[torch.nn.Parameter, float]]) -> None:
    """Raise ValueError where the first step of Adam or one of its kind would leave the room that a number has."""
    for name, (parameter, room) in rooms.items():
        if parameter.requires_grad:
            for lr in _learning_rates(parameter):
                if lr >= room:
                    raise ValueError(
                        f"the optimiser's lr = {lr:g} moves {name} by that much in each step, and it has room for {room:g}: "
                        "pass material.parameter_groups(relative=0.05) instead of material.parameters()"
                    )
