"""Logarithmic strain and the exponential of a symmetric tensor, with exact derivatives also where eigenvalues coincide.

In the present eigenvectors of A, the columns of N, a change X of A changes a function f of it by

    f[a_i, a_j] X_ij + sum_k f[a_i, a_k, a_j] X_ik X_kj + ...

with divided differences f[..], of which those of the logarithm and of the exponential are written without a quotient of
differences that vanish. Higham, Functions of Matrices, 2008, sec. 3.2, doi:10.1137/1.9780898717778.
"""

import taichi as ti

from diffsim_ti.differentiation import Graph, Number, exp, expm1, log1p
from diffsim_ti.differentiation.functions import BERNOULLI, expm1_values
from diffsim_ti.materials.calculus.eigenbasis import eigenbasis
from diffsim_ti.materials.calculus.tensor import Tensor, sum_of
from diffsim_ti.runtime import let

PAIRS = ((0, 1), (0, 2), (1, 2))
NEAR = {ti.f64: 0.005, ti.f32: 0.05}  # differences of principal strains below which a series has more digits


def logarithmic_strain(H: Tensor, coaxial: bool) -> tuple[Tensor, Tensor]:
    """(N, L): 1/2 log(F^T F) = N L N^T of F = I + H, N constant, L diagonal but for its derivatives, which are exact to the
    second order. coaxial: of a function of the eigenvalues alone, which spares a part of the second ones."""
    graph = H.numbers[0].graph
    E = (H + H.transpose() + H.transpose() @ H) * 0.5
    N = Tensor(graph.leaf(x) for x in eigenbasis([x.value for x in E.numbers], graph.fp))
    A = N.transpose() @ (E @ N)
    strains = [A[i, i] for i in range(3)]
    logs, zero = [log1p(e * 2) * 0.5 for e in strains], graph.constant(0)

    def of_second_order(x: Number, y: Number, curvature) -> Number:
        """curvature() x y for x = y = 0, the curvature being asked for only where second derivatives are."""
        by_x = graph.function(zero, (y, curvature))
        if x is y:
            return graph.function(zero, (x, lambda: by_x + by_x))
        return graph.function(zero, (x, lambda: by_x), (y, lambda: graph.function(zero, (x, curvature))))

    rows = [[logs[i] if i == j else None for j in range(3)] for i in range(3)]
    for i, j in PAIRS:
        k, x = 3 - i - j, A[i, j]
        ratio, slope = difference_over_sinh(logs[i] - logs[j])
        scale = exp(0 - logs[i] - logs[j])
        rows[i][j] = scale * ratio * x
        for a, sign in ((i, 1), (j, -1)):
            rows[a][a] = rows[a][a] + of_second_order(
                x, x, lambda a=a, s=sign, r=ratio, d=slope, c=scale: exp(-2 * logs[a]) * c * (s * d - r)
            )
        if not coaxial:
            rows[i][j] = rows[i][j] + of_second_order(A[i, k], A[k, j], lambda: _three(graph, strains))
    return N, Tensor(rows[min(i, j)][max(i, j)] for i in range(3) for j in range(3))


def difference_over_sinh(d: Number) -> tuple[Number, Number]:
    """(d / sinh d, its derivative), both with their digits at d = 0."""
    graph = d.graph
    if "over_sinh" in d.known:
        return d.known["over_sinh"]
    square, real = let(d.value * d.value), graph.constant
    ratio, slope = let(0 * square), let(0 * square)
    for n in range(len(BERNOULLI), 0, -1):  # d / sinh d = 1 + sum (2 - 4^n) B_2n / (2n)! d^2n
        c = (2 - 4**n) * BERNOULLI[n - 1]
        ratio, slope = let(ratio * square + real(c)), let(slope * square + real(2 * n * c))
    near = let(square < real(0.04))
    far = let(ti.select(near, 0 * square + real(1), d.value))
    m, _ = expm1_values(far, graph.fp)
    sinh = let((m + m / (m + real(1))) * real(0.5))
    quotient = let(far / sinh)
    far_slope = (real(1) - quotient * (sinh + real(1) / (m + real(1)))) / sinh
    slope = graph.leaf(let(ti.select(near, slope * d.value, far_slope)))  # no further derivative: it is multiplied by 0
    d.known["over_sinh"] = (
        graph.function(let(ti.select(near, real(1) + ratio * square, quotient)), (d, lambda: slope)),
        slope,
    )
    return d.known["over_sinh"]


