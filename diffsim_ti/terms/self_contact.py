"""Contact of the surface with itself, and of several bodies with each other."""

from diffsim_ti.terms.described import positive
from diffsim_ti.terms.term import Term


class SelfContact(Term):
    """Pairs of surface primitives, vertex and triangle or edge and edge, push each other apart nearer than `width`.

    Energy of a pair at distance d: m b(d) with b(d) = -stiffness (d - width)^2 log(d / width) for d < width, exactly zero
    beyond (barrier.py); m fades out edges that become parallel (contact/proximity.py), with lengths as in the mesh.
    Pairs that share a vertex do not count. stiffness [N/m], width [m]. No friction.

    Pairs of one body whose distance D at rest is below twice the width, neighbours along its surface or walls of a slit,
    have a width and a stiffness of their own, so that a body at rest does not press on itself:

        own width = share width,   own stiffness = stiffness / share,   share = min(1, D / (2 width))

    They begin to press at half of D, with the forces that others have at the same share of their widths. D follows the rest
    shape, and gradients by rest shape and width know it; where two edges are exactly parallel at rest D has a kink, and they
    take the slope of one side. Different bodies (pieces of the mesh, see `TetrahedralMesh.joined`) may start nearer than the
    width and then press from the start.

    Inputs with gradient: "self_contact_stiffness", "self_contact_width", or "<name>.stiffness", "<name>.width".
    One per scene. Implicit solvers keep surfaces apart on the whole way of every step; ImplicitMidpointSolver raises
    Tunnelling where the end of a step lies beyond a contact.

    Raises ValueError for stiffness <= 0 or width <= 0 and, when a run starts, for a width beyond four mean edges of the
    surface, for primitives that touch at rest, and for surfaces that touch or pass through each other. A substep in which
    two primitives may have passed through each other raises Tunnelling.
    Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425.
    """

    def __init__(self, stiffness: float = 1e4, width: float = 1e-3, name: str | None = None):
        super().__init__(
            positive("stiffness", stiffness, "N/m", "self_contact_stiffness"),
            positive("width", width, "m", "self_contact_width"),
            name=name,
        )
