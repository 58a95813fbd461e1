"""How far gradients through a bounce can be trusted, by the substep: a barrier as a force, and as a stage of its own.

Soft balls and blocks, turned at random, are thrown onto a floor; asked is how their mean height after the bounce changes
with the speed that they were thrown with. The error is that against a run with much finer substeps of the same kind, and
the median is over all starts. A force needs substeps that follow the barrier; a stage takes those that the body allows.

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


def soft_block(cells: int = 4, size: float = 0.16) -> ds.TetrahedralMesh:
    """A cube, whose corners and edges meet the floor first."""
    return ds.TetrahedralMesh.create_box(cells + 1, size=size, origin=(-size / 2,) * 3)


BODIES = {"balls": soft_ball, "blocks": soft_block}
WIDTHS = (0.01, 2e-3)  # of the barrier [m]; the first is the default


def thrown_scene(start: int, body: str = "balls", width: float = 2e-3, stiffer: float = 1.0) -> ds.Scene:
    """The start-th throw; stiffer: times the stiffness that the scene chooses."""
    rng = np.random.default_rng(start)
    mesh = BODIES[body]().rotated(rng.standard_normal(3), rng.uniform(0, np.pi))
    mesh = mesh.translated([0, width + rng.uniform(0.002, 0.018) - mesh.bounding_box[0, 1], 0])
    speed, law = rng.uniform(0.2, 0.6), ds.StableNeoHookean(1e5, 0.4)
    start_of = dict(initial_velocities=(0, -speed, 0), precision="f64")
    scene = ds.Scene(mesh, law, terms=[ds.Gravity(), ds.Ground(width=width)], **start_of)
    if stiffer == 1:
        return scene
    chosen = float(scene.terms[1].values["barrier_stiffness_per_area"])
    floor = ds.Ground(width=width, stiffness_per_area=stiffer * chosen)
    return scene.replace(terms=[scene.terms[0], floor])


def limits(scenes: list[ds.Scene]) -> list[float]:
    """The stable steps [s] of the bodies."""
    return [ds.stable_dt(scene.replace(terms=scene.terms[:1])).dt for scene in scenes]


def thrown(scene: ds.Scene, substep: float, options: dict) -> tuple[ds.Rollout, object]:
    """(rollout, its frames); None for frames where the run fails."""
    steps = int(np.ceil(DURATION / substep))
    solver = ds.VelocityVerletSolver(scene, dt=DURATION / steps, **options)
    rollout = ds.Rollout(solver, steps, save_every=steps, gradients="initial_velocities")
    try:
        return rollout, rollout.forward()
    except ds.Divergence:
        return rollout, None


def gradient(scene: ds.Scene, substep: float, options: dict) -> tuple[float, bool]:
    """d (mean height at the end) / d (speed upwards at the start) [s], and whether the rollout would warn of it.

    Not a number where the run fails.
    """
    rollout, frames = thrown(scene, substep, options)
    if frames is None:
        return np.nan, True
    seed = np.zeros(frames.positions.shape)
    seed[-1, :, 1] = 1 / scene.mesh.num_vertices
    found = rollout.vjp(frames, positions=seed)["initial_velocities"][..., 1].sum()
    return float(found), not frames.contact_resolution.resolved


def errors_of(body: str, width: float, starts: int, finest: float, shares: tuple) -> dict:
    """{kind: (median errors, runs that failed, that warned), one for each of the shares}"""
    scenes, found = [thrown_scene(k, body, width) for k in range(starts)], {}
    steps = limits(scenes)
    right = np.array([gradient(s, finest * h, dict(contact_damping=0.0))[0] for s, h in zip(scenes, steps)])
    for kind, options in KINDS.items():
        runs = np.array([[gradient(s, x * h, options) for s, h in zip(scenes, steps)] for x in shares])
        values, warned = runs[..., 0], runs[..., 1] > 0
        failed = np.isnan(values)
        off = np.where(failed, np.inf, np.abs(values / right - 1))
        found[kind] = np.median(off, 1), failed.sum(1), (warned & ~failed).sum(1)
    return found


def main(
    chart_folder: str | None = None,
    starts: int = 20,
    finest: float = 1 / 32,
    cases: tuple | None = None,
    shares: tuple = SHARES,
) -> dict:
    """Returns {(body, width): {kind: median errors, by shares}}; a run that fails counts as infinitely wrong."""
    results = {}
    print(
        f"| median error of {starts} throws, substep over the body's limit | "
        + " | ".join(f"{x:g}" for x in shares)
        + " |"
    )
    print("| --- |" + " ---: |" * len(shares))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of substeps that are too long; they are counted
        for body, width in cases or [(body, width) for body in BODIES for width in WIDTHS]:
            found = errors_of(body, width, starts, finest, shares)
            results[body, width] = {kind: medians for kind, (medians, _, _) in found.items()}
            for kind, (medians, failed, warned) in found.items():
                cells = [f"{100 * x:.2g} %" if np.isfinite(x) else "-" for x in medians]
                cells = [
                    c + f" ({f} failed)" * bool(f) + f" ({w} warned)" * bool(w)
                    for c, f, w in zip(cells, failed, warned)
                ]
                print(f"| {body}, {1e3 * width:g} mm: {kind} | " + " | ".join(cells) + " |", flush=True)
    if chart_folder:
        save_chart(Path(chart_folder) / "bounce_gradients.png", results, shares)
    return results


def save_chart(path: Path, results: dict, shares: tuple) -> None:
    """Median errors against the substep, a panel for each body and width."""
    from matplotlib.figure import Figure

    figure = Figure((3.2 * len(results), 3.6), layout="constrained")
    panels = figure.subplots(1, len(results), sharey=True, squeeze=False)[0]
    for axes, ((body, width), errors) in zip(panels, results.items()):
        for kind, values in errors.items():
            seen = np.isfinite(values)
            axes.loglog(np.array(shares)[seen], 100 * values[seen], "o-", label=kind, lw=1.2, ms=4)
        axes.axhline(2, color="0.7", lw=1)
        axes.set_title(f"{body}, a barrier of {1e3 * width:g} mm", loc="left", fontsize=10)
        axes.set_xlabel("substep over the body's limit")
        axes.set_xticks(shares, [f"{x:g}" for x in shares])
        axes.minorticks_off()
    panels[0].set_ylabel("median error of the gradient [%]")
    panels[-1].legend(frameon=False, fontsize=8, loc="lower right")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    print(f"chart: {path}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None, int(sys.argv[2]) if len(sys.argv) > 2 else 20)
