"""How gradients grow in long rollouts, and up to where they are of use."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.rollout import Rollout


@dataclass
class Growth:
    """Size of the tangent |dx / dx0| at the frames' times [s], for several random directions (rows).

    rate [1/s]: slope of the logarithm of the largest one over the second half of the run: a finite-time Lyapunov
    exponent. horizon [s]: when the rounding of the precision, grown at the measured pace, reaches `useful` of the state,
    so that the gradient no longer tells where the motion goes; None if it does not within the run.
    """

    times: np.ndarray
    sizes: np.ndarray
    rate: float
    horizon: float | None

    def __str__(self) -> str:
        until = f"of use until t = {self.horizon:.3g} s" if self.horizon is not None else "of use to the end"
        return f"gradients grow to {self.sizes[:, -1].max():.3g} at rate {self.rate:.3g} 1/s; {until}"


def growth(solver, steps: int, frames: int = 50, directions: int = 2, useful: float = 1e-2, seed: int = 0) -> Growth:
    """Tangents of the positions by the start along random directions, through `steps` steps of the solver.

    Benettin et al. 1980, doi:10.1007/BF02128236; Metz et al. 2021, Gradients are not all you need, arXiv:2111.05803.
    """
    if not 0 < useful < 1:
        raise ValueError(f"useful must lie between 0 and 1, got {useful:g}")
    every = max(1, steps // frames)
    rollout = Rollout(solver, steps // every * every, save_every=every)
    start, rng, sizes = rollout.forward(), np.random.default_rng(seed), []
    for _ in range(directions):
        d = rng.standard_normal(start.positions.shape[1:])
        d[solver.scene.fixed] = 0
        moved, _ = rollout.jvp(start, initial_positions=d / np.linalg.norm(d))
        sizes.append(np.linalg.norm(moved, axis=(1, 2)))
    sizes, times = np.array(sizes), rollout.times
    largest = sizes.max(0)
    half = len(times) // 2
    rate = float(np.polyfit(times[half:], np.log(np.maximum(largest[half:], 1e-300)), 1)[0])
    rounding = float(np.finfo(start.positions.dtype).eps)
    beyond = np.flatnonzero(largest * rounding > useful)
    return Growth(times, sizes, rate, float(times[beyond[0]]) if len(beyond) else None)
