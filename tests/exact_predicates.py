"""Whether surfaces pass through each other, by exact arithmetic: a judge that shares no code with the package.

Coordinates are taken as the binary fractions that they are. The sign of a determinant comes from floating point where its
error bound leaves no doubt, else from integers of any length.
Shewchuk 1997, Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates, doi:10.1007/PL00009321.
"""

from fractions import Fraction

import numpy as np

ROUNDING = (
    8 * 2.0**-53
)  # of a 3x3 determinant of differences, over the sum of the sizes of its products: Shewchuk's bound
GROUP = 4  # primitives of the smallest boxes of a tree


def side(a, b, c, d) -> np.ndarray:
    """Sign of det(a - d, b - d, c - d), exactly, of k tetrahedra; each shape (k, 3). Zero: the four lie in a plane."""
    sign, doubtful = _likely_side(a, b, c, d)
    for k in np.flatnonzero(doubtful):
        sign[k] = _exact_side(a[k], b[k], c[k], d[k])
    return sign


def _likely_side(a, b, c, d) -> tuple[np.ndarray, np.ndarray]:
    """(sign, whether rounding leaves it in doubt)"""
    u, v, w = a - d, b - d, c - d
    products = np.stack([v[:, 1] * w[:, 2], v[:, 2] * w[:, 0], v[:, 0] * w[:, 1]], 1)
    others = np.stack([v[:, 2] * w[:, 1], v[:, 0] * w[:, 2], v[:, 1] * w[:, 0]], 1)
    det = (u * (products - others)).sum(1)
    bound = ROUNDING * (np.abs(u) * (np.abs(products) + np.abs(others))).sum(1)
    return np.sign(det).astype(np.int8), (np.abs(det) <= bound) & (bound > 0)


def _exact_side(*points) -> int:
    a, b, c, d = (_exactly(p) for p in points)
    u, v, w = ([p - q for p, q in zip(x, d, strict=True)] for x in (a, b, c))
    det = u[0] * (v[1] * w[2] - v[2] * w[1]) + u[1] * (v[2] * w[0] - v[0] * w[2]) + u[2] * (v[0] * w[1] - v[1] * w[0])
    return (det > 0) - (det < 0)


def _exactly(point) -> list[Fraction]:
    return [Fraction(float(x)) for x in point]


def segments_meet_triangles(p, q, a, b, c) -> np.ndarray:
    """Whether the segments p q touch or pierce the triangles a b c, of k pairs; each shape (k, 3)."""
    out = np.zeros(len(p), bool)
    near = np.flatnonzero(~_clearly_apart(p, q, a, b, c))
    p, q, a, b, c = (x[near] for x in (p, q, a, b, c))
    of_p, of_q = side(a, b, c, p), side(a, b, c, q)
    turns = np.stack([side(p, q, a, b), side(p, q, b, c), side(p, q, c, a)])
    out[near] = (of_p * of_q <= 0) & ~(np.any(turns > 0, 0) & np.any(turns < 0, 0))
    for i in np.flatnonzero((of_p == 0) & (of_q == 0)):
        out[near[i]] = _meet_in_a_plane(p[i], q[i], a[i], b[i], c[i])
    return out


def _clearly_apart(p, q, a, b, c) -> np.ndarray:
    """Whether a plane that rounding cannot move enough separates them: along the triangle, across a side of it or the
    segment."""
    normal = np.cross(b - a, c - a)
    apart = np.zeros(len(p), bool)
    for axis in (normal, *(np.cross(normal, edge) for edge in (b - a, c - b, a - c, q - p))):
        along = np.stack([(axis * (x - a)).sum(1) for x in (p, q, a, b, c)])
        rounding = 64 * 2.0**-53 * np.stack([(np.abs(axis) * np.abs(x - a)).sum(1) for x in (p, q, b, c)]).max(0)
        mine, theirs = along[:2], along[2:]
        apart |= (mine.min(0) > theirs.max(0) + rounding) | (mine.max(0) < theirs.min(0) - rounding)
    return apart


def _meet_in_a_plane(p, q, a, b, c) -> bool:
    """Of five points in a plane, exactly; False of a triangle without area."""
    points = [_exactly(x) for x in (p, q, a, b, c)]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        p, q, *corners = ([x[i], x[j]] for x in points)
        if _turn(*corners):
            sides = [(corners[k], corners[(k + 1) % 3]) for k in range(3)]
            turns = [_turn(*s, p) for s in sides]
            return min(turns) >= 0 or max(turns) <= 0 or any(_cross(p, q, *s) for s in sides)
    return False


def _turn(a, b, c) -> int:
    det = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    return (det > 0) - (det < 0)


def _cross(p, q, a, b) -> bool:
    """Whether two segments of a plane touch."""
    if _turn(a, b, p) * _turn(a, b, q) > 0 or _turn(p, q, a) * _turn(p, q, b) > 0:
        return False
    return all(max(min(p[i], q[i]), min(a[i], b[i])) <= min(max(p[i], q[i]), max(a[i], b[i])) for i in (0, 1))


