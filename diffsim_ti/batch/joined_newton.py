"""Newton's method for all scenes of a batch at once, each with its own steps, tolerances and end.

What is done here is the usual course of Newton (solvers/implicit/newton.py) of one scene. A scene that leaves it (a line
search that finds nothing, rounds that are used up, of statics an indefinite Hessian) is given up here, and run alone
(batch/batch.py).
"""

import numpy as np

from diffsim_ti.inputs import ConsistentMass
from diffsim_ti.solvers.implicit.newton import Newton


class JoinedNewton(Newton):
    """`going`: (scenes,), those that are not given up."""

    def _rows(self, x: np.ndarray) -> np.ndarray:
        return x.reshape(len(self.going), -1)

    def _dot(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.einsum("bi,bi->b", self._rows(a), self._rows(b))

    def spread(self, x: np.ndarray) -> np.ndarray:
        """A number of each scene for each vertex, shape (num_vertices, 1)."""
        return np.repeat(x, len(self.moves) // len(self.going))[:, None]

    def solve_all(
        self, start, problem: tuple, going: np.ndarray, leave_saddles: bool, rounds: int | None = None
    ) -> tuple:
        """(minimisers, whether each scene came to its own), as `Newton.solve` of each scene that is `going`; `rounds`: those
        that each took."""
        self.mass, self.inertial, self.loads = problem
        self.going = going = going.copy()
        self.potential.only(np.ones(len(going), bool))
        u = self.potential.place(start)
        self.preconditioner, self.stiffness = self.preconditioners(self.mass)
        B, far = len(going), np.abs(u).max(1, keepdims=True)
        E, norm, rough = self.potential.energies(), np.full(B, np.inf), np.zeros(B, bool)
        self.upright = (E[2] > 0).all(1)
        solved, left, cuts, self.rounds = np.zeros(B, bool), going.copy(), *np.zeros((2, B), int)
        while True:
            (R, size), before = self._residual_all(u), norm
            rounding = self.eps * np.maximum(np.abs(u).max(1, keepdims=True), far)
            stiff = self._rigidity() * rounding * self.moves
            floor, norm = 4 * np.sqrt(self._dot(stiff, stiff)), np.sqrt(self._dot(R, R))
            small = norm <= self.tolerance * size + floor
            solved |= left & small & (~rough | (norm <= floor))
            if rounds is not None:
                solved |= left & np.isfinite(norm) & ((norm <= self.roughly * size) | (self.rounds >= rounds))
            most = np.minimum(self.max_iterations + cuts, self.patience * self.max_iterations)
            left &= ~solved & np.isfinite(norm) & (self.rounds < most)
            if not left.any():
                break
            self.rounds += left
            self.potential.only(left)
            self.preconditioner.update(u)
            forcing = np.array(
                [self._forcing(*x) if on else 1.0 for *x, on in zip(norm, before, small, size, floor, left)]
            )
            with np.errstate(divide="ignore", invalid="ignore"):
                rough = forcing > np.maximum(self.inexact, 0.3 * floor / norm)
            d, found, down, _ = self._direction_all(R * self.spread(left), np.maximum(forcing, 10 * self.eps), left)
            left &= found | (down & (not leave_saddles))
            u, E, moved, cut = self._search_all(u, d * self.spread(left), R, E, left)
            cuts += cut
            resting = left & ~moved & (small | (norm <= 100 * floor))  # rounding has the last word
            solved, left = solved | resting, left & moved
        self.potential.only(going)
        if leave_saddles and solved.any() and not self.by_residual:
            solved &= self._stable(u, solved)
        return u, solved

    def _direction_all(self, R, forcing, left) -> tuple:
        most = min(10 * len(R) // len(left), self.preconditioner.patience)
        return self.preconditioner.solver(*self.system(), R, forcing, left, most, self.eps)

    def system(self) -> tuple:
        """(diagonal mass, matrix of blocks or None) that join the potential's Hessian."""
        mass, at, parts = self.mass, self.potential.held_at, []
        if isinstance(mass, ConsistentMass):
            parts, mass = [mass.blocks()], np.zeros((len(at), 1))
        parts += [part.matrix(at) for part in (*self.potential.hosts, *self.others)]
        return mass, sum(parts[1:], parts[0]) if parts else None

    def _stable(self, u, solved) -> np.ndarray:
        """Whether Phi falls in no direction at u, as `Newton._downhill` asks."""
        probe = np.tile(np.random.default_rng(0).standard_normal((len(u) // len(solved), 3)), (len(solved), 1))
        self.preconditioner.update(u)
        return self._direction_all(probe * self.free, np.full(len(solved), 1e-3), solved)[1]

    def _rigidity(self) -> np.ndarray:
        """How much force a small displacement makes at each vertex [N/m], contact and friction included."""
        contact = self.potential.contact_blocks()
        return self.stiffness if contact is None else self.stiffness + np.abs(contact).sum((1, 2))[:, None]

    def _forcing(self, norm, before, solved, size, floor) -> float:
        """Relative residual of a round's linear solve: rough while rounds gain little, but not of the last one, whose error
        slow motions of stiff bodies would show. Eisenstat, Walker 1996, Choosing the Forcing Terms in an Inexact Newton
        Method, choice 2, doi:10.1137/0917003."""
        if not np.isfinite(norm):
            return self.inexact
        last = 0.3 * self.tolerance * size / norm  # what makes this round the last one, if that is within reach
        exact = min(self.inexact, np.sqrt(norm / size), last if last > 0.03 * self.inexact else 1.0)
        exact = max(exact, 0.3 * floor / norm)  # rounding would hide more
        gained = min(norm / before, 1.0) if np.isfinite(before) else 1.0
        return exact if solved else max(exact, min(self.rough, 0.9 * gained**2))

    def _residual_all(self, u):
        R, sizes = self.residual(u)
        return R, np.sqrt(self._dot(sizes, sizes))

    def _search_all(self, u, d, R, before, left) -> tuple:
        """(where scenes get, what was evaluated there, whether each moved, whether an obstacle cut it short)."""
        slope, share = self._dot(R, d), self.collisions(u, d)
        open_, moved, share = left.copy(), np.zeros(len(left), bool), np.where(left, np.minimum(1.0, share), 0.0)
        cut, E0 = left & (share < 1), before
        after = E0
        while open_.any():
            self.potential.only(open_)
            trial = self.potential.place(u + self.spread(share) * d)
            after = self.potential.energies()
            step = trial - u
            change = after[0] - E0[0] + self._against_loads_all(u, step)
            if self.others:
                change = change - self._work(u, step)
            kept = (after[2] > 0.1 * E0[2]).all(1)
            change = np.where(self.upright & (share > self.insist) & ~kept, np.inf, change)
            size = E0[1] + after[1] + self._rows(self.stiffness * trial**2).sum(1)
            noise = 10 * self.eps * size
            with np.errstate(invalid="ignore"):
                lower = change <= -1e-4 * share * slope
                drowned = (np.abs(slope) * share <= noise) & (noise >= change)
            ask = open_ & ~lower & drowned
            if ask.any():
                lower |= ask & (self._dot(self._residual_all(trial)[0], d) >= -0.8 * slope)
            found = open_ & lower
            self.upright &= ~found | (share > self.insist)
            moved |= found
            open_ &= ~lower
            share = np.where(open_, 0.5 * share, share)
            given_up = open_ & ~(share > self.shortest)  # also a share that is no number
            open_ &= ~given_up
            share = np.where(given_up, 0.0, share)
        if (left & ~moved).any():  # these stay
            self.potential.only(left & ~moved)
            self.potential.place(u + self.spread(np.where(moved, share, 0.0)) * d)
            after = self.potential.energies()
        self.potential.only(moved)
        return self.potential.held_at, after, moved, cut

    def _work(self, u, step) -> np.ndarray:
        return sum(part.work(u, step) for part in self.others)

    def _against_loads_all(self, u, step) -> np.ndarray:
        return self._dot(step, self.mass * (u + 0.5 * step - self.inertial) - self.loads)

    def rises(self, u, before: tuple, there, problem: tuple) -> np.ndarray:
        """`rise` of each scene."""
        self.mass, self.inertial, self.loads = problem
        self.potential.only(self.going)
        step = self.potential.place(there) - u
        (after, _, J), (E, _, J0) = self.potential.energies(), before
        with np.errstate(invalid="ignore"):
            sound = ((J0 <= 0) | ((J > 0.1 * J0) & (J < 10 * J0))).all(1)
        change = after - E + self._against_loads_all(u, step)
        if self.others:
            change = change - np.minimum(self._dot(self.others.forces(u), step), self._work(u, step))
        return np.where(sound, change, np.inf)
