"""Pictures and files of sweeps."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.study.charts import save, without_nan, write_results
from diffsim_ti.study.sweep import Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def is_log(values) -> bool:
    """Whether values go by factors rather than by differences."""
    x = np.asarray(values, float)
    return len(x) > 2 and bool((x > 0).all()) and x.max() > 20 * x.min()


def draw_sweep(sweep: Sweep, path: str | Path) -> None:
    """A panel for each result: over one number a line, over two a map, over more lines over the last one; refused points are
    crosses at the foot of the panel, or white."""
    from matplotlib.figure import Figure

    names = sweep.results
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(4.8 * columns, 3.9 * rows), dpi=120, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, name in zip(grid, names):
        (_map if len(sweep.over) == 2 and min(map(len, sweep.over.values())) > 1 else _lines)(axes, sweep, name)
        axes.set_title(name, loc="left", fontsize=10)
    for axes in grid[len(names) :]:
        axes.axis("off")
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
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


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
