"""Derivatives of a function of NumPy arrays, from the function: arrays that record what is done to them.

A function is written once, in NumPy; its change along a direction, and the product with its transpose, are sweeps over what
was recorded, forwards or backwards. `Graph` does so for the numbers of kernels.
Griewank, Walther, Evaluating Derivatives, ch. 3, doi:10.1137/1.9780898717761.
"""

from collections.abc import Callable, Iterable
from itertools import count

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

_numbers = count()


class Node:
    """A value with what it was made of: parents are (node, change of the value for that of the node, adjoint of the node for
    that of the value). None stands for zero. An adjoint may also be a function that adds it to what `zeros` gives."""

    def __init__(self, value, parents: Iterable = (), zeros: Callable | None = None):
        self.value, self.parents, self.number = value, tuple(parents), next(_numbers)
        self.zeros = zeros or (lambda: np.zeros(np.shape(value)))


class Recorded(Node, NDArrayOperatorsMixin):
    """A float64 array that records. Functions that have no derivative here raise TypeError."""

    shape = property(lambda self: np.shape(self.value))
    ndim = property(lambda self: np.ndim(self.value))
    size = property(lambda self: np.size(self.value))
    T = property(lambda self: linear(self, np.transpose, np.transpose))

    def __array__(self, *_, **__):
        raise TypeError(
            "an array whose derivatives are asked for cannot be made a plain one: leave np.array out, or write jvp and vjp"
        )

    def __array_ufunc__(self, ufunc, method, *x, **how):
        if ufunc is np.matmul:
            return _matmul(*x)
        plain = [value_of(a) for a in x]
        y = getattr(ufunc, method)(*plain, **how)
        if ufunc in PARTIALS and method == "__call__" and not how:
            slopes = [partial(y, *plain) if isinstance(a, Recorded) else 0 for a, partial in zip(x, PARTIALS[ufunc])]
            return made(y, *((a, s.__mul__, s.__mul__) for a, s in zip(x, map(np.asarray, slopes))))
        if y.dtype.kind == "f" and ufunc is not np.sign:
            raise TypeError(f"np.{ufunc.__name__} has no derivative here: write jvp and vjp beside value")
        return y

    def __array_function__(self, function, _, x, how):
        if function in FUNCTIONS:
            return FUNCTIONS[function](*x, **how)
        if function in MOVING:
            return _moved(function, *x, **how)
        if function in WITHOUT:
            return function(*map(value_of, x), **how)
        raise TypeError(f"np.{function.__name__} has no derivative here: write jvp and vjp beside value")

    def __len__(self) -> int:
        return len(self.value)

    def __iter__(self):
        return (self[k] for k in range(len(self)))

    def __getitem__(self, index):
        parts = index if isinstance(index, tuple) else (index,)
        listed = any(isinstance(part, list | np.ndarray) for part in parts)

        def add(into, seed):
            if listed:
                np.add.at(into, index, seed)
            else:
                into[index] += seed

        return linear(self, lambda x: x[index], lambda seed: lambda into: add(into, seed))

    def astype(self, _):
        return self

    copy = __copy__ = lambda self: self

    def reshape(self, *shape):
        return linear(self, lambda x: x.reshape(*shape), lambda seed: np.reshape(seed, self.shape))

    def ravel(self):
        return self.reshape(-1)

    def swapaxes(self, a, b):
        return linear(self, lambda x: np.swapaxes(x, a, b), lambda seed: np.swapaxes(seed, a, b))

    def sum(self, axis=None, keepdims=False):
        def spread(seed):
            return np.broadcast_to(seed if keepdims or axis is None else np.expand_dims(seed, axis), self.shape)

        return linear(self, lambda x: np.sum(x, axis, keepdims=keepdims), spread)

    def mean(self, axis=None, keepdims=False):
        total = self.sum(axis, keepdims)
        return total / (self.size / max(total.size, 1))


def value_of(x):
    """The plain array of one that may record."""
    return x.value if isinstance(x, Node) else x


def as_array(x):
    """A float64 array, or the one that records."""
    return x if isinstance(x, Node) else np.asarray(x, np.float64)


def made(value, *parents):
    """A value made of arrays, with parents as of `Node`; of those that do not record it has no derivatives."""
    own = [parent for parent in parents if isinstance(parent[0], Node)]
    return Recorded(value, own) if own else value


def linear(x, f: Callable, transpose: Callable):
    """f(x), f being linear."""
    return made(f(value_of(x)), (x, f, transpose))


def with_slopes(value, *slopes: tuple):
    """A value with known derivatives, (array, function that gives the derivative) pairs: of each item of the value by the
    items of the array in the same place of the leading axes, so of the array's shape."""
    value = np.asarray(value)
    axes = [tuple(range(value.ndim, np.ndim(value_of(x)))) for x, _ in slopes]

    def parent(x, slope, axes):
        by = slope() if isinstance(x, Node) else 0.0
        return x, lambda dx: (by * dx).sum(axes), lambda seed: np.expand_dims(seed, axes) * by

    return made(value, *(parent(*pair, own) for pair, own in zip(slopes, axes)))


