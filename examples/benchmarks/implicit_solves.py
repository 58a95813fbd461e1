"""Equilibria and implicit steps as the mesh grows: processor time, iterations of conjugate gradients, exponent.

    python examples/benchmarks/implicit_solves.py                       # a table in Markdown, and the exponents
    python examples/benchmarks/implicit_solves.py --against ../old      # beside another checkout, back to back
    python examples/benchmarks/implicit_solves.py --write               # the table also into examples/benchmarks/README.md

The beam of implicit_steps.py in float64, tolerance 1e-6. Equilibrium: E = 1e5 Pa, it sags by its length, in one load step,
preconditioner and all but compiling included. Steps: backward Euler, 10 ms, E = 1e6 Pa; the mean of four after the first,
and the reverse sweep through them. BLAS has one thread. Times are those of the processor, the least of some repetitions,
because a machine may have other things to do.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from datetime import date
from pathlib import Path

import numpy as np
from implicit_steps import DT, TOLERANCE, beam, scene_of
from threadpoolctl import threadpool_limits

import diffsim_ti as ds

SIZES, STEPS = [10_000, 25_000, 50_000, 100_000, 200_000], 4
PAGE = Path(__file__).parent / "README.md"
WRITTEN = "Written by `implicit_solves.py --write` on"
HEAD = ["tetrahedra", "equilibrium [s]", "iterations", "step [s]", "iterations per step", "gradient of a step [s]"]


def advanced(workspace, first: int, last: int) -> tuple[float, int]:
    """(processor time [s], products with the Hessian) of passes."""
    begin, products = time.process_time(), 0
    for j in range(first, last):
        workspace.advance(j, j + 1, last)
        products += workspace.newton.report.products
    return time.process_time() - begin, products


def equilibrium(scene, repeats: int) -> tuple[float, int]:
    """(processor time [s], products) of a solve that sets up all but kernels."""
    found = []
    for _ in range(repeats + 1):  # the first one compiles
        solver = ds.StaticSolver(scene, tolerance=TOLERANCE)
        found.append(advanced(solver.workspace(solver.start_values()), 0, 1))
    return min(found[1:])


def steps(scene, repeats: int) -> tuple[float, float]:
    """(processor time [s], products) of a step."""
    found = []
    for _ in range(repeats):
        solver = ds.ImplicitEulerSolver(scene, dt=DT, tolerance=TOLERANCE)
        workspace = solver.workspace(solver.start_values())
        advanced(workspace, 0, 1)
        found.append(advanced(workspace, 1, STEPS + 1))
    return tuple(x / STEPS for x in min(found))


def gradient(scene, repeats: int) -> float:
    """Processor time [s] of the reverse sweep of a step, by E."""
    solver = ds.ImplicitEulerSolver(scene, dt=DT, tolerance=TOLERANCE)
    rollout, found = ds.Rollout(solver, STEPS, gradients=["youngs_modulus"]), []
    frames = rollout.forward()
    adjoint = np.zeros_like(frames.positions)
    adjoint[-1] = frames.displacements[-1]
    for _ in range(repeats + 1):
        begin = time.process_time()
        rollout.vjp(frames, adjoint)
        found.append(time.process_time() - begin)
    return min(found[1:]) / STEPS


def row_of(size: int, repeats: int) -> list:
    """The numbers of a row of the table."""
    mesh = beam(size)
    s, products = equilibrium(scene_of(mesh, E=1e5), repeats)
    own, each = steps(scene_of(mesh), repeats)
    return [mesh.num_tetrahedra, s, products, own, each, gradient(scene_of(mesh), repeats)]


def row_elsewhere(checkout: str, size: int, repeats: int) -> list:
    """`row_of` by the package of a checkout, in a process of its own."""
    found, here = os.environ | dict(PYTHONPATH=str(Path(checkout).resolve())), Path(__file__).parent
    code = (
        "import json, implicit_solves as s\ns.ds.init(precision='f64')\n"
        f"with s.threadpool_limits(1): print(json.dumps(s.row_of({size}, {repeats})))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=found, cwd=here, stdout=subprocess.PIPE, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def exponent(rows: list, column: int) -> float:
    """Of the growth of a column with the number of tetrahedra."""
    if len(rows) < 2:
        return float("nan")
    return float(np.polyfit(*np.log([[row[0], row[column]] for row in rows]).T, 1)[0])


def table(head: list, rows: list) -> str:
    """Markdown."""
    shown = [[f"{x:.3g}" if isinstance(x, float) else str(x) for x in row] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, ["---:"] * len(head), *shown])


def write(text: str) -> None:
    """Replace the table with our head in examples/benchmarks/README.md, and below it when and where it was measured."""
    lines, first = PAGE.read_text().split("\n"), text.split("\n")[0]
    at = lines.index(first)
    end = next(k for k in range(at, len(lines)) if lines[k].startswith(WRITTEN))
    where = (
        f"{WRITTEN} {date.today():%d %B %Y}, on {os.cpu_count()} cores of {platform.machine()}, {platform.system()}."
    )
    PAGE.write_text("\n".join([*lines[:at], text, "", where, *lines[end + 1 :]]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="numbers of tetrahedra, about")
    parser.add_argument("--repeats", type=int, default=3, help="of each measurement, of which the least counts")
    parser.add_argument("--against", help="another checkout to compare with")
    parser.add_argument("--write", action="store_true", help="put the table into examples/benchmarks/README.md")
    options = parser.parse_args()
    here = str(Path(__file__).parent.parent.parent)
    rows, others = [], []
    for size in sorted(options.sizes):
        rows.append(row_elsewhere(here, size, options.repeats))
        if options.against:
            others.append(row_elsewhere(options.against, size, options.repeats))
    print(table(HEAD, rows))
    for column in (1, 3, 5):
        print(f"{HEAD[column]} grows with the power {exponent(rows, column):.2f}")
    if others:
        print("\nthe other checkout, and its numbers over ours\n")
        print(table(HEAD, others))
        ratios = [[a[0], *(y / x for x, y in zip(a[1:], b[1:]))] for a, b in zip(rows, others)]
        print(table(HEAD, ratios))
    if options.write:
        write(table(HEAD, rows))


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
