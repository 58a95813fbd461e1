"""What a user calls a device, and the cards that CUDA's driver sees."""

import ctypes

from taichi._lib import core as _core
from taichi.lang import impl

_DRIVERS = ("libcuda.so", "libcuda.so.1", "nvcuda.dll")


def count_cards() -> int:
    """Cards that CUDA's driver sees: the driver may be installed where there is none, which Taichi takes for a card."""
    if not _core.with_cuda():
        return 0
    for name in _DRIVERS:
        try:
            driver = ctypes.CDLL(name)
        except OSError:
            continue
        count = ctypes.c_int(0)
        failed = driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count))
        return 0 if failed else count.value
    return 1  # Taichi found its driver under a name that is not known here, and will ask it


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
    if impl.get_runtime().prog is None:
        init("cuda")
    elif arch_name() != "cuda":
        raise RuntimeError(
            f"device {name!r} needs Taichi on CUDA, but it runs on {arch_name()}: "
            "call diffsim_ti.init('cuda') before anything else, or pass device='cpu'"
        )
