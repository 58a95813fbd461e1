"""The argument buffer of a launch context that is used again, on CUDA."""

import ctypes

_WORD = ctypes.sizeof(ctypes.c_void_p)


def _word(address: int) -> ctypes.c_void_p:
    return ctypes.c_void_p.from_address(address)


class ArgumentBuffer:
    """Gives a launch context its host buffer back, which Taichi's CUDA launcher replaces by a copy on the card.

    The launcher frees that copy and leaves its address behind, so that the next number or tensor that is set would be
    written to the card's memory by the host: a crash. A new context for each launch costs more than the launch itself.
    Taichi has no door for this: the two pointers lie in its object, `ctx_` (whose first word is the buffer in use) and
    `arg_buffer_` (the buffer it owns). In a context that was never launched they are the same, which is checked.
    Source: Taichi 1.7.4, program/launch_context_builder.h and runtime/cuda/kernel_launcher.cpp.
    """

    def __init__(self, context):
        builder = _word(
            id(context) + object.__basicsize__
        ).value  # pybind11 keeps the C++ object behind Python's header
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
