"""Friction of an obstacle at a vertex of a body of few numbers, as an impulse in an explicit pass.

Many vertices slow the same body. With velocities v before friction and 1 / w_i a bound of vertex i's effective mass, each
takes the impulse of backward Euler (friction.py) as if it had the share of its load in the body,

    p_i = -h mu N_i g(|t_i|) t_i,    g = lost_per(|t_i|, C, eps),    C = sum_j h mu N_j w_j,

so that C is the most by which all friction of a pass may slow the body. The matrix of what impulses do to velocities is at
most the diagonal one of w_i C / (h mu N_i w_i), for C is the sum of these weights: no pass gains energy by friction.
"""

import taichi as ti

from diffsim_ti.runtime import at, let, traced
from diffsim_ti.terms.obstacles import friction
from diffsim_ti.terms.obstacles.turning import all_changes


@traced
def _record(force, parameters, first, X, u, v, v_obstacle, time, total):
    """(graph, the obstacle's numbers, leaves of u, v, wall, [time, total], h mu N, impulse)"""
    g, p, moved, d, n = force.record(parameters, first, X, u)
    before, obstacle = ([g.leaf(at(x, d)) for d in range(3)] for x in (v, v_obstacle))
    time, total, (mu, eps) = g.leaf(time), g.leaf(total), force.rough(p)
    n, push = friction.normal_force(g, n, force.push(g, p, d))
    t, speed = friction.tangential(g, n, before, obstacle)
    load = time * mu * push
    factor = 0 - load * friction.lost_per(g, speed, total, eps)
    return g, p, moved, before, obstacle, [time, total], load, [factor * x for x in t]


@traced
def load(force, parameters, first, X, u, time):
    """h mu N [N s]; time: h, on the area of the vertex where the stiffness is per area."""
    g, p, _, d, n = force.record(parameters, first, X, u)
    _, push = friction.normal_force(g, n, force.push(g, p, d))
    return let((g.leaf(time) * p[force.index.friction] * push).value)


@traced
def impulse(force, parameters, first, X, u, v, v_obstacle, time, total):
    """p; total: C [m/s]."""
    return force.vector_of([x.value for x in _record(force, parameters, first, X, u, v, v_obstacle, time, total)[-1]])


@traced
def load_jvp(force, parameters, first, X, u, time, parameters_dot, du, dtime):
    """Change of h mu N."""
    g, p, moved, d, n = force.record(parameters, first, X, u)
    _, push = friction.normal_force(g, n, force.push(g, p, d))
    time = g.leaf(time)
    dots = [(time, dtime), *all_changes(p, parameters_dot, first, (moved, du))]
    return g.forward(dots, [time * p[force.index.friction] * push])[0]


@traced
def impulse_jvp(force, parameters, first, X, u, velocities, numbers, parameters_dot, du, changes, by_numbers):
    """Change of p; velocities: v and v_obstacle, numbers: time and total, with their changes."""
    g, p, moved, *both, own, _, out = _record(force, parameters, first, X, u, *velocities, *numbers)
    dots = all_changes(p, parameters_dot, first, (moved, du), *zip(both, changes))
    return force.vector_of(g.forward([*zip(own, by_numbers), *dots], out))


@traced
def total_vjp(force, parameters, first, X, u, v, v_obstacle, time, total, w):
    """Adjoint of C for that of p."""
    g, _, _, _, _, numbers, _, out = _record(force, parameters, first, X, u, v, v_obstacle, time, total)
    return g.reverse([(k, let(at(w, d))) for d, k in enumerate(out)], numbers[1:])[0]


@traced
def vjp(force, parameters, first, X, u, v, v_obstacle, time, total, w, load_adj):
    """(adjoints of u, v and the obstacle's velocity as vectors, of time, of the obstacle's numbers, a tuple, and (p, h
    mu N) as a vector) for those of p and of h mu N."""
    g, p, moved, before, obstacle, numbers, loaded, out = _record(
        force, parameters, first, X, u, v, v_obstacle, time, total
    )
    seeds = [(loaded, load_adj), *((k, let(at(w, d))) for d, k in enumerate(out))]
    adjoints, count = g.reverse(seeds, [*moved, *before, *obstacle, numbers[0], *p]), len(moved)
    by_push = let(ti.types.vector(4, force.fp)(*(x.value for x in out), loaded.value))
    return (*force.parted(adjoints, count), adjoints[count + 6], tuple(adjoints[count + 7 :]), by_push)
