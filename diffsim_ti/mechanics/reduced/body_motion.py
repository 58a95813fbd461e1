"""How a rigid body moves in a pass, from sums over its vertices: Taichi functions with their tangents and adjoints.

A body is x = c + R y with y and J = sum m y y^T as state/bodies.py has them. U, the gradient of its displacements by y, is
R - 1. Its vertices would go with velocities of gradient G by y; what of that is a spin omega, in the body's own axes, is

    I omega = L = R^T l,    l = sum_b R_b x (G J_b),    I = tr J - J;    its gradient's columns are (R omega) x R_b.

The pass is the discrete rigid body of Moser and Veselov, which is SHAKE: the new rotation R F is that for which the momentum
sum m R y x (R F y) / alpha is the old one. With F = 1 + 2 ([f]x + [f]x^2) / (1 + f^2), f = tan(angle / 2) times the axis,

    I f + f x I f = (1 + f^2) alpha L / 2.

R is one step of Newton's method from 1 + U to a rotation, so that what rounding adds is lost again; its change is
theta x R_b, theta = sum_b R_b x dU_b / 2. Matrices are columns x, y, z; all vectors have a fourth component, zero.
Moser, Veselov 1991, doi:10.1007/BF02352494; McLachlan, Zanna 2005, The discrete Moser-Veselov algorithm for the free rigid
body, revisited, doi:10.1007/s10208-004-0118-6.
"""

import taichi as ti

from diffsim_ti.runtime import A, Bundle, cross, let, traced

VECTOR = ti.types.vector(4, ti.f64)


@traced
def columns(x, y, z):
    return Bundle(x=let(x), y=let(y), z=let(z))


@ti.func
def times(M: A, a):
    """M a"""
    return a.x * M.x + a.y * M.y + a.z * M.z


@ti.func
def back(M: A, a):
    """M^T a"""
    return VECTOR(M.x.dot(a), M.y.dot(a), M.z.dot(a), 0)


@ti.func
def solved(M: A, b):
    """M^-T b, of a symmetric one M^-1 b."""
    p = cross(M.y, M.z)
    return (b.x * p + b.y * cross(M.z, M.x) + b.z * cross(M.x, M.y)) / M.x.dot(p)


@traced
def inertia(J):
    """I = tr J - J"""
    t = let(trace(J))
    return columns(unit(0, t) - J.x, unit(1, t) - J.y, unit(2, t) - J.z)


@ti.func
def trace(J: A):
    return J.x.x + J.y.y + J.z.z


@ti.func
def unit(k: A, t):
    e = VECTOR(0, 0, 0, 0)
    e[k] = t
    return e


@ti.func
def inertia_times(J: A, a):
    """I a"""
    return trace(J) * a - times(J, a)


@traced
def rotation(U):
    """Columns of R."""
    near = columns(*(let(u + unit(k, 1)) for k, u in enumerate((U.x, U.y, U.z))))
    return columns(*(_nearer(near, k) for k in (near.x, near.y, near.z)))


@ti.func
def _nearer(M: A, k):
    return 1.5 * k - 0.5 * times(M, back(M, k))


@ti.func
def turning(R: A, dU: A):
    """theta"""
    return 0.5 * (cross(R.x, dU.x) + cross(R.y, dU.y) + cross(R.z, dU.z))


@ti.func
def momentum(R: A, G: A, J: A):
    """l"""
    return cross(R.x, times(G, J.x)) + cross(R.y, times(G, J.y)) + cross(R.z, times(G, J.z))


@ti.func
def momentum_jvp(R: A, G: A, J: A, theta, dG: A, dJ: A):
    """Change of l."""
    turned = columns(cross(theta, R.x), cross(theta, R.y), cross(theta, R.z))
    return momentum(R, dG, J) + momentum(R, G, dJ) + momentum(turned, G, J)


@ti.func
def momentum_vjp(R: A, G: A, J: A, by):
    """(adjoint of theta, columns of what those of G are J times, and those of J the products of G with) for that of l."""
    theta = cross(R.x, cross(times(G, J.x), by)) + cross(R.y, cross(times(G, J.y), by))
    theta += cross(R.z, cross(times(G, J.z), by))
    return theta, cross(by, R.x), cross(by, R.y), cross(by, R.z)


