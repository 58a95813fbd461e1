"""Frequencies of free vibration as an experiment: what a modal test, or a struck body, tells of a scene's numbers."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.common.checked import instance, whole
from diffsim_ti.common.public import Public
from diffsim_ti.inputs.description import InputValue
from diffsim_ti.outputs.modes import Modes, modes
from diffsim_ti.scene import Scene

START = ("initial_positions", "initial_velocities")


@dataclass(frozen=True)
class _Frequencies:
    k: int

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (self.k,)


class ModalTest(metaclass=Public):
    """An experiment for `identify` whose data are the k lowest frequencies [Hz] of small vibrations about the rest shape.

        r_i = (f_i(x) - d_i) / noise,        df = phi . (dK - lambda dM) phi / (8 pi^2 f)    (`modes`, in float64)

    Data: {"frequencies": values of shape (k,), ascending}, NaN where a mode was not heard; a free body's first six are 0 and
    tell nothing. Modes are taken by their order: where measured ones may lie in another, leave a gap between them, or start
    near. Of frequencies that coincide the mean is differentiated: measure all of a group or none, and cut none by k.
    What changes frequencies is found: moduli, density, rest shape, springs, foundations; neither loads nor contact.
    `forward` costs an eigenproblem, `tangents` and `vjp` a reverse sweep for each mode that was measured.

    Raises ValueError as `modes` does.
    Ewins, Modal Testing, 2nd ed., 2000, ch. 2; Magnus 1985, doi:10.1017/S0266466600011129.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_box((6, 2, 2), size=(0.5, 0.1, 0.1))
    >>> scene = ds.Scene(mesh, ds.LinearElastic(7e10, 0.33), 2700.0, fixed="xmin", precision="f64")
    >>> heard = ds.modes(scene.replace(density=2600.0), 4).frequencies
    >>> found = ds.identify(ds.ModalTest(scene, 4), {"frequencies": heard}, {"density": 2700.0}, noise=1.0)
    >>> print(f"{found.estimates['density']:.0f} kg/m^3")
    2600 kg/m^3
    """

    num_frames, times = 1, np.zeros(1)

    def __init__(self, scene: Scene, k: int):
        self.scene = instance("ModalTest", "scene", scene, Scene, "a Scene")
        self.k = whole("ModalTest: k", k)
        self.values = {name: x for name, x in scene.inputs.at_times([0.0]).items() if name not in START}
        self.inputs = tuple(self.values)
        self.outputs = {"frequencies": _Frequencies(self.k)}
        self._rows: tuple[Modes, dict[int, dict]] | None = None

    def __repr__(self) -> str:
        return f"ModalTest({self.scene!r}, {self.k})"

    def forward(self, **values: InputValue) -> Modes:
        """The modes with some of the scene's numbers replaced."""
        return modes(self.scene, self.k, **values)

    def _row(self, found: Modes, group: list[int]) -> dict[str, np.ndarray]:
        """Gradients of a group's mean frequency, kept for the last modes that were asked about."""
        if self._rows is None or self._rows[0] is not found:
            self._rows = found, {}
        rows = self._rows[1]
        if group[0] not in rows:
            by = np.zeros(self.k)
            if found.frequencies[group[0]]:
                by[group] = 1 / len(group)
            rows[group[0]] = found.gradients(by)
        return rows[group[0]]

    def tangents(self, found: Modes, **changes: InputValue) -> dict[str, np.ndarray]:
        """{"frequencies": their change}, shape (k,), for changes of inputs; of a group that coincides its mean's."""
        out = np.zeros(self.k)
        for group in found.groups:
            row = self._row(found, group)
            out[group] = sum(float((row[name] * np.asarray(change)).sum()) for name, change in changes.items())
        return {"frequencies": out}

    def vjp(self, found: Modes, frequencies: np.ndarray) -> dict[str, np.ndarray]:
        """Gradients by all inputs for those by the frequencies: the transpose of `tangents`."""
        out = {name: np.zeros(value.shape) for name, value in found.scene.inputs.at_times([0.0]).items()}
        for group in found.groups:
            weight = float(np.asarray(frequencies)[group].sum())
            for name, row in (self._row(found, group) if weight else {}).items():
                if name in out:
                    out[name] = out[name] + weight * row
        return out
