"""Kernels whose loops are gone through many times in one launch, each time by all threads.

Taichi compiles each outermost loop of a kernel to a task of its own, before them one that reads their bounds, and its
launcher goes through a list of tasks. Loops that are to be done n times could be written down n times, which takes n times
as long to compile: half a minute for eight substeps and their adjoints. Here the list names the same loops n times, so that
nothing is compiled twice. Which time it is, loops count in an array (solvers/explicit/kernels.py).
"""

import contextlib
import ctypes
import sys
import threading

import taichi as ti
from taichi.lang import impl

from diffsim_ti.runtime.start import is_alive

_WORD = ctypes.sizeof(ctypes.c_void_p)
_TASK = 6 * _WORD  # a task: its name, a string of four words, the sizes of its grid and blocks, and padding
_MOST_TASKS = 1024  # of a kernel: an iteration with a deep hierarchy has hundreds
KNOWN = ti.__version__ == (1, 7, 4) and sys.platform == "linux"  # the build of Taichi whose objects are known


def _word(address: int) -> int:
    return ctypes.c_void_p.from_address(address).value or 0


def can_repeat() -> bool:
    """Whether loops can be repeated: where Taichi is the build whose objects are known, and compiles by LLVM."""
    return KNOWN and impl.current_cfg().arch in (ti.x64, ti.arm64, ti.cuda)


class RepeatedLoops:
    """A compiled kernel, code, whose first `loops` loops are gone through n times before what follows them; -1: all its
    tasks.

    Taichi has no door for this. Its object holds a list of tasks, and the number under which the launcher knows the kernel,
    given at its first launch with a copy of that list. Both are others while a launch takes place here, and then again what
    they were. Each n has a number, and the driver a copy of the kernel, of its own.
    Source: Taichi 1.7.4, codegen/llvm/compiled_kernel_data.h and runtime/cuda/kernel_launcher.cpp.
    """

    _numbers: dict[tuple, int] = {}  # by address of the kernel and n, of the program that runs
    _owner, _lock = None, threading.Lock()

    def __init__(self, code, owner, loops: int):
        # pybind11 keeps the C++ object behind Python's header
        self._data, self._loops = _word(id(code) + object.__basicsize__), loops
        self._number = (ctypes.c_int32 * 2).from_address(self._data + _WORD)  # and whether there is one
        self._tasks = (ctypes.c_void_p * 3).from_address(
            self._data + 10 * _WORD
        )  # the first, behind the last, free memory
        if RepeatedLoops._owner is None or not is_alive(RepeatedLoops._owner):
            RepeatedLoops._owner, RepeatedLoops._numbers = owner, {}
        self._check()

    def _check(self) -> None:
        expected = ["serial", *["range_for"] * self._loops]
        found = [name.split("_kernel_")[-1].partition("_")[2] for name in self._names()]
        if self._loops < 0:
            expected = [task for task in found if task in ("serial", "range_for")] or ["serial"]
        if found[: len(expected)] != expected or self._loops < 0 and found != expected:
            raise RuntimeError(
                f"this build of Taichi compiled a kernel to tasks {found or 'of an unknown layout'}, where version 1.7.4 "
                f"has {expected}: install taichi==1.7.4"
            )

    def _names(self) -> list[str]:
        first, behind, _ = (word or 0 for word in self._tasks)
        count, rest = divmod(behind - first, _TASK)
        if rest or not 0 < count < _MOST_TASKS:
            return []
        return [
            ctypes.string_at(_word(task), _word(task + _WORD)).decode("ascii", "replace")
            for task in range(first, behind, _TASK)
        ]

    def _repeated(self, n: int) -> ctypes.Array:
        """The list of tasks with its loops n times; texts of names stay where they are."""
        first, behind, _ = self._tasks
        text, end = ctypes.string_at(first, behind - first), _TASK * (1 + self._loops)
        text = n * text if self._loops < 0 else text[:_TASK] + n * text[_TASK:end] + text[end:]
        return ctypes.create_string_buffer(text, len(text))

    @contextlib.contextmanager
    def times(self, n: int):
        """Launches of the kernel in a `with` block go through its loops n times."""
        key = self._data, n
        with self._lock:
            number, tasks = tuple(self._number), tuple(self._tasks)
            if key in self._numbers:
                self._number[:] = self._numbers[key], 1
            else:
                longer = self._repeated(n)
                first = ctypes.addressof(longer)
                self._tasks[:] = first, first + len(longer), first + len(longer)
                self._number[1] = 0
            try:
                yield
                self._numbers[key] = self._number[0]
            finally:
                self._tasks[:], self._number[:] = tasks, number
