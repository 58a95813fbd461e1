"""What a reverse sweep says of gradients that may be of little use."""

import warnings

from diffsim_ti.solvers.solver import Solver
from diffsim_ti.state.watch import ContactResolution


def warn_of_coarse_steps(solver: Solver, seen: ContactResolution) -> None:
    """Contacts that the steps hardly resolve."""
    damped = solver.stages_contact and solver.contact_damping > 0
    warnings.warn(
        f"gradients through contacts may be off by more than 10 %: {seen}; take substeps of at most "
        f"{seen.advised_substep:.3g} s instead of {seen.substep:.3g} s, or a softer or wider barrier"
        + (", or a smaller contact_damping" if damped else ""),
        stacklevel=4,
    )


def warn_of_explosion(of_frames: tuple, of_start: tuple, duration: float) -> None:
    """An adjoint that grew, by its norms (by displacements, by velocities) where the sweep began and where it ended;
    duration [s] of the run."""
    start, end = (by_u + by_v / duration for by_u, by_v in (of_frames, of_start))
    if end > 1e8 * start > 0:
        warnings.warn(
            f"the adjoint grew by {end / start:.1g} over the run: the motion is chaotic or unstable, and this "
            "gradient is of little use; shorten the rollout, pass truncate=, or see gradient_health",
            stacklevel=4,
        )
