"""What is noted of the passes of an implicit run: what solves took and, where it is asked for, what obstacles did."""

import warnings

import numpy as np

from diffsim_ti.solvers.implicit.contact_record import ContactRecord, Shares
from diffsim_ti.state.solve_report import Buckled


class Noted:
    """A part of ImplicitWorkspace."""

    def record_contacts(self) -> None:
        self.impulses = ContactRecord(self)

    def forget_contacts(self) -> None:
        self.record_contacts()

    def contact_forces(self, frame_time: np.ndarray) -> np.ndarray:
        return self.impulses.forces

    def note_contacts(self, j: int, save_every: int) -> None:
        """What obstacles, and friction between surfaces, did in pass j, where it is asked for."""
        if self.impulses and save_every:
            at = self.potential.place(self.u_star)
            shares = self.kept("shares", lambda: Shares(self)) if len(self.arrays.obstacles) else None
            friction = lambda: self.potential.rubbing.forces(at)  # noqa: E731
            self.impulses.add(j, save_every, self.is_static, lambda: shares.forces(), friction)

    def note_solves(self, j: int, num_passes: int, seconds: float) -> None:
        """What pass j took; statics say which saddles they left and, without contact, where states were not stable."""
        step, solves = self.step_of(j, num_passes), self.newton.reports
        self.report.note(step, seconds, solves)
        saddles, unstable = (sum(getattr(solve, name) for solve in solves) for name in ("saddles", "indefinite"))
        # whose curved barriers, and states beside the volumes that are held, are indefinite where nothing buckles
        if self.arrays.contacts or self.pairs or self.volumes:
            unstable = 0
        if self.is_static and (saddles or unstable):
            rounds = sum(max(len(solve.residuals) - 1, 0) for solve in solves)
            left = f"{saddles} saddle{'s' * (saddles > 1)} left: the body was in balance and not stable, as when it buckles"
            if not saddles:
                left = (
                    f"{unstable} of {rounds} rounds of Newton's method met states that are not stable: the body may have "
                    "buckled on the way (follow it by more load_steps)"
                )
            went = "it went to a lower equilibrium, which may be one of several, and gradients are of it"
            said = f"step {step}: {left}; {went}"
            warnings.warn(Buckled(said, step, saddles, unstable), stacklevel=2)

    @property
    def is_static(self) -> bool:
        """Whether passes look for equilibria."""
        return self.solver.stage(self.rate, True, 0).static
