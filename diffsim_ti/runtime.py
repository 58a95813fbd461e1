"""The one door to Taichi's runtime: start-up, precision, arrays that are freed, fields that are lent and returned.

Nothing else in the package touches `taichi.lang.impl` or `taichi._lib`.
"""

import contextlib
import io
import os
import tempfile
import warnings
import weakref
from collections import defaultdict
from types import SimpleNamespace

import numpy as np
import taichi as ti
from taichi._lib import core as _core
from taichi.lang import impl
from taichi.types import primitive_types

PRECISIONS = {"f32": ti.f32, "f64": ti.f64}
NUMPY = {"f32": np.float32, "f64": np.float64}
_ARCHS = {"cpu": ti.cpu, "cuda": ti.cuda, "vulkan": ti.vulkan}
_settings = {"precision": "f32", "bytes": 0}


def available_archs() -> list[str]:
    """Names of the backends this machine and this Taichi build can run, always with "cpu"."""
    ti.set_logging_level(ti.ERROR)  # a missing driver is an answer here, not a warning
    return [name for name in _ARCHS if _has_arch(name)]


def _has_arch(name: str) -> bool:
    return {"cpu": lambda: True, "cuda": _core.with_cuda, "vulkan": _core.with_vulkan}[name]()


def init(arch: str = "cpu", precision: str = "f32", threads: int | None = None, **options) -> None:
    """Start Taichi for this process: a thin front of `ti.init`, and the only place that calls it.

    arch: "cpu", "cuda" or "vulkan"; a backend that is not there is an error, never a fall-back.
    precision: "f32" or "f64", what a Scene uses unless it says otherwise.
    threads: CPU threads, default all.
    options: handed to `ti.init`. `fast_math` stays False because it erases NaNs before anyone can see them, and
    `default_fp` stays f64 so that both precisions can live in one process.

    Used before `init`, the library calls `init()` itself: CPU, f32. A `ti.init` of the host program is respected.
    Calling it again drops every array of earlier scenes; they say so when used.
    Raises ValueError for an unknown name, RuntimeError for a backend that is not available.
    """
    if arch not in _ARCHS:
        raise ValueError(f"arch must be one of {', '.join(_ARCHS)}, got {arch!r}")
    check_precision(precision)
    ti.set_logging_level(ti.ERROR)
    if not _has_arch(arch):
        raise RuntimeError(
            f"the {arch} backend is not available here (available: {', '.join(available_archs())}); "
            f"pass one of those to diffsim_ti.init, or install the driver that {arch} needs"
        )
    for name in ("default_fp", "fast_math"):
        if name in options:
            raise ValueError(f"{name} cannot be chosen: diffsim_ti needs default_fp=f64 and fast_math=False")
    options.setdefault("log_level", ti.ERROR)
    if not _can_write_cache(options.get("offline_cache_file_path") or os.environ.get("TI_OFFLINE_CACHE_FILE_PATH")):
        # Taichi makes the folder even then, and crashes at exit if it cannot
        options |= dict(offline_cache=False, offline_cache_file_path=tempfile.mkdtemp(prefix="ticache-"))
        os.environ.pop("TI_OFFLINE_CACHE_FILE_PATH", None)
    if threads is not None:
        options["cpu_max_num_threads"] = int(threads)
    set_precision(precision)
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(arch=_ARCHS[arch], default_fp=ti.f64, fast_math=False, enable_fallback=False, **options)


def _can_write_cache(path: str | None) -> bool:
    folder = os.path.expanduser(path or "~/.cache/taichi/ticache")
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


def set_precision(precision: str) -> None:
    """Set the precision, "f32" or "f64", of scenes that do not name one."""
    _settings["precision"] = check_precision(precision)


def check_precision(precision: str | None) -> str:
    """Return a valid precision name; None means the process-wide default."""
    if precision is None:
        return _settings["precision"]
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be 'f32' or 'f64', got {precision!r}")
    return precision


def _after_fork() -> None:
    _settings["forked"] = impl.get_runtime().prog is not None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _refuse_fork() -> None:
    if _settings.get("forked"):
        raise RuntimeError(
            "this process was forked after Taichi had started, and Taichi's threads do not survive a fork: start workers "
            "with multiprocessing.get_context('spawn'), or DataLoader(..., multiprocessing_context='spawn')"
        )


def program() -> weakref.ref:
    """The live Taichi program; starts the stated default (CPU, f32) if nothing did.

    A weak reference: a program that is still held would outlive `ti.init`, and at its end free memory of the next one.
    """
    _refuse_fork()
    if impl.get_runtime().prog is None:
        init()
    return weakref.ref(impl.get_runtime().prog)


