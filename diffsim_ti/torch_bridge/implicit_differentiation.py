"""PyTorch interface: gradients through solutions of equations, and conjugate gradients. Right for any equation, not
only ours."""

from collections.abc import Callable

import numpy as np

from diffsim_ti.common.public import Public, public
from diffsim_ti.common.warn import warn
from diffsim_ti.torch_bridge.autograd import first_order_only, torch


@public
def conjugate_gradient(
    A: Callable[[torch.Tensor], torch.Tensor],
    b: torch.Tensor,
    x0: torch.Tensor | None = None,
    max_iters: int = 100,
    atol: float = 1e-6,
) -> torch.Tensor:
    """Solve A x = b for a symmetric positive definite operator given by products A(v); |b - A x| <= atol.

    Warns if it did not converge or met a direction of negative curvature. Hestenes, Stiefel 1952.
    """
    x = torch.zeros_like(b) if x0 is None else x0.clone()
    r = b - A(x)
    p, rr = r.clone(), (r * r).sum()
    for _ in range(max_iters):
        if rr.sqrt() <= atol:
            return x
        Ap = A(p)
        curvature = (p * Ap).sum()
        if curvature <= 0:
            warn(f"conjugate_gradient: A is not positive definite (p.A p = {float(curvature):.3g})")
            return x
        alpha = rr / curvature
        x, r = x + alpha * p, r - alpha * Ap
        rr, old = (r * r).sum(), rr
        p = r + (rr / old) * p
    if rr.sqrt() > atol:
        warn(
            f"conjugate_gradient did not converge: |b - A x| = {float(rr.sqrt()):.3g} > atol = {atol:g} after "
            f"{max_iters} iterations; raise max_iters or precondition"
        )
    return x


class _Implicit(torch.autograd.Function):
    """x*(params) of F(x*, params) = 0: backward solves (dF/dx)^T y = grad and returns -(dF/dp)^T y."""

    @staticmethod
    def forward(ctx, forward_fn, x_star, atol, *params):
        ctx.forward_fn, ctx.atol, ctx.tensors = forward_fn, atol, params
        ctx.save_for_backward(x_star, *params)
        return x_star.detach().clone()

    @staticmethod
    @first_order_only("differentiate the residual's equation twice by hand")
    def backward(ctx, grad):
        from scipy.sparse.linalg import LinearOperator, gmres

        size = float(grad.norm())
        if size == 0:
            return None, None, None, *(torch.zeros_like(p) if p.requires_grad else None for p in ctx.tensors)
        with torch.enable_grad():
            x, *params = ctx.saved_tensors
            x = x.detach().requires_grad_()
            residual = ctx.forward_fn(x, *params)
            n = x.numel()
            if residual.numel() != n:
                raise ValueError(f"the residual must be square: {n} unknowns, but {residual.numel()} equations")

            def transposed(v):
                # a copy: autograd may hand v itself back, and GMRES goes on writing into it
                v = torch.tensor(v, dtype=residual.dtype, device=residual.device).reshape(residual.shape)
                return torch.autograd.grad(residual, x, v, retain_graph=True)[0].double().cpu().numpy().ravel()

            rhs = grad.double().cpu().numpy().ravel() / size
            operator = LinearOperator((n, n), transposed, dtype=np.float64)
            atol = max(ctx.atol, 50 * torch.finfo(residual.dtype).eps)
            y, failed = gmres(operator, rhs, rtol=0.0, atol=atol, restart=min(n, 200), maxiter=50)
            if failed:
                raise RuntimeError(
                    f"implicit_backward: GMRES did not reach atol = {atol:g} (residual "
                    f"{np.linalg.norm(transposed(y) - rhs):.3g}): dF/dx may be singular at x_star; raise atol"
                )
            y = torch.from_numpy(size * y).to(residual).reshape(residual.shape)
            wanted = [p for p in params if p.requires_grad]
            grads = torch.autograd.grad(residual, wanted, -y, allow_unused=True) if wanted else ()
            if any(g is None for g in grads):
                raise ValueError("implicit_backward: the residual does not depend on one of params; leave that one out")
            grads = iter(grads)
        return None, None, None, *(next(grads) if p.requires_grad else None for p in params)


class ImplicitDifferentiation(metaclass=Public):
    """Gradients through a solution by the implicit function theorem: dx*/dp = -(dF/dx)^-1 dF/dp."""

    @staticmethod
    def implicit_backward(forward_fn, x_star: torch.Tensor, params, atol: float = 1e-6) -> torch.Tensor:
        """x_star with its gradients to `params` attached, for any square residual forward_fn(x, *params) = 0.

        params: a tensor or a sequence of tensors. Backward solves the transposed system, of any square shape, with exact
        Jacobian products by GMRES to atol relative to the incoming gradient (at least what the dtype resolves) and raises
        RuntimeError if it cannot. forward_fn must be pure: it runs again in backward. Second derivatives are refused.
        """
        single = isinstance(params, torch.Tensor)
        return _Implicit.apply(forward_fn, x_star, atol, *((params,) if single else tuple(params)))
