"""The same calls on torch-diffsim 0.2.0 and on diffsim_ti: same motion for the same law; time of a step and its gradient.

torch-diffsim is no dependency: install it beside diffsim_ti in an environment of its own (pip install torch-diffsim==0.2.0).
Its law is Smith's stable neo-Hookean; its ground (barrier of width 0.02 at y = 0) cannot be switched off, so the body is
lifted above it; damping is off.

    python examples/benchmarks/side_by_side_torch_diffsim.py [--sizes 4 6 8]
    python examples/benchmarks/side_by_side_torch_diffsim.py --implicit [--sizes 2 3 4 5]  # its IPC step; needs ipctk
"""

import argparse
import json
import time
import warnings

import torch

import diffsim_ti
from diffsim_ti import diff_physics, diff_simulator

STEPS, DT, SUBSTEPS, LIFT = 50, 2e-3, 4, 0.2


def simulators(resolution: int) -> dict:
    """The same cube, law and start in both: 1 m wide, pulled by 5 % along x, above the ground."""
    import diffsim

    mesh = diffsim_ti.TetrahedralMesh.create_cube(resolution).translated((0.0, LIFT, 0.0))
    start = torch.tensor(mesh.vertices * (1.05, 1.0, 1.0), dtype=torch.float32)
    theirs = diffsim.DifferentiableSimulator(
        diffsim.TetrahedralMesh(mesh.vertices.copy(), mesh.tetrahedra.copy()),
        diffsim.DifferentiableMaterial(1e5, 0.4),
        diffsim.DifferentiableSolver(dt=DT, gravity=-9.8, damping=1.0, substeps=SUBSTEPS),
    )
    ours = diff_simulator.DifferentiableSimulator(
        mesh,
        diff_physics.DifferentiableMaterial(1e5, 0.4, law=diffsim_ti.SmithNeoHookean),
        diff_simulator.DifferentiableSolver(dt=DT, gravity=-9.8, damping=1.0, substeps=SUBSTEPS),
        contact=False,
    )
    assert ours._substeps == SUBSTEPS, "the step must be stable as it is"

    def reset_theirs():
        theirs.positions, theirs.velocities = start.clone().requires_grad_(True), torch.zeros_like(start)

    return {"torch-diffsim": (theirs, reset_theirs), "diffsim_ti": (ours, lambda: ours.reset(start))}


def measure(simulator, reset, repeats: int = 3) -> dict:
    """Best times per step and per step's backward [ms]; where the body ends, and the gradient by E of its spread."""
    forward, backward = [], []
    for _ in range(repeats + 1):
        reset()
        simulator.material.E.grad = None
        begin = time.perf_counter()
        for _ in range(STEPS):
            simulator.step()
        middle = time.perf_counter()
        (simulator.positions[:, 0] ** 2).mean().backward()
        forward.append(1e3 * (middle - begin) / STEPS)
        backward.append(1e3 * (time.perf_counter() - middle) / STEPS)
    return dict(
        positions=simulator.positions.detach(),
        gradient=simulator.material.E.grad.item(),
        step_ms=min(forward[1:]),
        backward_ms=min(backward[1:]),
    )


