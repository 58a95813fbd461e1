"""What acts on all of a body's mass: gravity, damping as a rate, forces of a turning frame."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import Up, numbers, upwards
from diffsim_ti.inputs import NOT_NEGATIVE, Input
from diffsim_ti.terms.term import Term


class Gravity(Term):
    """Uniform gravity: acceleration g [m/s^2] of every vertex, energy -m g . x.

    acceleration: one number along `up` (so -9.81 pulls down), or a vector of 3, which needs no `up`.
    up: "y", "x", "z", "-x", "-y" or "-z", as in `Ground`.
    Input with gradient: "gravity", shape (3,), or "<name>.acceleration".
    Raises ValueError for other shapes and what is not finite. Goldstein, Classical Mechanics, 3rd ed., 2002, sec. 1.4.

    >>> import diffsim_ti as ds
    >>> ds.Gravity(-1.62, up="z").values["gravity"]  # on the moon, z being up
    array([ 0.  ,  0.  , -1.62])
    """

    def __init__(self, acceleration: ArrayLike = -9.81, name: str | None = None, up: Up = "y"):
        g, (axis, sign) = numbers("Gravity: acceleration", acceleration), upwards("Gravity", up)
        if g.shape == ():
            g = np.where(np.arange(3) == axis, sign * float(g), 0.0)
        elif up != "y":
            raise ValueError(f"Gravity: 3 numbers say their direction: leave up={up!r} out, or give one number")
        if g.shape != (3,):
            raise ValueError(f"Gravity: acceleration must be a number (along up) or 3 numbers, got shape {g.shape}")
        super().__init__(Input("acceleration", g, unit="m/s^2", plain="gravity"), name=name)


class Drag(Term):
    """Damping by a rate c [1/s]: dv/dt = -c v, solved exactly, v <- v exp(-c h), whatever the step h.

    A free body's velocity falls as exp(-c t) for any step. Input with gradient: "drag_rate", shape (), or "<name>.rate".
    Raises ValueError for a negative rate. Hairer, Lubich, Wanner, Geometric Numerical Integration, 2006, II.5 (the
    splitting).
    """

    def __init__(self, rate: float, name: str | None = None):
        super().__init__(Input("rate", rate, ((),), "1/s", NOT_NEGATIVE, plain="drag_rate", label="rate"), name=name)


class RotatingFrame(Term):
    """Positions, velocities, obstacles and supports are those of a frame that turns at a constant rate: on each vertex of
    mass m, at x with velocity v in that frame, act the Coriolis and the centrifugal force [N],

        f = -m (2 Omega x v + Omega x (Omega x (x - c))).

    angular_velocity [rad/s]: Omega, 3 numbers. center [m]: c, any point of the axis. What lies still in an inertial frame
    starts with initial_velocities -Omega x (x - c). Gravity stays as given, so it turns with the frame.
    Of ten-node tetrahedra implicit steps and equilibria take the consistent mass, as of inertia. Explicit steps turn
    velocities by Cayley's rotation, which keeps their size; implicit ones take those of the step. Static solves have the
    centrifugal force alone: spinning bodies at rest in the frame. Explicit runs do not look for gains of energy.
    Inputs with gradient: "angular_velocity", "rotation_center", or "<name>.angular_velocity", "<name>.center".
    Raises ValueError for other shapes.
    Goldstein, Poole, Safko, Classical Mechanics, 3rd ed., 2002, sec. 4.10.
    """

    def __init__(self, angular_velocity: ArrayLike, center: ArrayLike = (0.0, 0.0, 0.0), name: str | None = None):
        super().__init__(
            Input("angular_velocity", angular_velocity, ((3,),), "rad/s"),
            Input("center", center, ((3,),), "m", plain="rotation_center", label="center", axes="xyz"),
            name=name,
        )
