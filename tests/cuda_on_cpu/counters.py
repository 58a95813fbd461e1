"""What the stand-in has counted in this process."""

import ctypes
from collections import Counter
from pathlib import Path


class Absent(RuntimeError):
    """This process does not run on the stand-in."""


class _Kernel(ctypes.Structure):
    _fields_ = [("name", ctypes.c_char_p), ("launches", ctypes.c_long), ("ptx", ctypes.c_char_p)]


class Counters:
    """Calls of the driver since the last `restart`, and the kernels that were launched since then."""

    def __init__(self):
        try:
            self._driver = ctypes.CDLL("libcuda.so")
            names = ctypes.string_at(ctypes.addressof(ctypes.c_char.in_dll(self._driver, "cuda_on_cpu_counter_names")))
        except (OSError, ValueError) as error:
            raise Absent("libcuda.so is not the stand-in: use python tests/cuda_on_cpu/run.py") from error
        self._names = names.decode().split()
        self._driver.cuda_on_cpu_counters.restype = ctypes.POINTER(ctypes.c_long * len(self._names))
        self.restart()

    def restart(self) -> None:
        self._start, self._launched = self._read(), [kernel.launches for kernel in self._kernels()]

    def counts(self) -> dict[str, int]:
        """How often each kind of call was made, and how many bytes were copied."""
        return {name: value - self._start[name] for name, value in self._read().items()}

    def launches(self) -> dict[str, int]:
        """How often each kernel was launched, those only that were."""
        before = self._launched + [0] * (len(self._kernels()) - len(self._launched))
        counted = Counter()
        for kernel, old in zip(self._kernels(), before):
            counted[kernel.name.decode()] += kernel.launches - old
        return {name: count for name, count in counted.items() if count}

    def ptx(self) -> dict[str, str]:
        """The text of the module of each kernel that was launched; kernels are named there by their place."""
        launched = self.launches()
        return {
            k.name.decode(): Path(k.ptx.decode()).read_text() for k in self._kernels() if k.name.decode() in launched
        }

    def _read(self) -> dict[str, int]:
        return dict(zip(self._names, self._driver.cuda_on_cpu_counters().contents))

    def _kernels(self) -> list[_Kernel]:
        count = ctypes.c_int.in_dll(self._driver, "cuda_on_cpu_kernel_count").value
        kernels = (ctypes.POINTER(_Kernel) * count).in_dll(self._driver, "cuda_on_cpu_kernels")
        return [kernel.contents for kernel in kernels]
