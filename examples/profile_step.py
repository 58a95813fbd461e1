"""Where the time of a step goes: share of each kernel and of starting it, by size, and the distance to a C++ bound.

    python examples/profile_step.py [--sizes 6 11 21 44] [--bound PROGRAM]

The common work of benchmark.py, forward, in the Taichi profiler. --bound names a program that prints lines with
`M=<tetrahedra>` and `<number> ns/el` (ns per tetrahedron and force evaluation), such as a hand-written C++ loop.
"""

import argparse
import re
import subprocess
import time
from collections import defaultdict

import taichi as ti
from benchmark import SUBSTEPS, best_seconds, common_rollout
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
    return dict(tetrahedra=rollout.scene.mesh.num_tetrahedra, seconds=seconds, outside=outside,
                kernels={name: (calls, t / profiled) for name, (calls, t) in kernels.items()})  # fmt: skip


def bounds(program: str) -> dict[int, float]:
    """Tetrahedra -> ns per tetrahedron and force evaluation, as the program prints them."""
    text = subprocess.run([program], capture_output=True, text=True).stdout
    return {int(m): float(ns) for m, ns in re.findall(r"M=(\d+).*?([\d.]+) ns/el", text)}


def main(sizes=(6, 11, 21, 44), program: str | None = None) -> list[dict]:
    ds.init(precision="f32", kernel_profiler=True)
    known, rows = bounds(program) if program else {}, []
    for resolution in sizes:
        row = profile(resolution)
        rows.append(row)
        ns = 1e9 * row["seconds"] / (SUBSTEPS * row["tetrahedra"])
        bound = known.get(row["tetrahedra"])
        beyond = f", {ns / bound:.1f} times the bound of {bound:.1f}" if bound else ""
        print(f"{row['tetrahedra']} tetrahedra: {ns:.1f} ns per tetrahedron and substep{beyond}", flush=True)
        print(f"  {row['outside']:6.1%}  starting kernels, copies, Python")
        for name, (calls, share) in sorted(row["kernels"].items(), key=lambda x: -x[1][1])[:6]:
            print(f"  {share:6.1%}  {name}, {calls} calls")
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[6, 11, 21, 44], help="vertices a side")
    parser.add_argument("--bound", help="program that prints the bound")
    options = parser.parse_args()
    main(options.sizes, options.bound)
