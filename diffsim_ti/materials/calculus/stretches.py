"""Energies of principal stretches, with exact first and second derivatives also where stretches coincide.

E = (F^T F - I) / 2 has principal values e_i. To second order in a change of E from where it is, with the present
eigenvectors as columns of N and A = N^T E N,

    sum_i f(e_i) = sum_i f(A_ii) + sum_{i<j} f'[e_i, e_j] A_ij^2,    f'[a, b] = (f'(a) - f'(b)) / (a - b),  f''(a) for a = b

so that no eigenvector is differentiated and nothing is divided by a difference of stretches that nearly coincide.
Daleckii, Krein; Higham, Functions of Matrices, 2008, sec. 3.2, doi:10.1137/1.9780898717778.
"""

import math
from collections.abc import Callable

import taichi as ti

from diffsim_ti.differentiation import Graph, Number, log1p
from diffsim_ti.materials.calculus.eigenbasis import eigenbasis
from diffsim_ti.materials.calculus.tensor import Tensor, sum_of
from diffsim_ti.runtime import Bundle, assign, let, spread, traced, variable

# where rounding of the difference is as large as the quadrature's error, as a share of the mean of 1 + 2 e
NEAR = {ti.f64: 0.007, ti.f32: 0.1}


def sum_over_stretches(H: Tensor, f: Callable[[Number], Number]) -> Number:
    """sum_i f(l_i) over the logarithmic stretches l_i = log lambda_i of F = I + H, in the energy of an `EnergyLaw`.

    f takes and gives a Number; lambda_i^a is exp(a * l). Whatever f is, the sum has exact first and second derivatives, by
    f's own numbers too. l_i keeps its digits near rest; so do stresses if f is of second order in l and written so:
    lambda^a - 1 - a log lambda is `expm1_minus_x(a * l)`. det F must not vanish.
    """
    graph = H.numbers[0].graph
    E = (H + H.transpose() + H.transpose() @ H) * 0.5
    N = Tensor(graph.leaf(x) for x in eigenbasis([x.value for x in E.numbers], graph.fp))
    M = E @ N

    def entry(i: int, j: int) -> Number:
        return sum_of(N[k, i] * M[k, j] for k in range(3))

    def of_strain(e: Number) -> Number:
        return f(log1p(e * 2) * 0.5)

    diagonal = [entry(i, i) for i in range(3)]
    terms = [of_strain(e) for e in diagonal]
    pairs, found = ((0, 1), (0, 2), (1, 2)), []

    def curvature(pair: tuple):
        """2 f'[e_i, e_j]; those of all pairs are found together, where second derivatives ask for the first."""
        if not found:
            strains = [(e.value, graph.gradient(y, [e])[0].value) for y, e in zip(terms, diagonal)]
            found.extend(divided_differences(graph, of_strain, [[strains[k] for k in pair] for pair in pairs]))
        return 2 * found[pairs.index(pair)]

    def coupling(i: int, j: int) -> Number:
        """f'[e_i, e_j] A_ij^2 for A_ij = 0; f' is asked for only where second derivatives are."""
        x, zero = entry(i, j), graph.constant(0)
        first = graph.function(zero, (x, lambda: curvature((i, j))))
        return graph.function(zero, (x, lambda: first))

    return sum_of([*terms, *(coupling(*pair) for pair in pairs)])


def divided_differences(graph: Graph, f: Callable, pairs: list) -> list:
    """f'[a, b] for pairs of (a, f'(a)) and (b, f'(b)), principal strains: the mean of f'' between them, where they are
    close."""
    gaps = [let(a[0] - b[0]) for a, b in pairs]
    means = [let(1 + a[0] + b[0]) for a, b in pairs]
    is_far = [let(g * g > m * m * graph.constant(NEAR[graph.fp] ** 2)) for g, m in zip(gaps, means)]
    far = [(a[1] - b[1]) / ti.select(*of) for (a, b), of in zip(pairs, zip(is_far, gaps, means))]
    middles = [let((a[0] + b[0]) * graph.constant(0.5)) for a, b in pairs]
    totals = [variable(0 * gap) for gap in gaps]
    job = Bundle(
        graph=graph, f=f, middle=variable(middles[0]), gap=variable(gaps[0]), totals=totals, of=(middles, gaps)
    )
    _add_curvatures(job)
    return [let(ti.select(*of)) for of in zip(is_far, far, totals)]


@ti.func
def _add_curvatures(job: ti.template()):
    for pair, k in ti.ndrange(3, 3):  # k: a place of Gauss's rule
        for p in ti.static(range(3)):
            if pair == p:
                _take(job, p)
        mean = _curvature(job, k)
        for p in ti.static(range(3)):
            if pair == p:
                _add(job, p, mean)


@traced
def _take(job, p: int) -> None:
    for target, values in zip((job.middle, job.gap), job.of):
        assign(target, values[p])


@traced
def _add(job, p: int, value) -> None:
    assign(job.totals[p], job.totals[p] + value)


@traced
def _curvature(job, k):
    """f'' at a place of Gauss's rule, times its weight."""
    real, graph = job.graph.constant, job.graph
    weight = ti.select(k == 1, real(8 / 18), real(5 / 18))
    with graph.within():
        x = graph.leaf(let(job.middle + job.gap * (real(k - 1) * real(math.sqrt(0.15)))))
        y = job.f(x)
        for _ in range(2):
            (y,) = graph.gradient(y, [x])
        return let(spread(y.value, x.value) * weight)
