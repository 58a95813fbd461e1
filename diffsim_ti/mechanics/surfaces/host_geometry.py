"""Pairs of surface primitives on the host, all at a time: the formulas of proximity.py and secant.py for NumPy's arrays.

y: corners 1 to 3 relative to corner 0, shape (pairs, 3, 3); edges: which pairs are of two edges. Places may record.
"""

import numpy as np

from diffsim_ti.differentiation.arrays import cross, made, value_of, with_slopes
from diffsim_ti.mechanics.surfaces.proximity import BY_FIRST, BY_SECOND
from diffsim_ti.terms.obstacles.barrier import curvature_within, slope_within, value_within

TINY, FLAT = 1e-200, 1e-14
FLOOR = 1e-5  # share of the width below which the barrier goes on as a parabola
VALUE, SLOPE, CURVATURE = (f(FLOOR, np.log(FLOOR)) for f in (value_within, slope_within, curvature_within))
NODES, SHARES = np.polynomial.legendre.leggauss(8)
NODES, SHARES = 0.5 * (1 + NODES), 0.5 * SHARES
NEAR = 0.25  # relative distance of two arguments below which the secant's slope is integrated
FIRST, SECOND = np.array(BY_FIRST, float), np.array(BY_SECOND, float)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def dot(a, b):
    A, B = value_of(a), value_of(b)
    by_a = (a, lambda da: _dot(da, B), lambda seed: seed[..., None] * B)
    return made(_dot(A, B), by_a, (b, lambda db: _dot(A, db), lambda seed: seed[..., None] * A))


def by_rows(a, x):
    """Numbers times vectors."""
    A, X = value_of(a), value_of(x)
    by_a = (a, lambda da: da[:, None] * X, lambda seed: _dot(seed, X))
    return made(A[:, None] * X, by_a, (x, lambda dx: A[:, None] * dx, lambda seed: A[:, None] * seed))


# ---- nearest points ------------------------------------------------------------------------------------------------------


