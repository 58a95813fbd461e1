"""A picture of an optimisation: how the loss fell, where the parameters went, and the body found over its target.

`OptimizationPicture` collects evaluations and writes at the end or while they are made; `optimization_figure` draws arrays.
"""

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.public import Public, public
from diffsim_ti.mesh import TetrahedralMesh

if TYPE_CHECKING:
    from matplotlib.figure import Figure


CURVES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")  # Okabe and Ito's, told apart by all eyes
START, FOUND, TARGET = "#b8b8b8", "#6fa8dc", "#d55e00"
LEAST = 1e-300  # a loss of nothing is drawn below the axis


class OptimizationPicture(metaclass=Public):
    """Evaluations of an optimisation, as they come, and their picture.

    mesh, target, truth, loss_label, plane, size: as in `optimization_figure`; path: where the picture goes.
    every [s]: with a path, `add` writes the picture when the last was written so long ago (0: each time; None: only
    `save` does). A picture takes some 0.3 s; it is replaced as a whole, so that who follows the file never sees half of it.
    """

    def __init__(
        self,
        mesh: TetrahedralMesh,
        target: ArrayLike,
        path: str | Path | None = None,
        every: float | None = None,
        truth: dict | None = None,
        loss_label: str = "loss",
        plane: str = "xy",
        size: tuple[int, int] = (960, 320),
    ):
        if every is not None and (path is None or not every >= 0):
            raise ValueError(f"every: must be >= 0 [s] and go with a path, got {every} and path {path}; leave it out")
        self.mesh, self.target, self.path, self.every = mesh, target, path and Path(path), every
        self.look = dict(truth=truth, loss_label=loss_label, plane=plane, size=size)
        self.losses, self.parameters, self.start, self.found = [], {}, None, None
        self._written = time.perf_counter()

    def add(self, loss: float, parameters: dict, positions: ArrayLike) -> None:
        """An evaluation: its loss, {name with unit: number or numbers}, and the body's positions [m], (num_vertices, 3)."""
        if self.losses and set(parameters) != set(self.parameters):
            raise ValueError(f"parameters: must be {sorted(self.parameters)} each time, got {sorted(parameters)}")
        self.losses.append(float(loss))
        for name, value in parameters.items():
            self.parameters.setdefault(name, []).append(np.array(value, np.float64))
        self.found = np.array(positions, np.float64)
        self.start = self.found if self.start is None else self.start
        if self.every is not None and time.perf_counter() - self._written >= self.every:
            self.save()

    def save(self, path: str | Path | None = None) -> None:
        """Write the picture to `path` or the one given at first."""
        if path is None and self.path is None:
            raise ValueError(
                "path: must be given here or to OptimizationPicture, got none; pass where the picture goes"
            )
        path = Path(path or self.path)
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_name(f".{os.getpid()}_{path.name}")
        bodies = self.mesh, self.found, self.target, self.start
        try:
            save_optimization(draft, self.losses, self.parameters, *bodies, **self.look)
            os.replace(draft, path)
        finally:
            draft.unlink(missing_ok=True)
        self._written = time.perf_counter()


@public
def save_optimization(
    path: str | Path,
    losses: ArrayLike,
    parameters: dict,
    mesh: TetrahedralMesh,
    found: ArrayLike,
    target: ArrayLike,
    start: ArrayLike | None = None,
    truth: dict | None = None,
    loss_label: str = "loss",
    plane: str = "xy",
    size: tuple[int, int] = (960, 320),
) -> None:
    """Write `optimization_figure` of the arguments, positions in [m], in the format of the suffix (PNG, SVG, PDF ...)."""
    figure = optimization_figure(losses, parameters, mesh, found, target, start, truth, loss_label, plane, size)
    figure.savefig(path)


