"""What a card computes, and how fast: for the day one is there. Ten minutes at most; exit code 1 if a part fails.

    python examples/benchmarks/gpu_gate.py [--arch cuda|vulkan|cpu] [--minutes 10] [--largest 5000000]
    python examples/benchmarks/gpu_gate.py --record gate.jsonl --half 1   # and, another time, --half 2

Each part runs in a process of its own with a time limit, prints one JSON line, and is a row of the table at the end: the
device; copies and launches; correctness against the CPU, in float64 and float32; time per substep by size beside what
copying the same bytes takes; implicit steps and their gradients by size, and what bytes their iterations of conjugate
gradients move; many scenes at once, explicit and implicit; the same work by peers that are installed (compare_peers.py),
on the same device. What does not fit the time or the memory is left out, and said so. With --record the rows go
to a file, too, and parts that are done there are not done again; --half takes the first or the second part of the list.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import taichi as ti
from compare_peers import common_jobs
from peers import work
from speed import BATCH_STEPS, SUBSTEPS, H, batch_work, common_rollout

import diffsim_ti as ds
from diffsim_ti import runtime, verify

SIZES = {6_000: 11, 48_000: 21, 196_608: 33, 998_250: 56, 4_983_504: 95}  # tetrahedra: vertices a side
# relative to the CPU's float64; float32 divides approximately on CUDA
GATES = {
    "f64": dict(motion=1e-11, gradient=1e-9, transpose=1e-12),
    "f32": dict(motion=1e-5, gradient=2e-3, transpose=1e-4),
}


@ti.kernel
def copy(source: ti.types.ndarray(ti.f32, 1), target: ti.types.ndarray(ti.f32, 1)):
    for i in target:
        target[i] = source[i]


def seconds(function, repeats: int) -> float:
    """Best wall time of a call, until the device is done [s]."""
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        ti.sync()
        best = min(best, time.perf_counter() - start)
    return best


def device(options) -> dict:
    try:
        import torch

        torch_sees = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "no card"
    except ImportError:
        torch_sees = "not installed"
    return dict(arch=runtime.arch_name(), name=runtime.device_name(), taichi=ti.__version__, torch_sees=torch_sees)


def bandwidth(options) -> dict:
    n = min(2**26, options.largest * 12)
    source, target = runtime.array(ti.f32, n), runtime.array(ti.f32, n)
    launch = runtime.Launch(copy, source, target)
    small = runtime.Launch(copy, runtime.array(ti.f32, 1), runtime.array(ti.f32, 1))
    launch(), small()
    many = seconds(lambda: [small() for _ in range(100)], 5) / 100
    return dict(copy_GB_per_s=round(8 * n / seconds(launch, 5) / 1e9, 2), launch_us=round(1e6 * many, 1))


def two_boxes() -> ds.TetrahedralMesh:
    box = ds.TetrahedralMesh.create_box(2, 0.1)
    return ds.TetrahedralMesh.joined([box, box.translated([0.02, 0.125, 0.01])])


def solver(kind: str, precision: str):
    """Scenes of the comparison: explicit with friction, implicit, and two bodies that meet."""
    mesh = two_boxes() if kind == "self-contact" else ds.TetrahedralMesh.create_cube(4, 0.3)
    ground = ds.Ground(mesh.vertices[:, 1].min() - 5e-3, 1e3, 0.01, friction=0.3)
    terms = [ds.Gravity(-9.8), ground] + ([ds.SelfContact(2e4, 2e-2)] if kind == "self-contact" else [])
    scene = ds.Scene(mesh, ds.StableNeoHookean(5e4, 0.3), 1000.0, terms, precision=precision)
    if kind == "implicit":
        return ds.ImplicitEulerSolver(scene, dt=5e-3)
    return ds.SemiImplicitSolver(scene, dt=5e-3, substeps=50, allow_unstable=True)


def results(kind: str, precision: str) -> tuple[ds.Rollout, dict[str, np.ndarray]]:
    rollout = ds.Rollout(solver(kind, precision), 4, gradients=["youngs_modulus", "initial_velocities"])
    frames = rollout.forward()
    return rollout, dict(motion=frames.displacements) | rollout.vjp(frames, frames.displacements)


def reference(options) -> dict:
    """The comparison's numbers on the CPU in float64, written for the parts that follow."""
    for kind in ("explicit", "implicit", "self-contact"):
        np.savez(Path(options.folder) / f"{kind}.npz", **results(kind, "f64")[1])
    return {}


