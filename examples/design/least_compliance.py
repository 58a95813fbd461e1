"""Where to put material: the stiffest bracket of a given weight.

A panel is held on the left and loaded downwards at the right. Each tetrahedron has a density x in [0, 1] and the stiffness
E_min + x^3 (E_0 - E_min), so that half material pays badly (SIMP); densities are averaged over a radius, so that the
answer does not depend on the mesh. The compliance f . u is least under a given mean of x by optimality criteria:
x <- x sqrt(-dc/dx / (multiplier volume)), within a move limit.
Bendsoe, Sigmund, Topology Optimization, doi:10.1007/978-3-662-05086-6; Andreassen and others, doi:10.1007/s00158-010-0594-7.

    python examples/design/least_compliance.py [folder for a picture, default output]
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

E0, E_MIN, PENALTY, SHARE, MOVE = 1e7, 1e4, 3, 0.4, 0.2  # [Pa], [Pa]; SHARE: of the panel's volume
SIZE, FORCE = (1.0, 0.5, 0.05), 10.0  # [m], [N]


def averaging(mesh: ds.TetrahedralMesh, radius: float) -> csr_matrix:
    """Row-stochastic matrix: mean over the tetrahedra nearer than `radius`, weighted by volume and closeness."""
    pairs = cKDTree(mesh.centroids).sparse_distance_matrix(cKDTree(mesh.centroids), radius, output_type="coo_matrix")
    weights = csr_matrix(((radius - pairs.data) * mesh.volumes[pairs.col], (pairs.row, pairs.col)), pairs.shape)
    return csr_matrix(weights.multiply(1 / weights.sum(1)))


def optimality_step(x: np.ndarray, by_x: np.ndarray, volumes: np.ndarray) -> np.ndarray:
    """Densities with sum volumes x unchanged; `by_x` < 0: derivatives of the compliance. The multiplier by bisection."""
    low, high = np.log(1e-20), np.log(1e20)
    gain = np.sqrt(np.maximum(-by_x, 0) / volumes)
    for _ in range(100):
        middle = 0.5 * (low + high)
        new = np.clip(x * gain * np.exp(-0.5 * middle), np.maximum(x - MOVE, 0), np.minimum(x + MOVE, 1))
        low, high = (middle, high) if volumes @ new > volumes @ x else (low, middle)
    return new


class Panel:
    """The compliance of a panel as a function of the stiffness of its tetrahedra."""

    def __init__(self, cells, tolerance: float = 1e-6):
        self.mesh = mesh = ds.TetrahedralMesh.create_box([n + 1 for n in cells], SIZE, pattern="five")
        loaded = mesh.vertices_where(lambda X: (X[:, 0] > SIZE[0] - 1e-9) & (np.abs(X[:, 1] - SIZE[1] / 2) < 0.06))
        self.load = np.zeros((2, mesh.num_vertices, 3))
        self.load[1, loaded, 1] = -FORCE / len(loaded)
        scene = ds.Scene(
            mesh, ds.LinearElastic(E0, 0.3), 1.0, [ds.ExternalForce(self.load[1])], "xmin", precision="f64"
        )
        self.rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=tolerance), 1, gradients=["youngs_modulus"])

    def compliance(self, E: np.ndarray) -> tuple[float, np.ndarray]:
        """(f . u [J], its derivatives by E)"""
        frames = self.rollout.forward(youngs_modulus=E)
        c = float((self.load[1] * frames.displacements[-1]).sum())
        return c, self.rollout.vjp(frames, self.load)["youngs_modulus"]


def main(folder="output", quick: bool = False) -> dict:
    """Returns compliances [J]: of x even, of an even panel of SHARE of the thickness, and best; their ratios; how clear the
    answer is (share of tetrahedra with x < 0.1 or > 0.9); the volume; history; seconds."""
    panel, iterations = Panel((16, 8, 1) if quick else (40, 20, 2)), 15 if quick else 50
    mesh, start = panel.mesh, time.perf_counter()
    average, volumes = averaging(mesh, 0.07 if quick else 0.04), mesh.volumes / mesh.volume
    thinner, _ = panel.compliance(np.full(mesh.num_tetrahedra, SHARE * E0))
    design, history = np.full(mesh.num_tetrahedra, SHARE), []
    for iteration in range(iterations + 1):
        x = average @ design
        c, by_E = panel.compliance(E_MIN + x**PENALTY * (E0 - E_MIN))
        history.append(c)
        if iteration < iterations:
            by_x = average.T @ (by_E * PENALTY * x ** (PENALTY - 1) * (E0 - E_MIN))
            design = optimality_step(design, by_x, average.T @ volumes)
    seconds = time.perf_counter() - start
    clear = float(volumes[(x < 0.1) | (x > 0.9)].sum())
    out = {
        "even": history[0],
        "thinner": thinner,
        "best": c,
        "by_even": history[0] / c,
        "by_thinner": thinner / c,
        "clear": clear,
        "volume": float(volumes @ x),
        "history": history,
        "seconds": seconds,
    }
    print(
        f"compliance {1e3 * c:.4g} mJ after {iterations} steps, {out['by_even']:.3g} times less than with x = {SHARE} "
        f"everywhere and {out['by_thinner']:.3g} times less than of an even panel of that share of the thickness; volume "
        f"{out['volume']:.3f}, {100 * clear:.0f} % all or nothing; "
        f"{mesh.num_tetrahedra} tetrahedra, {seconds:.1f} s"
    )
    if folder:
        Path(folder).mkdir(exist_ok=True)
        corners, kept = np.unique(mesh.tetrahedra[x > 0.5], return_inverse=True)
        kept = ds.TetrahedralMesh(mesh.vertices[corners], kept.reshape(-1, 4))
        save_picture(
            Path(folder) / "least_compliance.png",
            kept,
            kept.vertices,
            x[x > 0.5],
            "density",
            limits=(0.5, 1.0),
            title="the stiffest bracket, held on the left",
            azimuth=20,
            elevation=12,
            fixed=kept.vertices[:, 0] < 1e-9,
        )
    return out


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
