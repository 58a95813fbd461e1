"""Where the points within a face lie in contact with an obstacle, and how their part in it fades in (faces.py)."""

import numpy as np
import taichi as ti

from diffsim_ti.mesh import geometry
from diffsim_ti.mesh.curved_triangles import NOTABLE, arches, nodes_of_triangles
from diffsim_ti.terms.obstacles import barrier

FLAT, BENT, GROWTH = NOTABLE, 0.12, 8
PER_WIDTH, MOST_PARTS = 4, 64  # lattice points along a width; along the side of a face, if half of PER_WIDTH are there
FINEST = 1024  # lattice points along the side of a face, at most
SMOOTH = 0.05  # of a width: how far a curved face is from the triangles of its lattice, before what is smooth
REACH = 0.65  # of the distance of lattice points: from what lies between them to the nearest, faces being stretched a little


@ti.func
def rise(t, fp: ti.template()):
    """The step from 0 to 1 between FLAT and BENT, and its two derivatives."""
    per = ti.cast(1 / (BENT - FLAT), fp)
    r = ti.min(ti.max((t - ti.cast(FLAT, fp)) * per, ti.cast(0, fp)), ti.cast(1, fp))
    value, slope = r * r * r * (10 + r * (6 * r - 15)), 30 * per * r * r * (1 - r) * (1 - r)
    curvature = 60 * per * per * r * (1 - r) * (1 - 2 * r)
    return value, slope, curvature


def firmer(force) -> bool:
    """Whether points are the firmer, the narrower their obstacle is."""
    return force.per_area


@ti.func
def fade(t, force: ti.template(), fp: ti.template()):
    """phi(t) and its two derivatives"""
    value, slope, curvature = rise(t, fp)
    if ti.static(firmer(force)):
        grown, by_t, twice = 1 + ti.cast(GROWTH, fp) * t * t, ti.cast(2 * GROWTH, fp) * t, ti.cast(2 * GROWTH, fp)
        curvature = curvature * grown + 2 * by_t * slope + twice * value
        slope = slope * grown + by_t * value
        value = value * grown
    return value, slope, curvature


# F = beta(s) phi(t), or per area (beta(s) - beta(s + t)) phi(t), and its derivatives; before hollow obstacles what
# curved_faces.py says, in which t is what corners say


@ti.func
def felt(s, t, force: ti.template(), fp: ti.template()):
    """Whether a point has some energy."""
    out = s < 1
    if ti.static(force.hollow):
        if out:
            out = t < barrier.value(s, fp)
    else:
        out = out and t > ti.cast(FLAT, fp)
    return out


@ti.func
def point_energy(s, t, force: ti.template(), fp: ti.template()):
    """F"""
    b, p = barrier.value(s, fp), ti.cast(0, fp)
    if ti.static(force.hollow):
        p, _, _ = unsaid(t / b, fp)
    else:
        if ti.static(force.per_area):
            b -= barrier.value(s + t, fp)
        p, _, _ = fade(t, force, fp)
    return b * p


@ti.func
def unsaid(r, fp: ti.template()):
    """h and its two derivatives by x = 1 - r."""
    x = ti.max(1 - r, ti.cast(0, fp))
    value, slope = x * x * x * (6 + x * (3 * x - 8)), x * x * (18 + x * (15 * x - 32))
    return value, slope, 12 * x * (3 + x * (5 * x - 8))


@ti.func
def hollow_slopes(s, t, fp: ti.template()):
    b = barrier.value(s, fp)
    h, h1, _ = unsaid(t / b, fp)
    return (h + t / b * h1) * barrier.slope(s, fp), 0 - h1


@ti.func
def hollow_curvatures(s, t, fp: ti.template()):
    b, b1 = barrier.value(s, fp), barrier.slope(s, fp)
    h, h1, h2 = unsaid(t / b, fp)
    r, by_b = t / b, b1 / b
    return (h + r * h1) * barrier.curvature(s, fp) + r * r * h2 * by_b * b1, 0 - r * h2 * by_b, h2 / b


@ti.func
def hollow_stiffness(s, t, fp: ti.template()):
    """What d2F does not exceed, of the point's distance and, times b1^2, of each corner's."""
    b, b1 = barrier.value(s, fp), barrier.slope(s, fp)
    h, h1, h2 = unsaid(t / b, fp)
    r, steep = t / b, 2 * ti.max(h2, ti.cast(0, fp)) / b
    return (h + r * h1) * barrier.curvature(s, fp) + r * r * steep * b1 * b1, steep


@ti.func
def point_slopes(s, t, force: ti.template(), fp: ti.template()):
    """dF/ds, dF/dt"""
    by_s, by_t = ti.cast(0, fp), ti.cast(0, fp)
    if ti.static(force.hollow):
        by_s, by_t = hollow_slopes(s, t, fp)
    else:
        by_s, by_t = solid_slopes(s, t, force, fp)
    return by_s, by_t


