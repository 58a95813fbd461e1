"""Speed on a common piece of work: nanoseconds per tetrahedron and substep, forward and with gradients.

The unit cube in Kuhn tetrahedra (6 per cell), Smith neo-Hookean, E = 1e5 Pa, nu = 0.4, 1000 kg/m^3, start stretched by 1 %,
gravity, drag that keeps 0.999 of the velocity per substep, symplectic Euler, 20 substeps of 2.5e-4 s, float32; the loss is
the sum of squared final positions, the gradients are by both Lame parameters of every tetrahedron and by the start.

    python examples/benchmarks/speed.py --common [--json] [--sizes 6 11 21] [--precision f32] [--repeats 20]
    python examples/benchmarks/speed.py --growth          # cost per tetrahedron from 6 000 to 1 000 000 tetrahedra
    python examples/benchmarks/speed.py --batch [--json] [--batches 6x64 11x16]    # many scenes at once, against one
    python examples/benchmarks/speed.py --batch --implicit --precision f64         # the same in steps of backward Euler
"""

import argparse
import json
import math
import time

import numpy as np

import diffsim_ti as ds

SUBSTEPS, H = 20, 2.5e-4
BATCH_STEPS = 10  # of many scenes at once


def best_seconds(function, repeats: int) -> float:
    """Best wall time of several calls [s]."""
    best = math.inf
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        best = min(best, time.perf_counter() - start)
    return best


def common_rollout(
    resolution: int, precision: str, per_tetrahedron: bool = True, substeps: int = SUBSTEPS, h: float = H
) -> ds.Rollout:
    """The common work on a cube with `resolution` vertices a side, in a step of `substeps` substeps of h [s]."""
    mesh = ds.TetrahedralMesh.create_cube(resolution)
    m = mesh.num_tetrahedra if per_tetrahedron else ()
    E, nu = 1e5, 0.4
    material = ds.SmithNeoHookean(mu=np.full(m, E / (2 * (1 + nu))), lam=np.full(m, E * nu / ((1 + nu) * (1 - 2 * nu))))
    scene = ds.Scene(
        mesh,
        material,
        density=1000.0,
        terms=[ds.Gravity(-9.8), ds.Drag(-math.log(0.999) / h)],
        initial_positions=mesh.vertices * 1.01,
        precision=precision,
    )
    # the common step is within the stable one at these sizes; --growth goes beyond, where only time is looked at
    solver = ds.SemiImplicitSolver(scene, dt=substeps * h, substeps=substeps, allow_unstable=resolution > 31)
    return ds.Rollout(solver, 1, gradients=["mu", "lam", "initial_positions"], memory=8000)


def measure(resolution: int, precision: str, repeats: int) -> dict:
    """One row of the table, with the keys `who, tets, forward_ns, forward_backward_ns, compile_s`."""
    rollout = common_rollout(resolution, precision)

    def forward_backward():
        frames = rollout.forward()
        adjoint = np.zeros_like(frames.positions)
        adjoint[-1] = 2 * frames.positions[-1]
        return rollout.vjp(frames, adjoint)

    start = time.perf_counter()
    rollout.forward()
    compile_forward = time.perf_counter() - start
    forward_backward()
    compile_s = time.perf_counter() - start
    scale = 1e9 / (SUBSTEPS * rollout.scene.mesh.num_tetrahedra)
    return {
        "who": "diffsim_ti",
        "tets": rollout.scene.mesh.num_tetrahedra,
        "forward_ns": round(best_seconds(rollout.forward, repeats) * scale, 1),
        "forward_backward_ns": round(best_seconds(forward_backward, repeats) * scale, 1),
        "compile_s": round(compile_s, 2),
        "compile_forward_s": round(compile_forward, 2),
        "precision": precision,
    }


def batch_work(resolution: int, scenes: int, precision: str, contact: bool) -> tuple:
    """(batch, rollout of one scene, values of the batch): the common work, or that on a rough floor with forces."""
    one = common_rollout(resolution, precision, per_tetrahedron=False)
    n, rng = one.scene.mesh.num_vertices, np.random.default_rng(0)
    values = {"mu": one.sweep.values["mu"] * rng.uniform(0.9, 1.1, scenes)}
    if contact:
        floor, forces = ds.Ground(-0.011, width=0.01, friction=0.3), ds.ExternalForce(np.zeros((n, 3)))
        one = one.with_scene(terms=[*one.scene.terms, floor, forces], initial_positions=one.scene.mesh.vertices)
        values["external_forces"] = rng.normal(size=(scenes, n, 3)) / n
    rollout = ds.Rollout(one.solver, BATCH_STEPS, gradients=["mu", "lam", "initial_positions"])
    return ds.Batch(one.solver, BATCH_STEPS, scenes, gradients=rollout.wanted), rollout, values


