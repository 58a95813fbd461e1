"""Bodies that move by few numbers: which vertices go together, and how."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers, shown
from diffsim_ti.mesh import TetrahedralMesh

KINDS = {"affine": 12, "rigid": 6}  # numbers that each moves by


@dataclass(frozen=True)
class Together:
    """Vertices of a set, shape (k,), and an orthonormal basis: of each component of their displacements, shape (k, m), or of
    all three together, (3 k, m); that of a rigid one is of affine motions."""

    name: str
    kind: str
    vertices: np.ndarray
    basis: np.ndarray

    def numbers(self, x: np.ndarray) -> np.ndarray:
        """q = B^T x of vectors of all vertices, shape (num_vertices, 3): (m, 3), or (m, 1) of all components together."""
        return self.basis.T @ x[self.vertices].reshape(len(self.basis), -1)

    def motion(self, q: np.ndarray) -> np.ndarray:
        """B q, shape (k, 3)."""
        return (self.basis @ q).reshape(-1, 3)

    @property
    def rigid(self) -> bool:
        return self.kind == "rigid"

    @property
    def per_component(self) -> bool:
        """Whether the basis is of each component, so that what it can do turns with a turn of it."""
        return len(self.basis) == len(self.vertices)

    @property
    def count(self) -> int:
        """How many numbers it moves by."""
        return KINDS.get(self.kind) or self.basis.shape[1] * (3 if self.per_component else 1)

    def apart(self, x: np.ndarray) -> np.ndarray:
        """Places or velocities of the set's vertices without their mean."""
        return x[self.vertices] - x[self.vertices].mean(0)

    def fields(self) -> np.ndarray:
        """Displacements of each number, shape (k, 3, count)."""
        if not self.per_component:
            return self.basis.reshape(len(self.vertices), 3, -1)
        return np.einsum("vj,ab->vajb", self.basis, np.eye(3)).reshape(len(self.vertices), 3, -1)

    def follows_translations(self) -> bool:
        """Whether every rigid translation is among its motions."""
        ones = np.ones((len(self.vertices), 1))
        ones = ones if self.per_component else np.kron(ones, np.eye(3))
        return float(np.abs(ones - self.basis @ (self.basis.T @ ones)).max()) < 1e-9


