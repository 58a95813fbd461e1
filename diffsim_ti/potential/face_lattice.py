"""Where the points within a face lie that feel an obstacle, and how their part in it fades in (faces.py)."""

import numpy as np
import taichi as ti

from diffsim_ti.mesh import geometry
from diffsim_ti.terms.obstacles import barrier

FLAT, BENT, GROWTH = 0.02, 0.12, 8
PER_WIDTH, MOST_PARTS = 4, 64  # lattice points along a width; along the side of a face
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
    """Whether points are the firmer, the narrower their obstacle is; a spline's t ends with its grid."""
    return force.per_area and not force.grain


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


# F = beta(s) phi(t), or per area (beta(s) - beta(s + t)) phi(t), and its derivatives


@ti.func
def point_energy(s, t, force: ti.template(), fp: ti.template()):
    """F"""
    b = barrier.value(s, fp)
    if ti.static(force.per_area):
        b -= barrier.value(s + t, fp)
    p, _, _ = fade(t, force, fp)
    return b * p


@ti.func
def point_slopes(s, t, force: ti.template(), fp: ti.template()):
    """dF/ds, dF/dt"""
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
    b, b1, b2 = barrier.value(s, fp), barrier.slope(s, fp), barrier.curvature(s, fp)
    p, p1, p2 = fade(t, force, fp)
    ss, st, tt = b2 * p, b1 * p1, b * p2
    if ti.static(force.per_area):
        c, c1, c2 = barrier.value(s + t, fp), barrier.slope(s + t, fp), barrier.curvature(s + t, fp)
        ss, st, tt = (b2 - c2) * p, (b1 - c1) * p1 - c2 * p, (b - c) * p2 - (c1 + c1) * p1 - c2 * p
    return ss, st, tt


def face_rows(mesh, terms) -> tuple[np.ndarray, ...]:
    """(start, next, parts, reach, weight): the faces around vertex i are start[i] .. start[i + 1]; of each, its two other
    corners and, for each obstacle, in how many parts the lattice cuts its sides, r [m] and c (faces.py)."""
    faces, n = mesh.surface_triangles, mesh.num_vertices
    corner, own = np.argsort(faces.ravel(), kind="stable"), np.sort(faces.ravel(), kind="stable")
    f, a = corner // 3, corner % 3
    x = mesh.vertices[faces]
    longest = np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(1)
    widths = np.array([float(t.values["barrier_width"]) for t in terms])
    parts = np.clip(np.ceil(PER_WIDTH * longest[:, None] / widths), 2, MOST_PARTS).astype(int)
    start = np.searchsorted(own, np.arange(n + 1))
    apart = longest[:, None] / parts
    reach, weight = REACH * apart, (apart / widths) ** 2
    return start, np.stack([faces[f, (a + 1) % 3], faces[f, (a + 2) % 3]], 1), parts[f], reach[f], weight[f]


def rest_of_areas(mesh, rest, by_rows) -> np.ndarray:
    """Adjoint of the rest positions, shape (num_vertices, 3), for adjoints of the faces' areas by the rows above."""
    faces = mesh.surface_triangles
    by_faces = np.bincount(np.argsort(faces.ravel(), kind="stable") // 3, by_rows, len(faces))
    return geometry.triangle_areas_vjp(rest, faces, by_faces)
