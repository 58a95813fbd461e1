"""Inputs that have a number for each tetrahedron, given by named sets: {"soft": 2e4}, and gradients by the same names.

The number x_s of a set acts on its tetrahedra, so its gradient is the sum of theirs, dL/dx_s = sum_{e in s} dL/dx_e.
Tetrahedra of no set that is named keep the scene's values; the set "default" names them.

And the shape of the whole body as one input of runs, `shape`, which moves rest and initial positions together. Fixed
vertices stay at `initial_positions`, so a change of `rest_positions` alone strains the body at its supports, and the
gradient by it is mostly of that strain. What a designer changes moves both, and has the sum of their gradients.
"""

from collections.abc import Iterable, Mapping

import numpy as np

from diffsim_ti.common.checked import as_numbers, instance, shown
from diffsim_ti.scene import Scene

Rows = dict[str, np.ndarray]  # tetrahedra of each set
MOVED = "initial_positions", "rest_positions"


def rows_of_sets(scene: Scene, name: str, sets: Iterable[str]) -> Rows:
    """The tetrahedra of each set that an input is given by. Raises ValueError for what has no number per tetrahedron, for
    unknown sets, and for sets that share tetrahedra."""
    mesh, described = scene.mesh, scene.inputs.described.get(name)
    if described is None:
        raise ValueError(scene.inputs.no_input(name, "this scene", scene.inputs.described))
    _rule(scene, name)
    out, owner = {}, np.full(mesh.num_tetrahedra, -1)
    named = [key for key in sets if key != "default"]
    for k, key in enumerate(named):
        if key not in mesh.tetrahedron_sets:
            known = ", ".join(map(repr, mesh.tetrahedron_sets)) or "none"
            raise ValueError(f"{name}: the mesh has no tetrahedron set {shown(key)} (it has: {known})")
        rows = out[key] = np.asarray(mesh.tetrahedron_sets[key])
        taken = rows[owner[rows] >= 0]
        if len(taken):
            other = named[owner[taken[0]]]
            raise ValueError(f"{name}: tetrahedron {taken[0]} is in both {other!r} and {key!r}; make the sets disjoint")
        owner[rows] = k
    if "default" in sets:
        out["default"] = np.flatnonzero(owner < 0)
    return out


def _rule(scene: Scene, name: str) -> tuple:
    """The shape of an input that has a row for each tetrahedron."""
    for rule in scene.inputs.described[name].shapes:
        if rule[:1] == ("tetrahedra",):
            return rule
    raise ValueError(f"{name}: has no numbers per tetrahedron, so give an array or a number instead of named sets")


def per_tetrahedron(scene: Scene, name: str, value: np.ndarray) -> np.ndarray:
    """A copy of an input's value with a row for each tetrahedron."""
    rule = _rule(scene, name)
    tail = value.shape[1:] if value.ndim == len(rule) else value.shape
    return np.array(np.broadcast_to(value, (scene.mesh.num_tetrahedra, *tail)), np.float64)


def spread(scene: Scene, name: str, base: np.ndarray, numbers: Mapping, rows: Rows) -> np.ndarray:
    """The values of all tetrahedra: `base` where no set is named."""
    out = per_tetrahedron(scene, name, base)
    for key, own in rows.items():
        number = as_numbers(f"{name}[{key!r}]", numbers[key])
        if number.shape != out.shape[1:]:
            raise ValueError(f"{name}[{key!r}]: expected shape {out.shape[1:]}, got {number.shape}")
        out[own] = number
    return out


def spread_all(
    scene: Scene, bases: Mapping, values: Mapping, known: Mapping[str, Rows] | None = None
) -> tuple[dict, dict[str, Rows]]:
    """(values with arrays instead of named sets, sets of the inputs that were given by them); known: sets of a run."""
    out, sets = dict(values), {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            run = (known or {}).get(name, {})
            sets[name] = {k: run[k] for k in value} if value.keys() <= run.keys() else rows_of_sets(scene, name, value)
            out[name] = spread(scene, name, bases[name], value, sets[name])
    return out, sets


def gathered(gradient: np.ndarray, rows: Rows) -> dict[str, np.ndarray]:
    """Gradients by the numbers of sets, from those by tetrahedra."""
    return {key: gradient[own].sum(0) for key, own in rows.items()}


def change_like(name: str, change, shape: tuple) -> np.ndarray:
    """A change of an input as a finite array of the input's shape, to which smaller ones are spread."""
    change = as_numbers(f"change of {name}", change)
    if not np.all(np.isfinite(change)):
        raise ValueError(f"change of {name} must be finite, got {shown(change)}")
    try:
        return np.broadcast_to(change, shape)
    except ValueError:
        raise ValueError(f"change of {name}: expected the input's shape {shape}, got {change.shape}") from None


def split_name(name: str) -> tuple[str, str | None]:
    """ "youngs_modulus[soft]" as (input, set); a plain name as (name, None)."""
    plain, bracket, rest = instance("field", "name", name, str, "that of an input or output").partition("[")
    return (plain, rest[:-1]) if bracket and rest.endswith("]") else (name, None)


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
