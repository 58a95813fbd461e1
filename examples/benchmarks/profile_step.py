"""Where the time of a step goes: share of each kernel and of starting it, by size, and the distance to a C++ bound.

    python examples/benchmarks/profile_step.py [--sizes 6 11 21 44] [--bound PROGRAM ...]

The common work of speed.py, forward, in the Taichi profiler. --bound names programs that print lines with
`M=<tetrahedra>` and `<number> ns/el` (ns per tetrahedron and force evaluation), such as a hand-written C++ loop; the size
nearest to ours counts.
"""

import argparse
import re
import subprocess
import time
from collections import defaultdict

import taichi as ti
from speed import SUBSTEPS, best_seconds, common_rollout
from taichi.profiler.kernel_profiler import get_default_kernel_profiler

import diffsim_ti as ds


def kernel_times(rollout) -> dict[str, list[float]]:
    """Kernel -> [calls, seconds] of one forward run."""
    profiler = get_default_kernel_profiler()
    ti.profiler.clear_kernel_profiler_info()
    rollout.forward()
    profiler._update_records()
    out = defaultdict(lambda: [0, 0.0])
    for record in profiler._traced_records:
        name = re.sub(r"_c\d+_\d+.*?_kernel_(\d+)_", r" part \1 ", record.name)
        out[name][0] += 1
        out[name][1] += record.kernel_time / 1e3
    return dict(out)


def profile(resolution: int) -> dict:
    """{tetrahedra, seconds of a run, seconds outside kernels, kernels}, for one size."""
    rollout = common_rollout(resolution, "f32")
    rollout.forward()
    seconds = best_seconds(rollout.forward, 10 if resolution < 30 else 3)
    begin = time.perf_counter()
    kernels = kernel_times(rollout)
    profiled = time.perf_counter() - begin
    inside = sum(t for _, t in kernels.values())
    outside = max(0.0, profiled - inside) / profiled
    return dict(
        tetrahedra=rollout.scene.mesh.num_tetrahedra,
        seconds=seconds,
        outside=outside,
        kernels={name: (calls, t / profiled) for name, (calls, t) in kernels.items()},
    )


def bounds(program: str) -> dict[int, float]:
    """Tetrahedra -> ns per tetrahedron and force evaluation, as the program prints them."""
    text = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    return {int(m): float(ns) for m, ns in re.findall(r"M=(\d+).*?([\d.]+) ns/el", text)}


def variants(resolution: int) -> dict[str, float]:
    """ns per tetrahedron and substep of other ways to do the same: what was tried, and why it is done as it is."""
    base = common_rollout(resolution, "f32")
    law, m = type(base.scene.material.law("f32")), base.scene.mesh.num_tetrahedra
    out = {}
    for lanes in (True, False):
        for parallel in (False, True):
            law.lanes = lanes
            own = base.solver
            solver = type(own)(base.scene, own.dt, own.substeps, parallel=parallel, allow_unstable=True)
            rollout = ds.Rollout(solver, 1)
            rollout.forward()
            name = "eight lanes" if lanes else "one number at a time"
            name += ", a launch per loop" if parallel else ", one launch"
            out[name] = 1e9 * best_seconds(rollout.forward, 10 if resolution < 30 else 3) / (SUBSTEPS * m)
    law.lanes = True
    return out


def table(rows: list[dict], programs: list[str]) -> str:
    """Markdown: where a step's time goes, how far that is from the bounds, and what else was tried."""
    sizes = [row["tetrahedra"] for row in rows]
    lines = ["| | " + " | ".join(f"{m:,}" for m in sizes) + " |", "| --- |" + " ---: |" * len(sizes)]

    def line(name, cells):
        lines.append(f"| {name} | " + " | ".join(cells) + " |")

    line("ns per tetrahedron and substep", [f"{row['ns']:.1f}" for row in rows])
    line("starting kernels, copies, Python", [f"{row['outside']:.0%}" for row in rows])
    for part, words in PARTS.items():
        shares = [sum(share for name, (_, share) in row["kernels"].items() if name.endswith(part)) for row in rows]
        line(words, [f"{share:.0%}" for share in shares])
    for program in programs:
        known = bounds(program)
        near = [known[min(known, key=lambda m, s=s: abs(m - s))] for s in sizes]
        line(f"times {program.rsplit('/')[-1]}", [f"{row['ns'] / ns:.1f} ({ns:.1f} ns)" for row, ns in zip(rows, near)])
    for name in rows[0]["variants"]:
        line(name, [f"{row['variants'][name]:.1f}" for row in rows])
    return "\n".join(lines)


PARTS = {
    "part 0 serial": "all substeps in one serial kernel",
    "part 1 range_for": "forces of tetrahedra, a launch per substep",
    "part 3 range_for": "gathering and moving vertices, a launch per substep",
}


def main(sizes=(6, 11, 21, 44), programs=()) -> list[dict]:
    ds.init(precision="f32", kernel_profiler=True)
    rows = []
    for resolution in sizes:
        row = profile(resolution)
        row |= dict(ns=1e9 * row["seconds"] / (SUBSTEPS * row["tetrahedra"]), variants=variants(resolution))
        rows.append(row)
        calls = ", ".join(f"{name} {n}" for name, (n, share) in row["kernels"].items() if share > 1e-3)
        print(f"{row['tetrahedra']} tetrahedra: calls of {calls}", flush=True)
    print(table(rows, programs))
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[6, 11, 21, 44], help="vertices a side")
    parser.add_argument("--bound", nargs="+", default=[], help="programs that print bounds")
    options = parser.parse_args()
    main(options.sizes, options.bound)
