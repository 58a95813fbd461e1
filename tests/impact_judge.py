"""Whether a body's surface and a solid overlap, by geometry alone: nothing here comes from the package.

Solids are dicts: dict(kind="box", center, axes (rows: unit vectors), half), dict(kind="capsule", start, end, radius) (a ball
has start = end), dict(kind="half_space", point, normal).
"""

import numpy as np


def moved(solid: dict, by) -> dict:
    """The solid, displaced."""
    return solid | {name: solid[name] + by for name in ("center", "start", "end", "point") if name in solid}


def shrunk(solid: dict, share: float) -> dict:
    """Its core: what is left when `share` of the smallest thickness is taken from all sides."""
    if solid["kind"] == "box":
        return solid | {"half": solid["half"] - share * solid["half"].min()}
    if solid["kind"] == "capsule":
        return solid | {"radius": (1 - share) * solid["radius"]}
    return solid


def thickness(solid: dict) -> float:
    if solid["kind"] == "box":
        return 2 * float(solid["half"].min())
    return 2 * solid["radius"] if solid["kind"] == "capsule" else np.inf


def overlaps(triangles: np.ndarray, solid: dict) -> bool:
    """Whether any triangle, shape (k, 3, 3), has a point within the solid."""
    if solid["kind"] == "box":
        return bool(triangles_in_box((triangles - solid["center"]) @ solid["axes"].T, solid["half"]).any())
    if solid["kind"] == "half_space":
        return bool((((triangles - solid["point"]) @ solid["normal"]) < 0).any())
    return bool((distance_to_segment(triangles, solid["start"], solid["end"]) < solid["radius"]).any())


