"""A floor: the barrier of the ground plane y = height."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.inputs import Input
from diffsim_ti.runtime import traced
from diffsim_ti.terms.obstacles import shapes
from diffsim_ti.terms.obstacles.obstacle import Obstacle, ObstacleForce


@dataclass(frozen=True)
class GroundForce(ObstacleForce):
    """d = y - height."""

    count = 1
    lanes = True
    hollow = True

    @traced
    def distance_and_normal(self, g, p, X, u):
        return (X[1] - p[0]) + u[1], [g.number(0), g.number(1), g.number(0)]


class Ground(Obstacle):
    """Floor y = height [m], which acts on surface vertices through the barrier of their distance d = y - height.

    Stiffness per area [N/m^3] (default: the scene chooses it) or stiffness of every vertex [N/m], width [m] (default: 1 % of
    the body), friction and path as for every `Obstacle`.
    Inputs with gradient: "ground_height", and those of every `Obstacle`.
    Raises ValueError for numbers out of range, or a body that starts on or below the floor.
    Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> floor = ds.Ground(height=-0.1, friction=0.4, name="floor")
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity(), floor], precision="f64")
    >>> [name for name in scene.inputs.described if name.startswith("floor.")]
    ['floor.height', 'floor.stiffness_per_area', 'floor.width', 'floor.friction', 'floor.friction_speed']
    """

    counterpart = GroundForce

    def __init__(self, height: float = 0.0, stiffness: float | None = None, width: float | None = None, **options):
        super().__init__(
            [Input("height", height, ((),), "m", plain="ground_height", axes="y")], stiffness, width, **options
        )

    def distance(self, positions: np.ndarray) -> np.ndarray:
        return positions[:, 1] - float(self.values["ground_height"])

    def floor_height(self):
        return float(self.values["ground_height"])

    def _refuse(self, gap: np.ndarray, surface: np.ndarray) -> None:
        raise ValueError(
            f"the body starts below or on the ground: vertex {surface[gap.argmin()]} is at {gap.min():.3g} m above y = "
            f"{float(self.values['ground_height']):g} ({(gap <= 0).sum()} vertices); lift the body or lower the ground"
        )

    def surface(self, size):
        """A square, of one that turns."""
        height = float(self.values["ground_height"])
        return shapes.square((self.about[0], height, self.about[2]), (0.0, 1.0, 0.0), size) if self.turns else None
