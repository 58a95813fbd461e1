"""Inputs of a batch as they are given: which scenes have of their own, and which they share; by named sets, {"soft": 2e4}
for all scenes or {"soft": [...]} with a number for each, and gradients by the same names (rollout/set_values.py)."""

from collections.abc import Mapping

import numpy as np

from diffsim_ti.batch.sweep import BatchValues, Own, value_of
from diffsim_ti.common.checked import as_numbers
from diffsim_ti.rollout.rollout import Rollout
from diffsim_ti.rollout.set_values import Rows, change_like, gathered, per_tetrahedron, rows_of_sets, spread
from diffsim_ti.scene import Scene


def spread_given(scene: Scene, given: dict, bases: dict, scenes: int) -> tuple[dict, dict]:
    """(values as arrays, {input given by named sets: (tetrahedra of each, those that scenes have of their own)})"""
    out, sets = dict(given), {}
    for name, value in given.items():
        if isinstance(value, Mapping):
            out[name], *sets[name] = spread_scenes(scene, name, bases.get(name), value, scenes)
    return out, sets


def checked_values(one: Rollout, given: dict, scenes: int) -> dict:
    """All values of a run: what was given, checked, those of scenes as `Own`, and the rollout's own."""
    inputs, out = one.scene.inputs, BatchValues(one.values)
    unknown = [name for name in given if name not in one.inputs]
    if unknown:
        raise ValueError(one.scene.inputs.no_input(unknown[0], "this batch", one.inputs))
    for name, value in given.items():
        inputs.warn_if_coarse(name, value)
        if isinstance(value, Own) or _is_own(one, name, value := as_numbers(name, value), scenes):
            whole = np.array(value, np.float64)
            whole.flags.writeable = False
            described = inputs.described[name]
            if not described.allows(whole) or not described.fits(whole.shape[1:], inputs.sizes):
                for row in whole:  # says what is wrong
                    inputs.check({name: row})
            out[name] = Own(whole)
        else:
            known = out[name]
            same = value.shape == known.shape and np.array_equal(value, known)
            out[name] = known if same else inputs.check({name: value.copy()})[name]
        inputs.check_steps({name: value_of(out[name], 0)}, one.steps)  # rows of scenes have one shape
    return out


def _is_own(one: Rollout, name: str, value: np.ndarray, scenes: int) -> bool:
    """Whether a value has the axis of scenes in front."""
    described, sizes = one.scene.inputs.described[name], one.scene.inputs.sizes
    shared = described.fits(value.shape, sizes)
    own = value.ndim > 0 and len(value) == scenes and described.fits(value.shape[1:], sizes)
    exact = sizes | {"steps": one.steps, "steps + 1": one.steps + 1}  # and no rows of forces that no step takes
    if own and described.fits(value.shape, exact):
        raise ValueError(
            f"{name}: shape {value.shape} may be one value for all scenes or one for each of {scenes}: give "
            f"np.broadcast_to(x, {(scenes, *value.shape)}) if all share it, np.broadcast_to(x[:, None], "
            f"{(scenes, *value.shape)}) if each has its own"
        )
    if not shared and not own:
        raise ValueError(
            f"{name}: expected {described.expected(sizes)}, or the same behind an axis of {scenes} scenes, got {value.shape}"
        )
    return own


def change_of(name: str, tangent, value, b: int, scenes: int) -> np.ndarray:
    """The change of scene b's value: that of the shared one, or its own."""
    tangent, shape = as_numbers(f"change of {name}", tangent), np.shape(value_of(value, b))
    if isinstance(value, Own) or tangent.shape == (scenes, *shape):
        return change_like(name, tangent, (scenes, *shape))[b]
    return change_like(name, tangent, shape)


def own_sets(scene: Scene, name: str, base: np.ndarray, numbers: Mapping, scenes: int) -> frozenset:
    """The sets whose numbers have the axis of scenes in front. Raises ValueError for shapes that fit neither way."""
    tail, out = per_tetrahedron(scene, name, base).shape[1:], set()
    for key, number in numbers.items():
        shape = np.shape(number)
        if shape not in (tail, (scenes, *tail)):
            raise ValueError(
                f"{name}[{key!r}]: expected shape {tail}, or {(scenes, *tail)} for {scenes} scenes, got {shape}"
            )
        if shape != tail:
            out.add(key)
    return frozenset(out)


def spread_scenes(scene: Scene, name: str, base, numbers: Mapping, scenes: int) -> tuple[np.ndarray, Rows, frozenset]:
    """(values of all tetrahedra, with the axis of scenes where one set or the base has it; sets; those with the axis)"""
    rows = rows_of_sets(scene, name, numbers)
    own = own_sets(scene, name, value_of(base, 0), numbers, scenes)
    of = lambda b: {key: np.asarray(x)[b] if key in own else x for key, x in numbers.items()}  # noqa: E731
    if not own and not isinstance(base, Own):
        return spread(scene, name, base, numbers, rows), rows, own
    return np.stack([spread(scene, name, value_of(base, b), of(b), rows) for b in range(scenes)]), rows, own


def gathered_scenes(gradient: np.ndarray, value, rows: Rows, own: frozenset) -> dict[str, np.ndarray]:
    """Gradients by the numbers of sets, those that scenes share summed over them in their order."""
    if not isinstance(value, Own):
        return gathered(gradient, rows)
    each = [gathered(row, rows) for row in gradient]
    out = {key: [row[key] for row in each] for key in rows}
    return {key: np.stack(x) if key in own else sum(x[1:], x[0]) for key, x in out.items()}
