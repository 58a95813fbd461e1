"""Coulomb friction, smoothed.

In explicit solvers it is a stage of its own: velocities are slowed in closed form, so that no step is too large.

A vertex of mass m that a barrier pushes with N slides along the obstacle with speed s*. In a time h friction mu N leaves

    s + c f(s / eps) = s*,    c = h mu N / m,    f(y) = 2 y - y^2 for y < 1, 1 beyond

(Li et al. 2020, doi:10.1145/3386569.3392425, whose smoothing f is), which backward Euler gives for friction alone: a
quadratic equation for s < eps, and s = s* - c beyond, Coulomb's law exactly. So friction never pushes a vertex back, never
adds energy, and holds what Coulomb's law holds, but for a creep slower than eps = friction_speed.
"""


def keeps(g, speed, c, eps):
    """s / s*, the share of the speed s* that is left; C1 in everything."""
    sticks = speed.value < eps.value + c.value
    inside = g.minimum(speed, eps + c)  # where the root is real
    both = eps + c * 2
    stuck = eps * 2 / (both + g.sqrt(both * both - c * inside * 4))
    outside = g.maximum(speed, eps + c)
    sliding = g.number(1) - c / outside
    return g.select(sticks, stuck, sliding)


def lost_per(g, speed, c, eps):
    """(1 - keeps) / c, with all its digits where c is small; tends to f(s / eps) / s."""
    sticks = speed.value < eps.value + c.value
    inside = g.minimum(speed, eps + c)
    both = eps + c * 2
    root = g.sqrt(both * both - c * inside * 4)
    stuck = (2 + 4 * (c + eps - inside) / (root + eps)) / (both + root)
    return g.select(sticks, stuck, 1 / g.maximum(speed, eps + c))


def normal_force(g, n, push):
    """(unit normal, N) of a barrier's force push n: the gradient n of a sampled distance is not quite of length one, and
    what is left of a velocity without its part along n would then not lie across it."""
    size = g.sqrt(g.dot(n, n))
    return [x / size for x in n], push * size


def slide(g, n, push, v, wall, h_over_m, mu, eps):
    """Velocity after friction: push n the barrier's force, v and wall the velocities of vertex and obstacle.

    Everything is a number of the graph `g`, or a list of three.
    """
    n, push = normal_force(g, n, push)
    t, speed = tangential(g, n, v, wall)
    lost = g.number(1) - keeps(g, speed, h_over_m * mu * push, eps)
    return [a - lost * x for a, x in zip(v, t)]


# In implicit solvers friction is a force of the pass, -mu N f(|t| / eps) t / |t|, t the tangential velocity, with N
# and the normal as they are at its beginning. It then has a potential in the displacement, as Newton's method likes it.


def tangential(g, n, v, wall):
    """(t, |t|): the part of the velocity relative to the obstacle that lies in its surface."""
    relative = [a - b for a, b in zip(v, wall)]
    towards = g.dot(relative, n)
    t = [r - towards * k for r, k in zip(relative, n)]
    return t, g.sqrt(g.dot(t, t))


def rub(g, n, push, v, wall, mu, eps):
    """The force of friction on a vertex."""
    t, speed = tangential(g, n, v, wall)
    slow = (eps * 2 - g.minimum(speed, eps)) / (eps * eps)
    share = g.select(speed.value < eps.value, slow, g.number(1) / g.maximum(speed, eps))
    factor = g.number(0) - mu * push * share
    return [factor * x for x in t]


def dissipation(g, n, push, v, wall, mu, eps):
    """Its potential by the velocity, mu N eps (y^2 - y^3 / 3) for y = |t| / eps < 1, mu N (|t| - eps / 3) beyond."""
    _, speed = tangential(g, n, v, wall)
    third = g.number(1 / 3)
    low = g.minimum(speed, eps)
    inside = low * low / eps * (g.number(1) - third * low / eps)
    return mu * push * g.select(speed.value < eps.value, inside, speed - third * eps)
