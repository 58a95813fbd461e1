"""A stack of soft blocks that stands: each rests on the barrier of the one below.

python examples/contact/stack.py [folder for a picture]
"""

import sys
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

SIDE, GAP, COUNT = 0.1, 2e-3, 4  # [m]
DT, SECONDS = 1e-3, 1.2  # [s]


def main(count: int = COUNT, seconds: float = SECONDS, picture_folder: str | None = None) -> dict:
    """Returns height, drift sideways, smallest gap and the gaps between blocks [m], and speed [m/s], at the end."""
    block = ds.TetrahedralMesh.create_box(4, SIDE, pattern="five").translated([-SIDE / 2, GAP, -SIDE / 2])
    turned = [block.rotated([0, 1, 0], 0.15 * k).translated([0, k * (SIDE + GAP), 0]) for k in range(count)]
    mesh = ds.TetrahedralMesh.joined(turned)
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(1e5, 0.3),
        density=500.0,
        precision="f64",
        terms=[
            ds.Gravity(),
            ds.Drag(8.0),
            ds.Ground(0.0, stiffness=300.0, width=2 * GAP),
            ds.SelfContact(stiffness=100.0, width=2 * GAP),
        ],
    )
    simulator = ds.Simulator(ds.SemiImplicitSolver(scene, dt=DT, substeps=5))
    simulator.run(round(seconds / DT))
    simulator.check_surfaces()
    x, v = simulator.positions, simulator.velocities
    bodies = [mesh.vertex_sets[f"body_{k}"] for k in range(count)]
    between = [x[upper, 1].min() - x[lower, 1].max() for lower, upper in zip(bodies, bodies[1:])]
    drift = max(np.hypot(*(x[body] - mesh.vertices[body]).mean(0)[[0, 2]]) for body in bodies)
    speed, gap = float(np.abs(v).max()), simulator.smallest_gap()
    print(
        f"{count} blocks, {x[:, 1].max():.3f} m high after {seconds:g} s: speed {speed:.1e} m/s, "
        f"drift {1e3 * drift:.3f} mm, smallest gap {1e3 * gap:.2f} mm"
    )
    if picture_folder:
        body = np.repeat(np.arange(count), mesh.num_vertices // count)
        save_picture(
            Path(picture_folder) / "stack.png",
            mesh,
            x,
            body,
            ground=0.0,
            wireframe=True,
            azimuth=40,
            elevation=22,
            title=f"{count} soft blocks after {seconds:g} s",
        )
    return {"height": float(x[:, 1].max()), "speed": speed, "drift": float(drift), "gap": gap, "between": between}


if __name__ == "__main__":
    ds.init(precision="f64")
    main(picture_folder=sys.argv[1] if len(sys.argv) > 1 else None)
