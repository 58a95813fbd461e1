"""Pictures and files of charts. Colours are Okabe and Ito's, which colour-blind readers tell apart."""

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from diffsim_ti.study.work_precision import Chart, Point


STYLES = {  # of a solver: colour and marker
    "SemiImplicit": ("#E69F00", "o"),
    "VelocityVerlet": ("#0072B2", "s"),
    "ImplicitEuler": ("#D55E00", "^"),
    "ImplicitMidpoint": ("#009E73", "D"),
    "BDF2": ("#CC79A7", "v"),
    "Static": ("#56B4E9", "P"),
}
PEER_COLORS = {"torch-diffsim": "#555555", "Warp": "#999999", "JAX": "#BBBBBB"}


def new_figure(width: float = 9.2, height: float = 5.4) -> "tuple[Figure, Axes]":
    """(figure, axes) in the style of all pictures, without a display."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=130, layout="constrained")
    axes = figure.add_subplot()
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure, axes


def draw_chart(chart: "Chart", path: str | Path, peers: dict | None = None) -> None:
    """The work-precision diagram: time against error, a mark per run, the Pareto front as a line with its labels.

    peers: other systems' runs of the same problem, name -> [(seconds per simulated second, error), ...].
    """
    figure, axes = new_figure(10.5)
    names = dict.fromkeys(p.solver for p in chart.points)
    for solver in names:
        name = solver.removesuffix("Solver")
        for precision, filled in (("f32", True), ("f64", False)):
            rows = [p for p in chart.points if p.solver == solver and p.precision == precision and np.isfinite(p.error)]
            if rows:
                color, marker = STYLES.get(name, ("#000000", "x"))
                look = dict(
                    s=22, marker=marker, facecolors=color if filled else "none", edgecolors=color, linewidths=1.0
                )
                seconds, errors = [p.seconds for p in rows], [p.error for p in rows]
                axes.scatter(seconds, errors, alpha=0.75, label=f"{name}, {precision}", zorder=2, **look)
    front = chart.front
    axes.plot([p.seconds for p in front], [p.error for p in front], "k-", lw=1.3, zorder=1, label="Pareto front")
    for who, rows in (peers or {}).items():
        rows = sorted(rows)
        best = [min(e for _, e in rows[: k + 1]) for k in range(len(rows))]
        own = [row for k, row in enumerate(rows) if row[1] == best[k] and (k == 0 or row[1] < best[k - 1])]
        if rows:
            axes.plot(*zip(*rows), "*", ms=8, color=PEER_COLORS.get(who, "#777777"), zorder=3, label=who)
            axes.plot(*zip(*own), "--", lw=1.2, color=PEER_COLORS.get(who, "#777777"), zorder=1, label=f"{who}'s front")
    per = "equilibrium" if chart.problem.static else "simulated second"
    axes.set(xscale="log", yscale="log", ylabel=chart.problem.error, xlabel=f"wall time per {per} [s]")
    axes.set_title(chart.problem.title, loc="left", fontsize=11)
    axes.grid(which="major", color="0.9", zorder=0)
    if chart.reference_error > 0:
        axes.axhspan(chart.reference_error / 2, chart.reference_error, color="0.9", zorder=0)
        axes.set_ylim(bottom=min(chart.reference_error / 2, axes.get_ylim()[0]))
        place = dict(transform=axes.get_yaxis_transform(), ha="right", va="bottom")
        axes.text(0.99, chart.reference_error, "the reference's own error", fontsize=8, color="0.35", **place)
    label_front(axes, front)
    axes.legend(fontsize=8, frameon=False, ncols=1, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    save(figure, path)


def label_front(axes: "Axes", front: "Sequence[Point]", most: int = 9) -> None:
    """Number some of the front's runs and say beside the diagram what they are."""
    apart = front[:1]
    for p in front[1:]:  # of runs that lie close together the first one is named
        if abs(np.log(p.seconds / apart[-1].seconds)) + abs(np.log(p.error / apart[-1].error)) > 0.35:
            apart.append(p)
    few = [apart[round(k)] for k in np.linspace(0, len(apart) - 1, min(most, len(apart)))]
    look = dict(textcoords="offset points", xytext=(-3, -3), ha="right", va="top", fontsize=8, fontweight="bold")
    for k, p in enumerate(few):
        axes.annotate(str(k + 1), (p.seconds, p.error), zorder=4, **look)
    lines = ["the front:", *(f"{k + 1}  {p.label}" for k, p in enumerate(few))]
    axes.text(1.02, 0.0, "\n".join(lines), transform=axes.transAxes, fontsize=7.5, va="bottom", linespacing=1.5)


def save(figure: "Figure", path: str | Path) -> None:
    """Write a figure, making its folder."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def write_json(record: dict, path: str | Path) -> None:
    """Numbers and words as JSON, NaN as null."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(json.dumps(record, indent=1, default=str) + "\n", encoding="utf-8")


def write_csv(rows: list[dict], path: str | Path) -> None:
    """Rows with the same keys as CSV."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


def without_nan(row: dict) -> dict:
    """A row of a table with None for what is not finite."""
    return {k: (None if isinstance(x, float) and not np.isfinite(x) else x) for k, x in row.items()}


def write_results(stem: Path, draw: Callable[[Path], object], rows: list[dict], record: dict) -> list[str]:
    """A picture, rows and a record as `stem`.png, .csv, .json; returns their names."""
    draw(stem.with_suffix(".png"))
    write_csv(rows, stem.with_suffix(".csv"))
    write_json(record, stem.with_suffix(".json"))
    return [str(stem.with_suffix(suffix)) for suffix in (".png", ".csv", ".json")]


def write_chart(chart: "Chart", folder: str | Path, peers: dict | None = None) -> list[str]:
    """chart_<problem>.png, .csv, .json in a folder; returns their names."""
    stem = Path(folder) / f"chart_{chart.problem.name.replace('-', '_')}"
    record = chart.record() | ({"peers": peers} if peers else {})
    return write_results(stem, lambda path: draw_chart(chart, path, peers), record["points"], record)
