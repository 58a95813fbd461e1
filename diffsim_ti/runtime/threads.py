"""One thread at a time in Taichi: it compiles kernels by way of globals, and launches them from one thread.

Any thread may build and step scenes; they take turns. Fields, which `Rollout.run` uses under a tape, Taichi makes in the
thread alone that started it.
"""

import functools
import threading

from taichi.lang import impl, kernel_impl

LOCK = threading.RLock()


def take_turns() -> None:
    """Let calls of kernels wait for each other, in all of this process."""
    call = kernel_impl.Kernel.__call__

    @functools.wraps(call)
    def one_call(self, *args, **kwargs):
        with LOCK:
            return call(self, *args, **kwargs)

    kernel_impl.Kernel.__call__ = one_call


def materialize() -> None:
    """Place what fields were declared. Raises RuntimeError in a thread that cannot."""
    try:
        impl.get_runtime().materialize()
    except RuntimeError as error:
        if "main_thread_id_" not in str(error):
            raise
        raise RuntimeError(
            "Taichi makes fields, and with them its first kernel, in the thread alone that called ti.init: call "
            "diffsim_ti.init() there, and use Rollout.run and tapes there; other threads can use Simulator and "
            "Rollout.forward"
        ) from error
