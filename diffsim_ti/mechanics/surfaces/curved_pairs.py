"""Contact of surfaces whose vertices are not those of the mesh, x = C X + g: sums over nodes, of the finer surface of curved
faces (mesh/collision_surface.py), and corners of obstacles, which their poses give (obstacle_corners.py). Displacements go
to them by C and g, forces back by C^T; all between is that of linear tetrahedra."""

from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.curved_friction import CurvedLaggedFriction
from diffsim_ti.mechanics.surfaces.obstacle_corners import ObstacleCorners, ObstacleMotion, SurfaceWithObstacles
from diffsim_ti.mechanics.surfaces.surface_pairs import surface_edges
from diffsim_ti.mesh.collision_surface import CollisionSurface, cuts_of
from diffsim_ti.runtime import Kernel, kernels_of, vector_type

A = ti.template()
ROWS = dict(start="ints", index="ints", weight="scalars")


def pairs_of(kind: type, arrays, parallel: bool):
    """Pairs of a kind (surface_pairs.py, implicit_pairs.py), of a finer surface where faces are curved and smooth, and with
    the corners of obstacles; None where a scene has none."""
    mesh, term = arrays.mesh, arrays.self_contact
    corners = ObstacleCorners(arrays) if any(x.primitives is not None for x in arrays.contacts) else None
    if not (term or corners):
        return None
    cuts = cuts_of(mesh, arrays.width_of_pairs, arrays.bend)
    surface = CollisionSurface(mesh, cuts) if cuts else mesh
    if corners:
        surface = SurfaceWithObstacles(surface, surface_edges(surface), corners, term)
    return kind(arrays, parallel) if surface is mesh else CurvedPairs(kind, arrays, parallel, surface)


