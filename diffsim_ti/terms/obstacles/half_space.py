"""A plane of any orientation, solid on one side."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti.common.checked import present
from diffsim_ti.common.origin import far_part
from diffsim_ti.inputs import Input
from diffsim_ti.inputs.links import NearestPoint
from diffsim_ti.runtime import traced
from diffsim_ti.terms.obstacles import shapes
from diffsim_ti.terms.obstacles.obstacle import Obstacle, ObstacleForce, ObstacleOptions
from diffsim_ti.terms.term import place


@dataclass(frozen=True)
class HalfSpaceForce(ObstacleForce):
    """d = n . (x - point), n the normal made unit."""

    count = 6
    lanes = True
    hollow = True

    @traced
    def distance_and_normal(self, g, p, X, u):
        point, normal = p[:3], p[3:]
        length = g.sqrt(g.dot(normal, normal))
        n = [k / length for k in normal]
        return g.dot(n, [(x - c) + y for x, c, y in zip(X, point, u)]), n


class HalfSpace(Obstacle):
    """All space below a plane: point [m] lies on the plane, normal points out of the solid (of any length).

    Inputs with gradient: "half_space_point", "half_space_normal", shape (3,), and those of every `Obstacle`, whose other
    arguments it takes.
    """

    counterpart = HalfSpaceForce

    def __init__(
        self,
        point: ArrayLike = (0.0, 0.0, 0.0),
        normal: ArrayLike = (0.0, 1.0, 0.0),
        **options: Unpack[ObstacleOptions],
    ):
        present("normal", normal)
        turn = Input("normal", normal, ((3,),), plain="half_space_normal")
        super().__init__([place("point", point, "half_space_point"), turn], **options)
        if not np.linalg.norm(self.values["half_space_normal"]) > 0:
            raise ValueError("HalfSpace: normal must not be zero; pass the direction that points out of the solid")

    def distance(self, positions):
        n = self.values["half_space_normal"]
        return (positions - self.values["half_space_point"]) @ (n / np.linalg.norm(n))

    def nearer(self, origin, length, names, own):
        n, away = self.values["half_space_normal"], self.values["half_space_point"] - origin
        if not far_part(away - n * (n @ away) / (n @ n), length).any():
            return []
        return [NearestPoint(names["half_space_point"], names["half_space_normal"], f"{own} point", origin)]

    def floor_height(self):
        upwards = np.allclose(shapes.unit(self.values["half_space_normal"]), [0, 1, 0])
        return float(self.values["half_space_point"][1]) if upwards else None

    def surface(self, size):
        """A square; a floor that does not turn is drawn as one."""
        if self.floor_height() is not None and not self.turns:
            return None
        return shapes.square(self.values["half_space_point"], self.values["half_space_normal"], size)