def correctness(options, kind: str, precision: str) -> dict:
    file = Path(options.folder) / f"{kind}.npz"
    if not file.exists():
        return dict(left_out="nothing to compare with: the part reference was not done")
    rollout, found = results(kind, precision)
    expected = np.load(file)
    off = {name: float(np.abs(x - expected[name]).max() / np.abs(expected[name]).max()) for name, x in found.items()}
    again = results(kind, precision)[1]
    row = dict(
        motion=off.pop("motion"),
        gradient=max(off.values()),
        transpose=verify.dot_product_test(rollout),
        same_bits=all(np.array_equal(x, again[name]) for name, x in found.items()),
    )
    gate = GATES[precision]
    if kind == "implicit":  # solved to a tolerance, not to the last digit
        gate = gate | dict(transpose=1e-4)
    return row | dict(passed=row["same_bits"] and all(row[name] <= gate[name] for name in gate))


def divergence(options) -> dict:
    """A state that is not finite is found where it lies."""
    mesh = ds.TetrahedralMesh.create_cube(3)
    scene = ds.Scene(mesh, ds.StableNeoHookean(5e4, 0.3), 1000.0, [ds.Gravity(-9.8)])
    simulator = ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-3))
    bad = np.zeros(mesh.vertices.shape)
    bad[5] = np.nan
    runtime.fill(simulator.workspace.state.v, bad[None])
    try:
        simulator.step()
    except ds.Divergence as error:
        return dict(vertex=error.vertex, passed=error.vertex is not None)
    return dict(passed=False)


def torch_streams(options) -> dict:
    """A step and its gradient on torch's default stream and on another: the same bits."""
    import torch

    where = "cuda" if torch.cuda.is_available() and runtime.arch_name() == "cuda" else "cpu"
    streams = [torch.cuda.default_stream(), torch.cuda.Stream()] if where == "cuda" else [None]
    out = []
    floor = ds.Ground(-0.01, stiffness=1e4, width=0.01)
    scene = ds.Scene(ds.TetrahedralMesh.create_cube(3), ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity(-9.8), floor])
    for stream in streams:
        with torch.cuda.stream(stream):
            E, nu = (torch.tensor(x, device=where, requires_grad=True) for x in (1e5, 0.3))
            rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-3), 5)
            frames = ds.rollout_frames(rollout, youngs_modulus=E, poissons_ratio=nu)
            frames.positions[-1].square().sum().backward()
            out.append([x.grad.cpu().numpy() for x in (E, nu)] + [frames.positions[-1].detach().cpu().numpy()])
    same = all(np.array_equal(a, b) for other in out[1:] for a, b in zip(out[0], other))
    return dict(tensors_on=where, streams=len(streams), passed=same and all(np.isfinite(x).all() for x in out[0]))


def speed(options, tetrahedra: int) -> dict:
    """Time of a substep, forward and with its reverse, by runs of few and many, and of what a call takes besides; the bytes
    of state, shape and corner forces that a substep has to move, by its time."""
    if tetrahedra > options.largest:
        return dict(left_out="beyond --largest")
    n = SIZES[tetrahedra]
    times, counts = {}, (16, 16 * (25 if n < 30 else 8 if n < 90 else 4))
    for count in counts:
        rollout = common_rollout(n, "f32", False, count, H * min(1.0, 30 / n))  # so that many are stable
        frames = rollout.forward()
        adjoint = np.ones_like(frames.positions)
        rollout.vjp(frames, adjoint)
        forward = seconds(rollout.forward, 4)
        times[count] = np.array([forward, seconds(lambda: rollout.vjp(rollout.forward(), adjoint), 4)])
    few, many = counts
    forward, both = each = (times[many] - times[few]) / (many - few)
    fixed = times[few] - few * each
    vertices, m = rollout.scene.mesh.num_vertices, rollout.scene.mesh.num_tetrahedra
    touched = 4 * (m * (4 + 10 + 2 * 16) + vertices * 16)
    return dict(
        forward_us=round(1e6 * forward, 1),
        with_reverse_us=round(1e6 * both, 1),
        call_ms=round(1e3 * fixed[0], 1),
        both_calls_ms=round(1e3 * fixed[1], 1),
        forward_GB_per_s=round(touched / forward / 1e9, 2),
        megabytes=round(runtime.allocated_megabytes()),
    )


def bytes_of_iteration(workspace, preconditioner) -> int:
    """What an iteration of conjugate gradients with multigrid has to move at least: of elements indices, gradients, volumes,
    coefficients, displacements and directions of their corners and forces on them; of each level its matrix six times; of
    vertices five vectors read and three written."""
    arrays, real = workspace.arrays, 4 if workspace.scene.precision == "f32" else 8
    elements = arrays.num_tetrahedra * (16 + real * (9 + 1 + 2 + 3 * 12))
    levels = getattr(getattr(preconditioner, "cycle", None), "levels", [])
    cycle = sum(6 * 4 * np.prod((*x.values.shape, *x.values.element_shape)) for x in levels[:-1])
    return int(elements + cycle + arrays.num_vertices * 3 * real * 8)