def _three(graph: Graph, strains: list) -> Number:
    """f[a, b, c] of f = 1/2 log(1 + 2 e) at the principal strains; found once."""
    if "three" not in strains[0].known:
        strains[0].known["three"] = graph.leaf(_three_values([e.value for e in strains], graph))
    return strains[0].known["three"]


def _three_values(strains: list, graph: Graph):
    real = graph.constant
    mean = let(sum_of(strains) * real(1 / 3))
    x = let(1 + 2 * mean)
    a, b, c = (let((e - mean) / x) for e in strains)  # of sum zero
    # sum over n of (-1)^(n+1) 2^(n-1) / n h_(n-2), with the complete symmetric polynomials h of a, b, c
    q, r = let((a * a + b * b + c * c) * real(0.5)), let(a * b * c)
    h, total = [1.0, 0.0, q, r], real(-1.0) - 2 * q + real(16 / 5) * r
    for n in range(6, 10):
        h.append(let(q * h[-2] + r * h[-3]))
        total = total + real((-1) ** (n + 1) * 2 ** (n - 1) / n) * h[-1]
    gaps = [let((c - b) * (c - b)), let((a - c) * (a - c)), let((b - a) * (b - a))]
    first = let((gaps[0] >= gaps[1]) & (gaps[0] >= gaps[2]))  # which two lie furthest apart
    second = let(gaps[1] >= gaps[2])

    def chosen(of_first, of_second, of_third):
        return let(ti.select(first, of_first, ti.select(second, of_second, of_third)))

    middle, low, high = chosen(a, b, c), chosen(b, c, a), chosen(c, a, b)
    gap = let(high - low)
    near = let(gap * gap < real(NEAR[graph.fp] ** 2))
    slopes = [_log_slope(let(end), let(middle), graph) for end in (high, low)]
    far = (slopes[0] - slopes[1]) / ti.select(near, 0 * gap + real(1), gap)
    return let(ti.select(near, let(total), far) / (x * x))


def _log_slope(a, b, graph: Graph):
    """f[a, b] of f = 1/2 log(1 + 2 e) = u / (2 b + 1) log(1 + u) / u, u = 2 (a - b) / (1 + 2 b)."""
    from diffsim_ti.differentiation.functions import log1p_value

    real = graph.constant
    u = let(2 * (a - b) / (1 + 2 * b))
    some = let(u * u > 0)
    return let(ti.select(some, log1p_value(u) / ti.select(some, u, 0 * u + real(1)), 0 * u + real(1)) / (1 + 2 * b))


def exponential_less_one(A: Tensor, coaxial: bool) -> Tensor:
    """exp(A) - I of a symmetric tensor, with exact first derivatives. coaxial: A is diagonal but for its derivatives."""
    graph = A.numbers[0].graph
    if not coaxial:
        N = Tensor(graph.leaf(x) for x in eigenbasis([x.value for x in A.numbers], graph.fp))
        return N @ exponential_less_one(N.transpose() @ (A @ N), True) @ N.transpose()
    rows = [[expm1(A[i, i]) if i == j else None for j in range(3)] for i in range(3)]
    for i, j in PAIRS:
        d = let(A[i, i].value - A[j, j].value)
        some = let(d * d > 0)
        ratio = ti.select(some, expm1_values(d, graph.fp)[0] / ti.select(some, d, 0 * d + graph.constant(1)), 1 + 0 * d)
        rows[i][j] = graph.leaf(let((1 + rows[j][j].value) * ratio)) * A[i, j]
    return Tensor(rows[min(i, j)][max(i, j)] for i in range(3) for j in range(3))
