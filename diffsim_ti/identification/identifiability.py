"""Which inputs the frames' positions can determine at all: eigenvalues of the Fisher matrix."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from diffsim_ti.common.public import public
from diffsim_ti.inputs.description import InputValue
from diffsim_ti.rollout import Rollout


@dataclass(repr=False)
class Identifiability:
    """What the frames' positions tell of some inputs: eigenvalues of the Fisher matrix, smallest first, in m^2.

    directions[k]: {input: relative change}, of unit length together: along it a relative change eps moves the vertices of
    all frames by eps sqrt(eigenvalues[k]) [m] (Euclidean norm).
    """

    eigenvalues: np.ndarray
    directions: list[dict]
    resolution: float

    @property
    def num_singular(self) -> int:
        """Directions that the frames do not see: their eigenvalues are round-off beside the largest."""
        return int((self.eigenvalues <= self.resolution * self.eigenvalues[-1]).sum())

    def __str__(self) -> str:
        lines = []
        for k, (value, direction) in enumerate(zip(self.eigenvalues, self.directions)):
            parts = ", ".join(f"{name} {np.array2string(np.asarray(x), precision=3)}" for name, x in direction.items())
            lines.append(f"{value:10.3e} m^2 {'NOT SEEN' if k < self.num_singular else ''} {parts}")
        return "\n".join(lines)

    __repr__ = __str__


@public
def identifiability(
    rollout: Rollout, inputs: str | Iterable[str], groups: dict | None = None, **values: InputValue
) -> Identifiability:
    """Which inputs can be recovered from the frames' positions: eigenvalues and directions of the Fisher matrix J^T J.

    J, shape (3 frames vertices, parameters) [m], has a column x_j d positions / d x_j for each number x_j of the inputs, by
    `Rollout.jvp`: parameters are compared by relative changes, as in an optimisation of logarithms.
    groups: input name -> whole numbers, shape of that input: numbers of one group change together (E per region).
    With noise of deviation s [m] on every coordinate, a relative change along direction k is known to
    s / sqrt(eigenvalues[k]) (Cramer-Rao). Costs a tangent run per parameter; raises ValueError for inputs that are zero.
    Bates, Watts, Nonlinear Regression Analysis, 1988, ch. 2, doi:10.1002/9780470316757.
    """
    names = [inputs] if isinstance(inputs, str) else list(inputs)
    frames = rollout.forward(**values)
    columns, labels = [], []
    for name in names:
        if name not in frames.inputs:
            said = rollout.scene.inputs.no_input(name, "this rollout", rollout.inputs)
            raise ValueError(f"identifiability: {said}")
        value = np.asarray(frames.inputs[name])
        if not np.any(value):
            raise ValueError(f"identifiability: {name} is zero, so that relative changes of it mean nothing")
        group = np.asarray((groups or {}).get(name, np.arange(value.size).reshape(value.shape)))
        if group.shape != value.shape:
            raise ValueError(f"groups of {name}: expected shape {value.shape}, got {group.shape}")
        for k in np.unique(group):
            dx, _ = rollout.jvp(frames, **{name: np.where(group == k, value, 0.0)})
            columns.append(dx.ravel())
            labels.append(name)
    J = np.stack(columns, 1)
    _, sizes, directions = np.linalg.svd(J, full_matrices=False)  # not of J^T J, which would lose half the digits
    parts = [{name: d[np.array(labels) == name] for name in names} for d in directions[::-1]]
    resolution = (1e-9 if rollout.scene.precision == "f64" else 1e-4) ** 2
    return Identifiability(sizes[::-1] ** 2, parts, resolution)
