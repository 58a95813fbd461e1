"""A picture of an identification: data and fit, residuals over the noise, numbers with their intervals."""

import textwrap
from pathlib import Path

import numpy as np

from diffsim_ti.identification.measurements import Measurement
from diffsim_ti.identification.result import Identification, ends
from diffsim_ti.rollout import Frames


def save_picture(
    path: str | Path,
    found: Identification,
    measurement: Measurement,
    frames: Frames,
    at: np.ndarray | None = None,
    at_label: str = "time [s]",
) -> None:
    """Write the picture of one experiment's measurement; frames: of the run with the numbers found; at: what the values'
    rows are drawn over, default their times."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    r = measurement.residual(frames, float(found.estimates.get("time_offset", 0.0)))
    seen = measurement.seen
    times = frames.times if measurement.times is None else measurement.times
    times = times if at is None else at
    t = np.broadcast_to(times.reshape(-1, *[1] * (seen.ndim - 1)), seen.shape)[seen]
    fit = measurement.values[seen] + r * measurement.deviation
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    axes[0].plot(t, measurement.values[seen], "o", mfc="none", ms=4, label="data")
    axes[0].plot(t, fit, ".", ms=4, label="fit")
    axes[0].set(xlabel=at_label, ylabel=measurement.output)
    axes[0].legend()
    axes[1].plot(t, r, ".", ms=4)
    axes[1].axhspan(-1.96, 1.96, alpha=0.15)
    axes[1].set(xlabel=at_label, ylabel="residual / noise", title=f"chi² {found.chi_square:.4g} of {found.degrees:.4g}")
    shown = found.intervals and found.residuals_fit
    for i, label in enumerate(found.labels if found.intervals else []):
        low, high = (end[i] / found.numbers[i] for end in ends(found.intervals))
        axes[2].plot(*([low, high], [i, i], "|-") if shown else ([1], [i], "o"))
        axes[2].annotate(
            f"{label} {found.numbers[i]:.5g}", (1, i), xytext=(0, 6), textcoords="offset points", ha="center"
        )
    none = "no intervals: the fit does not explain the data"
    label = "95 % interval over the estimate" if found.residuals_fit else none
    axes[2].set(xlabel=label, yticks=[], ylim=(-0.5, len(found.labels) - 0.3))
    if found.headline:
        figure.suptitle("\n".join(textwrap.wrap(found.headline, 150)), color="tab:red", fontsize=9)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)
