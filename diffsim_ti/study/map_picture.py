"""Pictures and files of stability maps."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.study.charts import save, write_results
from diffsim_ti.study.stability_map import OUTCOMES, StabilityMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes


OUTCOME_COLORS = ("#009E73", "#8FD0EC", "#F0E442", "#BBBBBB", "#D55E00")  # in the order of OUTCOMES
LETTERS = "ABLR!"  # the same in letters, for eyes and printers that see no colours
LOSES = "loses more than a tenth of the energy"
LEGEND = ("accurate: energy keeps to 1 %", "bounded", LOSES, "raises, refuses or warns", "wrong silently")


def draw_maps(results: list, path: str | Path) -> None:
    """A panel per solver: a cell per run, dt against the maps' quantity, with the theoretical limit and where
    boundedness ends; three panels a row, the legend in the last place."""
    from matplotlib.figure import Figure

    columns = min(3, len(results) + 1)
    rows = -(-(len(results) + 1) // columns)
    figure = Figure(figsize=(4.9 * columns, 4.6 * rows), dpi=110, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    panels = [axes for row in grid for axes in row]
    explicit = [r for r in results if r.explicit]
    if len(explicit) == 2 and len(results) > 2 and columns == 3:  # explicit solvers above, implicit ones below
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
