"""What the modules of the PyTorch interface share: torch itself, or what to install; and a clear no to second
derivatives."""

from functools import wraps

try:
    import torch
except ImportError as error:
    raise ImportError(
        "the PyTorch interface of diffsim_ti (diff_physics, diff_simulator) needs torch, which could not be imported "
        f"({error}): pip install 'torch>=2.4,<2.14' (CPU only: add --index-url https://download.pytorch.org/whl/cpu); "
        "the rest of diffsim_ti works without it"
    ) from error


def uncompiled(function):
    """Decorate what reads tensors' numbers: torch.compile breaks its graph there, and what is called runs as it is."""

    @wraps(function)
    def called(*arguments, **named):
        if torch.compiler.is_compiling():  # asked first: `disable` would load a compiler that nobody needs
            return torch.compiler.disable(function)(*arguments, **named)
        return function(*arguments, **named)

    return called


def refuse_transforms(tensors) -> None:
    """Raise RuntimeError for tensors of torch.func's transforms, whose numbers cannot be read."""
    wrapped = getattr(getattr(torch._C, "_functorch", None), "is_functorch_wrapped_tensor", lambda tensor: False)
    if any(isinstance(tensor, torch.Tensor) and wrapped(tensor) for tensor in tensors):
        raise RuntimeError(
            "torch.func's vmap, grad and jacrev cannot differentiate a simulation: for many scenes take diffsim_ti.Batch, "
            "whose inputs have a leading axis, and for gradients tensor.backward() or torch.autograd"
        )


def refuse_state(law, where: str, remedy: str) -> None:
    """Raise ValueError for a law that remembers, where nothing says what."""
    if law.state_names:
        names = ", ".join(law.state_names)
        raise ValueError(f"{type(law).__name__} has a state ({names}) that {where} does not support: {remedy}")


class _Refusal(torch.autograd.Function):
    """The identity on a gradient; differentiating it once more raises."""

    @staticmethod
    def forward(ctx, remedy: str, gradient, *causes):
        ctx.remedy = remedy
        return gradient.clone()

    @staticmethod
    def backward(ctx, *_):
        raise RuntimeError(f"second derivatives are not available here: {ctx.remedy}")


def first_order_only(remedy: str):
    """Decorate the `backward` of an autograd.Function that keeps its inputs in `ctx.tensors`.

    Differentiating its result raises RuntimeError with the remedy, also where torch's `once_differentiable` would return
    zero in silence (a loss that is linear in the outputs).
    """

    def decorate(backward):
        def wrapped(ctx, *adjoints):
            with torch.no_grad():
                gradients = backward(ctx, *adjoints)
            causes = [x for x in (*ctx.tensors, *adjoints) if isinstance(x, torch.Tensor) and x.requires_grad]
            if not torch.is_grad_enabled() or not causes:
                return gradients
            return tuple(None if g is None else _Refusal.apply(remedy, g, *causes) for g in gradients)

        return wrapped

    return decorate
