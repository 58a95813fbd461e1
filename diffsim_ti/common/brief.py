"""Objects in a line: what `repr` says where the fields are arrays."""

from dataclasses import fields

import numpy as np

FEW, LONG = 6, 100  # numbers, or members, that are said one by one; characters of anything else


def brief(value) -> str:
    """A value in a line: of arrays and tensors the shape and the range, of what has many members how many."""
    if isinstance(value, float | np.floating):
        return f"{value:.6g}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return _of_array(value)
    if isinstance(value, dict):
        own = [f"{key}: {brief(x)}" for key, x in list(value.items())[:FEW]]
        return f"{{{', '.join(own)}{', ...' * (len(value) > FEW)}}}"
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        return (
            f"[{', '.join(map(brief, value))}]" if len(value) <= FEW else f"{len(value)} of {type(value[0]).__name__}"
        )
    text = " ".join(repr(value).split())
    return text if len(text) <= LONG else f"{text[: LONG - 3]}..."


def _of_array(x) -> str:
    x = np.asarray(x.detach().cpu() if hasattr(x, "detach") else x)
    if x.size <= FEW or not np.issubdtype(x.dtype, np.number):
        return np.array2string(x, precision=6, separator=", ", threshold=FEW).replace("\n", "")
    low, high = f"{x.min():.4g}", f"{x.max():.4g}"
    return f"{tuple(x.shape)} " + (f"all {low}" if low == high else f"from {low} to {high}")


def brief_fields(self) -> str:
    """`__repr__` of a dataclass with arrays: fields that hold something, in a line."""
    shown = ((f.name, getattr(self, f.name)) for f in fields(self) if f.repr)
    said = [f"{name}={brief(x)}" for name, x in shown if not (x is None or isinstance(x, dict | list | str) and not x)]
    return f"{type(self).__name__}({', '.join(said)})"
