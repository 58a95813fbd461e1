"""What the damping of contacts does, at the longest steps: to gradients of a bounce, to energy, where barriers are stiff.

Soft blocks are thrown onto a floor as in bounce_gradients.py, with substeps of 0.8 of the stable step of the body, on
barriers wide and narrow, as stiff as the scene chooses and a hundred times as stiff. `contact_damping` lies between 0, the
barrier's discrete gradient, and 1, its backward Euler. Of twenty throws there are

    error   the median of the error of d (mean height at the end) / d (speed at the start), against substeps 25 times as
            fine without damping
    growth  the largest such gradient, over the time of flight; far above 1, a bounce is chaotic
    lost    the median share of the energy of the fall that the contact took

    python examples/contact/damping_map.py [number of starts]
"""

import sys
import warnings

import numpy as np
from bounce_gradients import DURATION, gradient, limits, thrown_scene

import diffsim_ti as ds

DAMPINGS = (0.0, 0.005, 0.02, 0.1, 0.3, 1.0)
BARRIERS = ((0.01, 1), (0.01, 100), (2e-3, 1), (2e-3, 100))  # (width [m], times the stiffness that the scene chooses)
SHARE = 0.8  # of the stable step of the body


def lost(scene: ds.Scene, substep: float, damping: float) -> float:
    """The share of the energy of a throw, less that of the body at the floor at rest, that is gone at the end."""
    steps = int(np.ceil(DURATION / substep))
    simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=DURATION / steps, contact_damping=damping))
    first = simulator.compute_energy()
    fall = 9.81 * scene.terms[1].gap(scene.mesh.vertices).min()
    speed = scene.inputs.values["initial_velocities"][0, 1]
    mass = float(simulator.scene.inputs.derive(scene.inputs.values).mass.sum())
    simulator.run(steps)
    return float(first - simulator.compute_energy()) / (mass * (fall + speed**2 / 2))


def column(width: float, stiffer: float, starts: int, finest: float) -> dict:
    """{damping: (error, growth, lost)}"""
    scenes = [thrown_scene(k, "blocks", width, stiffer) for k in range(starts)]
    steps, found = limits(scenes), {}
    right = np.array([gradient(s, finest * h, dict(contact_damping=0.0))[0] for s, h in zip(scenes, steps)])
    for damping in DAMPINGS:
        runs = [gradient(s, SHARE * h, dict(contact_damping=damping))[0] for s, h in zip(scenes, steps)]
        values = np.where(np.isnan(runs), np.inf, runs)
        gone = [lost(s, SHARE * h, damping) for s, h, x in zip(scenes, steps, runs) if np.isfinite(x)]
        error = np.median(np.abs(values / right - 1))
        found[damping] = float(error), float(np.abs(values).max() / DURATION), float(np.median(gone))
    return found


def main(starts: int = 20, finest: float = 1 / 32, barriers: tuple = BARRIERS) -> dict:
    """Returns {(width, stiffer): {damping: (error, growth, lost)}}, printed as a table."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of substeps that are too long for gradients: that is what is looked at
        found = {barrier: column(*barrier, starts, finest) for barrier in barriers}
    print("| `contact_damping` | " + " | ".join(f"{1e3 * w:g} mm, x {x}: error | lost" for w, x in found) + " |")
    print("| ---: |" + " ---: |" * 2 * len(found))
    for damping in DAMPINGS:
        cells = (by_damping[damping] for by_damping in found.values())
        rows = (f"{100 * error:.2g} % | {100 * gone:.2g} %" for error, _, gone in cells)
        print(f"| {damping:g} | " + " | ".join(rows) + " |")
    print(f"growth at most {max(row[1] for by_damping in found.values() for row in by_damping.values()):.2g}")
    return found


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*(int(x) for x in sys.argv[1:2]))
