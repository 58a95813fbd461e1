"""How the values at an element's nodes make dx/dxi at its points, and how what works on these pushes the nodes.

mesh/reference_element.py says where points lie and in which order nodes come.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import taichi as ti

from diffsim_ti.materials.calculus.tensor import Tensor, sum_of
from diffsim_ti.mesh.reference_element import LINEAR, MID_EDGES, QUADRATIC, ReferenceElement
from diffsim_ti.runtime import let, spread, traced


@dataclass(frozen=True)
class Nodes(ABC):
    """Functions of one item in a float type."""

    fp: object

    reference: ClassVar[ReferenceElement]

    @property
    def count(self) -> int:
        return self.reference.num_nodes

    @property
    def points(self) -> int:
        return self.reference.num_points

    @traced
    def constant(self, number: float, like):
        """For many uses: Taichi writes a bare one anew for each lane wherever it stands."""
        return spread(ti.cast(number, self.fp), like)

    @abstractmethod
    def edges(self, x) -> list[Tensor]:
        """dx/dxi at each point, for x[a][d] at the nodes a."""

    @abstractmethod
    def forces(self, pushes) -> list:
        """[a][d]: minus the transpose of `edges`, for a Tensor at each point."""


class LinearNodes(Nodes):
    """Four nodes, one point: dx/dxi has the columns x_a - x_0, a = 1..3."""

    reference = LINEAR

    @traced
    def edges(self, x) -> list[Tensor]:
        return [Tensor(x[a][d] - x[0][d] for d in range(3) for a in (1, 2, 3))]

    @traced
    def forces(self, pushes) -> list:
        (Q,) = pushes
        minus = self.constant(-1, Q[0, 0])
        forces = [[let(minus * Q[d, a]) for d in range(3)] for a in range(3)]
        return [[let(sum_of(Q[d, a] for a in range(3))) for d in range(3)], *forces]  # node 0 balances them


BETWEEN = {(int(b), int(c)): 4 + k for k, ends in enumerate(MID_EDGES) for b, c in (ends, ends[::-1])}
BETWEEN |= {(c, c): c for c in range(4)}  # the node between corners b and c, a corner itself where they are one
FAR, NEAR = QUADRATIC.points[0, 0], QUADRATIC.points[1, 0]  # L_c at point q, NEAR for c = q
assert np.allclose(QUADRATIC.points, FAR + (NEAR - FAR) * np.eye(4)[:, 1:])


class QuadraticNodes(Nodes):
    """Ten nodes, four points. With x_bc at the node between corners b and c, and x_cc = x_c:

        dx/dL_c at point q = s_c + 4 (near - far) x_qc,   s_c = 4 far sum_b x_bc - x_c,   dx/dxi_c = dx/dL_c - dx/dL_0

    which takes a fourth of the operations of ten shape functions at each point.
    """

    reference = QUADRATIC

    @traced
    def _factors(self, like) -> tuple:
        return self.constant(4 * FAR, like), self.constant(4 * (NEAR - FAR), like)

    @traced
    def edges(self, x) -> list[Tensor]:
        far, near = self._factors(x[0][0])
        # differences first: whatever is the same at all nodes leaves no trace of rounding
        r = [[let(0 * v) for v in x[0]]] + [[let(v - o) for v, o in zip(x[a], x[0])] for a in range(1, 10)]
        s = [[let(far * sum_of(r[BETWEEN[b, c]][d] for b in range(4)) - r[c][d]) for d in range(3)] for c in range(4)]
        s = [[let(s[c][d] - s[0][d]) for d in range(3)] for c in range(4)]
        return [
            Tensor(s[c][d] + near * (r[BETWEEN[q, c]][d] - r[BETWEEN[q, 0]][d]) for d in range(3) for c in (1, 2, 3))
            for q in range(4)
        ]

    @traced
    def forces(self, pushes) -> list:
        like = pushes[0][0, 0]
        (far, near), minus = self._factors(like), self.constant(-1, like)
        by_L = [  # [q][c][d]: what works on minus dx/dL_c at point q
            [[let(sum_of(Q[d, k] for k in range(3))) for d in range(3)]]
            + [[let(minus * Q[d, k]) for d in range(3)] for k in range(3)]
            for Q in pushes
        ]
        by_s = [[let(far * sum_of(by_L[q][c][d] for q in range(4))) for d in range(3)] for c in range(4)]
        nodes = [[let(by_s[c][d] + near * by_L[c][c][d]) for d in range(3)] for c in range(4)]
        whole = [[let(sum_of(by_L[q][c][d] for q in range(4))) for d in range(3)] for c in range(4)]
        nodes = [[let(own - all_of) for own, all_of in zip(nodes[c], whole[c])] for c in range(4)]
        return nodes + [
            [let(by_s[b][d] + by_s[c][d] + near * (by_L[b][c][d] + by_L[c][b][d])) for d in range(3)]
            for b, c in MID_EDGES
        ]


def nodes_of(order: int, fp) -> Nodes:
    """Of elements of order 1 or 2."""
    return (QuadraticNodes if order == 2 else LinearNodes)(fp)
