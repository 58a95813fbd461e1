"""Quadrants, a maintained fork of Taichi, in Taichi's place where DIFFSIM_TI_TAICHI=quadrants asks for it."""

import dataclasses
import importlib
import os
import sys

QUADRANTS = os.environ.get("DIFFSIM_TI_TAICHI") == "quadrants"


def stand_in() -> None:
    """Make `import taichi`, here and in programs that import diffsim_ti first, mean the code that was chosen.

    Raises ImportError for another name, and where Taichi was imported before.
    """
    chosen = os.environ.get("DIFFSIM_TI_TAICHI", "taichi")
    if chosen == "taichi":
        return
    if chosen != "quadrants":
        raise ImportError(f"DIFFSIM_TI_TAICHI must be taichi or quadrants, got {chosen!r}")
    known = sys.modules.get("taichi")
    if known is not None and known.__name__ != "quadrants":
        raise ImportError("DIFFSIM_TI_TAICHI=quadrants: import diffsim_ti before taichi")
    code = importlib.import_module("quadrants")
    for name in [name for name in dir(code) if name.startswith("Quadrants")]:
        setattr(code, name.replace("Quadrants", "Taichi"), getattr(code, name))  # its errors
    _hand_dataclasses_on()
    for name, module in [*sys.modules.items()]:
        if name == "quadrants" or name.startswith("quadrants."):
            sys.modules["taichi" + name.removeprefix("quadrants")] = module
    sys.modules["taichi.lang.enums"] = importlib.import_module("quadrants.types.enums")  # where it has gone


def _hand_dataclasses_on() -> None:
    """Functions of kernels take our dataclasses as they are, as Taichi hands them on, not field by field."""
    calls = importlib.import_module("quadrants.lang.ast.ast_transformers.call_transformer").CallTransformer
    spread = calls._expand_Call_dataclass_args

    def whole(context, arguments, *more, **named):
        values = [argument.ptr for argument in arguments]
        if any(dataclasses.is_dataclass(value) and not isinstance(value, type) for value in values):
            return (), arguments
        return spread(context, arguments, *more, **named)

    calls._expand_Call_dataclass_args = staticmethod(whole)
