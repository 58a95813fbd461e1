"""The numbers of an implicit pass (solver.py)."""

from typing import NamedTuple


class Stage(NamedTuple):
    """Numbers of a pass, and the derivatives of b0, b1, e0, e1 by the drag rate."""

    gamma: float
    a0: float = 1.0
    a1: float = 0.0
    b0: float = 1.0
    b1: float = 0.0
    c0: float = 1.0
    e0: float = 1.0
    e1: float = 0.0
    by_rate: tuple = (0.0, 0.0, 0.0, 0.0)
    static: bool = False

    @property
    def inertia(self) -> float:
        """c of the incremental potential [1/s^2]."""
        return 0.0 if self.static else 1 / self.gamma**2
