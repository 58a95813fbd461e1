"""Taichi's tracer with less ado for each node of source code: the same expressions and messages in two thirds of the time.

Taichi enters a context manager for each node, makes a record of its place in the file for each expression, and asks of each
value which of a dozen types it has. Here what nodes of kernels are most often comes first; all else is left to Taichi.

Taichi copies the value of an assignment, `x = f(y)`, twice, and each argument of a call once more. Half of the variables of
a kernel were such copies, and the time of Taichi's first pass grows with their number squared. Here an assignment makes one
variable, or none where its value is one that never changes, such as another function's `let`; and a function takes such an
argument as it is, unless it changes its parameter. What functions change by reference must be a `variable`. Functions from
elsewhere, of laws and obstacles that users write, keep Taichi's copies; a scalar product or a norm, which take Taichi eight
variables, takes two everywhere.
"""

import ast
import inspect
import operator
from functools import lru_cache, reduce
from pathlib import Path

import numpy as np
from taichi._lib import core
from taichi.lang import impl, matrix_ops, ops
from taichi.lang.any_array import AnyArray
from taichi.lang.ast import ast_transformer
from taichi.lang.ast.ast_transformer import ASTTransformer, build_stmt
from taichi.lang.ast.ast_transformer_utils import Builder, LoopStatus, ReturnStatus
from taichi.lang.exception import TaichiTypeError
from taichi.lang.expr import Expr
from taichi.lang.matrix_ops import matmul
from taichi.types import primitive_types
from taichi.types.annotations import template

from diffsim_ti.runtime.language import at, let, made, traced

_any_node, _any_expr, _any_binary = Builder.__call__, Expr.__init__, ops._binary_operation
_any_subscript, _any_variable, _any_builtin = impl.subscript, impl.expr_init, ASTTransformer.build_call_if_is_builtin
_PLAIN, _NUMBERS, _INTEGERS = (int, float), (int, float, bool, Expr), range(-(2**31), 2**31)
_OPERATORS = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
    ast.LShift: operator.lshift,
    ast.RShift: operator.rshift,
    ast.BitOr: operator.or_,
    ast.BitXor: operator.xor,
    ast.BitAnd: operator.and_,
    ast.MatMult: matmul,
}
_DECORATORS = {
    id(impl.static): "static",
    id(impl.static_assert): "static_assert",
    id(impl.grouped): "grouped",
    id(ast_transformer.ndrange): "ndrange",
}
_record_of = lru_cache(maxsize=None)(core.DebugInfo)  # of a place in a file
_AS_IT_IS = template()  # Taichi copies no argument of a parameter with this annotation
shared: list = []  # parameters that have it while a kernel of ours is traced, some of functions of Taichi's
_PACKAGE = Path(__file__).resolve().parents[1]


class _Fails:
    """A transformer whose every method raises an error, so that Taichi says of it what it says of its own."""

    def __init__(self, error: Exception):
        self.error = error

    def __getattr__(self, name: str):
        def again(context, node):
            raise self.error

        return again


@lru_cache(maxsize=None)
def _method_of(kind: type):
    return getattr(build_stmt, "build_" + kind.__name__, None)


def _node(transformer, context, node):
    """What a node stands for."""
    kind = type(node)
    if kind is ast.Constant:
        node.ptr = node.value
        return node.value
    if kind is ast.Name:
        try:
            return _name(context, node)
        except Exception:
            return _any_node(transformer, context, node)
    method = _method_of(kind)
    if method is None or not isinstance(node, (ast.stmt, ast.expr)):
        return _any_node(transformer, context, node)
    places = impl.pytaichi.src_info_stack
    places.append(context.get_pos_info(node))
    try:
        return method(context, node)
    except Exception as error:
        return _any_node(_Fails(error), context, node)
    finally:
        places.pop()


def _name(context, node: ast.Name):
    name = node.id
    for scope in reversed(context.local_scopes):
        if name in scope:
            found = scope[name]
            break
    else:
        found = context.get_var_by_name(name)
    node.ptr = found
    if isinstance(found, Expr):
        found.dbg_info = _record_of(context.get_pos_info(node))
        found.ptr.set_dbg_info(found.dbg_info)
    return found


def _statements(context, statements: list) -> list:
    scopes = context.local_scopes
    scopes.append({})
    try:
        for statement in statements:
            if context.returned != ReturnStatus.NoReturn or context.loop_status() != LoopStatus.Normal:
                break
            build_stmt(context, statement)
    finally:
        scopes.pop()
    return statements


def _operation(context, node: ast.BinOp):
    left, right = build_stmt(context, node.left), build_stmt(context, node.right)
    try:
        node.ptr = _OPERATORS[type(node.op)](left, right)
    except TypeError as error:
        raise TaichiTypeError(str(error)) from None
    return node.ptr


def _decorator(context, node) -> str:
    """Which of Taichi's words for the tracer itself a call calls, if any."""
    if type(node) is not ast.Call:
        return ""
    names, value = [], node.func
    while isinstance(value, ast.Attribute):
        names.append(value.attr)
        value = value.value
    found = context.global_vars.get(value.id) if isinstance(value, ast.Name) else None
    for name in reversed(names):
        found = getattr(found, name, None)
    return _DECORATORS.get(id(found), "")


def _builtin(context, node, arguments, keywords) -> bool:
    """Whether a call of one of Python's own functions was built."""
    known = getattr(node.func.ptr, "_is_taichi_function", False)
    return False if known else _any_builtin(context, node, arguments, keywords)


def _record():
    """Where the tracer is."""
    return _record_of(impl.pytaichi.src_info_stack[-1])


