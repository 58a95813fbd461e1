"""What a user calls a device, the cards that CUDA's driver sees, and copies that the driver makes by itself."""

import ctypes
import platform
from functools import cache

import numpy as np
from taichi._lib import core as _core

from diffsim_ti.runtime.threads import current_program

_DRIVERS = ("libcuda.so", "libcuda.so.1", "/usr/lib/wsl/lib/libcuda.so", "nvcuda.dll")


@cache
def _driver():
    """CUDA's driver library, which Taichi has loaded too."""
    for name in _DRIVERS:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise RuntimeError(
        f"Taichi found CUDA's driver, but not as {', '.join(_DRIVERS)}: add its folder to the library path"
    )


def count_cards() -> int:
    """Cards that CUDA's driver sees: the driver may be installed where there is none, which Taichi takes for a card."""
    if not _core.with_cuda():
        return 0
    count = ctypes.c_int(0)
    failed = _driver().cuInit(0) or _driver().cuDeviceGetCount(ctypes.byref(count))
    return 0 if failed else count.value


def device_name() -> str:
    """Name and driver of the first card, or of the processor where Taichi runs there."""
    from diffsim_ti.runtime.start import arch_name

    if arch_name() != "cuda":
        return f"{platform.processor() or platform.machine()} ({arch_name()})"
    name, version = ctypes.create_string_buffer(128), ctypes.c_int(0)
    _driver().cuDeviceGetName(name, len(name), 0)
    _driver().cuDriverGetVersion(ctypes.byref(version))
    return f"{name.value.decode()}, CUDA {version.value // 1000}.{version.value % 1000 // 10}"


@cache
def _context() -> ctypes.c_void_p:
    """The first card's primary context, which Taichi and torch share."""
    context = ctypes.c_void_p()
    if status := _driver().cuDevicePrimaryCtxRetain(ctypes.byref(context), 0):
        raise RuntimeError(f"CUDA's driver gives no context, error {status}")
    return context


def _copy(function: str, to: int, source: int, size: int) -> None:
    status = _driver().cuCtxSetCurrent(_context())  # a thread that has launched nothing has none
    status = status or getattr(_driver(), function)(ctypes.c_void_p(to), ctypes.c_void_p(source), ctypes.c_size_t(size))
    if status:
        raise RuntimeError(
            f"CUDA's driver failed with error {status} in {function}; an earlier kernel may be the cause"
        )


def copy_to_card(address: int, numbers: np.ndarray) -> None:
    """Contiguous numbers to an address of the card, after the kernels that were launched before."""
    _copy("cuMemcpyHtoD_v2", address, numbers.ctypes.data, numbers.nbytes)


def copy_from_card(numbers: np.ndarray, address: int) -> None:
    """Contiguous numbers from an address of the card, after the kernels that were launched before."""
    _copy("cuMemcpyDtoH_v2", numbers.ctypes.data, address, numbers.nbytes)


def use_device(device) -> None:
    """Make sure that Taichi computes where `device` says.

    device: None or "cpu" leave the choice to `diffsim_ti.init`; "cuda" or "cuda:0" start Taichi on the card if nothing
        has started it. A torch.device counts as its name.
    Raises RuntimeError if Taichi already runs elsewhere or there is no card, ValueError for another device: Taichi
    takes the first card that CUDA_VISIBLE_DEVICES leaves it.
    """
    from diffsim_ti.runtime.start import arch_name, init

    name = "cpu" if device is None else str(device)
    if name == "cpu":
        return
    if name.startswith("cuda:") and name != "cuda:0":
        raise ValueError(
            f"Taichi computes on the first card only, got device {name!r}: "
            f"set CUDA_VISIBLE_DEVICES={name[5:]} before Python starts and pass 'cuda'"
        )
    if name not in ("cuda", "cuda:0"):
        raise ValueError(f"device must be 'cpu' or 'cuda', got {name!r}")
    if current_program() is None:
        init("cuda")
    elif arch_name() != "cuda":
        raise RuntimeError(
            f"device {name!r} needs Taichi on CUDA, but it runs on {arch_name()}: "
            "call diffsim_ti.init('cuda') before anything else, or pass device='cpu'"
        )
