"""Kernels whose signatures are made from descriptions of their arrays, so that none is typed by hand."""

import linecache
from collections.abc import Callable
from functools import lru_cache
from itertools import count
from types import MethodType

import taichi as ti

from diffsim_ti.runtime.language import Bundle
from diffsim_ti.runtime.launch import Launch
from diffsim_ti.runtime.quadrants import QUADRANTS
from diffsim_ti.runtime.repeated_loops import can_repeat
from diffsim_ti.runtime.start import PRECISIONS, runs_on_cpu

if QUADRANTS:  # has a tracer of its own
    kernel = ti.kernel
else:
    from diffsim_ti.runtime.sources import kernel

LANES = 8  # tetrahedra in a block
ROWS = {3: ti.types.vector(4, ti.f32), 6: ti.types.vector(8, ti.f32)}  # three or six numbers of a preconditioner
_serial = count()


def array_types(precision: str) -> dict:
    """Taichi's annotation for each kind of array, and for numbers "int" and "float"."""
    fp = PRECISIONS[precision]
    vector, lanes = ti.types.vector(4, fp), ti.types.vector(LANES, fp)
    ndarray = ti.types.ndarray
    return {
        "ints": ndarray(ti.i32, 1),
        "scalars": ndarray(fp, 1),
        "scalars2": ndarray(fp, 2),
        "vectors": ndarray(vector, 1),
        "vectors2": ndarray(vector, 2),
        "blocks": ndarray(lanes, 1),
        "blocks2": ndarray(lanes, 2),
        "vectors2_f32": ndarray(ti.types.vector(4, ti.f32), 2),
        "vectors2_f64": ndarray(ti.types.vector(4, ti.f64), 2),
        "singles": ndarray(ti.f32, 1),
        "doubles": ndarray(ti.f64, 1),
        "rows3": ndarray(ROWS[3], 1),
        "rows6": ndarray(ROWS[6], 1),
        "int": ti.i32,
        "float": fp,
    }


class Kernel:
    """A Taichi kernel whose code is `body(*bundles, numbers)`; loops of the body are loops of the kernel.

    arrays: {bundle: {array: kind}}, kinds as in `array_types`; each bundle reaches the body as a `Bundle` of its arrays,
    and `numbers`, {name: "int" or "float"}, as one more.
    loops: so many of its first loops are gone through as often as the last number says (repeated_loops.py); 0: once.
    polished: also by Taichi's own passes (Launch).
    """

    def __init__(
        self,
        name: str,
        body: Callable,
        precision: str,
        arrays: dict[str, dict],
        numbers: dict[str, str],
        loops: int = 0,
        polished: bool = False,
    ):
        if "times" in numbers:  # which launches take from the last number, wherever who describes the kernel names it
            numbers = {n: kind for n, kind in numbers.items() if n != "times"} | dict(times=numbers["times"])
        self.arrays, self.numbers, self.options = arrays, tuple(numbers), dict(loops=loops, polished=polished)
        owner = getattr(body, "__self__", None)
        law = getattr(owner, "law", None) or getattr(getattr(owner, "element", None), "law", None)
        self.of_law = f" of {law.title}" if hasattr(law, "title") else ""
        self.options["title"] = f"the kernel {name}{self.of_law}"
        self.body, self._types, self.kinds = body, array_types(precision), numbers
        first, call, arguments = self.call("body", {})
        self.kernel = _compiled(name, arguments, [*first, call], dict(body=body))

    @property
    def variables(self) -> int:
        """Its local variables, by whose square its compile time grows; 0 before its first launch."""
        return getattr(self.kernel._primal, "variables", 0)

    def call(self, body: str, names: dict, prefix: str = "") -> tuple[list, str, dict]:
        """(lines before all loops, the line that calls the body, {argument: type}) in the source of a kernel; names: of the
        arguments that have others there, {(bundle, array): argument}."""
        types, arguments, bundles = self._types, {}, []
        for bundle, own in self.arrays.items():
            mine = {a: names.get((bundle, a), f"{prefix}{bundle}_{a}") for a in own}
            arguments |= {mine[a]: types[kind] for a, kind in own.items()}
            bundles.append(f"Bundle({', '.join(f'{a}={argument}' for a, argument in mine.items())})")
        arguments |= {prefix + n: types[kind] for n, kind in self.kinds.items()}
        # a GPU takes one task more, of one thread, for the bounds of each loop, but one for all that are read before them
        first = [] if runs_on_cpu() else [n for n, kind in self.kinds.items() if kind == "int"]
        numbers = ", ".join(f"{n}={prefix}{n}_" if n in first else f"{n}={prefix}{n}" for n in self.kinds)
        lines = [f"{prefix}{n}_ = {prefix}{n}" for n in first]
        return lines, f"{body}({', '.join([*bundles, f'Bundle({numbers})'])})", arguments

    def bind(self, vectorized: bool = False, **records) -> Callable:
        """The kernel with its arrays bound; call it with the numbers, by name.

        records: for each bundle the object whose attributes its arrays are, or a tuple of objects that share them.
        """
        arrays = [_found(records[bundle], name) for bundle, own in self.arrays.items() for name in own]
        launch, names = Launch(self.kernel, *arrays, vectorized=vectorized, **self.options), self.numbers
        return lambda **numbers: launch(*map(numbers.__getitem__, names))


