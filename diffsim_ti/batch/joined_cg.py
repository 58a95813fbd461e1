"""Conjugate gradients of all scenes of a batch at once: each has its own numbers alpha, beta and end."""

from diffsim_ti.runtime.piecewise import Pieces
from diffsim_ti.solvers.implicit.cg_kernels import STOPPED
from diffsim_ti.solvers.implicit.device_cg import DeviceCG

COUNTS = "nodes", "below", "shares", "shares_below", "chunks", "systems"  # of all scenes
COUNTS += "num_items", "num_tetrahedra", "num_vertices", "vertices", "points", "count"

# what scenes share, or is found by what `start` says, in kernels of one scene
WHOLE = {(m, a) for m in ("level", "down", "up", "inverse") for a in ("column", "values")}
WHOLE |= {("cg", "column"), ("cg", "blocks"), ("cg", "held"), ("scene", "corner_of"), ("at", "rate"), ("body", "point")}
# which of their numbers are places in which arrays
COUNTING = {("level", "column"): ("level", "x"), ("down", "column"): ("level", "x"), ("up", "column"): ("below", "x")}
COUNTING |= {("inverse", "column"): ("level", "x"), ("cg", "column"): ("cg", "x"), ("scene", "tets"): ("at", "u")}
COUNTING |= {("scene", "corner_of"): ("scene", "corner"), ("way", "vertices"): ("at", "u")}
COUNTING |= {("body", "nodes"): ("at", "u"), ("body", "point"): ("body", "strains")}


def pieces_of(uniform: bool) -> Pieces:
    """Of scenes; uniform: whether all tetrahedra of all share the law's numbers."""
    whole = WHOLE | ({("scene", "coefficients")} if uniform else set())
    return Pieces(frozenset(whole), tuple(COUNTING.items()), frozenset({("cg", "state")}), COUNTS)


class JoinedCG(DeviceCG):
    """Solves A x = b of all scenes; a scene that is not `going` keeps x = 0. On the processor a thread takes a scene to its
    end, while its arrays lie in the caches: from 64 scenes of 750 tetrahedra on twice as fast as all scenes in turns."""

    several = True

    def __init__(self, potential, *more):
        self.systems, self.by_scene = potential.arrays.num_scenes, potential.arrays.by_scene
        super().__init__(potential, *more)

    def __call__(self, mass, more, b, tolerances, going, max_iterations: int, eps: float):
        """(x, solved, negative) of each scene, as `solve`."""
        self.put_system(mass, more)
        x, state = self.solve(b, tolerances, going, max_iterations, eps, more is not None)
        return x, state[:, STOPPED] == 1, state[:, STOPPED] == 2