def _expr(self, *values, dbg_info=None, dtype=None) -> None:
    """Expr(value): a C++ expression, or a small number."""
    value = values[0] if len(values) == 1 else None
    if type(value) is core.Expr:
        own = value
    elif type(value) is Expr and value.ptr_type_checked:
        self.ptr, self.ptr_type_checked, self.dbg_info = value.ptr, True, value.dbg_info
        return
    elif (
        type(value) is int and dtype is None and value in _INTEGERS and impl.pytaichi.default_ip is primitive_types.i32
    ):
        own = core.make_const_expr_int(primitive_types.i32, value)
    else:
        _any_expr(self, *values, dbg_info=dbg_info, dtype=dtype)
        return
    self.ptr, self.dbg_info, self.ptr_type_checked = own, dbg_info, True
    if dbg_info is not None:
        own.set_dbg_info(dbg_info)
    own.type_check(impl.pytaichi.prog.config())


def _binary(of_taichi, of_python, a, b):
    left, right = isinstance(a, Expr), isinstance(b, Expr)
    if not (left and (right or type(b) in _PLAIN) or right and type(a) in _PLAIN):
        return _any_binary(of_taichi, of_python, a, b)
    record = _record()
    if not left:
        a = Expr(a, dbg_info=record)
    if not right:
        b = Expr(b, dbg_info=record)
    return Expr(of_taichi(a.ptr, b.ptr), dbg_info=record)


def _subscript(builder, value, *indices, skip_reordered=False):
    """value[indices] of an array, or a part of a vector."""
    if not isinstance(value, AnyArray) and not (isinstance(value, Expr) and value.is_tensor()):
        return _any_subscript(builder, value, *indices, skip_reordered=skip_reordered)
    group = core.ExprGroup()
    for index in indices:
        if not isinstance(index, Expr):
            if type(index) is not int or index < 0:
                return _any_subscript(builder, value, *indices, skip_reordered=skip_reordered)
            index = Expr(index)
        group.push_back(index.ptr)
    return Expr(impl.pytaichi.compiling_callable.ast_builder().expr_subscript(value.ptr, group, _record()))


@traced
def _reduce(values, function):
    """function(... function(values[0], values[1]) ...), for sums, scalar products and norms."""
    values, shape = let(values), values.get_shape()
    first, *others = (at(values, *index) for index in np.ndindex(*shape))
    return let(reduce(function, others, first))


def _variable(value):
    """A new variable."""
    if type(value) is not Expr:
        return _any_variable(value)
    made["variables"] += 1
    return Expr(impl.pytaichi.compiling_callable.ast_builder().expr_var(value.ptr, _record()))


def may_share(file: str) -> bool:
    """Whether functions of a file are written for it: those of this package, and Taichi's own of vectors and matrices."""
    return file == matrix_ops.__file__ or _PACKAGE in Path(file).resolve().parents


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


def _never_changes(value) -> bool:
    """Whether a value is a number, or a variable that nobody changes."""
    return type(value) in _PLAIN or getattr(value, "is_let", False)


def arguments(function, values: tuple, changed: set[str]) -> tuple:
    """What a Taichi function is called with: what never changes as it is, all else in a variable of its own."""
    passed = []
    for parameter, value in zip(function.arguments, values):
        if parameter.annotation is inspect.Parameter.empty and parameter.name not in changed:
            parameter.annotation = _AS_IT_IS
            shared.append(parameter)
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
        if type(value) in _NUMBERS and not isinstance(target, ast.Tuple):
            _store(context, target, value, may_share=not isinstance(node.value, ast.Name))
            return
        if _is_unpacked(target, value):
            _store_all(context, target.elts, value, may_share=isinstance(node.value, ast.Call))
            return
    value = value if is_static else impl.expr_init(value)
    for target in node.targets:
        ASTTransformer.build_assign_unpack(context, target, value, is_static)


def _is_unpacked(target, values) -> bool:
    """Whether `target = values` gives a number each to as many names or places, of which none is named twice."""
    if not isinstance(target, ast.Tuple) or type(values) not in (tuple, list) or len(values) != len(target.elts):
        return False
    names = [name.id for name in target.elts if isinstance(name, ast.Name)]
    return all(type(v) in _NUMBERS for v in values) and len(set(names)) == len(names)


def _store_all(context, targets: list, values, may_share: bool) -> None:
    """All values are those before the first of them is stored."""
    if not all(_is_new(context, target) for target in targets):
        values = [value if _never_changes(value) else let(value) for value in values]
    for target, value in zip(targets, values):
        _store(context, target, value, may_share)


def _is_new(context, target) -> bool:
    return (
        isinstance(target, ast.Name) and not context.is_var_declared(target.id) and target.id not in context.kernel_args
    )


def _store(context, target, value, may_share: bool) -> None:
    """A new name for a value; what nobody changes is as good as a `let`, and stands for itself if a function made it."""
    if not _is_new(context, target):
        ASTTransformer.build_assign_basic(context, target, value, False)
        return
    own = let(value) if may_share and target.id not in context.changed else impl.expr_init(value)
    own.is_let = target.id not in context.changed
    context.create_variable(target.id, own)


CHANGES = {  # (owner, name) of a function of Taichi's -> what sources.py puts in its place while a kernel of ours is traced
    (ASTTransformer, "__call__"): _node,
    (ASTTransformer, "build_BinOp"): staticmethod(_operation),
    (ASTTransformer, "get_decorator"): staticmethod(_decorator),
    (ASTTransformer, "build_call_if_is_builtin"): staticmethod(_builtin),
    (ASTTransformer, "build_Assign"): staticmethod(_build_assign),
    (ast_transformer, "build_stmts"): _statements,
    (Expr, "__init__"): _expr,
    (ops, "_binary_operation"): _binary,
    (impl, "subscript"): _subscript,
    (matrix_ops, "_reduce"): _reduce,
    (impl, "expr_init"): _variable,
}
