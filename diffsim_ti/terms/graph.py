"""Derivatives of a contact's formula, from the formula: a graph of numbers that is recorded while a kernel compiles.

A shape writes its distance once, in `Number`s; what the kernels need besides (changes along a direction, products with the
transpose) is a sweep over the recorded graph, forwards or backwards, and comes out as straight-line code. Only the local
derivatives that a sweep meets are emitted.
Griewank, Walther, Evaluating Derivatives, ch. 3, doi:10.1137/1.9780898717761.
"""

import taichi as ti

from diffsim_ti.runtime import let


class Number:
    """A number of the graph: its value in the kernel, and (parent, function that emits the derivative by it) pairs."""

    def __init__(self, graph, value, parents=()):
        self.graph, self.value = graph, let(value)
        self.parents = [[parent, partial, None] for parent, partial in parents]
        graph.numbers.append(self)

    def partials(self):
        """(parent, derivative by it), each emitted once."""
        for entry in self.parents:
            if entry[2] is None:
                entry[2] = let(entry[1]())
            yield entry[0], entry[2]

    def __add__(self, other):
        g, other = self.graph, self.graph.number(other)
        return Number(g, self.value + other.value, [(self, g.one), (other, g.one)])

    def __sub__(self, other):
        g, other = self.graph, self.graph.number(other)
        return Number(g, self.value - other.value, [(self, g.one), (other, g.minus_one)])

    def __mul__(self, other):
        other = self.graph.number(other)
        return Number(self.graph, self.value * other.value, [(self, lambda: other.value), (other, lambda: self.value)])

    def __truediv__(self, other):
        other = self.graph.number(other)
        quotient = let(self.value / other.value)
        inverse = lambda: self.graph.one() / other.value  # noqa: E731
        minus = lambda: self.graph.constant(0) - quotient / other.value  # noqa: E731
        return Number(self.graph, quotient, [(self, inverse), (other, minus)])


class Graph:
    """Numbers in the order in which they were made; `fp` is the scene's float, `parameters` its parameter array."""

    def __init__(self, fp, parameters=None):
        self.fp, self.parameters, self.numbers = fp, parameters, []

    def constant(self, value):
        return ti.cast(value, self.fp)

    def one(self):
        return self.constant(1)

    def minus_one(self):
        return self.constant(-1)

    def leaf(self, value) -> Number:
        """A number that derivatives are taken by, or a given one."""
        return Number(self, value)

    def number(self, value) -> Number:
        """A Python number as a constant of the graph."""
        return value if isinstance(value, Number) else self.leaf(self.constant(value))

    def function(self, value, *parents) -> Number:
        """A function with hand-written derivatives: (parent, function that emits the derivative) pairs."""
        return Number(self, value, parents)

    def sqrt(self, x: Number) -> Number:
        """The root, with derivative zero where x is."""
        tiny = self.constant(1e-30)
        root = let(ti.sqrt(ti.max(x.value, tiny)))
        slope = lambda: ti.select(x.value > tiny, self.constant(0.5) / root, self.constant(0))  # noqa: E731
        return Number(self, root, [(x, slope)])

    def select(self, condition, a, b) -> Number:
        """a where the condition holds, else b; both are evaluated."""
        a, b, chosen = self.number(a), self.number(b), let(condition)
        one, zero = self.constant(1), self.constant(0)
        return Number(
            self,
            ti.select(chosen, a.value, b.value),
            [(a, lambda: ti.select(chosen, one, zero)), (b, lambda: ti.select(chosen, zero, one))],
        )

    def maximum(self, a, b) -> Number:
        a, b = self.number(a), self.number(b)
        return self.select(a.value > b.value, a, b)

    def minimum(self, a, b) -> Number:
        a, b = self.number(a), self.number(b)
        return self.select(a.value < b.value, a, b)

    def dot(self, a, b) -> Number:
        """Inner product of two lists of numbers."""
        total = a[0] * b[0]
        for x, y in zip(a[1:], b[1:]):
            total = total + x * y
        return total

    def forward(self, dots: list, outputs: list) -> list:
        """Changes of the outputs for changes (leaf, change) of leaves."""
        known = {id(leaf): change for leaf, change in dots}
        for number in self.numbers:
            terms = [let(partial * known[id(p)]) for p, partial in self._reached(number, known)]
            if terms:
                known[id(number)] = self._sum(terms)
        return [known.get(id(out), self.constant(0)) for out in outputs]

    @staticmethod
    def _reached(number, known):
        """Pairs of `partials` whose parent has a change."""
        if any(id(p) in known for p, _, _ in number.parents):
            for p, partial in number.partials():
                if id(p) in known:
                    yield p, partial

    def reverse(self, seeds: list, leaves: list) -> list:
        """Adjoints of the leaves for adjoints (number, adjoint) of results."""
        adjoints = {}
        for number, seed in seeds:
            adjoints.setdefault(id(number), []).append(seed)
        for number in reversed(self.numbers):
            if id(number) in adjoints:
                total = adjoints[id(number)] = [self._sum(adjoints[id(number)])]
                for parent, partial in number.partials():
                    adjoints.setdefault(id(parent), []).append(let(partial * total[0]))
        return [self._sum(adjoints[id(leaf)]) if id(leaf) in adjoints else self.constant(0) for leaf in leaves]

    @staticmethod
    def _sum(terms):
        total = terms[0]
        for term in terms[1:]:
            total = let(total + term)
        return total
