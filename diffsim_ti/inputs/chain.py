"""The chain rule as a list of links: each a function whose derivatives are found from it or stand beside it, and three loops
over all of them."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate
from operator import is_
from types import SimpleNamespace

import numpy as np

from diffsim_ti.differentiation.arrays import Recorded, forward, reverse_of_all
from diffsim_ti.inputs.description import frozen

Arrays = Sequence[np.ndarray]


class Link(ABC):
    """y = f(x), for arrays x named by `reads` and y named by `writes`; all methods return one array per name.

    What a link reads are inputs, or what links before it write. A link must not write into what it is given, and y may
    depend on nothing else that changes.
    """

    reads: tuple[str, ...]
    writes: tuple[str, ...]

    @abstractmethod
    def value(self, *x: np.ndarray) -> Arrays:
        """y = f(x)"""

    @abstractmethod
    def jvp(self, x: Arrays, dx: Arrays) -> Arrays:
        """dy = f'(x) dx"""

    @abstractmethod
    def vjp(self, x: Arrays, y_adj: Arrays) -> Arrays:
        """Adjoints of x, f'(x)^T y_adj, each of its x's shape."""


class Recording:
    """The part of a link whose value takes arrays that record, from which its derivatives are found
    (differentiation/arrays.py). What was recorded is kept while x, of up to `few` numbers, stays the same arrays. Adjoints
    of up to `fewest` are products with the matrix of derivatives: from the first on, for bits are not to depend on how
    often they were asked for."""

    few, fewest = 20_000, 16
    _record = None  # what was recorded last, with what it read

    def recorded(self, x: Arrays) -> SimpleNamespace:
        """leaves: arrays that record in the place of x, of these shapes, whose numbers, one after the other, end at `ends`;
        y: what they lead to; slopes: dy/dx, a row for each number of x, None until it is asked for."""
        last = self._record
        if last is not None and all(map(is_, last.x, x)):
            return last
        leaves = [Recorded(part) for part in x]
        ends = [*accumulate(map(np.size, x), initial=0)]
        of_x = dict(x=(*x,), leaves=leaves, shapes=[*map(np.shape, x)], ends=ends)
        found = SimpleNamespace(**of_x, y=(*self.value(*leaves),), slopes=None)
        keeps = ends[-1] <= self.few and all(map(is_fixed, x))
        self._record = found if keeps else None
        return found

    def _slopes(self, at: SimpleNamespace) -> np.ndarray:
        """Those of up to `fewest` numbers, else none."""
        ends = at.ends
        if ends[-1] > self.fewest or ends[-1] * sum(map(np.size, at.y)) > self.few:
            return np.zeros(0)
        changes = [[e[a:b].reshape(s) for s, a, b in zip(at.shapes, ends, ends[1:])] for e in np.eye(ends[-1])]
        return np.array([_in_a_row([forward(y, zip(at.leaves, dx)) for y in at.y]) for dx in changes])

    def jvp(self, x: Arrays, dx: Arrays) -> Arrays:
        at = self.recorded(x)
        return [forward(y, zip(at.leaves, dx)) for y in at.y]

    def vjp(self, x: Arrays, y_adj: Arrays) -> Arrays:
        at = self.recorded(x)
        if at.slopes is None:
            at.slopes = self._slopes(at)
        if at.slopes.size:
            flat = at.slopes @ _in_a_row(y_adj)
            return [flat[a:b].reshape(shape) for shape, a, b in zip(at.shapes, at.ends, at.ends[1:])]
        found = reverse_of_all(zip(at.y, y_adj), at.leaves)
        return [np.zeros(shape) if adjoint is None else adjoint for shape, adjoint in zip(at.shapes, found)]


def _in_a_row(arrays: Arrays) -> np.ndarray:
    """The numbers of all."""
    return np.ravel(arrays[0]) if len(arrays) == 1 else np.concatenate([*map(np.ravel, arrays)])


def _are_same(x: Mapping, y: Mapping) -> bool:
    """Whether two mappings hold the same objects."""
    return x.keys() == y.keys() and all(map(is_, x.values(), map(y.__getitem__, x)))


def is_fixed(x) -> bool:
    """Whether an array has its numbers for good: what may be written to may change and stay the same array."""
    return isinstance(x, np.ndarray) and not x.flags.writeable


