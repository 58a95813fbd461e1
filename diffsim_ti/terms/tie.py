"""Faces of one part glued to those of another whose nodes do not match."""

from copy import copy

import numpy as np

from diffsim_ti.common.checked import number
from diffsim_ti.common.warn import warn
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.mortar import Mortar
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.terms.self_contact import SelfContact
from diffsim_ti.terms.term import Term, nonempty

WHOLE = 0.99  # share of a face that is to lie on the other surface
NARROW = 1e-3  # of an edge: gaps beyond are said


class Tie(Term):
    """Glues faces b to faces a on which they lie, whose nodes need not match, in every solver.

        int N_i (u_b - u_a) = 0 for the function N_i of each vertex i of b,    D u_b = M u_a

    Displacements of b's vertices follow those of a's, u_b = D^-1 M u_a, and the forces on them go to these by the
    transpose: no stiffness is chosen, steps stay as long as they were, momentum is kept, and linear displacements (constant
    stress) go through exactly, of four and of ten nodes. Let b be the finer surface, and one that lies wholly on a.

    a, b: name of a surface set, or of a vertex set whose faces are meant; several names, rows of `surface_triangles` or
        triangles, shape (k, 3).
    tolerance [m]: how far apart they may lie, by default 5 % of the mean edge of b. What is left of a gap, as between
        facets of a curved surface, stays as it is at rest and does not turn with the body.
    Weights are those of the mesh's places and flat faces, whatever rest_positions a run takes. Vertices of a and b may be
    fixed along axes, where they stand still at rest. `Reaction(tie)` is the force on b. Explicit solvers take obstacles
    beside it by contact="force" without friction, or by pairs; SelfContact, for which the surfaces touch, goes with it in no
    solver.

    Raises ValueError for surfaces that do not meet, share vertices, or of which b lies on a in part only, for vertices of b
    that another tie has, and for fixed vertices that move or are fixed along a direction that is no axis.
    Wohlmuth 2000, A mortar finite element method using dual spaces for the Lagrange multiplier,
    doi:10.1137/S0036142999350929.

    >>> import diffsim_ti as ds
    >>> box = ds.TetrahedralMesh.create_box
    >>> mesh = ds.TetrahedralMesh.joined({"left": box(3, 1.0), "right": box(4, 1.0, origin=(1, 0, 0))})
    >>> tie = ds.Tie("left_xmax", "right_xmin")
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[tie, ds.Gravity()], fixed="left_xmin", precision="f64")
    >>> frames = ds.Rollout(ds.StaticSolver(scene), steps=1, outputs=[ds.Reaction(tie)]).forward()
    >>> print(f"{frames['reaction'][-1, 1]:.1f} N")  # the weight of the right half
    9810.0 N
    """

    num_numbers = 0

    def __init__(self, a: SetOrIndices, b: SetOrIndices, tolerance: float | None = None, name: str | None = None):
        super().__init__(name=name)
        self.a, self.b = a, b
        self.tolerance = None if tolerance is None else number("Tie: tolerance", tolerance, unit="m")

    def __repr__(self) -> str:
        said = [repr(x) if isinstance(x, str) else "faces" for x in (self.a, self.b)]
        return f"Tie({', '.join(said)})"

    def faces(self, mesh: TetrahedralMesh, chosen: SetOrIndices) -> np.ndarray:
        """Of a or b, rows of three or six vertices."""
        if isinstance(chosen, str) and chosen not in mesh.surface_sets and chosen in mesh.vertex_sets:
            chosen = np.flatnonzero(np.isin(mesh.surface_triangles, mesh.vertex_indices(chosen)).all(1))
        return nonempty(self, mesh.faces_of(chosen))

    def glued_vertices(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Those of b, sorted."""
        return np.unique(self.faces(mesh, self.b))

    def mortar(self, mesh: TetrahedralMesh) -> Mortar:
        """The integrals over where b lies on a."""
        a, b, x = self.faces(mesh, self.a), self.faces(mesh, self.b), mesh.vertices
        shared = np.intersect1d(a, b)
        if len(shared):
            raise ValueError(
                f"{self!r}: vertex {shared[0]} is in both surfaces ({len(shared)} are), which needs no glue there; name "
                "surfaces of parts that share no vertices"
            )
        edge = float(np.linalg.norm(x[b[:, :3]] - x[np.roll(b[:, :3], 1, 1)], axis=2).mean())
        reach = 0.05 * edge if self.tolerance is None else self.tolerance
        out = Mortar.of(x, b, a, reach)
        part = out.covered < WHOLE
        if not out.covered.any():
            near = Mortar.of(x, b, a, 2 * edge)
            apart = f"they lie up to {near.gap:.3g} m apart, " if near.gap else "they do not face each other, "
            raise ValueError(
                f"{self!r}: the surfaces do not meet within {reach:.3g} m: {apart}with edges of {edge:.3g} m; name faces "
                "that lie on each other, move the parts together, or pass tolerance= [m]"
            )
        if part.any():
            raise ValueError(
                f"{self!r}: {part.sum()} of {len(b)} faces of b lie on a in part only, or not within {reach:.3g} m, the "
                f"first about {np.round(x[b[np.argmax(part), :3]].mean(0), 6).tolist()}: exchange a and b, or let b be only "
                "the faces that lie wholly on a (mesh.with_surface_set)"
            )
        if out.gap > NARROW * edge:
            warn(
                f"{self!r}: the surfaces lie up to {out.gap:.3g} m apart, {100 * out.gap / edge:.2g} % of an edge; the gap "
                "stays as it is at rest and does not turn with the body: let the surfaces meet where it turns far"
            )
        return out

    def settled(self, scene, density, initial_positions, initial_velocities) -> "Tie":
        if any(isinstance(term, SelfContact) for term in scene.terms):
            raise ValueError(
                f"{self!r}: glued surfaces touch, which SelfContact refuses; leave one of both out, or join the parts by "
                "common nodes (mesh.merged)"
            )
        out = copy(self)
        own = np.union1d(self.faces(scene.mesh, self.a), self.faces(scene.mesh, self.b))
        out.held = np.intersect1d(own, scene.held)
        out.rest = scene.mesh.vertices[out.held]
        return out

    def check_start(self, positions, surface, *places) -> None:
        moved = np.abs(positions[self.held] - self.rest).max(1, initial=0.0)
        if moved.any():
            raise ValueError(
                f"{self!r}: vertex {self.held[moved.argmax()]} is fixed {moved.max():.3g} m from its place at rest; fixed "
                "vertices of a tie are to start there: leave it out of initial_positions, or out of the tie's surfaces"
            )
