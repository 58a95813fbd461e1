"""Peers at equal accuracy: how long they and we take to the same error, in a table and a picture.

    python examples/benchmarks/public/all_peers.py [--quick] [--peers FOLDER]

Tasks: a Lame mode and its gradient, a bunny that falls and its gradient (compare_peers.py: torch-diffsim, Warp, JAX,
each from the same meshes and steps); an equilibrium of a beam (static_peers.py: torch-fem, Newton's method with SciPy's
LU); the stretch of a plate that torch-fem publishes (torch_fem_stretch.py). Left out are JAX-FEM, CHOLMOD, Newton, the
tasks of many bodies at once and those of ipc_corpus.py. The kernels for Warp and JAX and Newton's method with SciPy's
LU are ours.

Method. Each run is a point (seconds, error). A tool's time to an error is that of its fastest run which is at least so
accurate. Equal accuracy is the least error that both tools reach: the larger of the two tools' best. The ratio of a
peer on a task is its time to that error over ours. The geometric mean goes over tasks, each counted once; its spread is
the factor by which they scatter about it, exp of the standard deviation of their logarithms. Errors are against closed
forms, converged motions, or a solution to tolerance 1e-10; what is below 1e-6 counts as 1e-6. Times are wall times [s],
of what moves per simulated second [s/s]. Compiling is left out, and so is making meshes and scenes; what an
equilibrium's solver sets up is in its time. The processes run one after the other. diffsim_ti, torch and JAX may use
all cores; Warp runs on one thread on a CPU, and of ours BLAS has one. Tasks that a peer does not solve are named and in
no mean. Without --peers the page and the picture stay as they are.
"""

import sys
import tempfile
from importlib import metadata
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

import diffsim_ti as ds

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
import compare_peers  # noqa: E402
import static_peers  # noqa: E402
import torch_fem_stretch  # noqa: E402
from peers import work  # noqa: E402
from table import ROOT, asked, number, parser, report  # noqa: E402

from diffsim_ti.study import charts  # noqa: E402

OURS, LEAST = "diffsim_ti", 1e-6  # errors below that count as that
STYLES = compare_peers.STYLES | {"torch-fem": ("#E69F00", "v"), "SciPy LU": ("#7F7F7F", "X")}


def beam(peers: dict, tetrahedra: int) -> dict:
    """{tool: [(seconds, error)]} of the equilibrium of a beam, each at tolerances of its own."""
    scene, repeats = static_peers.scene_of(static_peers.beam(tetrahedra), static_peers.E), 2

    def ours(tolerance: float):
        solver = ds.StaticSolver(scene, tolerance=tolerance)
        workspace = solver.workspace(solver.start_values())
        workspace.advance(0, 1, 1)
        return workspace.u_star

    exact = ours(1e-10)

    def point(seconds: float, u) -> tuple[float, float]:
        return seconds, max(float(np.abs(u - exact).max() / np.abs(exact).max()), LEAST)

    out = {OURS: [point(*static_peers.best(lambda t=t: ours(t), repeats)) for t in (1e-2, 1e-4, 1e-6)]}
    direct = static_peers.Direct(scene, static_peers.lu)
    out["SciPy LU"] = [
        point(*static_peers.best(lambda: static_peers.Direct(scene, direct.factorised).solve(), repeats))
    ]
    if "torch-fem" in peers:
        job = static_peers.job_of(scene, repeats)
        answers = [
            static_peers.asked("static_torch_fem.py", peers["torch-fem"], job | dict(tolerance=t)) for t in (1e-2, 1e-6)
        ]
        out["torch-fem"] = [point(*a) for a in answers if a]
    return out


def stretch(peers: dict, vertices: int) -> dict:
    """{tool: [(seconds forward and gradient, error of the force)]}"""
    forward, gradient, _, force, _ = torch_fem_stretch.measured(vertices, 1)
    exact = torch_fem_stretch.FORCE
    out = {OURS: [(forward + gradient, max(abs(force / exact - 1), LEAST))]}  # the exact force has six digits
    if "torch-fem" in peers:
        told = asked(peers["torch-fem"], HERE / "torch_fem_peer.py", "stretch", vertices, "tetrahedra")
        out["torch-fem"] = []
        if "error" in told:
            print(f"torch-fem left the stretch: {told['error']}")
        else:
            seconds = told["forward"] + told["gradient"]  # neither counts making the mesh
            out["torch-fem"] = [(seconds, max(abs(told["value"] / exact - 1), LEAST))]
    return out


def least(points) -> float:
    """The least error of runs, infinite where none has a number."""
    return min((e for _, e in points if np.isfinite(e)), default=np.inf)


def unsolved(found: dict) -> list[str]:
    """Sentences that name who did not solve what."""
    return [
        f'{who} did not solve "{task}".'
        for task, tools in found.items()
        for who, points in tools.items()
        if not np.isfinite(least(points))
    ]


def ratios(found: dict) -> list[tuple]:
    """[(task, peer, the error that both reach, ours [s], theirs [s])]"""
    out = []
    for task, tools in found.items():
        best = {who: least(points) for who, points in tools.items()}
        for who in tools:
            error = 1.001 * max(best[OURS], best[who])
            if who != OURS and np.isfinite(error):
                out.append((task, who, error, *(compare_peers.time_to(tools[w], error) for w in (OURS, who))))
    return out


