"""What Taichi's tracer asks of source code, answered faster.

Taichi traces a function anew wherever it is called. Each time it reads and parses the file, and for each node it wraps
lines to 80 columns for a message that only an error shows: more than half of its time before LLVM starts.

A number cast to a float type is a constant of that type. Taichi makes a constant of another and a cast, and takes each such
pair out again by a walk through the whole kernel: its time grows with the square of a kernel's length.
"""

import ast
import inspect
import textwrap
from contextlib import contextmanager, nullcontext

import taichi as ti
from taichi._lib import core
from taichi.lang import kernel_impl, ops
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
from taichi.lang.expr import Expr
from taichi.lang.util import cook_dtype
from taichi.types import primitive_types

from diffsim_ti.runtime import tracer
from diffsim_ti.runtime.language import traced
from diffsim_ti.runtime.threads import LOCK

_of_kernels, _trace, _any_cast = kernel_impl._get_tree_and_ctx, kernel_impl.transform_tree, ops.cast
_sources: dict = {}  # by code: functions that a factory makes share theirs


class _Source:
    """The text of a function, and its trees that no trace of it uses now: one, or more if it calls itself."""

    def __init__(self, function):
        lines, self.start = kernel_impl.getsourcelines(function)
        self.file = kernel_impl.getsourcefile(function)
        self.lines = [textwrap.fill(line, tabsize=4, width=9999) for line in lines]
        self.free, self.changed = [], None
        if tracer.may_share(self.file):
            self.free.append(self.take())
            self.changed = tracer.changed_names(self.free[0].body[0])

    def take(self) -> ast.Module:
        if self.free:
            return self.free.pop()
        tree = ast.parse(textwrap.dedent("\n".join(self.lines)))
        tree.body[0].decorator_list = []
        tree.source, tree.nodes = (
            self,
            [n for n in ast.walk(tree) if not isinstance(n, (ast.expr_context, ast.operator))],
        )
        return tree

    def give_back(self, tree: ast.Module) -> None:
        for node in tree.nodes:  # what the tracer wrote there
            found = vars(node)
            found.pop("ptr", None)
            found.pop("caller", None)
        self.free.append(tree)


def _tree_and_context(function, *args, is_kernel: bool = True, is_real_function: bool = False, **more):
    if is_kernel or is_real_function:
        return _of_kernels(function, *args, is_kernel=is_kernel, is_real_function=is_real_function, **more)
    code = function.func.__code__
    source = _sources.get((code.co_filename, code))
    if source is None:
        source = _sources[code.co_filename, code] = _Source(function.func)
    context = ASTTransformerContext(
        is_kernel=False,
        func=function,
        global_vars=kernel_impl._get_global_vars(function.func),
        argument_data=more["args"]
        if source.changed is None
        else tracer.arguments(function, more["args"], source.changed),
        src=source.lines,
        start_lineno=source.start,
        file=source.file,
        ast_builder=more["ast_builder"],
    )
    context.changed = source.changed
    return source.take(), context


def _transform(tree: ast.Module, context: ASTTransformerContext):
    try:
        return _trace(tree, context)
    finally:
        if hasattr(tree, "source"):
            tree.source.give_back(tree)


def _place(context, node) -> str:
    """Where a node stands in its file, for messages: as Taichi says it, without wrapping, and its first line alone."""
    place = vars(node).get("place")
    if place is None:
        line = context.src[node.lineno - 1]
        first = context.indent + node.col_offset
        behind = context.indent + node.end_col_offset if node.end_lineno == node.lineno else len(line.rstrip())
        name, number = context.func.func.__name__, node.lineno + context.lineno_offset
        marks = " " * first + "^" * (behind - first)
        place = node.place = f'File "{context.file}", line {number}, in {name}:\n{line.rstrip()}\n{marks}\n'
    return place


@traced
def _cast(obj, dtype):
    dtype = cook_dtype(dtype)
    if type(obj) in (int, float) and dtype in primitive_types.real_types:
        return Expr(core.make_const_expr_fp(dtype, float(obj)))
    return _any_cast(obj, dtype)


_CHANGES = {
    (kernel_impl, "_get_tree_and_ctx"): _tree_and_context,
    (kernel_impl, "transform_tree"): _transform,
    (ti, "cast"): _cast,
    (ops, "cast"): _cast,
    (ASTTransformerContext, "get_pos_info"): _place,
    **tracer.CHANGES,
}
_INHERITED = object()


@contextmanager
def _faster():
    """Taichi traces with these answers until the end of the block; the lock keeps other threads from compiling meanwhile."""
    with LOCK:
        before = {(owner, name): vars(owner).get(name, _INHERITED) for owner, name in _CHANGES}
        try:
            for (owner, name), own in _CHANGES.items():
                setattr(owner, name, own)
            yield
        finally:
            while tracer.shared:
                tracer.shared.pop().annotation = inspect.Parameter.empty
            for (owner, name), own in before.items():
                delattr(owner, name) if own is _INHERITED else setattr(owner, name, own)


def kernel(function):
    """`ti.kernel` for kernels of this package, which are traced faster. Kernels of others are left as they are."""
    made = ti.kernel(function)
    primal, materialize = made._primal, made._primal.materialize

    def faster(key=None, **more):
        with _faster() if key not in primal.compiled_kernels else nullcontext():
            materialize(key=key, **more)

    primal.materialize = faster
    return made
