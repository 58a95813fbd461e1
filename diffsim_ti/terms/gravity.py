"""Uniform gravity."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.inputs import Input
from diffsim_ti.terms.term import Term


class Gravity(Term):
    """Uniform gravity: acceleration g [m/s^2] of every vertex, energy -m g . x.

    acceleration: a vector of 3, or one number along y (so -9.81 pulls down). Default (0, -9.81, 0).
    Input with gradient: "gravity", shape (3,), or "<name>.acceleration".
    Raises ValueError for other shapes and what is not finite. Goldstein, Classical Mechanics, 3rd ed., 2002, sec. 1.4.

    >>> import diffsim_ti as ds
    >>> ds.Gravity(-1.62).values["gravity"]  # on the moon
    array([ 0.  , -1.62,  0.  ])
    """

    def __init__(self, acceleration: ArrayLike = (0.0, -9.81, 0.0), name: str | None = None):
        g = numbers("Gravity: acceleration", acceleration)
        if g.shape == ():
            g = np.array([0.0, float(g), 0.0])
        if g.shape != (3,):
            raise ValueError(f"Gravity: acceleration must be a number (along y) or 3 numbers, got shape {g.shape}")
        super().__init__(Input("acceleration", g, unit="m/s^2", plain="gravity"), name=name)
