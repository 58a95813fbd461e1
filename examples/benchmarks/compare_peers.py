"""Common work on whatever of torch-diffsim, NVIDIA Warp and JAX is installed, next to ours, in one run.

    python examples/benchmarks/compare_peers.py [--peers FOLDER] [--part common|batch|accuracy|charts|all] [--quick]

common: the work of speed.py, equal steps; prints ns per tetrahedron and substep.
batch: many bodies at once, as worlds of Warp (pieces of one mesh), by JAX's vmap, and ds.Batch.
accuracy: time to a given error, with and without gradients, of a Lamé mode against its closed form and of a bunny that falls
    on a floor against its own converged motion; draws peers.png and prints the times to 1e-2 and 1e-3.
charts: the work-precision diagrams of `diffsim-ti chart` with torch-diffsim's runs in them.

Each peer runs in a process of its own (peers/ beside this file), one after the other. --peers installs each into an
environment of its own in FOLDER, at the versions of peers/work.py, which are printed, and leaves out what does not install,
with the reason; a second run finds them there. Or --peer-python names an interpreter whose environment holds the peers.
Pictures and records go to --output.
"""

import argparse
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from peers import work
from speed import BATCH_STEPS, SUBSTEPS, H, common_rollout, measure, measure_batch

import diffsim_ti as ds
from diffsim_ti.study import chart, charts, pareto_front, problem, problems
from diffsim_ti.study.problem import FrameLoss, Problem
from diffsim_ti.study.work_precision import reference

sys.path.insert(0, str(Path(__file__).parent / "public"))
from table import environment  # noqa: E402

ROOT = Path(__file__).parents[2]
EXPLICIT = (ds.SemiImplicitSolver, ds.VelocityVerletSolver)
ERRORS = (1e-2, 1e-3)


def interpreters(folder: Path, names) -> tuple[dict[str, str], list[str]]:
    """({peer: interpreter} of those that install into folder, sentences why the others do not); both are printed."""
    out, reasons = {}, []
    for who in names:
        python, reason = environment(folder, who.lower(), *work.PINNED[who])
        said = f"{who} is left out: {reason.rstrip('.')}." if reason else f"{who}: {', '.join(work.PINNED[who])}"
        print(said, flush=True)
        if python:
            out[who] = python
        else:
            reasons.append(said)
    return out, reasons


# ---- equal steps --------------------------------------------------------------------------------------------------------


def common(peers: dict, sizes, rounds: int) -> dict:
    """{(who, tetrahedra): [forward, forward and gradient]} in ns per tetrahedron and substep, the best of the rounds."""
    best: dict = {}

    def note(who, tets, k, ns):
        row = best.setdefault((who, tets), [np.inf, np.inf])
        row[k] = min(row[k], ns)

    for _ in range(rounds):
        for n in sizes:
            row = measure(n, "f32", 10)
            note("diffsim_ti", row["tets"], 0, row["forward_ns"])
            note("diffsim_ti", row["tets"], 1, row["forward_backward_ns"])
        for who, python in peers.items():
            for n in sizes:
                jobs, tets = common_jobs(n)
                for k, answer in enumerate(work.ask(who, python, jobs)):
                    if answer is not None:
                        note(who, tets, k, float(answer["seconds"]) / SUBSTEPS / tets * 1e9)
    return best


def common_jobs(vertices_a_side: int, repeats: int = 5, **more) -> tuple[list[dict], int]:
    """(the common work forward, the same with gradients; tetrahedra)"""
    scene = common_rollout(vertices_a_side, "f32", per_tetrahedron=False).scene
    end = np.array([0.0, 1.0])
    job = work.scene_numbers(scene, H) | dict(E=1e5, nu=0.4, frames=1, substeps=SUBSTEPS, repeats=repeats) | more
    both = job | dict(weights=2 * scene.mesh.vertices, linear=end, square=0 * end, target=0 * end)
    return [job, both], scene.mesh.num_tetrahedra


BATCHES = (6, 64), (11, 16)  # vertices a side, bodies


def at_once(peers: dict, rounds: int) -> dict:
    """{(who, "bodies x tetrahedra"): [forward, forward and gradient]} in ns per tetrahedron, substep and body."""
    best: dict = {}
    for _ in range(rounds):
        for n, worlds in BATCHES:
            row = measure_batch(n, worlds, "f32", False, 5)
            size = f"{worlds} x {row['tets']}"
            found = {"diffsim_ti": [row["forward_ns"], row["forward_backward_ns"]]}
            for who, python in peers.items():
                if who != "torch-diffsim":
                    jobs, tets = common_jobs(n, worlds=worlds, substeps=BATCH_STEPS * SUBSTEPS)
                    answers = work.ask(who, python, jobs)
                    scale = 1e9 / (BATCH_STEPS * SUBSTEPS * tets * worlds)
                    found[who] = [np.inf if a is None else float(a["seconds"]) * scale for a in answers]
            for who, numbers in found.items():
                best[who, size] = np.minimum(best.get((who, size), np.inf), numbers).tolist()
    return best


