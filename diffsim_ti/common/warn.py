"""Warnings of the package: they point at the user's line, and come once for each kind and line."""

import inspect
import re
import warnings
from types import FrameType

# what may stand between a user's line and the package, besides the package itself
BETWEEN = frozenset(("abc", "contextlib", "functools", "importlib", "numpy", "scipy", "taichi", "torch"))
_registries: dict[tuple, dict] = {}


def users_frame() -> FrameType:
    """The frame of the user's line that led here, or the outermost one."""
    own, frame = __name__.partition(".")[0], inspect.currentframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in {own, *BETWEEN}:
        frame = frame.f_back
    return frame


def warn(message: str | Warning, category: type[Warning] = UserWarning) -> None:
    """Warn of a message, from the user's line.

    Messages that differ in their numbers alone are of one kind. Where the filters of `warnings` show a warning once for each
    line, which is their default, one of each kind is shown for each line: a loop says a thing once.
    """
    frame, kind = users_frame(), re.sub(r"\d[\d.,+\-e]*", "#", str(message))
    place = kind, frame.f_code.co_filename, frame.f_lineno
    registry = _registries.setdefault(place, {})
    category = type(message) if isinstance(message, Warning) else category
    # "version" of the filters, and a message that they have let through once; Python empties it when the filters change
    if len(registry) > 1:
        registry = _registries[place] = {"version": registry["version"], (str(message), category, frame.f_lineno): True}
    warnings.warn_explicit(message, category, *place[1:], frame.f_globals.get("__name__"), registry)
