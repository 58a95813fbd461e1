"""Soft cubes learn to jump, many of them at once: `diffsim_ti.envs.jumper`, which says what they do and what is observed.

`train` finds actions by the simulator's gradient: one run of sixteen starts at once, forward and in reverse, for each of
thirty iterations.

    python examples/control/jumper.py
"""

import time

import numpy as np

import diffsim_ti as ds
from diffsim_ti.envs.jumper import SoftJumpers

STEP, HORIZON = SoftJumpers.step_time, SoftJumpers.horizon  # [s], steps of an episode


def train(iterations: int = 30, starts: int = 16) -> tuple[np.ndarray, list[float]]:
    """Actions (steps, 2) that lift cubes from many starts, and the mean rise [m] in each iteration.

    Adam on the mean over starts of a smooth maximum, log sum exp, of the heights after half of the episode.
    """
    scene = SoftJumpers.make_scene()
    mesh, rng = scene.mesh, np.random.default_rng(0)
    batch = ds.Batch(ds.SemiImplicitSolver(scene, dt=STEP, substeps=20), HORIZON, starts, save_every=1)
    press, late, sharp = SoftJumpers.forces(mesh), HORIZON // 2, 200.0
    lifts = rng.uniform(0, 0.02, starts)[:, None, None] * np.array([0.0, 1.0, 0.0])
    actions, rises = np.zeros((HORIZON, 2)), []
    mean, square = np.zeros_like(actions), np.zeros_like(actions)
    for k in range(1, iterations + 1):
        forces = np.einsum("tk,kni->tni", np.clip(actions, -1, 1), press)
        frames = batch.forward(initial_positions=mesh.vertices + lifts, external_forces=forces)
        heights = frames.positions[:, late:, :, 1].mean(2)
        weights = np.exp(sharp * (heights - heights.max(1, keepdims=True)))
        weights /= weights.sum(1, keepdims=True) * starts * mesh.num_vertices
        seed = np.zeros_like(frames.positions)
        seed[:, late:, :, 1] = weights[:, :, None]
        by_forces = batch.vjp(frames, seed)["external_forces"]
        gradient = np.einsum("tni,kni->tk", by_forces, press)
        rises.append(float((heights.max(1) - mesh.vertices[:, 1].mean()).mean()))
        mean, square = 0.9 * mean + 0.1 * gradient, 0.99 * square + 0.01 * gradient**2
        step = mean / (1 - 0.9**k) / (np.sqrt(square / (1 - 0.99**k)) + 1e-12)
        actions = np.clip(actions + 0.1 * step, -1, 1)
    return actions, rises


def main(num_envs: int = 32, steps: int = HORIZON, iterations: int = 30) -> dict:
    """Steps per second, all at once and one by one; heights [m] that letting go after a squeeze reaches, and training."""
    out = {}
    for name, count in (("together", num_envs), ("alone", 1)):
        envs = SoftJumpers(count)
        envs.reset(seed=0)
        envs.action_space.seed(0)
        envs.step(envs.action_space.sample())  # compiles
        start = time.perf_counter()
        for _ in range(steps):
            envs.step(envs.action_space.sample())
        out[name] = count * steps / (time.perf_counter() - start)
    envs = SoftJumpers(1)
    envs.reset(seed=0)
    heights = []
    for k in range(HORIZON - 1):
        observed, *_ = envs.step(np.full((1, 2), 1.0 if k < 15 else -1.0 if k < 20 else 0.0))
        heights.append(observed[0, 0])
    out |= {"rest": float(np.mean(heights[10:15])), "jumped": float(max(heights[15:]))}
    print(f"{num_envs} at once: {out['together']:.0f} steps per second; one by one: {out['alone']:.0f}")
    print(f"squeezed, the centre is at {out['rest']:.3f} m; let go, it jumps to {out['jumped']:.3f} m")
    start = time.perf_counter()
    _, rises = train(iterations)
    out |= {"first": rises[0], "best": max(rises)}
    print(
        f"{iterations} iterations in {time.perf_counter() - start:.1f} s: rises of {rises[0]:.3f} to {max(rises):.3f} m"
    )
    return out


if __name__ == "__main__":
    main()
