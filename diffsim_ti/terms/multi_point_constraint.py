"""A linear relation between displacements of several places."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.inputs import Input, Link
from diffsim_ti.inputs.description import POSITIVE
from diffsim_ti.inputs.links import Joined
from diffsim_ti.inputs.loads import InTime, VertexAreas
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.terms.marks import Points
from diffsim_ti.terms.over_time import GivenOverTime, OverTime, amount
from diffsim_ti.terms.term import Term


class MultiPointConstraint(GivenOverTime, Term):
    """Holds a linear relation between displacements u [m] of several vertices,

        g = sum_j c_j . u_j - value = 0,

    such as equal motion of two places, the mean motion of a face, or a lever, exactly by the forces f_j = p c_j: in implicit
    steps and equilibria p is a Lagrange multiplier at the end of each substep (the midpoint rule in the middle of it, so
    that what does not fit at the start swings about the value), in explicit ones it leads there in each substep (SHAKE) and
    velocities follow value (RATTLE). With a stiffness implicit steps and equilibria have the penalty
    E = stiffness / 2 g^2 instead, for vertices that are fixed too, and for `modes`, `load_path` and `refine`.

    vertices: a vertex set's name, several, indices or a mask; coefficients c_j [-]: shape (k, 3), in the order of the
        indices, of sets and masks in that of ascending indices.
    value [m], over time as the amount of `Pressure`; static load steps apply it in parts.
    stiffness [N/m], or None: exactly. g is the force over it; a hundred to a million times E times the body's size costs
        little, for solvers know the relation's matrix; `load_path` finds no equilibria beyond ten thousand times. Explicit
        steps do not read it.
    `MultiPointConstraint.mean` makes the relation of a face's mean motion.
    Inputs with gradient: "constraint_value", "constraint_coefficients", "constraint_stiffness", or "<name>.value", ...
    Raises ValueError for other shapes, unknown sets, coefficients that are all zero, and stiffness not above zero.
    Relations that are held exactly must not follow from each other, nor name vertices that links of robots hold, or along
    directions in which they are fixed; explicit steps refuse reduced sets and ties beside them.
    Cook, Malkus, Plesha, Witt, Concepts and Applications of Finite Element Analysis, 2001, 13.3; Leimkuhler, Reich,
    Simulating Hamiltonian Dynamics, 2004, 7.2.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_box((5, 3, 3), size=(0.4, 0.1, 0.1))
    >>> lift = ds.MultiPointConstraint.mean(mesh, "xmax", (0, 1, 0), value=0.02)
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[lift], fixed="xmin", precision="f64")
    >>> tip = ds.Rollout(ds.StaticSolver(scene), steps=1).forward().displacements[-1][mesh.vertex_sets["xmax"]]
    >>> print(f"{tip[:, 1].mean():.2f} m")
    0.02 m
    """

    def __init__(
        self,
        vertices: SetOrIndices,
        coefficients: ArrayLike,
        value: OverTime = 0.0,
        *,
        stiffness: float | None = None,
        name: str | None = None,
    ):
        self.vertices, c = vertices, numbers("MultiPointConstraint: coefficients", coefficients)
        if c.ndim != 2 or c.shape[1] != 3 or not c.any():
            raise ValueError(
                f"MultiPointConstraint: coefficients must have shape (k, 3), not all zero, got shape {c.shape}"
            )
        more = [Input("coefficients", c, (c.shape,), "-", plain="constraint_coefficients", label="coefficients")]
        if stiffness is not None:
            k = Input("stiffness", stiffness, ((),), "N/m", POSITIVE, plain="constraint_stiffness", label="stiffness")
            more.append(k)
        self.is_exact = stiffness is None
        super().__init__(amount("value", value, (), "m", "constraint_value"), *more, name=name)
        self._give(value)

    @classmethod
    def mean(
        cls,
        mesh: TetrahedralMesh,
        surface: SetOrIndices,
        direction: ArrayLike,
        value: OverTime = 0.0,
        *,
        stiffness: float | None = None,
        turn: bool = False,
        name: str | None = None,
    ) -> "MultiPointConstraint":
        """The mean motion of a surface along a `direction`, by areas at rest; with turn=True its mean rotation [rad] about
        that direction through its centre, for small rotations, with value [rad] and stiffness [N m]. The surface stays
        free to deform."""
        faces = mesh.faces_of(surface)
        vertices, n = np.unique(faces), numbers("MultiPointConstraint: direction", direction)
        if n.shape != (3,) or not n.any():
            raise ValueError(f"MultiPointConstraint: direction must be 3 numbers, not all zero, got {direction!r}")
        n, (a,) = n / np.linalg.norm(n), VertexAreas(faces, vertices, "areas").value(mesh.vertices)
        x = mesh.vertices[vertices]
        along = np.cross(n, x - a @ x / a.sum()) if turn else np.tile(n, (len(x), 1))
        c = a[:, None] * along / float(a @ (along**2).sum(1))
        return cls(vertices, c, value, stiffness=stiffness, name=name)

    @property
    def num_numbers(self) -> int:
        """Coefficients and stiffness; the value over time lies in an array of its own."""
        return sum(described.value.size for described in self.described[1:])

    def indices(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Vertices in the order of the coefficients."""
        ascending, given = mesh.vertex_indices(self.vertices), np.asarray(self.vertices)
        return given.astype(np.int64) if given.dtype.kind in "iu" and given.shape == ascending.shape else ascending

    def check(self, mesh: TetrahedralMesh) -> None:
        k, given = len(self.indices(mesh)), len(self.described[1].value)
        if k != given:
            raise ValueError(f"MultiPointConstraint: coefficients of {given} vertices for {k}; give a row for each")

    def links(self, names: dict[str, str], own: str) -> Sequence[Link]:
        in_time = InTime(names[self.plain], f"{own} in time", 1, self.keyed)
        return [in_time, Joined([names[described.plain] for described in self.described[1:]], own)]

    def drawn(self, moment):
        return [Points(self.name or "constraint", moment.positions[self.indices(moment.mesh)])]
