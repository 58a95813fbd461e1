"""Which shape must a canopy be cast in, so that it hangs flat under its own weight?

The unknowns are the rest positions X of all free vertices, the equations x(X) = wanted, one for each. Gauss-Newton: the
step minimises |r + J d|^2 + damping |d|^2, r = x(X) - wanted, by LSMR, to which J d is the derivative of the equilibrium in
a direction of the rest shape and J^T r its gradient by the rest shape: one linear solve each with the Hessian of the
equilibrium, whatever the number of unknowns. A step is halved while it makes things worse or turns a tetrahedron over.

    python examples/design/sag_into_shape.py [folder for a picture, default output]
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.sparse.linalg import LinearOperator, lsmr

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

FALL = 3000  # stop when the error has fallen so many times


class Canopy:
    """A plate held along one edge, and its equilibria as a function of its rest shape."""

    def __init__(self, resolution, E: float):
        self.mesh = ds.TetrahedralMesh.create_box(resolution, (1.0, 0.1, 0.6), pattern="five")
        scene = ds.Scene(self.mesh, ds.StableNeoHookean(E, 0.3), 1000.0, [ds.Gravity()], "xmin", precision="f64")
        self.rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-10), 1, gradients=["rest_positions"])
        self.wanted = self.mesh.vertices
        self.free = np.setdiff1d(np.arange(self.mesh.num_vertices), scene.fixed)

    def hang(self, rest: np.ndarray, start: np.ndarray) -> tuple[ds.Frames, np.ndarray]:
        """The equilibrium of a rest shape, sought from `start`, and how far off it is, shape (num_vertices, 3) [m]."""
        frames = self.rollout.forward(rest_positions=rest, initial_positions=start)
        return frames, frames.positions[-1] - self.wanted

    def rms(self, off: np.ndarray) -> float:
        """Root mean square of the free vertices' distances [m]."""
        return float(np.sqrt((off[self.free] ** 2).sum(1).mean()))

    def step(self, frames: ds.Frames, off: np.ndarray) -> np.ndarray:
        """Change of the rest positions [m]."""
        adjoint, direction = np.zeros((2, *off.shape)), np.zeros(off.shape)

        def forward(d):
            direction[self.free] = d.reshape(-1, 3)
            return self.rollout.jvp(frames, rest_positions=direction)[0][-1][self.free].ravel()

        def reverse(r):
            adjoint[1, self.free] = r.reshape(-1, 3)
            return self.rollout.vjp(frames, adjoint)["rest_positions"][self.free].ravel()

        r = off[self.free].ravel()
        J = LinearOperator((r.size, r.size), forward, reverse, dtype=np.float64)
        change = np.zeros(off.shape)
        change[self.free] = -lsmr(J, r, damp=0.03, atol=1e-2, btol=1e-2, maxiter=12)[0].reshape(-1, 3)
        return change

    def improve(self, rest: np.ndarray, frames: ds.Frames, off: np.ndarray) -> tuple:
        """(rest, frames, off) after one step."""
        change = self.step(frames, off)
        for fraction in 0.5 ** np.arange(8):
            trial = rest + fraction * change
            try:
                _, new = self.hang(trial, frames.positions[-1])
            except (ValueError, ds.NotConverged):  # turned over, or hangs nowhere near
                continue
            if np.linalg.norm(new) < np.linalg.norm(off):
                return trial, *self.hang(trial, new + self.wanted)  # from where it hangs: derivatives start there
        raise RuntimeError("no step makes the canopy hang flatter: raise the damping")


def main(folder="output", quick: bool = False) -> dict:
    """Returns rms distances before and after [m], their ratio, how much higher the edge is cast [m], iterations, seconds."""
    canopy = Canopy((7, 2, 4), 2e6) if quick else Canopy((11, 3, 7), 4e6)
    start, iterations, rest = time.perf_counter(), 0, canopy.wanted.copy()
    frames, off = canopy.hang(rest, rest)
    before = canopy.rms(off)
    while canopy.rms(off) > before / FALL and iterations < 12:
        print(f"iteration {iterations}: {1e3 * canopy.rms(off):.4g} mm off")
        rest, frames, off = canopy.improve(rest, frames, off)
        iterations += 1
    after, seconds = canopy.rms(off), time.perf_counter() - start
    lift = float((rest - canopy.wanted)[canopy.mesh.vertex_sets["xmax"], 1].mean())
    print(
        f"{3 * len(canopy.free)} unknowns: {1e3 * before:.3g} mm off when cast flat, {1e3 * after:.2g} mm "
        f"with the edge cast {1e3 * lift:.3g} mm higher ({before / after:.0f} times less); "
        f"{iterations} iterations, {seconds:.1f} s"
    )
    if folder:
        Path(folder).mkdir(exist_ok=True)
        higher, below = rest[:, 1] - canopy.wanted[:, 1], frames.positions[-1] - [0, 0.35, 0]
        both = ds.TetrahedralMesh.joined([canopy.mesh, canopy.mesh])
        save_picture(
            Path(folder) / "sag_into_shape.png",
            both,
            np.concatenate([rest, below]),
            np.concatenate([higher, 0 * higher]),
            "cast higher by [m]",
            azimuth=-25,
            elevation=18,
            wireframe=True,
            title="cast as above, it sags flat as below",
            fixed=both.vertices[:, 0] < 1e-9,
        )
    return {
        "before": before,
        "after": after,
        "ratio": before / after,
        "lift": lift,
        "iterations": iterations,
        "rest": rest,
        "seconds": seconds,
    }


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
