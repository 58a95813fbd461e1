"""A floor: the barrier of the plane at a height along x, y or z."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import Up, upwards
from diffsim_ti.inputs import Input
from diffsim_ti.runtime import traced
from diffsim_ti.terms.obstacles import shapes
from diffsim_ti.terms.obstacles.obstacle import Obstacle, ObstacleForce
from diffsim_ti.terms.over_time import Motion


@dataclass(frozen=True)
class GroundForce(ObstacleForce):
    """d = y - height, or of another axis, or of its opposite (sign -1)."""

    axis: int = 1
    sign: int = 1

    count = 1
    lanes = True
    hollow = True

    @traced
    def distance_and_normal(self, g, p, X, u):
        n = [g.number(self.sign if d == self.axis else 0) for d in range(3)]
        if self.sign < 0:
            return (g.number(0) - X[self.axis]) - p[0] - u[self.axis], n
        return (X[self.axis] - p[0]) + u[self.axis], n


class Ground(Obstacle):
    """Floor y = height [m], which acts on surface vertices through the barrier of their distance d = y - height.

    up: the direction that the height is measured along: "y", "x", "z", "-x", "-y" or "-z", as in `Gravity`. With "z" it is
    the floor z = height, with "-z" the plane -z = height, solid where -z is smaller. Pictures and films have y up: they draw
    such a floor as a square.
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

    def __init__(
        self,
        height: float = 0.0,
        stiffness: float | None = None,
        width: float | None = None,
        friction: float = 0.0,
        friction_speed: float = 1e-3,
        path: Motion | None = None,
        name: str | None = None,
        stiffness_per_area: float | None = None,
        about: ArrayLike | None = None,
        up: Up = "y",
    ):
        self.up, (self.axis, self.sign) = up, upwards("Ground", up)
        shape = [Input("height", height, ((),), "m", plain="ground_height", axes="xyz"[self.axis])]
        contact = stiffness, width, friction, friction_speed, path, name, stiffness_per_area, about
        super().__init__(shape, *contact)

    def __repr__(self) -> str:
        return super().__repr__() if self.up == "y" else super().__repr__().replace("(", f"(up={self.up!r}, ", 1)

    @property
    def height(self) -> float:
        """Height [m] along `up`, where it was made."""
        return float(self.values["ground_height"])

    def distance(self, positions: np.ndarray) -> np.ndarray:
        return self.sign * positions[:, self.axis] - self.height

    def shift(self, origin: np.ndarray) -> np.ndarray:
        """A height along an axis that points down has what the origin has less."""
        out = super().shift(origin)
        out[0] *= self.sign
        return out

    @property
    def variant(self) -> tuple:
        return (*super().variant, self.up)

    def kernel(self, precision: str) -> GroundForce:
        return self.counterpart(precision, self.has_friction, self.axis, self.sign)

    def floor_height(self):
        return self.height if self.up == "y" else None

    def _refuse(self, gap: np.ndarray, surface: np.ndarray) -> None:
        raise ValueError(
            f"the body starts below or on the ground: vertex {surface[gap.argmin()]} is at {gap.min():.3g} m above "
            f"{self.up} = {self.height:g} ({(gap <= 0).sum()} vertices); lift the body or lower the ground"
        )

    def surface(self, size):
        """A square, of one that turns or whose up is not y."""
        if self.floor_height() is not None and not self.turns:
            return None
        normal, point = self.sign * np.eye(3)[self.axis], np.array(self.about)
        point[self.axis] = self.sign * self.height
        return shapes.square(point, normal, size)
