"""Gradient through an impact: how many substeps an accuracy takes, equal ones and those that `adaptive_steps` finds.

Blocks of 0.1 m are thrown at a rough floor, and rounded ones bounce on a smooth, harder one, a fifth of the time in
contact. The gradient is that of the height of the centre of mass 0.16 s later by the upward velocity of the start. Its
error against substeps of 5 us is not monotone in the substep for any one start, so twenty starts and the median are taken.
Between impacts a centre of mass goes its way whatever the step is, so steps are sought by the error of bodies.
Where unequal steps have nothing to win: a bar that swings from one end, and a block that two pads hold, whose gradient is
that of the place of a corner, so that steps are sought by the error of vertices.

    python examples/benchmarks/impact_steps.py          # prints all tables; minutes
    python examples/benchmarks/impact_steps.py --quick  # three starts
"""

import sys
import time
import warnings

import numpy as np

import diffsim_ti as ds

STEPS, DURATION = 80, 0.16
EQUAL, TOLERANCES = (5, 7, 10, 14, 20, 28), (3e-3, 1e-3, 3e-4, 1e-4)
KINDS = ("block", "ball", "swing", "grasp")


def rounded(cells: int, size: float, share: float = 0.5) -> ds.TetrahedralMesh:
    """A cube whose vertices go the share of the way to a ball."""
    mesh = ds.TetrahedralMesh.create_box(cells, 2.0, origin=(-1, -1, -1))
    x = mesh.vertices
    ball = x * np.abs(x).max(1, keepdims=True) / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
    return ds.TetrahedralMesh((x + share * (ball - x)) * size / 2, mesh.tetrahedra)


def thrown(velocity, kind: str = "block") -> ds.Scene:
    rough = dict(friction=0.5) if kind == "block" else {}
    mesh = (
        ds.TetrahedralMesh.create_box(5, 0.1, origin=(0, 0.05, 0)) if rough else rounded(5, 0.1).translated([0, 0.1, 0])
    )
    floor = ds.Ground(stiffness_per_area=3e6, width=0.005, **rough) if rough else ds.Ground(width=0.002)
    terms = [ds.Gravity(), ds.Drag(0.5), floor]
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, initial_velocities=velocity, precision="f64")


def swinging(velocity) -> ds.Scene:
    """A bar, held at one end."""
    mesh = ds.TetrahedralMesh.create_box((7, 3, 3), (0.2, 0.05, 0.05))
    start = np.outer(mesh.vertices[:, 0] / 0.2, velocity)
    terms = [ds.Gravity(), ds.Drag(0.5)]
    return ds.Scene(
        mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, fixed="xmin", initial_velocities=start, precision="f64"
    )


def grasped(velocity) -> ds.Scene:
    """A block between two rough pads that close on it and lift it."""
    mesh = ds.TetrahedralMesh.create_box(5, 0.1, origin=(-0.05, -0.05, -0.05))
    rate = abs(velocity[1])

    def pad(side: int) -> ds.Box:
        def path(t):
            close = 0.012 * np.minimum(t / 0.08, 1.0)
            return [-side * close, 0.05 * rate * t, 0.0]

        return ds.Box(
            (side * 0.075, 0, 0), (0.04, 0.12, 0.12), stiffness_per_area=3e6, width=0.005, friction=0.8, path=path
        )

    terms = [ds.Gravity(), ds.Drag(0.5), pad(-1), pad(1)]
    start = [0.05 * velocity[0], 0.0, 0.0]
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, initial_velocities=start, precision="f64")


def scene_of(velocity, kind: str) -> ds.Scene:
    return {"swing": swinging, "grasp": grasped}.get(kind, lambda v: thrown(v, kind))(velocity)


def verlet(scene: ds.Scene, substeps: int = 1) -> ds.VelocityVerletSolver:
    return ds.VelocityVerletSolver(scene, dt=DURATION / STEPS, substeps=substeps, check_start=False)


def masses(mesh: ds.TetrahedralMesh) -> np.ndarray:
    """Share of each vertex in the mass of a body of one density: a quarter of its tetrahedra."""
    shares = np.bincount(mesh.tetrahedra.ravel(), np.repeat(mesh.volumes, 4), mesh.num_vertices)
    return shares / shares.sum()


def gradient(rollout: ds.Rollout, kind: str) -> tuple[float, float]:
    """(d height of the centre of mass, or of the last corner / d upward velocity [s], processor time of forward and reverse
    [s])"""
    begin = time.process_time()
    frames = rollout.forward()
    by_height = np.zeros_like(frames.positions)
    if kind in ("swing", "grasp"):
        by_height[-1, -1, 1] = 1.0
    else:
        by_height[-1, :, 1] = masses(rollout.scene.mesh)
    out = rollout.vjp(frames, by_height)["initial_velocities"][:, 1].sum()
    return float(out), time.process_time() - begin


def main(starts: int = 20, kinds: tuple = KINDS) -> dict:
    """{kind: {"equal" or "adaptive": rows of (median substeps, median error, median time [s])}}, printed as tables."""
    return {kind: table_of(kind, starts) for kind in kinds}


def table_of(kind: str, starts: int) -> dict:
    """The rows of one kind."""
    rng, found, of = np.random.default_rng(0), {}, "vertices" if kind in ("swing", "grasp") else "bodies"
    for _ in range(starts):
        scene = scene_of([rng.uniform(0.5, 1.5), rng.uniform(-1.5, -0.8), 0.0], kind)
        exact, _ = gradient(ds.Rollout(verlet(scene, 400), STEPS), kind)
        runs = {("equal", n): ds.Rollout(verlet(scene, n), STEPS) for n in EQUAL}
        for tolerance in TOLERANCES:
            begin = time.process_time()
            steps = ds.adaptive_steps(verlet(scene), STEPS, tolerance, of=of)
            found.setdefault("search", []).append(time.process_time() - begin)
            runs["adaptive", tolerance] = ds.Rollout(verlet(scene), steps)
        for key, rollout in runs.items():
            gradient(rollout, kind)  # makes room
            got, seconds = gradient(rollout, kind)
            found.setdefault(key, []).append((rollout.sweep.num_passes - 1, abs(got / exact - 1), seconds))
    table = {way: [np.median(found[key], 0) for key in found if key[0] == way] for way in ("equal", "adaptive")}
    print(f"| {kind}: steps | substeps | error of the gradient % | time [ms] |")
    print("| --- | ---: | ---: | ---: |")
    for way, rows in table.items():
        for substeps, error, seconds in rows:
            print(f"| {way} | {substeps:.0f} | {100 * error:.2g} | {1e3 * seconds:.3g} |")
    print(f"a search takes {1e3 * np.median(found['search']):.3g} ms")
    return table


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    ds.init("cpu", precision="f64")
    main(3 if "--quick" in sys.argv else 20)