def implicit(options, tetrahedra: int) -> dict:
    """Backward Euler of a block that is held on one side and falls: time of a step and of its gradient, products with the
    Hessian, and the bytes that these have to move by the time of the step."""
    if tetrahedra > options.largest:
        return dict(left_out="beyond --largest")
    mesh, steps = ds.TetrahedralMesh.create_cube(SIZES[tetrahedra], 1.0), 3
    precision = "f32" if runtime.arch_name() == "vulkan" else "f64"
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.3), 1000.0, [ds.Gravity(-9.81)], "xmin", precision=precision)
    rollout = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=1e-2), steps, gradients=["youngs_modulus"])
    begin = time.perf_counter()
    frames = rollout.forward()
    rollout.vjp(frames, frames.displacements)
    first = time.perf_counter() - begin
    forward = seconds(rollout.forward, 2) / steps
    frames = rollout.forward()
    gradient = seconds(lambda: rollout.vjp(frames, frames.displacements), 2) / steps
    products, ws = rollout.report.products / steps, rollout.sweep.workspace
    moved = bytes_of_iteration(ws, ws.newton.preconditioner)
    return dict(
        first_s=round(first, 1),
        step_ms=round(1e3 * forward, 1),
        gradient_ms=round(1e3 * gradient, 1),
        products=round(products, 1),
        megabytes_of_iteration=round(moved / 1e6, 1),
        step_GB_per_s=round(products * moved / forward / 1e9, 2),
        passed=bool(np.isfinite(frames.positions).all()),
    )


