"""Taylor's bar: a copper rod hits a smooth rigid wall at 227 m/s, and how short and how wide it has become after 80 us.

A quarter of the rod, in explicit steps of linear tetrahedra with patches, or of ten-node ones; the wall holds z of its end,
which stays in contact for that long. Radius and length in the end [mm]:

    7.17, 21.50  linear tetrahedra with patches, 6 x 36 cells
    7.02, 21.55  ten-node tetrahedra with the mean dilatation of each (--order 2)
    7.12         Simo 1992, doi:10.1016/0045-7825(92)90123-2
    7.11         Zienkiewicz, Rojek, Taylor, Pastor 1998, Triangles and tetrahedra in explicit dynamic codes for solids
    7.22         hexahedra, converged; Foulk and others 2021, doi:10.1002/nme.6686
    7.23, 21.43  their composite tetrahedra in Sierra/SM; 7.23, 21.42: fifteen-node tetrahedra of Carina
    6.9, 21.7    F-bar hexahedra in OpenSees, coarse

The third to the sixth row stand in the benchmarks of Carina (github.com/Cthonios/Carina.jl, benchmark/tet15-p1/taylor), the
last in the validation of a fork of OpenSees (LadrunoBrick).

    python examples/plasticity/taylor_bar.py [--quick]
"""

import argparse

import numpy as np
from quarter_bar import quarter_bar

import diffsim_ti as ds

RADIUS, LENGTH, SPEED, DENSITY = 3.2e-3, 32.4e-3, 227.0, 8930.0  # SI
COPPER = ds.J2Plasticity(E=117e9, nu=0.35, yield_stress=400e6, hardening=100e6)
DURATION, FRAMES = 80e-6, 16


def impact(across: int, along: int, order: int) -> tuple[float, float, float]:
    """(length [mm], radius [mm], largest equivalent plastic strain) in the end."""
    mesh = quarter_bar(RADIUS, LENGTH, across, along, finer=1.3, order=order)
    scene = ds.Scene(
        mesh,
        COPPER,
        DENSITY,
        fixed=dict(xmin="x", ymin="y", zmin="z"),
        initial_velocities=np.tile([0, 0, -SPEED], (mesh.num_vertices, 1)),
        volume="patches",
        precision="f64",
    )
    solver = ds.SemiImplicitSolver(scene, dt=DURATION / FRAMES)
    solver.choose_substeps(share=0.25)  # elements become flat, and their stable steps short
    simulator = ds.Simulator(solver)
    start = simulator.compute_energy()
    for _ in range(FRAMES):
        simulator.step()
        x, energy = simulator.positions, simulator.compute_energy()
        edge = x[mesh.vertex_indices("edge")]
        length, radius = 1e3 * x[:, 2].max(), 1e3 * np.hypot(edge[:, 0], edge[:, 1]).mean()
        parts = ", ".join(f"{name} {value / start:.3f}" for name, value in energy.parts.items())
        print(
            f"{1e6 * simulator.time:5.1f} us  length {length:.3f} mm  radius {radius:.3f} mm  energies: {parts}",
            flush=True,
        )
    return length, radius, float(simulator.output(ds.PlasticStrain()).max())


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--across", type=int, default=6)
    parser.add_argument("--along", type=int, default=36)
    parser.add_argument("--order", type=int, default=1)
    o = parser.parse_args()
    if o.quick:
        o.across, o.along = 3, 16
    length, radius, strain = impact(o.across, o.along, o.order)
    print(f"length {length:.3f} mm, radius {radius:.3f} mm, largest plastic strain {strain:.2f}")
