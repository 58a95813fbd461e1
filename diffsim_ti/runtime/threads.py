"""One thread at a time in Taichi: it compiles kernels by way of globals, and launches them from one thread.

Any thread may build and step scenes; they take turns. Fields, which `Rollout.run` uses under a tape, Taichi makes in the
thread alone that started it.
"""

import functools
import threading

from taichi.lang import impl, kernel_impl

from diffsim_ti.runtime.quadrants import QUADRANTS

LOCK = threading.RLock()


def take_turns() -> None:
    """Let calls of kernels wait for each other, in all of this process."""
    call = kernel_impl.Kernel.__call__

    @functools.wraps(call)
    def one_call(self, *args, **kwargs):
        with LOCK:
            return call(self, *args, **kwargs)

    kernel_impl.Kernel.__call__ = one_call


def untaped(call):
    """The same function, whose kernels an open `ti.ad.Tape` does not note down: copies and looks of ours, which have no
    derivative that it could ask for."""

    @functools.wraps(call)
    def quiet(*args, **kwargs):
        taichi = impl.get_runtime()
        before, taichi.grad_replaced = taichi.grad_replaced, True
        try:
            return call(*args, **kwargs)
        finally:
            taichi.grad_replaced = before

    return quiet


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


def current_program():
    """The program that runs, or None; Quadrants' own property raises where there is none."""
    return impl.get_runtime()._prog if QUADRANTS else impl.pytaichi.prog
