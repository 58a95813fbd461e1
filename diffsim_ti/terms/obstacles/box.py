"""Obstacles with edges: a box of any orientation and a cylinder."""

from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti.common.checked import numbers, shape_of
from diffsim_ti.inputs import POSITIVE, Input
from diffsim_ti.runtime import traced
from diffsim_ti.terms.obstacles import shapes
from diffsim_ti.terms.obstacles.ball import check_axis, radial
from diffsim_ti.terms.obstacles.obstacle import BOW, Obstacle, ObstacleForce, ObstacleOptions
from diffsim_ti.terms.obstacles.primitives import BOX, PrismPrimitives
from diffsim_ti.terms.term import extent, place


@traced
def corner(g, q):
    """Distance of a point to the region where all q <= 0, by its signed distances q to the sides, and its derivatives.

    Outside |max(q, 0)|, inside the largest q.
    """
    outside = [g.maximum(k, 0) for k in q]
    length = g.sqrt(g.dot(outside, outside))
    nearest = q[0]
    for k in q[1:]:
        nearest = g.maximum(nearest, k)
    is_outside = nearest.value > 0
    by, found = [], ti.cast(0, ti.i32)
    for k, out in zip(q, outside):
        chosen = ti.select(k.value == nearest.value, 1 - found, 0)  # the first of equal ones
        found = found + chosen
        by.append(g.select(is_outside, out / length, ti.cast(chosen, g.fp)))
    return g.select(is_outside, length, nearest), by


@dataclass(frozen=True)
class BoxForce(ObstacleForce):
    """Of y = R^T (x - center): d of |y| - half sizes (see `corner`); R the rotation of a quaternion (w, x, y, z)."""

    count = 10

    @traced
    def distance_and_normal(self, g, p, X, u):
        center, size, quaternion = p[:3], p[3:6], p[6:]
        r = [(x - c) + y for x, c, y in zip(X, center, u)]
        R = rotation(g, quaternion)
        y = [g.dot([R[d][k] for d in range(3)], r) for k in range(3)]
        signs = [ti.select(k.value < 0, ti.cast(-1, g.fp), ti.cast(1, g.fp)) for k in y]
        d, by = corner(g, [k * s - half * 0.5 for k, s, half in zip(y, map(g.leaf, signs), size)])
        local = [k * s for k, s in zip(by, map(g.leaf, signs))]
        return d, [g.dot(R[d], local) for d in range(3)]


@traced
def rotation(g, q):
    """Rows of the rotation matrix of a quaternion (w, x, y, z) of any length."""
    w, x, y, z = q
    two = g.number(2) / g.dot(q, q)
    one = g.number(1)
    return [
        [one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)],
    ]


class Box(Obstacle):
    """A box: center [m], size [m] of its three sides, turned by `rotation`, a vector along the axis whose length is the
    angle [rad].

    Inputs with gradient: "box_center", "box_size", shape (3,), "box_rotation" (a quaternion w, x, y, z, shape (4,)), and
    those of every `Obstacle`, whose other arguments it takes. Its distance is C1 outside; at the edges' regions the
    contact's stiffness jumps.
    """

    counterpart, all_primitives = BoxForce, BOX

    def __init__(
        self,
        center: ArrayLike = (0.0, 0.0, 0.0),
        size: ArrayLike = (1.0, 1.0, 1.0),
        rotation: ArrayLike = (0.0, 0.0, 0.0),
        **options: Unpack[ObstacleOptions],
    ):
        size = np.broadcast_to(numbers("Box: size", size), (3,)) if shape_of("Box: size", size) == () else size
        turn = numbers("Box: rotation", rotation)
        if turn.shape != (3,) or not np.all(np.isfinite(turn)):
            raise ValueError(f"Box: rotation must be 3 finite numbers, axis times angle [rad], got {rotation}")
        angle = np.linalg.norm(turn)
        quaternion = [np.cos(angle / 2), *(0.5 * np.sinc(angle / 2 / np.pi) * turn)]
        sides = Input("size", size, ((3,),), "m", POSITIVE, plain="box_size")
        turned = Input("rotation", quaternion, plain="box_rotation")
        super().__init__([place("center", center, "box_center"), sides, turned], **options)

    def distance(self, positions):
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_quat(np.roll(self.values["box_rotation"], -1))
        q = np.abs(turn.inv().apply(positions - self.values["box_center"])) - self.values["box_size"] / 2
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)

    def surface(self, size):
        return shapes.box(self.values["box_center"], self.values["box_size"], self.values["box_rotation"])


@dataclass(frozen=True)
class CylinderForce(ObstacleForce):
    """d of (distance to the axis - radius, distance along it to the nearer end), see `corner`."""

    count = 7

    @traced
    def distance_and_normal(self, g, p, X, u):
        start, end, radius = p[:3], p[3:6], p[6]
        axis = [b - a for a, b in zip(start, end)]
        length = g.sqrt(g.dot(axis, axis))
        along = [a / length for a in axis]
        r = [(x - c) + y for x, c, y in zip(X, start, u)]
        height = g.dot(r, along)
        across, out = radial(g, [x - height * a for x, a in zip(r, along)])
        middle = height - length * 0.5
        sign = g.leaf(ti.select(middle.value < 0, ti.cast(-1, g.fp), ti.cast(1, g.fp)))
        d, (by_radius, by_height) = corner(g, [across - radius, middle * sign - length * 0.5])
        return d, [by_radius * a + by_height * sign * b for a, b in zip(out, along)]


class Cylinder(Obstacle):
    """A cylinder with flat ends: `start` and `end` [m] of its axis, radius [m].

    Inputs with gradient: "cylinder_start", "cylinder_end", shape (3,), "cylinder_radius", and those of every `Obstacle`,
    whose other arguments it takes.
    """

    counterpart, all_primitives = CylinderForce, PrismPrimitives.of(np.eye(3)[1], 1.0, 1.0)

    def __init__(self, start: ArrayLike, end: ArrayLike, radius: float, **options: Unpack[ObstacleOptions]):
        ends = place("start", start, "cylinder_start"), place("end", end, "cylinder_end")
        super().__init__([*ends, extent("radius", radius, "cylinder_radius")], **options)
        check_axis(self, "cylinder_start", "cylinder_end")

    def primitives_for(self, mesh, width):
        start, end, radius = self.values["cylinder_start"], self.values["cylinder_end"], self.values["cylinder_radius"]
        return PrismPrimitives.of(end - start, float(radius), BOW * width)

    def distance(self, positions):
        a, b = self.values["cylinder_start"], self.values["cylinder_end"]
        length = np.linalg.norm(b - a)
        height = (positions - a) @ (b - a) / length
        across = np.linalg.norm(positions - a - height[:, None] * (b - a) / length, axis=1)
        q = np.stack([across - self.values["cylinder_radius"], np.abs(height - length / 2) - length / 2], 1)
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)

    def surface(self, size):
        values = self.values
        ends = values["cylinder_start"], values["cylinder_end"]
        return shapes.tube(*ends, float(values["cylinder_radius"]), rounded=False)
