"""Kernels with their arrays bound once, launched many times."""

import contextlib
import ctypes
import logging
import os
import signal
import subprocess
import sys
from collections import deque
from itertools import repeat

import numpy as np
import taichi as ti
from taichi.lang import impl
from taichi.types import primitive_types

from diffsim_ti.common import ranks
from diffsim_ti.common.progress import LOG
from diffsim_ti.runtime.arrays import check_owner, full_shape
from diffsim_ti.runtime.language import made
from diffsim_ti.runtime.quadrants import QUADRANTS
from diffsim_ti.runtime.repeated_loops import KNOWN, RepeatedLoops
from diffsim_ti.runtime.start import arch_name, check_alive, program
from diffsim_ti.runtime.threads import LOCK, materialize, untaped

PATIENCE, SHORT = 5, 500  # [s]; variables of kernels that take less than a second
MOST_BYTES = 2**20  # of a list of functions, which names those of loops as often as they are gone through
_WORD = ctypes.sizeof(ctypes.c_void_p)
_TASK = ctypes.PYFUNCTYPE(ctypes.c_int32, ctypes.c_void_p)  # which keeps Python's lock, as Taichi's launcher does


class Launch:
    """A kernel with its arrays bound once, launched many times with other numbers.

    A plain call looks at every argument anew, 5 us for each array; this sets numbers that changed alone, and on a processor
    calls what Taichi has compiled (`compiled_tasks`).
    vectorized: compile vectors as they are, to vector instructions, instead of number by number: on the CPU, and on CUDA,
    which moves the four numbers of a vertex at once, where no function such as a logarithm takes a vector.
    polished: also by Taichi's own passes, whose time grows with the square of a kernel's length. LLVM repeats most of what
    they do: without them the same bits, and a third of the compile time for scenes with many terms; but short kernels that
    run all the time are a tenth faster with them.
    loops: so many of its first loops are gone through as often as the last number says (repeated_loops.py); 0: once; -1: all
    its tasks are.
    title: what it is, for who waits until it is compiled.
    """

    def __init__(
        self, kernel, *arrays, vectorized: bool = False, polished: bool = False, loops: int = 0, title: str = ""
    ):
        for array in arrays:
            check_owner(array)
        self._kernel, self._arrays, self._loops = kernel._primal, arrays, loops
        self._options = dict(real_matrix_scalarize=not vectorized, advanced_optimization=polished)
        self._setters, self._buffer, self._repeated, self._owner = None, None, None, program()
        self._read, self._tasks = None, {}  # what compiled functions read; these, by how often loops are gone through
        self._title = title or f"the kernel {kernel._primal.func.__name__}"

    def _prepare(self, numbers: tuple) -> None:
        prog = impl.get_runtime().prog
        config, kernel = prog.config(), self._kernel
        with _settings(config, **self._options):
            materialize()
            before = made["variables"]
            compiled = kernel.compiled_kernels[kernel.ensure_compiled(*self._arrays, *numbers)]
            self.variables = made["variables"] - before  # that were traced here
            kernel.variables = max(self.variables, getattr(kernel, "variables", 0))
            self._code = self._compile(prog, config, compiled)
        if self._loops:
            self._repeated = RepeatedLoops(self._code, self._owner, self._loops)
        self._context, arch = compiled.make_launch_context(), arch_name()
        if arch == "cuda":
            self._buffer = ArgumentBuffer(self._context)
        if KNOWN and arch == "cpu" and not config.debug:  # which the launcher looks at after each launch
            self._read = _word(_object(self._context) + 2 * _WORD).value
        for k, array in enumerate(self._arrays):
            if not isinstance(array, ti.Ndarray):  # a torch tensor, set at each launch
                continue
            if (
                arch == "cpu"
            ):  # a launch replaces an array by its raw pointer, so that a context could not be used twice
                pointer, size = prog.get_ndarray_data_ptr_as_int(array.arr), int(np.prod(full_shape(array))) * 8
                self._context.set_arg_external_array_with_shape((k,), pointer, size, tuple(array.shape), 0)
            else:
                self._context.set_arg_ndarray((k,), array.arr)
        kinds = kernel.arguments[len(self._arrays) :]
        floats = [id(argument.annotation) in primitive_types.real_type_ids for argument in kinds]
        self._setters = [
            ((self._context.set_arg_float if is_float else self._context.set_arg_int), (k,))
            for k, is_float in enumerate(floats, start=len(self._arrays))
        ]
        self._set, self._last = [None] * len(floats), None  # the numbers as the context has them

    def _compile(self, prog, config, traced):
        with say_if_long(f"compiling {self._title}") if self.variables > SHORT else contextlib.nullcontext():
            return prog.compile_kernel(config, prog.get_device_caps(), traced)

    def __call__(self, *numbers) -> None:
        check_alive(self._owner)
        with LOCK:
            if self._owner() is None:  # by a thread that was waited for
                check_alive(self._owner)
            self._launch(numbers)

    def _launch(self, numbers: tuple) -> None:
        if QUADRANTS:  # keeps what a kernel was compiled to, and its arguments, by itself
            config = impl.get_runtime().prog.config()
            with _settings(config, **self._options):
                untaped(self._kernel)(*self._arrays, *numbers)
            return
        if self._setters is None:
            self._prepare(numbers)
        if self._buffer:
            self._buffer.restore()
        if numbers != self._last or 0 in numbers:  # of which -0.0 is equal to 0.0
            known, self._last = self._set, None  # also if this is interrupted
            for k, (setter, index) in enumerate(self._setters):
                number = numbers[k]
                if number is not known[k] and (number != known[k] or number == 0):  # a third of a microsecond each
                    known[k] = None
                    setter(index, number)
                    known[k] = number
            self._last = numbers
        times = numbers[-1] if self._loops else 1
        tasks = self._tasks.get(times)
        if tasks:
            if len(tasks) == 1:
                tasks[0](self._read)
            else:  # without a line of Python between them, where an interrupt would end half a launch
                deque(map(_TASK.__call__, tasks, repeat(self._read)), maxlen=0)
            return
        with self._repeated.times(times) if self._repeated else contextlib.nullcontext():
            self._owner().launch_kernel(self._code, self._context)
            tasks = compiled_tasks(self._owner(), self._code) if self._read else None
            if tasks:
                self._tasks[times] = tasks


