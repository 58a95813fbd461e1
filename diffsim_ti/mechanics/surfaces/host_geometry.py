"""Pairs of surface primitives on the host, all at a time: the formulas of proximity.py and secant.py for NumPy's arrays.

y: corners 1 to 3 relative to corner 0, shape (pairs, 3, 3); edges: which pairs are of two edges. Everything takes complex
numbers, too, and is analytic in them between its kinks, so that changes of inputs can go along as imaginary parts.
"""

import numpy as np

from diffsim_ti.differentiation.arrays import cross
from diffsim_ti.mechanics.surfaces.proximity import BY_FIRST, BY_SECOND
from diffsim_ti.terms.obstacles.barrier import curvature_within, slope_within, value_within

TINY, FLAT = 1e-200, 1e-14
FLOOR = 1e-5  # share of the width below which the barrier goes on as a parabola
VALUE, SLOPE, CURVATURE = (f(FLOOR, np.log(FLOOR)) for f in (value_within, slope_within, curvature_within))
NODES, SHARES = np.polynomial.legendre.leggauss(8)
NODES, SHARES = 0.5 * (1 + NODES), 0.5 * SHARES
NEAR = 0.25  # relative distance of two arguments below which the secant's slope is integrated
FIRST, SECOND = np.array(BY_FIRST, float), np.array(BY_SECOND, float)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


# ---- nearest points ------------------------------------------------------------------------------------------------------


def _along(q: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest parameter in [0, 1] of the line t e to q, and 1 / |e|^2 where it is free, else 0."""
    square = dot(e, e)
    square = np.where(square.real > TINY, square, TINY)
    t = dot(q, e) / square
    low, high = t.real <= 0, t.real >= 1
    return np.where(low, 0, np.where(high, 1, t)), np.where(low | high, 0, 1 / square)


def _inner(a: np.ndarray, b: np.ndarray, q: np.ndarray) -> tuple:
    """(s, t, whether a x b is not degenerate, (aa, ab, bb) / det) of the point s a + t b nearest to q."""
    aa, ab, bb, normal = dot(a, a), dot(a, b), dot(b, b), cross(a, b)
    det = dot(normal, normal)
    fine = det.real > FLAT * (aa * bb).real
    inverse = 1 / np.where(det.real > TINY, det, TINY)
    s, t = dot(cross(q, b), normal) * inverse, dot(cross(a, q), normal) * inverse
    return s, t, fine, np.stack([aa, ab, bb], -1) * inverse[:, None]


def _better(best: tuple, other: tuple, distance) -> tuple:
    """Of two (s, t, g, squared distance), the nearer one, pair by pair."""
    s, t, g = other
    d = distance(s, t)
    wins = d.real < best[3].real
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
        inside &= (s.real > 0) & (s.real < 1) & (t.real > 0) & (t.real < 1)
        square = lambda s, t: dot(*2 * [y2 + t[:, None] * b - s[:, None] * a])  # noqa: E731
        (t0, f0), (t1, f1), (s2, f2), (s3, f3) = _along(-y2, b), _along(a - y2, b), _along(y2, a), _along(y3, a)
        others = (zero, t0, pack(zero, zero, f0)), (one, t1, pack(zero, zero, f1))
        others += (s2, zero, pack(f2, zero, zero)), (s3, one, pack(f3, zero, zero))
    else:
        a, b, q = y2 - y1, y3 - y1, origin - y1
        s, t, inside, g = _inner(a, b, q)
        g = pack(g[:, 2], -g[:, 1], g[:, 0])
        inside &= (s.real > 0) & (t.real > 0) & ((s + t).real < 1)
        square = lambda s, t: dot(*2 * [q - s[:, None] * a - t[:, None] * b])  # noqa: E731
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


def nearest(y: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(weights of the corners, r, (G_11, G_12, G_22)); docstring of proximity.py."""
    w, g = np.zeros((len(y), 4), y.dtype), np.zeros((len(y), 3), y.dtype)
    for kind in (False, True):
        some = edges == kind
        if some.any():
            w[some], g[some] = _nearest(y[some], kind)
    return w, np.einsum("pk,pkd->pd", w[:, 1:], y), g


def nearest_vjp(y, edges, w, r, g, w_adj, r_adj) -> np.ndarray:
    """Adjoint of y for those of the weights and of r."""
    first, second = FIRST[edges.astype(int)], SECOND[edges.astype(int)]
    e1, e2 = np.einsum("pk,pkd->pd", first[:, 1:], y), np.einsum("pk,pkd->pd", second[:, 1:], y)
    t1, t2 = dot(e1, r_adj) + (first * w_adj).sum(1), dot(e2, r_adj) + (second * w_adj).sum(1)
    s1, s2 = -(g[:, 0] * t1 + g[:, 1] * t2), -(g[:, 1] * t1 + g[:, 2] * t2)
    along = r_adj + s1[:, None] * e1 + s2[:, None] * e2
    turned = first[:, 1:] * s1[:, None] + second[:, 1:] * s2[:, None]
    return w[:, 1:, None] * along[:, None] + turned[:, :, None] * r[:, None]


def fading(y: np.ndarray, edges: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """m of each pair; scale: 1 / sqrt(threshold of |a x b|^2) of edges, anything for others."""
    x = scale[:, None] * cross(y[:, 0], y[:, 2] - y[:, 1])
    q = dot(x, x)
    return np.where(edges & (q.real < 1), q * (2 - q), 1)


def fading_vjp(y: np.ndarray, edges: np.ndarray, scale: np.ndarray, m_adj: np.ndarray) -> np.ndarray:
    """Adjoint of y."""
    b = y[:, 2] - y[:, 1]
    x = scale[:, None] * cross(y[:, 0], b)
    q = dot(x, x)
    x_adj = (np.where(edges & (q < 1), 2 * (1 - q), 0) * m_adj * 2 * scale)[:, None] * x
    by_b = cross(x_adj, y[:, 0])
    return np.stack([cross(b, x_adj), -by_b, by_b], 1)


# ---- the barrier, and the secant's slope --------------------------------------------------------------------------------


def _joined(s, below, inside):
    low, high = s.real < FLOOR, s.real >= 1
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
    low, high = np.minimum(s.real, t.real), np.maximum(s.real, t.real)
    near = (high - low < NEAR * low) & (high < 1) & (low > FLOOR)
    step = np.where(near | (change.real == 0), 1, change)
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
