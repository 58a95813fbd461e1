"""Contact of the surface with itself, and of several bodies with each other."""

from diffsim_ti.terms.described import positive
from diffsim_ti.terms.term import Term


class SelfContact(Term):
    """Pairs of surface primitives, vertex and triangle or edge and edge, push each other apart nearer than `width`.

    Energy of a pair at distance d: m b(d) with b(d) = -stiffness (d - width)^2 log(d / width) for d < width, exactly zero
    beyond (barrier.py); m fades out edges that become parallel (contact/proximity.py), with lengths as in the mesh.
    Pairs that share a vertex do not count. stiffness [N/m], width [m]. No friction.

    The width must be smaller than the rest distance of all primitives of one body that share no vertex, so that a body at
    rest does not press on itself; different bodies (pieces of the mesh, see `TetrahedralMesh.joined`) may start nearer.
    Inputs with gradient: "self_contact_stiffness", "self_contact_width", or "<name>.stiffness", "<name>.width".
    One per scene. Implicit solvers keep surfaces apart on the whole way of every step; ImplicitMidpointSolver raises
    Tunnelling where the end of a step lies beyond a contact.

    Raises ValueError for stiffness <= 0 or width <= 0 and, when a run starts, for a width that is too large, and for
    surfaces that touch or pass through each other. A substep in which two primitives may have passed through each other
    raises Tunnelling.
    Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425.
    """

    def __init__(self, stiffness: float = 1e4, width: float = 1e-3, name: str | None = None):
        super().__init__(
            positive("stiffness", stiffness, "N/m", "self_contact_stiffness"),
            positive("width", width, "m", "self_contact_width"),
            name=name,
        )
