"""A floor: the barrier of the ground plane y = height."""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from diffsim_ti.terms import barrier
from diffsim_ti.terms.term import Term, VertexForce


class Ground(Term):
    """Floor y = height [m], felt by surface vertices through the barrier of their distance d = y - height.

    Energy per vertex b(d) = -stiffness (d - width)^2 log(d / width) for d < width, exactly zero beyond, and its
    second-order Taylor polynomial below width / 1000 (see terms/barrier.py), so that a vertex that got past still is
    pushed out. stiffness [N/m], width [m]. No friction.
    Inputs with gradient: "ground_height", "barrier_stiffness", "barrier_width".
    Raises ValueError for stiffness <= 0, width <= 0, or a body that starts on or below the floor.
    Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425.
    """

    acts_on_surface = True

    def __init__(self, height: float = 0.0, stiffness: float = 1e4, width: float = 0.01):
        super().__init__(ground_height=height, barrier_stiffness=stiffness, barrier_width=width)
        for name, value in (("stiffness [N/m]", stiffness), ("width [m]", width)):
            if not float(value) > 0:
                raise ValueError(f"Ground: {name} must be > 0, got {value}")

    def gap(self, positions: np.ndarray) -> np.ndarray:
        """Distance to the floor [m] of each position."""
        return positions[:, 1] - float(self.values["ground_height"])

    def check_start(self, positions: np.ndarray, surface: np.ndarray) -> None:
        gap = self.gap(positions[surface])
        if gap.size and gap.min() <= 0:
            worst = surface[gap.argmin()]
            raise ValueError(
                f"the body starts below or on the ground: vertex {worst} is at {gap.min():.3g} m above y = "
                f"{float(self.values['ground_height']):g} ({(gap <= 0).sum()} vertices); lift the body or lower the ground"
            )

    def kernel(self, precision: str, first: int) -> "GroundForce":
        return GroundForce(precision, first)


@dataclass(frozen=True)
class GroundForce(VertexForce):
    """Compile-time twin of Ground; numbers (height, stiffness, width)."""

    size = 3

    @ti.func
    def scaled(self, parameters: ti.template(), X, u):
        """(d / width, stiffness, width)"""
        width = parameters[self.first + 2]
        return ((X.y - parameters[self.first]) + u.y) / width, parameters[self.first + 1], width

    @ti.func
    def energy(self, parameters: ti.template(), X, u):
        s, stiffness, width = self.scaled(parameters, X, u)
        return stiffness * width * width * barrier.value(s, self.fp)

    @ti.func
    def force(self, parameters: ti.template(), X, u, v):
        s, stiffness, width = self.scaled(parameters, X, u)
        f = 0 * u
        f.y = -stiffness * width * barrier.slope(s, self.fp)
        return f

    @ti.func
    def force_jvp(self, parameters: ti.template(), X, u, v, du, dv):
        s, stiffness, width = self.scaled(parameters, X, u)
        df = 0 * u
        df.y = -stiffness * barrier.curvature(s, self.fp) * du.y
        return df

    @ti.func
    def force_vjp(self, parameters: ti.template(), X, u, v, w):
        return self.force_jvp(parameters, X, u, v, w, w), 0 * w

    @ti.func
    def parameter_derivatives(self, parameters: ti.template(), X, u, v):
        s, stiffness, width = self.scaled(parameters, X, u)
        slope, curvature = barrier.slope(s, self.fp), barrier.curvature(s, self.fp)
        by_height, by_stiffness, by_width = 0 * u, 0 * u, 0 * u
        by_height.y = stiffness * curvature
        by_stiffness.y = -width * slope
        by_width.y = -stiffness * (slope - s * curvature)
        return by_height, by_stiffness, by_width
