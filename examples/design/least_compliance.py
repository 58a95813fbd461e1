"""Where to put material: the stiffest bracket of a given weight.

A panel is held on the left and loaded downwards at the right. Each tetrahedron has a design variable in [0, 1], which is
averaged over a radius, so that the answer does not depend on the mesh, and projected towards 0 and 1 by a smooth step,

    x = (tanh(b h) + tanh(b (y - h))) / (tanh(b h) + tanh(b (1 - h))),

whose place h keeps the mean of x as it is to be, whatever the design, and whose steepness b grows. The stiffness is
E_min + x^3 (E_0 - E_min), so that half material pays badly (SIMP). SciPy's L-BFGS-B makes the compliance f . u least.
Bendsoe, Sigmund, Topology Optimization, doi:10.1007/978-3-662-05086-6; Wang, Lazarov, Sigmund 2011, On projection methods,
doi:10.1007/s00158-010-0602-y.

    python examples/design/least_compliance.py [folder for a picture, default output]
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

E0, E_MIN, PENALTY, SHARE = 1e7, 1e4, 3, 0.4  # [Pa], [Pa]; SHARE: of the panel's volume
SIZE, FORCE = (1.0, 0.5, 0.05), 10.0  # [m], [N]


def averaging(mesh: ds.TetrahedralMesh, radius: float) -> csr_matrix:
    """Row-stochastic matrix: mean over the tetrahedra nearer than `radius`, weighted by volume and closeness."""
    pairs = cKDTree(mesh.centroids).sparse_distance_matrix(cKDTree(mesh.centroids), radius, output_type="coo_matrix")
    weights = csr_matrix(((radius - pairs.data) * mesh.volumes[pairs.col], (pairs.row, pairs.col)), pairs.shape)
    return csr_matrix(weights.multiply(1 / weights.sum(1)))


class Projection:
    """x of averaged designs y: a smooth step of a steepness at h, which keeps volumes . x, and its derivative."""

    def __init__(self, y: np.ndarray, steepness: float, volumes: np.ndarray, share: float):
        self.volumes = volumes
        step = lambda h: self._step(y, h, steepness)  # noqa: E731
        h = brentq(lambda h: volumes @ step(h)[0] - share, -0.5, 1.5)
        self.x, self.by_y, self.by_h = step(h)

    @staticmethod
    def _step(y, h, b) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(x, its derivatives by y, and by h)"""
        low, high, t = np.tanh(b * h), np.tanh(b * (1 - h)), np.tanh(b * (y - h))
        total, slope = low + high, b * (1 - t**2)
        by_low, by_high = b * (1 - low**2), -b * (1 - high**2)
        x = (low + t) / total
        return x, slope / total, (by_low - slope - x * (by_low + by_high)) / total

    def vjp(self, by_x: np.ndarray) -> np.ndarray:
        """Derivatives by y of what has those by x, the volume staying."""
        shift = (by_x @ self.by_h) / (self.volumes @ self.by_h)
        return self.by_y * (by_x - shift * self.volumes)


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
    panel, iterations = Panel((16, 8, 1) if quick else (40, 20, 2)), 6 if quick else 20
    mesh, start = panel.mesh, time.perf_counter()
    average, volumes = averaging(mesh, 0.07 if quick else 0.04), mesh.volumes / mesh.volume
    thinner, _ = panel.compliance(np.full(mesh.num_tetrahedra, SHARE * E0))
    design, history, x = np.full(mesh.num_tetrahedra, SHARE), [], None

    def cost(design: np.ndarray, steepness: float) -> tuple[float, np.ndarray]:
        """Compliance over that of an even panel of x = SHARE, and its derivatives."""
        nonlocal x
        projection = Projection(average @ design, steepness, volumes, SHARE)
        x = projection.x
        c, by_E = panel.compliance(E_MIN + x**PENALTY * (E0 - E_MIN))
        history.append(c)
        by_x = by_E * PENALTY * x ** (PENALTY - 1) * (E0 - E_MIN)
        return c / history[0], average.T @ projection.vjp(by_x) / history[0]

    for steepness in (1.0, 4.0, 8.0):
        options = dict(maxiter=iterations, maxls=5)
        found = minimize(cost, design, (steepness,), "L-BFGS-B", True, bounds=[(0, 1)] * len(design), options=options)
        design = found.x
    cost(design, steepness)
    c = history[-1]
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
        f"compliance {1e3 * c:.4g} mJ after {len(history)} solves, {out['by_even']:.3g} times less than with x = {SHARE} "
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
