"""What kernels are written with: plain Python that builds their code while they compile."""

from types import SimpleNamespace

from taichi.lang import impl


def traced(function):
    """Mark a plain Python function that kernels may call: it runs while the kernel is compiled and builds its code."""
    function._is_taichi_function, function.func = True, SimpleNamespace(has_print=False)
    return function


def let(value):
    """A local variable of the kernel that is being compiled, set to `value`."""
    return impl.expr_init(value)


def at(array, *index):
    """array[index] in a traced function."""
    return impl.subscript(None, array, *index)


@traced
class Bundle:
    """Arrays and numbers of a kernel under one name, to hand to Taichi functions; exists only while compiling."""

    _data_oriented = True  # Taichi hands it on as it is

    def __init__(self, **parts):
        self.__dict__.update(parts)