def is_alive(owner: weakref.ref) -> bool:
    """Whether the program `owner` is the one that runs."""
    return owner() is not None and owner() is impl.get_runtime().prog


def check_host_init() -> None:
    """Warn once about a host program's `ti.init` that weakens the library's promises."""
    program()
    config = impl.current_cfg()
    if config.fast_math and not _settings.get("warned"):
        _settings["warned"] = True
        warnings.warn(
            "ti.init was called with fast_math=True, which can erase NaNs before they are seen; "
            "use diffsim_ti.init(), or ti.init(fast_math=False, default_fp=ti.f64)",
            stacklevel=3,
        )


def check_alive(owner: weakref.ref) -> None:
    """Raise if `ti.init` was called after the program `owner`, or if this process was forked since."""
    _refuse_fork()
    if not is_alive(owner):
        raise RuntimeError("ti.init was called again, which destroys all Taichi data: build the scene and solver anew")


def arch_name() -> str:
    """Name of the running backend."""
    program()
    arch = impl.current_cfg().arch
    return next((name for name, value in _ARCHS.items() if value == arch), "cpu")


def runs_on_cpu() -> bool:
    return arch_name() == "cpu"


def check_backend(precision: str) -> None:
    """Raise ValueError if the running backend cannot compute in this precision."""
    if arch_name() == "vulkan" and precision == "f64":
        raise ValueError(
            "Vulkan has no float64 logarithm, which energies and contacts need: use precision='f32' there, "
            "or diffsim_ti.init('cpu') or ('cuda') for float64"
        )


def allocated_megabytes() -> float:
    """Memory that this package's arrays hold now [MB]."""
    return _settings["bytes"] / 1e6


def _free(owner, handle, size) -> None:
    _settings["bytes"] -= size
    if is_alive(owner):
        if not runs_on_cpu():
            ti.sync()  # an array that a kernel still uses would not be freed, in silence
        owner().delete_ndarray(handle)


class _Scalars(ti.ScalarNdarray):
    """An array of numbers that is freed like one of vectors, by `_free`."""

    def __del__(self):
        pass  # Taichi's own frees whatever array of a later program has come to lie at the same address


def array(dtype, *shape: int):
    """A Taichi ndarray whose memory goes back when the last reference goes, and only to the program that gave it."""
    owner = program()
    shape = tuple(max(int(s), 1) for s in shape)  # Taichi has no empty arrays
    out = _Scalars(dtype, shape) if isinstance(dtype, type(ti.f32)) else ti.ndarray(dtype, shape)
    size = int(np.prod(full_shape(out))) * np.dtype(to_numpy_dtype(out.dtype)).itemsize
    _settings["bytes"] += size
    out.owner = owner
    weakref.finalize(out, _free, owner, out.arr, size)
    return out


def upload(data: np.ndarray, dtype) -> "ti.Ndarray":
    """A new Taichi array of element type `dtype` (scalar or vector) holding `data`; three components fit into four."""
    data = np.asarray(data)
    shape = data.shape if isinstance(dtype, type(ti.f32)) else data.shape[:-1]
    out = array(dtype, *shape)
    fill(out, 0)
    if data.size:
        fill(out, data)
    return out


def full_shape(target) -> tuple:
    """Shape of a Taichi array with its element's shape, as NumPy sees it."""
    _check_owner(target)
    return tuple(target.shape) + tuple(getattr(target, "element_shape", ()) or ())


def _check_owner(target) -> None:
    """The memory of an array of a dead program is gone, and so is what describes it."""
    if hasattr(target, "owner"):
        check_alive(target.owner)


def view(target) -> "np.ndarray | None":
    """A NumPy array over the memory of a Taichi array, no copy; None where that memory is not the host's."""
    _check_owner(target)
    host = getattr(target, "host_view", None)
    if host is None and runs_on_cpu():
        dtype, shape = to_numpy_dtype(target.dtype), full_shape(target)
        kind = np.ctypeslib.as_ctypes_type(dtype) * int(np.prod(shape))
        address = impl.get_runtime().prog.get_ndarray_data_ptr_as_int(target.arr)
        host = target.host_view = np.ctypeslib.as_array(kind.from_address(address)).reshape(shape)
    return host


