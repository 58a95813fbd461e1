"""The stiffness of three parts of an arm from one picture of it at rest: where the vertices of its surface hang.

Density is known, for an equilibrium under weight alone tells E / rho and nothing more. The parameters are log E of each
part; the gradient is that of the equilibrium, one linear solve. The places are known to a tenth of a millimetre, and the
spread of the answer that follows from that is stated with it: sqrt(noise^2 (S^T S)^-1), S the sensitivities of the places
to log E.

    python examples/identify/stiffness_from_picture.py [folder for a picture]
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

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
    rollout = ds.Rollout(ds.StaticSolver(scene), 1, gradients=["youngs_modulus"])
    seen = np.setdiff1d(mesh.surface_vertices, scene.fixed)
    part = np.zeros(mesh.num_tetrahedra, int)
    for k, name in enumerate(PARTS):
        part[mesh.tetrahedron_sets[name]] = k

    truth = rollout.forward(youngs_modulus=np.array(list(PARTS.values()))[part]).positions[-1][seen]
    picture = truth + NOISE * np.random.default_rng(0).standard_normal(truth.shape)
    chart = OptimizationPicture(mesh, picture, truth={NAME: list(PARTS.values())}, loss_label="loss [mm²]")
    place, adjoint = mesh.vertices.copy(), np.zeros((2, mesh.num_vertices, 3))

    def loss_and_gradient(log_E):
        frames = rollout.forward(youngs_modulus=np.exp(log_E)[part], initial_positions=place)
        place[:] = frames.positions[-1]  # each equilibrium starts from the one before
        off = 1e3 * (place[seen] - picture)  # [mm]
        adjoint[1, seen] = 2e3 * off / off.size
        chart.add((off**2).mean(), {NAME: np.exp(log_E)}, place)
        by_E = rollout.vjp(frames, adjoint)["youngs_modulus"] * np.exp(log_E)[part]
        return chart.losses[-1], np.bincount(part, by_E)

    start = time.perf_counter()
    found = minimize(loss_and_gradient, np.log([GUESS] * 3), jac=True, method="L-BFGS-B", options=dict(ftol=1e-10))
    seconds = time.perf_counter() - start

    if picture_folder:
        chart.save(Path(picture_folder) / "stiffness_from_picture.png")
    E = np.exp(found.x)
    frames = rollout.forward(youngs_modulus=E[part], initial_positions=place)
    S = [rollout.jvp(frames, youngs_modulus=E[k] * (part == k))[0][-1][seen].ravel() for k in range(3)]
    spread = np.sqrt(np.diag(np.linalg.inv(np.array(S) @ np.transpose(S)))) * NOISE
    error = np.abs(E / list(PARTS.values()) - 1)
    for k, name in enumerate(PARTS):
        print(f"{name}: E = {E[k]:.4g} Pa, {100 * error[k]:.2g} % off (expected spread {100 * spread[k]:.2g} %)")
    print(
        f"from {GUESS:.3g} Pa in {found.nit} iterations ({found.nfev} gradients), {seconds:.1f} s; "
        f"residual {np.sqrt(found.fun):.3g} mm"
    )
    return {
        "E": dict(zip(PARTS, E)),
        "error": error.max(),
        "spread": spread.max(),
        "evaluations": found.nfev,
        "residual_mm": np.sqrt(found.fun),
        "seconds": seconds,
    }


if __name__ == "__main__":
    ds.init(precision="f64")
    main(False, *sys.argv[1:])
