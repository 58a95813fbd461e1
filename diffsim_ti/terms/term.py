"""What a term is: a load, a contact or a damping that a scene lists, inlined into the step at compile time."""

from abc import ABC
from dataclasses import dataclass

import numpy as np
import taichi as ti

from diffsim_ti.runtime import PRECISIONS


class Term(ABC):
    """A load, contact or damping. `values` are its numbers, by input name, in SI units and float64.

    A term that the scene does not list leaves no code and no memory behind. Three hooks, each optional:
    `kernel` makes the compile-time twin of a term that acts by a force on each vertex (see VertexForce); gravity,
    drag and external forces are stages of the step itself.
    """

    acts_on_surface = False
    path = None  # displacement over time, of an obstacle that moves
    table = np.zeros(0)  # numbers without gradient, laid behind the parameters on the device
    variant: tuple = ()  # what else than its class decides about the kernels of a term

    def __init__(self, **values):
        self.values = {name: np.array(value, dtype=np.float64) for name, value in values.items()}
        for name, value in self.values.items():
            if not np.all(np.isfinite(value)):
                raise ValueError(f"{type(self).__name__}: {name} must be finite, got {value}")
            value.setflags(write=False)

    def check(self, mesh) -> None:
        """Raise ValueError if the term does not fit the mesh."""

    def settled(self, scene, density, initial_positions, initial_velocities) -> "Term":
        """The term with what it leaves to the scene to choose."""
        return self

    def check_start(self, positions: np.ndarray, surface: np.ndarray) -> None:
        """Raise ValueError if the body may not start at `positions` [m], shape (num_vertices, 3)."""

    def kernel(self, precision: str) -> "VertexForce | None":
        """Compile-time twin; a term with a table is also given `table`, where it starts in the scene's parameter array."""
        return None

    def __repr__(self) -> str:
        numbers = ", ".join(f"{name}={_short(value)}" for name, value in self.values.items())
        return f"{type(self).__name__}({numbers})"


def _short(value: np.ndarray) -> str:
    return f"array{value.shape}" if value.size > 3 else np.array2string(value, separator=", ", precision=6)


@dataclass(frozen=True)
class VertexForce(ABC):
    """Compile-time twin of a term: Taichi functions of one vertex, at rest position X, displacement u, velocity v.

    Vectors have four components, the last zero. Equal twins share compiled kernels, and those of one scene a loop.
    `size` numbers start at `first` in the parameter array.
    """

    precision: str
    size = 0
    # of obstacles only (obstacle.py): is there friction, are nearness and crossing noted?
    friction, watched = False, False

    @property
    def fp(self):
        return PRECISIONS[self.precision]

    @ti.func
    def energy(self, parameters: ti.template(), first, X, u):
        """Potential energy [J]."""

    @ti.func
    def force(self, parameters: ti.template(), first, X, u, v):
        """Force [N]."""

    @ti.func
    def force_jvp(self, parameters: ti.template(), first, X, u, v, du, dv):
        """Change of the force for changes du, dv."""

    @ti.func
    def force_vjp(self, parameters: ti.template(), first, X, u, v, w):
        """(adjoint of u, adjoint of v) for the adjoint w of the force."""

    @ti.func
    def parameter_derivatives(self, parameters: ti.template(), first, X, u, v):
        """Derivatives of the force by the term's own numbers: a tuple of `size` vectors."""
