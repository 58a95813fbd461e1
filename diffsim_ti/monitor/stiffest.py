"""What of gases and cables over time a stable step has to follow."""

import numpy as np

from diffsim_ti.scene import Scene
from diffsim_ti.terms import Term


def over_time(scene: Scene) -> list[Term]:
    """Terms whose stiffness may change over time."""
    return [term for term in scene.terms if term.stiffest is not None]


def stiffest(scene: Scene, values: dict) -> dict[str, np.ndarray]:
    """Values in which gases have their largest pressure, cables their largest tension and least length, of all steps that
    are given, of all keyframes, or of the times at which `values` sample a function; of one that they do not, at time 0."""
    out = dict(values)
    for term in over_time(scene):
        name = scene.input_names(term)[term.plain]
        rows = [np.ravel(values[name])] if name in values else []
        if term.keyed:
            rows.append(np.ravel(term.rows([0.0] if callable(term.given) else term.given[0])))
        extreme = term.stiffest(np.concatenate(rows))
        out[name] = np.array([extreme]) if term.keyed else np.array(extreme)
    return out


def sampled_by_runs(scene: Scene) -> bool:
    """Whether some of them is a function of time, which a run alone samples."""
    return any(term.keyed and callable(term.given) for term in over_time(scene))
