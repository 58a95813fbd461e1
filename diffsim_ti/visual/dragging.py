"""Taking hold of a body with the mouse: which vertex is under the cursor, and the spring that pulls it."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.mesh import TetrahedralMesh

RATE, FASTEST = 15.0, 150.0  # of the whole body on the spring, and at most of what is held [1/s]
REACH = 0.2  # radius of what is held, as a share of the body's size
NEAR = 1e-12  # a ray along a triangle does not meet it


def picked_vertex(origin: ArrayLike, ray: ArrayLike, points: np.ndarray, triangles: np.ndarray) -> int | None:
    """The corner next to where a ray first enters a surface, or None if it misses.

    origin [m] and ray (unit), shape (3,); points [m], shape (k, 3); triangles, shape (n, 3), seen from outside only.
    Moller, Trumbore, Fast, minimum storage ray-triangle intersection, doi:10.1080/10867651.1997.10487468.
    """
    a, b, c = (points[triangles[:, k]] for k in range(3))
    p = np.cross(ray, c - a)
    determinant = np.einsum("nd,nd->n", b - a, p)  # > 0: the triangle faces the eye
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("nd,nd->n", origin - a, p) / determinant
        q = np.cross(origin - a, b - a)
        v = q @ ray / determinant
        along = np.einsum("nd,nd->n", c - a, q) / determinant
        hit = (determinant > NEAR * np.ptp(points, 0).max() ** 2) & (u >= 0) & (v >= 0) & (u + v <= 1) & (along > 0)
    if not hit.any():
        return None
    first = np.flatnonzero(hit)[np.argmin(along[hit])]
    corners = triangles[first]
    return int(corners[np.argmin(np.linalg.norm(points[corners] - (origin + along[first] * ray), axis=1))])


class Grip:
    """A spring between a vertex, with the matter around it, and a point that the mouse moves.

    mesh: the body; mass [kg], shape (num_vertices,); vertex: the one that was picked; target [m]: where it is pulled to.
    Forces on the vertices are those of a critically damped spring on what is held, w m (r^2 (target - x_vertex) - 2 r v),
    w = exp(-(distance / reach)^2) at rest; r follows from sum(w m) r^2 = RATE^2 times the body's mass, up to FASTEST: any
    body can be lifted, and no step that animates it is too long.
    """

    def __init__(self, mesh: TetrahedralMesh, mass: np.ndarray, vertex: int):
        size = float(np.ptp(mesh.bounding_box, 0).max())
        away = np.linalg.norm(mesh.vertices - mesh.vertices[vertex], axis=1)
        self.vertex, self.longest, self.target = vertex, size, None
        self.held = mass * np.exp(-((away / (REACH * size)) ** 2))
        self.rate = min(RATE * float(np.sqrt(mass.sum() / self.held.sum())), FASTEST)

    def forces(self, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
        """Forces [N], shape (num_vertices, 3); zero without a target, and those of at most the body's size when further."""
        if self.target is None:
            return np.zeros(positions.shape)
        pull = self.target - positions[self.vertex]
        pull = pull * min(1.0, self.longest / max(np.linalg.norm(pull), 1e-300))
        return self.held[:, None] * (self.rate**2 * pull - 2 * self.rate * velocities)
