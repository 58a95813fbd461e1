"""A soft slab on an incline of tan = 1/2: friction 0.50 holds it, 0.49 lets it slide as far as Coulomb's law says.

The slab first settles on the incline, in drag, at the friction that just holds it; then it is let go. A soft body on a stiff
barrier would not do: Coulomb friction makes such a body vibrate (as brakes squeal), and then it slides further.

    python examples/contact/incline.py [folder for a picture]
"""

import sys
import time
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.obstacles import square
from diffsim_ti.picture import save_picture

SLOPE, G, DURATION = 0.5, 9.81, 2.5  # [-], [m/s^2], [s]
DT, CREEP = 3e-4, 1e-4  # [s], [m/s] with which what is held may creep


def slab_scene(friction: float, positions=None, drag: float = 0.0) -> tuple[ds.Scene, np.ndarray]:
    """The slab, from `positions` [m] or from just above the incline, and the way down."""
    angle = np.arctan(SLOPE)
    n, down = np.array([-np.sin(angle), np.cos(angle), 0]), np.array([-np.cos(angle), -np.sin(angle), 0])
    mesh = ds.TetrahedralMesh.create_box((4, 3, 4), size=(0.4, 0.1, 0.4), origin=(-0.2, 0.008, -0.2))
    mesh = mesh.rotated([0, 0, 1], angle)
    incline = ds.HalfSpace(normal=n, stiffness=2e3, width=0.01, friction=friction, friction_speed=CREEP)
    terms = [ds.Gravity(-G), incline] + ([ds.Drag(drag)] if drag else [])
    scene = ds.Scene(mesh, ds.StableNeoHookean(2e6, 0.3), 1000.0, terms, initial_positions=positions, precision="f64")
    return scene, down


def solver(scene: ds.Scene) -> ds.SemiImplicitSolver:
    """With contacts that damp: what rests, presses evenly."""
    return ds.SemiImplicitSolver(scene, dt=DT, contact_damping=1.0)


def main(picture_folder: str | None = None) -> dict:
    """Returns how far the slab went [m] at friction 0.49 and 0.50, what Coulomb's law says, and the seconds."""
    start = time.perf_counter()
    scene, down = slab_scene(SLOPE, drag=30.0)
    settled = ds.Rollout(solver(scene), round(2.5 / DT)).forward().positions[-1]
    exact = 0.5 * G * (SLOPE - 0.49) / np.sqrt(1 + SLOPE**2) * DURATION**2
    moved, ends = {}, []
    for friction in (0.49, 0.50):
        scene, _ = slab_scene(friction, settled)
        frames = ds.Rollout(solver(scene), round(DURATION / DT)).forward()
        moved[friction] = float((frames.positions[-1] - frames.positions[0]).mean(0) @ down)
        ends.append(frames.positions[-1] - frames.positions[0])
        print(f"friction {friction:.2f}: {moved[friction]:.5f} m in {DURATION} s; {frames.contact_resolution}")
    if picture_folder:
        apart = np.array([0, 0, 0.25])
        places = np.concatenate([settled + ends[0] + apart, settled + ends[1] - apart])
        slid = np.linalg.norm(np.concatenate(ends), axis=1)
        slope = square(settled.mean(0) - [0.12, 0.118, 0], (-SLOPE, 1, 0), 0.24)
        save_picture(
            Path(picture_folder) / "incline.png",
            ds.TetrahedralMesh.joined([scene.mesh] * 2),
            places,
            slid,
            "slid by [m]",
            obstacles=[slope],
            wireframe=True,
            azimuth=-12,
            elevation=22,
            title="friction 0.49 slides, 0.50 holds, on tan = 1/2",
        )
    seconds = time.perf_counter() - start
    off = moved[0.49] / exact - 1
    print(f"Coulomb's law: {exact:.5f} m ({off:+.2%}) and 0 ({moved[0.50]:.1e} m of creep); {seconds:.1f} s")
    return {"slides": moved[0.49], "holds": moved[0.50], "exact": exact, "seconds": seconds}


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
