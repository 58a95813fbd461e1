"""A soft finger that is blown up to reach a point: two chambers side by side above a stiff sole.

Gas in a chamber stretches the soft part and the sole does not follow, so that the finger bends; unequal gas bends it
sideways too. How far it bends is no linear matter: the gas does work on its own volume. Newton's method finds the two
amounts of gas by which the tip gets where it is to be, with the derivatives of the equilibrium; steps that lead farther
away are halved.
Shepherd and others 2011, Multigait soft robot, doi:10.1073/pnas.1116564108.

    python examples/control/pneumatic_finger.py [folder for a picture, default output]
"""

import sys
import time
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.obstacles import ball
from diffsim_ti.picture import save_picture

CELL, SOFT, SOLE, OUTSIDE = 0.004, 5e4, 5e5, 101325.0  # [m], Young's moduli [Pa], [Pa]
WALLS, CHAMBERS = 5, (slice(1, 3), slice(4, 6))  # cells across, in z; in y the lower two are sole


def finger(cells: int) -> ds.TetrahedralMesh:
    """So many cells long; surface sets "left" and "right" are the chambers, tetrahedra of "sole" are stiff."""
    box = ds.TetrahedralMesh.create_box((cells + 1, WALLS + 1, 8), CELL * np.array([cells, WALLS, 7]), pattern="five")
    i, j, k = np.floor(box.centroids / CELL).astype(int).T
    inner = (i > 0) & (i < cells - 1) & (j > 1) & (j < WALLS - 1)
    hollow = [inner & (k >= part.start) & (k < part.stop) for part in CHAMBERS]
    kept = ~(hollow[0] | hollow[1])
    used, tetrahedra = np.unique(box.tetrahedra[kept], return_inverse=True)
    sole = np.flatnonzero(j[kept] < 2)
    mesh = ds.TetrahedralMesh(box.vertices[used], tetrahedra.reshape(-1, 4), tetrahedron_sets={"sole": sole})
    size = box.vertices.max(0)

    def of(part):
        middle = CELL * (part.start + part.stop) / 2

        def is_wall(x, n):
            inside = np.all((x > 0.1 * CELL) & (x < size - 0.1 * CELL), axis=1)
            return inside & (np.abs(x[:, 2] - middle) < 1.1 * CELL)

        return is_wall

    mesh = mesh.with_surface_set("left", of(CHAMBERS[0])).with_surface_set("right", of(CHAMBERS[1]))
    return mesh.with_vertex_set("root", mesh.vertices[:, 0] < 1e-9).with_vertex_set(
        "tip", mesh.vertices[:, 0] > size[0] - 1e-9
    )


class Finger:
    """Where the tip is, as a function of the gas in both chambers, given as absolute pressures [Pa] at rest."""

    def __init__(self, cells: int):
        self.mesh = mesh = finger(cells)
        law = ds.StableNeoHookean(E={"sole": SOLE, "default": SOFT}, nu=0.4)
        gas = [ds.GasChamber(OUTSIDE, side, OUTSIDE, name=side) for side in ("left", "right")]
        scene = ds.Scene(mesh, law, 1000.0, gas, "root", precision="f64")
        outputs = [ds.ChamberPressure(side, name=f"p_{side}") for side in ("left", "right")]
        self.rollout = ds.Rollout(
            ds.StaticSolver(scene, tolerance=1e-7, preconditioner="multigrid"), 1, outputs=outputs
        )
        self.tip = mesh.vertex_sets["tip"]
        self.rest = mesh.vertices[self.tip].mean(0)

    def __call__(self, gas: np.ndarray) -> tuple[ds.Frames, np.ndarray]:
        """(frames, the tip's displacement [m])"""
        frames = self.rollout.forward(**{"left.pressure": gas[0], "right.pressure": gas[1]})
        return frames, frames.positions[-1][self.tip].mean(0) - self.rest

    def derivatives(self, frames: ds.Frames, axes) -> np.ndarray:
        """Of the tip's displacement along axes by the gas, shape (len(axes), 2); a reverse sweep each."""
        rows = []
        for axis in axes:
            seed = np.zeros(frames.positions.shape)
            seed[-1, self.tip, axis] = 1 / len(self.tip)
            gradients = self.rollout.vjp(frames, seed)
            rows.append([gradients["left.pressure"], gradients["right.pressure"]])
        return np.array(rows)


def main(folder="output", quick: bool = False) -> dict:
    """Returns the gas [Pa], the pressures over that outside [Pa], distances [m] from the target by iterations, and more."""
    body, start = Finger(10 if quick else 16), time.perf_counter()
    target = np.array([-0.002, 0.0003] if quick else [-0.010, 0.0015])  # down and sideways [m]
    gas, history = np.full(2, 2 * OUTSIDE), []
    frames, moved = body(gas)
    for _ in range(15):
        off = moved[1:] - target
        history.append(float(np.linalg.norm(off)))
        if history[-1] < 1e-6:
            break
        step = -np.linalg.solve(body.derivatives(frames, (1, 2)), off)
        step *= min(1.0, OUTSIDE / np.abs(step).max())
        for _ in range(6):
            frames, moved = body(gas + step)
            if np.linalg.norm(moved[1:] - target) < history[-1]:
                break
            step *= 0.5
        gas = gas + step
    over = np.array([frames[f"p_{side}"][-1] for side in ("left", "right")])
    out = dict(gas=gas, over=over, history=history, moved=moved, seconds=time.perf_counter() - start)
    print(
        f"the tip goes {1e3 * -moved[1]:.2f} mm down and {1e3 * moved[2]:.2f} mm sideways with {over[0] / 1e3:.2f} and "
        f"{over[1] / 1e3:.2f} kPa, {1e6 * history[-1]:.2g} um from the target after {len(history) - 1} steps; "
        f"{body.mesh.num_tetrahedra} tetrahedra, {out['seconds']:.1f} s"
    )
    if folder:
        draw(body, frames, target, Path(folder) / "pneumatic_finger.png")
    return out


def draw(body: Finger, frames: ds.Frames, target: np.ndarray, path: Path) -> None:
    """The finger blown up, with a ball before where its tip is to be, and at rest behind it."""
    mesh, n = body.mesh, body.mesh.num_vertices
    both = ds.TetrahedralMesh.joined([mesh, mesh])
    places = np.concatenate([mesh.vertices - [0, 0, 0.05], frames.positions[-1]])
    stretch = np.linalg.norm(frames.displacements[-1], axis=1)
    place = body.rest + [frames.positions[-1][body.tip].mean(0)[0] - body.rest[0] + 1.5 * CELL, *target]
    save_picture(
        path,
        both,
        places,
        1e3 * np.concatenate([np.zeros(n), stretch]),
        "displacement [mm]",
        title="two amounts of gas bring the tip before the ball",
        obstacles=[ball(place, 0.8 * CELL)],
        azimuth=35,
        elevation=20,
    )


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
