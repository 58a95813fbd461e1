"""Bend a soft finger to a target by the tension of its tendon: Newton's method through equilibria.

The tendon is a cable that slides through guides along one side of the finger, from its mount to its tip. One reverse sweep
gives the derivative of the tip's place by the tension, which Newton's method needs.

    python examples/control/tendon_finger.py [folder for a picture]
"""

import sys
import time
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

LENGTH, HEIGHT, WIDTH = 0.1, 0.02, 0.016  # [m]
SIDE = 0.005  # of the tendon above the finger's lower side [m]
TARGET = -0.05  # height of the tip, of a finger that is straight at 0 [m]
TOLERANCE = 1e-8  # [m]


def main(picture_folder: str | None = None, quick: bool = False) -> dict:
    """Returns the miss [m], the tension [N], how much of the tendon is pulled in [m], the tip [m], iterations, seconds."""
    cells = 10 if quick else 20
    mesh = ds.TetrahedralMesh.create_box(
        (cells + 1, 3, 3), (LENGTH, HEIGHT, WIDTH), origin=(0, -HEIGHT / 2, 0), pattern="five"
    )
    guides = np.linspace(0.05, 0.95, 10)[:, None] * [LENGTH, 0, 0] + [0, SIDE - HEIGHT / 2, WIDTH / 2]
    tendon = ds.Cable([ds.Anchor([-0.01, *guides[0, 1:]]), *guides], tension=1.0, name="tendon")
    tip = np.array([LENGTH, 0, WIDTH / 2])
    scene = ds.Scene(mesh, ds.StableNeoHookean(2e5, 0.4), 1100.0, [ds.Gravity(), tendon], "xmin", precision="f64")
    rollout = ds.Rollout(
        ds.StaticSolver(scene, load_steps=3, tolerance=1e-10), 1, outputs=ds.MaterialPoints(tip[None], name="tip")
    )

    start, tension, frames = time.perf_counter(), 1.0, {}
    for iteration in range(1, 16):
        frames[tension] = now = rollout.forward(**{"tendon.tension": tension})
        off = float(now["tip"][-1, 0, 1]) - TARGET
        print(f"iteration {iteration}: {tension:.4f} N, misses by {abs(off):.3g} m")
        if abs(off) < TOLERANCE:
            break
        seed = np.zeros(now["tip"].shape)
        seed[-1, 0, 1] = 1.0
        slope = float(rollout.vjp(now, tip=seed)["tendon.tension"])
        tension = tension - off / slope
    seconds, place = time.perf_counter() - start, now["tip"][-1, 0]

    through = ds.MaterialPoints(guides).settled(scene).value(now)[-1]
    pulled = (
        np.linalg.norm(np.diff(guides, axis=0), axis=1).sum() - np.linalg.norm(np.diff(through, axis=0), axis=1).sum()
    )
    if picture_folder:
        shown = [mesh.vertices, *(frames[key].positions[-1] for key in (1.0, tension))]
        shown = [x + [0, 0, 0.03 * k] for k, x in enumerate(shown)]  # side by side
        many = ds.TetrahedralMesh.joined([mesh] * len(shown))
        tensions = np.repeat([0.0, 1.0, tension], mesh.num_vertices)
        save_picture(
            Path(picture_folder) / "tendon_finger.png",
            many,
            np.concatenate(shown),
            tensions,
            "tension [N]",
            azimuth=-20,
            title="a tendon bends a finger to a target",
        )
    print(
        f"tip at {1e3 * place.round(6)} mm: off by {abs(off):.1e} m after {iteration} iterations, {seconds:.1f} s; tension "
        f"{tension:.4f} N, {1e3 * pulled:.2f} mm of the tendon between the guides pulled in"
    )
    return {
        "miss": abs(off),
        "tension": tension,
        "pulled": pulled,
        "tip": place,
        "iterations": iteration,
        "seconds": seconds,
    }


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
