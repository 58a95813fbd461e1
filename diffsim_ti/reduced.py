"""Bodies that move by few numbers: which vertices go together, and how."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from diffsim_ti.checked import shown
from diffsim_ti.mesh import TetrahedralMesh

KINDS = {"affine": 12, "rigid": 6}  # numbers that each moves by


@dataclass(frozen=True)
class Together:
    """Vertices of a set, shape (k,), and an orthonormal basis of each component of their displacements if these are affine,
    shape (k, 4)."""

    name: str
    kind: str
    vertices: np.ndarray
    basis: np.ndarray

    @property
    def rigid(self) -> bool:
        return self.kind == "rigid"

    def apart(self, x: np.ndarray) -> np.ndarray:
        """Places or velocities of the set's vertices without their mean."""
        return x[self.vertices] - x[self.vertices].mean(0)


class Reduced:
    """The sets of a scene that move by few numbers.

    affine: displacements A X + t of the mesh's places X, twelve numbers, u = B q; `x -> of(x)` is the nearest such to any
    x, a projection. B is that of the mesh, whatever rest_positions a run takes.
    rigid: places R X + t of the rest positions X of a run, six numbers, in explicit steps. A start is the nearest such
    (inputs/rigid_start.py).

    Raises ValueError for what is no {name: kind}, sets that are not known, lie in a plane, or share vertices with each
    other or with what is held.
    """

    def __init__(self, mesh: TetrahedralMesh, given: Mapping[str, str] | None, held: np.ndarray):
        if not isinstance(given, Mapping | None):
            raise ValueError(f'reduced: must be {{name of a set: "affine" or "rigid"}}, got {shown(given)}')
        self.bodies = tuple(self._body(mesh, name, kind) for name, kind in (given or {}).items())
        taken = {int(i): "what is held (fixed=)" for i in held}
        for body in self.bodies:
            both = [i for i in body.vertices if int(i) in taken]
            if both:
                raise ValueError(
                    f"reduced: vertex {both[0]} of {body.name!r} is also in {taken[int(both[0])]}; name sets that have no "
                    "vertex in common, and hold others"
                )
            taken |= dict.fromkeys(map(int, body.vertices), repr(body.name))

    @staticmethod
    def _body(mesh: TetrahedralMesh, name: str, kind: str) -> Together:
        if not isinstance(kind, str) or kind not in KINDS:
            raise ValueError(f"reduced: {name!r} must be {' or '.join(map(repr, KINDS))}, got {kind!r}")
        if name in mesh.tetrahedron_sets:
            vertices = np.unique(mesh.elements[mesh.tetrahedron_sets[name]])
        elif name in mesh.vertex_sets:
            vertices = np.unique(mesh.vertex_sets[name])
        else:
            known = sorted({*mesh.tetrahedron_sets, *mesh.vertex_sets})
            raise ValueError(f"reduced: the mesh has no set {name!r} of tetrahedra or vertices; it has {known}")
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
    def rigid(self) -> tuple[Together, ...]:
        """Sets that do not deform."""
        return tuple(body for body in self.bodies if body.rigid)

    def refuse_rigid(self, what: str) -> None:
        """Raise ValueError where a set does not deform."""
        for body in self.rigid:
            raise ValueError(
                f"{what}: the set {body.name!r} is rigid, which SemiImplicitSolver and VelocityVerletSolver alone know; "
                'take one of these, or "affine" in place of "rigid" and a stiff material'
            )

    def elements(self, elements: np.ndarray) -> list[np.ndarray]:
        """Which elements, rows of vertices, lie wholly in each set."""
        return [np.flatnonzero(np.isin(elements, body.vertices).all(1)) for body in self.bodies]

    def of(self, x: np.ndarray) -> np.ndarray:
        """Vectors of all vertices, shape (num_vertices, 3), those of affine sets as near as the sets can do; x where there
        are none."""
        if not self.bodies:
            return x
        out = np.array(x)
        for body in self.bodies:
            if body.rigid:
                continue
            out[body.vertices] = body.basis @ (body.basis.T @ x[body.vertices])
        return out

    def describe(self) -> str:
        """In a line."""
        return ", ".join(f"{b.name!r} {KINDS[b.kind]} for {3 * len(b.vertices)}" for b in self.bodies)
