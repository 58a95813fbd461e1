"""Taichi functions of this package that make no more variables than they need.

Taichi copies the value of an assignment, `x = f(y)`, twice, and each argument of a call once more. Half of the variables of
a kernel were such copies, and the time of Taichi's first pass grows with their number squared. Here an assignment makes one
variable, or none where its value is one that never changes, such as another function's `let`; and a function takes such an
argument as it is, unless it changes its parameter. What functions change by reference must be a `variable`. Functions from
elsewhere, of laws and obstacles that users write, keep Taichi's copies.
"""

import ast
import inspect
from pathlib import Path

from taichi.lang import impl
from taichi.lang.ast.ast_transformer import ASTTransformer, build_stmt
from taichi.lang.expr import Expr
from taichi.types.annotations import template

from diffsim_ti.runtime.language import let

_AS_IT_IS = template()  # Taichi copies no argument of a parameter with this annotation
_PACKAGE = Path(__file__).resolve().parents[1]


def may_share(file: str) -> bool:
    """Whether functions of a file are written for it: those of this package."""
    return _PACKAGE in Path(file).resolve().parents


def changed_names(function: ast.FunctionDef) -> set[str]:
    """The names that a function stores more than once, parameters included, or changes in part."""
    stored, changed = {argument.arg for argument in function.args.args}, set()
    for node in ast.walk(function):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            changed |= stored & {node.id}
            stored.add(node.id)
        elif isinstance(node, (ast.Subscript, ast.Attribute)) and isinstance(node.ctx, ast.Store):
            changed |= {name.id for name in ast.walk(node.value) if isinstance(name, ast.Name)}
        elif isinstance(node, ast.Call):  # ti.atomic_add(x, y) changes x
            named = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if named.startswith("atomic_"):
                changed |= {name.id for name in ast.walk(node.args[0]) if isinstance(name, ast.Name)}
    return changed


def arguments(function, values: tuple, changed: set[str]) -> tuple:
    """What a Taichi function is called with: what never changes as it is, all else in a variable of its own."""
    passed = []
    for parameter, value in zip(function.arguments, values):
        if parameter.annotation is inspect.Parameter.empty and parameter.name not in changed:
            parameter.annotation = _AS_IT_IS
        if parameter.annotation is _AS_IT_IS:
            value = let(value) if type(value) is Expr else impl.expr_init_func(value)
        elif (
            isinstance(parameter.annotation, template) and parameter.name in changed and getattr(value, "is_let", False)
        ):
            raise TypeError(f"{function.func.__qualname__} changes {parameter.name}: give it a variable()")
        passed.append(value)
    return tuple(passed)


def _build_assign(context, node: ast.Assign) -> None:
    """`x = y`, `x, y = z`, `x[i] = y`; what Taichi does, by fewer variables where x and y are new, or parts of arrays."""
    build_stmt(context, node.value)
    value, target = node.value.ptr, node.targets[0]
    is_static = isinstance(node.value, ast.Call) and node.value.func.ptr is impl.static
    if not is_static and len(node.targets) == 1 and vars(context).get("changed") is not None:
        if type(value) is Expr and _is_new(context, target):
            _store(context, target.id, value, may_share=not isinstance(node.value, ast.Name))
            return
        if type(value) is Expr and not isinstance(target, ast.Tuple):
            ASTTransformer.build_assign_basic(context, target, value, False)
            return
        if _are_new(context, target, value):
            for name, part in zip(target.elts, value):
                _store(context, name.id, part, may_share=isinstance(node.value, ast.Call))
            return
    value = value if is_static else impl.expr_init(value)
    for target in node.targets:
        ASTTransformer.build_assign_unpack(context, target, value, is_static)


def _is_new(context, target) -> bool:
    return (
        isinstance(target, ast.Name) and not context.is_var_declared(target.id) and target.id not in context.kernel_args
    )


def _are_new(context, target, values) -> bool:
    """Whether `target = values` gives a number each to as many new names."""
    if not isinstance(target, ast.Tuple) or type(values) not in (tuple, list) or len(values) != len(target.elts):
        return False
    if not all(type(v) is Expr for v in values) or not all(_is_new(context, name) for name in target.elts):
        return False
    return len({name.id for name in target.elts}) == len(values)


def _store(context, name: str, value: Expr, may_share: bool) -> None:
    """A new name for a value; what nobody changes is as good as a `let`, and stands for itself if a function made it."""
    if name in context.changed:
        own = impl.expr_init(value)
    else:
        own = let(value) if may_share else impl.expr_init(value)
        own.is_let = True
    context.create_variable(name, own)


CHANGES = {(ASTTransformer, "build_Assign"): staticmethod(_build_assign)}  # as in tracer.py
