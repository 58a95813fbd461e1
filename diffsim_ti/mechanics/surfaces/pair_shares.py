"""What points and edges of each obstacle do to each vertex of the body in an implicit pass, with tangent and adjoint."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import whole


class PairShares:
    """Of pairs with obstacles (curved_pairs.py), at the displacement of a potential that holds them; arrays of the shape
    (obstacles, 2: by push and by friction, num_vertices, 3)."""

    def __init__(self, potential):
        self.p, self.pairs = potential, potential.pairs
        self.parts = list(enumerate(self.pairs.finer.mesh.corners.parts, start=1))
        self.shape = len(potential.arrays.obstacles), 2, potential.arrays.num_vertices, 3

    def _pushes(self, number: int, all_pairs: bool) -> np.ndarray:
        """What the pairs of a contact have stored for their corners, of vertices; of those that press, or all."""
        inner, surface = self.pairs.inner, self.pairs.finer.mesh
        count = inner.list.count
        corners = runtime.fetch(inner.list.pairs)[: 4 * count].reshape(-1, 4)
        own = surface.numbers[corners[:, [0, 2]]].max(1) == number
        if not all_pairs:
            gap = whole(inner.plane)[:count, 3]
            own &= ~(gap > gap.dtype.type(inner.contacts.widths[number]))
        pushes, out = (
            runtime.fetch(inner.corner)[: 4 * count].reshape(-1, 4, 3)[own],
            np.zeros((surface.num_vertices, 3)),
        )
        np.add.at(out, corners[own], pushes.astype(np.float64))
        return self.pairs.matrix.T @ out

    def forces(self) -> np.ndarray:
        out, friction = np.zeros(self.shape), self.pairs.friction
        self.pairs.forces(self.p.u, 0, self.p.arrays.corner)
        for number, part in self.parts:
            out[part.k, 0] = self._pushes(number, all_pairs=False)
            if friction:
                out[part.k, 1] = friction.forces(self.p.held_at, number)
        return out

    def jvp(self, d_star, dx, du_begin, numbers, parameters_dot, poses_dot) -> np.ndarray:
        """Their change for those of u*, of x, of where the pass begins, of `numbers`, a Tangent, and of rows of poses."""
        out, friction = np.zeros(self.shape), self.pairs.friction
        runtime.fill(self.p.w, d_star[None])
        moved = numbers.rest, parameters_dot
        self.pairs.product(self.p.u, 0, self.p.w, self.p.arrays.corner, *moved, poses_dot=poses_dot)
        for number, part in self.parts:
            out[part.k, 0] = self._pushes(number, all_pairs=True)
        for number, part in self.parts if friction else ():
            out[part.k, 1] = friction.jvp(self.p.held_at, d_star, dx, du_begin, numbers, poses_dot, number)
        return out

    def vjp(self, seed: np.ndarray) -> np.ndarray:
        """Adjoints of u*, of x, of where the pass begins; adds those of the scene's numbers and of poses."""
        a, out, friction = self.p.arrays, np.zeros((3, *self.shape[2:])), self.pairs.friction
        surface = a.mesh.surface_vertices
        for number, part in self.parts:
            if seed[part.k, 0].any():
                runtime.fill(self.p.w, seed[part.k, :1])
                self.pairs.vjp(self.p.u, 0, self.p.w, a.corner, only=number)
                out[0, surface] += runtime.fetch(a.corner)[a.first_contact_corner :][: len(surface)]
        for number, part in self.parts if friction else ():
            if seed[part.k, 1].any():
                out += friction.vjp(self.p.held_at, seed[part.k, 1], number)
        return out
