"""Contact of surfaces whose vertices are not those of the mesh, x = C X + g: sums over nodes, of the finer surface of curved
faces (mesh/collision_surface.py), and corners of obstacles, which their poses give (obstacle_corners.py). Displacements go
to them by C and g, forces back by C^T; all between is that of linear tetrahedra."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import Parts
from diffsim_ti.mechanics.surfaces.near_corners import NearCorners
from diffsim_ti.mechanics.surfaces.obstacle_corners import ObstacleMotion, SurfaceWithObstacles
from diffsim_ti.mesh.collision_surface import CollisionSurface, cuts_of
from diffsim_ti.mesh.geometry import edges_of
from diffsim_ti.runtime import A, Kernel, as_kernel, kernels_of, vector_type
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE

ROWS = dict(start="ints", index="ints", weight="scalars")


class CurvedLaggedFriction:
    """As LaggedFriction, of nodes: a potential of the points, so that friction on nodes is C^T that on points."""

    def __init__(self, pairs):
        self.pairs, self.inner, self.C, self.began = pairs, pairs.inner.friction, pairs.matrix, None

    def begin(self, u: np.ndarray, x: np.ndarray, per_gamma: float, presses: bool) -> None:
        """With obstacles where the pass begins; their corners have x = g - v / per_gamma, g where forces are taken."""
        self.began, self.x = (u, x, per_gamma, presses), self.C @ x
        self.given, obstacles = np.zeros_like(self.x), self.pairs.obstacles
        self.lost = obstacles.velocities() / per_gamma if obstacles else None
        self.inner.begin(self.pairs.spread(u), self.x, per_gamma, presses)
        self.follow()

    def follow(self) -> None:
        """Obstacles are elsewhere."""
        if self.pairs.obstacles:
            first = self.pairs.finer.mesh.first
            self.given[first:] = self.pairs.obstacles.displacements
            self.x[first:] = self.given[first:] - self.lost
            self.inner.lag(self.x)

    def without(self):
        return self.inner.without()

    def _fine(self, u: np.ndarray) -> np.ndarray:
        return self.C @ u + self.given

    def forces(self, u: np.ndarray, only: int | None = None) -> np.ndarray:
        return self.C.T @ self.inner.forces(self._fine(u), only)

    def jvp(self, u, du, dx, du_begin, numbers, poses_dot=None, only: int | None = None) -> np.ndarray:
        """poses_dot: changes of the rows of poses, None: zero."""
        C, obstacles = self.C, self.pairs.obstacles
        changes = [C @ du, C @ dx, C @ du_begin]
        if obstacles:
            change = runtime.fetch(numbers.parameters)[: len(obstacles.parameters)].astype(np.float64)
            given = obstacles.changes(change, poses_dot)
            for change, corners in zip(changes, (given[0], given[0] - given[2] / self.inner.per_gamma, given[1])):
                change[self.pairs.finer.mesh.first :] = corners
        return C.T @ self.inner.jvp(self._fine(u), *changes, self.pairs.fine_numbers(numbers), only=only)

    def vjp(self, u: np.ndarray, forces_adj: np.ndarray, only: int | None = None) -> tuple[np.ndarray, ...]:
        found, obstacles = self.inner.vjp(self._fine(u), self.C @ forces_adj, only), self.pairs.obstacles
        if obstacles:
            by_u, by_x, by_begin = (by[self.pairs.finer.mesh.first :] for by in found)
            obstacles.add_places(by_u + by_x, AT_STAGE)
            obstacles.add_places(by_begin, AT_BEGIN)
            obstacles.add_velocities(-by_x / self.inner.per_gamma)
        return tuple(self.C.T @ by for by in found)


def pairs_of(kind: type, arrays, parallel: bool):
    """Pairs of a kind (surface_pairs.py, implicit_pairs.py), of a finer surface where faces are curved and smooth, and with
    the corners of obstacles; None where a scene has none."""
    mesh, has_corners = arrays.mesh, any(x.primitives is not None for x in arrays.contacts)
    if not (arrays.self_contact or has_corners):
        return None
    cuts = cuts_of(mesh, arrays.width_of_pairs, arrays.bend)
    body = CollisionSurface(mesh, cuts) if cuts else mesh
    if body is mesh and not has_corners:
        return kind(arrays, parallel)
    return CurvedPairs(kind, arrays, parallel, body, NearCorners(arrays, body) if has_corners else None)


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

    @as_kernel(
        "refine", "vectors2", "vectors2", lambda self: dict(given="vectors") if self.has_given else {}, slot="int"
    )
    def refine(self, rows: A, at: A, plan: A):
        """target[0] = C source[slot] + given"""
        ti.loop_config(serialize=not self.parallel)
        for k in range(plan.count):
            total = self.vector(0)
            for m in range(rows.start[k], rows.start[k + 1]):
                total += rows.weight[m] * at.source[plan.slot, rows.index[m]]
            if ti.static(self.has_given):
                total += at.given[k]
            at.target[0, k] = total

    @as_kernel("gather_points", "vectors", "vectors", first="int")
    def gather(self, rows: A, at: A, plan: A):
        """target[first + k] = (rows source)[k]"""
        ti.loop_config(serialize=not self.parallel)
        for k in range(plan.count):
            total = self.vector(0)
            for m in range(rows.start[k], rows.start[k + 1]):
                total += rows.weight[m] * at.source[rows.index[m]]
            at.target[plan.first + k] = total

    @as_kernel("add_point_blocks", "vectors2", "vectors2")
    def add_blocks(self, rows: A, at: A, plan: A):
        """Adds to rows 0..2 of target those of source, by squares of the weights."""
        ti.loop_config(serialize=not self.parallel)
        for k in range(plan.count):
            for m in range(rows.start[k], rows.start[k + 1]):
                for d in range(3):
                    w = rows.weight[m] * rows.weight[m]
                    at.target[d, k] = at.target[d, k] + w * at.source[d, rows.index[m]]


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

    obstacles: where corners of obstacles are (ObstacleMotion), None without. nearby: which there are; `inner`, and all
    that belongs to it, is made anew where others are near.
    """

    def __init__(self, kind: type, arrays, parallel: bool, body, nearby: NearCorners | None):
        self.a, self.nearby, self._kind, self._body = arrays, nearby, kind, body
        self._edges = edges_of(body.surface_triangles) if nearby else None
        self.kernels = kernels_of(Transfer, arrays.precision, parallel, nearby is not None)
        self._began, self._sums = None, None  # what a pass began with, in Newton's method; adjoints of who went
        self._hold()

    def _hold(self) -> None:
        """Have the corners that are near."""
        arrays, parallel, surface = self.a, self.kernels.parallel, self._body
        if self.nearby:
            surface = SurfaceWithObstacles(surface, self._edges, self.nearby.corners, arrays.self_contact)
        self.finer, self.matrix = FinerArrays(arrays, surface), surface.matrix
        self.obstacles = ObstacleMotion(surface, arrays) if self.nearby else None
        self.inner = self._kind(self.finer, parallel)
        self._most_nodes = int(np.diff(surface.matrix.indptr).max(initial=1))  # that a corner is a sum over
        fp, vector = arrays.fp, arrays.vector
        self.down, self.up = _rows(surface.matrix, fp), _rows(surface.matrix.T.tocsr(), fp)
        of_corners = surface.matrix.T.tocsr()[arrays.mesh.surface_vertices][:, surface.surface_vertices]
        self.to_corners, self.num_corners = _rows(of_corners.tocsr(), fp), len(arrays.mesh.surface_vertices)
        self._u, self._w, self._blocks = (runtime.array(vector, k, surface.num_vertices) for k in (1, 1, 3))
        self._rest_dot = runtime.array(vector, surface.num_vertices)
        self.inner.sizes["anew"] = 1
        # cleared where arrays of the list are others
        self._launch, self.launch = self.inner.list.launch, self.inner.launch
        self.friction = CurvedLaggedFriction(self) if self.inner.friction else None

    # ---- what is near ------------------------------------------------------------------------------------------------

    def cover(self, *places: np.ndarray, to=None, anew: bool = False, more: float = 0.0) -> None:
        """Have all corners that are within reach of bodies at displacements of the nodes, and between them, while obstacles
        are where they are, or go to rows of poses; anew: and few others; more: than the reach [m]."""
        if self.is_covered(*places, to=to, anew=anew, more=more) or not self.nearby.take():
            return
        gone, obstacles, friction = self.inner, self.obstacles, self.friction
        if self._sums:
            self._sums = self.collect()
        self._hold()
        self.inner.contacts.load(self.a.values.parameters)
        self.inner.checked_rest = gone.checked_rest
        if self._sums:
            self._clear()
        self.obstacles.by_rows = obstacles.by_rows
        if self._began:
            u, ahead, rows = self._began
            self.obstacles.follow(rows, AT_BEGIN)
            self.inner.begin(self.spread(u), self.matrix @ ahead)
            if friction and friction.began:
                self.friction.begin(*friction.began)
        self.follow(obstacles.rows, obstacles.m)

    def is_covered(self, *places: np.ndarray, to=None, anew: bool = False, more: float = 0.0) -> bool:
        """Whether they are there; which, where not, `nearby` knows then."""
        if not (self.nearby and self.nearby.many):
            return True
        at, reach = self.obstacles, self.inner.longest_reach + more
        poses = [(at.rows, m) for m in ((AT_BEGIN, AT_STAGE) if anew else (at.m,))]
        return self.nearby.has(places, poses + ([] if to is None else [(to, AT_STAGE)]), reach, anew)

    # ---- between nodes and points ------------------------------------------------------------------------------------

    def _refining(self, u, slot: int, target, given: str) -> tuple:
        self.finer.follow()
        more = {"given": getattr(self.obstacles, given)} if self.obstacles else {}
        records = dict(rows=self.down, at=SimpleNamespace(source=u, target=target, **more))
        return self.kernels.refine, records, dict(count=self.finer.num_vertices, slot=slot)

    def _fine(self, *what):
        self.launch([self._refining(*what)])
        return what[2]

    def _covered(self, u):
        """Displacements of the finer surface, from u[0], with all that is near; to be asked for before `inner`, which may be
        made anew."""
        if self.nearby:
            self.cover(runtime.fetch_row(u, 0))
        return self.fine(u, 0)

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
            if self.friction and self.friction.began:
                self.friction.follow()

    def _add_corners(self) -> None:
        """Add what the points' corners say of obstacles, to their adjoints."""
        if self.obstacles:
            first = len(self.finer.mesh.body.surface_vertices)
            self.obstacles.add_places(runtime.fetch(self.finer.corner)[first:].astype(np.float64))

    # ---- as of pairs of nodes ----------------------------------------------------------------------------------------

    @property
    def list(self):
        return self.inner.list

    @property
    def builds(self) -> int:
        return self.inner.builds

    def load(self, u) -> None:
        self._began = None
        if self.nearby:
            self.nearby.load()
            self.inner.contacts.load(self.a.values.parameters)
        fine = self._covered(u)
        self.inner.load(fine)

    def check_apart(self, u) -> None:
        fine = self._covered(u)
        self.inner.check_apart(fine)

    def forget(self, u) -> None:
        self._began = None
        fine = self._covered(u)
        self.inner.forget(fine)

    def look(self, u) -> tuple[float, float]:
        fine = self._covered(u)
        return self.inner.look(fine)

    def unbind(self) -> None:
        self.inner.unbind()

    def forces(self, u, slot: int, out) -> None:
        self.inner.forces(self.fine(u, slot), 0, self.finer.corner)
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
        self._sums = 0.0, 0.0
        self._clear()

    def _clear(self) -> None:
        self.inner.clear_sums()
        if self.obstacles:
            self.obstacles.clear()

    def vjp(self, u, slot: int, w, out, only: int | None = None) -> None:
        self.inner.vjp(self.fine(u, slot), 0, self.fine_change(w), self.finer.corner, only)
        self._gather(out)
        self._add_corners()

    def collect(self) -> tuple[np.ndarray, np.ndarray]:
        (numbers, rest), (of_gone, rest_of_gone) = self.inner.collect(), self._sums or (0.0, 0.0)
        numbers = numbers + self.obstacles.by_parameters if self.obstacles else numbers
        return numbers + of_gone, self.matrix.T @ rest + rest_of_gone

    # ---- in Newton's method ------------------------------------------------------------------------------------------

    def begin(self, u: np.ndarray, ahead: np.ndarray) -> None:
        self._began = None
        self.cover(u, u + ahead, anew=True)
        self.inner.begin(self.spread(u), self.matrix @ ahead)
        if self.nearby:
            self._began = u.copy(), ahead.copy(), self.obstacles.rows.copy()

    @property
    def asks(self) -> bool:
        """Whether others than those that are there may come near on the way of a step."""
        return bool(self.nearby and self.nearby.many)

    @property
    def version(self) -> tuple:
        return self.inner.version

    def place(self, u) -> None:
        fine = self._covered(u)
        self.inner.place(fine)
        self._gather(self.a.corner)

    def reach(self, u) -> None:
        fine = self._covered(u)
        self.inner.reach(fine)

    def placing(self, u) -> Parts:
        own = self.inner.placing(self._u)
        return [self._refining(u, 0, self._u, "given"), *own, self._gathering(self.a.corner)]

    def energies(self) -> np.ndarray:
        return self.inner.energies()

    def holding(self, u, w) -> Parts:
        there, step = self.inner.next, self.inner.step
        refining = self._refining(u, 0, there, "given"), self._refining(w, 0, step, "unmoved")
        return [*refining, *self.inner.holding(there, step)]

    def turning(self, u, w) -> Parts:
        if not self.friction:
            return []
        refining = self._refining(u, 0, self._u, "given"), self._refining(w, 0, self.inner.step, "unmoved")
        return [*refining, *self.inner.turning(self._u, self.inner.step)]

    def multiplying(self, u, w, convex: bool) -> Parts:
        refining = self._refining(w, 0, self._w, "unmoved")
        return [refining, *self.inner.multiplying(self.fine(u, 0), self._w, convex), self._gathering(self.a.corner)]

    def adding_blocks(self, u, out) -> Parts:
        """Those of points by squares of what nodes have of them, without what two points of a node have in common."""
        at = SimpleNamespace(source=self._blocks, target=out)
        add = self.kernels.add_blocks, dict(rows=self.up, at=at), dict(count=self.a.num_vertices)
        return [*self.inner.adding_blocks(self.fine(u, 0), self._blocks), add]

    @property
    def overlap(self) -> int:
        return self.inner.overlap * self._most_nodes

    def stiffness(self, u) -> tuple:
        from scipy.sparse import eye, kron

        matrix, diagonal = self.inner.stiffness(self.fine(u, 0))
        up = kron(self.matrix.T, eye(3), "csr")
        squares = self.matrix.T.multiply(self.matrix.T) @ diagonal.reshape(-1, 9)
        return (up @ matrix @ up.T).tobsr((3, 3)), squares.reshape(-1, 3, 3)

    def _step(self, step: np.ndarray, to) -> np.ndarray:
        return self.spread(
            step, 0.0 if to is None else self.obstacles.displacements_at(to) - self.obstacles.displacements
        )

    def safe_share(self, u: np.ndarray, step: np.ndarray, most: float = 1.0, to=None, placed: bool = False) -> float:
        """to: rows of poses to where obstacles go meanwhile; None: they stand still."""
        inner = self.inner
        self.cover(u, u + most * step, to=to)
        return self.inner.safe_share(self.spread(u), self._step(step, to), most, placed and self.inner is inner)

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

    def is_collision_free(self, u: np.ndarray, step: np.ndarray) -> bool:
        self.cover(u, u + step)
        return self.inner.is_collision_free(self.spread(u), self._step(step, None))

    def check_end(self, u: np.ndarray, u_next: np.ndarray, to=None) -> None:
        self.cover(u, u_next, to=to)
        self.inner.check_end(self.spread(u), self.spread(u) + self._step(u_next - u, to))


def _rows(matrix, fp) -> SimpleNamespace:
    """A CSR matrix on the device."""
    return SimpleNamespace(
        start=runtime.upload(matrix.indptr, ti.i32),
        index=runtime.upload(matrix.indices, ti.i32),
        weight=runtime.upload(matrix.data, fp),
    )
