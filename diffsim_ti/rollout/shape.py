"""The shape of the whole body as one input of runs, `shape`, which moves rest and initial positions together.

Fixed vertices stay at `initial_positions`, so a change of `rest_positions` alone strains the body at its supports, and the
gradient by it is mostly of that strain. What a designer changes moves both, and has the sum of their gradients.
"""

from collections.abc import Mapping

import numpy as np

from diffsim_ti.common.checked import as_numbers

MOVED = "initial_positions", "rest_positions"


def spread_shape(given: Mapping, values: Mapping) -> dict:
    """The inputs of a run with `shape` [m], places at rest of all vertices, as what it moves: the start keeps its
    displacement from the rest shape. values: those of the rollout."""
    if "shape" not in given:
        return dict(given)
    _check_alone(given)
    shape = given["shape"] if hasattr(given["shape"], "detach") else as_numbers("shape", given["shape"])
    rest = values["rest_positions"]
    if tuple(shape.shape[-2:]) != rest.shape:
        raise ValueError(f"shape: expected places of all vertices, shape {rest.shape} [m], got {tuple(shape.shape)}")
    away = values["initial_positions"] - rest
    if not isinstance(shape, np.ndarray):
        away = shape.new_tensor(away)
    return {name: x for name, x in given.items() if name != "shape"} | dict(zip(MOVED, (shape + away, shape)))


def spread_change(tangents: Mapping) -> dict:
    """The same of changes of inputs."""
    if "shape" not in tangents:
        return dict(tangents)
    _check_alone(tangents)
    return {name: x for name, x in tangents.items() if name != "shape"} | dict.fromkeys(MOVED, tangents["shape"])


def with_shape(gradients: dict, asked: bool) -> dict:
    """Gradients with that by `shape`, where it is asked for."""
    return gradients | dict(shape=sum(gradients[name] for name in MOVED)) if asked else gradients


def _check_alone(given: Mapping) -> None:
    both = [name for name in (*MOVED, "initial_displacements") if name in given]
    if both:
        raise ValueError(f"shape moves initial_positions and rest_positions together: leave out {' and '.join(both)}")
