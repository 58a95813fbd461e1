"""Functions of the tetrahedra of a batch, and of patches of them (mechanics/stress/patched_tetrahedron.py)."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.batch.views import EightScenes, ItemsOfScenes, OneScene
from diffsim_ti.materials.patch_law import PatchLaw
from diffsim_ti.mechanics.stress.patched_tetrahedron import MOST, PatchedTetrahedron
from diffsim_ti.mechanics.stress.tetrahedron import Tetrahedron
from diffsim_ti.runtime import LANES, Bundle, assign, let, traced, variable

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class TetrahedronOfScenes(Tetrahedron):
    """Functions of one tetrahedron: of eight scenes in lanes, or of one."""

    @cached_property
    def items(self) -> ItemsOfScenes:
        return (EightScenes if self.lanes else OneScene)(self.fp, self.nodes.count)

    @traced
    def coefficients_of(self, item, array) -> list:
        K = len(self.law.coefficient_names)
        return self.items.numbers(array, 0, K, K, item)


@dataclass(frozen=True)
class TetrahedronOfEight(TetrahedronOfScenes):
    """The same, which adds to vertices themselves."""

    @ti.func
    def gather(self, i, scene: A, corner: A):
        """What the tetrahedra have added at vertex i."""
        return corner[i]

    @traced
    def room_for_sums(self):
        """Variables for what a patch sums up; none here."""
        return Bundle(totals=[])

    @traced
    def sum_up(self, item, sums, scene, at, s, w=None, dots=None) -> None:
        """Before an item's functions are called: the sums over the patch that begins with it; arguments as of `forces`,
        `forces_vjp` (w) and `forces_jvp` (w, the change of u, and dots)."""


@dataclass(frozen=True)
class PatchOfEight(TetrahedronOfEight, PatchedTetrahedron):
    """A tetrahedron of a patch, of eight scenes simultaneously: eight items in a row are a patch, whose sums the first
    makes."""

    @traced
    def room_for_sums(self):
        return Bundle(totals=[variable(self.items.lanes(0)) for _ in range(MOST if self.order == 1 else 0)])

    @traced
    def sum_up(self, item, sums, scene, at, s, w=None, dots=None) -> None:
        item.totals = sums.totals
        if self.order == 1:
            self._sum_up(item, sums, Bundle(scene=scene, at=at, s=s, w=w, dots=dots))

    @ti.func
    def _sum_up(self, item: A, sums: A, job: A):
        if item.e % LANES == 0:
            self._clear(sums)
            for k in range(LANES):
                self._add(item.other(item.e + k), sums, job)

    @traced
    def _clear(self, sums) -> None:
        for total in sums.totals:
            assign(total, self.items.lanes(0))

    @traced
    def _add(self, item, sums, job) -> None:
        (t,) = self._own(item, job)
        for total, number in zip(sums.totals, t.numbers):
            assign(total, total + number)

    @traced
    def _sums(self, item, job, known) -> list:
        if self.order == 2:
            return PatchedTetrahedron._sums(self, item, job, known)
        return [let(total) for total, _ in zip(item.totals, known[0].numbers)]


@dataclass(frozen=True)
class PatchOfScenes(TetrahedronOfScenes, PatchedTetrahedron):
    """A tetrahedron of a patch, of one scene."""

    @ti.func
    def _sum_one_by_one(self, item: A, job: A):
        total = ti.types.vector(MOST, self.fp)(0)
        first = item.e // LANES * LANES
        for lane in range(LANES):
            total += self._row(item.other(first + lane), job)
        return total


def element_of_eight(law, features) -> TetrahedronOfEight:
    kind = PatchOfEight if isinstance(law, PatchLaw) else TetrahedronOfEight
    return kind(law, features.uniform, True, features.order, _growth(features))


def element_of_scenes(law, features) -> TetrahedronOfScenes:
    kind = PatchOfScenes if isinstance(law, PatchLaw) else TetrahedronOfScenes
    return kind(law, features.uniform, False, features.order, _growth(features))


def _growth(features) -> tuple | None:
    """As Tetrahedron has it; each tetrahedron of each scene has its own."""
    return (features.growth_per_step, False) if features.growing else None
