"""Which shape of a finger grips half as hard again, pulled by the same tendon?

The tendon is a cable along the lower side of a soft finger that presses it on a bar. Ten numbers move the finger: at five
stations of a cage, the share by which its back rises and the share by which it gets wider. It gets no wider, at most 1.75
times as deep, and no heavier; the lower side keeps its place, so that the gap is the same. The force of the equilibrium
becomes greatest by SciPy's SLSQP. Each equilibrium is sought from the last one; the gradient is one reverse sweep.

    python examples/design/finger_shape.py [folder for a picture, default output]
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import diffsim_ti as ds
from diffsim_ti.designs import Cage, rest_volume, smallest_ratio
from diffsim_ti.obstacles import obstacle_surfaces
from diffsim_ti.picture import save_picture

SIZE, SIDE = (0.1, 0.02, 0.016), 0.004  # [m]; SIDE: of the tendon above the finger's lower side
TENSION, E, GAP = 3.0, 2e5, 0.0015  # [N], [Pa], [m]
BAR, AT = 0.006, 0.075  # [m]: its radius, and how far along the finger it lies
STATIONS, DEEPER = 5, 0.75  # DEEPER: at most, as a share of the depth


class Finger:
    """The force of a finger on a bar, its volume and its shape as functions of ten numbers."""

    def __init__(self, resolution, order: int):
        mesh = ds.TetrahedralMesh.create_box(resolution, SIZE, pattern="five")
        self.mesh = mesh = mesh.quadratic() if order == 2 else mesh
        self.cage = Cage(mesh, (STATIONS, 2, 2))
        guides = np.linspace(0.05, 0.95, 10)[:, None] * [SIZE[0], 0, 0] + [0, SIDE, SIZE[2] / 2]
        tendon = ds.Cable([ds.Anchor([-0.01, *guides[0, 1:]]), *guides], tension=TENSION, name="tendon")
        ends = [np.array([AT, -GAP - BAR, z]) for z in (-0.5 * SIZE[2], 1.5 * SIZE[2])]
        bar = ds.Capsule(*ends, BAR, stiffness_per_area=3e7, width=0.001, name="bar")
        self.scene = scene = ds.Scene(mesh, ds.StableNeoHookean(E, 0.4), 1100.0, [tendon, bar], "xmin", precision="f64")
        self.rollout = ds.Rollout(
            ds.StaticSolver(scene, tolerance=1e-8),
            1,
            gradients=["rest_positions", "initial_positions"],  # both: what is held stays where it starts
            outputs=ds.ContactForce("bar", "normal"),
        )
        self.volume, self.simulations = rest_volume(mesh, mesh.vertices)[0], 0
        self.bent = np.zeros(mesh.vertices.shape)  # displacements of the last equilibrium [m]
        self.moves = np.zeros((2 * STATIONS, *self.cage.shape))
        for k in range(STATIONS):
            self.moves[k, k, 1, :, 1] = SIZE[1]  # the back rises
            self.moves[STATIONS + k, k, :, :, 2] = 0.5 * SIZE[2] * np.array([-1, 1])

    def shape(self, shares: np.ndarray) -> np.ndarray:
        """Rest positions [m] by the shares, (2 * STATIONS,): the back's rise, then wider."""
        return self.cage.value(np.tensordot(shares, self.moves, 1))

    def by_shares(self, by_positions: np.ndarray) -> np.ndarray:
        """The gradient by the shares from that by the rest positions."""
        return self.moves.reshape(2 * STATIONS, -1) @ self.cage.vjp(by_positions).ravel()

    def grip(self, shares: np.ndarray) -> tuple[float, np.ndarray, ds.Frames]:
        """(force on the bar [N], its gradient, frames)"""
        rest, seed = self.shape(shares), np.zeros((2, 3))
        frames = self.rollout.forward(rest_positions=rest, initial_positions=rest + self.bent)
        self.bent, seed[-1, 1] = frames.displacements[-1], 1.0
        self.simulations += 2
        gradients = self.rollout.vjp(frames, contact_force=seed)
        return float(frames["contact_force"][-1, 1]), self.by_shares(sum(gradients.values())), frames

    def room(self, shares: np.ndarray) -> tuple[float, np.ndarray]:
        """(share of the volume that is left, its gradient)"""
        volume, gradient = rest_volume(self.mesh, self.shape(shares))
        return 1 - volume / self.volume, -self.by_shares(gradient) / self.volume


