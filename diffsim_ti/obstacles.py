"""What stands around a body, as triangles to draw: a scene's obstacles by type, and its floor."""

import numpy as np

ROUND = 32  # sides of what is round


def floor_of(scene) -> float | None:
    """Height of a scene's floor [m], or None."""
    for term in scene.terms:
        values = getattr(term, "values", {})
        if "ground_height" in values:
            return float(values["ground_height"])
        if "half_space_point" in values and np.allclose(_unit(values["half_space_normal"]), [0, 1, 0]):
            return float(values["half_space_point"][1])
    return None


def obstacle_surfaces(scene, time: float = 0.0) -> list[tuple[np.ndarray, np.ndarray]]:
    """(points [m], shape (k, 3), triangles) of each obstacle of a scene at `time` [s], floors left out.

    Balls, boxes, capsules, cylinders, triangle meshes, slanted planes as large squares, and a hollow ball as the bowl that
    its lower half is, seen from within.
    """
    out = []
    for term in scene.terms:
        shape = _surface(term, scene)
        if shape is not None:
            out.append((shape[0] + _offset(term, time), shape[1]))
    return out


def _surface(term, scene):
    values = getattr(term, "values", {})
    if "sphere_radius" in values:
        return (bowl if term.inside else ball)(values["sphere_center"], float(values["sphere_radius"]))
    if "box_size" in values:
        return box(values["box_center"], values["box_size"], values["box_rotation"])
    for kind in ("capsule", "cylinder"):
        if f"{kind}_radius" in values:
            ends = values[f"{kind}_start"], values[f"{kind}_end"]
            return tube(*ends, float(values[f"{kind}_radius"]), rounded=kind == "capsule")
    if "mesh_position" in values:
        points, triangles = term._surface
        return points + values["mesh_position"], triangles
    if "half_space_point" in values and not np.allclose(_unit(values["half_space_normal"]), [0, 1, 0]):
        return square(values["half_space_point"], values["half_space_normal"], np.ptp(scene.mesh.bounding_box, 0).max())
    return None


def _offset(term, time: float) -> np.ndarray:
    """Where a moving obstacle has got to [m]."""
    if getattr(term, "path", None) is None:
        return np.zeros(3)
    from diffsim_ti.terms.motion import sampled

    return sampled("path", term.path, [time], 1)[0, 0]


def revolved(center, axis, along: np.ndarray, radius: np.ndarray):
    """A surface of revolution: rings `along` the axis from `center`, closed where the radius ends in 0."""
    axis = _unit(axis)
    first = _unit(np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0]))
    angle = np.arange(ROUND) * 2 * np.pi / ROUND
    rim = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(axis, first)
    points = np.asarray(center) + along[:, None, None] * axis + radius[:, None, None] * rim
    k, j = np.meshgrid(np.arange(len(along) - 1), np.arange(ROUND), indexing="ij")
    a, b = (k * ROUND + j).ravel(), (k * ROUND + (j + 1) % ROUND).ravel()
    c, d = a + ROUND, b + ROUND
    return points.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def ball(center, radius: float):
    angle = np.linspace(-np.pi / 2, np.pi / 2, ROUND // 2 + 1)
    return revolved(center, (0.0, 1.0, 0.0), radius * np.sin(angle), radius * np.cos(angle))


def bowl(center, radius: float):
    """The lower half of a hollow ball: it faces inwards, so that the side near the eye is not drawn."""
    angle = np.linspace(-np.pi / 2, 0, ROUND // 2 + 1)
    points, triangles = revolved(center, (0.0, 1.0, 0.0), radius * np.sin(angle), radius * np.cos(angle))
    return points, triangles[:, ::-1]


def tube(start, end, radius: float, rounded: bool):
    """A cylinder, its ends flat or round."""
    length = np.linalg.norm(end - start)
    sides = np.linspace(0, length, 9)
    if rounded:
        angle = np.linspace(0, np.pi / 2, ROUND // 4 + 1)
        along = np.concatenate([-radius * np.cos(angle), sides[1:-1], length + radius * np.sin(angle)])
        return revolved(start, end - start, along, radius * np.concatenate([np.sin(angle), np.ones(7), np.cos(angle)]))
    caps = np.linspace(0, radius, 4)
    along = np.concatenate([np.zeros(4), sides[1:-1], np.full(4, length)])
    return revolved(start, end - start, along, np.concatenate([caps, np.full(7, radius), caps[::-1]]))


def box(center, size, quaternion):
    """A box turned by a quaternion (w, x, y, z), its sides in small squares."""
    from scipy.spatial.transform import Rotation

    points, triangles = [], []
    for d in range(3):
        for sign in (-1, 1):
            flat, cells = _grid(8)
            local = np.empty((len(flat), 3))
            local[:, d], local[:, [(d + 1) % 3, (d + 2) % 3]] = 0.5 * sign, flat
            triangles.append((cells if sign > 0 else cells[:, ::-1]) + sum(map(len, points)))
            points.append(local)
    turn = Rotation.from_quat(np.roll(quaternion, -1))
    return turn.apply(np.concatenate(points) * size) + center, np.concatenate(triangles)


def square(point, normal, size: float):
    """A square of a plane, four times as wide as `size` [m]."""
    normal = _unit(normal)
    first = _unit(np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0]))
    flat, cells = _grid(16)
    return point + 4 * size * (flat[:, :1] * first + flat[:, 1:] * np.cross(normal, first)), cells


def _grid(n: int):
    """The unit square about 0 in 2 n^2 triangles."""
    x, y = (g.ravel() for g in np.meshgrid(*[np.linspace(-0.5, 0.5, n + 1)] * 2, indexing="ij"))
    i, j = (g.ravel() for g in np.meshgrid(*[np.arange(n)] * 2, indexing="ij"))
    a = i * (n + 1) + j
    b, c, d = a + n + 1, a + 1, a + n + 2
    return np.stack([x, y], 1), np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def _unit(v) -> np.ndarray:
    return np.asarray(v, np.float64) / np.linalg.norm(v)
