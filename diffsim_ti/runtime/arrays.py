"""Arrays on the device that are freed with their last reference, and copies between them and NumPy."""

import math
import weakref

import numpy as np
import taichi as ti
from taichi._lib import core as _core
from taichi.lang import impl
from taichi.lang._ndarray import Ndarray
from taichi.lang.enums import Layout
from taichi.lang.matrix import VectorNdarray

from diffsim_ti.runtime import device
from diffsim_ti.runtime.quadrants import QUADRANTS
from diffsim_ti.runtime.start import arch_name, check_alive, is_alive, program, runs_on_cpu
from diffsim_ti.runtime.threads import LOCK, untaped

_allocated = {"bytes": 0}
_MOST_NUMBERS = 2**31 - 1


def allocated_megabytes() -> float:
    """Memory that this package's arrays hold now [MB]."""
    return _allocated["bytes"] / 1e6


def _free(owner, handle, size) -> None:
    _allocated["bytes"] -= size
    if is_alive(owner):
        if arch_name() == "vulkan":
            ti.sync()  # an array that a kernel still uses would not be freed, in silence
        owner().delete_ndarray(handle)


def _describe(target, dtype, shape: tuple, layout) -> None:
    """What Taichi's constructors do, without a text of all calls that led to them: 17 us in place of 70 to 150."""
    Ndarray.__init__(target)
    target.dtype, target.shape, target.element_type = getattr(dtype, "dtype", dtype), shape, dtype
    if target.dtype is not dtype:
        target.n, target.element_type = (
            dtype.n,
            _core.get_type_factory_instance().get_tensor_type((dtype.n,), dtype.dtype),
        )
    prog, unnamed = impl.get_runtime().prog, _core.DebugInfo("")
    target.arr = prog.create_ndarray(target.element_type, shape, layout, zero_fill=True, dbg_info=unnamed)


class _Vectors(VectorNdarray):
    """An array of vectors."""

    def __init__(self, dtype, shape):
        if QUADRANTS:
            super().__init__(dtype.n, dtype.dtype, shape)
        else:
            _describe(self, dtype, shape, Layout.AOS)

    def __del__(self):
        pass  # `_free` frees it; Quadrants' own would, too


class _Scalars(ti.ScalarNdarray):
    """An array of numbers that is freed like one of vectors, by `_free`."""

    def __init__(self, dtype, shape):
        if QUADRANTS:
            super().__init__(dtype, shape)
        else:
            _describe(self, dtype, shape, Layout.NULL)

    def __del__(self):
        pass  # Taichi's own frees whatever array of a later program has come to lie at the same address


def array(dtype, *shape: int):
    """A Taichi ndarray whose memory goes back when the last reference goes, and only to the program that gave it.

    Raises ValueError beyond 2^31 - 1 numbers, which Taichi's indices wrap around in silence, and MemoryError.
    """
    owner = program()
    shape = tuple(max(int(s), 1) for s in shape)  # Taichi has no empty arrays
    is_scalar = isinstance(dtype, type(ti.f32))
    count = math.prod(shape) * (1 if is_scalar else math.prod(dtype.get_shape()))
    if count > _MOST_NUMBERS:
        raise ValueError(
            f"an array of {count:.3g} numbers is beyond the {_MOST_NUMBERS:.3g} that Taichi's 32-bit indices reach: "
            "keep fewer states (checkpoint_every, save_every), or use a coarser mesh"
        )
    size = count * np.dtype(to_numpy_dtype(dtype if is_scalar else dtype.dtype)).itemsize
    try:
        with LOCK:
            out = _Scalars(dtype, shape) if is_scalar else _Vectors(dtype, shape)
    except RuntimeError as error:
        if "out of memory" not in str(error).lower():
            raise
        raise MemoryError(
            f"{size / 1e6:.0f} MB do not fit into the memory of the {arch_name()} device, of which this process holds "
            f"{allocated_megabytes():.0f} MB: keep fewer states (checkpoint_every, save_every), or use a coarser mesh"
        ) from error
    _allocated["bytes"] += size
    out.owner = owner
    weakref.finalize(out, _free, owner, out.arr, size)
    return out


