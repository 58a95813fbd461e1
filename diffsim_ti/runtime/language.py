"""What kernels are written with: plain Python that builds their code while they compile; types of their numbers and
vectors."""

from types import SimpleNamespace

import taichi as ti
from taichi.lang import impl
from taichi.lang.expr import Expr  # noqa: F401  what a number of a kernel is
from taichi.types import vector

from diffsim_ti.runtime.start import PRECISIONS

A = ti.template()  # of an argument that is an array, or a Bundle, or known when kernels compile
made = {"variables": 0}  # in all of this process: what decides how long kernels take to compile (tracer.py counts)


def traced(function):
    """Mark a plain Python function that kernels may call: it runs while the kernel is compiled and builds its code."""
    function._is_taichi_function, function.func = True, SimpleNamespace(has_print=False)
    function._is_quadrants_function = False  # that it has this attribute is enough for Quadrants to be silent
    return function


def let(value):
    """A local variable of the kernel that is being compiled, set to `value`. Of such a variable it makes no second one."""
    if getattr(value, "is_let", False):
        return value
    out = impl.expr_init(value)
    if type(out) is impl.Expr:
        out.is_let = True
    return out


def variable(value):
    """A local variable of its own, to be assigned to."""
    return impl.expr_init(value)


def at(array, *index):
    """array[index] in a traced function."""
    return impl.subscript(None, array, *index)


def assign(target, value) -> None:
    """target = value in a traced function, where the target is a variable or an element of an array."""
    target._assign(value)


def num_lanes(value) -> int:
    """How many lanes a number of a kernel has, 0 if it is a scalar."""
    return value.get_shape()[0] if value.is_tensor() else 0


def _in_lanes(numbers: list):
    dtype = impl.Expr(numbers[0]).ptr.get_rvalue_type()
    return let(vector(len(numbers), dtype)(*numbers))


def each_lane(function, *values):
    """function(*values), lane by lane where values have lanes: Taichi has no vector code for log, exp and powers."""
    lanes = max(map(num_lanes, values))
    if not lanes:
        return let(function(*values))
    return _in_lanes([let(function(*(at(v, k) if num_lanes(v) else v for v in values))) for k in range(lanes)])


def spread(value, like):
    """A number with as many lanes as another one."""
    lanes = 0 if num_lanes(value) else num_lanes(like)
    return _in_lanes([value] * lanes) if lanes else value


@traced
class Bundle:
    """Arrays and numbers of a kernel under one name, to hand to Taichi functions; exists only while compiling."""

    _data_oriented = True  # Taichi hands it on as it is

    def __init__(self, **parts):
        self.__dict__.update(parts)


number_type = property(lambda self: PRECISIONS[self.precision], doc="Taichi's type of its numbers.")
vector_type = property(
    lambda self: ti.types.vector(4, PRECISIONS[self.precision]),
    doc="Taichi's type of its vectors: four components, the last zero.",
)


@ti.func
def cross(a, b):
    """a x b of such vectors."""
    return ti.Vector([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0], a[3]])
