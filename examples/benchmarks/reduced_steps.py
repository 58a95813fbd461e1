"""A stiff part that moves by few numbers: how much longer and cheaper explicit steps are, and what it does to the motion.

A soft pad on a block a thousand times stiffer, held where the pad ends, swings under its weight for 20 ms. Vertices of the
block move each by itself, by twelve numbers together (affine) or by six (rigid). Steps are 0.7 of the stable ones.

    python examples/benchmarks/reduced_steps.py             # 16 cells across; minutes
    python examples/benchmarks/reduced_steps.py --cells 6   # seconds
"""

import argparse
import time

import numpy as np

import diffsim_ti as ds

DURATION, SAFETY, SIZE = 0.02, 0.7, 0.1  # s, share of the stable step, m


def body(cells: int, kind: str | None) -> ds.Scene:
    """The block above, the pad below: a fifth of the height."""
    high = cells + max(2, cells // 4)
    size = (SIZE, SIZE * high / cells, SIZE)
    mesh = ds.TetrahedralMesh.create_box((cells + 1, high + 1, cells + 1), size, pattern="five")
    stiff = mesh.vertices[mesh.tetrahedra].mean(1)[:, 1] > size[1] - SIZE
    mesh = mesh.with_tetrahedron_set("block", np.flatnonzero(stiff))
    law = ds.StableNeoHookean(np.where(stiff, 1e8, 1e5), 0.3)
    terms = [ds.Gravity([3.0, -9.81, 0.0])]
    return ds.Scene(mesh, law, 1000.0, terms, fixed="ymin", precision="f64", reduced=kind and {"block": kind})


def main(cells: int = 16) -> dict:
    """Returns {kind: (stable step [s], processor time of a substep [s], of a simulated second [s], way of the top [m])}."""
    out, top = {}, None
    for kind in (None, "affine", "rigid"):
        scene = body(cells, kind)
        step = float(ds.stable_dt(scene))
        substeps = int(np.ceil(DURATION / (SAFETY * step)))
        solver = ds.VelocityVerletSolver(scene, dt=DURATION, substeps=substeps, parallel=False)
        rollout = ds.Rollout(solver, 1, gradients=[])
        ds.Rollout(ds.VelocityVerletSolver(scene, dt=step / 2, parallel=False), 1, gradients=[]).forward()  # compiles
        begin = time.process_time()
        moved = rollout.forward().displacements[-1]
        cost = time.process_time() - begin
        top = top or int(np.argmax(scene.mesh.vertices.sum(1)))
        out[kind or "each vertex"] = step, cost / substeps, cost / DURATION, float(np.linalg.norm(moved[top]))
    tets = scene.mesh.num_tetrahedra
    print(f"{tets} tetrahedra | stable step [us] | substep [ms] | simulated second [s] | cheaper | way of the top [mm]")
    whole = out["each vertex"][2]
    for name, (step, each, second, way) in out.items():
        print(f"{name} | {1e6 * step:.1f} | {1e3 * each:.2f} | {second:.1f} | {whole / second:.1f} | {1e3 * way:.3f}")
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cells", type=int, default=16)
    main(parser.parse_args().cells)
