"""Kernels of one body that go through many bodies of equal size, whose arrays stand one after the other: a thread takes a
body through all of them, as often as that is wanted, while its arrays lie in the caches."""

from collections.abc import Callable
from dataclasses import dataclass

from diffsim_ti.runtime.kernels import Repeated
from diffsim_ti.runtime.language import Bundle, at, let, traced

SPREAD = 1024  # items of a loop at least, for Taichi keeps fewer on one thread


@traced
class Piece:
    """`array[k]`, or `array[slot, k]`, of an array from its entry `first` on; its entries are whole numbers that count from
    `zero`, if that is given. row: of its rows the only one; size: of its entries."""

    _data_oriented = True  # Taichi hands it on as it is

    def __init__(self, array, first, zero=None, row=None, size=None):
        self._array, self._first, self._zero, self._row, self.shape = array, first, zero, row, (size,)

    def __getitem__(self, index):
        *slot, k = index if isinstance(index, tuple) else (index,)
        slot = slot if self._row is None else [self._row]
        entry = at(self._array, *slot, k if self._first is None else self._first + k)
        return entry if self._zero is None else entry - self._zero


@dataclass(frozen=True)
class Pieces:
    """How kernels of one thread and one body see arrays of all bodies.

    whole: {(bundle, array)} that bodies share, or to which the `start`s of rows lead. counting: (((bundle, array), (bundle,
    array)), ...), whole numbers that say places in the second one. rows: {(bundle, array)} that have a row for each body.
    counts: names of numbers that are of all bodies.
    """

    whole: frozenset
    counting: tuple
    rows: frozenset
    counts: tuple

    numbers, arguments = ("bodies", "spread"), "b, bodies"
    loop = (
        "for t in range(spread * bodies):",
        "    if t % spread == 0:",
        "        b = 2 * (t // spread)",  # neighbours, which take as long, go to different threads
        "        b = b % bodies + b // bodies * (1 - bodies % 2)",
    )

    def body_of(self, kernel) -> Callable:
        """body(b, bodies, bundles of the arrays of all, numbers) -> what the kernel's body does with those of body b."""
        counting = dict(self.counting)

        @traced
        def body(b, bodies, *bundles):
            records = dict(zip(kernel.arrays, bundles))
            size = lambda bundle, array: let(getattr(records[bundle], array).shape[-1] // bodies)  # noqa: E731

            def seen(bundle, a):
                array, place = getattr(records[bundle], a), (bundle, a)
                zero = let(b * size(*counting[place])) if place in counting else None
                if place in self.rows:
                    return Piece(array, None, row=b)
                if place in self.whole:
                    return array if zero is None else Piece(array, None, zero)
                own = size(bundle, a)
                return Piece(array, let(b * own), zero, size=own)

            own = [Bundle(**{a: seen(bundle, a) for a in of}) for bundle, of in kernel.arrays.items()]
            return kernel.body(*own, *bundles[len(own) :])

        return body


class OfOne:
    """Numbers of one body, as a dictionary of those of all has them when they are asked for."""

    def __init__(self, of_all: dict, count: int, counts: tuple):
        self.of_all, self.count, self.counts = of_all, count, counts

    def __getitem__(self, name):
        return self.of_all[name] // self.count if name in self.counts else self.of_all[name]


class Piecewise(Repeated):
    """Kernels as of `Repeated`, for each of `count` bodies: a thread takes a body through all of them."""

    def __init__(self, name: str, groups: list[list], count: int, pieces: Pieces, vectorized: bool):
        self._more = count, max(SPREAD // count, 1)
        of_one = self._of_one = lambda of: OfOne(of, count, pieces.counts)  # noqa: E731
        groups = [[(kernel, records, of and of_one(of)) for kernel, records, of in group] for group in groups]
        super().__init__(name, groups, False, vectorized, pieces)

    def __call__(self, times: int, **numbers) -> None:
        self._go(times, self._of_one(numbers))
