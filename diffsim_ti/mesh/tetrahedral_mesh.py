"""TetrahedralMesh: the rest shape of a soft body. Make, load, save, check, look at."""

import copy
import hashlib
import math
import warnings
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti import runtime
from diffsim_ti.common.checked import instance, listed, numbers
from diffsim_ti.common.origin import warn_of_rounding
from diffsim_ti.common.public import Public, public
from diffsim_ti.common.warn import warn
from diffsim_ti.mesh import checks, doctor, geometry
from diffsim_ti.mesh.elements import Elements
from diffsim_ti.mesh.exchange import Exchange
from diffsim_ti.mesh.grid import box
from diffsim_ti.mesh.jacobian import lowest_jacobian
from diffsim_ti.mesh.locate import LocatedPoints, locate
from diffsim_ti.mesh.named_sets import NamedSets
from diffsim_ti.mesh.reference_element import MID_EDGES
from diffsim_ti.mesh.seed_names import SeedNames
from diffsim_ti.mesh.sets import checked_sets, frozen, join, pieces, rows_on_surface, sizes

CONNECTIVITY = (  # what stays when vertices move
    "_elements _tetrahedra _surface_faces _surface_triangles _middles _vertex_sets _tetrahedron_sets _surface_sets".split()
)


class TetrahedralMesh(Exchange, NamedSets, Elements, SeedNames, metaclass=Public):
    """Tetrahedra of four or ten nodes at rest. Immutable: arrays are read-only float64 or int64, changes return a new mesh.

    vertices: positions [m], shape (num_vertices, 3).
    tetrahedra: vertex indices from 0, integers, shape (num_tetrahedra, 4), positive volume
        det [x1 - x0, x2 - x0, x3 - x0] / 6 > 0. With ten columns elements are quadratic: four corners, then the mid-edge
        vertices of 01, 12, 20, 03, 13, 23 (VTK's order), wherever they are as long as the map of the element is one to one.
    vertex_sets, tetrahedron_sets: name -> indices or Boolean mask; kept as sorted indices.
    surface_sets: name -> triangles of the surface as vertex indices, shape (k, 3), in any order; kept as sorted indices of
        rows of `surface_triangles`. Triangles within the body are left out. With ten nodes the corners of a face, alone or
        before its middles, shape (k, 6), stand for its four triangles.
    fix_orientation: swap two vertices of each inside-out tetrahedron instead of refusing it, and put mid-edge vertices of
        another order (Gmsh's is not VTK's) into place.

    Raises ValueError for wrong shapes or dtypes, indices out of range, non-finite coordinates, a repeated vertex in a
    tetrahedron, flat, inside-out, repeated or overlapping tetrahedra, a face of more than two tetrahedra, curved elements
    that are not one to one, and mid-edge vertices in another order. Warns (UserWarning) of vertices that no tetrahedron
    uses and of slivers. All thresholds are relative to the tetrahedron.

    >>> import diffsim_ti as ds
    >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> mesh = ds.TetrahedralMesh(corners, [[0, 1, 2, 3]], vertex_sets={"floor": [0, 1, 3]})
    >>> print(f"{mesh.volumes[0]:.4f} m^3, {len(mesh.surface_triangles)} faces, held: {mesh.vertex_indices('floor')}")
    0.1667 m^3, 4 faces, held: [0 1 3]
    """

    def __init__(
        self,
        vertices: ArrayLike,
        tetrahedra: ArrayLike,
        *,
        vertex_sets: dict | None = None,
        tetrahedron_sets: dict | None = None,
        surface_sets: dict | None = None,
        fix_orientation: bool = False,
    ):
        given, vertices = vertices, checks.checked_vertices(vertices)
        elements = checks.checked_tetrahedra(tetrahedra, len(vertices))
        volumes = checks.checked_volumes(vertices, elements[:, :4])
        elements = checks.oriented(elements, volumes, fix_orientation)
        if fix_orientation:
            elements = checks.middles_in_order(vertices, elements)
        volumes = checks.checked_curved_volumes(vertices, elements, np.abs(volumes))
        self._put(vertices, elements, volumes)
        self._vertex_sets = checked_sets(vertex_sets, self.num_vertices, "vertex")
        self._tetrahedron_sets = checked_sets(tetrahedron_sets, self.num_tetrahedra, "tetrahedron")
        on_surface = rows_on_surface(surface_sets, self._surface_triangles, self._surface_faces)
        self._surface_sets = checked_sets(on_surface, len(self._surface_triangles), "surface")
        checks.warn_of_orphans(self.unused_vertices)
        checks.warn_of_slivers(self)
        if twice := doctor.coinciding_of_pieces(self.vertices, self.elements):
            warn(
                f"{doctor.counted(twice, 'vertex coincides', 'vertices coincide')} with others of another piece "
                f"({self.num_pieces} pieces): if these are one body, take mesh.merged(); where they are meant to touch, "
                "TetrahedralMesh.joined says so"
            )
        if not doctor.is_manifold(self.surface_faces[:, :3]):
            for hinge in doctor.hinges(self.elements, self.num_vertices):
                warn(str(hinge))
        warn_of_rounding("vertices", given, self, "give them in float64")

    @classmethod
    @public
    def create_cube(
        cls,
        resolution: int = 5,
        size: float = 1.0,
        pattern: Literal["kuhn", "five"] = "kuhn",
        device: str | None = None,
    ) -> "TetrahedralMesh":
        """The cube [0, size]^3 [m], all of it filled; `resolution` counts vertices a side. See `create_box`.

        device: "cuda" starts Taichi on the card, or refuses if it runs elsewhere; the mesh itself lives in NumPy.
        """
        runtime.use_device(device)
        return cls.create_box(resolution, size, pattern)

    @classmethod
    @public
    def create_box(
        cls,
        resolution: ArrayLike = 5,
        size: ArrayLike = 1.0,
        pattern: Literal["kuhn", "five"] = "kuhn",
        origin: ArrayLike = (0, 0, 0),
    ) -> "TetrahedralMesh":
        """A box on a regular grid, with vertex sets and surface sets xmin, xmax, ymin, ymax, zmin, zmax.

        resolution: vertices per side, an integer of at least 2 or three of them.
        size: edge lengths [m], one number or three. origin: the lowest corner [m].
        pattern: "kuhn", six tetrahedra per cell, all cells alike; "five", five per cell, mirrored in every other cell
            (bends more freely when nearly incompressible). Both are conforming.
        Vertex (i, j, k) has index (i ny + j) nz + k.
        """
        vertices, tetrahedra, sides = box(resolution, size, pattern, origin)
        mesh = cls(vertices, tetrahedra, vertex_sets=sides)
        corners = mesh.surface_triangles
        rows = {name: np.isin(corners, side).all(1) for name, side in sides.items()}
        return mesh._changed(_surface_sets=checked_sets(rows, len(corners), "surface"))

    @classmethod
    @public
    def joined(cls, meshes: Mapping[str, "TetrahedralMesh"] | Iterable["TetrahedralMesh"]) -> "TetrahedralMesh":
        """Several bodies as one mesh of several pieces, one after the other.

        meshes: {"ball": ball, "left": finger}, which names them, or a list: "body_0", "body_1", ... Each body's vertices,
            tetrahedra and surface are sets of its name, which densities, laws, supports, friction and results take:
            `Scene(mesh, law, density={"ball": 900, "left": 1100})`, `CenterOfMass("ball")`.
        Sets of the same name become one, and what each body has of them is "ball_xmin", "left_xmin" ... too. A scene warns
        where the whole of such a set is a support. ValueError for no meshes, for a name that is no word, and for meshes
        that have a set of such a name already.

        >>> import diffsim_ti as ds
        >>> cube = ds.TetrahedralMesh.create_cube(resolution=2)
        >>> mesh = ds.TetrahedralMesh.joined({"ball": cube, "left": cube.translated((2, 0, 0))})
        >>> len(mesh.vertex_sets["left"]), mesh.vertex_indices("left_xmin").tolist()
        (8, [8, 9, 10, 11])
        """
        named = isinstance(meshes, Mapping)
        parts = [
            instance("joined", "each of the meshes", mesh, TetrahedralMesh, "a TetrahedralMesh")
            for mesh in (meshes.values() if named else listed("meshes", meshes, "TetrahedralMesh"))
        ]
        if not parts:
            raise ValueError("joined needs at least one mesh, got none")
        vertices, tetrahedra, sets = join(parts, list(meshes) if named else [f"body_{k}" for k in range(len(parts))])
        with warnings.catch_warnings():
            for said in ("(vertex coincides|vertices coincide)", "hinge"):  # of each body by itself
                warnings.filterwarnings("ignore", f"[0-9]+ {said}")
            return cls(vertices, tetrahedra, **sets)

    # What it consists of

    @property
    def vertices(self) -> np.ndarray:
        """Rest positions [m], shape (num_vertices, 3)."""
        return self._vertices

    @property
    def tetrahedra(self) -> np.ndarray:
        """Vertex indices of the corners, shape (num_tetrahedra, 4), positively oriented."""
        return self._tetrahedra

    @property
    def num_vertices(self) -> int:
        """How many vertices there are, those that no tetrahedron uses included."""
        return len(self._vertices)

    @property
    def num_tetrahedra(self) -> int:
        """How many tetrahedra, of four or ten nodes, there are."""
        return len(self._tetrahedra)

    @property
    def surface_triangles(self) -> np.ndarray:
        """Faces of one tetrahedron only, normals pointing outwards, shape (k, 3); of a face of six nodes four triangles."""
        return self._surface_triangles

    @cached_property
    def surface_vertices(self) -> np.ndarray:
        """Sorted indices of the vertices of the surface."""
        return frozen(np.unique(self.surface_triangles))

    @property
    def unused_vertices(self) -> np.ndarray:
        """Indices of the vertices that no tetrahedron uses."""
        return np.nonzero(np.bincount(self.elements.ravel(), minlength=self.num_vertices) == 0)[0]

    @cached_property
    def edges(self) -> np.ndarray:
        """Each edge once, by its two corners, shape (k, 2), the smaller index first."""
        return frozen(geometry.edges_of(self.tetrahedra, MID_EDGES)[0])

    @cached_property
    def num_pieces(self) -> int:
        """How many parts that share no vertex."""
        return int(pieces(self).max(initial=-1)) + 1 - len(self.unused_vertices)

    # Geometry

    @property
    def volumes(self) -> np.ndarray:
        """det [x1 - x0, x2 - x0, x3 - x0] / 6 > 0 per tetrahedron [m^3], shape (num_tetrahedra,), curved or not."""
        return self._volumes

    @cached_property
    def volume(self) -> float:
        """Of all tetrahedra [m^3], summed without rounding error."""
        return math.fsum(self._volumes)

    @cached_property
    def shape_gradients(self) -> np.ndarray:
        """grad N_a of linear functions of the corners [1/m], shape (num_tetrahedra, 4, 3); with four nodes the displacement
        gradient is sum_a u_a (x) grad N_a."""
        return frozen(geometry.shape_gradients(geometry.inverse_edges(self.vertices, self.tetrahedra)))

    @cached_property
    def altitudes(self) -> np.ndarray:
        """Height of each corner over its opposite face [m], h_a = 1 / |grad N_a|, shape (num_tetrahedra, 4)."""
        return frozen(1 / np.linalg.norm(self.shape_gradients, axis=2))

    @cached_property
    def quality(self) -> np.ndarray:
        """eta = 12 (3 V)^(2/3) / sum of the six squared edges, in (0, 1], 1: regular; shape (num_tetrahedra,)."""
        squares = geometry.squared_edges(self.vertices, self.tetrahedra).sum(1)
        return frozen(12 * np.cbrt(3 * self.volumes) ** 2 / squares)

    @cached_property
    def centroids(self) -> np.ndarray:
        """Mean of the four vertices [m], shape (num_tetrahedra, 3)."""
        return frozen(self.vertices[self.tetrahedra].mean(1))

    def at_stress_points(self, values: ArrayLike) -> np.ndarray:
        """A field given at the vertices, shape (num_vertices,), such as a temperature, as the elements interpolate it where
        stresses are: (num_tetrahedra,), of ten nodes (num_tetrahedra, 4)."""
        values = numbers("values at the vertices", values)
        if values.shape != (self.num_vertices,):
            raise ValueError(f"values: expected one for each vertex, shape {(self.num_vertices,)}, got {values.shape}")
        out = values[self.elements] @ self.reference.functions(self.reference.points).T
        return out[:, 0] if self.order == 1 else out

    @cached_property
    def bounding_box(self) -> np.ndarray:
        """Lowest and highest corner [m], shape (2, 3)."""
        return frozen(np.stack([self.vertices.min(0), self.vertices.max(0)]))

    @cached_property
    def body_size(self) -> float:
        """Longest side of the box around a body [m]; of several pieces, of the smallest."""
        used = np.delete(np.arange(self.num_vertices), self.unused_vertices)
        if self.num_pieces == 1:
            return float(np.ptp(self.vertices[used], 0).max())
        piece = pieces(self)[used]
        order = np.argsort(piece, kind="stable")
        first = np.flatnonzero(np.diff(piece[order], prepend=-1))
        x = self.vertices[used[order]]
        return float((np.maximum.reduceat(x, first) - np.minimum.reduceat(x, first)).max(1).min())

    # Points

    def locate(self, points: ArrayLike, nearest: bool = False) -> LocatedPoints:
        """Where points [m], shape (k, 3), lie: tetrahedra, corners, barycentric weights; `.matrix` is the sparse map.

        nearest: take the nearest point of the body for each point outside; default: ValueError that says how far out.
        """
        return locate(self, points, nearest)

    # Joining what coincides

    def merged(self, tolerance: float | None = None) -> "TetrahedralMesh":
        """With one vertex for all that lie within tolerance [m] of each other, by default 1e-9 of the size: parts whose
        faces have the same nodes become one body. Sets are kept. ValueError where a tetrahedron would lose a vertex."""
        size = float(np.ptp(self.bounding_box, 0).max())
        if tolerance is None:
            tolerance = doctor.COINCIDING * size
        if not (np.isfinite(tolerance) and tolerance > 0):
            raise ValueError(f"tolerance must be a length above 0 [m], got {tolerance!r}")
        first = doctor.coinciding(self.vertices, tolerance)
        kept, place = np.unique(first, return_inverse=True)
        triangles = {name: place[self.surface_triangles[rows]] for name, rows in self.surface_sets.items()}
        sets = {name: np.unique(place[rows]) for name, rows in self.vertex_sets.items()}
        sets = dict(vertex_sets=sets, tetrahedron_sets=dict(self.tetrahedron_sets), surface_sets=triangles)
        return type(self)(self.vertices[kept], place[self.elements], **sets)

    # Moving

    def translated(self, offset: ArrayLike) -> "TetrahedralMesh":
        """Moved by offset [m], 3 numbers; sets are kept, as in `scaled` and `rotated`."""
        return self._moved(self.vertices + geometry.three("offset", offset))

    def scaled(self, factor: ArrayLike, center: ArrayLike = (0.0, 0.0, 0.0)) -> "TetrahedralMesh":
        """Scaled about center [m] by a positive factor, or by three, one per axis. ValueError for factors <= 0."""
        factors, center = geometry.three("factor", factor, one_will_do=True), geometry.three("center", center)
        if np.any(factors <= 0):
            raise ValueError(f"scale factors must be positive, got {factor!r}; a mirrored body would be inside-out")
        new = self._moved((self.vertices - center) * factors + center)
        if np.ptp(factors) > 0:
            checks.warn_of_slivers(new)
        return new

    def rotated(
        self, rotation: ArrayLike, angle: float | None = None, center: ArrayLike = (0, 0, 0)
    ) -> "TetrahedralMesh":
        """Turned about center [m], by a rotation matrix (3, 3), or about an axis (3 numbers) by angle [rad].

        Right-handed. ValueError for a matrix that is not orthogonal to 1e-9 or has det -1, and for a zero axis.
        """
        R, center = geometry.rotation_matrix(rotation, angle), geometry.three("center", center)
        return self._moved((self.vertices - center) @ R.T + center)

    # Describing

    def check(self) -> doctor.Findings:
        """What may be wrong with it, with a remedy for each: nodes that coincide, faces that touch without common nodes,
        hinges, slivers and what they cost, vertices in no tetrahedron, sets that are empty or overlap, lengths that look
        like millimetres, and float32 far from the origin. `print(mesh.check())` lists them; the command
        `diffsim-ti check body.msh` does so of files, those that are refused too."""
        sets = {name: self.surface_triangles[rows] for name, rows in self.surface_sets.items()}
        return doctor.findings((self.vertices, self.elements, self.vertex_sets, self.tetrahedron_sets, sets))

    def describe(self) -> str:
        """Counts, size, edge lengths, worst tetrahedron, sets; a few lines."""
        low, high = self.bounding_box
        edges = np.linalg.norm(np.diff(self.vertices[self.edges], axis=1)[:, 0], axis=1)
        worst, thin, orphans = int(np.argmin(self.quality)), int(np.argmin(self.altitudes.min(1))), self.unused_vertices
        unused, pieces = f" ({len(orphans)} unused)" if len(orphans) else "", doctor.counted(self.num_pieces, "piece")
        start, end = (", ".join(f"{value:.6g}" for value in corner) for corner in (low, high))
        lines = [
            f"TetrahedralMesh: {self.num_vertices} vertices{unused}, {self.num_tetrahedra} tetrahedra, {pieces}",
            f"surface: {len(self.surface_triangles)} triangles, {len(self.surface_vertices)} vertices",
            f"size: {' x '.join(f'{d:.6g}' for d in high - low)} m, from ({start}) to ({end})",
            f"volume: {self.volume:.6g} m^3",
            f"edges: {edges.min():.4g} to {edges.max():.4g} m, mean {edges.mean():.4g} m",
            f"worst quality: {self.quality[worst]:.3g} in tetrahedron {worst}; mean {self.quality.mean():.3g} of 1",
            f"smallest altitude: {self.altitudes[thin].min():.4g} m in tetrahedron {thin}",
            f"vertex sets: {sizes(self.vertex_sets)}",
            f"tetrahedron sets: {sizes(self.tetrahedron_sets)}",
            f"surface sets: {sizes(self.surface_sets)}",
        ]
        if self.order == 2:
            text, more = f"{len(self.corners)} corners, {len(self.middles)} mid-edge vertices", ", straight edges"
            if self.curved.any():
                J = lowest_jacobian(self)
                bound = f"lowest bound of J over its mean {J.min():.3g} in tetrahedron {int(np.argmin(J))}"
                more = f"; {self.curved.sum()} are curved, {bound}"
            lines.insert(4, f"ten-node tetrahedra: {text}{more}")
        return "\n".join(lines)

    def __repr__(self) -> str:
        size = " x ".join(f"{d:.4g}" for d in np.ptp(self.bounding_box, 0))
        return f"TetrahedralMesh({self.num_vertices} vertices, {self.num_tetrahedra} tetrahedra, {size} m)"

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of vertices and tetrahedra, 64 hexadecimal digits; sets do not count. The same on every machine."""
        digest = hashlib.sha256(np.array([self.num_vertices, self.num_tetrahedra], "<i8").tobytes())
        digest.update(self.vertices.astype("<f8").tobytes())
        digest.update(self.elements.astype("<i8").tobytes())
        return digest.hexdigest()

    def _changed(self, **parts) -> "TetrahedralMesh":
        new = copy.copy(self)
        new.__dict__.update(parts)
        return new

    def _moved(self, vertices: np.ndarray) -> "TetrahedralMesh":
        """The same connectivity at other positions; checked, and nothing cached that depends on positions."""
        vertices = checks.checked_vertices(vertices)
        volumes = checks.checked_volumes(vertices, self._tetrahedra)
        checks.oriented(self._tetrahedra, volumes, fix_orientation=False)
        volumes = checks.checked_curved_volumes(vertices, self._elements, volumes)
        new = object.__new__(type(self))
        new.__dict__.update({name: self.__dict__[name] for name in CONNECTIVITY})
        new._vertices, new._volumes = frozen(vertices), frozen(volumes)
        return new

    def __setstate__(self, state: dict) -> None:
        """Copies and unpickled meshes are read-only too (NumPy forgets the flag)."""
        self.__dict__.update(state)
        sets = (self._vertex_sets, self._tetrahedron_sets, self._surface_sets)
        for value in (*state.values(), *(rows for named in sets for rows in named.values())):
            if isinstance(value, np.ndarray):
                frozen(value)