def draw(path: Path, finger: Finger, before: ds.Frames, after: ds.Frames, ratio: float) -> None:
    """The finger above, the shape found below, each pulled on its bar."""
    up = np.array([0.0, 0.065, 0.0])
    bars = [(points + k * up, triangles) for k in (1, 0) for points, triangles in obstacle_surfaces(finger.scene)]
    places = [frames.positions[-1] + k * up for k, frames in zip((1, 0), (before, after))]
    moved = [1e3 * np.linalg.norm(frames.displacements[-1], axis=1) for frames in (before, after)]
    both = ds.TetrahedralMesh.joined([finger.mesh] * 2)
    save_picture(
        path,
        both,
        np.concatenate(places),
        np.concatenate(moved),
        "displacement [mm]",
        title=f"the same pull, {ratio:.2f} times the force on the bar",
        azimuth=25,
        elevation=12,
        obstacles=bars,
        fixed=both.vertex_sets["xmin"],
    )


def main(folder="output", quick: bool = False, orders=(1, 2)) -> dict:
    """For linear and for ten-node tetrahedra: forces [N] before and after, their ratio, the volume's change, how deep and
    wide it is by the finger, the smallest J of the map, simulations, seconds."""
    out = {}
    resolutions = {1: (10, 3, 3), 2: (6, 2, 2)} if quick else {1: (31, 5, 5), 2: (16, 3, 3)}
    for order in orders:
        resolution = resolutions[order]
        finger, begin = Finger(resolution, order), time.perf_counter()
        plain = np.zeros(2 * STATIONS)
        before, _, first = finger.grip(plain)

        def weakness(shares, finger=finger, before=before):
            force, gradient, _ = finger.grip(shares)
            return -force / before, -gradient / before

        found = minimize(
            weakness,
            plain,
            jac=True,
            method="SLSQP",
            bounds=[(-0.5, DEEPER)] * STATIONS + [(-0.5, 0.0)] * STATIONS,
            constraints={"type": "ineq", "fun": lambda x: finger.room(x)[0], "jac": lambda x: finger.room(x)[1]},
            options=dict(maxiter=6 if quick else 25, ftol=1e-3),
        )
        (after, _, last), rest = finger.grip(found.x), finger.shape(found.x)
        extent = np.ptp(rest, axis=0) / SIZE
        out[order] = r = {
            "before": before,
            "after": after,
            "ratio": after / before,
            "volume": ds.TetrahedralMesh(rest, finger.mesh.elements).volume / finger.mesh.volume - 1,
            "deeper": extent[1],
            "wider": extent[2],
            "smallest_J": smallest_ratio(finger.mesh, rest),
            "shares": found.x,
            "simulations": finger.simulations,
            "seconds": time.perf_counter() - begin,
        }
        print(
            f"{'linear' if order == 1 else 'ten-node'} tetrahedra: grips with {before:.4f} N before, {after:.4f} N after "
            f"({r['ratio']:.2f} times); volume {100 * r['volume']:+.2g} %, {r['deeper']:.3g} times as deep; "
            f"{r['simulations']} simulations, {r['seconds']:.1f} s"
        )
        if folder:
            name = "finger_shape.png" if order == 1 else "finger_shape_ten_nodes.png"
            draw(Path(folder) / name, finger, first, last, r["ratio"])
    return out


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