def mean_of(rows) -> tuple[float, float]:
    """(geometric mean, factor of its scatter) of theirs over ours."""
    logs = np.log([theirs / ours for *_, ours, theirs in rows])
    return float(np.exp(logs.mean())), float(np.exp(logs.std()))


def draw(found: dict, rows: list, path) -> None:
    """Left every run, with the pairs of equal accuracy joined; right the ratios, with geometric mean and spread."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 5.6), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    tasks = list(found)
    for tools in found.values():
        for who, points in tools.items():
            if points:
                color, marker = STYLES[who]
                left.scatter(*zip(*points), s=16, color=color, marker=marker, alpha=0.25, linewidths=0)
    for task, who, error, ours, theirs in rows:
        (own, own_marker), (color, marker) = STYLES[OURS], STYLES[who]
        left.plot([ours, theirs], [error, error], color=color, lw=0.8, alpha=0.5, zorder=0)
        left.scatter([ours], [error], s=42, color=own, marker=own_marker, zorder=3)
        left.scatter([theirs], [error], s=42, color=color, marker=marker, zorder=3)
        left.annotate(str(tasks.index(task) + 1), (theirs, error), (5, 4), textcoords="offset points", fontsize=8)
    left.set(xscale="log", yscale="log", xlabel="wall time [s], of motions [s/s]", ylabel="error [-]")
    left.set_title("Lines join runs of equal accuracy; the number is the task", loc="left", fontsize=10)
    peers = list(dict.fromkeys(who for _, who, *_ in rows))
    for k, who in enumerate(peers):
        color, marker = STYLES[who]
        own = [row for row in rows if row[1] == who]
        for task, _, _, ours, theirs in own:
            right.scatter([theirs / ours], [k], s=42, color=color, marker=marker, alpha=0.7)
            label = str(tasks.index(task) + 1)
            right.annotate(label, (theirs / ours, k), (0, 6), textcoords="offset points", fontsize=8, ha="center")
        mean, spread = mean_of(own)
        right.plot([mean / spread, mean * spread], [k - 0.25] * 2, color=color, lw=2)
        right.plot([mean], [k - 0.25], "|", color=color, ms=12, mew=2)
        right.annotate(f"{mean:.1f}", (mean, k - 0.25), (0, -14), textcoords="offset points", fontsize=9, ha="center")
    right.axvline(1.0, color="0.6", lw=0.8, ls="--")
    right.set(xscale="log", yticks=range(len(peers)), yticklabels=peers, ylim=(-0.7, len(peers) - 0.5))
    right.set_xlabel("time at equal accuracy over that of diffsim_ti")
    right.set_title("Each task once; bars: geometric mean and its spread", loc="left", fontsize=10)
    for who in (OURS, *peers):
        left.scatter([], [], color=STYLES[who][0], marker=STYLES[who][1], label=who)
    left.legend(frameon=False, fontsize=8)
    for axes in (left, right):
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    told = "\n".join(f"{k + 1}  {task}" for k, task in enumerate(tasks))
    figure.supxlabel(told, x=0.02, ha="left", multialignment="left", fontsize=9)
    charts.save(figure, path)


HEAD = ["task", "peer", "error that both reach", "diffsim_ti [s or s/s]", "peer [s or s/s]", "ratio"]


def measured(peers: dict, quick: bool, folder: Path) -> dict:
    """{task: {tool: [(seconds, error), ...]}}"""
    others = {who: python for who, python in peers.items() if who in work.PEERS}
    found = compare_peers.accuracy(others, quick, folder, cubes=(4, 8, 12), time=0.02)
    size, vertices = (1_000, 7) if quick else (10_000, 13)
    found[f"Equilibrium of a beam of {size:,} tetrahedra"] = beam(peers, size)
    found[f"Stretch of a plate to ten times its thickness, {15 * vertices**2:,} unknowns"] = stretch(peers, vertices)
    return found


def table_of(rows: list) -> tuple[list, str]:
    """(the table's rows, the worst first; a sentence with the means)"""
    order = sorted(rows, key=lambda row: row[4] / row[3])
    cells = [[task, who, f"{e:.1e}", ours, theirs, f"{theirs / ours:.2g}"] for task, who, e, ours, theirs in order]
    said = []
    for who in (*dict.fromkeys(row[1] for row in rows), None):
        own = [row for row in rows if who is None or row[1] == who]
        if own:
            mean, spread = mean_of(own)
            named = f"{who} {number(mean)}" if who else f"all pairs {number(mean)}"
            said.append(f"{named} ({len(own)} tasks, spread {spread:.1f})" if len(own) > 1 else f"{named} (one task)")
    return cells, "Times as long as diffsim_ti, geometric means: " + "; ".join(said) + "." if said else ""


def main() -> None:
    given = parser(__doc__).parse_args()
    names = [*work.PEERS, "torch-fem"]
    peers, notes = compare_peers.interpreters(given.peers, names) if given.peers else ({}, [])
    partial = given.quick or not given.peers
    with tempfile.TemporaryDirectory() as scratch:
        found = measured(peers, given.quick, Path(scratch))
        rows = ratios(found)
        picture = Path(scratch) if partial else ROOT / "assets" / "pictures"
        draw(found, rows, picture / "all_peers.png")
    cells, said = table_of(rows)
    told = " ".join([*notes, *unsolved(found), said]).strip()
    report("all_peers", HEAD, cells, partial, told, scipy=metadata.version("scipy"), **work.versions(*peers))


if __name__ == "__main__":
    ds.init("cpu", precision="f64")
    with threadpool_limits(1):
        main()