class Tree:
    """Boxes about primitives, in groups of nearby ones; the groups are chosen once, at x."""

    def __init__(self, corners: np.ndarray, x: np.ndarray):
        self.corners = corners
        self.depth = max(int(np.ceil(np.log2(max(len(corners), 1) / GROUP))), 0)
        size = GROUP << self.depth
        order = np.full(size, -1)
        order[: len(corners)] = np.arange(len(corners))
        middles = np.vstack([x[corners].mean(1), np.full((1, 3), np.inf)])
        for level in range(self.depth):
            groups = order.reshape(1 << level, -1)
            places, real = middles[groups], (groups >= 0)[..., None]
            extent = np.where(real, places, -np.inf).max(1) - np.where(real, places, np.inf).min(1)
            along = np.take_along_axis(places, extent.argmax(1)[:, None, None].repeat(groups.shape[1], 1), 2)[..., 0]
            order = np.take_along_axis(groups, along.argsort(1, kind="stable"), 1).ravel()
        self.order, self.there = order, order >= 0

    def fit(self, x: np.ndarray, margin: float = 0.0) -> None:
        """Boxes at x."""
        low, high = (np.full((len(self.order), 3), s) for s in (np.inf, -np.inf))
        places = x[self.corners[self.order[self.there]]]
        low[self.there], high[self.there] = places.min(1) - margin, places.max(1) + margin
        self.levels = [(low, high)]
        for step in (GROUP, *[2] * self.depth):
            low, high = low.reshape(-1, step, 3).min(1), high.reshape(-1, step, 3).max(1)
            self.levels.append((low, high))

    def overlaps(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(i, j): boxes i given, shape (k, 3), that overlap the box of primitive j."""
        i, node = np.arange(len(low)), np.zeros(len(low), int)
        for level in range(self.depth + 1, -1, -1):
            their_low, their_high = self.levels[level]
            keep = np.all((low[i] <= their_high[node]) & (high[i] >= their_low[node]), 1)
            i, node = i[keep], node[keep]
            if level:
                step = GROUP if level == 1 else 2
                i, node = i.repeat(step), (step * node[:, None] + np.arange(step)).ravel()
        return i, self.order[node]


class ExactJudge:
    """Of surfaces on one array of vertices, shape (n, 3): triangles (k, 3), segments (k, 2), tetrahedra (k, 4), points (k,).

    The vertices of bodies and of obstacles stand in that array one after another. `asked` [bool, shape (n,)] says which
    vertices move or matter: an edge and a triangle are looked at unless neither has such a vertex (obstacles whose own
    triangles pass through each other).
    """

    def __init__(self, x, triangles, segments=(), tetrahedra=(), points=(), asked=None):
        x = np.asarray(x, np.float64)
        self.triangles = np.asarray(triangles, int).reshape(-1, 3)
        sides = np.concatenate([self.triangles[:, [0, 1]], self.triangles[:, [1, 2]], self.triangles[:, [2, 0]]])
        edges = np.concatenate([sides, np.asarray(segments, int).reshape(-1, 2)])
        self.edges = np.unique(np.sort(edges, 1), axis=0)
        self.tetrahedra, self.points = np.asarray(tetrahedra, int).reshape(-1, 4), np.asarray(points, int).ravel()
        self.asked = np.ones(len(x), bool) if asked is None else np.asarray(asked, bool)
        self.by_triangles, self.by_tetrahedra = Tree(self.triangles, x), Tree(self.tetrahedra, x)

    def pierced(self, x) -> np.ndarray:
        """Edges and triangles without a common vertex that touch or pierce each other at x, shape (k, 2): rows of `edges`
        and of `triangles`. Without such pairs surfaces do not intersect; one may lie wholly within another (`inside`)."""
        x = np.asarray(x, np.float64)
        self.by_triangles.fit(x)
        ends = x[self.edges]
        e, t = self.by_triangles.overlaps(ends.min(1), ends.max(1))
        edge, triangle = self.edges[e], self.triangles[t]
        keep = ~(edge[:, :, None] == triangle[:, None]).any((1, 2))
        keep &= self.asked[edge].any(1) | self.asked[triangle].any(1)
        e, t, edge, triangle = e[keep], t[keep], edge[keep], triangle[keep]
        meet = segments_meet_triangles(*x[edge].swapaxes(0, 1), *x[triangle].swapaxes(0, 1))
        return np.stack([e[meet], t[meet]], 1)

    def inside(self, x) -> np.ndarray:
        """`points` within or on tetrahedra of which they are no corner, at x, shape (k, 2): vertex, row of `tetrahedra`."""
        x = np.asarray(x, np.float64)
        self.by_tetrahedra.fit(x)
        i, t = self.by_tetrahedra.overlaps(x[self.points], x[self.points])
        p, corners = self.points[i], self.tetrahedra[t]
        keep = ~(corners == p[:, None]).any(1) & (self.asked[p] | self.asked[corners].any(1))
        p, t, corners = p[keep], t[keep], corners[keep]
        faces = [
            (x[p], *x[corners[:, others]].swapaxes(0, 1)) for others in ([1, 3, 2], [0, 2, 3], [0, 3, 1], [0, 1, 2])
        ]
        for certain in (True, False):  # most are outside without doubt
            sides = [_likely_side(*face) for face in faces] if certain else [(side(*face), False) for face in faces]
            signs = np.stack([np.where(doubtful, 0, sign) for sign, doubtful in sides])
            left = ~(np.any(signs > 0, 0) & np.any(signs < 0, 0))
            p, t, faces = p[left], t[left], [[z[left] for z in face] for face in faces]
        return np.stack([p, t], 1)

    def turned(self, x) -> np.ndarray:
        """Rows of `tetrahedra` whose volume is zero or negative."""
        a, b, c, d = np.asarray(x, np.float64)[self.tetrahedra].swapaxes(0, 1)
        return np.flatnonzero(side(b, c, d, a) <= 0)

    def count(self, x) -> int:
        """How many intersections there are at x."""
        return len(self.pierced(x)) + len(self.inside(x))

    def count_along(self, x, x_next, samples: int = 4) -> int:
        """The same, summed over `samples` places along the straight motion from x to x_next, its end included."""
        return sum(self.count(x + (x_next - x) * s) for s in np.arange(1, samples + 1) / samples)
