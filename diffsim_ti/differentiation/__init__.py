"""Derivatives of a formula, from the formula: numbers that record what is done to them, and functions of them;
of NumPy arrays `arrays.py`."""

from diffsim_ti.differentiation.functions import (
    exp,
    expm1,
    expm1_minus_x,
    log,
    log1p,
    maximum,
    minimum,
    sqrt,
    where,
    x_minus_log1p,
)
from diffsim_ti.differentiation.graph import Graph, Number

__all__ = ["Graph", "Number", "exp", "expm1", "expm1_minus_x", "log", "log1p", "maximum", "minimum", "sqrt", "where"]
__all__ += ["x_minus_log1p"]
