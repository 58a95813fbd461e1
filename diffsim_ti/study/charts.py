"""Pictures and files of charts, stability maps and sweeps, in Okabe and Ito's colours, which the colour-blind tell apart."""

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.study.stability_map import OUTCOMES, StabilityMap
from diffsim_ti.study.sweep import Sweep

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
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def panels_of(count: int, width: float, height: float, dpi: int) -> "tuple[Figure, list[Axes]]":
    """(figure, so many panels), three a row; what is left over of the last row is empty."""
    from matplotlib.figure import Figure

    columns = min(3, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(width * columns, height * rows), dpi=dpi, layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in panels[count:]:
        axes.axis("off")
    return figure, panels


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


OUTCOME_COLORS = ("#009E73", "#8FD0EC", "#F0E442", "#BBBBBB", "#D55E00")  # in the order of OUTCOMES
LETTERS = "ABLR!"  # the same in letters, for eyes and printers that see no colours
LOSES = "loses more than a tenth of the energy"
LEGEND = ("accurate: energy keeps to 1 %", "bounded", LOSES, "raises, refuses or warns", "wrong silently")


def draw_maps(results: list, path: str | Path) -> None:
    """A panel per solver: a cell per run, dt against the maps' quantity, with the theoretical limit and where
    boundedness ends; three panels a row, the legend in the last place."""
    figure, panels = panels_of(len(results) + 1, 4.9, 4.6, 110)
    if len([r for r in results if r.explicit]) == 2 and len(results) > 2:  # explicit solvers above, implicit ones below
        panels = [panels[0], panels[1], *panels[3:], panels[2]]
    for result, axes in zip(results, panels):
        draw_panel(result, axes)
    draw_legend(results, panels[len(results)])
    for axes in panels[len(results) + 1 :]:
        axes.axis("off")
    silent, total = sum(len(r.silent) for r in results), sum(r.outcomes.size for r in results)
    figure.suptitle(f"{results[0].axis.name}: {silent} of {total} runs went wrong without an error", fontsize=12)
    save(figure, path)


def draw_panel(result: StabilityMap, axes: "Axes") -> None:
    """One solver's map. Rows are as high as each other, whatever lies between their steps."""
    from matplotlib.colors import ListedColormap

    outcomes = result.outcomes
    colours = dict(cmap=ListedColormap(OUTCOME_COLORS), vmin=-0.5, vmax=len(OUTCOMES) - 0.5)
    axes.pcolormesh(outcomes, edgecolors="white", linewidth=0.8, **colours)
    for (row, column), outcome in np.ndenumerate(outcomes):
        axes.text(column + 0.5, row + 0.5, LETTERS[outcome], ha="center", va="center", fontsize=7, color="0.15")
    height = lambda share: np.interp(np.log(share), np.log(result.shares), np.arange(len(result.shares)) + 0.5)  # noqa: E731
    axes.axhline(height(1.0), color="black", lw=1.8)
    axes.plot(np.arange(len(result.limits)) + 0.5, height(result.bounds / result.limits), "kx", ms=8, mew=1.6)
    axes.set_xticks(np.arange(len(result.limits)) + 0.5, [f"{value:g}" for value in result.axis.values], fontsize=8)
    axes.set_yticks(np.arange(len(result.shares)) + 0.5, [f"{share:g}" for share in result.shares], fontsize=8)
    axes.set_xlabel(f"{result.axis.name} [{result.axis.unit}]", fontsize=9)
    axes.set_ylabel("dt over the explicit limit [-]", fontsize=9)
    axes.set_title(result.solver.removesuffix("Solver"), loc="left", fontsize=10)


def draw_legend(results: Sequence[StabilityMap], axes: "Axes") -> None:
    """What colours, letters, line and crosses mean."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Patch(color=color, label=f"{letter}  {words}") for color, letter, words in zip(OUTCOME_COLORS, LETTERS, LEGEND)
    ]
    handles.append(Line2D([], [], color="black", lw=1.8, label="2 / omega max of the start, by power iteration"))
    if any(np.isfinite(r.bounds).any() for r in results):
        label = "up to here bounded, refusal overridden"
        handles.append(Line2D([], [], color="black", marker="x", ms=8, lw=0, label=label))
    axes.axis("off")
    axes.legend(handles=handles, loc="center left", frameon=False, fontsize=9, handlelength=1.6, labelspacing=0.9)


def write_maps(results: list, folder: str | Path, name: str) -> list[str]:
    """stability_<name>.png, .csv, .json of all solvers on one axis in a folder; returns their names."""
    rows, record = [row for result in results for row in result.rows()], {}
    for r in results:
        bounds = [None if np.isnan(b) else b for b in r.bounds]
        of_axis = dict(axis=r.axis.name, values=list(r.axis.values), limits_s=list(r.limits))
        record[r.solver] = of_axis | dict(runs=r.rows(), bounded_up_to_s=bounds)
    return write_results(Path(folder) / f"stability_{name}", lambda path: draw_maps(results, path), rows, record)


def is_log(values) -> bool:
    """Whether values go by factors rather than by differences."""
    x = np.asarray(values, float)
    return len(x) > 2 and bool((x > 0).all()) and x.max() > 20 * x.min()


def draw_sweep(sweep: Sweep, path: str | Path) -> None:
    """A panel for each result: over one number a line, over two a map, over more lines over the last one; refused points are
    crosses at the foot of the panel, or white."""
    figure, panels = panels_of(len(sweep.results), 4.8, 3.9, 120)
    for axes, name in zip(panels, sweep.results):
        (_map if len(sweep.over) == 2 and min(map(len, sweep.over.values())) > 1 else _lines)(axes, sweep, name)
        axes.set_title(name, loc="left", fontsize=10)
    save(figure, path)


def _lines(axes: "Axes", sweep: Sweep, name: str) -> None:
    along = list(sweep.over)[-1]
    x, values = np.array(sweep.over[along]), sweep.column(name)
    values = values.reshape(-1, len(x))
    for k, row in enumerate(values):
        alpha = 1 if len(values) == 1 else 0.3 + 0.7 * k / len(values)
        axes.plot(x, row, "o-", ms=3.5, lw=1.2, color="#0072B2", alpha=alpha)
    refused, foot = x[np.isnan(values).any(0)], dict(transform=axes.get_xaxis_transform(), clip_on=False)
    axes.plot(refused, np.zeros(len(refused)), "x", color="#D55E00", **foot)
    axes.set_xlabel(along)
    axes.set_xscale("log" if is_log(x) else "linear")
    axes.set_yscale("log" if is_log(values[np.isfinite(values)]) else "linear")
    axes.grid(color="0.9")
    axes.spines[["top", "right"]].set_visible(False)


def _map(axes: "Axes", sweep: Sweep, name: str) -> None:
    (first, y), (second, x) = sweep.over.items()
    drawn = axes.pcolormesh(x, y, sweep.column(name), shading="nearest", cmap="viridis")
    axes.figure.colorbar(drawn, ax=axes)
    axes.set(xlabel=second, ylabel=first)
    axes.set_xscale("log" if is_log(x) else "linear")
    axes.set_yscale("log" if is_log(y) else "linear")


def write_sweep(sweep: Sweep, folder: str | Path) -> list[str]:
    """sweep.csv, .json, and .png where a run gave a number, in a folder; returns their names."""
    stem = Path(folder) / "sweep"
    rows = [without_nan(row) for row in sweep.rows]
    record = dict(over=sweep.over, results=sweep.results, rows=rows)
    files = write_results(stem, lambda path: draw_sweep(sweep, path) if sweep.results else None, rows, record)
    return files if sweep.results else files[1:]