@contextlib.contextmanager
def say_if_long(what: str):
    """Say so on stderr, once, if a `with` block of Taichi takes longer than PATIENCE [s] and the logger "diffsim_ti" shows
    warnings.

    The compiler holds Python's lock, so that no thread of this process could say it, and no interrupt is heard: another
    process waits, and is ended if the block ends first. Of several ranks the first one says it.
    """
    text = f"diffsim_ti: {what} takes longer than {PATIENCE} s; an interrupt (Ctrl-C) is heard when it is done"
    waiting = None
    if os.name == "posix" and ranks.is_first() and LOG.isEnabledFor(logging.WARNING):
        with contextlib.suppress(OSError):
            script = 'sleep "$1"; kill -0 "$2" 2> /dev/null && echo "$3" >&2'
            arguments = ["sh", "-c", script, "sh", str(PATIENCE), str(os.getpid()), text]
            waiting = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, start_new_session=True)
    try:
        yield
    finally:
        if waiting:
            with contextlib.suppress(OSError):
                os.killpg(waiting.pid, signal.SIGKILL)
            waiting.wait()


@contextlib.contextmanager
def _settings(config, **values):
    """Taichi's options while one kernel is compiled."""
    before = {name: getattr(config, name) for name in values}
    try:
        for name, value in values.items():
            setattr(config, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(config, name, value)


class TensorLaunch(Launch):
    """A kernel whose first arguments are torch tensors, other ones at each launch; its arrays are bound once."""

    def _launch(self, tensors: tuple) -> None:
        if QUADRANTS:
            untaped(self._kernel)(*tensors, *self._arrays)
            return
        if self._setters is None:
            arrays = self._arrays
            self._arrays = (*tensors, *arrays)
            self._prepare(())
            self._arrays = arrays  # keeps no tensor alive
        if self._buffer:
            self._buffer.restore()
        for k, tensor in enumerate(tensors):
            size = tensor.numel() * tensor.element_size()
            self._context.set_arg_external_array_with_shape((k,), tensor.data_ptr(), size, tuple(tensor.shape), 0)
        self._owner().launch_kernel(self._code, self._context)


def _word(address: int) -> ctypes.c_void_p:
    return ctypes.c_void_p.from_address(address)


def _object(python) -> int:
    """The address of the C++ object that pybind11 keeps behind Python's header."""
    return _word(id(python) + object.__basicsize__).value


def compiled_tasks(prog, code) -> list | None:
    """The functions of a kernel that was launched on a processor, to be called with the address of what they read; None
    where something else lies there.

    Taichi's launcher looks for the address of each array again each time, for half a microsecond. It has no door to what it
    calls then: the list of a kernel's functions lies in its object, under the kernel's number. What is read here is read as
    a file, so that a wrong address is an error and no crash, and must be code.
    Source: Taichi 1.7.4, program/program.h, runtime/cpu/kernel_launcher.h.
    """
    try:
        with open("/proc/self/mem", "rb", buffering=0) as memory:
            word = lambda address: int.from_bytes(os.pread(memory.fileno(), _WORD, address), sys.byteorder)  # noqa: E731
            launcher = word(word(_object(prog) + 87 * _WORD) + 3 * _WORD)
            number = word(_object(code) + _WORD) & 0xFFFFFFFF
            own = word(launcher + 3 * _WORD) + 6 * _WORD * number
            first, behind = word(own), word(own + _WORD)
            size = behind - first if behind - first < MOST_BYTES else 0
            places = np.frombuffer(os.pread(memory.fileno(), size, first), np.uintp).tolist()
        if not _are_code(places):  # nor have been before
            with open("/proc/self/maps", encoding="utf-8", errors="replace") as maps:
                rows = (line.split(maxsplit=2) for line in maps)
                _code[:] = [tuple(int(x, 16) for x in row[0].split("-")) for row in rows if "x" in row[1]]
    except (OSError, OverflowError, ValueError):
        return None
    return [_TASK(place) for place in places] if _are_code(places) else None


_code: list[tuple[int, int]] = []  # begin and end of what this process may execute


def _are_code(places: list[int]) -> bool:
    return bool(places) and all(any(begin <= place < end for begin, end in _code) for place in set(places))


class ArgumentBuffer:
    """Gives a launch context its host buffer back, which Taichi's CUDA launcher replaces by a copy on the card.

    The launcher frees that copy and leaves its address behind, so that the next number or tensor that is set would be
    written to the card's memory by the host: a crash. A new context for each launch costs more than the launch itself.
    Taichi has no door for this: the two pointers lie in its object, `ctx_` (whose first word is the buffer in use) and
    `arg_buffer_` (the buffer it owns). In a context that was never launched they are the same, which is checked.
    Source: Taichi 1.7.4, program/launch_context_builder.h and runtime/cuda/kernel_launcher.cpp.
    """

    def __init__(self, context):
        builder = _object(context)
        self._own = _word(builder + 3 * _WORD).value
        self._in_use = _word(_word(builder + 2 * _WORD).value)
        if not self._own or self._in_use.value != self._own:
            raise RuntimeError(
                "this build of Taichi lays out its launch contexts in another way than version 1.7.4, "
                "so that kernels cannot be launched twice on CUDA: install taichi==1.7.4"
            )

    def restore(self) -> None:
        """Before anything is set for the next launch."""
        self._in_use.value = self._own
