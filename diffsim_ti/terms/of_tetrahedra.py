"""An amount over time that tetrahedra have: one together, one for each set, or one for each tetrahedron."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.inputs import Input
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms.over_time import GivenOverTime, OverTime, amount, is_keyed, rows_at

PER = ("all", "set", "tetrahedron")


class OfTetrahedra(GivenOverTime):
    """The part of a term that gives tetrahedra an amount over time; `tetrahedra` and `per` as the terms say."""

    def _take(
        self, argument: str, given: OverTime, plain: str, tetrahedra: str | Sequence[str] | ArrayLike | None, per: str
    ) -> tuple[Input, tuple]:
        """The input of the amount, and the shape of one row of it."""
        kind = type(self).__name__
        if per not in PER:
            raise ValueError(f"{kind}: per must be one of {', '.join(map(repr, PER))}, got {per!r}")
        if per == "set" and (isinstance(tetrahedra, str) or not all(isinstance(s, str) for s in tetrahedra or [0])):
            raise ValueError(f'{kind}: per="set" takes tetrahedra=["left", "right"], names of sets, got {tetrahedra!r}')
        shape = () if per == "all" else (len(tetrahedra),) if per == "set" else ("k",)
        self.given, self.keyed, self.per, self.tetrahedra = given, is_keyed(given), per, tetrahedra
        self.ndim, self._called = len(shape) + 1, f"{kind}: {argument}"
        return amount(argument, given, shape, "-", plain), shape

    def rows(self, times: ArrayLike) -> np.ndarray:
        at = self.given(0.0) if callable(self.given) else np.asarray(self.given[1])[0]
        return rows_at(self._called, self.given, times, np.shape(at))

    def groups(self, mesh: TetrahedralMesh) -> tuple[np.ndarray, np.ndarray]:
        """(tetrahedra, which number of a row each has)"""
        if self.per == "set":
            each = [mesh.tetrahedron_indices(own) for own in self.tetrahedra]
            return np.concatenate(each), np.repeat(np.arange(len(each)), [len(own) for own in each])
        every = np.arange(mesh.num_tetrahedra)
        chosen = every if self.tetrahedra is None else mesh.tetrahedron_indices(self.tetrahedra)
        return chosen, np.arange(len(chosen)) if self.per == "tetrahedron" else np.zeros(len(chosen), np.int64)

    def sizes(self, mesh: TetrahedralMesh) -> dict[str, int]:
        """How many tetrahedra "k" stands for."""
        return {"k": len(self.groups(mesh)[0])}

    def _shapes(self, chosen: np.ndarray) -> tuple[tuple, tuple]:
        """(the shape that a row must have for these tetrahedra, the one that is given)"""
        count = () if self.per == "all" else (len(self.tetrahedra) if self.per == "set" else len(chosen),)
        if self.keyed:
            return count, self.rows([0.0]).shape[1:]
        value = self.described[0].value
        return count, value.shape[value.ndim - len(count) :]