def fill(target, data) -> None:
    """Copy numbers into a Taichi array; `data` broadcasts to its shape, and three components fit into four."""
    data, shape = np.asarray(data), full_shape(target)
    three = shape[-1] == 4 and data.ndim and data.shape[-1] == 3
    host = view(target)
    if host is not None:
        (host[..., :3] if three else host)[...] = data
        return
    whole = np.zeros(shape, to_numpy_dtype(target.dtype))
    (whole[..., :3] if three else whole)[...] = data
    target.from_numpy(whole)


def fetch(source) -> np.ndarray:
    """A NumPy copy of a Taichi array; of four components the first three."""
    host = view(source)
    host = source.to_numpy() if host is None else host
    is_vector = len(getattr(source, "element_shape", ()) or ()) == 1 and host.shape[-1] == 4
    return host[..., :3].copy() if is_vector else host.copy()


def to_numpy_dtype(dtype):
    """NumPy's type for a Taichi scalar type."""
    return {ti.f32: np.float32, ti.f64: np.float64, ti.i32: np.int32}[dtype]


class Launch:
    """A kernel with its arrays bound once, launched many times with other numbers.

    A plain call looks at every argument anew: 5 us for each array, 130 us for the kernels of a step; this takes 12 us.
    vectorized: compile vectors as they are, to vector instructions, instead of number by number (CPU only).
    """

    def __init__(self, kernel, *arrays, vectorized: bool = False):
        self._kernel, self._arrays, self._vectorized = kernel._primal, arrays, vectorized
        self._setters, self._owner = None, program()

    def _prepare(self, numbers: tuple) -> None:
        prog = impl.get_runtime().prog
        config, kernel = prog.config(), self._kernel
        scalarize, config.real_matrix_scalarize = config.real_matrix_scalarize, not self._vectorized
        try:
            kernel.runtime.materialize()
            compiled = kernel.compiled_kernels[kernel.ensure_compiled(*self._arrays, *numbers)]
            self._code = prog.compile_kernel(config, prog.get_device_caps(), compiled)
        finally:
            config.real_matrix_scalarize = scalarize
        self._context, on_cpu = compiled.make_launch_context(), runs_on_cpu()
        for k, array in enumerate(self._arrays):
            if not isinstance(array, ti.Ndarray):  # a torch tensor, set at each launch
                continue
            if on_cpu:  # a launch replaces an array by its raw pointer, so that a context could not be used twice
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

    def __call__(self, *numbers) -> None:
        check_alive(self._owner)
        if self._setters is None:
            self._prepare(numbers)
        for (setter, index), number in zip(self._setters, numbers):
            setter(index, number)
        self._owner().launch_kernel(self._code, self._context)


class TensorLaunch(Launch):
    """A kernel whose first arguments are torch tensors, other ones at each launch; its arrays are bound once."""

    def __call__(self, *tensors) -> None:
        check_alive(self._owner)
        if self._setters is None:
            arrays = self._arrays
            self._arrays = (*tensors, *arrays)
            self._prepare(())
            self._arrays = arrays  # keeps no tensor alive
        for k, tensor in enumerate(tensors):
            size = tensor.numel() * tensor.element_size()
            self._context.set_arg_external_array_with_shape((k,), tensor.data_ptr(), size, tuple(tensor.shape), 0)
        self._owner().launch_kernel(self._code, self._context)


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


class FieldPool:
    """Taichi fields with gradients, lent and returned: plain fields are never freed and 512 field trees end a process."""

    def __init__(self):
        self._free = defaultdict(list)

    def take(self, owner, dtype, shape: tuple, components: int = 0):
        """A field of that kind, zeroed; it comes back to the pool when `owner` is collected."""
        key = (program(), dtype, tuple(shape), components)
        field = self._free[key].pop() if self._free[key] else self._make(dtype, tuple(shape), components)
        weakref.finalize(owner, self._free[key].append, field)
        for part in (field, field.grad):
            part.from_numpy(np.zeros(tuple(shape) + ((components,) if components else ()), to_numpy_dtype(dtype)))
        return field

    @staticmethod
    def _make(dtype, shape, components):
        if components:
            return ti.Vector.field(components, dtype, shape=shape, needs_grad=True)
        return ti.field(dtype, shape=shape, needs_grad=True)


fields = FieldPool()


def current_tape():
    """The `ti.ad.Tape` that is open now, or None."""
    program()
    return impl.get_runtime().target_tape


@traced
class Bundle:
    """Arrays and numbers of a kernel under one name, to hand to Taichi functions; exists only while compiling."""

    _data_oriented = True  # Taichi hands it on as it is

    def __init__(self, **parts):
        self.__dict__.update(parts)
