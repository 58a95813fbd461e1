"""Throw a soft ball off a wall so that it ends at a target: Newton's method on the ball's velocity, through the bounce.

The wall is rough and the ball soft, so that it leaves with other speed and spin than it came with. Three reverse sweeps, one
for each coordinate of the ball's centre, give the Jacobian that Newton's method needs.

    python examples/control/wall_shot.py [folder for a picture]
"""

import sys
import time
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.obstacles import box
from diffsim_ti.picture import save_picture

DURATION, DT = 0.6, 2e-4  # [s]
WALL, TARGET = 1.0, (0.1, 0.5, 0.3)  # [m]; the ball starts at the origin
TOLERANCE = 1e-6  # [m]


def ball(radius: float, count: int = 4) -> ds.TetrahedralMesh:
    """A cube of `count` vertices a side, drawn out to a ball."""
    cube = ds.TetrahedralMesh.create_box(count, size=2.0, origin=(-1, -1, -1), pattern="five")
    x = cube.vertices
    a, b = np.roll(x, 1, 1) ** 2, np.roll(x, 2, 1) ** 2
    y = x * np.sqrt(1 - a / 2 - b / 2 + a * b / 3)
    return ds.TetrahedralMesh(radius * y, cube.tetrahedra)


def main(picture_folder: str | None = None) -> dict:
    """Returns the miss [m], the velocity [m/s], what its bounce does to it, iterations and seconds."""
    mesh = ball(0.1)
    wall = ds.HalfSpace((WALL, 0, 0), (-1, 0, 0), stiffness=300.0, width=0.06, friction=0.4, friction_speed=0.05)
    scene = ds.Scene(mesh, ds.StableNeoHookean(5e4, 0.3), 300.0, [ds.Gravity(), ds.Drag(0.2), wall], precision="f64")
    rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=DT), round(DURATION / DT), gradients=["initial_velocities"])
    mass = scene.inputs.derive(scene.inputs.values).mass
    share = mass / mass.sum()

    def jacobian(frames):
        """Derivative of the centre by the throw's velocity, 3 x 3."""
        rows = []
        for d in range(3):
            weights = np.zeros_like(frames.positions)
            weights[-1, :, d] = share
            rows.append(rollout.vjp(frames, weights)["initial_velocities"].sum(0))
        return np.array(rows)

    start, v = time.perf_counter(), np.array([3.5, 3.0, 0.0])
    for iteration in range(1, 16):
        frames = rollout.forward(initial_velocities=np.tile(v, (mesh.num_vertices, 1)))
        off = share @ frames.positions[-1] - TARGET
        miss = float(np.linalg.norm(off))
        print(f"iteration {iteration}: misses by {miss:.3g} m")
        if miss < TOLERANCE:
            break
        v = v - np.linalg.solve(jacobian(frames), off)
    seconds = time.perf_counter() - start

    back = float(share @ frames.velocities[-1, :, 0])
    seen = frames.contact_resolution
    if picture_folder:
        way = (
            ds.Rollout(ds.VelocityVerletSolver(scene, dt=DT), round(DURATION / DT), save_every=300)
            .forward(initial_velocities=np.tile(v, (mesh.num_vertices, 1)))
            .positions
        )
        many = ds.TetrahedralMesh.joined([mesh] * len(way))
        slab = box((WALL + 0.01, 0.5, 0.15), (0.02, 1.2, 0.8), (1, 0, 0, 0))
        times = np.repeat(np.arange(len(way)) * DURATION / (len(way) - 1), mesh.num_vertices)
        save_picture(
            Path(picture_folder) / "wall_shot.png",
            many,
            way.reshape(-1, 3),
            times,
            "time [s]",
            obstacles=[slab],
            azimuth=-30,
            title="thrown off a rough wall at a target",
        )
    print(
        f"throw with {v.round(4)} m/s: off by {miss:.1e} m after {iteration} iterations, {seconds:.1f} s; it comes back "
        f"at {back:.3g} m/s; {seen}"
    )
    return {
        "miss": miss,
        "velocity": v,
        "back": back,
        "resolved": seen.resolved,
        "gap": seen.smallest_gap,
        "iterations": iteration,
        "seconds": seconds,
    }


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
