"""How many unknowns, and how much time, bending takes: linear tetrahedra, patches, ten-node tetrahedra.

A beam, 1 x 0.2 x 0.2 m, clamped at x = 0, at rest under its own weight: StableNeoHookean, E 1e6 Pa, nu 0.3, 1000 kg/m^3,
5 n x n x n cells of pattern "five". The number is the mean drop of its end; the reference, 0.34558 m, is extrapolated from
ten-node tetrahedra of another code. Time is that of a solve with all that it sets up, compiling apart, on one thread of
BLAS, the best of some.

    python examples/benchmarks/bending.py          # prints the table; about two minutes
    python examples/benchmarks/bending.py --quick  # small meshes, seconds
"""

import os
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np  # noqa: E402

import diffsim_ti as ds  # noqa: E402

REFERENCE = 0.34558  # [m]
KINDS = {"linear": (1, "tetrahedra"), "patches": (1, "patches"), "ten nodes": (2, "tetrahedra")}
CELLS = {"linear": (2, 4, 8, 13, 14), "patches": (2, 4, 8, 12), "ten nodes": (1, 2, 3, 4)}
QUICK = {"linear": (2, 4), "patches": (2, 4), "ten nodes": (1, 2)}


def beam(cells: int, kind: str) -> ds.Scene:
    order, volume = KINDS[kind]
    mesh = ds.TetrahedralMesh.create_box((5 * cells + 1, cells + 1, cells + 1), (1.0, 0.2, 0.2), "five")
    mesh = mesh.quadratic() if order == 2 else mesh
    material = ds.StableNeoHookean(1e6, 0.3)
    return ds.Scene(mesh, material, 1000.0, ds.Gravity(), fixed="xmin", precision="f64", volume=volume)


def drop_of(scene: ds.Scene) -> tuple[float, float]:
    """(mean drop of the end [m], time of the solve [s])"""
    begin = time.perf_counter()
    moved = ds.Rollout(ds.StaticSolver(scene), 1).forward().displacements[-1]
    seconds = time.perf_counter() - begin
    X = scene.mesh.vertices
    corners = (X[:, 0] == 1) & np.isin(X[:, 1], (0, 0.2)) & np.isin(X[:, 2], (0, 0.2))
    return -float(moved[corners, 1].mean()), seconds


def main(cells: dict[str, tuple[int, ...]] = CELLS, rounds: int = 3) -> dict:
    """Returns {(kind, cells): (unknowns, error, seconds)}, printed as a table."""
    found = {}
    print("| elements | cells | unknowns | error % | time [s] |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for kind, sizes in cells.items():
        drop_of(beam(1, kind))  # compiles
        for n in sizes:
            scene = beam(n, kind)
            runs = [drop_of(scene) for _ in range(rounds if n < 8 else min(rounds, 2))]
            error, seconds = abs(runs[0][0] / REFERENCE - 1), min(t for _, t in runs)
            found[kind, n] = 3 * scene.mesh.num_vertices, error, seconds
            print(f"| {kind} | {n} | {found[kind, n][0]} | {100 * error:.2f} | {seconds:.3g} |", flush=True)
    report(found)
    return found


def report(found: dict) -> None:
    """What one per cent takes."""
    best = {}
    for (kind, _), (unknowns, error, seconds) in found.items():
        if error < 0.0115 and seconds < best.get(kind, (0, np.inf))[1]:
            best[kind] = unknowns, seconds
    for kind, (unknowns, seconds) in best.items():
        least = min(s for _, s in best.values())
        print(f"one per cent, {kind}: {unknowns} unknowns, {seconds:.2g} s, {seconds / least:.3g} times the least")


if __name__ == "__main__":
    ds.init("cpu", precision="f64")
    main(QUICK if "--quick" in sys.argv else CELLS)
