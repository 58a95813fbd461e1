"""What of gases and cables over time a stable step has to follow."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from diffsim_ti.mechanics.interaction import Interaction
    from diffsim_ti.scene import Scene
    from diffsim_ti.terms import Term


def over_time(scene: "Scene") -> "list[tuple[Interaction, Term]]":
    """(interaction, term) of each whose stiffness may change over time."""
    return [(x, term) for x in scene.interactions for term in x.stiff_over_time]


def stiffest(scene: "Scene", values: dict) -> dict[str, np.ndarray]:
    """Values in which gases have their largest pressure, cables their largest tension and least length, of all steps that
    are given, of all keyframes, or of the times at which `values` sample a function; of one that they do not, at time 0."""
    out = dict(values)
    for x, term in over_time(scene):
        name = scene.input_names(term)[term.plain]
        rows = [np.ravel(values[name])] if name in values else []
        if term.keyed:
            rows.append(np.ravel(term.rows([0.0] if callable(term.given) else term.given[0])))
        extreme = np.concatenate(rows).min() if term.plain in x.least else np.concatenate(rows).max()
        out[name] = np.array([extreme]) if term.keyed else np.array(extreme)
    return out


def sampled_by_runs(scene: "Scene") -> bool:
    """Whether some of them is a function of time, which a run alone samples."""
    return any(term.keyed and callable(term.given) for _, term in over_time(scene))
