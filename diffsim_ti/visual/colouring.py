"""From numbers to colours: which map, which limits, which label; and the fields of a state that they may show.

The maps are even in lightness and safe for the colour-blind: viridis for what starts at zero, PuOr about the middle value
for what goes both ways.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.outputs.deformation import PointMeans, von_mises
from diffsim_ti.rollout.simulator import Simulator

SIGNED = "PuOr"


@dataclass(frozen=True)
class Field:
    """A quantity to colour by: `middle` is the neutral value of a two-sided field, None for one that starts at zero."""

    label: str
    colours: str = "viridis"
    middle: float | None = None

    def limits(self, low: float, high: float) -> tuple[float, float]:
        """What the colours span for values from `low` to `high`: never empty, symmetric about `middle` if there is one."""
        if self.middle is None:
            low = min(0.0, low)
            return (low, high) if high > low else (low, low + 1.0)
        reach = max(abs(low - self.middle), abs(high - self.middle)) or 1.0
        return self.middle - reach, self.middle + reach


FIELDS = {
    "displacement": Field("displacement [m]"),
    "speed": Field("speed [m/s]"),
    "von_mises": Field("von Mises stress [Pa]"),
    "energy_density": Field("energy density [J/m^3]"),
    "plastic_strain": Field("equivalent plastic strain [-]"),
    "J": Field("volume ratio J [-]", "PuOr", 1.0),
    "stiffness": Field("Young's modulus [Pa]"),
    "gradient": Field("size of the gradient"),
}


def field_named(name: str) -> Field:
    """The field of that name. Raises ValueError for an unknown one."""
    if name not in FIELDS:
        raise ValueError(f"colour: must be one of {', '.join(FIELDS)}, got {name!r}; choose one of these")
    return FIELDS[name]


@dataclass(frozen=True)
class Colouring:
    """How values are coloured: label with unit, the numbers that the colours span, a matplotlib colour map."""

    label: str = ""
    limits: tuple[float, float] = (0.0, 1.0)
    map: str = "viridis"

    def __post_init__(self):
        from matplotlib import colormaps

        low, high = (float(x) for x in self.limits)
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise ValueError(f"limits of colours must be two finite numbers, the lower first, got {self.limits}")
        if self.map not in colormaps:
            raise ValueError(f"no matplotlib colour map is called {self.map!r}; viridis, cividis and PuOr read well")

    @classmethod
    def of(
        cls,
        values: ArrayLike,
        label: str = "",
        limits: tuple[float, float] | None = None,
        map: str | None = None,
        field: Field | None = None,
    ) -> "Colouring":
        """Map and limits that suit these numbers: 0 (or the least) to the 99.5th percentile; two-sided as the field says.

        Without a field, numbers of both signs are taken as two-sided about 0.
        """
        values = np.asarray(values, np.float64).ravel()
        if not values.size or not np.all(np.isfinite(values)):
            raise ValueError(
                "values to colour must be finite numbers, at least one; a diverged state cannot be coloured"
            )
        if field is None:
            field = Field(label, SIGNED, 0.0) if values.min() < 0 < values.max() else Field(label)
        if limits is None:
            least = values.min() if field.middle is None else np.percentile(values, 0.5)
            limits = field.limits(float(least), float(np.percentile(values, 99.5)))
        return cls(label or field.label, tuple(float(x) for x in limits), map or field.colours)

    def __call__(self, values) -> np.ndarray:
        """RGB in [0, 1], shape of `values` and 3."""
        from matplotlib import colormaps

        low, high = self.limits
        return colormaps[self.map](np.clip((np.asarray(values) - low) / (high - low), 0, 1))[..., :3]


def to_vertices(mesh: TetrahedralMesh, values: ArrayLike) -> np.ndarray:
    """One value per vertex: given so, or per tetrahedron and averaged, weighted by volume."""
    values = np.asarray(values, np.float64)
    if values.shape == (mesh.num_vertices,):
        return values
    if values.shape != (mesh.num_tetrahedra,):
        raise ValueError(
            f"values: expected one per vertex ({mesh.num_vertices}) or per tetrahedron ({mesh.num_tetrahedra}), "
            f"got shape {values.shape}"
        )
    num_nodes = mesh.elements.shape[1]
    at, weight = mesh.elements.ravel(), np.repeat(mesh.volumes, num_nodes)
    total = np.bincount(at, weight, mesh.num_vertices)
    return np.bincount(at, weight * np.repeat(values, num_nodes), mesh.num_vertices) / np.where(total > 0, total, 1)


def field_of(simulator: Simulator, name: str) -> np.ndarray:
    """A field of a simulator's state, per vertex or per tetrahedron; "gradient" is not the state's and must be given."""
    field_named(name)
    if name == "displacement":
        return np.linalg.norm(simulator.displacements, axis=1)
    if name == "speed":
        return np.linalg.norm(simulator.velocities, axis=1)
    if name == "stiffness":
        modulus = simulator.scene.inputs.values["youngs_modulus"]
        return np.broadcast_to(modulus, simulator.scene.mesh.num_tetrahedra)
    if name == "gradient":
        raise ValueError("a gradient is no field of the state; pass its size per vertex or tetrahedron as values")
    return measured_fields(simulator)[name]


def measured_fields(simulator: Simulator) -> dict[str, np.ndarray]:
    """von Mises stress [Pa], energy density [J/m^3] and J [-] of a state, and of a plastic law its equivalent plastic strain
    [-] (of ten nodes its mean over the points), per tetrahedron; of ten nodes the first is that at
    vertices, as `Stress(at="vertices", von_mises=True)` has it."""
    measured, mesh = simulator.tetrahedron_fields(), simulator.scene.mesh
    fields = {name: getattr(measured, name) for name in ("von_mises", "energy_density", "J")}
    if mesh.order == 2:
        means = simulator.workspace.kept("means at vertices", lambda: PointMeans.of_vertices(mesh, []))
        stress = measured.stress.reshape(1, -1, 3, 3)
        fields["von_mises"] = von_mises(means.value(stress, np.ones(stress.shape[1])))[0]
    if (law := simulator.scene.law).plastic:
        at_points = simulator.law_state[..., law.state_names.index("plastic_strain")]
        fields["plastic_strain"] = at_points.reshape(mesh.num_tetrahedra, -1).mean(1)
    return fields
