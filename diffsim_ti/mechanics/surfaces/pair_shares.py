"""What points and edges of each obstacle, and surfaces of bodies, do to each vertex in an implicit pass, with tangent and
adjoint."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import whole


class PairShares:
    """Of the pairs of a potential at its displacement, by contacts; arrays of the shape (obstacles, and a row of surfaces on
    each other, 2: by push and by friction, num_vertices, 3)."""

    def __init__(self, potential):
        self.p, self.pairs = potential, potential.pairs
        a, self.parts = potential.arrays, []  # (row, number of the contact, None where there is one alone)
        if self.pairs.obstacles:
            self.parts = [(part.k, k) for k, part in enumerate(self.pairs.finer.mesh.corners.parts, start=1)]
        if a.self_contact:
            self.parts.append((len(a.obstacles), 0 if self.parts else None))
        self.shape = a.num_contact_rows, 2, a.num_vertices, 3

    def _of_all(self) -> np.ndarray:
        """What all pairs have put into the last corners, of vertices."""
        a, out = self.p.arrays, np.zeros(self.shape[2:])
        surface = a.mesh.surface_vertices
        out[surface] = runtime.fetch(a.corner)[a.first_contact_corner :][: len(surface)]
        return out

    def _pushes(self, number: int | None, all_pairs: bool) -> np.ndarray:
        """What the pairs of a contact have stored for their corners, of vertices; of those that press, or all."""
        if number is None:
            return self._of_all()
        inner, surface = self.pairs.inner, self.pairs.finer.mesh
        count = inner.list.count
        corners = runtime.fetch(inner.list.pairs)[: 4 * count].reshape(-1, 4)
        own = surface.numbers[corners[:, [0, 2]]].max(1) == number
        if not all_pairs:
            gap = whole(inner.plane)[:count, 3]
            own &= ~(gap > gap.dtype.type(inner.contacts.widths[number]))
        pushes = runtime.fetch(inner.corner)[: 4 * count].reshape(-1, 4, 3)[own]
        out = np.zeros((surface.num_vertices, 3))
        np.add.at(out, corners[own], pushes.astype(np.float64))
        return self.pairs.matrix.T @ out

    def forces(self) -> np.ndarray:
        out, friction = np.zeros(self.shape), self.pairs.friction
        self.pairs.forces(self.p.u, 0, self.p.arrays.corner)
        for row, number in self.parts:
            out[row, 0] = self._pushes(number, all_pairs=False)
            if friction:
                out[row, 1] = friction.forces(self.p.held_at, number)
        return out

    def jvp(self, d_star, dx, du_begin, numbers, parameters_dot, poses_dot) -> np.ndarray:
        """Their change for those of u*, of x, of where the pass begins, of `numbers`, a Tangent, and of rows of poses."""
        out, friction = np.zeros(self.shape), self.pairs.friction
        runtime.fill(self.p.w, d_star[None])
        moved = numbers.rest, parameters_dot, poses_dot
        self.pairs.product(self.p.u, 0, self.p.w, self.p.arrays.corner, *moved)
        for row, number in self.parts:
            out[row, 0] = self._pushes(number, all_pairs=True)
        for row, number in self.parts if friction else ():
            out[row, 1] = friction.jvp(self.p.held_at, d_star, dx, du_begin, numbers, poses_dot, number)
        return out

    def vjp(self, seed: np.ndarray) -> np.ndarray:
        """Adjoints of u*, of x, of where the pass begins; adds those of the scene's numbers and of poses."""
        a, out, friction = self.p.arrays, np.zeros((3, *self.shape[2:])), self.pairs.friction
        for row, number in self.parts:
            if seed[row, 0].any():
                runtime.fill(self.p.w, seed[row, :1])
                self.pairs.vjp(self.p.u, 0, self.p.w, a.corner, only=number)
                out[0] += self._of_all()
        for row, number in self.parts if friction else ():
            if seed[row, 1].any():
                out += friction.vjp(self.p.held_at, seed[row, 1], number)
        return out
