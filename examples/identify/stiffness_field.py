"""A stiffness field from displacements: which tetrahedra of a beam are the stiff ones?

A beam with a stiff middle hangs from one end and swings; the places of all vertices are measured with noise in some frames.
E of every tetrahedron is unknown, so that neighbours must be told to agree: `Smooth(..., edges=True)` is the total
variation of log E, which leaves sharp edges sharp.

    python examples/identify/stiffness_field.py [folder for a picture, default output]
"""

import sys
import time
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

SOFT, STIFF, GUESS, NOISE = 5e4, 2e5, 1e5, 2e-5  # [Pa], [m]
JUMP = 0.01  # of log E between neighbours, beyond which a jump is an edge


def main(folder="output", cells=(8, 3, 3), method: str = "Levenberg-Marquardt", iterations: int = 50) -> dict:
    """Returns errors of log E (median, worst tenth), the share of tetrahedra that are told right, iterations, simulations,
    seconds."""
    mesh = ds.TetrahedralMesh.create_box([c + 1 for c in cells], [0.8, 0.3, 0.3])
    stiff = np.abs(mesh.centroids[:, 0] - 0.35) < 0.15
    truth = np.where(stiff, STIFF, SOFT)
    terms = [ds.Gravity((0.0, -9.8, 3.0)), ds.Drag(3.0)]
    scene = ds.Scene(mesh, ds.StableNeoHookean(GUESS, 0.3), terms=terms, fixed="xmin", precision="f64")
    solver = ds.SemiImplicitSolver(scene, dt=0.01, substeps=8)
    rollout = ds.Rollout(solver, 30, save_every=5, gradients=["youngs_modulus"])
    seen = rollout.forward(youngs_modulus=truth).positions
    seen = seen + NOISE * np.random.default_rng(0).standard_normal(seen.shape)

    start = time.perf_counter()
    found = ds.identify(
        rollout,
        {"positions": seen},
        {"youngs_modulus": ds.Unknown(GUESS, regions="each")},
        noise=NOISE,
        prior={"youngs_modulus": ds.Smooth(JUMP, edges=True)},
        max_iterations=iterations,
        method=method,
        progress=True,
    )
    seconds = time.perf_counter() - start
    E = found.estimates["youngs_modulus"]
    error = np.abs(np.log(E / truth))
    result = dict(
        median_error=float(np.median(error)),
        worst_tenth=float(np.quantile(error, 0.9)),
        classified=float(((E > np.sqrt(SOFT * STIFF)) == stiff).mean()),
        iterations=len(found.iterations),
        simulations=found.simulations,
        seconds=seconds,
    )
    said = ", ".join(f"{name} {x:.4g}" for name, x in result.items())
    print(f"stiffness of {mesh.num_tetrahedra} tetrahedra: {said}; {found.stopped}")
    if folder:
        title = "recovered from noisy displacements"
        Path(folder).mkdir(exist_ok=True)
        save_picture(Path(folder) / "stiffness_field.png", mesh, mesh.vertices, E, "Young's modulus [Pa]", title=title)
    return result


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
