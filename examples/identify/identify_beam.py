"""Find Young's modulus of a clamped beam from how it falls into sag: observed tip motion, noise of a tenth of a millimetre.

`identify` keeps E between bounds, takes exact tangents, and says how well the data tell E.
Density must be known: motion under gravity alone tells E / rho and nothing more.

    python examples/identify/identify_beam.py [folder for a picture, which is written while the optimisation runs]
"""

import sys
import time
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.optimization_picture import OptimizationPicture

TRUE_E, GUESS = 1.0e6, 3.0e5  # [Pa]
RANGE = 1.0e5, 2.5e6  # [Pa]; the step is stable up to there
NOISE = 1e-4  # [m]
NAME = "Young's modulus [Pa]"


def observed_motion(rollout: ds.Rollout, watched: np.ndarray) -> np.ndarray:
    """Positions of the watched vertices in all frames [m], as a camera would give them."""
    frames = rollout.forward(youngs_modulus=TRUE_E)
    seen = frames.positions[:, watched]
    return seen + NOISE * np.random.default_rng(0).standard_normal(seen.shape)


def main(picture_folder: str | None = None) -> dict:
    """Returns the modulus found [Pa], its relative error, evaluations of loss and gradient, and seconds."""
    mesh = ds.TetrahedralMesh.create_box((9, 3, 3), size=(1.0, 0.2, 0.2), pattern="five")
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(GUESS, 0.3),
        density=1000.0,
        terms=[ds.Gravity(), ds.Drag(0.5)],
        fixed="xmin",
        precision="f64",
    )
    rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-3), 300, save_every=10, gradients=["youngs_modulus"])
    tip = mesh.vertex_sets["xmax"]
    observed = observed_motion(rollout, tip)
    picture = OptimizationPicture(
        mesh,
        observed[-1],
        picture_folder and Path(picture_folder) / "identify_beam.png",
        1.0 if picture_folder else None,
        truth={NAME: TRUE_E},
        loss_label="chi²",
    )

    start = time.perf_counter()
    found = ds.identify(
        rollout,
        ds.Measurement("positions", observed, NOISE, at=tip),
        {"youngs_modulus": ds.Unknown(GUESS, range=RANGE)},
        check_mesh=False,  # data are of this very mesh
        callback=lambda row, frames: picture.add(row["chi_square"], {NAME: row["numbers"][0]}, frames[0].positions[-1]),
    )
    seconds = time.perf_counter() - start
    E, error = found.estimates["youngs_modulus"], abs(found.estimates["youngs_modulus"] / TRUE_E - 1)
    residual = 1e3 * NOISE * float(np.sqrt((found.residuals**2).mean()))
    print(
        f"E = {E:.6g} Pa, {100 * error:.2g} % off, from {GUESS:.3g} Pa, {seconds:.1f} s; residual {residual:.3g} mm\n{found}"
    )
    if picture_folder:
        picture.save()
    return {
        "youngs_modulus": E,
        "error": error,
        "evaluations": found.simulations,
        "residual_mm": residual,
        "seconds": seconds,
    }


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
