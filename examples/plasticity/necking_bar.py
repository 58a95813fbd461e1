"""Necking of a round bar in tension: how thin its middle becomes while its ends are drawn apart.

An eighth of the bar, of ten-node tetrahedra with the mean dilatation of each, in quasi-static steps. The bar is 1.8 %
thinner in its middle, so that it is there that it necks. Simo, Armero 1992, Geometrically non-linear enhanced strain mixed
methods and the method of incompatible modes, doi:10.1002/nme.1620330705; de Souza Neto, Peric, Owen, Computational Methods
for Plasticity, 2008, sec. 14.9, doi:10.1002/9780470694626.

After 7 mm the middle's radius is 2.22 mm with 2 cells across and 8 along (--quick), 2.07 mm with 3 and 12: what was lost of
it, 4.19 and 4.34 mm, still grows by 3.5 % with the mesh.

    python examples/plasticity/necking_bar.py [--quick]
"""

import argparse

import numpy as np
from quarter_bar import quarter_bar

import diffsim_ti as ds

RADIUS, HALF, TAPER = 6.413, 53.334 / 2, 0.018  # [mm]
DRAWN = 7.0  # at each end [mm]
BULK, SHEAR = 164.206e3, 80.1938e3  # [MPa]
STEEL = ds.J2Plasticity(
    mu=SHEAR,
    lam=BULK - 2 / 3 * SHEAR,
    yield_stress=450.0,
    hardening=129.24,
    saturation_stress=715.0,
    saturation_exponent=16.93,
)


def bar(across: int, along: int) -> ds.TetrahedralMesh:
    mesh = quarter_bar(RADIUS, HALF, across, along, finer=1.5)
    x = mesh.vertices.copy()
    x[:, :2] *= 1 - TAPER * (1 - x[:, 2:] / HALF)
    return ds.TetrahedralMesh(x, mesh.elements, vertex_sets={n: mesh.vertex_indices(n) for n in mesh.vertex_sets})


def draw(across: int, along: int, steps: int, drawn: float = DRAWN):
    """(elongation of each end [mm], radius in the middle [mm], force [N] of the whole bar) after each step."""
    mesh = bar(across, along)
    scene = ds.Scene(
        mesh,
        STEEL,
        fixed=dict(xmin="x", ymin="y", zmin="z", zmax="z"),
        motion=dict(zmax=lambda t: [0, 0, drawn * t / steps]),
        volume="patches",
        precision="f64",
    )
    simulator = ds.Simulator(ds.StaticSolver(scene, tolerance=1e-6))
    pull, rows = ds.Reaction("zmax"), []
    for k in range(steps):
        simulator.step()
        edge = simulator.positions[mesh.vertex_indices("edge")]
        radius = np.hypot(edge[:, 0], edge[:, 1]).mean()
        rows.append((drawn * (k + 1) / steps, radius, 4 * simulator.output(pull)[2]))
        print(
            f"{rows[-1][0]:6.3f} mm  radius {radius:.4f} mm ({radius / RADIUS:.4f})  {rows[-1][2] / 1e3:7.2f} kN",
            flush=True,
        )
    return np.array(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--across", type=int, default=4)
    parser.add_argument("--along", type=int, default=14)
    parser.add_argument("--steps", type=int, default=70)
    o = parser.parse_args()
    if o.quick:
        o.across, o.along, o.steps = 2, 8, 50
    draw(o.across, o.along, o.steps)
