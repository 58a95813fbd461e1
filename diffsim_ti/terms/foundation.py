"""An elastic foundation on a surface."""

from numpy.typing import ArrayLike

from diffsim_ti.common.checked import present
from diffsim_ti.inputs import Input, Link
from diffsim_ti.inputs.lines import FoundationStiffness
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.terms.lines import AT_LEAST_0
from diffsim_ti.terms.marks import MOST, Points, spread
from diffsim_ti.terms.term import OnMesh, OnSurface, Term, nonempty


class ElasticFoundation(OnSurface, OnMesh, Term):
    """Springs under a surface that pull it back to where it is at rest (Winkler): on each vertex f = -K u, u its
    displacement from the rest shape,

        K = sum over its triangles of A / 3 [t I + (c - t) N N^T]

    A, N: area and normal at rest, c: `normal`, t: `tangential`: stiffness per area [N/m^3]. It pushes and pulls alike, and
    stands still. With ten-node tetrahedra the integral of the vertex's shape function takes the place of A / 3.

    surface: a surface set's name, several, rows of `surface_triangles`; None: all of the surface. normal, tangential: one
    number or one for each of its faces, in the order of `mesh.faces_of(surface)`.
    Inputs with gradient: "foundation_normal" and "foundation_tangential", or "<name>.normal" and "<name>.tangential"; the
    rest shape counts by areas and normals.
    Raises ValueError for unknown sets, other shapes, and stiffness below zero.
    Winkler 1867, Die Lehre von der Elasticitaet und Festigkeit, sec. 195; Hetenyi 1946, Beams on Elastic Foundation, ch. 1.
    """

    num_numbers = 0  # what kernels read of it lies in arrays of its own

    def __init__(
        self,
        normal: ArrayLike,
        tangential: ArrayLike = 0.0,
        surface: SetOrIndices | None = None,
        name: str | None = None,
    ):
        present("normal", normal), present("tangential", tangential)
        both = [
            Input(argument, given, ((), ("k",)), "N/m^3", AT_LEAST_0, plain=f"foundation_{argument}", label=argument)
            for argument, given in (("normal", normal), ("tangential", tangential))
        ]
        super().__init__(*both, name=name)
        self.surface = surface

    def sizes(self, mesh):
        return {"k": len(self.faces(mesh))}

    def check(self, mesh: TetrahedralMesh) -> None:
        count, kind = len(nonempty(self, self.faces(mesh))), "triangles" if mesh.order == 1 else "faces"
        for i in self.described:
            if i.value.ndim and len(i.value) != count:
                given = f"{i.name} has {len(i.value)} numbers"
                raise ValueError(f"ElasticFoundation: {given} for {count} {kind}; give one or {count}")

    def drawn(self, moment):
        vertices = self.indices(moment.mesh)
        vertices = vertices[spread(moment.mesh.vertices[vertices], MOST)]
        return [Points(self.name or "foundation", moment.positions[vertices])]

    def links(self, names: dict[str, str], own: str) -> list[Link]:
        normal, tangential = (names[i.plain] for i in self.described)
        faces, vertices = self.faces(self.mesh), self.indices(self.mesh)
        return [FoundationStiffness(faces, vertices, normal, tangential, f"{own} matrices")]
