"""Which shape must a cantilever be cast in, so that it sags into a straight bar?

The unknowns are the rest positions of all free vertices. The bar is let go in the wanted shape with drag, and moves until it
hangs still; the residual is how far it then is from the wanted shape. Gauss-Newton: the step solves J^T J d = -J^T r by
conjugate gradients, where J^T r is the gradient by the rest shape and J^T J d one tangent and one reverse run.

    python examples/design/inverse_rest_shape.py [folder for a picture]
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

import diffsim_ti as ds
from diffsim_ti.picture import save_picture
from diffsim_ti.verify import gauss_newton_product

STEPS, DT = 800, 2e-3
DAMPING = 3e-3  # of Levenberg and Marquardt: directions that hardly move the bar stay small
TOLERANCE = 1e-5  # [m]


def main(picture_folder: str | None = None) -> dict:
    """Returns the residual before and after [m], their ratio, how far the tip is cast upwards [m], iterations, seconds."""
    bar = ds.TetrahedralMesh.create_box((7, 3, 3), size=(0.6, 0.2, 0.2), pattern="five")
    scene = ds.Scene(
        bar,
        ds.StableNeoHookean(3e5, 0.3),
        density=1000.0,
        terms=[ds.Gravity(), ds.Drag(20.0)],
        fixed="xmin",
        precision="f64",
    )
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=DT), STEPS, gradients=["rest_positions"])
    free = np.setdiff1d(np.arange(bar.num_vertices), scene.fixed)
    rest = bar.vertices.copy()
    last = np.zeros((2, 1, 1))
    last[1] = 1  # only the last frame counts

    def step(frames, residual):
        """Change of the free vertices' rest positions [m]."""

        def product(d):
            direction = np.zeros(rest.shape)
            direction[free] = d.reshape(-1, 3)
            by_rest = gauss_newton_product(rollout, frames, {"rest_positions": direction}, last)["rest_positions"]
            return by_rest[free].ravel() + DAMPING * d

        gradient = rollout.vjp(frames, last * residual)["rest_positions"][free].ravel()
        operator = LinearOperator((gradient.size, gradient.size), product, dtype=np.float64)
        return cg(operator, -gradient, rtol=1e-2, maxiter=15)[0].reshape(-1, 3)

    start, history = time.perf_counter(), []
    for iteration in range(10):
        frames = rollout.forward(rest_positions=rest)
        residual = frames.positions[-1] - bar.vertices
        history.append(float(np.sqrt((residual[free] ** 2).sum(1).mean())))
        print(f"iteration {iteration}: {1e3 * history[-1]:.4g} mm off")
        if history[-1] < TOLERANCE:
            break
        rest[free] += step(frames, residual)
    seconds = time.perf_counter() - start

    before, after, ratio = history[0], history[-1], history[0] / history[-1]
    lift = float((rest - bar.vertices)[bar.vertex_sets["xmax"], 1].mean())
    print(
        f"sag {1e3 * before:.3g} mm; with the new rest shape {1e3 * after:.2g} mm ({ratio:.0f} times less), whose tip "
        f"is cast {1e3 * lift:.3g} mm higher; {iteration} iterations, {seconds:.1f} s"
    )
    if picture_folder:
        higher, hangs = 1e3 * (rest - bar.vertices)[:, 1], frames.positions[-1] - [0, 0, 0.35]
        both = ds.TetrahedralMesh.joined([bar, bar])
        save_picture(
            Path(picture_folder) / "inverse_rest_shape.png",
            both,
            np.concatenate([rest, hangs]),
            np.concatenate([higher, 0 * higher]),
            "cast higher [mm]",
            wireframe=True,
            azimuth=-35,
            elevation=18,
            title="cast like the one in front, it sags straight",
            fixed=both.vertices[:, 0] < 1e-9,
        )
    return {"before": before, "after": after, "ratio": ratio, "lift": lift, "iterations": iteration, "seconds": seconds}


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
