"""Functions of the numbers of a graph, for formulas written in them; + - * / and ** are Python's."""

import taichi as ti

from diffsim_ti.differentiation.graph import Number
from diffsim_ti.runtime import each_lane, let, spread, traced


def sqrt(x: Number) -> Number:
    """The root; its derivative is zero where x is."""
    return x.graph.sqrt(x)


def log(x: Number) -> Number:
    """The natural logarithm; near x = 1 `x_minus_log1p` keeps more digits."""
    return x.graph.log(x)


def exp(x: Number) -> Number:
    """e^x"""
    return x.graph.exp(x)


def where(condition, a, b) -> Number:
    """a where the condition (x > y or x < y) holds, else b; both must be finite, one of them a Number."""
    return (a if isinstance(a, Number) else b).graph.select(condition, a, b)


def maximum(a: Number, b) -> Number:
    """The larger of the two; `a` is a Number."""
    return a.graph.maximum(a, b)


def minimum(a: Number, b) -> Number:
    """The smaller of the two; `a` is a Number."""
    return a.graph.minimum(a, b)


def log1p(x: Number) -> Number:
    """log(1 + x) for x > -1, with all its digits near zero."""
    return x.graph.function(log1p_value(x.value), (x, lambda: 1 / (1 + x)))


def expm1(x: Number) -> Number:
    """e^x - 1, with all its digits near zero."""
    return _expm1_of(x)[0]


def expm1_minus_x(x: Number) -> Number:
    """e^x - 1 - x, with all its digits near zero: what energies of powers are made of."""
    return _expm1_of(x)[1]


def _expm1_of(x: Number) -> tuple[Number, Number]:
    """(e^x - 1, e^x - 1 - x), found once for each Number."""
    if "expm1" not in x.known:
        plain, less = expm1_values(x.value, x.graph.fp)
        own = x.graph.function(plain, (x, lambda: 1 + own))
        x.known["expm1"] = own, x.graph.function(less, (x, lambda: own))
    return x.known["expm1"]


def x_minus_log1p(x: Number) -> Number:
    """x - log(1 + x) for x > -1, with all its digits near zero: what logarithmic energies are made of."""
    fp = x.graph.fp
    value = each_lane(lambda one: x_minus_log1p_value(one, fp), x.value)
    return x.graph.function(value, (x, lambda: x / (1 + x)))


@ti.func
def x_minus_log1p_value(x, fp: ti.template()):
    """x - log(1 + x) with all its digits: plain subtraction loses the leading x^2 / 2, and Taichi has no log1p."""
    y = 0 * x
    if ti.abs(x) * 5 < 1:
        # log(1 + x) = 2 artanh(z) = 2 z (1 + w/3 + w^2/5 + ...); eight terms leave 1e-17 at |x| = 1/5
        z = x / (2 + x)
        w = z * z
        series = 0 * x
        for k in ti.static(range(8)):
            series = ti.cast(1 / (17 - 2 * k), fp) + w * series
        y = z * (x - 2 * w * series)
    else:
        y = x - ti.log(1 + x)
    return y


@traced
def log1p_value(x):
    """log(1 + x) with all its digits, of a number or of lanes: the rounding of 1 + x is in numerator and denominator.

    Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed. 2002, sec. 1.14.1.
    """
    u = let(1 + x)
    rounded = let(u - 1)
    exact = let(rounded * rounded > 0)
    return let(ti.select(exact, each_lane(ti.log, u) * x / ti.select(exact, rounded, u), x))


# B_2n / (2n)!, n = 1 .. 7: x / (e^x - 1) = 1 - x / 2 + sum_n B_2n / (2n)! x^2n, to 1e-17 for |x| < 1/2
BERNOULLI = (1 / 12, -1 / 720, 1 / 30240, -1 / 1209600, 1 / 47900160, -691 / 1307674368000, 1 / 74724249600)


@traced
def expm1_values(x, fp) -> tuple:
    """(e^x - 1, e^x - 1 - x) with all their digits, of a number or of lanes: plain subtraction loses x and x^2 / 2."""
    (one, half), y = (spread(let(ti.cast(c, fp)), x) for c in (1, 0.5)), let(x * x)
    series = ti.cast(BERNOULLI[-1], fp)
    for c in BERNOULLI[-2::-1]:
        series = series * y + ti.cast(c, fp)
    series = let(series)
    scale = let(x / (one - x * half + y * series))
    plain, close = let(each_lane(ti.exp, x) - one), let(y * 4 < 1)
    return let(ti.select(close, scale, plain)), let(ti.select(close, scale * x * (half - x * series), plain - x))
