"""One scene of a batch as Taichi functions of a single scene see it, and functions of the tetrahedra of a batch.

Numbers that scenes have of their own lie as batch/layouts.py says; what all scenes share lies as it does for one scene.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.batch.layouts import APART
from diffsim_ti.materials.patch_law import PatchLaw
from diffsim_ti.mechanics.stress.items import Items
from diffsim_ti.mechanics.stress.patched_tetrahedron import MOST, PatchedTetrahedron
from diffsim_ti.mechanics.stress.tetrahedron import Tetrahedron
from diffsim_ti.runtime import LANES, Bundle, Expr, assign, at, let, traced, variable

A = ti.template()  # an array or Bundle handed to a Taichi function


class Place(Expr):
    """A vector of a kernel whose components lie apart; assigning to it writes them."""

    def __init__(self, components, vector, zero):
        super().__init__(vector(*components, zero))
        self._components = components

    def _assign(self, value):
        for d, component in enumerate(self._components):
            assign(component, at(value, d))


@traced
class View:
    """Numbers of one scene: `array[k]`, or `array[slot, k]` of an array of slots.

    first: where those of its block begin.
    """

    _data_oriented = True  # Taichi hands it on as it is

    def __init__(self, array, first, lane):
        self._array, self._first, self._lane = array, first, lane

    def _number(self, index, k):
        return at(at(self._array, *index, self._first + k), self._lane)

    def __getitem__(self, index):
        *slot, k = index if isinstance(index, tuple) else (index,)
        return self._number(slot, k)


@traced
class Vectors(View):
    """Vectors of one scene, with a fourth component of zero."""

    def __init__(self, array, first, lane, vector, zero):
        super().__init__(array, first, lane)
        self._vector, self._zero = vector, zero

    def __getitem__(self, index):
        *slot, i = index if isinstance(index, tuple) else (index,)
        first = let(3 * i)
        return Place([self._number(slot, first + d) for d in range(3)], self._vector, self._zero)


class Sum(Place):
    """Such a vector that is added to by assigning to it."""

    def _assign(self, value):
        for d, component in enumerate(self._components):
            assign(component, component + at(value, d))


@traced
class AtVertices(Vectors):
    """Forces at corners of one scene: `array[corner] = force` adds it to the vertex there, which no other thread does."""

    def __init__(self, array, first, lane, vector, zero, vertices):
        super().__init__(array, first, lane, vector, zero)
        self._vertices = vertices

    def __getitem__(self, corner):
        first = let(3 * at(self._vertices, corner))
        return Sum([self._number((), first + d) for d in range(3)], self._vector, self._zero)


@traced
class Scratch:
    """What is noted of one vertex while it is worked on: `array[row, i]` for any i, in a column of its block."""

    _data_oriented = True

    def __init__(self, array, b):
        self._array, self._column = array, let(b * APART)

    def __getitem__(self, index):
        return at(self._array, *([index[0]] if isinstance(index, tuple) else []), self._column)


@traced
class Item(Bundle):
    """Tetrahedron e of scene b, of `count` scenes; or of block b, whose vectors and tetrahedra begin at `vertices` and
    `tetrahedra`."""

    @traced
    def other(self, e):
        """Another tetrahedron of the scene or the block."""
        return Item(**vars(self) | dict(e=e))


@traced
class Column:
    """Numbers or vectors of scene b where scenes are innermost, `count` of them: `array[k]`, or `array[slot, k]`."""

    _data_oriented = True

    def __init__(self, array, b, count):
        self._array, self._b, self._count = array, b, count

    def __getitem__(self, index):
        *slot, k = index if isinstance(index, tuple) else (index,)
        return at(self._array, *slot, k * self._count + self._b)


@dataclass(frozen=True)
class ItemsOfScenes(Items):
    """Tetrahedra whose numbers scenes share (`Shared`), have one set of for all (`Uniform`), or have of their own.

    place(rows, item, k): where number k of the `rows` that the item has lies; uniform_place: likewise of one set for all.
    """

    def numbers(self, array, first: int, count: int, rows: int, item):
        wanted = range(first, first + count)
        if isinstance(array, Shared):
            return [self.broadcast(let(at(array.array, rows * item.e + k))) for k in wanted]
        place = self.uniform_place if isinstance(array, Uniform) else self.place
        array = array.array if isinstance(array, Uniform) else array
        return [let(at(array, place(rows, item, k))) for k in wanted]

    def entries(self, array, slots: tuple, first: int, count: int, rows: int, item):
        return (at(array, *slots, self.place(rows, item, k)) for k in range(first, first + count))


@dataclass(frozen=True)
class EightScenes(ItemsOfScenes):
    """A tetrahedron of eight scenes simultaneously; an item is an `Item` of a block."""

    @cached_property
    def lanes(self):
        return ti.types.vector(LANES, self.fp)

    def broadcast(self, number):
        return let(self.lanes(*[number] * LANES))

    def place(self, rows: int, item, k):
        return rows * (item.tetrahedra + item.e) + k

    def uniform_place(self, rows: int, item, k):
        return rows * item.b + k

    def places(self, tets, item):
        """Where the vector of each node begins."""
        return [let(item.vertices + 3 * at(tets, self.nodes * item.e + a)) for a in range(self.nodes)]

    def corners(self, vectors, slot, tets, item):
        return [[let(at(vectors, slot, place + d)) for d in range(3)] for place in self.places(tets, item)]

    def store(self, corner, item, forces, zero, add: bool = False):
        """Straight to the nodes: no other thread works on these scenes."""
        for place, force in zip(self.places(corner.tets, item), forces):
            for d in range(3):
                target = at(corner.array, place + d)
                assign(target, target + force[d])


@dataclass(frozen=True)
class OneScene(ItemsOfScenes):
    """A tetrahedron of one scene, where scenes are innermost; an item is an `Item` of that."""

    def broadcast(self, number):
        return number

    def place(self, rows: int, item, k):
        return (rows * item.e + k) * item.count + item.b

    def uniform_place(self, rows: int, item, k):
        return k * item.count + item.b

    def corners(self, vectors, slot, tets, item):
        nodes = (let(at(tets, self.nodes * item.e + a)) for a in range(self.nodes))
        whole = [let(at(vectors, slot, node * item.count + item.b)) for node in nodes]
        return [[let(at(w, d)) for d in range(3)] for w in whole]

    def store(self, corner, item, forces, zero, add: bool = False):
        """To corners of their own, which vertices gather: other threads work on the same scene."""
        for a in range(self.nodes):
            self.put_force(at(corner, self.place(self.nodes, item, a)), self.vector(*forces[a], zero), add)


@traced
class Shared(Bundle):
    """Numbers of tetrahedra, `array`, that all scenes share."""


@traced
class Uniform(Bundle):
    """Numbers, `array`, of which each scene has one set for all tetrahedra."""


@dataclass(frozen=True)
class TetrahedronOfScenes(Tetrahedron):
    """Functions of one tetrahedron: of eight scenes in lanes, or of one."""

    @cached_property
    def items(self) -> ItemsOfScenes:
        return (EightScenes if self.lanes else OneScene)(self.fp, self.nodes.count)

    @traced
    def coefficients_of(self, item, array, q: int = 0) -> list:
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


def element_of(law, features, lanes: bool) -> TetrahedronOfScenes:
    """Of eight scenes in lanes, or of one."""
    alone, patch = (TetrahedronOfEight, PatchOfEight) if lanes else (TetrahedronOfScenes, PatchOfScenes)
    kind = patch if isinstance(law, PatchLaw) else alone
    growth = (features.growth_per_step, False) if features.growing else None  # of each tetrahedron of each scene
    return kind(law, features.uniform, lanes, features.order, growth)