def implicit(sizes=(2, 3, 4, 5), steps: int = 2) -> list[tuple]:
    """Rows (vertices, tetrahedra, seconds per step of torch-diffsim's IPC solver, of ours, ratio, difference [m]).

    A beam, held at one end, begins to fall: backward Euler in float64 to the same tolerance, with contact of the surface
    with itself watched by both.
    """
    import diffsim
    from diffsim.ipc import IPCImplicitEulerSolver

    rows = []
    for n in sizes:
        mesh = diffsim_ti.TetrahedralMesh.create_box((3 * n - 2, n, n), (0.6, 0.2, 0.2))
        held, E, nu, dt, tolerance = mesh.vertex_indices("xmin"), 1e5, 0.4, 1e-2, 1e-8
        terms = [diffsim_ti.Gravity(-9.8), diffsim_ti.SelfContact(1e3, 1e-3)]
        scene = diffsim_ti.Scene(mesh, diffsim_ti.SmithNeoHookean(E, nu), 1000.0, terms, fixed=held, precision="f64")
        ours = diffsim_ti.Simulator(diffsim_ti.ImplicitEulerSolver(scene, dt=dt, tolerance=tolerance))
        body = diffsim.TetrahedralMesh(mesh.vertices.copy(), mesh.tetrahedra.copy())
        for name, value in vars(body).items():
            if torch.is_tensor(value) and value.is_floating_point():
                setattr(body, name, value.double())
        solver = IPCImplicitEulerSolver(dt=dt, dhat=1e-3, newton_tolerance=tolerance)
        law, masses = (
            diffsim.DifferentiableMaterial(E, nu),
            torch.tensor(scene.inputs.derive(scene.inputs.values).mass),
        )
        state = torch.as_tensor(mesh.vertices.copy()), torch.zeros(mesh.vertices.shape, dtype=torch.float64)
        seconds = []
        for _ in range(steps + 1):  # the first one compiles and sets up
            begin = time.perf_counter()
            state = [x.detach() for x in solver.step(body, law, *state, masses, fixed_vertices=torch.as_tensor(held))]
            middle = time.perf_counter()
            ours.step()
            seconds.append((middle - begin, time.perf_counter() - middle))
        theirs, mine = (sum(x) / steps for x in zip(*seconds[1:]))
        off = float(abs(state[0].numpy() - ours.positions).max())
        rows.append((mesh.num_vertices, mesh.num_tetrahedra, theirs, mine, theirs / mine, off))
        print("| " + " | ".join(f"{x:.3g}" for x in rows[-1]) + " |", flush=True)
    return rows


def main(sizes=(4, 6, 8)) -> list[dict]:
    rows = []
    for resolution in sizes:
        results = {who: measure(*both) for who, both in simulators(resolution).items()}
        theirs, ours = results["torch-diffsim"], results["diffsim_ti"]
        moved = (ours["positions"] - theirs["positions"]).abs().max().item()
        row = dict(
            tetrahedra=6 * (resolution - 1) ** 3,
            largest_difference_m=moved,
            gradient_difference=abs(ours["gradient"] / theirs["gradient"] - 1),
        )
        for who, result in results.items():
            row |= {
                f"{who} step_ms": round(result["step_ms"], 3),
                f"{who} backward_ms": round(result["backward_ms"], 3),
            }
        print(json.dumps(row), flush=True)
        rows.append(row)
    print(table(rows))
    return rows


def table(rows: list[dict]) -> str:
    """Times of step() and of its share of backward() [ms] as Markdown, with how many times faster diffsim_ti is."""
    lines = [
        "| tetrahedra | step(): torch-diffsim | diffsim_ti | ratio | backward(): torch-diffsim | diffsim_ti | ratio |",
        "|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        cells = [str(row["tetrahedra"])]
        for what in ("step_ms", "backward_ms"):
            theirs, ours = row[f"torch-diffsim {what}"], row[f"diffsim_ti {what}"]
            cells += [f"{theirs:.2f} ms", f"{ours:.2f} ms", f"{theirs / ours:.1f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", help="vertices a side")
    parser.add_argument("--implicit", action="store_true", help="the implicit steps of both")
    options = parser.parse_args()
    warnings.simplefilter("ignore", DeprecationWarning)
    if options.implicit:
        diffsim_ti.init(precision="f64")
        print(
            "| vertices | tetrahedra | torch-diffsim [s] | diffsim_ti [s] | ratio | differ by [m] |\n"
            + "|---:" * 6
            + "|"
        )
        implicit(options.sizes or (2, 3, 4, 5))
    else:
        main(options.sizes or (4, 6, 8))
