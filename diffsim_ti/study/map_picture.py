"""Pictures and files of stability maps and of growth."""

from pathlib import Path

import numpy as np

from diffsim_ti.study.charts import new_figure, save, write_csv, write_json
from diffsim_ti.study.stability_map import OUTCOMES

OUTCOME_COLORS = ("#009E73", "#8FD0EC", "#F0E442", "#BBBBBB", "#D55E00")  # in the order of OUTCOMES


def draw_map(result, path) -> None:
    """A coloured cell per run, dt against the map's quantity, with the theoretical limit and where boundedness ends."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    figure, axes = new_figure(9.0)
    columns, outcomes = np.arange(len(result.axis.values)), result.outcomes
    edges = share_edges(result.shares)
    axes.pcolormesh(np.arange(len(columns) + 1) - 0.5, edges, outcomes, cmap=ListedColormap(OUTCOME_COLORS), vmin=-0.5,
                    vmax=len(OUTCOMES) - 0.5, edgecolors="white", linewidth=0.6)  # fmt: skip
    axes.axhline(1.0, color="black", lw=1.4)
    axes.text(len(columns) - 0.45, 1.0, "2 / omega max,\nby power iteration", va="center", fontsize=8)
    if np.isfinite(result.bounds).any():
        axes.plot(columns, result.bounds / result.limits, "kx", ms=7)
        axes.text(len(columns) - 0.45, 0.86, "x: bounded up to\nhere, if overridden", va="top", fontsize=8)
    axes.set(yscale="log", xlabel=f"{result.axis.name} [{result.axis.unit}]",
             ylabel="dt over the explicit limit at the start [-]")  # fmt: skip
    axes.set_xticks(columns, [f"{value:g}" for value in result.axis.values])
    labelled = zip(result.shares, apart(result.shares))
    axes.set_yticks(result.shares, [f"{share:g}" if keep else "" for share, keep in labelled])
    axes.minorticks_off()
    title = f"{result.solver}: {len(result.silent)} of {outcomes.size} runs wrong without a word"
    axes.set_title(title, loc="left", fontsize=11)
    handles = [Patch(color=color, label=name) for color, name in zip(OUTCOME_COLORS, OUTCOMES)]
    axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=9)
    save(figure, path)


def share_edges(shares) -> np.ndarray:
    """Edges of cells around the shares; one edge is exactly 1, the limit, where shares lie on both sides."""
    middles = np.sqrt(shares[1:] * shares[:-1])
    middles[(shares[1:] > 1) & (shares[:-1] < 1)] = 1.0
    return np.concatenate([[shares[0] ** 2 / middles[0]], middles, [shares[-1] ** 2 / middles[-1]]])


def apart(shares, least: float = 1.08) -> list[bool]:
    """Which shares have room for a label: each at least 8 % above the last one labelled."""
    keep, last = [], 0.0
    for share in shares:
        keep.append(share >= least * last)
        last = share if keep[-1] else last
    return keep


def write_map(result, folder, name: str) -> list[str]:
    """stability_<axis>_<solver>.png, .csv, .json in a folder; returns their names."""
    stem = Path(folder) / f"stability_{name}_{result.solver.removesuffix('Solver').lower()}"
    draw_map(result, stem.with_suffix(".png"))
    write_csv(result.rows(), stem.with_suffix(".csv"))
    record = dict(solver=result.solver, axis=result.axis.name, values=list(result.axis.values), limits_s=list(result.limits),
                  bounded_up_to_s=[None if np.isnan(b) else b for b in result.bounds], runs=result.rows())  # fmt: skip
    write_json(record, stem.with_suffix(".json"))
    return [str(stem.with_suffix(s)) for s in (".png", ".csv", ".json")]


def draw_growth(results: dict, path) -> None:
    """Size of the tangent against time, a line per run, with the horizon marked where one is reached."""
    from diffsim_ti.study.charts import COLORS

    figure, axes = new_figure()
    for (name, result), color in zip(results.items(), COLORS.values()):
        largest = result.sizes.max(0)
        axes.plot(result.times, largest, color=color, lw=1.6)
        axes.annotate(f"{name}, {result.rate:.2g} 1/s", (result.times[-1], largest[-1]), xytext=(5, 0),
                      textcoords="offset points", va="center", fontsize=8, color=color, annotation_clip=False)  # fmt: skip
        if result.horizon is not None:
            axes.plot(result.horizon, np.interp(result.horizon, result.times, largest), "o", color=color)
    axes.set(yscale="log", xlabel="time [s]", ylabel="size of d positions / d start [-]")
    axes.set_title("Growth of gradients", loc="left", fontsize=11)
    save(figure, path)
