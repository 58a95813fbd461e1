"""Inputs of a batch by named sets, {"soft": 2e4} for all scenes or {"soft": [...]} with a number for each, and gradients by
the same names, as `Rollout` takes them (rollout/set_values.py)."""

from collections.abc import Mapping

import numpy as np

from diffsim_ti.batch.sweep import Own, value_of
from diffsim_ti.rollout.set_values import Rows, gathered, per_tetrahedron, rows_of_sets, spread
from diffsim_ti.scene import Scene


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
