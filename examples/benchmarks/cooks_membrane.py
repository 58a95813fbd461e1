"""Cook's membrane in plane strain: a tapered panel held on the left and sheared on the right.

Vertices are held in all three directions or in none, so that u_z = 0 is imposed by the forces that it takes: f_z on every
vertex with u_z(f) = 0, found by Newton's method. Its matrix, the compliance du_z / df_z, is symmetric, and its product with
a vector is a gradient of the equilibrium by the external forces; conjugate gradients solve for the step.

Two problems, in N, mm and MPa: small strains, whose corner rises 32.18 mm, and large strains, 13.577 mm at the corner and
14.499 mm in the middle of the edge. Linear tetrahedra approach both from below (locking), with an error of order h^2 or a
little less, for the corner on the left is singular. Aitken's formula gives their limit where the errors of four meshes
shrink by one factor; where they do not yet, none is printed.

    python examples/benchmarks/cooks_membrane.py [--quick] [folder for a picture]
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.linalg import LinearOperator, cg

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

THICKNESS = 12.0  # [mm]: a thin panel would buckle sideways before it is held
LINEAR = dict(material=ds.LinearElastic(70.0, 1 / 3), traction=6.25, exact=(32.18, None))
LARGE = dict(material=ds.StableNeoHookean(2 * 0.4225 * 1.3, 0.3), traction=1 / 16, exact=(13.577, 14.499))


def panel(cells: int) -> ds.TetrahedralMesh:
    """48 mm long, 44 mm high on the left, 16 mm on the right, one cell thick; sets as those of a box."""
    box = ds.TetrahedralMesh.create_box((cells + 1, cells + 1, 2), (1, 1, THICKNESS / 48), pattern="five")
    s, r, q = box.vertices.T
    vertices = np.stack([48 * s, 44 * s + r * (44 - 28 * s), 48 * q], 1)
    return ds.TetrahedralMesh(vertices, box.tetrahedra, vertex_sets=box.vertex_sets)


def edge_forces(mesh: ds.TetrahedralMesh, traction: float) -> np.ndarray:
    """Upward traction [MPa] on the right edge as forces on all vertices [N], shape (num_vertices, 3)."""
    forces, edge = np.zeros(mesh.vertices.shape), mesh.vertex_sets["xmax"]
    y = mesh.vertices[edge, 1]
    forces[edge, 1] = np.where((y > y.min()) & (y < y.max()), 2.0, 1.0)
    return forces * (traction * 16 * THICKNESS / forces.sum())


def stiffness_across(mesh: ds.TetrahedralMesh, material, free: np.ndarray) -> csr_matrix:
    """K_zz = sum V (mu grad N . grad N + (lam + mu) N,z N,z) of the free vertices, which preconditions the compliance: that
    is the inverse of K_zz but for the motion in the plane."""
    mu, lam = material.lame(material.values(mesh))
    N, V = mesh.shape_gradients, mesh.volumes[:, None, None]
    elements = V * (mu * N @ np.swapaxes(N, 1, 2) + (lam + mu) * N[:, :, None, 2] * N[:, None, :, 2])
    rows, columns = np.repeat(mesh.tetrahedra, 4, 1), np.tile(mesh.tetrahedra, (1, 4))
    K = coo_matrix((elements.ravel(), (rows.ravel(), columns.ravel())), (mesh.num_vertices,) * 2).tocsr()
    return K[free][:, free]


def membrane(cells: int, material, traction: float, exact: tuple) -> dict:
    """Rise of the upper right corner and of the middle of the edge [mm], the largest |u_z| left, and the effort."""
    mesh = panel(cells)
    load = edge_forces(mesh, traction)
    scene = ds.Scene(mesh, material, 1.0, [ds.ExternalForce(load)], "xmin", precision="f64")
    rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-10), 1, gradients=["external_forces"])
    free = np.setdiff1d(np.arange(mesh.num_vertices), scene.fixed)
    stiffness = stiffness_across(mesh, material, free)
    adjoint, forces, steps, products = np.zeros((2, mesh.num_vertices, 3)), load.copy(), 0, 0

    def compliance(f):
        nonlocal products
        products += 1
        adjoint[1, free, 2] = f
        return rollout.vjp(frames, adjoint)["external_forces"][free, 2]

    operator = LinearOperator((len(free),) * 2, compliance, dtype=np.float64)
    frames = rollout.forward()
    while np.abs(u_z := frames.displacements[-1][free, 2]).max() > 1e-6 and steps < 12:
        change, _ = cg(operator, -u_z, rtol=1e-3, maxiter=200, M=stiffness)
        forces[free, 2] += change
        frames = rollout.forward(external_forces=forces, initial_positions=frames.positions[-1])
        steps += 1
    if steps == 12:
        raise RuntimeError(f"the panel is not held in its plane: |u_z| is {np.abs(u_z).max():.2g} mm; make it thicker")

    u, edge = frames.displacements[-1], mesh.vertex_sets["xmax"]
    rise, y = (x[edge, 1].reshape(-1, 2).mean(1) for x in (u, mesh.vertices))  # front and back
    corner, middle = np.interp([60, 52], y, rise)
    return {
        "corner": corner,
        "middle": middle,
        "left": np.abs(u[:, 2]).max(),
        "steps": steps,
        "products": products,
        "mesh": mesh,
        "positions": frames.positions[-1],
    }


def limit(values: list[float]) -> float | None:
    """Aitken's limit of a sequence, None where it carries none: where fewer than three differences shrink, or not by a
    constant factor, to 10 %."""
    steps = np.diff(values)
    if len(steps) < 3 or not np.all(steps[1:] / steps[:-1] < 1):
        return None
    shrink = steps[1:] / steps[:-1]
    if abs(shrink[-1] / shrink[-2] - 1) > 0.1:
        return None
    return values[-1] + steps[-1] * shrink[-1] / (1 - shrink[-1])


def _said(value: float | None) -> str:
    return "not reached by a constant rate" if value is None else f"{value:.3f}"


def main(quick: bool = False, picture_folder: str | None = None) -> dict:
    """{"linear", "large": {"cells", "corner", "middle" (lists), "limit" (corner, middle; or None), "exact", "left"}}, mm."""
    out, start = {}, time.perf_counter()
    for name, problem in (("linear", LINEAR), ("large", LARGE)):
        cells = [3, 6, 12] if quick else [3, 6, 12, 24]
        rows = [membrane(n, **problem) for n in cells]
        corner, middle = ([row[key] for row in rows] for key in ("corner", "middle"))
        limits = limit(corner), limit(middle)
        out[name] = dict(
            cells=cells,
            corner=corner,
            middle=middle,
            limit=limits,
            exact=problem["exact"],
            left=max(row["left"] for row in rows),
        )
        print(
            f"{name}: corner rises "
            + ", ".join(f"{c:.3f} mm ({n} cells)" for n, c in zip(cells, corner))
            + f"; limit {_said(limits[0])}, exact {problem['exact'][0]}"
        )
        if problem["exact"][1]:
            print(f"  middle of the edge {middle[-1]:.3f} mm, limit {_said(limits[1])}, exact {problem['exact'][1]}")
        if picture_folder and name == "large":
            mesh, bent = rows[-1]["mesh"], rows[-1]["positions"]
            save_picture(
                Path(picture_folder) / "cooks_membrane.png",
                mesh,
                bent,
                (bent - mesh.vertices)[:, 1],
                "rise [mm]",
                title="Cook's membrane, large strains",
                fixed="xmin",
                wireframe=True,
                azimuth=12,
            )
        print(
            f"  |u_z| <= {out[name]['left']:.1g} mm after {rows[-1]['steps']} Newton steps, "
            f"{rows[-1]['products']} products"
        )
    out["seconds"] = time.perf_counter() - start
    print(f"{out['seconds']:.1f} s")
    return out


if __name__ == "__main__":
    ds.init(precision="f64")
    main("--quick" in sys.argv, *[folder for folder in sys.argv[1:] if folder != "--quick"])
