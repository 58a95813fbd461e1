"""Kernels of one body that go through many bodies of equal size, whose arrays stand one after the other: a thread takes a
body through all of them, as often as that is wanted, while its arrays lie in the caches."""

from functools import lru_cache

import taichi as ti

from diffsim_ti.runtime.kernels import _compiled, named_arrays
from diffsim_ti.runtime.language import Bundle, at, let, traced
from diffsim_ti.runtime.launch import Launch

SPREAD = 1024  # items of a loop at least, for Taichi keeps fewer on one thread


@traced
class Piece:
    """`array[k]`, or `array[slot, k]`, of an array from its entry `first` on; its entries are whole numbers that count from
    `zero`, if that is given. row: of its rows the only one."""

    _data_oriented = True  # Taichi hands it on as it is

    def __init__(self, array, first, zero=None, row=None):
        self._array, self._first, self._zero, self._row = array, first, zero, row

    def __getitem__(self, index):
        *slot, k = index if isinstance(index, tuple) else (index,)
        slot = slot if self._row is None else [self._row]
        entry = at(self._array, *slot, k if self._first is None else self._first + k)
        return entry if self._zero is None else entry - self._zero


class Piecewise:
    """Kernels one after the other, again and again in one launch, for each of `count` bodies: `launch(times, numbers of each
    kernel)`, as of one body.

    parts: [(kernel, records)] as of `Repeated`, with kernels of one thread and the arrays of all bodies. The body of the
    first says whether the others are still wanted of a body. whole: {(bundle, array)} that bodies share, or to which the
    `start`s of rows lead. counting: {(bundle, array): (bundle, array)}, whole numbers that say places in the second one.
    rows: {(bundle, array)} that have a row for each body.
    """

    def __init__(
        self, name: str, parts: list, count: int, whole: set, counting: dict, vectorized: bool, rows=frozenset()
    ):
        kernels, (names, arrays) = [kernel for kernel, _ in parts], named_arrays(parts)
        self._names, self._count = [kernel.numbers for kernel in kernels], count
        made = _kernel(name, tuple(kernels), names, frozenset(whole), tuple(counting.items()), frozenset(rows))
        title = f"the kernel {name}" + next((k.of_law for k in kernels if k.of_law), "")
        self._launch = Launch(made, *arrays, vectorized=vectorized, title=title)

    def __call__(self, times: int, *numbers: dict) -> None:
        own = (of[n] for names, of in zip(self._names, numbers, strict=True) for n in names)
        self._launch(*own, self._count, max(SPREAD // self._count, 1), times)


def _of_body(kernel, whole: frozenset, counting: dict, rows: frozenset):
    """body(b, count, bundles of the arrays of all bodies, numbers) -> what the kernel's body does with those of body b."""

    @traced
    def body(b, count, *bundles):
        records = dict(zip(kernel.arrays, bundles))
        first = lambda bundle, array: let(b * (getattr(records[bundle], array).shape[-1] // count))  # noqa: E731

        def seen(bundle, a):
            array, place = getattr(records[bundle], a), (bundle, a)
            zero = first(*counting[place]) if place in counting else None
            if place in rows:
                return Piece(array, None, row=b)
            if place in whole:
                return array if zero is None else Piece(array, None, zero)
            return Piece(array, first(bundle, a), zero)

        own = [Bundle(**{a: seen(bundle, a) for a in of}) for bundle, of in kernel.arrays.items()]
        return kernel.body(*own, *bundles[len(own) :])

    return body


@lru_cache(maxsize=None)
def _kernel(name: str, kernels: tuple, names: tuple, whole: frozenset, counting: tuple, rows: frozenset):
    calls, arrays, numbers, scope = [], {}, {}, {}
    for k, (kernel, own) in enumerate(zip(kernels, names)):
        _, call, arguments = kernel.call(f"body{k}", dict(own), f"k{k}_")
        of_numbers = {f"k{k}_{n}" for n in kernel.numbers}
        arrays |= {a: kind for a, kind in arguments.items() if a not in of_numbers and a not in arrays}
        numbers |= {a: kind for a, kind in arguments.items() if a in of_numbers}
        scope[f"body{k}"] = _of_body(kernel, whole, dict(counting), rows)
        calls.append(call.replace("(", "(b, count, ", 1))
    lines = [
        "for t in range(spread * count):",
        "    if t % spread == 0:",
        "        b = 2 * (t // spread)",  # neighbours, which take as long, go to different threads
        "        b = b % count + b // count * (1 - count % 2)",
        "        for _ in range(times):",
        f"            if {calls[0]}:",
        *(f"                {call}" for call in calls[1:]),
    ]
    more = dict.fromkeys(("count", "spread", "times"), ti.i32)
    return _compiled(name, arrays | numbers | more, lines, scope)
