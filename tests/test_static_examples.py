"""The examples of equilibria and implicit steps find what they look for, on small meshes."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"


def example(name: str):
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_cantilever(capsys):
    """Small strains as another code finds them (its numbers have three digits); large rotations as the elastica."""
    numbers = example("cantilever").main(quick=True)
    for share, known in numbers["shares"].values():
        assert share == pytest.approx(known, abs=6e-3)
    (fine, extrapolated), = numbers["elastica"].values()
    assert -0.06 < fine[0] < -0.04  # locked
    assert np.abs(extrapolated).max() < 0.018  # and how much of it extrapolation from 2 and 3 cells takes away
    assert "elastica" in capsys.readouterr().out


def test_cooks_membrane(capsys):
    """Plane strain is met, the corner rises towards the reference from below, as linear tetrahedra do."""
    numbers = example("cooks_membrane").main(quick=True)
    for name in ("linear", "large"):
        case = numbers[name]
        rise, exact = np.array(case["corner"]), case["exact"][0]
        assert np.all(np.diff(rise) > 0) and case["left"] < 1e-6
        assert 0.85 * exact < rise[-1] < exact
    assert 0.9 * 14.499 < numbers["large"]["middle"][-1] < 14.499
    assert "corner rises" in capsys.readouterr().out
