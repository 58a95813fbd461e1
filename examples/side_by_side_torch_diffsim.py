"""The same calls on torch-diffsim 0.2.0 and on diffsim_ti: same motion for the same law; time of a step and its gradient.

torch-diffsim is no dependency: install it beside diffsim_ti in an environment of its own (pip install torch-diffsim==0.2.0).
Its law is Smith's stable neo-Hookean; its ground (barrier of width 0.02 at y = 0) cannot be switched off, so the body is
lifted above it; damping is off.

    python examples/side_by_side_torch_diffsim.py [--sizes 4 6 8]
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
    )  # fmt: skip
    ours = diff_simulator.DifferentiableSimulator(
        mesh, diff_physics.DifferentiableMaterial(1e5, 0.4, law=diffsim_ti.SmithNeoHookean),
        diff_simulator.DifferentiableSolver(dt=DT, gravity=-9.8, damping=1.0, substeps=SUBSTEPS), contact=False,
    )  # fmt: skip
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
    return dict(positions=simulator.positions.detach(), gradient=simulator.material.E.grad.item(),
                step_ms=min(forward[1:]), backward_ms=min(backward[1:]))  # fmt: skip


def main(sizes=(4, 6, 8)) -> list[dict]:
    rows = []
    for resolution in sizes:
        results = {who: measure(*both) for who, both in simulators(resolution).items()}
        theirs, ours = results["torch-diffsim"], results["diffsim_ti"]
        moved = (ours["positions"] - theirs["positions"]).abs().max().item()
        row = dict(tetrahedra=6 * (resolution - 1) ** 3, largest_difference_m=moved,
                   gradient_difference=abs(ours["gradient"] / theirs["gradient"] - 1))  # fmt: skip
        for who, result in results.items():
            row |= {f"{who} step_ms": round(result["step_ms"], 3), f"{who} backward_ms": round(result["backward_ms"], 3)}
        print(json.dumps(row), flush=True)
        rows.append(row)
    print(table(rows))
    return rows


def table(rows: list[dict]) -> str:
    """Times of step() and of its share of backward() [ms] as Markdown, with how many times faster diffsim_ti is."""
    lines = ["| tetrahedra | step(): torch-diffsim | diffsim_ti | ratio | backward(): torch-diffsim | diffsim_ti | ratio |",
             "|---:|---:|---:|---:|---:|---:|---:|"]  # fmt: skip
    for row in rows:
        cells = [str(row["tetrahedra"])]
        for what in ("step_ms", "backward_ms"):
            theirs, ours = row[f"torch-diffsim {what}"], row[f"diffsim_ti {what}"]
            cells += [f"{theirs:.2f} ms", f"{ours:.2f} ms", f"{theirs / ours:.1f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[4, 6, 8], help="vertices a side")
    warnings.simplefilter("ignore", DeprecationWarning)
    main(parser.parse_args().sizes)
