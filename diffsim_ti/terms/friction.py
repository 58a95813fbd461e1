"""Coulomb friction, smoothed, as a stage of its own: velocities are slowed in closed form, so that no step is too large.

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


def slide(g, n, push, v, wall, mu, h_over_m, eps):
    """Velocity after friction: n the normal, `push` the barrier's force N, v and wall the velocities of vertex and obstacle.

    Everything is a number of the graph `g`, or a list of three.
    """
    relative = [a - b for a, b in zip(v, wall)]
    towards = g.dot(relative, n)
    tangential = [r - towards * k for r, k in zip(relative, n)]
    c = h_over_m * mu * push
    lost = g.number(1) - keeps(g, g.sqrt(g.dot(tangential, tangential)), c, eps)
    return [a - lost * t for a, t in zip(v, tangential)]
