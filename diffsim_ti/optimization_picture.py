"""A picture of an optimisation: how the loss fell, where the parameters went, and the body found over its target."""

import numpy as np

CURVE, START, FOUND, TARGET = "#1f5fa8", "#b8b8b8", "#6fa8dc", "#d1495b"


def optimization_figure(losses, parameters: dict, mesh, found, target, start=None, truth: dict | None = None,
                        loss_label: str = "loss", plane: str = "xy", size=(1200, 400)):  # fmt: skip
    """A matplotlib figure of three panels; `size` in pixels.

    losses: shape (n,), one per evaluation, drawn on a logarithmic axis.
    parameters: {name with unit: values}, shapes (n,) or (n, k); each name gets a panel. truth: {name: the value to find}.
    mesh, found: the body and its positions at the end [m], shape (num_vertices, 3), seen along the axis that `plane` lacks;
        start: its positions at the first evaluation.
    target: the positions wanted [m]: of all vertices, drawn as edges, or some points, shape (m, 3), drawn as crosses.
    Raises ValueError for shapes that do not fit and for numbers that are not finite, or losses not above zero.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    losses = _finite("losses", losses)
    if losses.ndim != 1 or not losses.size or losses.min() <= 0:
        raise ValueError(f"losses: must be a row of numbers > 0 for a logarithmic axis, got shape {losses.shape} with "
                         f"least {losses.min(initial=np.inf):g}; leave out what is exact")  # fmt: skip
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
    panels[0].semilogy(evaluations, losses, "o-", color=CURVE, markersize=4)
    panels[0].set(xlabel="evaluation", ylabel=loss_label)
    for panel, (name, values) in zip(panels[1:], parameters.items()):
        values = _finite(name, values)
        if values.ndim not in (1, 2) or len(values) != len(losses):
            raise ValueError(f"{name}: must have one row for each of the {len(losses)} losses, got shape {values.shape}")
        _curves(panel, evaluations, values, name, (truth or {}).get(name))
    _overlay(panels[-1], mesh, shown, _finite("target", target), plane)
    for panel in panels[:-1]:
        panel.grid(alpha=0.3)
        panel.xaxis.get_major_locator().set_params(integer=True)
    return figure


def save_optimization(path, *arguments, **options) -> None:
    """Write `optimization_figure` of the arguments in the format of the suffix (PNG, SVG, PDF ...)."""
    optimization_figure(*arguments, **options).savefig(path)


def _finite(name: str, values) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name}: must be finite, got {values[~np.isfinite(values)][0]}; draw up to where it diverged")
    return values


def _curves(panel, evaluations, values, name: str, truth) -> None:
    """Each column of the values over the evaluations, and dashed what they should become."""
    columns = values.reshape(len(values), -1)
    styles = ("o-", "s-", "^-", "d-")
    for k, column in enumerate(columns.T):
        label = f"component {k + 1}" if columns.shape[1] > 1 else "found"
        panel.plot(evaluations, column, styles[k % len(styles)], color=CURVE, markersize=4, label=label)
    if truth is not None:
        for k, value in enumerate(np.ravel(truth)):
            panel.axhline(value, color=TARGET, linestyle="--", label=None if k else "truth")
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
        panel.plot(*target[:, axes].T, "x", color=TARGET, markersize=6, label="target")
    panel.set(xlabel=f"{plane[0]} [m]", ylabel=f"{plane[1]} [m]")
    panel.autoscale_view()
    panel.margins(0.08)
    panel.set_aspect("equal", adjustable="datalim")
    panel.legend(frameon=False, fontsize="small")