# ---- the spin ------------------------------------------------------------------------------------------------------------


@ti.func
def spin(R: A, G: A, J: A):
    """R omega"""
    return times(R, solved(inertia(J), back(R, momentum(R, G, J))))


@ti.func
def spin_jvp(R: A, G: A, J: A, theta, dG: A, dJ: A):
    """Columns of the change of the spin's gradient."""
    l = momentum(R, G, J)
    omega = solved(inertia(J), back(R, l))
    dL = back(R, momentum_jvp(R, G, J, theta, dG, dJ) - cross(theta, l))
    change = times(R, solved(inertia(J), dL - inertia_times(dJ, omega)))
    w = times(R, omega)
    x, y, z = cross(w, R.x), cross(w, R.y), cross(w, R.z)
    return (
        cross(theta, x) + cross(change, R.x),
        cross(theta, y) + cross(change, R.y),
        cross(theta, z) + cross(change, R.z),
    )


# ---- the turn of a pass --------------------------------------------------------------------------------------------------


@ti.func
def half_turn(J: A, a):
    """f by Newton's method; not a number where a substep would turn the body by more than about a radian."""
    f = 0 * a
    near, found = 0, 0
    for _ in range(30):
        if found == 0:
            If = inertia_times(J, f)
            left = If + cross(f, If) - 0.5 * (1 + f.dot(f)) * a
            f += -1 * solved(_slope_rows(J, f, If, a), left)
            found = near
            near = int(left.dot(left) <= 1e-20 * a.dot(a))  # the next one ends at round-off
    if found == 0 or not f.dot(f) < 1:
        f = f * ti.math.nan
    return f


@traced
def _slope_rows(J, f, If, a):
    """Columns of the transpose of I + [f]x I - [I f]x - a f^T."""
    return columns(*(_slope_row(J, f, If, a, k) for k in range(3)))


@ti.func
def _slope_row(J: A, f, If, a, k: A):
    e = unit(k, 1.0)
    # row k: e.(I w + f x I w - If x w - a f.w) = w.(I e + I (e x f) - e x If - a_k f)
    return inertia_times(J, e + cross(e, f)) - cross(e, If) - a[k] * f


@traced
def _slope_columns(J, f, If, a):
    """Columns of the same without the transpose."""
    return columns(*(_slope_column(J, f, If, a, k) for k in range(3)))


@ti.func
def _slope_column(J: A, f, If, a, k: A):
    e = unit(k, 1.0)
    Ie = inertia_times(J, e)
    return Ie + cross(f, Ie) - cross(If, e) - f[k] * a


@ti.func
def gained(phi, k):
    """Column of R F - R for phi = R f and a column of R."""
    way = cross(phi, k)
    return 2 / (1 + phi.dot(phi)) * (way + cross(phi, way))


@ti.func
def gained_jvp(phi, dphi, k, c):
    """The change of such a column c by phi alone."""
    way, dway, scale = cross(phi, k), cross(dphi, k), 2 / (1 + phi.dot(phi))
    return scale * (dway + cross(dphi, way) + cross(phi, dway) - phi.dot(dphi) * c)


@ti.func
def gained_vjp(phi, k, c, by):
    """Adjoint of phi."""
    way, scale = cross(phi, k), 2 / (1 + phi.dot(phi))
    return scale * (cross(k, by) + cross(way, by) + cross(k, cross(by, phi)) - c.dot(by) * phi)


@ti.func
def half_turn_jvp(J: A, f, a, da, dJ: A):
    """Change of f."""
    left = inertia_times(dJ, f)
    left = 0.5 * (1 + f.dot(f)) * da - left - cross(f, left)
    return solved(_slope_rows(J, f, inertia_times(J, f), a), left)


@ti.func
def half_turn_vjp(J: A, f, a, by):
    """mu, the adjoint of what is zero at f."""
    return solved(_slope_columns(J, f, inertia_times(J, f), a), by)
