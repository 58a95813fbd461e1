"""3x3 tensors of numbers, where a number is a Taichi scalar or a vector of lanes, and the algebra that the laws share;
Green's strain, and symmetric tensors as six numbers.

A kernel works on one tetrahedron with scalars, or on eight at a time with lanes; laws are written once for both.
"""

import taichi as ti

from diffsim_ti.differentiation import Number, expm1_minus_x, log1p, x_minus_log1p
from diffsim_ti.runtime import at, let, traced


@traced
class Tensor:
    """Nine numbers of the kernel that is being compiled; operators give new ones. Numbers multiply from the right.

    Sums and multiples wait: what is used once, in one more of them, is part of its expression and becomes no variable. A
    kernel's compile time grows with the square of how many it has.
    """

    _data_oriented = True  # Taichi hands it on as it is

    def __init__(self, numbers, waits: bool = False):
        self._numbers, self._waits, self._used = [x if waits else let(x) for x in numbers], waits, False
        self.known = {}  # what some law has found of it, by the function's name

    @property
    def numbers(self) -> list:
        """As variables, for any number of uses."""
        if self._waits:
            self._numbers, self._waits = [let(x) for x in self._numbers], False
        return self._numbers

    @traced
    def used_once(self) -> list:
        """For one use of each; from the second on they are variables."""
        if self._waits and self._used:
            return self.numbers
        self._used = True
        return self._numbers

    def __getitem__(self, index):
        return self.numbers[3 * index[0] + index[1]]

    def __add__(self, other):
        return Tensor([a + b for a, b in zip(self.used_once(), other.used_once())], waits=True)

    def __sub__(self, other):
        return Tensor([a - b for a, b in zip(self.used_once(), other.used_once())], waits=True)

    def __mul__(self, number):
        number = _shared(number)
        return Tensor([a * number for a in self.used_once()], waits=True)

    def __matmul__(self, other):
        return Tensor(sum_of(self[i, k] * other[k, j] for k in range(3)) for i in range(3) for j in range(3))

    @traced
    def dot(self, other):
        """self @ other, for Taichi functions, where @ takes Taichi matrices only."""
        return self @ other

    @traced
    def transpose(self):
        return Tensor(self[j, i] for i in range(3) for j in range(3))

    @traced
    def trace(self):
        return let(self[0, 0] + self[1, 1] + self[2, 2])

    @traced
    def matrix(self):
        """As a Taichi matrix (scalars only)."""
        return ti.Matrix([[self[i, j] for j in range(3)] for i in range(3)])


def _shared(number):
    """For several uses."""
    return number if isinstance(number, (int, float)) else let(number)


def sum_of(terms):
    """Sum from left to right, without a leading zero."""
    first, *others = terms
    for term in others:
        first = first + term
    return first


@traced
def tensor(matrix) -> Tensor:
    """A Taichi matrix as a Tensor."""
    return Tensor(at(matrix, i, j) for i in range(3) for j in range(3))


@traced
def inner(A, B):
    """A : B"""
    return let(sum_of(a * b for a, b in zip(A.used_once(), B.used_once())))


def _cyclic():
    """(k, m, n, o) of the minor that belongs to entry (i, j); cyclic indices spare every sign."""
    return (((i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3) for i in range(3) for j in range(3))


@traced
def cofactor(A) -> Tensor:
    """cof A, so that A (cof A)^T = det(A) I; its trace is the sum of the principal 2x2 minors."""
    return Tensor(A[k, n] * A[m, o] - A[k, o] * A[m, n] for k, m, n, o in _cyclic())


@traced
def cofactor_differential(A, dA) -> Tensor:
    """d cof A for a change dA."""
    return Tensor(
        dA[k, n] * A[m, o] + A[k, n] * dA[m, o] - dA[k, o] * A[m, n] - A[k, o] * dA[m, n] for k, m, n, o in _cyclic()
    )


@traced
def add_to_diagonal(A, x) -> Tensor:
    """A + x I"""
    x = _shared(x)
    return Tensor([a + x if k % 4 == 0 else a for k, a in enumerate(A.used_once())], waits=True)


@traced
def invariants(H: Tensor) -> tuple:
    """(K, j, s) of F = I + H without cancellation: K = cof F - I, j = det F - 1, s = |F|^2 - 3 - 2 j."""
    if "invariants" not in H.known:
        H.known["invariants"] = _invariants(H)
    return H.known["invariants"]


def _invariants(H):
    C, trace = cofactor(H), H.trace()
    minors = let(C.trace() + H[0, 0] * C[0, 0] + H[0, 1] * C[0, 1] + H[0, 2] * C[0, 2])
    K = add_to_diagonal(C - H.transpose(), trace)
    return K, let(trace + minors), let(inner(H, H) - 2 * minors)


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


def isochoric(H: Tensor) -> tuple[Number, Number, Number]:
    """(J^(-2/3) I_C - 3, J - 1, log J) of F = I + H, with all digits near rest; J > 0."""
    _, j, s = invariants(H)  # s = I_C - 3 - 2 j
    log = log1p(j)
    more = expm1_minus_x(log * (-2 / 3))  # J^(-2/3) = 1 - 2/3 log J + more
    # all parts are of second order in H: nothing cancels
    return s + 2 * x_minus_log1p(j) + 3 * more + (more - log * (2 / 3)) * (s + 2 * j), j, log
