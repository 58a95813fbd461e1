"""Mass scaling: how much longer and cheaper steps are, and what it does to the motion beside the errors of mesh and step.

A body of 0.1 m strikes the floor at 1 m/s; its motion of 50 ms is compared at ten times, by the largest distance of any
vertex over the largest displacement. Beside the error of mass scaling stand that of the plain run's step (against half of
it) and that of its mesh (each tetrahedron cut into eight; both runs scaled, so that the fine one can be afforded).

    python examples/benchmarks/mass_scaling.py                             # a box with slivers that is made here; seconds
    python examples/benchmarks/mass_scaling.py bunny.msh --share 0.01      # any mesh of tetrahedra
    python examples/benchmarks/mass_scaling.py bunny.msh --chart out.png   # and its points of time against error
"""

import argparse
import time
import warnings

import numpy as np

import diffsim_ti as ds
from diffsim_ti.study.charts import draw_chart
from diffsim_ti.study.problem import Problem
from diffsim_ti.study.work_precision import Chart, Point

DURATION, FRAMES, SAFETY = 0.05, 10, 0.7  # s, and the share of the stable step


def with_slivers(resolution: int = 16, close: float = 0.98, seed: int = 0) -> ds.TetrahedralMesh:
    """A box one inner vertex of which lies nearly in the opposite face of one of its tetrahedra."""
    mesh, rng = ds.TetrahedralMesh.create_box(resolution, 1.0), np.random.default_rng(seed)
    x = mesh.vertices.copy()
    vertex = rng.choice(np.setdiff1d(np.arange(mesh.num_vertices), mesh.surface_triangles))
    own = mesh.tetrahedra[(mesh.tetrahedra == vertex).any(1)][0]
    x[vertex] += close * (x[own[own != vertex]].mean(0) - x[vertex])
    return ds.TetrahedralMesh(x, mesh.tetrahedra)


def dropped(mesh: ds.TetrahedralMesh, share: float | None) -> ds.Scene:
    terms = [ds.Gravity(), ds.Ground(stiffness_per_area=1e6, width=0.005)]
    start = dict(initial_velocities=[0.0, -1.0, 0.0], precision="f64", mass_scaling=share)
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, **start)


def moved(scene: ds.Scene, finer: int = 1) -> tuple[np.ndarray, int, float]:
    """(displacements at the frames [m], substeps, processor time [s] of the second run)"""
    substeps = finer * int(np.ceil(DURATION / FRAMES / (SAFETY * ds.stable_dt(scene, tight=True).dt)))
    solver = ds.VelocityVerletSolver(scene, dt=DURATION / FRAMES, substeps=substeps, check_start=False)
    rollout = ds.Rollout(solver, FRAMES, save_every=1)
    ds.Rollout(solver, 1).forward()  # compiles
    begin = time.process_time()
    frames = rollout.forward()
    return frames.displacements, FRAMES * substeps, time.process_time() - begin


def apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one - other, axis=-1).max() / np.linalg.norm(other, axis=-1).max())


def main(mesh: ds.TetrahedralMesh, share: float, name: str, chart: str | None = None) -> dict:
    """Returns the row of the table that it prints."""
    low, high = mesh.bounding_box
    size = 0.1 / (high - low).max()
    mesh = mesh.scaled(size).translated([0, 0.005 - size * low[1], 0])
    plain, half, scaled = moved(dropped(mesh, None)), moved(dropped(mesh, None), 2), moved(dropped(mesh, share))
    fine = moved(dropped(mesh.refined(), share))[0][:, : mesh.num_vertices]
    row = dict(
        tetrahedra=mesh.num_tetrahedra,
        longer=plain[1] / scaled[1],
        cheaper=plain[2] / scaled[2],
        of_scaling=apart(scaled[0], plain[0]),
        of_step=apart(plain[0], half[0]),
        of_mesh=apart(scaled[0], fine),
    )
    print(
        "| mesh | tetrahedra | mass added at most % | steps longer | cheaper | error of motion % | of step % | of mesh % |"
    )
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    errors = " | ".join(f"{100 * row[key]:.2g}" for key in ("of_scaling", "of_step", "of_mesh"))
    times = f"{row['longer']:.3g} | {row['cheaper']:.3g}"
    print(f"| {name} | {mesh.num_tetrahedra} | {100 * share:.3g} | {times} | {errors} |", flush=True)
    if chart:
        runs = {"plain": plain, f"mass_scaling={share:g}": scaled}
        points = []
        for label, (x, n, seconds) in runs.items():
            what = ("VelocityVerletSolver", 0, label, "linear", "f64", mesh.num_tetrahedra)
            points.append(Point(*what, DURATION / n, n, seconds / DURATION, apart(x, half[0])))
        problem = Problem.of_scene(dropped(mesh, None), DURATION, name, FRAMES)
        draw_chart(Chart(problem, points, row["of_step"] / 3), chart)
    return row


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("mesh", nargs="?", help="a file of tetrahedra; without it a box with slivers")
    parser.add_argument("--share", type=float, default=0.01, help="of the mass, that may be added at most")
    parser.add_argument("--chart", metavar="FILE", help="picture of time against error")
    given = parser.parse_args()
    ds.init("cpu", precision="f64", threads=1)  # so that processor time is that of the work
    body = ds.TetrahedralMesh.load_from_msh(given.mesh) if given.mesh else with_slivers()
    main(body, given.share, given.mesh or "a box with slivers", given.chart)
