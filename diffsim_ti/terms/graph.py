"""The graph that obstacles are recorded in; it lives in `differentiation`."""

from diffsim_ti.differentiation.graph import Graph, Number

__all__ = ["Graph", "Number"]
