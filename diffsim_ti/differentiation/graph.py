"""Derivatives of a formula, from the formula: a graph of numbers that is recorded while a kernel compiles.

A shape writes its distance once, a law its energy, in `Number`s; what the kernels need besides (changes along a direction,
products with the transpose, second derivatives) is a sweep over the recorded graph, forwards or backwards, and comes out as
straight-line code. Only the local derivatives that a sweep meets are emitted. A number is a scalar or a vector of lanes.
Griewank, Walther, Evaluating Derivatives, ch. 3 and 5, doi:10.1137/1.9780898717761.
"""

import operator
from contextlib import contextmanager
from numbers import Integral, Real

import taichi as ti

from diffsim_ti.runtime import each_lane, let, spread


class Number:
    """A number of the graph: its value in the kernel, and (parent, function that gives the derivative by it) pairs.

    The function gives a Python number, a `Number`, or a value of the kernel, which has no derivatives of its own.
    Operands may be Python numbers; they are constants in the graph's precision.
    """

    _data_oriented = True  # Taichi hands it on as it is, so that tensors may be made of it
    __array_ufunc__ = None  # NumPy's numbers leave operations to this class

    def __init__(self, graph, value, parents=(), made_of=None):
        self.graph, self.made_of, self.uses = graph, made_of, 0
        self.known = {}  # what some function has found of it, by the function's name
        self._value = None if made_of else let(value)
        self.parents = [[parent, partial, None] for parent, partial in parents]
        graph.numbers.append(self)
        if made_of and not graph.waits:
            self.value  # noqa: B018  it is found here

    @property
    def value(self):
        """As a variable, found when it is first asked for."""
        if self._value is None:
            self._value = let(self._expression())
            self.graph.found.append(self)
        return self._value

    def _expression(self):
        operation, *operands = self.made_of
        return operation(*(x.used() if isinstance(x, Number) else self.graph.constant(x) for x in operands))

    def used(self):
        """For one more operation: as a variable, but where this is its only use."""
        return self._expression() if self._value is None and self.uses < 2 else self.value

    def partials(self):
        """(parent, derivative by it), each found once."""
        for entry in self.parents:
            if entry[2] is None:
                entry[2] = entry[1]()
                if not isinstance(entry[2], (Number, Real)):
                    entry[2] = let(entry[2])
            yield entry[0], entry[2]

    def _value_of(self, other):
        return other.value if isinstance(other, Number) else self.graph.constant(other)

    def _made(self, operation, a, b, *parents) -> "Number":
        """operation(a, b); parents that are Python numbers have no derivatives."""
        numbers = [x for x in (a, b) if isinstance(x, Number)]
        linear = operation in (operator.add, operator.sub) or len(numbers) < 2 and operation is operator.mul
        for x in numbers:
            x.uses += 1 if linear else 2  # a derivative has it too
        parents = [(p, partial) for p, partial in parents if isinstance(p, Number)]
        return Number(self.graph, None, parents, (operation, a, b))

    def __add__(self, other):
        return self._made(operator.add, self, other, (self, lambda: 1), (other, lambda: 1))

    def __radd__(self, other):
        return self._made(operator.add, other, self, (self, lambda: 1))

    def __sub__(self, other):
        return self._made(operator.sub, self, other, (self, lambda: 1), (other, lambda: -1))

    def __rsub__(self, other):
        return self._made(operator.sub, other, self, (self, lambda: -1))

    def __neg__(self):
        return 0 - self

    def __mul__(self, other):
        return self._made(operator.mul, self, other, (self, lambda: other), (other, lambda: self))

    def __rmul__(self, other):
        return self._made(operator.mul, other, self, (self, lambda: other))

    def __truediv__(self, other):
        out = self._made(operator.truediv, self, other, (self, lambda: 1 / other), (other, lambda: 0 - out / other))
        return out

    def __rtruediv__(self, other):
        out = self._made(operator.truediv, other, self, (self, lambda: 0 - out / self))
        return out

    def __pow__(self, n):
        """x^n for a Python number or a Number n; unless n is a Python integer, x must be positive."""
        n = int(n) if isinstance(n, Integral) else n
        value = self.value**n if isinstance(n, int) else each_lane(operator.pow, self.value, self._value_of(n))
        parents = [(self, lambda: n if isinstance(n, int) and n in (0, 1) else n * self ** (n - 1))]
        if isinstance(n, Number):
            parents.append((n, lambda: out * self.graph.log(self)))
        out = Number(self.graph, value, parents)
        return out

    def __lt__(self, other):
        """A condition for `Graph.select`, as that of >."""
        return self.value < self._value_of(other)

    def __gt__(self, other):
        return self.value > self._value_of(other)


