"""Green's strain E = (F^T F - 1) / 2 of F = 1 + H, and symmetric tensors as six numbers."""

from diffsim_ti.materials.calculus.tensor import Tensor, add_to_diagonal, sum_of
from diffsim_ti.runtime import let, traced

PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # of a symmetric tensor
SIX = ("xx", "yy", "zz", "yz", "xz", "xy")


@traced
def green_strain(H, half) -> Tensor:
    """E; half: 1/2 in the law's precision."""
    return (H + H.transpose() + H.transpose() @ H) * half


@traced
def green_strain_differential(H, dH, half) -> Tensor:
    """sym(F^T dH)"""
    A = add_to_diagonal(H, 1).transpose() @ dH
    return (A + A.transpose()) * half


@traced
def six(A) -> list:
    """A symmetric tensor's numbers, in the order of PAIRS."""
    return [A[i, j] for i, j in PAIRS]


@traced
def hooke(e, mu, lam):
    """mu |e|^2 + lam/2 tr(e)^2 of a symmetric tensor's six numbers."""
    trace, size = sum_of(e[:3]), sum_of(x * x for x in e[:3]) + 2 * sum_of(x * x for x in e[3:])
    return mu * size + lam / 2 * trace * trace


@traced
def of_six(numbers) -> Tensor:
    """The symmetric tensor of six numbers."""
    place = {pair: k for k, pair in enumerate(PAIRS)}
    return Tensor(numbers[place[min(i, j), max(i, j)]] for i in range(3) for j in range(3))


@traced
def six_adjoint(numbers, half) -> Tensor:
    """The adjoint, symmetric, of a symmetric tensor for those of its six numbers."""
    return of_six([x if i == j else let(half * x) for x, (i, j) in zip(numbers, PAIRS)])
