"""What a kernel works on at a time: eight tetrahedra in lanes, or one; how their numbers are read and written.

Data of tetrahedra lie in blocks of eight. On the CPU a block is worked on at once, each number of a formula being a
vector of eight lanes that becomes vector instructions; elsewhere, and for laws that need a loop, tetrahedra go one by one
over the same data. Vectors of vertices have four components (the last is zero), since whole loads and stores of four are
what vector units do well.
"""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.runtime import LANES, assign, at, let


@dataclass(frozen=True)
class Items:
    """Reading and writing of items in a float type; nodes: how many each tetrahedron has.

    `entries(array, slots, first, count, rows, item)` of a subclass: the elements of an array where numbers of an item lie.
    """

    fp: object
    nodes: int = 4

    @cached_property
    def vector(self):
        return ti.types.vector(4, self.fp)

    def numbers(self, array, first: int, count: int, rows: int, item):
        """`count` numbers from `first` on, of the `rows` that each item has."""
        return [let(x) for x in self.entries(array, (), first, count, rows, item)]

    def row(self, array, slot, first: int, count: int, rows: int, item):
        """The same in a slot of an array of slots."""
        return [let(x) for x in self.entries(array, (slot,), first, count, rows, item)]

    def put(self, array, rows: int, item, first: int, numbers):
        for target, number in zip(self.entries(array, (), first, len(numbers), rows, item), numbers):
            assign(target, number)

    def put_row(self, array, slot, first: int, rows: int, item, numbers):
        for target, number in zip(self.entries(array, (slot,), first, len(numbers), rows, item), numbers):
            assign(target, number)

    def add(self, array, rows: int, item, numbers, first: int = 0):
        for target, number in zip(self.entries(array, (), first, len(numbers), rows, item), numbers):
            assign(target, target + number)

    @staticmethod
    def put_force(target, force, add: bool):
        """To a corner; add: to what is there."""
        assign(target, target + force if add else force)


class Block(Items):
    """Eight tetrahedra at once: item b is block b."""

    @cached_property
    def lanes(self):
        return ti.types.vector(LANES, self.fp)

    def broadcast(self, number):
        return let(self.lanes(*[number] * LANES))

    def entries(self, array, slots: tuple, first: int, count: int, rows: int, item):
        begin = let(rows * item + first)
        return (at(array, *slots, begin + k if k else begin) for k in range(count))

    def corners(self, vectors, slot, tets, item):
        """[a][d]: component d of the vector at node a."""
        out, begin = [], let(self.nodes * LANES * item)
        for a in range(self.nodes):
            places = (begin + (LANES * a + lane) for lane in range(LANES))
            whole = [let(at(vectors, slot, at(tets, place))) for place in places]
            out.append([let(self.lanes(*(at(w, d) for w in whole))) for d in range(3)])
        return out

    def store(self, corner, item, forces, zero, add: bool = False, first=None):
        begin = self.nodes * LANES * item
        begin = let(begin if first is None else begin + first)
        for a in range(self.nodes):
            for lane in range(LANES):
                force = self.vector(*(at(forces[a][d], lane) for d in range(3)), zero)
                self.put_force(at(corner, begin + (self.nodes * lane + a)), force, add)


class Single(Items):
    """One tetrahedron: item e is tetrahedron e, a lane of its block."""

    def broadcast(self, number):
        return number

    def _place(self, rows: int, item, first=0) -> tuple:
        """(where the block's numbers from `first` on begin, lane)"""
        return let(rows * (item // LANES) + first), let(item % LANES)

    def entries(self, array, slots: tuple, first: int, count: int, rows: int, item):
        begin, lane = self._place(rows, item, first)
        return (at(at(array, *slots, begin + k if k else begin), lane) for k in range(count))

    def corners(self, vectors, slot, tets, item):
        begin, lane = self._place(self.nodes * LANES, item)
        places = (begin + (lane + LANES * a) for a in range(self.nodes))
        whole = [let(at(vectors, slot, at(tets, place))) for place in places]
        return [[let(at(w, d)) for d in range(3)] for w in whole]

    def store(self, corner, item, forces, zero, add: bool = False, first=None):
        begin = self.nodes * item
        begin = let(begin if first is None else begin + first)
        for a in range(self.nodes):
            self.put_force(at(corner, begin + a), self.vector(*forces[a], zero), add)
