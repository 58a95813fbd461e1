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
    terms, kept = [of_strain(e) for e in diagonal], {}

    def slope(i: int):
        """f'(e_i)"""
        if i not in kept:
            kept[i] = _derivative(graph, of_strain, diagonal[i].value, 1)
        return kept[i]

    def coupling(i: int, j: int) -> Number:
        """f'[e_i, e_j] A_ij^2 for A_ij = 0; f' is asked for only where second derivatives are."""
        x, zero = entry(i, j), graph.constant(0)

        def curvature():
            return 2 * divided_difference(graph, of_strain, *((diagonal[k].value, slope(k)) for k in (i, j)))

        first = graph.function(zero, (x, curvature))
        return graph.function(zero, (x, lambda: first))

    return sum_of([*terms, coupling(0, 1), coupling(0, 2), coupling(1, 2)])


def _derivative(graph: Graph, f: Callable, at, order: int):
    """A derivative of f at a value of the kernel."""
    x = graph.leaf(at)
    y = f(x)
    for _ in range(order):
        (y,) = graph.gradient(y, [x])
    return spread(y.value, at)


def divided_difference(graph: Graph, f: Callable, a: tuple, b: tuple):
    """f'[a, b] of (a, f'(a)) and (b, f'(b)), principal strains: the mean of f'' between them, where they are close."""
    gap, mean = let(a[0] - b[0]), let(1 + a[0] + b[0])
    is_far = let(gap * gap > mean * mean * graph.constant(NEAR[graph.fp] ** 2))
    far = (a[1] - b[1]) / ti.select(is_far, gap, mean)
    job = Bundle(graph=graph, f=f, middle=let((a[0] + b[0]) * graph.constant(0.5)), gap=gap, total=variable(0 * gap))
    _add_curvatures(job)
    return let(ti.select(is_far, far, job.total))


@ti.func
def _add_curvatures(job: ti.template()):
    for k in range(3):  # Gauss's rule
        _add_curvature(job, k)


@traced
def _add_curvature(job, k) -> None:
    real = job.graph.constant
    weight = ti.select(k == 1, real(8 / 18), real(5 / 18))
    at = let(job.middle + job.gap * (real(k - 1) * real(math.sqrt(0.15))))
    assign(job.total, job.total + _derivative(job.graph, job.f, at, 2) * weight)
