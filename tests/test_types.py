"""Annotations of the public interface are complete, so that type checkers see it; tests/typed_client.py is run."""

import inspect

import typed_client

import diffsim_ti as ds

CALLED = ("TetrahedralMesh", "Simulator", "Frames", "Measurement", "Identification")


def gaps() -> list[str]:
    """Named parameters of public functions and constructors, and those of what everyone calls, without an annotation."""
    out = []
    for name in ds.__all__:
        thing = getattr(ds, name)
        functions = {name: thing} if inspect.isfunction(thing) else {}
        for own, value in vars(thing).items() if inspect.isclass(thing) else ():
            value = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
            called = name in CALLED and not own.startswith("_")
            if (called or own == "__init__") and inspect.isfunction(value):
                functions[f"{name}.{own}"] = value
        for label, function in functions.items():
            if getattr(function, "__module__", "").startswith("diffsim_ti"):
                signature = inspect.signature(function)
                for parameter in list(signature.parameters.values()):
                    named = parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
                    if named and parameter.name not in ("self", "cls") and parameter.annotation is parameter.empty:
                        out.append(f"{label}({parameter.name})")
                if signature.return_annotation is signature.empty and not label.endswith("__init__"):
                    out.append(f"{label} ->")
    return sorted(set(out))


def test_the_public_interface_is_annotated():
    assert gaps() == []


def test_the_typed_client_runs():
    assert typed_client.fall() > 0