def encloses(triangles: np.ndarray, point: np.ndarray) -> bool:
    """Whether a closed surface winds around a point: its solid angle is 4 pi. Van Oosterom, Strackee 1983."""
    a, b, c = (triangles[:, k] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    dot = lambda x, y: (x * y).sum(1)  # noqa: E731
    down = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return abs(2 * np.arctan2(dot(a, np.cross(b, c)), down).sum()) > 2 * np.pi


def middle(solid: dict) -> np.ndarray:
    if solid["kind"] == "half_space":
        return solid["point"] - 1e9 * solid["normal"]
    return solid["center"] if solid["kind"] == "box" else 0.5 * (solid["start"] + solid["end"])


def triangles_in_box(t: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Separating axes of triangles and a box about 0: its three sides, the triangle's normal, nine products of edges."""
    edges = np.roll(t, -1, axis=1) - t
    axes = [np.broadcast_to(e, (len(t), 3)) for e in np.eye(3)] + [np.cross(edges[:, 0], edges[:, 1])]
    axes += [np.cross(np.eye(3)[d], edges[:, k]) for d in range(3) for k in range(3)]
    apart = np.zeros(len(t), bool)
    for axis in axes:
        along = np.einsum("kai,ki->ka", t, axis)
        reach = np.abs(axis) @ half
        apart |= (along.min(1) > reach) | (along.max(1) < -reach)
    return ~apart


def distance_to_segment(t: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Distance of each triangle to the segment from p to q."""
    out = np.minimum(point_triangle(p, t), point_triangle(q, t))
    for k in range(3):
        out = np.minimum(out, segment_segment(t[:, k], t[:, (k + 1) % 3], p, q))
    n = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    a, b = ((n * (x - t[:, 0])).sum(1) for x in (p, q))
    share = np.divide(a, a - b, out=np.full(len(t), 2.0), where=a != b)
    crossing = (share >= 0) & (share <= 1)
    at = p + np.where(crossing, share, 0)[:, None] * (q - p)
    return np.where(crossing & (inside(at, t, n)), 0.0, out)


def inside(x: np.ndarray, t: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Whether points over triangles lie between their sides."""
    sides = [(np.cross(t[:, (k + 1) % 3] - t[:, k], x - t[:, k]) * n).sum(1) >= 0 for k in range(3)]
    return sides[0] & sides[1] & sides[2]


def point_triangle(p: np.ndarray, t: np.ndarray) -> np.ndarray:
    n = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    n = n / np.linalg.norm(n, axis=1, keepdims=True)
    height = ((p - t[:, 0]) * n).sum(1)
    out = np.where(inside(p - height[:, None] * n, t, n), np.abs(height), np.inf)
    for k in range(3):
        a, b = t[:, k], t[:, (k + 1) % 3]
        share = np.clip(((p - a) * (b - a)).sum(1) / ((b - a) ** 2).sum(1), 0, 1)[:, None]
        out = np.minimum(out, np.linalg.norm(p - a - share * (b - a), axis=1))
    return out


def segment_segment(a: np.ndarray, b: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Distances of segments a b, shape (k, 3), to the segment p q: the best of the ends and of the lines' nearest points."""
    d, e, r = b - a, np.broadcast_to(q - p, a.shape), a - p
    dd, ee, de, dr, er = ((x * y).sum(1) for x, y in ((d, d), (e, e), (d, e), (d, r), (e, r)))
    down = dd * ee - de * de
    s = np.clip(np.divide(de * er - ee * dr, down, out=np.zeros(len(a)), where=down > 1e-30), 0, 1)
    best = np.full(len(a), np.inf)
    for first in (s, np.zeros(len(a)), np.ones(len(a))):
        t = np.clip(np.divide(er + first * de, ee, out=np.zeros(len(a)), where=ee > 0), 0, 1)
        s = np.clip(np.divide(t * de - dr, dd, out=np.zeros(len(a)), where=dd > 0), 0, 1)
        best = np.minimum(best, np.linalg.norm(r + s[:, None] * d - t[:, None] * e, axis=1))
    return best


class Judge:
    """Follows a body's surface past a solid, step by step, and says what it did wrong.

    Overlap at the end of a step is "impaled". "passed": on straight ways from step to step the surface goes through the
    solid's core. In a step that is longer than half the body a body may well go round a solid that is not wider than it,
    so that straight ways say nothing; a wall (wider than five bodies) is never gone round, unless the body ends beyond its
    rim, as one does that a turning wall has flung off.
    """

    def __init__(self, triangles: np.ndarray, solid: dict, positions: np.ndarray, by=(0.0, 0.0, 0.0)):
        self.triangles, self.solid, self.core = triangles, solid, shrunk(solid, 0.3)
        self.before, self.by = np.asarray(positions, np.float64), np.asarray(by, np.float64)
        self.size = float(np.ptp(self.before, 0).max())
        self.is_wall = solid["kind"] == "half_space" or (
            solid["kind"] == "box" and np.sort(2 * solid["half"])[1] > 5 * self.size
        )

    def after_step(self, positions: np.ndarray, by) -> str | None:
        """What is wrong with a step to these positions, the solid being displaced by `by`: "impaled", "passed" or None."""
        x, by = np.asarray(positions, np.float64), np.asarray(by, np.float64)
        if overlaps(x[self.triangles], moved(self.solid, by)) or encloses(x[self.triangles], middle(self.solid) + by):
            return "impaled"
        start, end = self.before - self.by, x - by  # as the solid sees it
        self.before, self.by = x, by
        travel = np.linalg.norm(end - start, axis=1).max()
        if self.is_wall and not self._beyond_rim(end) or travel < 0.5 * self.size:
            halts = min(200, 1 + int(np.ceil(2 * travel / thickness(self.core))))
            for share in np.linspace(0, 1, halts + 1)[1:-1]:
                if overlaps(((1 - share) * start + share * end)[self.triangles], self.core):
                    return "passed"
        return None

    def _beyond_rim(self, x: np.ndarray) -> bool:
        """Whether a part of the body, as the solid sees it, is not over the wall."""
        if self.solid["kind"] != "box":
            return False
        along = np.abs((x - self.solid["center"]) @ self.solid["axes"].T)
        wide = np.argsort(self.solid["half"])[1:]
        return bool((along[:, wide] > self.solid["half"][wide]).any())
