"""Muscles: fibres in tetrahedra that pull along themselves as far as they are activated."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers, present
from diffsim_ti.inputs import Input, Link
from diffsim_ti.inputs.lines import LineRows, Segments
from diffsim_ti.inputs.loads import InTime, MuscleTension
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.mesh.paths import Paths
from diffsim_ti.terms.lines import AT_LEAST_0, Cable
from diffsim_ti.terms.marks import MOST, Lines, spread
from diffsim_ti.terms.over_time import OfTetrahedra, OverTime
from diffsim_ti.terms.term import Term, nonempty


class Muscle(OfTetrahedra, Cable):
    """Fibres along a in tetrahedra, which add the energy alpha s (|F a| - 1) [J/m^3] and so the stress P = alpha s t a^T,
    t = F a / |F a|: a pull that turns with the fibre, whatever its length, in every substep and every Newton iteration.

    fibre: the direction a at rest, of any length, shape (3,) or (k, 3) for the k tetrahedra. stress [Pa]: s, what a fibre
    pulls with at alpha = 1, per area at rest; one number, or one for each activation.
    activation: alpha >= 0, over time: one number, one for each step (shape (steps,)), a function of time [s], or keyframes
    (times, values), a tuple, linear between. per: what has an activation of its own: "all" together; each "set" of those
    that `tetrahedra` names; each "tetrahedron". Then alpha has one number for each, shape (n,), or (steps, n) by steps.
    tetrahedra: a tetrahedron set's name, several, indices or a mask; None: all.
    Forces and their moments sum to zero in each tetrahedron. If the rest shape changes, fibres go along with it.
    In load steps of static solves activations grow with the loads. Energy that a muscle gives counts as work of a load.
    Inputs with gradient: "activation" and "muscle_stress", or "<name>.activation" and "<name>.stress", of the shape given,
    (steps + 1, ...) of what is linear within steps; the rest shape.
    Raises ValueError for other shapes, another `per`, an empty set, directions without length, and numbers below zero.
    Blemker, Pinsky, Delp 2005, A 3D model of muscle, doi:10.1016/j.jbiomech.2004.04.009 (active stress along fibres).
    """

    by_tension = of_fibres = True

    def __init__(
        self,
        fibre: ArrayLike,
        stress: ArrayLike,
        activation: OverTime,
        tetrahedra: SetOrIndices | None = None,
        per: Literal["all", "set", "tetrahedron"] = "all",
        name: str | None = None,
    ):
        amount, shape = self._take("activation", activation, "activation", tetrahedra, per)
        a = numbers("Muscle: fibre", fibre)
        if a.shape[-1:] != (3,) or a.ndim > 2 or not np.all(np.isfinite(a)) or np.any(np.linalg.norm(a, axis=-1) == 0):
            raise ValueError(f"Muscle: fibre must be finite directions, shape (3,) or (k, 3), got shape {a.shape}")
        present("Muscle: stress", stress)
        self.fibre, shapes = a / np.linalg.norm(a, axis=-1, keepdims=True), ((),) if per == "all" else ((), shape)
        strength = Input("stress", stress, shapes, "Pa", AT_LEAST_0, plain="muscle_stress", label="stress")
        Term.__init__(self, amount, strength, name=name)
        if np.any((self.rows([0.0]) if self.keyed else amount.value) < 0):
            raise ValueError("Muscle: activation must be >= 0, for it pulls only")

    def check(self, mesh: TetrahedralMesh) -> None:
        chosen = nonempty(self, self.groups(mesh)[0])
        if self.fibre.ndim == 2 and len(self.fibre) != len(chosen):
            count = len(self.fibre)
            raise ValueError(f"Muscle: fibre has {count} directions for {len(chosen)} tetrahedra; give one or all")
        (count, last), stress = self._shapes(chosen), self.described[1].value
        if last != count or stress.shape not in ((), count):
            raise ValueError(
                f'Muscle: per="{self.per}" takes activations of shape {count} here, one row or one for each step, got '
                f"{last}, and a stress of shape () or {count}, got {stress.shape}"
            )

    def _points(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Number of each of its points among those of all tetrahedra."""
        q = mesh.reference.num_points
        return (self.groups(mesh)[0][:, None] * q + np.arange(q)).ravel()

    def found_paths(self, mesh: TetrahedralMesh) -> Paths:
        """At each point of the stresses from a point at rest in the origin to h F a, a sum of places whose weights add up to
        zero: half the work of a path from one point of the fibre to another."""
        reference, (chosen, _) = mesh.reference, self.groups(mesh)
        nodes, none = mesh.elements[chosen], (np.zeros(0, np.int64), np.zeros(0))
        by_xi = reference.derivatives(reference.points)  # (q, n, 3)
        J = np.einsum("tni,qnk->tqik", mesh.vertices[nodes], by_xi)
        gradients = np.einsum("qnk,tqki->tqni", by_xi, np.linalg.inv(J))
        h = np.cbrt(np.abs(np.linalg.det(J)))[:, :, None]
        along = h * np.einsum("tqni,ti->tqn", gradients, np.broadcast_to(self.fibre, (len(chosen), 3)))
        return Paths.of([[none, (own, w)] for own, part in zip(nodes, along) for w in part])

    def drawn(self, moment):
        mesh, reference = moment.mesh, moment.mesh.reference
        nodes = mesh.elements[self.groups(mesh)[0]]
        N = reference.functions(reference.points)
        middles = np.einsum("qn,tni->tqi", N, moment.positions[nodes]).reshape(-1, 3)
        shown = spread(middles, MOST)
        half = (0.5 * self.paths(mesh).matrix(mesh.num_vertices)[1::2] @ moment.positions)[shown]
        return [Lines(self.name or "muscle", np.stack([middles[shown] - half, middles[shown] + half], 1))]

    def links(self, names: dict[str, str], own: str) -> list[Link]:
        mesh, paths, segments = self.mesh, self.paths(self.mesh), f"{own} segments"
        group = np.repeat(self.groups(mesh)[1], mesh.reference.num_points)
        activation, tension = f"{own} activation in time", f"{own} tension in time"
        pull = MuscleTension(activation, names["muscle_stress"], segments, self._points(mesh), group, tension)
        in_time = InTime(names["activation"], activation, self.ndim, self.keyed)
        rows = LineRows(paths, segments, f"{own} rows", tension=tension)
        return [Segments(paths, mesh.num_vertices, None, segments), in_time, pull, rows]
