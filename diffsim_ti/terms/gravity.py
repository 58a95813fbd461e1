"""Uniform gravity."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import Up, numbers, upwards
from diffsim_ti.inputs import Input
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
