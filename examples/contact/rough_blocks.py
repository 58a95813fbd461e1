"""Soft on soft with friction: a slab on a slope of tan = 1/2, and a tower of five blocks that leans.

Friction 0.51 holds the slab, 0.49 lets it slide, and with 0.3 it goes as far as Coulomb's law says. The tower leans by
tan = 0.06 on a rough floor; blocks with friction 0.4 stand, smooth ones slide apart.

    python examples/contact/rough_blocks.py [folder for a picture]
"""

import sys
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

G, CREEP = 9.81, 1e-3  # [m/s^2], [m/s] with which what is held may creep
SIDE, COUNT, LEAN = 0.1, 5, 0.06  # of a block [m], blocks of the tower, tan of the angle by which it leans


def down_a_slope(tangent: float) -> np.ndarray:
    """Gravity where the slope is down the x axis."""
    return G * np.array([tangent, -1.0, 0.0]) / np.hypot(1, tangent)


def slab_scene(friction: float, start=None, drag: float = 0.0) -> tuple[ds.Scene, np.ndarray]:
    """A soft slab on a long soft board whose underside is held; and the slab's vertices."""
    board = ds.TetrahedralMesh.create_box((8, 2, 3), size=(2.1, 0.1, 0.3), pattern="five")
    slab = ds.TetrahedralMesh.create_box((3, 2, 3), size=(0.2, 0.08, 0.2), pattern="five")
    mesh = ds.TetrahedralMesh.joined([board, slab.translated([0.13, 0.1016, 0.042])])
    contact = ds.SelfContact(4e4, 2e-3, friction=friction, friction_speed=CREEP)
    terms = [ds.Gravity(down_a_slope(0.5)), contact] + ([ds.Drag(drag)] if drag else [])
    material = ds.KelvinVoigt(ds.StableNeoHookean(1e6, 0.3), time=2e-3)
    held = np.flatnonzero(mesh.vertices[:, 1] == 0)
    scene = ds.Scene(mesh, material, 1000.0, terms, fixed=held, initial_positions=start, precision="f64")
    return scene, mesh.vertex_sets["body_1"]


def slides(duration: float = 2.5) -> dict[float, tuple[float, float, float]]:
    """{friction: (how far the slab goes [m], how far Coulomb's law says, in how many seconds)}"""
    scene, slab = slab_scene(0.5, drag=30.0)
    dt = 0.5 * float(ds.stable_dt(scene))
    settled = ds.Rollout(ds.SemiImplicitSolver(scene, dt=dt), round(1.0 / dt)).forward().positions[-1]
    out = {}
    for friction, seconds in ((0.51, duration), (0.49, duration), (0.3, min(duration, 1.2))):
        scene, _ = slab_scene(friction, settled)
        frames = ds.Rollout(ds.SemiImplicitSolver(scene, dt=dt), round(seconds / dt)).forward()
        way = float((frames.positions[-1] - frames.positions[0])[slab, 0].mean())
        law = 0.5 * G * max(0.5 - friction, 0.0) / np.hypot(1, 0.5) * frames.times[-1] ** 2
        out[friction] = way, law, float(frames.times[-1])
        print(f"friction {friction}: {way:.5f} m in {frames.times[-1]:.2f} s, Coulomb's law {law:.5f} m")
    return out


def tower(friction: float, seconds: float = 1.0) -> tuple[ds.TetrahedralMesh, np.ndarray, float]:
    """(mesh, positions at the end, how far the top block has gone against the one at the bottom [m])"""
    block, gap = ds.TetrahedralMesh.create_box((3, 3, 3), size=(SIDE,) * 3, pattern="five"), 5e-4
    mesh = ds.TetrahedralMesh.joined(
        block.translated([-SIDE / 2, gap + k * (SIDE + gap), -SIDE / 2]) for k in range(COUNT)
    )
    floor = ds.Ground(0.0, stiffness=2e4, width=2 * gap, friction=0.5)
    contact = ds.SelfContact(2e4, 2 * gap, friction=friction, friction_speed=CREEP)
    material = ds.KelvinVoigt(ds.StableNeoHookean(5e5, 0.3), time=3e-3)
    scene = ds.Scene(
        mesh, material, 500.0, [ds.Gravity(down_a_slope(LEAN)), floor, contact], fixed=None, precision="f64"
    )
    solver = ds.SemiImplicitSolver(scene, dt=0.5 * float(ds.stable_dt(scene)), contact_damping=1.0)
    frames = ds.Rollout(solver, round(seconds / solver.dt)).forward()
    moved = frames.positions[-1] - frames.positions[0]
    bottom, top = (mesh.vertex_sets[f"body_{k}"] for k in (0, COUNT - 1))
    apart = float(moved[top, 0].mean() - moved[bottom, 0].mean())
    print(f"tower, friction {friction}: the top has gone {1e3 * apart:.2f} mm against the bottom in {seconds:g} s")
    return mesh, frames.positions[-1], apart


def main(picture_folder: str | None = None, duration: float = 2.5) -> dict:
    """Returns the ways of the slab, and how far the towers' tops went [m] with friction 0.4 and 0."""
    out, towers = {"slides": slides(duration)}, [tower(0.4), tower(0.0, 0.3)]
    if picture_folder:
        mesh, places, angle = towers[0][0], [], np.arctan(LEAN)
        turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        for k, (_, positions, _) in enumerate(towers):
            places.append(positions @ turn.T + [0.4 * k, 0, 0])
        bare = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra)  # no two sets of one name
        both = ds.TetrahedralMesh.joined([bare, bare])
        body = np.tile(np.repeat(np.arange(COUNT), mesh.num_vertices // COUNT), 2)
        title = "five blocks that lean: friction .4 after 1 s, none after .3 s"
        save_picture(Path(picture_folder) / "rough_blocks.png", both, np.concatenate(places), body, title=title)
    return out | {"rough": towers[0][2], "smooth": towers[1][2]}


if __name__ == "__main__":
    ds.init(precision="f64")
    main(sys.argv[1] if len(sys.argv) > 1 else None)
