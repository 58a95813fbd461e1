"""Damping as a rate."""

from diffsim_ti.inputs import NOT_NEGATIVE, Input
from diffsim_ti.terms.term import Term


class Drag(Term):
    """Damping by a rate c [1/s]: dv/dt = -c v, solved exactly, v <- v exp(-c h), whatever the step h.

    A free body's velocity falls as exp(-c t) for any step. Input with gradient: "drag_rate", shape (), or "<name>.rate".
    Raises ValueError for a negative rate. Hairer, Lubich, Wanner, Geometric Numerical Integration, 2006, II.5 (the
    splitting).
    """

    def __init__(self, rate: float, name: str | None = None):
        super().__init__(Input("rate", rate, ((),), "1/s", NOT_NEGATIVE, plain="drag_rate", label="rate"), name=name)
