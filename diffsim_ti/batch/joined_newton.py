"""Newton's method for all scenes of a batch at once, each with its own steps, tolerances and end.

They go through the rounds of one scene (solvers/implicit/rounds.py) together. A scene that leaves their usual course (a line
search that finds nothing, rounds that are used up, of statics an indefinite Hessian) is given up, and run alone
(batch/batch.py).
"""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import ConsistentMass
from diffsim_ti.solvers.implicit import newton_kernels as nk
from diffsim_ti.solvers.implicit.cg_kernels import COUNT, STOPPED
from diffsim_ti.solvers.implicit.newton import Newton


class JoinedNewton(Newton):
    """`going`: (scenes,), those that are not given up."""

    saddles = False  # whether negative curvature is left to runs alone

    def spread(self, x: np.ndarray) -> np.ndarray:
        """A number of each scene for each vertex, shape (num_vertices, 1)."""
        return np.repeat(x, len(self.moves) // len(self.going))[:, None]

    def solve_all(
        self, start, problem: tuple, going: np.ndarray, leave_saddles: bool, rounds: int | None = None
    ) -> tuple:
        """(minimisers, whether each scene came to its own), as `Newton.solve` of each scene that is `going`; `rounds`: those
        that each took."""
        self.pose(problem)
        self.going, self.saddles = going.copy(), leave_saddles
        self.potential.only(np.ones(len(going), bool))
        self.potential.place(start)
        here, most = self.loop, self.max_iterations if rounds is None else rounds
        here.start(self, 0.0 if rounds is None else self.roughly, most)
        while True:
            here.advance()
            state, many = here.state, here.state[:, nk.PHASE] == nk.MANY
            state[:, nk.MOST] = np.minimum(most + state[:, nk.CUTS], self.patience * most)
            more = many & (state[:, nk.ROUND] <= state[:, nk.MOST]) & (rounds is None)
            if not more.any():
                break
            state[more, nk.PHASE] = nk.UPDATE
        phase, small = state[:, nk.PHASE], (state[:, nk.SOLVED] == 1) | (state[:, nk.NORM] <= 100 * state[:, nk.FLOOR])
        solved = (phase == nk.DONE) | ((phase == nk.TROUBLE) & small)  # rounding has the last word
        solved = going & (solved | many & (rounds is not None))
        self.upright, self.rounds = state[:, nk.UPRIGHT] == 1, state[:, nk.ROUND] - 1
        self.potential.only(going)
        u = self.potential.place(runtime.fetch(here.u).astype(np.float64))
        if leave_saddles and solved.any() and not self.by_residual:
            solved &= self._stable(u, solved)
        return u, solved

    def leave(self, rounds, odd: np.ndarray) -> None:
        """Scenes whose linear solve did not succeed go on as far as it led to negative curvature, or are left."""
        state, cg = rounds.state, rounds.cg
        goes_on = odd & (state[:, STOPPED] == 2) & (not self.saddles)
        first = goes_on & (state[:, COUNT] <= 1)
        if first.any():
            x, p = (runtime.fetch_row(own, 0) for own in (cg.x, cg.p))
            runtime.fill(cg.x, np.where(self.spread(first), p, x)[None])
        state[goes_on, STOPPED] = 1
        lost = odd & ~goes_on
        state[lost, nk.PHASE], state[lost, nk.NORM], state[lost, nk.SOLVED] = nk.TROUBLE, np.inf, 0
        state[lost, STOPPED] = nk.WAITS

    def system(self) -> tuple:
        """(diagonal mass, matrix of blocks or None) that join the potential's Hessian."""
        mass, at, parts = self.mass, self.potential.held_at, []
        if isinstance(mass, ConsistentMass):
            parts, mass = [mass.blocks()], np.zeros((len(at), 1))
        parts += [part.matrix(at) for part in (*self.potential.hosts, *self.others)]
        return mass, sum(parts[1:], parts[0]) if parts else None

    def _stable(self, u, solved) -> np.ndarray:
        """Whether Phi falls in no direction at u, as `Newton._downhill` asks."""
        count = len(solved)
        probe = np.tile(np.random.default_rng(0).standard_normal((len(u) // count, 3)), (count, 1)) * self.free
        self.preconditioner.update(u)
        most = min(10 * len(u) // count, self.preconditioner.patience)
        return self.preconditioner.solver(*self.system(), probe, np.full(count, 1e-3), solved, most, self.eps)[1]
