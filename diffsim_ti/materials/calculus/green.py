"""Green's strain E = (F^T F - 1) / 2 of F = 1 + H, and symmetric tensors as six numbers."""

from diffsim_ti.materials.calculus.tensor import Tensor, add_to_diagonal
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
    return symmetric(add_to_diagonal(H, 1).transpose() @ dH, half)


@traced
def symmetric(A, half) -> Tensor:
    """(A + A^T) / 2"""
    return (A + A.transpose()) * half


@traced
def six(A) -> list:
    """A symmetric tensor's numbers, in the order of PAIRS."""
    return [A[i, j] for i, j in PAIRS]


@traced
def of_six(numbers) -> Tensor:
    """The symmetric tensor of six numbers."""
    place = {pair: k for k, pair in enumerate(PAIRS)}
    return Tensor(numbers[place[min(i, j), max(i, j)]] for i in range(3) for j in range(3))


@traced
def adjoint_of_six(A) -> list:
    """Adjoints of the six numbers, for the adjoint A of the tensor, which is symmetric."""
    return [A[i, j] if i == j else let(2 * A[i, j]) for i, j in PAIRS]


@traced
def six_adjoint(numbers, half) -> Tensor:
    """The adjoint, symmetric, of a symmetric tensor for those of its six numbers."""
    return of_six([x if i == j else let(half * x) for x, (i, j) in zip(numbers, PAIRS)])
