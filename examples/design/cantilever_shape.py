"""Which shape of a beam carries twice the load and drops no further, with no more mass?

A beam is held on the left and loaded at its end by a dead force. Twelve numbers move it: at six stations of a cage, the
share by which it gets deeper and the share by which it gets wider. They are bounded, so that the beam is nowhere wider
than it was and at most 1.35 times as deep: a cage's surface lies within its control points. Under twice the load the drop
of the end becomes least while the volume stays, by SciPy's SLSQP with two gradients: that of the drop is one reverse sweep
of the equilibrium, by the rest positions and then through the cage, that of the volume of straight tetrahedra is exact.

    python examples/design/cantilever_shape.py [folder for a picture, default output]
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import diffsim_ti as ds
from diffsim_ti.designs import Cage, rest_volume, smallest_ratio
from diffsim_ti.picture import save_picture

SIZE, FORCE, E = (1.0, 0.15, 0.15), 12.0, 2e6  # [m], [N], [Pa]
STATIONS, DEEPER = 6, 0.35  # DEEPER: at most, as a share of the depth


class Beam:
    """The drop of a beam's end, its volume and its shape as functions of twelve numbers."""

    def __init__(self, resolution, order: int):
        mesh = ds.TetrahedralMesh.create_box(resolution, SIZE, pattern="five")
        self.mesh = mesh = mesh.quadratic() if order == 2 else mesh
        self.cage, end = Cage(mesh, (STATIONS, 2, 2)), mesh.vertex_sets["xmax"]
        load = np.tile([0.0, -FORCE / len(end), 0.0], (len(end), 1))
        scene = ds.Scene(
            mesh, ds.StableNeoHookean(E, 0.3), 1000.0, [ds.ExternalForce(load, vertices=end)], "xmin", precision="f64"
        )
        wanted = ["rest_positions", "initial_positions"]  # both: what is held stays where it starts
        self.rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-9), 1, gradients=wanted)
        self.load, self.volume = load, rest_volume(mesh, mesh.vertices)[0]
        self.seed = np.zeros((2, mesh.num_vertices, 3))
        self.seed[1, end, 1] = -1 / len(end)
        side = np.array([-0.5, 0.5])  # of the lattice's control points, from the axis of the beam
        self.spread = np.zeros((2, STATIONS, *self.cage.shape))
        for k in range(STATIONS):
            self.spread[0, k, k, :, :, 1] = SIZE[1] * side[:, None]
            self.spread[1, k, k, :, :, 2] = SIZE[2] * side[None, :]
        self.simulations = 0

    def shape(self, shares: np.ndarray) -> np.ndarray:
        """Rest positions [m] by the shares, (2 * STATIONS,): deeper, then wider."""
        return self.cage.value(np.tensordot(shares, self.spread.reshape(2 * STATIONS, *self.cage.shape), 1))

    def by_shares(self, by_positions: np.ndarray) -> np.ndarray:
        """The gradient by the shares from that by the rest positions."""
        return self.spread.reshape(2 * STATIONS, -1) @ self.cage.vjp(by_positions).ravel()

    def hang(self, shares: np.ndarray, times: float) -> ds.Frames:
        """The equilibrium of a shape under `times` the load."""
        self.simulations += 1
        rest = self.shape(shares)
        return self.rollout.forward(rest_positions=rest, initial_positions=rest, external_forces=times * self.load)

    def drop(self, shares: np.ndarray, times: float) -> tuple[float, np.ndarray]:
        """(mean drop of the end [m], its gradient)"""
        frames = self.hang(shares, times)
        self.simulations += 1
        gradients = self.rollout.vjp(frames, displacements=self.seed)
        return float((self.seed * frames.displacements).sum()), self.by_shares(sum(gradients.values()))

    def swell(self, shares: np.ndarray) -> tuple[float, np.ndarray]:
        """(volume by that of the beam, less one; its gradient)"""
        volume, gradient = rest_volume(self.mesh, self.shape(shares))
        return volume / self.volume - 1, self.by_shares(gradient) / self.volume


def draw(path: Path, beam: Beam, before: ds.Frames, after: ds.Frames, ratio: float) -> None:
    """The beam under the load behind, the shape found under twice the load in front."""
    path.parent.mkdir(exist_ok=True)
    aside = 2.2 * np.array([0.0, 0.0, SIZE[2]])
    places = [frames.positions[-1] + k * aside for k, frames in enumerate((before, after))]
    drops = np.concatenate([-1e3 * frames.displacements[-1, :, 1] for frames in (before, after)])
    both = ds.TetrahedralMesh.joined([beam.mesh] * 2)
    save_picture(
        path,
        both,
        np.concatenate(places),
        drops,
        "drop [mm]",
        title=f"behind: a beam; in front: as much material, twice the load, {ratio:.2f} of the drop",
        azimuth=30,
        elevation=20,
        fixed=both.vertex_sets["xmin"],
    )


def main(folder="output", quick: bool = False) -> dict:
    """For linear and for ten-node tetrahedra: drops [m] of the beam and, under twice the load, of the shape found, their
    ratio, the volume's change, how deep and wide it is by the beam, the smallest J of the map, simulations, seconds."""
    out = {}
    for order, resolution in ((1, (13, 3, 3) if quick else (33, 5, 5)), (2, (7, 2, 2) if quick else (17, 3, 3))):
        beam, begin = Beam(resolution, order), time.perf_counter()
        straight = np.zeros(2 * STATIONS)
        first = beam.hang(straight, 1.0)
        before = float((beam.seed * first.displacements).sum())
        found = minimize(
            lambda x: tuple(part / before for part in beam.drop(x, 2.0)),
            straight,
            jac=True,
            method="SLSQP",
            bounds=[(-0.75, DEEPER)] * STATIONS + [(-0.75, 0.0)] * STATIONS,
            constraints={"type": "eq", "fun": lambda x: beam.swell(x)[0], "jac": lambda x: beam.swell(x)[1]},
            options=dict(maxiter=20 if quick else 40, ftol=1e-3 if quick else 1e-4),
        )
        frames, rest = beam.hang(found.x, 2.0), beam.shape(found.x)
        after = float((beam.seed * frames.displacements).sum())
        extent = np.ptp(rest, axis=0) / SIZE
        out[order] = {
            "before": before,
            "after": after,
            "ratio": after / before,
            "volume": ds.TetrahedralMesh(rest, beam.mesh.elements).volume / beam.mesh.volume - 1,
            "deeper": extent[1],
            "wider": extent[2],
            "smallest_J": smallest_ratio(beam.mesh, rest),
            "simulations": beam.simulations,
            "seconds": time.perf_counter() - begin,
        }
        r = out[order]
        print(
            f"{'linear' if order == 1 else 'ten-node'} tetrahedra: {1e3 * before:.3g} mm before, {1e3 * after:.3g} mm under "
            f"twice the load ({r['ratio']:.3f}); volume {100 * r['volume']:+.2g} %, {r['deeper']:.3g} times as deep, "
            f"{r['wider']:.3g} times as wide; {r['simulations']} simulations, {r['seconds']:.1f} s"
        )
        if folder:
            name = "cantilever_shape.png" if order == 1 else "cantilever_shape_ten_nodes.png"
            draw(Path(folder) / name, beam, first, frames, r["ratio"])
    return out


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