def times(matrix, x):
    """matrix @ x of a SciPy matrix, with all further axes of x beside each other."""

    def product(A, x):
        return (A @ x.reshape(len(x), -1)).reshape(-1, *x.shape[1:])

    return linear(x, lambda x: product(matrix, x), lambda seed: product(matrix.T, seed))


def summed_at(places: np.ndarray, x, count: int):
    """Sums of what stands in the same places, shape (count, ...): x has the axes of `places`, and others behind."""

    def add(x):
        out = np.zeros((count, *x.shape[places.ndim :]))
        np.add.at(out, places, x)
        return out

    return linear(x, add, lambda seed: seed[places])


def replaced(x, places: np.ndarray, rows):
    """x with other rows in some places."""
    chosen = np.isin(np.arange(len(x)), places).reshape(-1, *[1] * (np.ndim(x) - 1))
    return np.where(chosen, summed_at(places, rows, len(x)), x)


def ratio(a, b):
    """a / b, 0 where b is not above zero."""
    positive = value_of(b) > 0
    return np.where(positive, a / np.where(positive, b, 1.0), 0.0)


# ---- sweeps ------------------------------------------------------------------------------------------------------------


def forward(y, changes: Iterable[tuple[Node, object]]):
    """Change of y for changes of nodes."""
    known = {id(node): change for node, change in changes}
    for node in _before(y):
        if id(node) not in known:
            terms = [push(known[id(p)]) for p, push, _ in node.parents if known.get(id(p)) is not None]
            terms = [term for term in terms if term is not None]
            total = sum(terms[1:], terms[0]) if terms else None
            known[id(node)] = np.broadcast_to(total, node.shape) if terms and isinstance(node, Recorded) else total
    change = known.get(id(y))
    return np.zeros(np.shape(value_of(y))) if change is None else np.array(change)


def reverse(y, seed, leaves: Iterable[Node]) -> list:
    """Adjoints of the leaves for that of y; None where y does not depend on one."""
    known = {id(y): np.asarray(seed, np.float64)}
    for node in reversed(_before(y)):
        if id(node) in known:
            for parent, _, pull in node.parents:
                _add(known, parent, pull(known[id(node)]))
    return [known.get(id(leaf)) for leaf in leaves]


def _add(known: dict, node: Node, more) -> None:
    if more is None:
        return
    if not callable(more):
        more = _unspread(np.asarray(more), node.shape)
        if id(node) not in known:
            known[id(node)] = np.array(more)
            return
    into = known.setdefault(id(node), None)
    if into is None:
        into = known[id(node)] = node.zeros()
    if callable(more):
        more(into)
    else:
        into += more


def _unspread(x: np.ndarray, shape: tuple) -> np.ndarray:
    """The adjoint of what was broadcast from a shape."""
    x = x.sum(tuple(range(x.ndim - len(shape))))
    axes = tuple(k for k, n in enumerate(shape) if n == 1 and x.shape[k] > 1)
    return np.broadcast_to(x.sum(axes, keepdims=True) if axes else x, shape)


def _before(y) -> list[Node]:
    """The nodes that y was made of, in their order, itself the last."""
    found, waiting = {}, [y] if isinstance(y, Node) else []
    while waiting:
        node = waiting.pop()
        if id(node) not in found:
            found[id(node)] = node
            waiting += [parent for parent, *_ in node.parents]
    return sorted(found.values(), key=lambda node: node.number)


# ---- what NumPy does with arrays that record ----------------------------------------------------------------------------


def _moved(function: Callable, given, *more, **how):
    """What a function that moves or repeats numbers makes of an array, or of several."""
    several = isinstance(given, list | tuple)
    parts = list(given) if several else [given]
    ends = np.cumsum([0, *(np.size(value_of(part)) for part in parts)])

    def run(arrays):
        return function(arrays if several else arrays[0], *more, **how)

    at = run([np.arange(a, b).reshape(np.shape(value_of(part))) for a, b, part in zip(ends, ends[1:], parts)])
    none = [np.zeros(np.shape(value_of(part))) for part in parts]

    def parent(k):
        def pull(seed):
            return np.bincount(at.ravel(), seed.ravel(), ends[-1])[ends[k] : ends[k + 1]].reshape(none[k].shape)

        return parts[k], lambda dx: run([*none[:k], dx, *none[k + 1 :]]), pull

    return made(run([value_of(part) for part in parts]), *map(parent, range(len(parts))))


def _matmul(a, b):
    if np.ndim(b) == 1:
        return _matmul(a, b[:, None])[..., 0]
    if np.ndim(a) == 1:
        return _matmul(a[None], b)[..., 0, :]
    A, B = value_of(a), value_of(b)
    by_a = (a, lambda da: da @ B, lambda seed: seed @ np.swapaxes(B, -1, -2))
    return made(A @ B, by_a, (b, lambda db: A @ db, lambda seed: np.swapaxes(A, -1, -2) @ seed))


