"""Admissible motions of vertices, of which some are fixed in some directions only."""

import numpy as np


class FreeDirections:
    """Projectors of vertices: `x * free` takes from vectors, shape (num_vertices, 3), what is held of them.

    mask: (num_vertices, 1), 0 where a vertex is fixed wholly, else 1; guided: the fixed vertices in some directions,
    with projectors onto these, shape (k, 3, 3).
    """

    __array_ufunc__ = None  # so that NumPy leaves x * free to this class

    def __init__(self, mask: np.ndarray, partly_fixed: np.ndarray, sliding_supports: np.ndarray):
        self.mask, self.partly_fixed, self.sliding_supports = mask, partly_fixed, sliding_supports

    def __rmul__(self, x: np.ndarray) -> np.ndarray:
        out = x * self.mask
        partly_fixed = out[self.partly_fixed, :, None]
        for _ in range(2):  # where next to nothing is free, once leaves as much rounding of what is held
            partly_fixed = partly_fixed - self.sliding_supports @ partly_fixed
        out[self.partly_fixed] = partly_fixed[..., 0]
        return out

    __mul__ = __rmul__

    @property
    def linear(self) -> "FreeDirections":
        """The same, with all motions of sets that do not deform."""
        return self

    def projectors(self) -> np.ndarray:
        """Of all vertices, shape (num_vertices, 3, 3)."""
        out = self.mask[:, :, None] * np.eye(3)
        out[self.partly_fixed] -= self.sliding_supports
        return out

    def of(self, vertices: np.ndarray) -> "FreeDirections":
        """The same of some vertices, sorted, by their places."""
        here = np.isin(self.partly_fixed, vertices)
        return FreeDirections(
            self.mask[vertices], np.searchsorted(vertices, self.partly_fixed[here]), self.sliding_supports[here]
        )

    def around(self, blocks: np.ndarray) -> np.ndarray:
        """P B P for a block of each vertex, shape (num_vertices, 3, 3)."""
        P, out = np.eye(3) - self.sliding_supports, np.array(blocks)
        out[self.partly_fixed] = P @ blocks[self.partly_fixed] @ P
        return out


class FreeBodies(FreeDirections):
    """The same where some vertices go together (reduced.py): none of these is held.

    rigid: of what acts on sets that do not deform where they stand (rigid_sets.py); None: of all motions of their vertices.
    """

    def __init__(self, mask: np.ndarray, partly_fixed: np.ndarray, sliding_supports: np.ndarray, reduced, rigid=None):
        super().__init__(mask, partly_fixed, sliding_supports)
        self.reduced, self.rigid = reduced, rigid

    def __rmul__(self, x: np.ndarray) -> np.ndarray:
        x = self.reduced.of(super().__rmul__(x))
        return self.rigid.resultants(x) if self.rigid else x

    __mul__ = __rmul__

    @property
    def elimination(self):
        """T of glued.py, where ties are all that there is; else None."""
        only = len(self.reduced.bodies) == 1 and self.reduced.bodies[0].kind == "tie"
        return self.reduced.bodies[0].matrix if only else None

    @property
    def linear(self) -> "FreeBodies":
        return FreeBodies(self.mask, self.partly_fixed, self.sliding_supports, self.reduced)


Free = np.ndarray | FreeDirections  # numbers (num_vertices, 1) where no vertex is fixed in some directions only


def mask_of(free: Free) -> np.ndarray:
    """1 where a vertex moves in some direction, else 0, shape (num_vertices, 1)."""
    return free.mask if isinstance(free, FreeDirections) else free


def projectors_of(free: Free) -> np.ndarray:
    """Projectors of all vertices on what they may do, shape (num_vertices, 3, 3)."""
    return free.projectors() if isinstance(free, FreeDirections) else free[:, :, None] * np.eye(3)


def cleaned(free: Free, x: np.ndarray) -> np.ndarray:
    """A solution without the rounding that is left of it in what is held."""
    return x * free if isinstance(free, FreeDirections) else x


def linear_of(free: Free) -> Free:
    """What vertices may do, with all motions of sets that do not deform: these are no linear space."""
    return free.linear if isinstance(free, FreeDirections) else free


def held_as(free: Free, held: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Displacements that are `held` where vertices are held, and `moving` in what they may do."""
    free = linear_of(free)
    return held + (moving - held) * free if isinstance(free, FreeDirections) else held * (1 - free) + moving * free