@dataclass(frozen=True)
class Transfer:
    """Products with a sparse matrix of few rows, whose entries are `rows`."""

    precision: str
    parallel: bool
    has_given: bool = False  # whether vertices have a part that no node gives

    def _kernel(self, name: str, body, source: str, target: str, given: dict | None = None, **numbers) -> Kernel:
        own = dict(rows=ROWS, at=dict(source=source, target=target) | (given or {}))
        return Kernel(name, body, self.precision, own, dict(count="int") | numbers)

    vector = vector_type

    @ti.func
    def refine_all(self, rows: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for k in range(plan.count):
            total = self.vector(0)
            for m in range(rows.start[k], rows.start[k + 1]):
                total += rows.weight[m] * at.source[plan.slot, rows.index[m]]
            if ti.static(self.has_given):
                total += at.given[k]
            at.target[0, k] = total

    @cached_property
    def refine(self) -> Kernel:
        """target[0] = C source[slot] + given"""
        given = dict(given="vectors") if self.has_given else {}
        return self._kernel("refine", self.refine_all, "vectors2", "vectors2", given, slot="int")

    @ti.func
    def gather_all(self, rows: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for k in range(plan.count):
            total = self.vector(0)
            for m in range(rows.start[k], rows.start[k + 1]):
                total += rows.weight[m] * at.source[rows.index[m]]
            at.target[plan.first + k] = total

    @cached_property
    def gather(self) -> Kernel:
        """target[first + k] = (rows source)[k]"""
        return self._kernel("gather_points", self.gather_all, "vectors", "vectors", first="int")

    @ti.func
    def add_all(self, rows: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for k in range(plan.count):
            for m in range(rows.start[k], rows.start[k + 1]):
                for d in range(3):
                    w = rows.weight[m] * rows.weight[m]
                    at.target[d, k] = at.target[d, k] + w * at.source[d, rows.index[m]]

    @cached_property
    def add_blocks(self) -> Kernel:
        """Adds to rows 0..2 of target those of source, by squares of the weights."""
        return self._kernel("add_point_blocks", self.add_all, "vectors2", "vectors2")


class FinerArrays:
    """What pairs read of the arrays of a scene, for the vertices of another surface."""

    first_contact_corner = 0

    def __init__(self, arrays, surface: "CollisionSurface | SurfaceWithObstacles"):
        self.scene, self.mesh, self.precision = arrays, surface, arrays.precision
        self.self_contact, self.num_vertices = arrays.self_contact, surface.num_vertices
        self.parameters_of_self_contact = arrays.parameters_of_self_contact
        self.fp, self.vector = arrays.fp, arrays.vector
        self.rest = runtime.array(arrays.vector, surface.num_vertices)
        self.corner = runtime.array(arrays.vector, len(surface.surface_vertices))
        self._taken = None

    @property
    def values(self):
        return self.scene.values

    @property
    def parameters(self):
        return self.scene.parameters

    def follow(self) -> None:
        """Take the rest shape that the scene has loaded."""
        if self._taken is not self.values:
            self._taken, rest = self.values, self.mesh.matrix @ (self.values.rest - self.scene.origin)
            if isinstance(self.mesh, SurfaceWithObstacles):
                rest[self.mesh.first :] = self.mesh.corners.made(self.values.parameters)
            runtime.fill(self.rest, rest)


class CurvedPairs:
    """As SurfacePairs or ImplicitPairs, for arrays of the nodes. Numbers of vertices in messages that the mesh does not have
    are those of the collision surface.

    obstacles: where corners of obstacles are (ObstacleMotion), None without.
    """

    def __init__(self, kind: type, arrays, parallel: bool, surface: "CollisionSurface | SurfaceWithObstacles"):
        self.a, self.finer, self.matrix = arrays, FinerArrays(arrays, surface), surface.matrix
        self.obstacles = ObstacleMotion(surface, arrays) if isinstance(surface, SurfaceWithObstacles) else None
        self.inner = kind(self.finer, parallel)
        self.kernels = kernels_of(Transfer, arrays.precision, parallel, self.obstacles is not None)
        fp, vector, n = arrays.fp, arrays.vector, arrays.num_vertices
        self.down, self.up = _rows(surface.matrix, fp), _rows(surface.matrix.T.tocsr(), fp)
        of_corners = surface.matrix.T.tocsr()[arrays.mesh.surface_vertices][:, surface.surface_vertices]
        self.to_corners, self.num_corners = _rows(of_corners.tocsr(), fp), len(arrays.mesh.surface_vertices)
        self._u, self._w, self._blocks = (runtime.array(vector, k, surface.num_vertices) for k in (1, 1, 3))
        self._row, self._rest_dot = runtime.array(vector, 1, n), runtime.array(vector, surface.num_vertices)
        self.step, self.next = runtime.array(vector, 1, n), runtime.array(vector, 1, n)
        # cleared where arrays of the list are others
        self._launch, self.launch = self.inner.list.launch, self.inner.launch
        self.friction = CurvedLaggedFriction(self) if self.inner.friction else None

    # ---- between nodes and points ------------------------------------------------------------------------------------

    def _refining(self, u, slot: int, target, given: str) -> tuple:
        self.finer.follow()
        more = {"given": getattr(self.obstacles, given)} if self.obstacles else {}
        records = dict(rows=self.down, at=SimpleNamespace(source=u, target=target, **more))
        return self.kernels.refine, records, dict(count=self.finer.num_vertices, slot=slot)

    def _fine(self, *what):
        self.launch([self._refining(*what)])
        return what[2]

    def fine(self, u, slot: int):
        """Displacements of the finer surface, from those of a slot."""
        return self._fine(u, slot, self._u, "given")

    def fine_change(self, w, given: str = "unmoved"):
        """Their changes, from w[0]; given: those of corners of obstacles."""
        return self._fine(w, 0, self._w, given)

    def fine_numbers(self, numbers) -> SimpleNamespace:
        """What pairs of the finer surface read of changes of numbers."""
        runtime.fill(self._rest_dot, self.matrix @ runtime.fetch(numbers.rest).astype(np.float64))
        return SimpleNamespace(rest=self._rest_dot, parameters=numbers.parameters)

    def parameters_of(self, numbers) -> np.ndarray:
        """Changes of all parameters, of a Tangent."""
        return runtime.fetch(numbers.parameters)[: len(self.a.values.parameters)].astype(np.float64)

    def _gathering(self, out) -> tuple:
        records = dict(rows=self.to_corners, at=SimpleNamespace(source=self.finer.corner, target=out))
        return self.kernels.gather, records, dict(count=self.num_corners, first=self.a.first_contact_corner)

    def _gather(self, out) -> None:
        """From the points' corners to those of the nodes, the last ones of `out`."""
        self.launch([self._gathering(out)])

    def spread(self, u: np.ndarray, to: np.ndarray | None = None) -> np.ndarray:
        """Displacements of the finer surface, of corners of obstacles to where they are, or are said to be."""
        self.finer.follow()
        out = self.matrix @ u
        if self.obstacles:
            out[self.finer.mesh.first :] = self.obstacles.displacements if to is None else to
        return out

    # ---- obstacles ---------------------------------------------------------------------------------------------------

    def follow(self, rows: np.ndarray, m: int) -> None:
        """Obstacles are where the rows number m of poses say (state/obstacle_poses.py)."""
        if self.obstacles:
            self.obstacles.follow(rows, m)

    def _add_corners(self) -> None:
        """Add what the points' corners say of obstacles, to their adjoints."""
        if self.obstacles:
            first = len(self.finer.mesh.body.surface_vertices)
            self.obstacles.add_places(runtime.fetch(self.finer.corner)[first:].astype(np.float64))

    # ---- as of pairs of nodes ----------------------------------------------------------------------------------------

    @property
    def width(self) -> float:
        return self.inner.width

    @property
    def list(self):
        return self.inner.list

    @property
    def builds(self) -> int:
        return self.inner.builds

    def load(self, u) -> None:
        self.inner.load(self.fine(u, 0))

    def check_apart(self, u) -> None:
        self.inner.check_apart(self.fine(u, 0))

    def forget(self, u) -> None:
        self.inner.forget(self.fine(u, 0))

    def ensure(self, u, slot: int) -> None:
        self.inner.ensure(self.fine(u, slot), 0)

    def look(self, u) -> tuple[float, float]:
        return self.inner.look(self.fine(u, 0))

    def unbind(self) -> None:
        self.inner.unbind()

    def forces(self, u, slot: int, out, exact: bool = False) -> None:
        self.inner.forces(self.fine(u, slot), 0, self.finer.corner, exact)
        self._gather(out)

    def product(self, u, slot: int, w, out, rest_dot=None, parameters_dot=None, poses_dot=None) -> None:
        """poses_dot: changes of the rows of poses, None: zero."""
        if self.obstacles and parameters_dot is not None:
            self.obstacles.change(parameters_dot, poses_dot)
        given = "unmoved" if parameters_dot is None else "given_dot"
        fine_u, fine_w, moved = self.fine(u, slot), self.fine_change(w, given), None
        if rest_dot is not None:
            runtime.fill(self._rest_dot, self.matrix @ runtime.fetch(rest_dot).astype(np.float64))
            moved = self._rest_dot
        self.inner.product(fine_u, 0, fine_w, self.finer.corner, moved, parameters_dot)
        self._gather(out)

    def clear_sums(self) -> None:
        self.inner.clear_sums()
        if self.friction:
            self.friction.clear_sums()
        if self.obstacles:
            self.obstacles.clear()

    def vjp(self, u, slot: int, w, out, only: int | None = None) -> None:
        self.inner.vjp(self.fine(u, slot), 0, self.fine_change(w), self.finer.corner, only)
        self._gather(out)
        self._add_corners()

    def collect(self) -> tuple[np.ndarray, np.ndarray]:
        numbers, rest = self.inner.collect()
        return numbers + self.obstacles.by_parameters if self.obstacles else numbers, self.matrix.T @ rest

    # ---- in Newton's method ------------------------------------------------------------------------------------------

    def begin(self, u: np.ndarray, ahead: np.ndarray | None = None) -> None:
        runtime.fill(self.next, u[None])
        self.inner.begin(self.spread(u), None if ahead is None else self.matrix @ ahead)

    def place(self, u, on_way: bool = False) -> None:
        self.inner.place(self.fine(u, 0), on_way)
        self._gather(self.a.corner)

    def energies(self) -> np.ndarray:
        return self.inner.energies()

    def multiplying(self, u, w, convex: bool) -> tuple:
        refining = self._refining(w, 0, self._w, "unmoved")
        return refining, *self.inner.multiplying(self.fine(u, 0), self._w, convex), self._gathering(self.a.corner)

    def add_blocks(self, u, out) -> None:
        """Those of points by squares of what nodes have of them, without what two points of a node have in common."""
        runtime.fill(self._blocks, 0)
        self.inner.add_blocks(self.fine(u, 0), self._blocks)
        at = SimpleNamespace(source=self._blocks, target=out)
        self._launch(self.kernels.add_blocks, rows=self.up, at=at)(count=self.a.num_vertices)

    def _step(self, step: np.ndarray, drift) -> np.ndarray:
        return self.spread(step, 0.0 if drift is None else drift)

    def safe_share(self, u: np.ndarray, step: np.ndarray, most: float = 1.0, drift=None, placed: bool = False) -> float:
        """drift: displacements of corners of obstacles meanwhile; None: they stand still."""
        return self.inner.safe_share(self.spread(u), self._step(step, drift), most, placed)

    @property
    def met(self) -> tuple[tuple[int, ...], int | None] | None:
        """What stopped the last step: vertices of the body, and the obstacle; None where two bodies did."""
        surface, corners = self.finer.mesh, self.inner.blocked
        if corners is None:
            return None
        numbers = surface.numbers[corners]
        nodes = np.asarray(self.matrix[corners[numbers == 0]].argmax(1)).ravel()
        obstacle = surface.corners.parts[numbers.max() - 1].k if numbers.any() else None
        return tuple(int(i) for i in dict.fromkeys(nodes.tolist())), obstacle

    def is_collision_free(self, u: np.ndarray, step: np.ndarray, drift=None) -> bool:
        return self.inner.is_collision_free(self.spread(u), self._step(step, drift))

    def check_end(self, u: np.ndarray, u_next: np.ndarray, drift=None) -> None:
        self.inner.check_end(self.spread(u), self.spread(u) + self._step(u_next - u, drift))


def _rows(matrix, fp) -> SimpleNamespace:
    """A CSR matrix on the device."""
    return SimpleNamespace(
        start=runtime.upload(matrix.indptr, ti.i32),
        index=runtime.upload(matrix.indices, ti.i32),
        weight=runtime.upload(matrix.data, fp),
    )