class Reduced:
    """The sets of a scene that move by few numbers, and vertices that ties glue (glued.py).

    affine: displacements A X + t of the mesh's places X, twelve numbers, u = B q; `x -> of(x)` is the nearest such to any
    x, a projection. B is that of the mesh, whatever rest_positions a run takes.
    rigid: places R X + t of the rest positions X of a run, six numbers. A start is the nearest such (inputs/rigid_start.py).
    a basis, of all the mesh's vertices, of which those of the set count: m functions for each component, shape
    (num_vertices, m), such as the `weights` of a `designs.Cage`, 3 m numbers; or m fields of displacements, (m,
    num_vertices, 3), such as the `shapes` of `modes`, m numbers. Neither need be orthonormal.

    The set moves by u = B q alone, so that forces do what B^T f says, and what B lacks is held as by a support. Linear
    momentum is kept where B has the rigid translations (constant functions); angular momentum, in the midpoint rule and
    explicit steps, where it is of each component and has X, too, as cages have; both of rigid sets. Modes of a body that is
    held have neither: they are for what stays where it is and does not turn far.

    Raises ValueError for what is no {name: kind or basis}, bases of other shapes or of which some are all but combinations
    of others, sets that are not known, lie in a plane, or share vertices with each other or with what is fixed.
    """

    def __init__(
        self, mesh: TetrahedralMesh, given: Mapping[str, str | ArrayLike] | None, held: np.ndarray, glued: tuple = ()
    ):
        if not isinstance(given, Mapping | None):
            raise ValueError(f'reduced: must be {{name of a set: "affine", "rigid" or a basis}}, got {shown(given)}')
        self.bodies = tuple(self._body(mesh, name, kind) for name, kind in (given or {}).items())
        taken = {int(i): "what is fixed (fixed=)" for i in held}
        for body in self.bodies:
            both = [i for i in body.vertices if int(i) in taken]
            if both:
                raise ValueError(
                    f"reduced: vertex {both[0]} of {body.name!r} is also in {taken[int(both[0])]}; name sets that have no "
                    "vertex in common, and hold others"
                )
            taken |= dict.fromkeys(map(int, body.vertices), repr(body.name))
        for tie in glued:
            both = np.intersect1d(tie.vertices, np.concatenate([[], *(body.vertices for body in self.bodies)]))
            if len(both):
                raise ValueError(
                    f"{tie.name}: vertex {int(both[0])} is in a set of reduced= too, and moves by that alone; leave its "
                    "faces out of the tie, or let the set end before them"
                )
        self.bodies += glued

    @staticmethod
    def _body(mesh: TetrahedralMesh, name: str, kind: str | ArrayLike) -> Together:
        if kind is None or isinstance(kind, str) and kind not in KINDS:
            raise ValueError(f"reduced: {name!r} must be {' or '.join(map(repr, KINDS))} or a basis, got {kind!r}")
        if name in mesh.tetrahedron_sets:
            vertices = np.unique(mesh.elements[mesh.tetrahedron_sets[name]])
        elif name in mesh.vertex_sets:
            vertices = np.unique(mesh.vertex_sets[name])
        else:
            known = sorted({*mesh.tetrahedron_sets, *mesh.vertex_sets})
            raise ValueError(f"reduced: the mesh has no set {name!r} of tetrahedra or vertices; it has {known}")
        if not isinstance(kind, str):
            return Together(name, "basis", vertices, _orthonormal(mesh, name, vertices, kind))
        X = mesh.vertices[vertices]
        X = (X - X.mean(0)) / max(float(np.ptp(X, axis=0).max(initial=0.0)), 1e-300)
        if len(X) < 4 or np.linalg.svd(X, compute_uv=False)[-1] < 1e-6 * np.sqrt(len(X)):
            raise ValueError(
                f"reduced: the {len(X)} vertices of {name!r} lie in a plane, which leaves an affine motion open; name "
                "a set with tetrahedra"
            )
        return Together(name, kind, vertices, np.linalg.qr(np.concatenate([np.ones((len(X), 1)), X], 1))[0])

    def __bool__(self) -> bool:
        return bool(self.bodies)

    @property
    def by_few(self) -> tuple[Together, ...]:
        """Affine and rigid sets, which explicit kernels know."""
        return tuple(body for body in self.bodies if body.kind in KINDS)

    @property
    def by_basis(self) -> tuple[Together, ...]:
        """The others: what ties glue too."""
        return tuple(body for body in self.bodies if body.kind not in KINDS)

    @property
    def rigid(self) -> tuple[Together, ...]:
        """Sets that do not deform."""
        return tuple(body for body in self.bodies if body.rigid)

    def with_stress(self, elements: np.ndarray, volume: str) -> Callable[[np.ndarray], np.ndarray]:
        """volumes -> those without elements that lie wholly in a set that does not deform: what rounding makes of their
        stress would turn it. Patches need all."""
        if not self.rigid or volume != "tetrahedra":
            return lambda volumes: volumes
        stressed = np.ones(len(elements))
        for body, own in zip(self.bodies, self.elements(elements)):
            stressed[own] = not body.rigid
        return lambda volumes: (volumes.reshape(len(stressed), -1) * stressed[:, None]).reshape(volumes.shape)

    def elements(self, elements: np.ndarray) -> list[np.ndarray]:
        """Which elements, rows of vertices, lie wholly in each set."""
        return [np.flatnonzero(np.isin(elements, body.vertices).all(1)) for body in self.bodies]

    def of(self, x: np.ndarray) -> np.ndarray:
        """Vectors of all vertices, shape (num_vertices, 3), those of sets that deform as near as the sets can do; x where
        there are none."""
        if not self.bodies:
            return x
        out = np.array(x)
        for body in self.bodies:
            if not body.rigid:
                out[body.vertices] = body.motion(body.numbers(x))
        return out

    def describe(self) -> str:
        """In a line."""
        return ", ".join(
            f"{b.name if b.kind == 'tie' else repr(b.name)} {b.count} for {3 * len(b.vertices)}"
            + ("" if b.follows_translations() else ", tied to its place")
            for b in self.bodies
        )


def _orthonormal(mesh: TetrahedralMesh, name: str, vertices: np.ndarray, given: ArrayLike) -> np.ndarray:
    """An orthonormal basis of what is given, at the vertices of a set."""
    basis, n = numbers(f"reduced: the basis of {name!r}", given), mesh.num_vertices
    if basis.ndim == 3 and basis.shape[1:] == (n, 3) and len(basis):
        basis = basis[:, vertices].reshape(len(basis), -1).T
    elif basis.ndim == 2 and len(basis) == n and basis.shape[1]:
        basis = basis[vertices]
    else:
        raise ValueError(
            f"reduced: the basis of {name!r} must have shape ({n}, m), functions of each component, or (m, {n}, 3), fields "
            f"of displacements, at all vertices of the mesh; got {basis.shape}"
        )
    if not np.all(np.isfinite(basis)):
        raise ValueError(f"reduced: the basis of {name!r} must be finite")
    sizes = np.linalg.norm(basis, axis=0)
    basis = basis / np.where(sizes > 0, sizes, 1.0)
    singular = np.linalg.svd(basis, compute_uv=False)
    rank, m = int((singular > 1e-6 * singular.max(initial=0.0)).sum()), basis.shape[1]
    if rank < m:
        raise ValueError(
            f"reduced: of the {m} columns of the basis of {name!r} {m - rank} are combinations of the others at its "
            f"{len(vertices)} vertices, to 1e-6; leave them out, or give its singular vectors, np.linalg.svd"
        )
    return np.linalg.qr(basis)[0]
