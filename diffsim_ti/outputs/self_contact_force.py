"""Forces of surfaces that press and slide on each other: what a soft hand does to what it holds."""

from typing import Literal

from numpy.typing import ArrayLike

from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.outputs.contact_force import ContactForce
from diffsim_ti.scene import Scene
from diffsim_ti.terms import SelfContact


class SelfContactForce(ContactForce):
    """Force [N] of the pairs of SelfContact on vertices, shape (frames, 3), or on each, (frames, num_vertices, 3):

        f_i = sum over pairs of w_i (N n - mu N f(|t| / eps) t / |t|),    t = (I - n n^T) sum_i w_i v_i

    n: the pair's normal, w_i: the weights of its four corners (whose sum is 0), N: what its barrier presses with; f, mu,
    eps: of friction (terms/self_contact.py). So the sum over all vertices is zero, and that over one body is what all
    others do to it. What acts on fixed vertices is in it.

    on: whose sum is taken, by a vertex set's name, indices, a mask or a list of names, as of `mesh.vertex_indices`; of a
        joined mesh "body_0", "body_1" and so on.
    part: "normal", "friction" or "total". per_vertex: of each vertex of the mesh instead. name: how a loss calls it.
    about: the moment [N m] about this point [m] instead, sum (x_i - about) x f_i.

    As of ContactForce a frame holds the mean over the time T since the frame before it, zero in the first, so that T f is
    what contact added to momentum: to round-off in explicit steps, in backward Euler and the midpoint rule to the tolerance
    of their solves. In implicit steps friction takes N, n and w from where a substep begins. In static solves it is the
    force of the last equilibrium, whose v_i is the way of a load step over its share of dt.
    The gradient is exact by all inputs.

    Raises ValueError for a scene without SelfContact, another part, or on= or about= with per_vertex=True, and if neither
    on= nor per_vertex=True is given.
    Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425.
    """

    reads_contact_forces, _shown = "surfaces", ("on", "part")

    def __init__(
        self,
        on: SetOrIndices | None = None,
        part: Literal["total", "normal", "friction"] = "total",
        name: str = "self_contact_force",
        per_vertex: bool = False,
        about: ArrayLike | None = None,
    ):
        if on is None and not per_vertex:
            raise ValueError(
                "SelfContactForce: give on=, a set whose sum (or moment) is taken, or per_vertex=True, of all vertices; the "
                "sum over all is zero"
            )
        super().__init__("self-contact", part, name, per_vertex, about, on)

    def _place(self, scene: Scene) -> int:
        if scene.term(SelfContact) is None:
            raise ValueError(f"{self!r}: the scene has no SelfContact; add it to the scene's terms")
        return len(scene.obstacles)