def implicit_work(resolution: int, scenes: int, precision: str, contact: bool) -> tuple:
    """As `batch_work`: soft cubes of 0.1 m in steps of 5 ms, free or thrown at a rough floor."""
    mesh, terms = ds.TetrahedralMesh.create_cube(resolution, 0.1), [ds.Gravity(-9.8)]
    terms += [ds.Ground(-1e-3, 1e3, 2e-3, friction=0.3)] if contact else []
    start = np.tile([0.5, -0.2, 0.1], (mesh.num_vertices, 1))
    material = ds.StableNeoHookean(5e4, 0.3)
    scene = ds.Scene(mesh, material, 1000.0, terms, initial_velocities=start, precision=precision)
    solver, wanted = ds.ImplicitEulerSolver(scene, dt=5e-3), ["youngs_modulus"]
    values = {"youngs_modulus": np.random.default_rng(0).uniform(4e4, 6e4, scenes)}
    batch = ds.Batch(solver, BATCH_STEPS, scenes, save_every=BATCH_STEPS, gradients=wanted)
    return batch, ds.Rollout(solver, BATCH_STEPS, save_every=BATCH_STEPS, gradients=wanted), values


def measure_batch(
    resolution: int, scenes: int, precision: str, contact: bool, repeats: int, work_of=batch_work, substeps=SUBSTEPS
) -> dict:
    """Nanoseconds per tetrahedron, substep and scene of a batch and of one of its scenes, runs back to back."""
    batch, rollout, values = work_of(resolution, scenes, precision, contact)
    own = {name: x[0] for name, x in values.items()}
    seeds = np.zeros((scenes, 2, batch.scene.mesh.num_vertices, 3))
    seeds[:, -1] = 1.0
    work = {
        "batch": (lambda: batch.forward(**values), lambda: batch.vjp(batch.forward(**values), seeds), scenes),
        "one": (lambda: rollout.forward(**own), lambda: rollout.vjp(rollout.forward(**own), seeds[0]), 1),
    }
    best = {name: [math.inf, math.inf] for name in work}
    for _ in range(repeats + 1):  # the first round compiles
        for name, (*calls, count) in work.items():
            best[name] = [min(b, best_seconds(call, 1) / count) for b, call in zip(best[name], calls)]
    scale = 1e9 / (substeps * BATCH_STEPS * batch.scene.mesh.num_tetrahedra)
    row = {"tets": batch.scene.mesh.num_tetrahedra, "scenes": scenes, "contact": contact, "precision": precision}
    for k, what in enumerate(("forward", "forward_backward")):
        row |= {f"{what}_ns": round(best["batch"][k] * scale, 2), f"{what}_alone_ns": round(best["one"][k] * scale, 2)}
        row[f"{what}_gain"] = round(best["one"][k] / best["batch"][k], 1)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--common", action="store_true", help="the common work (default)")
    parser.add_argument("--growth", action="store_true", help="6 000 to 1 000 000 tetrahedra")
    parser.add_argument("--batch", action="store_true", help="many scenes at once, against one")
    parser.add_argument("--implicit", action="store_true", help="in steps of backward Euler")
    parser.add_argument("--batches", nargs="+", default=["6x64", "11x16", "6x8"], help="vertices a side x scenes")
    parser.add_argument("--json", action="store_true", help="one JSON line per size")
    parser.add_argument("--sizes", type=int, nargs="+", default=[6, 11, 21], help="vertices a side")
    parser.add_argument("--precision", default="f32", choices=["f32", "f64"])
    parser.add_argument("--arch", default="cpu")
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args()
    ds.init(options.arch, options.precision)
    if options.batch:
        for size in options.batches:
            for contact in (False, True):
                resolution, scenes = map(int, size.split("x"))
                how = (implicit_work, 1) if options.implicit else (batch_work, SUBSTEPS)
                row = measure_batch(resolution, scenes, options.precision, contact, max(2, options.repeats // 4), *how)
                print(json.dumps(row) if options.json else "  ".join(f"{k} {x}" for k, x in row.items()), flush=True)
        return
    sizes = [11, 21, 31, 45, 56] if options.growth else options.sizes
    for resolution in sizes:
        row = measure(
            resolution, options.precision, max(3, options.repeats if resolution <= 21 else options.repeats // 4)
        )
        if options.json:
            print(json.dumps(row), flush=True)
        else:
            print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)


if __name__ == "__main__":
    main()
