"""An obstacle at a vertex as a stage of explicit passes: Taichi functions of one obstacle, with tangents and adjoints.

`force` is the obstacle's compile-time class (obstacle_force.py), of which only the distance is used. A plane is the vector
(n, d) that its `contact_plane` gives where the pass begins. The push P is that of secant.py, for a distance that goes
from d to y = d + n . move, `move` being the vertex's displacement in the pass relative to the obstacle. Friction is that of
friction.py, with P as the normal force.
"""

import taichi as ti

from diffsim_ti.differentiation import Graph
from diffsim_ti.runtime import at, let, traced
from diffsim_ti.terms.obstacles import friction, secant
from diffsim_ti.terms.obstacles.turning import all_changes


@traced
def _vector(fp, numbers, last=0):
    return let(ti.types.vector(4, fp)(*numbers, ti.cast(last, fp)))


@ti.func
def numbers(force: ti.template(), parameters: ti.template(), first):
    """(stiffness, width, mu, friction speed)"""
    out = ti.types.vector(4, force.fp)(0)
    for k in ti.static(range(4 if force.friction else 2)):
        out[k] = parameters[first + force.index.stiffness + k]
    return out


@ti.func
def solve_linear(count: ti.template(), a, xyz, mixed, b):
    """(I + a sum K n (x) n)^-1 b; xyz and mixed are the entries of the sum of `count`, xx, yy, zz and yz, zx, xy.

    By L D L^T, or of one by Sherman and Morrison's formula.
    """
    x = 0 * b
    if ti.static(count == 1):
        x.x = xyz.x * b.x + mixed.z * b.y + mixed.y * b.z
        x.y = mixed.z * b.x + xyz.y * b.y + mixed.x * b.z
        x.z = mixed.y * b.x + mixed.x * b.y + xyz.z * b.z
        x = b - a / (1 + a * (xyz.x + xyz.y + xyz.z)) * x
    else:
        x = _solve_many(a, xyz, mixed, b)
    return x


@ti.func
def _solve_many(a, xyz, mixed, b):
    d0 = 1 + a * xyz.x
    l1, l2 = a * mixed.z / d0, a * mixed.y / d0
    d1 = 1 + a * xyz.y - l1 * a * mixed.z
    rest = a * mixed.x - l1 * a * mixed.y
    l3 = rest / d1
    d2 = 1 + a * xyz.z - l2 * a * mixed.y - l3 * rest
    y1 = b.y - l1 * b.x
    y2 = b.z - l2 * b.x - l3 * y1
    x2 = y2 / d2
    x1 = y1 / d1 - l3 * x2
    x = 0 * b
    x.x, x.y, x.z = b.x / d0 - l1 * x1 - l2 * x2, x1, x2
    return x


@traced
def _record_push(force, parameters, first, X, u, move, damping):
    """(graph, the obstacle's numbers, leaves of u, leaves of move, n, P)"""
    g, p, moved, d, n = force.record(parameters, first, X, u)
    leaves = [g.leaf(at(move, k)) for k in range(3)]
    stiffness, width = p[force.index.stiffness], p[force.index.width]
    s, t = d / width, (d + g.dot(n, leaves)) / width
    value, by_s, by_t = _three(secant.push(s.value, t.value, damping, force.fp))
    p_of = g.function(value, (s, lambda: let(-by_s)), (t, lambda: let(-by_t)))
    return g, p, moved, leaves, n, stiffness * width * p_of


@traced
def _three(values):
    return [let(value) for value in values]


@traced
def push_jvp(force, parameters, first, X, u, move, damping, parameters_dot, du, dmove):
    """Change of (n, P)"""
    g, p, moved, leaves, n, pushed = _record_push(force, parameters, first, X, u, move, damping)
    dots = all_changes(p, parameters_dot, first, (moved, du), (leaves, dmove))
    *dn, dp = g.forward(dots, [*n, pushed])
    return _vector(force.fp, dn, dp)


@traced
def push_vjp(force, parameters, first, X, u, move, damping, n_adj, push_adj):
    """(adjoints of u and move as vectors, those of the obstacle's numbers as a tuple) for those of n and P."""
    g, p, moved, leaves, n, pushed = _record_push(force, parameters, first, X, u, move, damping)
    seeds = [(k, let(at(n_adj, d))) for d, k in enumerate(n)] + [(pushed, push_adj)]
    adjoints, count = g.reverse(seeds, [*moved, *leaves, *p]), len(moved)
    of_place = let(ti.types.vector(6, force.fp)(*adjoints[:6])) if count == 6 else _vector(force.fp, adjoints[:3])
    return of_place, _vector(force.fp, adjoints[count : count + 3]), (*adjoints[count + 3 :], *force.rows_of(p))


# ---- friction, for a plane and a push that are known -------------------------------------------------------------------


@traced
def _record_slide(fp, plane, push, v, v_obstacle, ratio, mu, eps):
    """(graph, leaves: n, P, v, wall, ratio, mu, eps, and the velocity after it)"""
    g = Graph(fp)
    n, before, obstacle = ([g.leaf(at(x, d)) for d in range(3)] for x in (plane, v, v_obstacle))
    pushed, ratio, mu, eps = (g.leaf(x) for x in (push, ratio, mu, eps))
    after = friction.slide(g, n, pushed, before, obstacle, ratio, mu, eps)
    return g, [*n, pushed, *before, *obstacle, ratio, mu, eps], after


@traced
def slide(fp, plane, push, v, v_obstacle, ratio, mu, eps):
    """Velocity after friction; ratio: h / m [s/kg]."""
    return _vector(fp, [k.value for k in _record_slide(fp, plane, push, v, v_obstacle, ratio, mu, eps)[-1]])


@traced
def slide_jvp(fp, plane, push, v, v_obstacle, ratio, mu, eps, dplane, dv, dv_obstacle, dratio, dmu, deps):
    """Its change; dplane: that of (n, P)."""
    g, leaves, after = _record_slide(fp, plane, push, v, v_obstacle, ratio, mu, eps)
    vectors = [at(x, d) for x, size in ((dplane, 4), (dv, 3), (dv_obstacle, 3)) for d in range(size)]
    return _vector(fp, g.forward(list(zip(leaves, [*vectors, dratio, dmu, deps])), after))


@traced
def slide_vjp(fp, plane, push, v, v_obstacle, ratio, mu, eps, w):
    """(adjoints of (n, P), v, wall as vectors, of ratio, mu, eps) for that of the velocity after it."""
    g, leaves, after = _record_slide(fp, plane, push, v, v_obstacle, ratio, mu, eps)
    x = g.reverse([(k, let(at(w, d))) for d, k in enumerate(after)], leaves)
    return (_vector(fp, x[:3], x[3]), _vector(fp, x[4:7]), _vector(fp, x[7:10]), *x[10:])