def off_alone(frames, one, values: dict) -> float:
    """How far some scenes of a batch are from runs of them alone."""
    off, scenes = 0.0, len(frames.displacements)
    for b in {0, scenes // 2, scenes - 1}:
        alone = one.forward(**{name: x[b] for name, x in values.items()}).displacements
        off = max(off, float(np.abs(frames.displacements[b] - alone).max() / np.abs(alone).max()))
    return off


def implicit_batch(options, scenes: int) -> dict:
    """Many scenes of 750 tetrahedra on a rough floor by backward Euler: time of a step of one, and of its gradient; some
    against what they are alone."""
    if 750 * scenes > max(options.largest, 6_000):
        return dict(left_out="beyond --largest")
    mesh, steps = ds.TetrahedralMesh.create_cube(6, 0.1), 2
    precision = "f32" if runtime.arch_name() == "vulkan" else "f64"
    terms = [ds.Gravity(-9.8), ds.Ground(mesh.vertices[:, 1].min() - 1e-3, 1e3, 2e-3, friction=0.3)]
    scene = ds.Scene(mesh, ds.StableNeoHookean(5e4, 0.3), 1000.0, terms, precision=precision)
    solver = ds.ImplicitEulerSolver(scene, dt=5e-3)
    batch = ds.Batch(solver, steps, scenes, gradients=["youngs_modulus"])
    values = dict(youngs_modulus=np.random.default_rng(0).uniform(4e4, 6e4, scenes))
    frames = batch.forward(**values)
    seeds = np.ones_like(frames.positions)
    batch.vjp(frames, seeds)
    forward = seconds(lambda: batch.forward(**values), 2) / (steps * scenes)
    both = seconds(lambda: batch.vjp(batch.forward(**values), seeds), 2) / (steps * scenes)
    off = off_alone(frames, ds.Rollout(solver, steps), values)
    return dict(
        step_ms=round(1e3 * forward, 3),
        with_gradient_ms=round(1e3 * both, 3),
        off=off,
        passed=bool(batch.lanes and frames.alive.all() and off <= GATES["f32"]["motion"]),
    )


def batch(options, scenes: int) -> dict:
    """Many scenes of 750 tetrahedra, with contact: time of a substep of one, forward and with its reverse; some against
    what they are alone."""
    if 750 * scenes > max(options.largest, 6_000):
        return dict(left_out="beyond --largest")
    many, one, values = batch_work(6, scenes, "f32", contact=True)
    frames, per_scene = many.forward(**values), BATCH_STEPS * SUBSTEPS * scenes
    seeds, off = np.ones_like(frames.positions), off_alone(frames, one, values)
    many.vjp(frames, seeds)
    forward = seconds(lambda: many.forward(**values), 2) / per_scene
    both = seconds(lambda: many.vjp(many.forward(**values), seeds), 2) / per_scene
    return dict(
        forward_us=round(1e6 * forward, 3),
        with_reverse_us=round(1e6 * both, 3),
        off=off,
        passed=bool(many.lanes and frames.alive.all() and off <= GATES["f32"]["motion"]),
    )


def peers(options, who: str) -> dict:
    """The work of 48 000 tetrahedra by another code: time of a substep, forward and with its reverse."""
    if who not in work.installed(sys.executable):
        return dict(left_out="not installed")
    if options.arch == "vulkan" or options.largest < 48_000:
        return dict(left_out="it has no Vulkan" if options.arch == "vulkan" else "beyond --largest")
    jobs, _ = common_jobs(SIZES[48_000], repeats=3, device=options.arch)
    answers = work.ask(who, sys.executable, jobs)
    if None in answers:
        return dict(passed=False, error="it failed; see what it printed")
    return {
        name: round(1e6 * float(answer["seconds"]) / SUBSTEPS, 1)
        for name, answer in zip(("forward_us", "with_reverse_us"), answers)
    }


PARTS = {"device": device, "bandwidth": bandwidth, "reference": reference}
for _kind in ("explicit", "implicit", "self-contact"):
    for _precision in ("f64", "f32"):
        PARTS[f"{_kind} {_precision}"] = lambda options, k=_kind, p=_precision: correctness(options, k, p)
PARTS |= {"divergence": divergence, "torch": torch_streams}
PARTS |= {f"implicit, {n:,} tetrahedra": lambda options, n=n: implicit(options, n) for n in list(SIZES)[:4]}
SECOND = len(PARTS)  # parts of the first half
PARTS |= {f"{n:,} tetrahedra": lambda options, n=n: speed(options, n) for n in SIZES}
PARTS |= {f"{n:,} scenes": lambda options, n=n: batch(options, n) for n in (1, 64, 256, 4096)}
PARTS |= {f"implicit, {n:,} scenes": lambda options, n=n: implicit_batch(options, n) for n in (1, 64, 256, 4096)}
PARTS |= {f"{who}, 48,000": lambda options, who=who: peers(options, who) for who in work.PEERS}


def run_part(options, name: str) -> dict:
    arch = "cpu" if name == "reference" else options.arch
    if name.endswith("f64") and arch == "vulkan":
        return dict(left_out="Vulkan has float32 only")
    ds.init(arch)
    try:
        return PARTS[name](options)
    except MemoryError as error:
        return dict(left_out=str(error))


def ask(options, name: str, limit: float, folder: str) -> dict:
    """The answer of a part's own process."""
    command = [sys.executable, __file__, "--arch", options.arch, "--largest", str(options.largest)]
    try:
        done = subprocess.run(
            [*command, "--part", name, "--folder", folder], capture_output=True, text=True, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return dict(left_out=f"not done in {limit:.0f} s")
    if done.returncode:
        return dict(
            passed=False, error=(done.stderr.strip() or f"ended with {done.returncode}").splitlines()[-1][-200:]
        )
    return json.loads(done.stdout.splitlines()[-1])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arch", default="cuda", choices=["cpu", "cuda", "vulkan"])
    parser.add_argument("--minutes", type=float, default=10.0, help="for all parts together")
    parser.add_argument("--largest", type=int, default=5_000_000, help="tetrahedra of the largest mesh")
    parser.add_argument("--only", nargs="+", choices=PARTS, metavar="PART", help="these parts alone")
    parser.add_argument("--part", help=argparse.SUPPRESS)
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    parser.add_argument("--half", type=int, choices=[1, 2], help="the parts of one half alone")
    parser.add_argument("--record", type=Path, help="a file of rows, whose parts are not done again")
    options = parser.parse_args()
    if options.part:
        print(json.dumps(run_part(options, options.part)))
        return 0
    end, rows = time.monotonic() + 60 * options.minutes, {}
    if options.record and options.record.exists():
        known = (json.loads(line) for line in options.record.read_text().splitlines())
        rows = {row["part"]: row for row in known if "no time left" not in row.get("left_out", "")}
        rows.pop("reference", None)  # which those that follow read
    half = {None: slice(None), 1: slice(SECOND), 2: slice(SECOND, None)}[options.half]
    with tempfile.TemporaryDirectory() as folder:
        for name in [name for name in options.only or list(PARTS)[half] if name not in rows]:
            left, start = end - time.monotonic(), time.monotonic()
            row = ask(options, name, min(left, 120), folder) if left > 5 else dict(left_out="no time left")
            rows[name] = dict(part=name, seconds=round(time.monotonic() - start, 1)) | row
            print(json.dumps(rows[name]), flush=True)
            if options.record:
                with options.record.open("a") as file:
                    file.write(json.dumps(rows[name]) + "\n")
    print("\n| part | |\n| --- | --- |")
    for name, row in rows.items():
        cells = (
            f"{key} {value:.2g}" if isinstance(value, float) and value < 1 else f"{key} {value}"
            for key, value in row.items()
            if key not in ("part", "seconds")
        )
        print(f"| {name} | {', '.join(cells) or 'done'} |")
    return int(any(row.get("passed") is False for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main())