def _along(q: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest parameter in [0, 1] of the line t e to q, and 1 / |e|^2 where it is free, else 0."""
    square = _dot(e, e)
    square = np.where(square > TINY, square, TINY)
    t = _dot(q, e) / square
    low, high = t <= 0, t >= 1
    return np.where(low, 0, np.where(high, 1, t)), np.where(low | high, 0, 1 / square)


def _inner(a: np.ndarray, b: np.ndarray, q: np.ndarray) -> tuple:
    """(s, t, whether a x b is not degenerate, (aa, ab, bb) / det) of the point s a + t b nearest to q."""
    aa, ab, bb, normal = _dot(a, a), _dot(a, b), _dot(b, b), cross(a, b)
    det = _dot(normal, normal)
    fine = det > FLAT * aa * bb
    inverse = 1 / np.where(det > TINY, det, TINY)
    s, t = _dot(cross(q, b), normal) * inverse, _dot(cross(a, q), normal) * inverse
    return s, t, fine, np.stack([aa, ab, bb], -1) * inverse[:, None]


def _better(best: tuple, other: tuple, distance) -> tuple:
    """Of two (s, t, g, squared distance), the nearer one, pair by pair."""
    s, t, g = other
    d = distance(s, t)
    wins = d < best[3]
    return tuple(np.where(wins[:, None] if a.ndim > 1 else wins, b, a) for a, b in zip(best, (s, t, g, d)))


def _nearest(y: np.ndarray, edges: bool) -> tuple[np.ndarray, np.ndarray]:
    """(w, G) of pairs of one kind: weights of the four corners, and (G_11, G_12, G_22)."""
    y1, y2, y3 = y[:, 0], y[:, 1], y[:, 2]
    zero, origin = 0 * y[:, 0, 0], 0 * y1
    one = zero + 1
    pack = lambda *g: np.stack(np.broadcast_arrays(*g), -1)  # noqa: E731
    if edges:
        a, b = y1, y3 - y2
        s, t, inside, g = _inner(a, -b, y2)
        g = pack(g[:, 2], -g[:, 1], g[:, 0])
        inside &= (s > 0) & (s < 1) & (t > 0) & (t < 1)
        square = lambda s, t: _dot(*2 * [y2 + t[:, None] * b - s[:, None] * a])  # noqa: E731
        (t0, f0), (t1, f1), (s2, f2), (s3, f3) = _along(-y2, b), _along(a - y2, b), _along(y2, a), _along(y3, a)
        others = (zero, t0, pack(zero, zero, f0)), (one, t1, pack(zero, zero, f1))
        others += (s2, zero, pack(f2, zero, zero)), (s3, one, pack(f3, zero, zero))
    else:
        a, b, q = y2 - y1, y3 - y1, origin - y1
        s, t, inside, g = _inner(a, b, q)
        g = pack(g[:, 2], -g[:, 1], g[:, 0])
        inside &= (s > 0) & (t > 0) & ((s + t) < 1)
        square = lambda s, t: _dot(*2 * [q - s[:, None] * a - t[:, None] * b])  # noqa: E731
        (s1, f1), (t2, f2), (t3, f3) = _along(q, a), _along(q, b), _along(q - a, b - a)
        others = (s1, zero, pack(f1, zero, zero)), (zero, t2, pack(zero, zero, f2))
        others += ((1 - t3, t3, pack(f3, -f3, f3)),)
    best = (*others[0], square(*others[0][:2]))
    for other in others[1:]:
        best = _better(best, other, square)
    s, t = np.where(inside, s, best[0]), np.where(inside, t, best[1])
    g = np.where(inside[:, None], g, best[2])
    w = np.stack([1 - s, s, t - 1, -t], -1) if edges else np.stack([one, s + t - 1, -s, -t], -1)
    return w, g


def nearest(y, edges: np.ndarray) -> tuple:
    """(weights of the corners, r); docstring of proximity.py."""
    Y = value_of(y)
    w, g = np.zeros((len(Y), 4)), np.zeros((len(Y), 3))
    for kind in (False, True):
        some = edges == kind
        if some.any():
            w[some], g[some] = _nearest(Y[some], kind)
    own = w[:, 1:, None]
    r = (own * Y).sum(1)
    if y is Y:
        return w, r
    F = np.stack([FIRST[edges.astype(int)], SECOND[edges.astype(int)]], 1)  # how weights change with the parameters
    E, G = F[:, :, 1:] @ Y, g[:, [[0, 1], [1, 2]]]

    def change(dy):
        moved = (own * dy).sum(1)
        q = -G @ (E @ moved[:, :, None] + F[:, :, 1:] @ (dy @ r[:, :, None]))
        return np.concatenate([F.swapaxes(1, 2) @ q, moved[:, :, None] + E.swapaxes(1, 2) @ q], 1)[..., 0]

    def back(seed):
        by_w, by_r = seed[:, :4, None], seed[:, 4:, None]
        q = -G @ (E @ by_r + F @ by_w)
        return own * (by_r + E.swapaxes(1, 2) @ q).swapaxes(1, 2) + (F[:, :, 1:].swapaxes(1, 2) @ q) * r[:, None]

    both = made(np.concatenate([w, r], 1), (y, change, back))
    return both[:, :4], both[:, 4:]


def fading(y, edges: np.ndarray, scale: np.ndarray):
    """m of each pair; scale: 1 / sqrt(threshold of |a x b|^2) of edges, anything for others."""
    Y = value_of(y)
    a, b = Y[:, 0], Y[:, 2] - Y[:, 1]
    x = scale[:, None] * cross(a, b)
    q = _dot(x, x)
    some = edges & (q < 1)

    def slope():
        by_x = (np.where(some, 4 * (1 - q), 0) * scale)[:, None] * x
        by_b = cross(by_x, a)
        return np.stack([cross(b, by_x), -by_b, by_b], 1)

    return with_slopes(np.where(some, q * (2 - q), 1.0), (y, slope))


# ---- the barrier, and the secant's slope --------------------------------------------------------------------------------


def _joined(s, below, inside):
    low, high = s < FLOOR, s >= 1
    within = np.where(low | high, 0.5, s)
    return np.where(low, below(s - FLOOR), np.where(high, 0, inside(within, np.log(within))))


def value(s):
    return _joined(s, lambda t: VALUE + t * (SLOPE + t * (CURVATURE / 2)), value_within)


def slope(s):
    return _joined(s, lambda t: SLOPE + t * CURVATURE, slope_within)


def curvature(s):
    return _joined(s, lambda t: CURVATURE + 0 * t, curvature_within)


def secant(s: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(sigma, its derivatives by s and t): (beta(t) - beta(s)) / (t - s), near t = s the integral of the slope between."""
    change = t - s
    low, high = np.minimum(s, t), np.maximum(s, t)
    near = (high - low < NEAR * low) & (high < 1) & (low > FLOOR)
    step = np.where(near | (change == 0), 1, change)
    far = (value(t) - value(s)) / step
    by_s, by_t = (far - slope(s)) / step, (slope(t) - far) / step
    if near.any():
        at = s[near, None] + change[near, None] * NODES
        bend = curvature(at) * SHARES
        far[near], by_s[near], by_t[near] = slope(at) @ SHARES, bend @ (1 - NODES), bend @ NODES
    return far, by_s, by_t


def push(s: np.ndarray, t: np.ndarray, c: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(p, its derivatives by s and t) of secant.py."""
    sigma, by_s, by_t = secant(s, t) if c < 1 else (0 * t, 0 * t, 0 * t)
    return -c * slope(t) - (1 - c) * sigma, -(1 - c) * by_s, -c * curvature(t) - (1 - c) * by_t
