"""How far gradients through a bounce can be trusted, by the substep: a barrier as a force, and as a stage of its own.

A soft ball, turned at random, is thrown onto a floor; asked is how its mean height after the bounce changes with the speed
that it was thrown with. The error is that against a run with much finer substeps of the same kind, and the median is over
all starts. A force needs substeps that follow the barrier; a stage takes those that the body allows.

    python examples/contact/bounce_gradients.py [folder for a chart] [number of starts]
"""

import sys
import warnings
from pathlib import Path

import numpy as np

import diffsim_ti as ds

DURATION = 0.12  # [s]
SHARES = (0.8, 0.4, 0.2, 0.1)  # of the stable step of the body
KINDS = {
    "force": dict(contact="force"),
    "stage, damping 0": dict(contact_damping=0.0),
    "stage, default": {},
    "stage, damping .1": dict(contact_damping=0.1),
    "stage, damping 1": dict(contact_damping=1.0),
}


def soft_ball(cells: int = 5, radius: float = 0.1) -> ds.TetrahedralMesh:
    """A grid whose cubes are blown up to spheres."""
    cube = ds.TetrahedralMesh.create_box(cells + 1, size=2.0, origin=(-1, -1, -1))
    length = np.linalg.norm(cube.vertices, axis=1)
    stretch = np.abs(cube.vertices).max(1) / np.maximum(length, 1e-9)
    return ds.TetrahedralMesh(radius * cube.vertices * stretch[:, None], cube.tetrahedra)


def thrown_scene(start: int) -> ds.Scene:
    """The start-th throw."""
    rng = np.random.default_rng(start)
    ball = soft_ball().rotated(rng.standard_normal(3), rng.uniform(0, np.pi))
    ball = ball.translated([0, rng.uniform(0.004, 0.02) - ball.bounding_box[0, 1], 0])
    terms = [ds.Gravity(), ds.Ground(stiffness=None, width=2e-3)]
    speed = rng.uniform(0.2, 0.6)
    law = ds.StableNeoHookean(1e5, 0.4)
    return ds.Scene(ball, law, terms=terms, initial_velocities=(0, -speed, 0), precision="f64")


def gradient(scene: ds.Scene, substep: float, options: dict) -> float:
    """d (mean height at the end) / d (speed upwards at the start) [s]; not a number where the run fails."""
    steps = int(np.ceil(DURATION / substep))
    solver = ds.VelocityVerletSolver(scene, dt=DURATION / steps, **options)
    rollout = ds.Rollout(solver, steps, save_every=steps, gradients="initial_velocities")
    try:
        frames = rollout.forward()
    except ds.Divergence:
        return np.nan
    seed = np.zeros(frames.positions.shape)
    seed[-1, :, 1] = 1 / scene.mesh.num_vertices
    return float(rollout.vjp(frames, positions=seed)["initial_velocities"][..., 1].sum())


def main(chart_folder: str | None = None, starts: int = 20, finest: float = 1 / 32) -> dict:
    """Returns {kind: median errors, one for each of SHARES}; a run that fails counts as infinitely wrong."""
    scenes = [thrown_scene(k) for k in range(starts)]
    limits = [ds.stable_dt(scene.replace(terms=scene.terms[:1])).dt for scene in scenes]
    errors, failed = {}, {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of substeps that are too long for the force
        right = [gradient(s, finest * h, dict(contact_damping=0.0)) for s, h in zip(scenes, limits)]
        for kind, options in KINDS.items():
            found = np.array([[gradient(s, x * h, options) for s, h in zip(scenes, limits)] for x in SHARES])
            off = np.where(np.isnan(found), np.inf, np.abs(found / right - 1))
            errors[kind], failed[kind] = np.median(off, 1), np.isnan(found).sum(1)
    print(f"{'median error at, of the stable step':38}" + "".join(f"{x:10g}" for x in SHARES))
    for kind in KINDS:
        ended = f"   {failed[kind].sum()} of {len(SHARES) * starts} runs failed" if failed[kind].any() else ""
        print(f"{kind:38}" + "".join(f"{100 * x:9.3g}%" for x in errors[kind]) + ended)
    if chart_folder:
        save_chart(Path(chart_folder) / "bounce_gradients.png", errors)
    return errors


def save_chart(path: Path, errors: dict) -> None:
    """Median errors against the substep."""
    from matplotlib.figure import Figure

    figure = Figure((6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    for kind, values in errors.items():
        seen = np.isfinite(values)
        axes.loglog(np.array(SHARES)[seen], 100 * values[seen], "o-", label=kind)
    axes.set_xlabel("substep, of the stable step of the body")
    axes.set_ylabel("median error of the gradient [%]")
    axes.axhline(2, color="0.7", lw=1)
    axes.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    print(f"chart: {path}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None, int(sys.argv[2]) if len(sys.argv) > 2 else 20)
