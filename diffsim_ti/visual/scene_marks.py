"""What is drawn of a scene's terms at a moment of a run, and of results as arrows."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.common.public import public
from diffsim_ti.scene import Scene
from diffsim_ti.terms.marks import Arrows, Mark, Moment, arrows

if TYPE_CHECKING:
    from diffsim_ti.visual.frame import Frame

OF_A_RESULT = 200  # arrows that are drawn of one


@public
def marks_of(
    scene: Scene, positions: np.ndarray, time: float = 0.0, step: int = 0, values: Mapping | None = None
) -> list[Mark]:
    """What the terms of a scene say that is drawn of them (`Term.drawn`) at positions [m], shape (num_vertices, 3).

    time [s]; step: how many steps were done, for what is given for each: it shows those of the step that ends there.
    values: {name of an input: value} of the run, default the scene's own.
    """
    x = np.asarray(positions, np.float64)
    known, out = scene.inputs.at_times([time]) if values is None else values, []
    for k, term in enumerate(scene.terms):
        now = {}
        for plain, name in scene.inputs.names_of(k).items():
            if name in known:
                now[plain] = _at(np.asarray(known[name]), scene.inputs.described[name].shapes, step)
        out += term.drawn(Moment(scene.mesh, x, float(time), now))
    return [mark for mark in out if not isinstance(mark, Arrows) or len(mark.points)]


def _at(value: np.ndarray, shapes, step: int) -> np.ndarray:
    """What of a value holds after so many steps."""
    for rule in shapes:
        if len(rule) == value.ndim and rule and rule[0] in ("steps", "steps + 1"):
            return value[min(max(step - (rule[0] == "steps"), 0), len(value) - 1)]
    return value


def results_as_arrows(frame: "Frame", mesh, names: Sequence[str]) -> list[Mark]:
    """Arrows of some of a frame's fields, vectors of all vertices. Raises ValueError for another name or shape."""
    vectors = [name for name, value in frame.fields.items() if np.shape(value) == (mesh.num_vertices, 3)]
    out = []
    for name in names:
        if name not in vectors:
            known = ", ".join(vectors) or "none: pass such outputs to the Rollout"
            raise ValueError(f"arrows: {name!r} must be a vector of each vertex that frames hold; they hold {known}")
        unit = frame.units.get(name)
        label = name.replace("_", " ") + (f" [{unit}]" if unit else "")
        x, each = np.asarray(frame.positions, np.float64), range(mesh.num_vertices)
        out.append(replace(arrows(label, mesh, x, each, frame.fields[name], OF_A_RESULT), through=True))
    return [mark for mark in out if len(mark.points)]
