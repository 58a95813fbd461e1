"""How a rigid body moves in a pass, from sums over its vertices: a formula in numbers of a graph, and the rotation it takes.

A body is x = c + R y with y and J = sum m y y^T as state/bodies.py has them, and R - 1 the gradient of its displacements by
y. Its vertices would go with a velocity of gradient G by y; what of that is a spin omega, in the body's own axes, is

    I omega = L = ax(R^T G J),    I = tr J - J,    ax(A)_a = e_abc A_cb.

The pass is the discrete rigid body of Moser and Veselov, which is SHAKE: the new rotation R F is that for which the momentum
sum m R y x (R F y) / alpha is the old one. With F = 1 + 2 ([f]x + [f]x^2) / (1 + f^2), f = tan(angle / 2) times the axis,

    I f + f x I f = (1 + f^2) alpha L / 2.

R is taken from the displacements with one step of Newton's method to a rotation, so that what rounding adds is lost again.
Moser, Veselov 1991, doi:10.1007/BF02352494; McLachlan, Zanna 2005, The discrete Moser-Veselov algorithm for the free rigid
body, revisited, doi:10.1007/s10208-004-0118-6.
"""

import taichi as ti

from diffsim_ti.differentiation import Graph
from diffsim_ti.runtime import at, let, traced
from diffsim_ti.state.bodies import PAIRS

VECTOR = ti.types.vector(4, ti.f64)


