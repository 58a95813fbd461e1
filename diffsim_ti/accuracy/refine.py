"""Meshes that are refined where a number of a run needs it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.accuracy.estimate import Accuracy, Number, estimated, on_finer_mesh
from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.checked import number, whole
from diffsim_ti.common.public import Public, public
from diffsim_ti.mesh import TetrahedralMesh

if TYPE_CHECKING:
    from diffsim_ti.rollout import Rollout

SHARE = 0.5  # of the error, whose tetrahedra are refined in a round


@dataclass(repr=False)
class Refined(metaclass=Public):
    """What `refine` found.

    rollout: the problem on the last mesh, for values and gradients there. accuracy: of the number there.
    history: (unknowns, Accuracy) of each mesh, the first being the problem's own. reached: whether the tolerance is.
    values: of inputs on the last mesh, for `rollout.forward(**values)`.
    """

    rollout: "Rollout"
    history: list[tuple[int, Accuracy]]
    reached: bool
    values: dict = field(default_factory=dict, repr=False)

    __repr__ = brief_fields

    @property
    def mesh(self) -> TetrahedralMesh:
        """The last mesh."""
        return self.rollout.scene.mesh

    @property
    def accuracy(self) -> Accuracy:
        """Of the number on the last mesh."""
        return self.history[-1][1]

    def __str__(self) -> str:
        rows = [
            f"{unknowns:>9} unknowns: {a.value:.7g}, error {a.error:.2g} ({a.relative:.2g})"
            for unknowns, a in self.history
        ]
        return "\n".join(rows + ([] if self.reached else ["the tolerance was not reached"]))


@public
def refine(
    problem: "Rollout",
    output: str,
    tolerance: float,
    weights: ArrayLike | Callable | None = None,
    rounds: int = 20,
    most: int = 300_000,
    onto: Callable[[np.ndarray], ArrayLike] | None = None,
    values: dict | None = None,
    ten_nodes: bool = True,
) -> Refined:
    """Refine the mesh of a run where a number's error comes from, until this is below a tolerance.

    problem: a Rollout of equilibria or implicit steps, without volumes and relations that are held exactly. output,
    weights: the number, as in `Rollout.accuracy`.
    tolerance: of the estimated error over the number's change since the first frame, `Accuracy.relative`.
    rounds: of refinement at most. most: unknowns of the finer mesh that says the error, beyond which no round begins.
    onto: as in `TetrahedralMesh.refined`. values: of inputs, as in `Rollout.forward`.
    ten_nodes: whether the first round of a linear mesh gives its tetrahedra ten nodes and cuts none, which brings most for
        each unknown: the error falls by a higher power of the length of edges. With `onto` all meshes stay linear, for the
        middles of edges would not lie there; so they do with False.

    In each other round the fewest tetrahedra that have half of the error by size are cut in two at their longest edges.
    States are carried to the new mesh, and Newton's method begins there. What the steps cost is not refined.
    Doerfler 1996, A convergent adaptive algorithm for Poisson's equation, doi:10.1137/0733054.
    """
    tolerance, rounds = number("tolerance", tolerance), whole("rounds", rounds, 0)
    if problem.solver.explicit or problem.scene.has_multipliers:
        raise ValueError(
            "refine needs the error of each tetrahedron, which accuracy does not have of explicit steps and of what is held "
            "exactly (volumes, relations): take BDF2Solver or StaticSolver and relations with a stiffness, or refine by "
            "hand with mesh.refined()"
        )
    wanted, values, given, history = Number(problem, output, weights), dict(values or {}), None, []
    while True:
        found, run = estimated(problem, wanted, None, values, given)
        history.append((found.cost["unknowns"], found))
        reached = found.relative <= tolerance
        if reached or len(history) > rounds or found.cost["finer unknowns"] > most:
            return Refined(problem, history, reached, values)
        cuts = dict(where=largest(found.shares), edges="longest", onto=onto)
        is_given_nodes = ten_nodes and onto is None and problem.scene.mesh.order == 1
        finer = TetrahedralMesh.quadratic if is_given_nodes else partial(TetrahedralMesh.refined, **cuts)
        problem, values, P, _ = on_finer_mesh(problem, finer, values)
        given = [P @ u for u in run.each("places")]


def largest(shares: np.ndarray, part: float = SHARE) -> np.ndarray:
    """The fewest tetrahedra whose shares have a part of the sum of their sizes."""
    sizes = np.abs(shares)
    order = np.argsort(-sizes, kind="stable")
    return order[: 1 + int(np.searchsorted(np.cumsum(sizes[order]), part * sizes.sum()))]
