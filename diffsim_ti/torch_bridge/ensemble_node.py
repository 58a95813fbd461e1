"""A sum of losses that several processes work out, as one node of torch's graph."""

from collections.abc import Callable, Iterable

from diffsim_ti.torch_bridge.autograd import first_order_only, torch


def total_of(ensemble, function: Callable, parameters: "torch.nn.Module | Iterable[torch.Tensor]") -> torch.Tensor:
    """The sum over an Ensemble's members, in their order, of function(member)."""
    if isinstance(parameters, torch.nn.Module):
        parameters = parameters.parameters()
    parameters = [p for p in parameters if p.requires_grad]
    differentiates = torch.is_grad_enabled() and bool(parameters)

    def of_member(member):
        value = function(member)
        if not isinstance(value, torch.Tensor) or value.numel() != 1:
            raise ValueError(f"the loss of a member must be a tensor of one number, got {type(value).__name__}")
        gradients = [None] * len(parameters)
        if differentiates and value.requires_grad:
            gradients = torch.autograd.grad(value, parameters, allow_unused=True)
        numbers = [None if g is None else g.detach().cpu().numpy() for g in gradients]
        return value.detach().cpu().reshape(()).numpy(), numbers

    parts = ensemble.map(of_member)
    total, sums = torch.as_tensor(parts[0][0]), [None] * len(parameters)
    for value, _ in parts[1:]:
        total = total + torch.as_tensor(value)
    if not differentiates:
        return total
    for _, gradients in parts:
        for k, gradient in enumerate(gradients):
            if gradient is not None:
                gradient = torch.as_tensor(gradient)
                sums[k] = gradient if sums[k] is None else sums[k] + gradient
    return _Known.apply(total, sums, *parameters)


class _Known(torch.autograd.Function):
    """A number whose gradients are known."""

    @staticmethod
    def forward(ctx, total, gradients, *parameters):
        ctx.gradients, ctx.tensors = gradients, parameters
        return total.clone()

    @staticmethod
    @first_order_only("an Ensemble's loss has gradients of first order only")
    def backward(ctx, adjoint):
        sums = (
            None if g is None else (adjoint * g.to(adjoint.dtype)).to(p.device, p.dtype)
            for g, p in zip(ctx.gradients, ctx.tensors)
        )
        return None, None, *sums