class Chain:
    """Links one after the other, from some inputs on. What a link wrote is kept for as long as its arrays are the same.

    Raises ValueError for a link that reads what is not there yet, for two that write one name, and for an idle input.
    """

    def __init__(self, links: Iterable[Link], inputs: Iterable[str]):
        self.links = tuple(links)
        known = unread = set(inputs)
        for link in self.links:
            kind = type(link).__name__
            for name in link.reads:
                if name not in known:
                    raise ValueError(f"{kind} reads {name!r}, which is no input and which no link before it writes")
            for name in link.writes:
                if name in known:
                    raise ValueError(f"{kind} writes {name!r}, which is an input or written by a link before it")
            known, unread = known.union(link.writes), unread.difference(link.reads)
        if unread:
            raise ValueError(f"no link reads the input {sorted(unread)[0]!r}: give its term or material one that does")
        self._kept: dict[Link, tuple[Arrays, Arrays]] = {}  # (what it read, what it wrote)
        self._ways: dict[tuple[str, ...], tuple[list[Link], list[Link]]] = {}
        self._after: dict[tuple[str, ...], list[Link]] = {}
        self._last: tuple | None = None  # wanted inputs, values of all, and what the links of `vjp` read of these

    def value(self, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The values and what all links write; links that miss something are left out."""
        return self._through(self.links, values)

    def _through(self, links: Iterable[Link], values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        known = dict(values)
        for link in links:
            try:
                x = [known[name] for name in link.reads]
            except KeyError:
                continue
            known.update(zip(link.writes, self._written(link, x)))
        return known

    def _written(self, link: Link, x: Arrays) -> Arrays:
        before = self._kept.get(link)
        if before is not None and all(map(is_, before[0], x)):
            return before[1]
        y = [frozen(part) for part in link.value(*x)]
        if all(map(is_fixed, x)):
            self._kept[link] = x, y
        return y

    def again(self, known: Mapping[str, np.ndarray], changed: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Some changed inputs, and what links write that these lead to; known: inputs and what links wrote before."""
        out = dict(changed)
        for link in self._led_to(tuple(changed)):
            x = [out[name] if name in out else known.get(name) for name in link.reads]
            if not any(part is None for part in x):
                out.update(zip(link.writes, map(frozen, link.value(*x))))
        return out

    def _led_to(self, names: tuple[str, ...]) -> list[Link]:
        """The links that some inputs lead to."""
        if names not in self._after:
            reached, after = set(names), []
            for link in self.links:
                if not reached.isdisjoint(link.reads):
                    reached.update(link.writes)
                    after.append(link)
            self._after[names] = after
        return self._after[names]

    def jvp(self, values: Mapping[str, np.ndarray], tangents: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Tangents of what links write, of those alone that change."""
        known, out = self.value(values), dict(tangents)
        for link in self.links:
            if any(name in out for name in link.reads) and all(name in known for name in link.reads):
                x = [known[name] for name in link.reads]
                dx = [out[name] if name in out else np.zeros_like(part) for name, part in zip(link.reads, x)]
                out.update(zip(link.writes, link.jvp(x, dx)))
        return out

    def vjp(
        self, values: Mapping[str, np.ndarray], adjoints: Mapping[str, np.ndarray], wanted: Iterable[str]
    ) -> dict[str, np.ndarray]:
        """Adjoints of the wanted inputs for adjoints of what links write (None: zero)."""
        wanted, last = tuple(wanted), self._last
        pulled, before = self._way(wanted)
        if last is None or last[0] != wanted or not _are_same(last[1], values):
            known = self._through(before, values)
            last = wanted, dict(values), [(link, [*map(known.get, link.reads)]) for link in reversed(pulled)]
            self._last = last if all(map(is_fixed, values.values())) else None
        total = {n: y for n, y in adjoints.items() if y is not None}
        for link, x in last[2]:
            if total.keys().isdisjoint(link.writes):
                continue
            try:
                y_adj = [total[name] for name in link.writes]
            except KeyError:  # nothing depends on some of it
                y_adj = [total.get(n, np.zeros_like(y)) for n, y in zip(link.writes, self._written(link, x))]
            for name, adjoint in zip(link.reads, link.vjp(x, y_adj)):
                total[name] = total[name] + adjoint if name in total else adjoint
        return {name: np.asarray(total[name] if name in total else np.zeros_like(values[name])) for name in wanted}

    def meets(self, name: str, others: Iterable[str]) -> bool:
        """Whether a link that `name` leads to reads what others of the inputs lead to as well."""
        reached, theirs = {name}, set(others)
        for link in self.links:
            by_name, by_others = not reached.isdisjoint(link.reads), not theirs.isdisjoint(link.reads)
            if by_name and by_others:
                return True
            reached.update(link.writes if by_name else ())
            theirs.update(link.writes if by_others else ())
        return False

    def _way(self, wanted: tuple[str, ...]) -> tuple[list[Link], list[Link]]:
        """(links between the wanted inputs and what kernels read, links that give what those read)."""
        if wanted not in self._ways:
            reached = set(wanted)
            pulled = []
            for link in self.links:
                if not reached.isdisjoint(link.reads):
                    reached.update(link.writes)
                    pulled.append(link)
            needed = {name for link in pulled for name in link.reads}
            before = []
            for link in reversed(self.links):
                if not needed.isdisjoint(link.writes):
                    needed.update(link.reads)
                    before.insert(0, link)
            self._ways[wanted] = pulled, before
        return self._ways[wanted]
