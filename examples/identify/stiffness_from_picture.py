"""The stiffness of three parts of an arm from one picture of it at rest: where the vertices of its surface hang.

Density is known, for an equilibrium under weight alone tells E / rho and nothing more. `identify` finds the E of each
named part, and says how well: the places are known to a tenth of a millimetre.

    python examples/identify/stiffness_from_picture.py [folder for a picture]
"""

import sys
import time
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.optimization_picture import OptimizationPicture

PARTS = {"upper": 2e6, "elbow": 2.5e5, "lower": 8e5}  # true E [Pa]
GUESS, NU, DENSITY, NOISE = 6e5, 0.4, 1000.0, 1e-4
NAME = "Young's moduli [Pa]"


def arm(cells: int) -> ds.TetrahedralMesh:
    """0.9 m long, with the tetrahedron sets upper, elbow and lower."""
    mesh = ds.TetrahedralMesh.create_box((6 * cells + 1, cells + 1, cells + 1), (0.9, 0.15, 0.15), pattern="five")
    x = mesh.centroids[:, 0]
    for name, chosen in (("upper", x < 0.3), ("elbow", (x > 0.3) & (x < 0.6)), ("lower", x > 0.6)):
        mesh = mesh.with_tetrahedron_set(name, chosen)
    return mesh


def main(quick: bool = False, picture_folder: str | None = None) -> dict:
    """Returns {part: E found [Pa]}, the largest relative error and its expected spread, evaluations, seconds."""
    mesh = arm(2 if quick else 4)
    scene = ds.Scene(mesh, ds.StableNeoHookean(GUESS, NU), DENSITY, [ds.Gravity()], "xmin", precision="f64")
    rollout = ds.Rollout(ds.StaticSolver(scene), 1)
    seen = np.setdiff1d(mesh.surface_vertices, scene.fixed)
    stiffness = np.zeros(mesh.num_tetrahedra)
    for name, E in PARTS.items():
        stiffness[mesh.tetrahedron_sets[name]] = E

    truth = rollout.forward(youngs_modulus=stiffness).positions[-1][seen]
    picture = truth + NOISE * np.random.default_rng(0).standard_normal(truth.shape)
    chart = OptimizationPicture(mesh, picture, truth={NAME: list(PARTS.values())}, loss_label="chi²")

    start = time.perf_counter()
    found = ds.identify(
        rollout,
        ds.Measurement("positions", [np.full(picture.shape, np.nan), picture], NOISE, at=seen),
        {"youngs_modulus": ds.Unknown(GUESS, regions=list(PARTS))},
        check_mesh=False,  # data are of this very mesh
        callback=lambda row, frames: chart.add(row["chi_square"], {NAME: row["numbers"]}, frames[0].positions[-1]),
    )
    seconds = time.perf_counter() - start

    if picture_folder:
        chart.save(Path(picture_folder) / "stiffness_from_picture.png")
    E, spread = found.estimates["youngs_modulus"], found.information.deviations
    error = np.abs(E / list(PARTS.values()) - 1)
    residual = 1e3 * NOISE * np.sqrt((found.residuals**2).mean())
    print(f"E = {dict(zip(PARTS, E))} Pa, {seconds:.1f} s; residual {residual:.3g} mm\n{found}")
    return {
        "E": dict(zip(PARTS, E)),
        "error": error.max(),
        "spread": spread.max(),
        "evaluations": found.simulations,
        "residual_mm": residual,
        "seconds": seconds,
    }


if __name__ == "__main__":
    ds.init(precision="f64")
    main(False, *sys.argv[1:])