class as_kernel:
    """Decorator of a method that is the code of a kernel: as an attribute it is that `Kernel`, which the object's own
    `_kernel(name, body, *described, **more)` makes once. What depends on the object is given as a function of it."""

    def __init__(self, name: str, *described, **more):
        self.name, self.described, self.more = name, described, more

    def __call__(self, body: Callable) -> "as_kernel":
        body.__annotations__["self"] = ti.template()  # Taichi knows methods by the line that calls `ti.func`
        self.__doc__, self.body = body.__doc__, ti.func(body)
        return self

    def __set_name__(self, kind: type, attribute: str):
        self.attribute = attribute

    def __get__(self, owner, kind: type | None = None) -> "Kernel | as_kernel":
        if owner is None:
            return self
        described = [x(owner) if callable(x) else x for x in self.described]
        more = {name: x(owner) if callable(x) else x for name, x in self.more.items()}
        made = owner._kernel(self.name, MethodType(self.body, owner), *described, **more)
        vars(owner)[self.attribute] = made
        return made


def _compiled(name: str, arguments: dict, lines: list, scope: dict):
    """The kernel of such a source; scope: what its names are."""
    signature = ", ".join(f"{argument}: types[{k}]" for k, argument in enumerate(arguments))
    source = f"def {name}({signature}):\n" + "".join(f"    {line}\n" for line in lines)
    file = f"<{name} {next(_serial)}>"
    linecache.cache[file] = (len(source), None, source.splitlines(True), file)  # Taichi reads a kernel's source
    scope = dict(scope, Bundle=Bundle, ti=ti, types=list(arguments.values()))
    exec(compile(source, file, "exec"), scope)
    return kernel(scope[name])


def named_arrays(parts: list) -> tuple[tuple, list]:
    """(names of the arguments of each part, as pairs ((bundle, array), argument); the arrays, each once) of several kernels
    with their records that are one kernel."""
    known, arrays, names = {}, [], []
    for k, (kernel, records) in enumerate(parts):
        own = {(b, a): _found(records[b], a) for b, of in kernel.arrays.items() for a in of}
        for (b, a), array in own.items():
            if id(array) not in known:
                known[id(array)] = f"k{k}_{b}_{a}"
                arrays.append(array)
        names.append(tuple((place, known[id(array)]) for place, array in own.items()))
    return tuple(names), arrays


