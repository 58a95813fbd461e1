"""Damping as a rate."""

import numpy as np

from diffsim_ti.terms.term import Term


class Drag(Term):
    """Damping by a rate c [1/s]: dv/dt = -c v, solved exactly, v <- v exp(-c h), whatever the step h.

    A free body's velocity falls as exp(-c t) for any step. Input with gradient: "drag_rate", shape ().
    Raises ValueError for a negative rate.
    """

    def __init__(self, rate: float):
        super().__init__(drag_rate=rate)
        if np.ndim(rate) or float(rate) < 0:
            raise ValueError(f"Drag: rate must be one number >= 0 [1/s], got {rate}")
