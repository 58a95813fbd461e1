"""Corners and edges that obstacles bring to the pairs of a scene (terms/obstacles/primitives.py): where they are in a pass,
how fast, and the chain from there to the obstacles' numbers and poses.

A corner lies at x = c + t + R (p - c), p where the numbers of the obstacle's shape put it, c, t, R of its pose
(state/obstacle_poses.py). In pairs it is a vertex of infinite mass that follows no node. The edges of an obstacle act on
edges of bodies, its points on triangles; vertices of bodies meet the obstacle by its distance (mechanics/obstacles).

A stiffness per area is multiplied by the area that the body's primitive stands for in the mesh: a triangle by its own, an
edge by a third of its triangles'.
"""

from functools import cached_property
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.common import rotations
from diffsim_ti.differentiation.arrays import Recorded, forward, reverse, value_of
from diffsim_ti.mesh.geometry import triangle_normals
from diffsim_ti.mesh.sets import pieces
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE, RATE, TAU
from diffsim_ti.terms.obstacles.primitives import Primitives


class ObstacleCorners:
    """Of the obstacles of a scene that act by pairs. Rows of poses are those of state/obstacle_poses.py; parameters those of
    the scene, as loaded. some: of some obstacles, by number, what alone they are to have of their primitives."""

    def __init__(self, arrays, some: dict[int, Primitives] | None = None):
        self.a, self.parts, end = arrays, [], 0
        for k, ((force, first, _), term) in enumerate(zip(arrays.obstacles, arrays.contacts)):
            if term.primitives is not None:
                given = np.concatenate([np.ravel(x.value) for x in term.described if x.value is not None])
                given = given - term.shift(np.zeros(3))
                shape = np.r_[: force.count, force.size : force.size + term.num_extra]  # its numbers, from its first
                primitives = (some or {}).get(k, term.primitives)
                corners, _ = primitives.at(given[shape])
                own = slice(end, end := end + len(corners))
                part = dict(k=k, force=force, first=first, term=term, own=own, as_given=corners, shape=first + shape)
                self.parts.append(SimpleNamespace(**part, primitives=primitives))
        self.count = end

    # functions of all parameters and of the rows of poses, of arrays that record, too: changes of rotations are theta

    def jvp(self, what: str, parameters, change, rows, rows_dot, *m: int) -> np.ndarray:
        """Change of one of them."""
        p, q = Recorded(parameters), Recorded(rows)
        return forward(getattr(self, what)(p, q, *m), [(p, change), (q, rows_dot)])

    def vjp(self, what: str, parameters, rows, by, by_parameters, by_rows, *m: int) -> None:
        """Adds the adjoints of the parameters and of the rows."""
        p, q = Recorded(parameters), Recorded(rows)
        for total, more in zip((by_parameters, by_rows), reverse(getattr(self, what)(p, q, *m), by, [p, q])):
            if more is not None:
                total += more

    def made(self, parameters: np.ndarray) -> np.ndarray:
        """Where corners are as obstacles were made, shape (count, 3) [m]."""
        return np.concatenate([x.primitives.at(parameters[x.shape])[0] for x in self.parts])

    def radii(self, parameters: np.ndarray, rows=None) -> np.ndarray:
        return np.stack([x.primitives.at(parameters[x.shape])[1] for x in self.parts])

    def at(self, parameters: np.ndarray, rows: np.ndarray, m: int = AT_STAGE) -> np.ndarray:
        """Where corners are at the rows number m of poses."""
        out = []
        for x in self.parts:
            p, _ = x.primitives.at(parameters[x.shape])
            if self.row_of(x, m) is not None:
                c, arms = self._arms(x, parameters, rows, m, p)
                p = c + arms
            out.append(p + rows[3 * x.k + m])
        return np.concatenate(out)

    def row_of(self, part, m: int) -> int | None:
        """The row of rotations, None of an obstacle that does not turn."""
        place = self.a.poses.place_of.get(part.k)
        return None if place is None else 3 * place + m

    def about(self, part, parameters: np.ndarray) -> np.ndarray:
        at = part.first + part.force.index.about
        return parameters[at : at + 3]

    def _arms(self, part, parameters, rows, m: int, p) -> tuple:
        """(c, R (p - c)) of an obstacle that turns."""
        c, turn = self.about(part, parameters), rows[self.row_of(part, m)]
        now = value_of(turn)
        arms = rotations.turned(rotations.from_rodrigues(now), p - c)
        return c, arms + np.cross(turn - now, arms)

    def velocity(self, parameters: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Of corners [m/s], on the chord of a time tau from where the pass begins (mechanics/obstacles/turned.py)."""
        out = []
        for x in self.parts:
            p, _ = x.primitives.at(parameters[x.shape])
            v = np.zeros((x.own.stop - x.own.start, 3)) + rows[3 * x.k + RATE]
            row = self.row_of(x, 0)
            if row is not None:
                _, arms = self._arms(x, parameters, rows, AT_BEGIN, p)
                omega, now, tau = rows[row + RATE], value_of(rows)[row + RATE], value_of(rows)[row + TAU, 0]
                J, there = rotations.left_jacobian(tau * now), rotations.quaternion(tau * now)
                turning = np.cross((omega - now) @ J.T, rotations.turned(there, value_of(arms)))
                v = v + np.cross(now, arms @ J.T) + turning
            out.append(v)
        return np.concatenate(out)


class SurfaceWithObstacles:
    """The surface of a body and behind it the corners and edges of obstacles, as pairs read it; vertices of the body keep
    their numbers.

    body: a mesh, or its finer surface (mesh/collision_surface.py). owner: number of the contact of each vertex of
    `surface_vertices`. acting: vertices that meet triangles; the first own_edges edges are the body's, of which the first
    meeting_edges meet each other. areas: of each triangle and each edge.
    """

    def __init__(self, body, of_body: tuple, corners: ObstacleCorners, self_contact):
        """of_body: `edges_of` of its triangles."""
        (edges, sides), n, given = of_body, body.num_vertices, [x.as_given for x in corners.parts]
        self.num_vertices, self.first, self.vertices = n + corners.count, n, np.concatenate([body.vertices, *given])
        self.body, self.corners, self.surface_triangles = body, corners, body.surface_triangles
        self.surface_vertices = np.concatenate([body.surface_vertices, np.arange(n, self.num_vertices)])
        self.elements, self.tetrahedron_sets, self.vertex_sets = body.elements, body.tetrahedron_sets, body.vertex_sets
        begin = [(n + x.own.start, x.primitives) for x in corners.parts]
        self.edges = np.concatenate([edges, *(at + part.edges for at, part in begin)])
        points = np.concatenate([at + part.points for at, part in begin])
        self.own_edges, self.meeting_edges = len(edges), len(edges) if self_contact else 0
        self.acting = np.concatenate([body.surface_vertices[: None if self_contact else 0], points])
        size = np.linalg.norm(triangle_normals(body.vertices, body.surface_triangles), axis=1)
        of_edges = np.bincount(sides.ravel(), np.repeat(size / 3, 3), len(edges))
        self.areas = size, np.concatenate([of_edges, np.zeros(len(self.edges) - len(edges))])
        self.numbers = np.zeros(self.num_vertices, int)
        for number, part in enumerate(corners.parts, start=1):
            self.numbers[n + part.own.start : n + part.own.stop] = number
        self.owner = self.numbers[self.surface_vertices]

    def pieces(self) -> np.ndarray:
        """Which body, or obstacle, each vertex belongs to."""
        own = np.asarray(pieces(self.body))
        return np.concatenate([own[: self.first], own.max() + self.numbers[self.first :]])

    def name(self, vertex: int):
        """The obstacle that a vertex belongs to, or None."""
        number = int(self.numbers[vertex])
        return self.corners.parts[number - 1].term if number else None

    @cached_property
    def matrix(self):
        """C of vertices x = C X, without corners of obstacles, whose rows are empty."""
        from scipy.sparse import csr_matrix, identity, vstack

        own = getattr(self.body, "matrix", None)
        own = identity(self.body.num_vertices, format="csr") if own is None else own
        return vstack([own, csr_matrix((self.corners.count, own.shape[1]))], format="csr")

    @cached_property
    def with_corners(self):
        """The same for X of nodes and then of corners of obstacles."""
        from scipy.sparse import block_diag, identity

        return block_diag([self.matrix[: self.first], identity(self.corners.count)], format="csr")


class ObstacleMotion:
    """Where the corners of a SurfaceWithObstacles are, on the device too, and the adjoints of that. `given` and `given_dot`
    are displacements of all its vertices that no node gives, and changes of these."""

    def __init__(self, surface: SurfaceWithObstacles, arrays):
        self.surface, self.corners, self.a = surface, surface.corners, arrays
        self.given, self.given_dot, self.unmoved = (
            runtime.array(arrays.vector, surface.num_vertices) for _ in range(3)
        )
        for array in (self.given, self.given_dot, self.unmoved):
            runtime.fill(array, 0)
        self.rows, self.m = np.zeros((arrays.poses.size, 3)), AT_STAGE
        self.moves = any(x.term.path is not None or x.term.led is not None for x in self.corners.parts)
        self.displacements = np.zeros((self.corners.count, 3))
        self.by_parameters = self.by_rows = None

    @property
    def parameters(self) -> np.ndarray:
        return self.a.values.parameters

    def displacements_at(self, rows: np.ndarray, m: int = AT_STAGE) -> np.ndarray:
        """Displacements of corners from where they were made, at rows of poses."""
        return self.corners.at(self.parameters, rows, m) - self.corners.made(self.parameters)

    def _fill(self, target, corners: np.ndarray) -> None:
        out = np.zeros((self.surface.num_vertices, 3))
        out[self.surface.first :] = corners
        runtime.fill(target, out)

    def follow(self, rows: np.ndarray, m: int) -> None:
        self.rows, self.m = rows, m
        self.displacements = self.displacements_at(rows, m)
        self._fill(self.given, self.displacements)

    def change(self, parameters_dot: np.ndarray, rows_dot: np.ndarray | None) -> np.ndarray:
        """Changes of the displacements, for those of all parameters and of the rows of poses."""
        out = self.corners.jvp("at", self.parameters, parameters_dot, self.rows, rows_dot, self.m)
        self._fill(self.given_dot, out)
        return out

    def changes(self, parameters_dot: np.ndarray, rows_dot: np.ndarray | None) -> tuple[np.ndarray, ...]:
        """Those of where corners are where forces are taken and where the pass begins, and of their velocities."""
        given = self.parameters, parameters_dot, self.rows, rows_dot
        places = (self.corners.jvp("at", *given, m) for m in (AT_STAGE, AT_BEGIN))
        return *places, self.corners.jvp("velocity", *given)

    def velocities(self) -> np.ndarray:
        return self.corners.velocity(self.parameters, self.rows)

    def clear(self) -> None:
        """A reverse sweep begins."""
        self.by_parameters, self.by_rows = np.zeros_like(self.parameters), np.zeros_like(self.rows)

    def add_places(self, by_x: np.ndarray, m: int | None = None) -> None:
        """Add the adjoints by that of where corners are."""
        self._add("at", by_x, self.m if m is None else m)

    def add_velocities(self, by_v: np.ndarray) -> None:
        self._add("velocity", by_v)

    def _add(self, what: str, by: np.ndarray, *m: int) -> None:
        self.corners.vjp(what, self.parameters, self.rows, by, self.by_parameters, self.by_rows, *m)

    def take_rows(self) -> np.ndarray:
        """The adjoints of the rows of poses that were added in a pass."""
        out, self.by_rows = self.by_rows, np.zeros_like(self.rows)
        return out


class ContactNumbers:
    """Which numbers of the scene the contacts of a SurfaceWithObstacles have, on the device (listed_pair.py)."""

    def __init__(self, surface: SurfaceWithObstacles, arrays):
        self.surface, parts, term = surface, surface.corners.parts, arrays.self_contact
        self.of_bodies, rows = arrays.parameters_of_self_contact, [[0, 0, 0]]
        if term:
            index, first = term.index, self.of_bodies.start
            rows = [[first + index.stiffness, first + index.width, first + index.friction_speed * term.has_friction]]
        for x in parts:
            speed = x.force.index.friction_speed if x.force.friction else 0
            rows.append([x.first + k for k in (x.force.index.stiffness, x.force.index.width, speed)])
        self.rows = np.array(rows)
        mu = np.arange(first + index.friction, self.of_bodies.stop) if term and term.has_friction else np.zeros(0, int)
        self.rows_of_bodies = len(mu)
        rough = [x.first + x.force.index.friction for x in parts if x.force.friction]
        self.mu = np.concatenate([mu, rough]).astype(int)
        rough = np.array([x.force.friction for x in parts])
        self.row_of = np.where(rough, self.rows_of_bodies + np.cumsum(rough) - 1, -1)
        per_area = [0, *(int(x.force.per_area) for x in parts)]
        self.owner = runtime.upload(surface.owner, ti.i32)
        self.at_number = runtime.upload(self.rows.ravel(), ti.i32)
        self.at_row = runtime.upload(np.append(self.mu, 0), ti.i32)
        self.per_area = runtime.upload(np.array(per_area), ti.i32)
        self.radius = runtime.array(arrays.fp, len(rows))
        self.numbers_dot = runtime.array(arrays.vector, len(rows))
        self.widths = self.reach = None

    def load(self, parameters: np.ndarray) -> None:
        """Numbers that are loaded. widths: of the contacts; reach: how far each acts."""
        radii = np.append(0.0, self.surface.corners.radii(parameters))
        self.widths = parameters[self.rows[:, 1]]
        self.reach = self.widths + radii
        runtime.fill(self.radius, radii)

    def load_change(self, parameters, change: np.ndarray | None) -> None:
        """Changes of the numbers; None: zero."""
        rows = np.zeros((len(self.rows), 3))
        if change is not None:
            rows[:, :2] = change[self.rows[:, :2]]
            rows[1:, 2] = self.surface.corners.jvp("radii", parameters, change, 0.0, None)
            if not self.of_bodies.stop > self.of_bodies.start:
                rows[0] = 0
        runtime.fill(self.numbers_dot, rows)

    def collect(self, parameters, sums: np.ndarray, out: np.ndarray) -> None:
        """Adds to the adjoints of all parameters those by sums of (stiffness, width, -, radius) at each vertex."""
        total = np.zeros((len(self.rows), 4))
        np.add.at(total, self.surface.owner, sums)
        for c in range(0 if self.of_bodies.stop > self.of_bodies.start else 1, len(total)):
            out[self.rows[c, :2]] += total[c, :2]
        self.surface.corners.vjp("radii", parameters, 0.0, total[1:, 3], out, None)
