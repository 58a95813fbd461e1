"""Equilibria of bodies that supports leave free to move rigidly, and that contact holds.

Where contact is open nothing resists such motions, and no equilibrium is near. So the body goes to it in proximal steps,

    u <- argmin Phi(w) + c/2 |w - u|^2_M,

which are those of an overdamped motion: the loads carry it no farther than their acceleration over c, until what it touches
holds it. Their fixed points are the equilibria, and the last solve is Newton's of the equilibrium itself.
Rockafellar 1976, Monotone operators and the proximal point algorithm, doi:10.1137/0314056.
"""

import weakref

import numpy as np

from diffsim_ti.common.errors import NotConverged
from diffsim_ti.common.warn import warn
from diffsim_ti.mesh.sets import pieces
from diffsim_ti.terms.supports import rigid_motions_left


class Closing:
    """Of a workspace whose solver says in `loose` what is free to move rigidly but for contact."""

    first, growth = 1e-3, 4.0  # way of the first step over the body's size, and of each over that of the one before
    least = 1e-6  # stiffness of a motion that is held, over that of the stiffest

    def __init__(self, workspace):
        self.ws, self.said = weakref.proxy(workspace), False  # which holds this: no circle
        rest = workspace.arrays.values.rest
        self.size = float(np.ptp(rest, 0).max())

    def _motions(self, u: np.ndarray) -> np.ndarray:
        """Rigid motions of the pieces that supports leave at u, shape (k, num_vertices, 3)."""
        ws, out = self.ws, []
        x, piece = ws.arrays.values.rest + u, pieces(ws.scene.mesh)
        for number in np.unique(piece[ws.scene.mesh.tetrahedra[:, 0]]):
            own = (piece == number)[:, None]
            arms = (x - x[own[:, 0]].mean(0)) / self.size
            shifts = np.broadcast_to(np.eye(3)[:, None], (3, *x.shape))
            z = np.concatenate([shifts, np.cross(np.eye(3)[:, None], arms)]) * own
            against = np.stack([m - m * ws.linear for m in z]).reshape(6, -1)
            values, vectors = np.linalg.eigh(against @ against.T)
            out += list(np.tensordot(vectors.T[values < 1e-10 * own.sum()], z, 1))
        return np.array(out).reshape(-1, *x.shape)

    def left(self, u: np.ndarray) -> np.ndarray:
        """Those of them that contact, springs and the like do not resist at u."""
        z = self._motions(u)
        self.ws.potential.place(u)
        if not len(z):
            return z
        K = np.tensordot(z, [self.ws.potential.contact_product(w) for w in z], ([1, 2], [1, 2]))
        values, vectors = np.linalg.eigh(0.5 * (K + K.T))
        return np.tensordot(vectors.T[values <= self.least * max(values[-1], 0.0)], z, 1)

    def approached(self, start: np.ndarray, problem: tuple) -> np.ndarray:
        """A place from where Newton's method finds the equilibrium of a problem (`Newton.solve`). Raises NotConverged."""
        ws, (_, _, loads) = self.ws, problem
        newton, place = ws.newton, start
        ws.potential.place(start)
        R, left, way = newton.residual_of(problem), self.left(start), self.first * self.size
        pull = max((abs(float((m * R).sum())) / float((m * (ws.mass * m)).sum()) for m in left), default=0.0)
        while len(left):
            if not pull > 0 or way > 4 * self.size or np.abs(place - start).max() > self.size:
                raise NotConverged(
                    f"static solve: but for contact {ws.solver.loose}, and contact leaves {self._words(left)}: hold it by "
                    "fixed=..., bring it nearer to what it is to lie on, let it begin within the barrier where friction is "
                    "to hold it, or use a solver with inertia",
                    [],
                )
            place, way = newton.solve(place, pull / way * ws.mass, place, loads), self.growth * way
            left = self.left(place)
        if not self.said:
            self.said = True
            warn(f"static solve: but for contact {ws.solver.loose}; contact holds it")
        return place

    def _words(self, left: np.ndarray) -> str:
        """What is left where the potential stands."""
        p, supports = self.ws.potential, self.ws.scene.supports
        x, (values, vectors) = p.arrays.values.rest + p.held_at, np.linalg.eigh(p.contact_blocks())
        stiff = (values > 1e-6 * values.max())[:, None] * vectors
        places, held = (x, x[supports.vertices]), (stiff @ np.swapaxes(stiff, 1, 2), supports.held)
        words = rigid_motions_left(np.concatenate(places), np.concatenate(held))
        return words or f"{len(left)} rigid motion{'s' if len(left) > 1 else ''} of its pieces together"