def common_table(best: dict) -> str:
    """Markdown: forward and forward + gradient by size, and how many times as long as ours."""
    sizes = list(dict.fromkeys(size for _, size in best))
    head = " | ".join(f"forward, {s if isinstance(s, str) else format(s, ',')} | + gradient" for s in sizes)
    lines = [f"| | {head} |", "| --- |" + " --- | --- |" * len(sizes)]
    for who in dict.fromkeys(w for w, _ in best):
        cells = []
        for s in sizes:
            for value, own in zip(best.get((who, s), [np.nan] * 2), best["diffsim_ti", s]):
                cells.append(f"{value:.0f}" if value >= 100 else f"{value:.3g}")
                cells[-1] += "" if who == "diffsim_ti" else f" ({value / own:.1f}x)"
        lines.append(f"| {who} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


# ---- equal accuracy -----------------------------------------------------------------------------------------------------


def drop(gradient: bool = False, duration: float = 0.05) -> Problem:
    """A bunny of E = 1e5 Pa that meets a floor at 1 m/s: its motion, or d (mean height at the end) / dE."""
    mesh = ds.TetrahedralMesh.from_file(ROOT / "assets" / "tetmesh" / "bunny0.msh").translated((0, 0.006, 0))
    scene = ds.Scene(
        mesh,
        ds.SmithNeoHookean(1e5, 0.4),
        1000.0,
        [ds.Gravity(), ds.Ground(0.0, 225.6, 0.005)],
        initial_velocities=(0, -1.0, 0),
        precision="f32",
    )
    out = replace(
        Problem.of_scene(scene, duration, "drop", frames=5),
        patterns=("five",),
        title="A bunny of 7 637 tetrahedra meets a floor at 1 m/s",
    )
    if not gradient:
        return out
    mean = FrameLoss.end(lambda mesh: np.eye(3)[1] * np.ones((mesh.num_vertices, 1)) / mesh.num_vertices, 5)
    return replace(
        out,
        name="drop-gradient",
        title="Gradient by E of the mean height of a bunny that meets a floor",
        quantity=lambda _, g: np.atleast_1d(g["youngs_modulus"]),
        adjoint=mean,
        inputs=("youngs_modulus",),
        error="error of the derivative",
    )


def accuracy(peers: dict, quick: bool, folder, cubes=(4, 8, 12, 16, 24), time: float = 0.05) -> dict:
    """{problem: {who: [(seconds per simulated second, error), ...]}}; peers.png and peers.json grow with each problem."""
    if quick:
        cubes, time = (4, 8), 0.012
    out = {}
    for asked, cells, levels in (
        (problem("lame"), cubes, 1),
        (problem("lame-gradient"), cubes, 1),
        (drop(False, time), (0,), 2),
        (drop(True, time), (0,), 2),
    ):
        ours = replace(asked, cells=cells, patterns=("five",))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # coarse steps through contact are what is measured
            result = chart(ours, EXPLICIT, ("f32",), levels=levels + 1, limit=60.0, repeats=3, say=print)
        out[asked.title] = {"diffsim_ti": [(p.seconds, p.error) for p in result.points if np.isfinite(p.error)]}
        for who, python in peers.items():
            out[asked.title][who] = work.peer_points(asked, who, python, cells, 1 if quick else levels)
        draw(out, folder / "peers.png")
        charts.write_json(out, folder / "peers.json")
        print(accuracy_table(out).splitlines()[-1], flush=True)
    return out


def time_to(points, error: float) -> float:
    """The least time of a run whose error is at most this; infinite if there is none."""
    return min((seconds for seconds, e in points if e <= error), default=np.inf)


def accuracy_table(found: dict) -> str:
    """Markdown: wall time per simulated second to an error, and how many times as long as ours; where not all reach
    the errors asked for, also to the least that all do reach."""
    lines = ["| | error | " + " | ".join(next(iter(found.values()))) + " |"]
    lines.append("| --- | --- |" + " --- |" * len(next(iter(found.values()))))
    for title, rows in found.items():
        least = max(min((e for _, e in points), default=np.inf) for points in rows.values())
        for error in (*ERRORS, *([1.001 * least] if min(ERRORS) < least < np.inf else [])):
            times = {who: time_to(points, error) for who, points in rows.items()}
            own = times["diffsim_ti"]
            cells = [f"{t:.3g} s ({t / own:.3g}x)" if np.isfinite(t) else "not reached" for t in times.values()]
            lines.append(f"| {title} | {error:.3g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


STYLES = {
    "diffsim_ti": ("#0072B2", "o"),
    "torch-diffsim": ("#D55E00", "s"),
    "Warp": ("#009E73", "^"),
    "JAX": ("#CC79A7", "D"),
}


def draw(found: dict, path) -> None:
    """Time against error, a panel per problem, the front of each system."""
    from types import SimpleNamespace

    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    figure = Figure(figsize=(11, 8.6), dpi=120, layout="constrained")
    panels = figure.subplots(2, 2).flat
    for axes in panels[len(found) :]:
        axes.axis("off")
    for axes, (title, rows) in zip(panels, found.items()):
        for who, points in rows.items():
            color, marker = STYLES[who]
            front = pareto_front([SimpleNamespace(seconds=s, error=e) for s, e in points])
            axes.scatter(*zip(*points), s=18, color=color, marker=marker, alpha=0.35) if points else None
            axes.plot([p.seconds for p in front], [p.error for p in front], color=color, marker=marker, ms=6, label=who)
        for error in ERRORS:
            axes.axhline(error, color="0.75", lw=0.8, ls="--", zorder=0)
        axes.set(xscale="log", yscale="log", xlabel="wall time per simulated second [s]", ylabel="error [-]")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_title(title, loc="left", fontsize=10)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.axes[0].legend(frameon=False, fontsize=9)
    charts.save(figure, path)


# ---- the charts with a peer in them -------------------------------------------------------------------------------------


def as_deep(d, stiffness: float = 1e4, width: float = 0.01):
    """torch-diffsim's cubic floor, as run_torch_diffsim.py makes it of a barrier [J]."""
    return problems.barrier_energy(0.1 * width, stiffness, width) * ((width - d) / (0.9 * width)) ** 3


FINE_BEAMS = 12, 16  # cells across


def peers_of(name: str, who: str, python: str, quick: bool) -> list[tuple[float, float]]:
    """A peer's runs of a built-in problem, against the same right numbers; for a floor, of its own floor."""
    asked, right, levels = problem(name), None, 2
    cells = {"lame": (4, 8, 12, 16, 24), "beam": (1, 2, 3, 4, 6, *FINE_BEAMS), "identify": (2, 4)}.get(name, (1,))
    if name == "beam":
        known = reference(asked)[0]
        right, levels = lambda n: known, 1
    elif name == "identify":
        right = lambda n: reference(asked, n, "five")[0]  # noqa: E731
    elif name.startswith("bounce"):
        levels = 7
        if name == "bounce":
            asked = replace(asked, exact=np.array([problems.bounce_height(2.0, as_deep)]))
    return work.peer_points(asked, who, python, cells[:2] if quick else cells, 1 if quick else levels, right)


def charted(peers: dict, quick: bool, folder) -> str:
    """Write the charts with torch-diffsim's runs; Markdown of the times to an error."""
    found = {}
    for name in ("lame", "beam", "bounce", "bounce-gradient", "identify"):
        result = chart(problem(name), quick=quick, repeats=2, limit=0.35, say=print)
        if name == "beam" and not quick:  # meshes that take too long for all solvers and steps
            fine = chart(
                replace(problem(name), cells=FINE_BEAMS, patterns=("five",)),
                (ds.VelocityVerletSolver,),
                ("f32",),
                levels=1,
                repeats=1,
                limit=60.0,
                say=print,
            )
            result = result.with_points(fine.points)
        theirs = {who: peers_of(name, who, python, quick) for who, python in peers.items() if who == "torch-diffsim"}
        charts.write_chart(result, folder, theirs)
        ours = [(p.seconds, p.error) for p in result.points if np.isfinite(p.error)]
        found[result.problem.title] = {"diffsim_ti": ours, **theirs}
        print(accuracy_table(found), flush=True)
    return accuracy_table(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", type=Path, help="a folder that holds or gets an environment of each peer")
    parser.add_argument("--peer-python", default=sys.executable, help="or an interpreter with the peers")
    parser.add_argument("--part", default="all", choices=["common", "batch", "accuracy", "charts", "all"])
    parser.add_argument("--sizes", type=int, nargs="+", default=[6, 11, 21], help="vertices a side of the common work")
    parser.add_argument("--rounds", type=int, default=3, help="of the common work")
    parser.add_argument("--quick", action="store_true", help="small meshes, few steps")
    parser.add_argument("--output", type=Path, default=Path("output/peers"), help="folder for pictures and records")
    options = parser.parse_args()
    ds.init(precision="f32")
    if options.peers:
        peers, _ = interpreters(options.peers, work.PEERS)
    else:
        peers = dict.fromkeys(work.installed(options.peer_python), options.peer_python)
        print("peers:", ", ".join(peers) or "none is installed; see --peers")
    if options.part in ("common", "all"):
        print(common_table(common(peers, options.sizes, options.rounds)))
    if options.part in ("batch", "all"):
        print(common_table(at_once(peers, options.rounds)))
    if options.part in ("accuracy", "all"):
        print(accuracy_table(accuracy(peers, options.quick, options.output)))
    if options.part in ("charts", "all"):
        print(charted(peers, options.quick, options.output))


if __name__ == "__main__":
    main()
