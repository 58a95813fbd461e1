"""Two pads learn to hold a soft cube: how far each squeezes, at five times, so that the cube is lifted and does not slip.

Pads are planes that follow paths; the gradient by the paths goes through friction, which is all that holds the cube.

    python examples/control/gripper.py [folder for a film]
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import diffsim_ti as ds
from diffsim_ti.film import save_film
from diffsim_ti.obstacles import box

SIZE, WIDTH, DURATION, DT = 0.1, 0.01, 0.5, 2.5e-4  # [m], [m], [s], [s]
LIFT, KNOTS = 0.05, np.array([0.1, 0.2, 0.3, 0.4, 0.5])  # [m]; when squeezes are chosen [s], at first there is none
SLIP, GRIPPED = 5e-4, 2  # what counts as held [m]; from which of 11 frames on, that is from 0.1 s


def gripper_scene() -> ds.Scene:
    """The cube on a floor between two pads that stand clear of it."""
    cube = ds.TetrahedralMesh.create_box(3, size=SIZE, origin=(-SIZE / 2, 0.006, -SIZE / 2))
    options = dict(stiffness=300.0, width=WIDTH, friction=0.5, friction_speed=5e-3)
    still = ([0.0, DURATION], np.zeros((2, 3)))  # the paths are inputs
    left = ds.HalfSpace((-SIZE / 2 - WIDTH, 0, 0), (1, 0, 0), path=still, **options)
    right = ds.HalfSpace((SIZE / 2 + WIDTH, 0, 0), (-1, 0, 0), path=still, **options)
    floor = ds.Ground(stiffness=500.0, width=WIDTH)
    terms = [ds.Gravity(), ds.Drag(2.0), left, right, floor]
    return ds.Scene(cube, ds.StableNeoHookean(1e5, 0.3), 300.0, terms, precision="f64")


def save_lift(path, scene: ds.Scene, paths: dict, times) -> None:
    """A film of the lift, ten times slower than it is."""
    every = len(times) // 40
    shown = times[::every]
    frames = ds.Rollout(ds.SemiImplicitSolver(scene, dt=DT), len(times) - 1, every, gradients=[]).forward(**paths)
    places = [
        (side * (SIZE / 2 + 1.5 * WIDTH), SIZE / 2, 0) + path[::every] for side, path in zip((-1, 1), paths.values())
    ]
    pads = [[box(place, (WIDTH, SIZE, SIZE), (1, 0, 0, 0)) for place in pair] for pair in zip(*places)]
    save_film(
        path,
        scene.mesh,
        frames.positions,
        fps=8.0,
        size=(400, 300),
        obstacles=pads,
        ground=0.0,
        wireframe=True,
        elevation=18,
        box=[[-0.1, 0, -0.05], [0.1, 0.16, 0.05]],
        title=lambda k: f"lifted by friction alone, t = {shown[k]:.2f} s",
    )


def main(picture_folder: str | None = None) -> dict:
    """Returns how far the cube slips at first and at last [m], the squeezes [m], evaluations and seconds."""
    scene = gripper_scene()
    steps = round(DURATION / DT)
    rollout = ds.Rollout(
        ds.SemiImplicitSolver(scene, dt=DT), steps, steps // 10, gradients=["half_space_path", "half_space_path_2"]
    )
    times = np.arange(steps + 1) * DT
    lift = np.clip((times - 0.12) / 0.28, 0, 1)
    lift = LIFT * lift**2 * (3 - 2 * lift)
    hats = np.stack([np.interp(times, [0, *KNOTS], row) for row in np.eye(6)[1:]], 1)  # (steps + 1, knots)
    start, seen = time.perf_counter(), []

    def paths(q):
        """How the pads move, from squeezes [m] of left and right pad at the knots."""
        rows = (("half_space_path", 1, q[0]), ("half_space_path_2", -1, q[1]))
        return {name: np.stack([sign * hats @ row, lift, 0 * lift], 1) for name, sign, row in rows}

    def evaluate(squeezes):
        """Loss and its gradient by the squeezes [cm]."""
        q = 0.01 * squeezes.reshape(2, -1)
        frames = rollout.forward(**paths(q))
        # against the pads, from when they have closed on it
        slip = frames.positions[GRIPPED:].mean(1) - frames.positions[GRIPPED].mean(0)
        slip[:, 1] -= (lift[:: steps // 10] - lift[GRIPPED * steps // 10])[GRIPPED:]
        weights = np.zeros_like(frames.positions)
        weights[GRIPPED:] = 2 * slip[:, None] / SIZE**2 / scene.mesh.num_vertices
        weights[GRIPPED] -= weights[GRIPPED:].sum(0)
        by = rollout.vjp(frames, weights)
        gradient = np.stack([hats.T @ by["half_space_path"][:, 0], -hats.T @ by["half_space_path_2"][:, 0]])
        seen.append(dict(slip=float(np.linalg.norm(slip, axis=1).max()), q=q, frames=frames))
        print(f"evaluation {len(seen)}: slips by {1000 * seen[-1]['slip']:.3g} mm")
        return (slip**2).sum() / SIZE**2, (0.01 * gradient).ravel()

    def held(result):
        if min(run["slip"] for run in seen) < SLIP:
            raise StopIteration

    minimize(evaluate, np.full(10, 0.2), jac=True, method="L-BFGS-B", bounds=[(0, 1)] * 10, callback=held)
    seconds = time.perf_counter() - start
    best = min(seen, key=lambda run: run["slip"])
    if picture_folder:
        save_lift(Path(picture_folder) / "gripper.gif", scene, paths(best["q"]), times)
    print(
        f"slips by {100 * seen[0]['slip']:.3g} cm at first, {1000 * best['slip']:.2g} mm at last; squeezes [mm] "
        f"{(1000 * best['q']).round(1).tolist()}; {len(seen)} evaluations, {seconds:.1f} s; "
        f"{best['frames'].contact_resolution}"
    )
    return {
        "before": seen[0]["slip"],
        "after": best["slip"],
        "squeezes": best["q"],
        "evaluations": len(seen),
        "resolved": best["frames"].contact_resolution.resolved,
        "seconds": seconds,
    }


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