@traced
def vectors(numbers) -> list:
    """Columns, vectors of four components, of three numbers each."""
    zero = ti.cast(0, ti.f64)
    return [let(VECTOR(*numbers[3 * k : 3 * k + 3], zero)) for k in range(len(numbers) // 3)]


@traced
def _leaves(g, columns) -> list:
    """Numbers [k][d] of columns k."""
    return [[g.leaf(let(at(column, d))) for d in range(3)] for column in columns]


def _symmetric(numbers) -> list:
    out = [[None] * 3 for _ in range(3)]
    for (a, b), x in zip(PAIRS, numbers):
        out[a][b] = out[b][a] = x
    return out


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a, b) -> list:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _times(M, a) -> list:
    """M a, of rows."""
    return [_dot(row, a) for row in M]


def _rotation(gradient) -> list:
    """Rows of R, from the columns of the gradient of the displacement."""
    near = [[gradient[k][d] + int(d == k) for k in range(3)] for d in range(3)]
    columns = [[near[d][k] for d in range(3)] for k in range(3)]
    half = [[1.5 * int(k == m) - 0.5 * _dot(columns[k], columns[m]) for m in range(3)] for k in range(3)]
    return [[_dot(near[d], half[k]) for k in range(3)] for d in range(3)]


def _momentum(R, gradient, J) -> list:
    """L in the body's axes, of the columns of a velocity's gradient."""
    own = [[R[0][a] * column[0] + R[1][a] * column[1] + R[2][a] * column[2] for column in gradient] for a in range(3)]
    HJ = [[_dot(own[a], J[c]) for c in range(3)] for a in range(3)]
    return [HJ[2][1] - HJ[1][2], HJ[0][2] - HJ[2][0], HJ[1][0] - HJ[0][1]]


def _inertia(J) -> list:
    trace = J[0][0] + J[1][1] + J[2][2]
    return [[trace - J[a][a] if a == b else 0 - J[a][b] for b in range(3)] for a in range(3)]


def _inverse(M) -> list:
    """Of rows."""
    rows = [_cross(M[1], M[2]), _cross(M[2], M[0]), _cross(M[0], M[1])]  # columns of the inverse, times the determinant
    scale = 1 / _dot(M[0], rows[0])
    return [[rows[k][d] * scale for k in range(3)] for d in range(3)]


def _columns(R, own) -> list:
    """R K of the columns of K, one after the other."""
    return [x for column in own for x in _times(R, column)]


class Record:
    """A graph with its leaves; `results` are columns, one after the other."""

    _data_oriented = True

    def __init__(self, graph, leaves, results):
        self.graph, self.leaves, self.results = graph, leaves, results

    def values(self) -> list:
        return vectors([x.value for x in self.results])

    def changes(self, dots) -> list:
        """Changes of the results for those of the leaves, a list of the same length."""
        return vectors(self.graph.forward(list(zip(self.leaves, dots)), self.results))

    def adjoints(self, columns) -> list:
        """Adjoints of the leaves for those of the results, columns."""
        seeds = [let(at(column, d)) for column in columns for d in range(3)]
        return self.graph.reverse(list(zip(self.results, seeds)), self.leaves)


@traced
def spun(displaced, moving, J):
    """The velocity of a rigid body, three columns of its gradient, that is nearest to one of gradient `moving`; `displaced`:
    the gradient of its displacement; J: six numbers. Leaves: displaced, moving, J."""
    g = Graph(ti.f64)
    U, G, J = _leaves(g, displaced), _leaves(g, moving), [g.leaf(x) for x in J]
    full = _symmetric(J)
    R = _rotation(U)
    omega = _times(_inverse(_inertia(full)), _momentum(R, G, full))
    columns = [_cross(omega, [int(k == m) for m in range(3)]) for k in range(3)]
    columns = [[g.number(x) for x in column] for column in columns]
    return Record(g, [*sum(U, []), *sum(G, []), *J], _columns(R, columns))


@traced
def turned(displaced, moving, J, alpha, decay):
    """The same of a pass of the way alpha: gradients of the displacement and of the velocity after it, six columns.
    Leaves: displaced, moving, J, alpha, decay."""
    g = Graph(ti.f64)
    U, G, J = _leaves(g, displaced), _leaves(g, moving), [g.leaf(x) for x in J]
    alpha, decay = g.leaf(alpha), g.leaf(decay)
    full = _symmetric(J)
    R, I = _rotation(U), _inertia(full)
    a = [alpha * x for x in _momentum(R, G, full)]
    f = _half_turn(g, I, a)
    scale = 2 / (1 + _dot(f, f))
    K = [[scale * (x + f[k] * f[d] - _dot(f, f) * int(k == d)) for d, x in enumerate(_spin(f, k))] for k in range(3)]
    RK = _columns(R, K)
    gained = decay / alpha
    after = [R[d][k] - int(d == k) + RK[3 * k + d] for k in range(3) for d in range(3)]
    return Record(g, [*sum(U, []), *sum(G, []), *J, alpha, decay], [*after, *(gained * x for x in RK)])


def _spin(f, k) -> list:
    """Column k of [f]x."""
    zero = f[0] * 0
    return [[zero, f[2], -f[1]], [-f[2], zero, f[0]], [f[1], -f[0], zero]][k]


def _half_turn(g, I, a) -> list:
    """f as numbers, whose derivatives are those of the equation that they solve."""
    values = [[I[r][c].value for c in range(3)] for r in range(3)]
    found = half_turn(*vectors([x for row in values for x in row]), vectors([x.value for x in a])[0])
    f = [let(at(found, d)) for d in range(3)]
    at_f = [g.leaf(x) for x in f]
    If = _times(I, at_f)
    both = 1 + _dot(at_f, at_f)
    left = [x + y - 0.5 * both * z for x, y, z in zip(If, _cross(at_f, If), a)]
    slope = _inverse(_slope(values, f, [x.value for x in If], [x.value for x in a]))
    slope = [[let(x) for x in row] for row in slope]
    return [g.function(f[d], *((left[e], lambda d=d, e=e: let(-slope[d][e])) for e in range(3))) for d in range(3)]


def _slope(I, f, If, a) -> list:
    """Rows of the derivative by f of I f + f x I f - (1 + f^2) a / 2."""
    columns = [_cross(f, [I[r][c] for r in range(3)]) for c in range(3)]
    turned_ = [[0 * If[0], -If[2], If[1]], [If[2], 0 * If[0], -If[0]], [-If[1], If[0], 0 * If[0]]]
    return [[I[r][c] + columns[c][r] - turned_[r][c] - a[r] * f[c] for c in range(3)] for r in range(3)]


@ti.func
def half_turn(I0, I1, I2, a):
    """f by Newton's method, from rows of I; not a number where a substep would turn the body by more than about a radian."""
    f = 0 * a
    near, found = 0, 0
    for _ in range(30):
        if found == 0:
            If = _product(I0, I1, I2, f)
            left = If + _across(f, If) - 0.5 * (1 + f.dot(f)) * a
            f += _newton(I0, I1, I2, f, If, a, left)
            found = near
            near = int(left.dot(left) <= 1e-20 * a.dot(a))  # the next one ends at round-off
    if found == 0 or not f.dot(f) < 1:
        f = f * ti.math.nan
    return f


@ti.func
def _product(I0, I1, I2, f):
    return VECTOR(I0.dot(f), I1.dot(f), I2.dot(f), 0)


@ti.func
def _across(a, b):
    return VECTOR(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x, 0)


@traced
def _newton(I0, I1, I2, f, If, a, left):
    """The change of f."""
    I = [[at(row, c) for c in range(3)] for row in (I0, I1, I2)]
    parts = [[let(at(x, d)) for d in range(3)] for x in (f, If, a, left)]
    back = _inverse(_slope(I, *parts[:3]))
    return vectors([let(-x) for x in _times(back, parts[3])])[0]