def upload(data: np.ndarray, dtype) -> "ti.Ndarray":
    """A new Taichi array of element type `dtype` (scalar or vector) holding `data`; three components fit into four."""
    data = np.asarray(data)
    shape = data.shape if isinstance(dtype, type(ti.f32)) else data.shape[:-1]
    out = array(dtype, *shape)
    if runs_on_cpu() or not data.size:  # elsewhere `fill` writes the whole array
        fill(out, 0)
    if data.size:
        fill(out, data)
    return out


def full_shape(target) -> tuple:
    """Shape of a Taichi array with its element's shape, as NumPy sees it."""
    check_owner(target)
    return tuple(target.shape) + tuple(getattr(target, "element_shape", ()) or ())


def check_owner(target) -> None:
    """The memory of an array of a dead program is gone, and so is what describes it."""
    owner = getattr(target, "owner", None)
    if owner is not None:
        check_alive(owner)


def view(target) -> "np.ndarray | None":
    """A NumPy array over the memory of a Taichi array, no copy; None where that memory is not the host's."""
    host = getattr(target, "host_view", None)
    if host is not None:  # the usual way, as short as can be
        check_alive(target.owner)
        return host
    check_owner(target)
    if runs_on_cpu():
        dtype, shape = to_numpy_dtype(target.dtype), full_shape(target)
        kind = np.ctypeslib.as_ctypes_type(dtype) * int(np.prod(shape))
        host = target.host_view = np.ctypeslib.as_array(kind.from_address(_address(target))).reshape(shape)
    return host


def clear(targets) -> None:
    """Fill Taichi arrays with zeros."""
    for target in targets:
        host = view(target)
        if host is None:
            fill(target, 0)
        else:
            host.fill(0)


def fill(target, data) -> None:
    """Copy numbers into a Taichi array; `data` broadcasts to its shape, and three components fit into four."""
    data, host = np.asarray(data), view(target)
    shape = full_shape(target) if host is None else host.shape
    three = shape[-1] == 4 and data.ndim and data.shape[-1] == 3
    if host is not None:
        (host[..., :3] if three else host)[...] = data
        return
    on_cuda = arch_name() == "cuda"
    if on_cuda and data.ndim == 0 and data == 0:
        impl.get_runtime().prog.fill_uint(target.arr, 0)  # a memset, whatever the type
        return
    whole = np.zeros(shape, to_numpy_dtype(target.dtype))
    (whole[..., :3] if three else whole)[...] = data
    if on_cuda:  # Taichi would copy both ways, and wait three times
        device.copy_to_card(_address(target), whole)
    else:
        with LOCK:
            untaped(target.from_numpy)(whole)


def fetch(source, row: int | None = None) -> np.ndarray:
    """A NumPy copy of a Taichi array, or of a row of it; of four components the first three."""
    host = view(source)
    host = _copied(source, row) if host is None else host if row is None else host[row]
    is_vector = host.ndim > 0 and host.shape[-1] == 4 and host.ndim == len(source.shape) + (row is None)
    return host[..., :3].copy() if is_vector else host.copy()


def look(source) -> np.ndarray:
    """The numbers of an array, to be read at once: the array's own memory where that is the host's."""
    host = view(source)
    if host is None:
        return fetch(source)
    return host[..., :3] if host.ndim > len(source.shape) and host.shape[-1] == 4 else host


def _copied(source, row: int | None = None) -> np.ndarray:
    """All of an array whose memory is not the host's, or a row of it."""
    if arch_name() != "cuda":
        whole = untaped(source.to_numpy)()
        return whole if row is None else whole[row]
    shape = full_shape(source)
    out = np.empty(shape if row is None else shape[1:], to_numpy_dtype(source.dtype))
    before = 0 if row is None else range(shape[0])[row] * out.nbytes
    device.copy_from_card(out, _address(source) + before)
    return out


def _address(target) -> int:
    return impl.get_runtime().prog.get_ndarray_data_ptr_as_int(target.arr)


def fetch_row(source, k: int) -> np.ndarray:
    """Row k of a Taichi array of vectors in float64; of four components the first three."""
    host = view(source)
    return (fetch(source, k) if host is None else host[k, ..., :3]).astype(np.float64)


def to_numpy_dtype(dtype):
    """NumPy's type for a Taichi scalar type."""
    return {ti.f32: np.float32, ti.f64: np.float64, ti.i32: np.int32}[dtype]
