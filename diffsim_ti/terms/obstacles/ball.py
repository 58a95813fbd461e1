"""Round obstacles: a ball or the hollow inside of one, and a capsule."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti.runtime import traced
from diffsim_ti.terms.obstacles import shapes
from diffsim_ti.terms.obstacles.obstacle import Obstacle, ObstacleForce, ObstacleOptions
from diffsim_ti.terms.obstacles.primitives import BALL, CAPSULE
from diffsim_ti.terms.term import extent, place


def radial(g, r):
    """(|r|, r / |r|)"""
    length = g.sqrt(g.dot(r, r))
    return length, [k / length for k in r]


@dataclass(frozen=True)
class SphereForce(ObstacleForce):
    """d = |x - center| - radius, or radius - |x - center| inside a hollow one."""

    inside: bool = False

    count = 4
    lanes = True

    @property
    def hollow(self):
        return self.inside

    @traced
    def distance_and_normal(self, g, p, X, u):
        *center, radius = p
        length, n = radial(g, [(x - c) + y for x, c, y in zip(X, center, u)])
        if self.inside:
            return radius - length, [g.number(0) - k for k in n]
        return length - radius, n


class Sphere(Obstacle):
    """A ball, or with inside=True the inner surface of a hollow one (a bowl, seen from within): center, radius [m].

    Inputs with gradient: "sphere_center", shape (3,), "sphere_radius", and those of every `Obstacle`, whose other
    arguments it takes.
    """

    def __init__(
        self,
        center: ArrayLike = (0.0, 0.0, 0.0),
        radius: float = 1.0,
        inside: bool = False,
        **options: Unpack[ObstacleOptions],
    ):
        shape = place("center", center, "sphere_center"), extent("radius", radius, "sphere_radius")
        self.inside = bool(inside)
        self.all_primitives = None if inside else BALL
        super().__init__(shape, **options)

    def distance(self, positions):
        d = np.linalg.norm(positions - self.values["sphere_center"], axis=1) - self.values["sphere_radius"]
        return -d if self.inside else d

    def surface(self, size):
        """The ball, or of a hollow one the bowl that its lower half is, seen from within."""
        shape = shapes.bowl if self.inside else shapes.ball
        return shape(self.values["sphere_center"], float(self.values["sphere_radius"]))

    def least_radius(self):
        return np.inf if self.inside else float(self.values["sphere_radius"])

    @property
    def variant(self):
        return (*super().variant, self.inside)

    def kernel(self, precision):
        return SphereForce(precision, self.has_friction, self.inside)


@dataclass(frozen=True)
class CapsuleForce(ObstacleForce):
    """d = |x - nearest point of the segment a b| - radius."""

    count = 7
    lanes = True

    @traced
    def distance_and_normal(self, g, p, X, u):
        start, end, radius = p[:3], p[3:6], p[6]
        r = [(x - c) + y for x, c, y in zip(X, start, u)]
        axis = [b - a for a, b in zip(start, end)]
        share = g.minimum(g.maximum(g.dot(r, axis) / g.dot(axis, axis), 0), 1)
        length, n = radial(g, [x - share * a for x, a in zip(r, axis)])
        return length - radius, n


class Capsule(Obstacle):
    """A cylinder with round ends: all points within `radius` [m] of the segment from `start` to `end` [m].

    Inputs with gradient: "capsule_start", "capsule_end", shape (3,), "capsule_radius", and those of every `Obstacle`,
    whose other arguments it takes.
    """

    counterpart, all_primitives = CapsuleForce, CAPSULE

    def __init__(self, start: ArrayLike, end: ArrayLike, radius: float, **options: Unpack[ObstacleOptions]):
        ends = place("start", start, "capsule_start"), place("end", end, "capsule_end")
        super().__init__([*ends, extent("radius", radius, "capsule_radius")], **options)
        check_axis(self, "capsule_start", "capsule_end")

    def distance(self, positions):
        a, b = self.values["capsule_start"], self.values["capsule_end"]
        share = np.clip((positions - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        return np.linalg.norm(positions - a - share[:, None] * (b - a), axis=1) - self.values["capsule_radius"]

    def least_radius(self):
        return float(self.values["capsule_radius"])

    def surface(self, size):
        values = self.values
        return shapes.tube(
            values["capsule_start"], values["capsule_end"], float(values["capsule_radius"]), rounded=True
        )


def check_axis(term, start: str, end: str) -> None:
    """Raise ValueError if two ends are one point."""
    if not np.linalg.norm(term.values[end] - term.values[start]) > 0:
        raise ValueError(
            f"{type(term).__name__}: start and end must differ, got {term.values[start]} twice; use a Sphere"
        )
