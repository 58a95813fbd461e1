"""Gradient through an impact: how many substeps an accuracy takes, equal ones and those that `adaptive_steps` finds.

Blocks of 0.1 m are thrown at a rough floor; the gradient is that of the mean height 0.16 s later by the upward velocity of
the start. Its error against substeps of 10 us is not monotone in the substep for any one start, so twenty starts and the
median are taken.

    python examples/benchmarks/impact_steps.py          # prints the table; about a minute
    python examples/benchmarks/impact_steps.py --quick  # three starts
"""

import sys
import time
import warnings

import numpy as np

import diffsim_ti as ds

STEPS, DURATION = 40, 0.16
EQUAL, TOLERANCES = (4, 5, 7, 10, 14, 20, 28, 40), (1e-2, 3e-3, 1e-3, 3e-4)


def thrown(velocity) -> ds.Scene:
    mesh = ds.TetrahedralMesh.create_box(5, 0.1, origin=(0, 0.05, 0))
    floor = ds.Ground(stiffness_per_area=3e6, width=0.005, friction=0.5)
    terms = [ds.Gravity(), ds.Drag(0.5), floor]
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, initial_velocities=velocity, precision="f64")


def verlet(scene: ds.Scene, substeps: int = 1) -> ds.VelocityVerletSolver:
    return ds.VelocityVerletSolver(scene, dt=DURATION / STEPS, substeps=substeps, check_start=False)


def gradient(rollout: ds.Rollout) -> tuple[float, float]:
    """(d mean height / d upward velocity [s], time of forward and reverse [s])"""
    begin = time.perf_counter()
    frames = rollout.forward()
    by_height = np.zeros_like(frames.positions)
    by_height[-1, :, 1] = 1 / frames.positions.shape[1]
    out = rollout.vjp(frames, by_height)["initial_velocities"][:, 1].sum()
    return float(out), time.perf_counter() - begin


def main(starts: int = 20) -> dict:
    """Returns {"equal" or "adaptive": rows of (median substeps, median error, median time [s])}, printed as a table."""
    ds.init("cpu", precision="f64")
    rng, found = np.random.default_rng(0), {}
    for _ in range(starts):
        scene = thrown([rng.uniform(0.5, 1.5), rng.uniform(-1.5, -0.8), 0.0])
        exact, _ = gradient(ds.Rollout(verlet(scene, 400), STEPS))
        runs = {("equal", n): ds.Rollout(verlet(scene, n), STEPS) for n in EQUAL}
        for tolerance in TOLERANCES:
            begin = time.perf_counter()
            steps = ds.adaptive_steps(verlet(scene), STEPS, tolerance)
            found.setdefault("search", []).append(time.perf_counter() - begin)
            runs["adaptive", tolerance] = ds.Rollout(verlet(scene), steps)
        for key, rollout in runs.items():
            gradient(rollout)  # makes room
            got, seconds = gradient(rollout)
            found.setdefault(key, []).append((rollout.sweep.num_passes - 1, abs(got / exact - 1), seconds))
    table = {kind: [np.median(found[key], 0) for key in found if key[0] == kind] for kind in ("equal", "adaptive")}
    print("| steps | substeps | error of the gradient % | time [ms] |")
    print("| --- | ---: | ---: | ---: |")
    for kind, rows in table.items():
        for substeps, error, seconds in rows:
            print(f"| {kind} | {substeps:.0f} | {100 * error:.2g} | {1e3 * seconds:.3g} |")
    print(f"a search takes {1e3 * np.median(found['search']):.3g} ms")
    return table


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(3 if "--quick" in sys.argv else 20)
