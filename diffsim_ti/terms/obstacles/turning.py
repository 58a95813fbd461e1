"""Rotations in kernels: unit quaternions (w, x, y, z) and rotation vectors a; vectors have three components.

    R(a) x = cos |a| x + sinc a x x + b a (a . x),    J(a) x = sinc x + b a x x + c a (a . x),

sinc = sin |a| / |a|, b = (1 - cos |a|) / |a|^2, c = (1 - sinc) / |a|^2; J(a) da is the change of the rotation R(a), and
(R(a) - 1) x = a x J(a) x. The same on the host: rotations.py.
"""

import taichi as ti

from diffsim_ti.runtime import at, let, traced


def length_of(vector) -> int:
    """How many components a vector of a kernel has."""
    return vector.get_shape()[0] if hasattr(vector, "get_shape") else vector.n


@traced
def changes(leaves, change):
    """(leaf, its change), of all leaves of a place and a rotation, or by a vector of no six numbers of the first three."""
    return [(x, at(change, d)) for d, x in enumerate(leaves[: 6 if length_of(change) == 6 else 3])]


@traced
def all_changes(numbers, parameters_dot, first, *pairs):
    """(leaf, its change) of an obstacle's numbers and of the leaves of vectors, given as (leaves, change)."""
    out = [(q, at(parameters_dot, getattr(q, "row", first + k))) for k, q in enumerate(numbers)]
    return sum((changes(leaves, change) for leaves, change in pairs), out)


@traced
def cross(a, b):
    """Of lists of three."""
    return [let(a[(d + 1) % 3] * b[(d + 2) % 3] - a[(d + 2) % 3] * b[(d + 1) % 3]) for d in range(3)]


@traced
def rotation_matrix(q):
    """Rows of R of a unit quaternion, a list of four."""
    w, x, y, z = (let(k) for k in q)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return [[let(k) for k in row] for row in rows]


@ti.func
def _series(s, divisors: ti.template(), fp: ti.template()):
    """1 - s / a (1 - s / b (1 - ...)) for divisors a, b ..."""
    out = 1 + 0 * s
    for k in ti.static(divisors[::-1]):
        out = 1 - s * ti.cast(1 / k, fp) * out
    return out


@ti.func
def coefficients(a, fp: ti.template()):
    """(cos, sinc, b, c)"""
    s = a.norm_sqr()
    out = ti.types.vector(4, fp)(0)
    if s < ti.cast(0.25, fp):
        out[1] = _series(s, (6, 20, 42, 72, 110, 156), fp)
        out[2] = ti.cast(0.5, fp) * _series(s, (12, 30, 56, 90, 132), fp)
        out[3] = ti.cast(1 / 6, fp) * _series(s, (20, 42, 72, 110, 156), fp)
        out[0] = 1 - s * out[2]
    else:
        size = ti.sqrt(s)
        out[0] = ti.cos(size)
        out[1] = ti.sin(size) / size
        out[2] = (1 - out[0]) / s
        out[3] = (1 - out[1]) / s
    return out


@ti.func
def rotated(a, x, fp: ti.template()):
    """R(a) x"""
    k = coefficients(a, fp)
    return k[0] * x + k[1] * a.cross(x) + (k[2] * a.dot(x)) * a


@ti.func
def jacobian(a, x, fp: ti.template()):
    """J(a) x; its transpose is that of -a."""
    k = coefficients(a, fp)
    return k[1] * x + k[2] * a.cross(x) + (k[3] * a.dot(x)) * a


@ti.func
def quaternion(a, fp: ti.template()):
    """Of a rotation vector."""
    half = ti.cast(0.5, fp)
    k = coefficients(half * a, fp)
    out = ti.types.vector(4, fp)(0)
    out[0] = k[0]
    for d in ti.static(range(3)):
        out[1 + d] = k[1] * half * a[d]
    return out


@ti.func
def from_rodrigues(s, fp: ti.template()):
    """Of modified Rodrigues parameters."""
    n = s.norm_sqr()
    out, per = ti.types.vector(4, fp)(0), 1 / (1 + n)
    out[0] = (1 - n) * per
    for d in ti.static(range(3)):
        out[1 + d] = (s[d] + s[d]) * per
    return out


@ti.func
def product(p, q):
    """The rotation q, then p."""
    out = 0 * p
    out[0] = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3]
    out[1] = p[0] * q[1] + q[0] * p[1] + p[2] * q[3] - p[3] * q[2]
    out[2] = p[0] * q[2] + q[0] * p[2] + p[3] * q[1] - p[1] * q[3]
    out[3] = p[0] * q[3] + q[0] * p[3] + p[1] * q[2] - p[2] * q[1]
    return out


@ti.func
def at_share(s, phi, share, fp: ti.template()):
    """R(share phi) R, a unit quaternion, of the modified Rodrigues parameters s of R."""
    return product(quaternion(share * phi, fp), from_rodrigues(s, fp))


@ti.func
def turned(q, sign: ti.template(), x, fp: ti.template()):
    """R x, or with sign -1 R^T x."""
    v = ti.Vector([sign * q[1], sign * q[2], sign * q[3]])
    across = v.cross(x)
    twice = across + across
    return x + q[0] * twice + v.cross(twice)
