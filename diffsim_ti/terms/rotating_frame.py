"""A frame of reference that rotates."""

from numpy.typing import ArrayLike

from diffsim_ti.inputs import Input
from diffsim_ti.terms.term import Term


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