@ti.func
def solid_slopes(s, t, force: ti.template(), fp: ti.template()):
    b, b1 = barrier.value(s, fp), barrier.slope(s, fp)
    p, p1, _ = fade(t, force, fp)
    by_s, by_t = b1 * p, b * p1
    if ti.static(force.per_area):
        c, c1 = barrier.value(s + t, fp), barrier.slope(s + t, fp)
        by_s, by_t = (b1 - c1) * p, (b - c) * p1 - c1 * p
    return by_s, by_t


@ti.func
def point_curvatures(s, t, force: ti.template(), fp: ti.template()):
    """d2F/ds2, d2F/dsdt, d2F/dt2"""
    ss, st, tt = ti.cast(0, fp), ti.cast(0, fp), ti.cast(0, fp)
    if ti.static(force.hollow):
        ss, st, tt = hollow_curvatures(s, t, fp)
    else:
        ss, st, tt = solid_curvatures(s, t, force, fp)
    return ss, st, tt


@ti.func
def solid_curvatures(s, t, force: ti.template(), fp: ti.template()):
    b, b1, b2 = barrier.value(s, fp), barrier.slope(s, fp), barrier.curvature(s, fp)
    p, p1, p2 = fade(t, force, fp)
    ss, st, tt = b2 * p, b1 * p1, b * p2
    if ti.static(force.per_area):
        c, c1, c2 = barrier.value(s + t, fp), barrier.slope(s + t, fp), barrier.curvature(s + t, fp)
        ss, st, tt = (b2 - c2) * p, (b1 - c1) * p1 - c2 * p, (b - c) * p2 - (c1 + c1) * p1 - c2 * p
    return ss, st, tt


def lattices(arrays) -> tuple[np.ndarray, ...]:
    """(parts, reach, weight) of each triangle of the surface and each obstacle: in how many parts the lattice cuts its
    sides, r [m] and c (faces.py)."""
    mesh = arrays.mesh
    x = mesh.vertices[mesh.surface_triangles]
    longest = np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(1)
    widths = np.array([float(t.values["barrier_width"]) for t in arrays.contacts])
    along = PER_WIDTH * longest[:, None] / widths
    parts = np.clip(np.ceil(along), 2, np.clip(np.ceil(along / 2), MOST_PARTS, FINEST)).astype(int)
    smooth = np.array([arrays.curved and counterpart.hollow for counterpart, *_ in arrays.obstacles], bool)
    if smooth.any():
        fewest = np.ceil(np.sqrt(np.maximum(arches(mesh), arrays.bend)[:, None] / (SMOOTH * widths[smooth]))).astype(
            int
        )
        parts[:, smooth] = np.minimum(parts[:, smooth], np.clip(fewest, 3, MOST_PARTS))
    apart = longest[:, None] / parts
    reach, weight = REACH * apart, (apart / widths) ** 2
    reach[:, smooth], weight[:, smooth] = 0, np.minimum(weight[:, smooth], 1)
    return parts, reach, weight


def shortened(reach: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """r, shape (triangles, obstacles), in a run that starts with these distances [m] of the triangles: halved, where it is
    longer, until it is half of them at most. What starts in front of an obstacle is not behind it then."""
    halvings = np.ceil(np.log2(2 * reach / distances[:, None], where=reach > 0, out=np.zeros_like(reach)))
    return np.where(reach > distances[:, None], reach * 0.5**halvings, reach)


def nodes_of_faces(arrays) -> np.ndarray:
    """The vertices on which points of each triangle of the surface depend, shape (k, 3), of curved faces (k, 6)."""
    return nodes_of_triangles(arrays.mesh) if arrays.curved else arrays.mesh.surface_triangles


def around_vertices(nodes: np.ndarray, num_vertices: int) -> tuple[np.ndarray, ...]:
    """(start, face, place): the triangles around vertex i are face[start[i]] .. face[start[i + 1] - 1], as whose node
    number `place` it stands."""
    entries = np.argsort(nodes.ravel(), kind="stable")
    start = np.searchsorted(nodes.ravel()[entries], np.arange(num_vertices + 1))
    return start, *np.divmod(entries, nodes.shape[1])


def face_rows(arrays) -> tuple[np.ndarray, ...]:
    """(start, next, parts, reach, weight): the triangles around vertex i are start[i] .. start[i + 1]; of each, its two
    other corners, where faces are curved its six nodes, the place of i among them and whether it is the inner triangle; and
    its lattice before each obstacle."""
    nodes = nodes_of_faces(arrays)
    start, f, a = around_vertices(nodes, arrays.mesh.num_vertices)
    if arrays.curved:
        following = np.concatenate([nodes[f], a[:, None], (f % 4 == 3)[:, None]], 1)
    else:
        following = np.stack([nodes[f, (a + 1) % 3], nodes[f, (a + 2) % 3]], 1)
    return start, following, *(x[f] for x in lattices(arrays))


def rest_of_areas(arrays, rest, by_rows) -> np.ndarray:
    """Adjoint of the rest positions, shape (num_vertices, 3), for adjoints of the triangles' areas by the rows above."""
    faces = arrays.mesh.surface_triangles
    _, f, _ = around_vertices(nodes_of_faces(arrays), arrays.mesh.num_vertices)
    return geometry.triangle_areas_vjp(rest, faces, np.bincount(f, by_rows, len(faces)))