def _cross(a, b):
    A, B = value_of(a), value_of(b)
    by_a = (a, lambda da: np.cross(da, B), lambda seed: np.cross(B, seed))
    return made(np.cross(A, B), by_a, (b, lambda db: np.cross(A, db), lambda seed: np.cross(seed, A)))


def _einsum(letters: str, *x, optimize=False):
    plain = [value_of(a) for a in x]
    further = [np.ndim(a) - len(word) + 3 for a, word in zip(plain, letters.split("->")[0].split(",")) if "..." in word]
    words, out = letters.replace("...", "ABCDEF"[: max(further, default=0)]).split("->")
    words = words.split(",")

    def parent(k):
        others, own = words[:k] + words[k + 1 :], plain[:k] + plain[k + 1 :]
        kept = "".join(letter for letter in words[k] if letter in "".join((out, *others)))

        def pull(seed):
            found = np.einsum(f"{','.join((out, *others))}->{kept}", seed, *own, optimize=optimize)
            summed = [axis for axis, letter in enumerate(words[k]) if letter not in kept]
            return np.broadcast_to(np.expand_dims(found, tuple(summed)), np.shape(plain[k]))

        return x[k], lambda dx: np.einsum(letters, *plain[:k], dx, *plain[k + 1 :], optimize=optimize), pull

    return made(np.einsum(letters, *plain, optimize=optimize), *map(parent, range(len(x))))


def _where(condition, a, b):
    chosen = value_of(condition)
    by_a = (a, lambda da: np.where(chosen, da, 0.0), lambda seed: np.where(chosen, seed, 0.0))
    by_b = (b, lambda db: np.where(chosen, 0.0, db), lambda seed: np.where(chosen, 0.0, seed))
    return made(np.where(chosen, value_of(a), value_of(b)), by_a, by_b)


def _inv(A):
    B = np.linalg.inv(A.value)
    Bt = np.swapaxes(B, -1, -2)
    return made(B, (A, lambda dA: -B @ dA @ B, lambda seed: -Bt @ seed @ Bt))


def _det(A):
    det = np.linalg.det(A.value)
    return with_slopes(det, (A, lambda: det[..., None, None] * np.swapaxes(np.linalg.inv(A.value), -1, -2)))


def _eigvalsh(A):
    """Where some coincide, changes are those in the directions that the eigenvectors happen to have."""
    n = np.linalg.eigh(A.value)[1]
    push = lambda dA: np.einsum("...ia,...ij,...ja->...a", n, dA, n)  # noqa: E731
    return made(np.linalg.eigvalsh(A.value), (A, push, lambda seed: np.einsum("...ia,...a,...ja->...ij", n, seed, n)))


# derivatives by each argument, of the value and the arguments; that of a root is zero where it is
PARTIALS = {
    np.add: (lambda y, a, b: 1.0, lambda y, a, b: 1.0),
    np.subtract: (lambda y, a, b: 1.0, lambda y, a, b: -1.0),
    np.multiply: (lambda y, a, b: b, lambda y, a, b: a),
    np.divide: (lambda y, a, b: 1 / b, lambda y, a, b: -y / b),
    np.power: (lambda y, a, n: n * a ** (n - 1), lambda y, a, n: y * np.log(a)),
    np.arctan2: (lambda y, a, b: b / (a * a + b * b), lambda y, a, b: -a / (a * a + b * b)),
    np.maximum: (lambda y, a, b: (a >= b) * 1.0, lambda y, a, b: (a < b) * 1.0),
    np.negative: (lambda y, a: -1.0,),
    np.absolute: (lambda y, a: np.sign(a),),
    np.exp: (lambda y, a: y,),
    np.log: (lambda y, a: 1 / a,),
    np.sin: (lambda y, a: np.cos(a),),
    np.cos: (lambda y, a: -np.sin(a),),
    np.sqrt: (lambda y, a: np.divide(0.5, y, out=np.zeros_like(y), where=y > 0),),
}
FUNCTIONS = {
    np.sum: Recorded.sum,
    np.mean: Recorded.mean,
    np.reshape: Recorded.reshape,
    np.swapaxes: Recorded.swapaxes,
    np.moveaxis: lambda x, a, b: linear(x, lambda x: np.moveaxis(x, a, b), lambda seed: np.moveaxis(seed, b, a)),
    np.einsum: _einsum,
    np.cross: _cross,
    np.where: _where,
    np.clip: lambda x, low, high: _where((x > low) & (x < high), x, np.clip(x.value, low, high)),
    np.linalg.norm: lambda x, axis=None, keepdims=False: np.sqrt((x * x).sum(axis, keepdims)),
    np.linalg.inv: _inv,
    np.linalg.solve: lambda A, b: np.linalg.inv(A) @ b,
    np.linalg.det: _det,
    np.linalg.eigvalsh: _eigvalsh,
}
MOVING = {np.stack, np.concatenate, np.broadcast_to, np.repeat, np.tile, np.roll, np.diagonal, np.expand_dims}
WITHOUT = {np.shape, np.ndim, np.size, np.zeros_like, np.ones_like}