@public
def optimization_figure(
    losses: ArrayLike,
    parameters: dict,
    mesh: TetrahedralMesh,
    found: ArrayLike,
    target: ArrayLike,
    start: ArrayLike | None = None,
    truth: dict | None = None,
    loss_label: str = "loss",
    plane: str = "xy",
    size: tuple[int, int] = (960, 320),
) -> "Figure":
    """A matplotlib figure: a panel for the loss, one for each parameter, one for the body; `size` in pixels.

    losses: shape (n,), one per evaluation, drawn on a logarithmic axis; a loss of nothing falls out of it below.
    parameters: {name with unit: values}, shapes (n,) or (n, k). truth: {name: the value to find}, drawn dashed.
    mesh, found: the body and its positions at the end [m], shape (num_vertices, 3), seen along the axis that `plane` lacks;
        start: its positions at the first evaluation.
    target: the positions wanted [m]: of all vertices, drawn as edges, or some points, shape (m, 3), drawn as crosses.
    Raises ValueError for shapes that do not fit, for numbers that are not finite, and for losses below zero.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    losses = _finite("losses", losses)
    if losses.ndim != 1 or not losses.size or losses.min() < 0:
        raise ValueError(
            f"losses: must be a row of numbers >= 0, got shape {losses.shape} with "
            f"least {losses.min(initial=np.inf):g}; add a constant to a loss that can be negative"
        )
    if len(plane) != 2 or len(set(plane) & set("xyz")) != 2:
        raise ValueError(f"plane: must be two of x, y, z, got {plane!r}; 'xy' is the view from the front")
    unknown = set(truth or {}) - set(parameters)
    if unknown:
        raise ValueError(f"truth: must name parameters, of which there are {sorted(parameters)}, got {sorted(unknown)}")
    shown = [("found", found, FOUND)] if start is None else [("start", start, START), ("found", found, FOUND)]

    count = len(parameters) + 2
    figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, count, width_ratios=[1] * (count - 1) + [1.3])
    evaluations = np.arange(1, len(losses) + 1)
    panels[0].plot(evaluations, np.maximum(losses, LEAST), "o-", color=CURVES[0], markersize=4)
    panels[0].set(xlabel="evaluation", ylabel=loss_label, yscale="log")
    if losses.max() > 0:
        panels[0].set_ylim(0.3 * losses[losses > 0].min(), 3 * losses.max())
    for panel, (name, values) in zip(panels[1:], parameters.items()):
        values = _finite(name, values)
        if values.ndim not in (1, 2) or len(values) != len(losses):
            rule = f"must have one row for each of the {len(losses)} losses"
            raise ValueError(f"{name}: {rule}, got shape {values.shape}")
        _curves(panel, evaluations, values, name, (truth or {}).get(name))
    _overlay(panels[-1], mesh, shown, _finite("target", target), plane)
    for panel in panels[:-1]:
        panel.grid(alpha=0.3)
        panel.xaxis.get_major_locator().set_params(integer=True)
    return figure


def _finite(name: str, values) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name}: must be finite, got {values[~np.isfinite(values)][0]}; draw up to where it diverged")
    return values


def _curves(panel, evaluations, values, name: str, truth) -> None:
    """Each column of the values over the evaluations, and dashed what they should become."""
    columns = values.reshape(len(values), -1)
    names = [f"component {k + 1}" for k in range(columns.shape[1])] if columns.shape[1] > 1 else ["found"]
    goals = None if truth is None else np.broadcast_to(np.ravel(truth), columns.shape[1])
    for k, column in enumerate(columns.T):
        colour = CURVES[k % len(CURVES)]
        panel.plot(evaluations, column, "o-", color=colour, markersize=4, label=names[k] if k < 6 else None)
        if goals is not None:
            panel.axhline(goals[k], color=colour, linestyle="--", label=None if k else "truth")
    if truth is not None or columns.shape[1] > 1:
        panel.legend(frameon=False, fontsize="small")
    panel.set(xlabel="evaluation", ylabel=name)


def _overlay(panel, mesh, shown, target, plane: str) -> None:
    """Silhouettes of the body and the target over them."""
    from matplotlib.collections import LineCollection, PolyCollection

    axes = ["xyz".index(letter) for letter in plane]
    for label, positions, colour in shown:
        positions = _finite(label, positions)
        if positions.shape != (mesh.num_vertices, 3):
            raise ValueError(f"{label}: must have shape ({mesh.num_vertices}, 3), as the mesh, got {positions.shape}")
        corners = positions[mesh.surface_triangles][..., axes]
        panel.add_collection(PolyCollection(corners, facecolor=colour, edgecolor=colour, linewidth=0.5, label=label))
    if target.ndim != 2 or target.shape[1] != 3:
        raise ValueError(f"target: must be points of shape (m, 3), got {target.shape}")
    if len(target) == mesh.num_vertices:
        pairs = np.concatenate([mesh.surface_triangles[:, [i, (i + 1) % 3]] for i in range(3)])
        edges = target[np.unique(np.sort(pairs, 1), axis=0)][..., axes]
        panel.add_collection(LineCollection(edges, color=TARGET, linewidth=0.7, label="target"))
    else:
        sign, size = ("x", 8) if len(target) <= 30 else (".", 2)
        panel.plot(*target[:, axes].T, sign, color=TARGET, markersize=size, markeredgewidth=2, label="target")
    panel.set(xlabel=f"{plane[0]} [m]", ylabel=f"{plane[1]} [m]")
    panel.autoscale_view()
    panel.margins(0.08)
    panel.set_aspect("equal", adjustable="datalim")
    panel.legend(frameon=False, fontsize="small")
