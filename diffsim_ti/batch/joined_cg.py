"""Conjugate gradients of all scenes of a batch at once: each has its own numbers alpha, beta and end."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.runtime.piecewise import Pieces
from diffsim_ti.solvers.implicit.cg_kernels import COUNT, LEAST, LIMIT, ROOM, SQUARE, STOPPED
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
        self._look = self.many if self.by_scene else 0

    def solve(self, b: np.ndarray, tolerance, going, most: int, eps: float, more: bool) -> tuple:
        """(x, rows of `state`) of all systems, whose mass and matrix are on the device; of one that is not `going` 0. A
        system that meets a direction of negative curvature has the x before it or, if it is the first, the preconditioned b.
        """
        rows = b.reshape(self.systems, -1)
        size, state = np.sqrt(np.einsum("ij,ij->i", rows, rows)), np.zeros((self.systems, ROOM))
        wanted, done = going & (size > 0), 0
        runtime.fill(self.r, (rows / np.where(wanted, size, np.inf)[:, None]).reshape(1, -1, 3))
        state[:, LEAST], state[:, LIMIT], state[:, STOPPED] = tolerance**2, most, ~wanted
        runtime.fill(self.state, state)
        while done < most and (on := (state[:, STOPPED] == 0) & np.isfinite(state[:, SQUARE])).any():
            self.iterate(state[on], most - done, eps, more)
            state = runtime.fetch(self.state)
            done = max(done + 1, int(state[:, COUNT].max()))
        x = runtime.fetch_row(self.x, 0).reshape(rows.shape)
        first = (state[:, STOPPED] == 2) & (state[:, COUNT] == 1)
        if first.any():
            x = np.where(first[:, None], runtime.fetch_row(self.p, 0).reshape(rows.shape), x)
        known = wanted & (state[:, COUNT] > 0)
        return np.where(known[:, None], x * size[:, None], 0.0).reshape(b.shape), state

    def __call__(self, mass, more, b, tolerances, going, max_iterations: int, eps: float):
        """(x, solved, negative) of each scene, as `solve`."""
        self.put_system(mass, more)
        x, state = self.solve(b, tolerances, going, max_iterations, eps, more is not None)
        return x, state[:, STOPPED] == 1, state[:, STOPPED] == 2
