"""Growth over time: what each tetrahedron's rest state has grown by, while a run goes on."""

from functools import partial
from operator import lt
from typing import Literal

import numpy as np

from diffsim_ti.common.checked import present
from diffsim_ti.inputs import Input, Link, Range
from diffsim_ti.inputs.loads import InTime
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.terms.over_time import OfTetrahedra, OverTime
from diffsim_ti.terms.term import Term, nonempty

BEYOND = Range("> -1, which leaves nothing of the body", partial(lt, -1))


class Growth(OfTetrahedra, Term):
    """Growth, swelling or thermal strain over time, added to that of the material `Grown`: F_g = (1 + g) I and

        psi = det(F_g) psi_material(F F_g^-1) [J/m^3],    g = growth of `Grown` + sum of all Growth terms,

    in every substep and every Newton iteration. Forces sum to zero in each tetrahedron, and a free body with uniform
    growth takes its new size without stress. A scene makes its material `Grown(material, 0)` if it is not Grown itself.

    growth [-], > -1, over time: one number, one for each step (shape (steps,)), a function of time [s], or keyframes
    (times, values), a tuple, linear between; of heat alpha (T - T_0). per: what has a growth of its own: "all" together;
    each "set" of those that `tetrahedra` names; each "tetrahedron": shape (n,), or (steps, n) by steps.
    tetrahedra: a tetrahedron set's name, several, indices or a mask; None: all.
    In load steps of static solves growth is applied with the loads. Mass stays that of the rest shape.
    stiffness_matrix, modes and stable_dt take the growth of `Grown` alone; outputs that evaluate the law by frames, and
    volume="patches", refuse it. Input with gradient: "growth_over_time" or "<name>.growth", of the shape given, (steps
    + 1, ...) of what is linear within steps.
    Raises ValueError for other shapes, another `per`, an empty set, and a material that Grown does not take.
    Rodriguez, Hoger, McCulloch 1994, Stress-dependent finite growth, doi:10.1016/0021-9290(94)90021-3.
    """

    num_numbers = 0  # what kernels read of it lies in an array of its own

    def __init__(
        self,
        growth: OverTime,
        tetrahedra: SetOrIndices | None = None,
        per: Literal["all", "set", "tetrahedron"] = "all",
        name: str | None = None,
    ):
        present("growth", growth)
        described, _ = self._take("growth", growth, "growth_over_time", tetrahedra, per)
        own = {name: getattr(described, name) for name in ("name", "value", "shapes", "unit", "plain", "label")}
        super().__init__(Input(**own, range=BEYOND), name=name)
        if self.keyed and not np.all(BEYOND.holds(self.rows([0.0]))):
            raise ValueError(f"Growth: growth must be {BEYOND.words}")

    @property
    def everywhere(self) -> bool:
        """Whether all grow alike."""
        return self.per == "all" and self.tetrahedra is None

    def check(self, mesh: TetrahedralMesh) -> None:
        chosen = nonempty(self, self.groups(mesh)[0])
        if len(np.unique(chosen)) < len(chosen):
            raise ValueError("Growth: a tetrahedron is in two of its sets; list two Growth terms, which add up")
        count, last = self._shapes(chosen)
        if last != count:
            raise ValueError(f'Growth: per="{self.per}" takes growth of shape {count} here, got {last}')

    def links(self, names: dict[str, str], own: str) -> list[Link]:
        return [InTime(names[self.plain], f"{own} in time", self.ndim, self.keyed)]