class Repeated:
    """Kernels one after the other, again and again in one launch: `launch(times, **numbers)`.

    groups: lists of (kernel, records, numbers), records as of `Kernel.bind`; an array that several of them take is one
    argument; numbers: None where they are those of the launch, else a dictionary, of which they are taken then. The body
    of the first of a group says whether the others are wanted. On one thread of the processor it is asked each time;
    elsewhere the others themselves do nothing once they are not wanted, in a list of tasks that names them so often
    (repeated_loops.py). pieces: how kernels of one of many bodies see the arrays of all (piecewise.py).
    """

    def __init__(self, name: str, groups: list[list], parallel: bool, vectorized: bool = False, pieces=None):
        parts = [part for group in groups for part in group]
        names, arrays = named_arrays([(kernel, records) for kernel, records, _ in parts])
        kernels, own_numbers = tuple(kernel for kernel, *_ in parts), [numbers for *_, numbers in parts]
        one_thread, shared = runs_on_cpu() and not parallel, tuple(numbers is None for numbers in own_numbers)
        made, numbers = _repeated_kernel(name, kernels, names, shared, tuple(map(len, groups)), one_thread, pieces)
        title = f"the kernel {name}" + next((k.of_law for k in kernels if k.of_law), "")
        options = dict(title=title, loops=0 if one_thread else -1)
        self._launch = Launch(made, *arrays, vectorized=vectorized, **options)
        self._numbers = [(n, None if k is None else own_numbers[k]) for k, n in numbers]
        self._sizes = None if one_thread else (16, 4, 1)  # of launches: the driver compiles each number of times anew

    _more = ()  # numbers before the last one

    @staticmethod
    def is_possible(parallel: bool) -> bool:
        """Whether this machine can: Vulkan's drivers lend a kernel too few arrays."""
        return runs_on_cpu() and not parallel or can_repeat()

    def __call__(self, times: int, **numbers) -> None:
        self._go(times, numbers)

    def _go(self, times: int, numbers) -> None:
        given = [(numbers if own is None else own)[n] for n, own in self._numbers]
        while times:
            size = next(n for n in self._sizes if n <= times) if self._sizes else times
            self._launch(*given, *self._more, size)
            times -= size


@lru_cache(maxsize=None)
def _repeated_kernel(
    name: str, kernels: tuple, names: tuple, shared: tuple, sizes: tuple, one_thread: bool, pieces=None
):
    """(the kernel, its numbers as (place of the part that they are of, name)); shared: whether those of a part are not its
    own, so that the place is None; sizes: of the groups."""
    lines, calls, arrays, numbers, scope = [], [], {}, {}, {}
    for k, (kernel, own) in enumerate(zip(kernels, names)):
        prefix = "" if shared[k] else f"k{k}_"
        first, call, arguments = kernel.call(f"body{k}", dict(own), prefix)
        of_numbers = {prefix + n: (None if shared[k] else k, n) for n in kernel.numbers}
        arrays |= {a: kind for a, kind in arguments.items() if a not in of_numbers and a not in arrays}
        numbers |= {a: (arguments[a], place) for a, place in of_numbers.items()}
        scope[f"body{k}"] = pieces.body_of(kernel) if pieces else kernel.body
        call = call.replace("(", f"({pieces.arguments}, ", 1) if pieces else call
        lines, calls = lines + [line for line in first if line not in lines], [*calls, call]
    more, space = dict.fromkeys((*(pieces.numbers if pieces else ()), "times"), ti.i32), "    "
    if pieces:
        lines, space = [*lines, *pieces.loop, "        for _ in range(times):"], 3 * space
    elif one_thread:
        lines += ["ti.loop_config(serialize=True)", "for _ in range(times):"]
    for size in sizes:
        (asks, *own), calls = calls[:size], calls[size:]
        lines += [f"{space}if {asks}:", *(f"{space}    {call}" for call in own)] if one_thread else own
    kinds = {a: kind for a, (kind, _) in numbers.items()}
    return _compiled(name, arrays | kinds | more, lines, scope), [place for _, place in numbers.values()]


@lru_cache(maxsize=None)
def kernels_of(kind: type, *fields):
    """The object kind(*fields) that all share, so that its kernels compile once in a process."""
    return kind(*fields)


def _found(record, name: str):
    parts = record if type(record) is tuple else (record,)
    return next(getattr(part, name) for part in parts if hasattr(part, name))
