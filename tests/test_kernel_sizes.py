"""Kernels stay so short that the first step and the first gradient of any law compile in seconds."""

import pytest
from kernel_sizes import LAWS, SOLVERS, sizes

import diffsim_ti as ds
from diffsim_ti.runtime import launch

MOST = 30e6  # sum over the kernels of the squares of their variables: 20 s of a core of 2026 (`kernel_sizes.py`)


@pytest.mark.parametrize("name", ["nested ogden3", "viscous ogden3"])
def test_kernels_of_a_first_step_and_its_gradient_are_short(name):
    """The longest; all laws: python tests/kernel_sizes.py"""
    for solver in SOLVERS:
        for order in (1, 2):
            found = sizes(LAWS[name], solver, order)
            assert {"explicit": "step_vjp", "implicit": "vjp"}[solver] in found  # it came to the end
            assert 1000 < sum(n * n for n in found.values()) < MOST, (solver, order, found)


def test_a_kernel_that_compiles_long_says_which_it_is(monkeypatch, capfd):
    monkeypatch.setattr(launch, "PATIENCE", 0)
    with launch.say_if_long("compiling the kernel forces of Voigt(Ogden)"):
        said = ""
        while "compiling" not in said:  # as long as that takes
            said += capfd.readouterr().err
    assert said.count("compiling the kernel forces of Voigt(Ogden) takes longer than 0 s") == 1
    assert "interrupt" in said


def test_what_compiles_soon_says_nothing(capfd):
    with launch.say_if_long("compiling"):
        pass
    assert capfd.readouterr().err == ""


def test_a_law_names_those_within():
    law = ds.KelvinVoigt(ds.Grown(ds.Ogden([5e4], [2.0], 2e5), 0.0), time=1e-2).law("f64")
    assert law.title == "KelvinVoigt(Grown(Ogden))"
