"""Which shape must a canopy be cast in, so that it hangs flat under its own weight?

The unknowns are the rest positions of all free vertices; the loss is the mean squared distance of the equilibrium to the
wanted shape. Its gradient by the rest shape costs one linear solve with the Hessian of the equilibrium, whatever the number
of unknowns. L-BFGS; each equilibrium starts from the one before.

    python examples/sag_into_shape.py
"""

import time
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

FALL = 3000  # stop when the error has fallen so many times


def main(folder="output", quick: bool = False) -> dict:
    """Returns rms distances before and after [m], their ratio, how much higher the edge is cast [m], iterations, seconds."""
    resolution = (7, 2, 4) if quick else (13, 3, 9)
    canopy = ds.TetrahedralMesh.create_box(resolution, (1.0, 0.1, 0.6), pattern="five")
    scene = ds.Scene(canopy, ds.StableNeoHookean(2e6, 0.3), 1000.0, [ds.Gravity()], "xmin", precision="f64")
    rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-10), 1, gradients=["rest_positions"])
    wanted, free = canopy.vertices, np.setdiff1d(np.arange(canopy.num_vertices), scene.fixed)
    rest, place, adjoint, history = wanted.copy(), wanted.copy(), np.zeros((2, *wanted.shape)), []

    def loss_and_gradient(x):  # [mm], for which L-BFGS takes a first step of 1
        rest[free] = wanted[free] + 1e-3 * x.reshape(-1, 3)
        frames = rollout.forward(rest_positions=rest, initial_positions=place)
        place[:] = frames.positions[-1]
        off = 1e3 * (place - wanted)[free]  # [mm]
        adjoint[1, free] = 2e3 * off / len(free)
        history.append(1e-3 * np.sqrt((off**2).sum(1).mean()))
        return (off**2).sum(1).mean(), 1e-3 * rollout.vjp(frames, adjoint)["rest_positions"][free].ravel()

    def stop_if_flat(intermediate_result):
        if np.sqrt(intermediate_result.fun) < 1e3 * history[0] / FALL:
            raise StopIteration

    start = time.perf_counter()
    found = minimize(loss_and_gradient, np.zeros(3 * len(free)), jac=True, method="L-BFGS-B", callback=stop_if_flat,
                     options=dict(maxiter=300, maxfun=400, maxcor=40, ftol=0, gtol=0))  # fmt: skip
    seconds = time.perf_counter() - start
    rest[free] = wanted[free] + 1e-3 * found.x.reshape(-1, 3)
    before, after = history[0], 1e-3 * np.sqrt(found.fun)
    lift = float((rest - wanted)[canopy.vertex_sets["xmax"], 1].mean())
    print(f"{3 * len(free)} unknowns: {1e3 * before:.3g} mm off when cast flat, {1e3 * after:.2g} mm with the edge cast "
          f"{1e3 * lift:.3g} mm higher ({before / after:.0f} times less); {found.nit} iterations, {seconds:.1f} s")  # fmt: skip
    if folder:
        Path(folder).mkdir(exist_ok=True)
        save_picture(Path(folder) / "sag_into_shape.png", canopy, rest, rest[:, 1] - wanted[:, 1], "cast higher by [m]",
                     title="the shape to cast, which sags flat", azimuth=60)  # fmt: skip
    return {"before": before, "after": after, "ratio": before / after, "lift": lift, "iterations": found.nit,
            "evaluations": found.nfev, "rest": rest, "seconds": seconds}  # fmt: skip


if __name__ == "__main__":
    ds.init(precision="f64")
    main()
