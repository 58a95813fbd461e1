"""Coulomb friction, smoothed.

In explicit solvers it is a stage of its own: velocities are slowed in closed form, so that no step is too large.

A vertex of mass m that a barrier pushes with N slides along the obstacle with speed s*. In a time h friction mu N leaves

    s + c f(s / eps) = s*,    c = h mu N / m,    f(y) = 2 y - y^2 for y < 1, 1 beyond

(Li et al. 2020, doi:10.1145/3386569.3392425, whose smoothing f is), which backward Euler gives for friction alone: a
quadratic equation for s < eps, and s = s* - c beyond, Coulomb's law exactly. So friction never pushes a vertex back, never
adds energy, and holds what Coulomb's law holds, but for a creep slower than eps = friction_speed.
"""

from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti.runtime import traced

# what a law of numbers is written in: NumPy's arrays, or numbers of kernels; a graph has the same names
ARRAYS = SimpleNamespace(sqrt=np.sqrt, minimum=np.minimum, maximum=np.maximum, select=np.where)
KERNELS = SimpleNamespace(sqrt=ti.sqrt, minimum=ti.min, maximum=ti.max, select=ti.select)


@traced
def _roots(g, speed, c, eps):
    """(a, b, c + eps - s*) with s / s* = 2 eps / (a + b) where a vertex sticks, s* = speed < eps + c."""
    left = c + eps - g.minimum(speed, eps + c)
    return (
        eps + c * 2,
        g.sqrt(eps * eps + c * left * 4),
        left,
    )  # the root of (eps + 2 c)^2 - 4 c s*, with all its digits


@traced
def lost_per(g, speed, c, eps):
    """(1 - s / s*) / c = f(s / eps) / s*, with all its digits where c is small or 0; C1 in everything. g: a graph, ARRAYS or
    KERNELS."""
    both, root, left = _roots(g, speed, c, eps)
    stuck = (2 + 4 * left / (root + eps)) / (both + root)
    return g.select(speed < eps + c, stuck, 1 / g.maximum(speed, eps + c))


def slip(speed, c, eps, g: ti.template()):
    """(f / s*, f, y, B) at y = s / eps for the speed s*; df = B (ds* - f dc - y d eps). c = 0: where s* is s.

    For NumPy's arrays, and as `slip_in_kernels` for numbers of kernels; g: ARRAYS, KERNELS.
    """
    both, root, _ = _roots(g, speed, c, eps)
    y = g.select(speed < eps + c, speed * 2 / (both + root), 1)
    return lost_per(g, speed, c, eps), y * (2 - y), y, 2 * (1 - y) / (eps + 2 * c * (1 - y))


slip_in_kernels = ti.func(slip)


def dissipated(speed, eps, m: ti.template()):
    """Integral of f(s / eps) over s, eps (y^2 - y^3 / 3) for y = s / eps < 1, s - eps / 3 beyond; m: ARRAYS, KERNELS or a
    graph."""
    low = m.minimum(speed, eps)
    return low * low / eps * (1 - low / (eps * 3)) + (speed - low)


dissipated_in_kernels = ti.func(dissipated)


def normal_force(g, n, push):
    """(unit normal, N) of a barrier's force push n: the gradient n of a sampled distance is not quite of length one, and
    what is left of a velocity without its part along n would then not lie across it."""
    size = g.sqrt(g.dot(n, n))
    return [x / size for x in n], push * size


def slide(g, n, push, v, v_obstacle, h_over_m, mu, eps):
    """Velocity after friction: push n the barrier's force, the velocities of vertex and obstacle.

    Everything is a number of the graph `g`, or a list of three.
    """
    n, push = normal_force(g, n, push)
    t, speed = tangential(g, n, v, v_obstacle)
    c = h_over_m * mu * push
    lost = c * lost_per(g, speed, c, eps)
    return [a - lost * x for a, x in zip(v, t)]


# In implicit solvers friction is a force of the pass, -mu N f(|t| / eps) t / |t|, t the tangential velocity, with N
# and the normal as they are at its beginning. It then has a potential in the displacement, as Newton's method likes it.


def tangential(g, n, v, v_obstacle):
    """(t, |t|): the part of the velocity relative to the obstacle that lies in its surface."""
    relative = [a - b for a, b in zip(v, v_obstacle)]
    towards = g.dot(relative, n)
    t = [r - towards * k for r, k in zip(relative, n)]
    return t, g.sqrt(g.dot(t, t))


def friction_force(g, n, push, v, v_obstacle, mu, eps):
    """The force of friction on a vertex."""
    t, speed = tangential(g, n, v, v_obstacle)
    factor = g.number(0) - mu * push * lost_per(g, speed, g.number(0), eps)
    return [factor * x for x in t]


def dissipation(g, n, push, v, v_obstacle, mu, eps):
    """Its potential by the velocity."""
    _, speed = tangential(g, n, v, v_obstacle)
    return mu * push * dissipated(speed, eps, g)