class Graph:
    """Numbers in the order in which they were made; `fp` is the scene's float, `parameters` its parameter array.

    waits: sums, products and quotients are found where they are first asked for, and not at all if they are not asked
    for; what only one sum has is part of it, and no variable. The time in which a kernel compiles grows with the square
    of their number. What a loop or a branch of a kernel asks for is unknown behind it: `within`.
    """

    def __init__(self, fp, parameters=None, waits: bool = False):
        self.fp, self.parameters, self.numbers, self.waits, self.found = fp, parameters, [], waits, []

    @contextmanager
    def within(self):
        """What is found in this `with` block stands in a loop or branch."""
        found, numbers = len(self.found), len(self.numbers)
        yield
        for number in self.found[found:]:
            number._value = None
        for number in self.numbers[:numbers]:
            number.known.clear()
        del self.found[found:]

    def constant(self, value):
        return ti.cast(value, self.fp)

    def one(self):
        return self.constant(1)

    def leaf(self, value) -> Number:
        """A number that derivatives are taken by, or a given one."""
        return Number(self, value)

    def number(self, value) -> Number:
        """A Python number as a constant of the graph."""
        return value if isinstance(value, Number) else self.leaf(self.constant(value))

    def function(self, value, *parents) -> Number:
        """A function with hand-written derivatives: (parent, function that gives the derivative) pairs."""
        return Number(self, value, parents)

    def sqrt(self, x: Number) -> Number:
        """The root, with derivative zero where x is."""
        tiny = self.constant(1e-30)
        out = Number(self, ti.sqrt(ti.max(x.value, tiny)), [(x, lambda: self.select(x.value > tiny, 0.5 / out, 0))])
        return out

    def log(self, x: Number) -> Number:
        return Number(self, each_lane(ti.log, x.value), [(x, lambda: 1 / x)])

    def exp(self, x: Number) -> Number:
        out = Number(self, each_lane(ti.exp, x.value), [(x, lambda: out)])
        return out

    def select(self, condition, a, b) -> Number:
        """a where the condition holds, else b; both are evaluated, and must be finite with their derivatives."""
        chosen = let(condition)
        a, b = (self.number(x) for x in (a, b))

        def pick(x, y):
            return ti.select(chosen, spread(x, chosen), spread(y, chosen))

        one, zero = self.constant(1), self.constant(0)
        return Number(
            self,
            pick(a.value, b.value),
            [(a, lambda: self.leaf(pick(one, zero))), (b, lambda: self.leaf(pick(zero, one)))],
        )

    def maximum(self, a, b) -> Number:
        a, b = self.number(a), self.number(b)
        return self.select(a > b, a, b)

    def minimum(self, a, b) -> Number:
        a, b = self.number(a), self.number(b)
        return self.select(a < b, a, b)

    def dot(self, a, b) -> Number:
        """Inner product of two lists of numbers."""
        total = a[0] * b[0]
        for x, y in zip(a[1:], b[1:]):
            total = total + x * y
        return total

    # ---- sweeps -----------------------------------------------------------------------------------------------------

    def forward(self, dots: list, outputs: list) -> list:
        """Changes of the outputs, values of the kernel, for changes (leaf, change) of leaves."""
        known, needed = {id(leaf): change for leaf, change in dots}, self._behind(outputs)
        for number in tuple(self.numbers):
            if id(number) in needed and any(id(p) in known for p, _, _ in number.parents):
                terms = [self._product(partial, known[id(p)]) for p, partial in number.partials() if id(p) in known]
                known[id(number)] = self._sum(terms)
        return [known.get(id(out), self.constant(0)) for out in outputs]

    def reverse(self, seeds: list, leaves: list) -> list:
        """Adjoints of the leaves, values of the kernel, for adjoints (number, adjoint) of results."""
        return self._sweep_back(seeds, leaves, self._product, self._sum, self.constant(0))

    def gradient(self, output: Number, leaves: list) -> list:
        """Derivatives of a number by leaves as Numbers, whose own derivatives further sweeps find."""
        out = self._sweep_back([(output, 1)], leaves, self._product_of_numbers, self._sum_of_numbers, 0)
        return [self.number(x) for x in out]

    def _sweep_back(self, seeds, leaves, product, add, zero) -> list:
        adjoints, before = {}, self._ahead_of(leaves)
        for number, seed in seeds:
            adjoints.setdefault(id(number), []).append(seed)
        for number in reversed(tuple(self.numbers)):
            if id(number) in adjoints:
                total = adjoints[id(number)] = [add(adjoints[id(number)])]
                for parent, partial in number.partials() if id(number) in before else ():
                    if id(parent) in before:
                        adjoints.setdefault(id(parent), []).append(product(partial, total[0]))
        return [add(adjoints[id(leaf)]) if id(leaf) in adjoints else zero for leaf in leaves]

    def _ahead_of(self, leaves) -> set:
        """Numbers that depend on the leaves, which are among them."""
        found = {id(leaf) for leaf in leaves}
        for number in self.numbers:
            if any(id(parent) in found for parent, _, _ in number.parents):
                found.add(id(number))
        return found

    def _behind(self, outputs) -> set:
        """Numbers that the outputs depend on, which are among them."""
        found = {id(out) for out in outputs}
        for number in reversed(self.numbers):
            if id(number) in found:
                found.update(id(parent) for parent, _, _ in number.parents)
        return found

    def _product(self, partial, x):
        """partial x as a value of the kernel."""
        if isinstance(partial, Real):
            return x if partial == 1 else self.constant(partial) * x
        return (partial.value if isinstance(partial, Number) else partial) * x

    @staticmethod
    def _product_of_numbers(partial, x):
        """partial x as a Number, or a Python number."""
        if not isinstance(partial, (Number, Real)):
            raise TypeError("second derivatives need a function's derivative as a Number, got a value of the kernel")
        if isinstance(partial, Real) and partial == 1:
            return x
        return partial if isinstance(x, Real) and x == 1 else partial * x

    @staticmethod
    def _sum(terms):
        total = terms[0]
        for term in terms[1:]:
            total = total + term
        return let(total)

    @staticmethod
    def _sum_of_numbers(terms):
        total = terms[0]
        for term in terms[1:]:
            total = total + term
        return total
