"""Old public names work for one version, with a DeprecationWarning that names the new one."""

import subprocess
import sys
from importlib import import_module

import pytest

import diffsim_ti as ds
from diffsim_ti.common import deprecated


@pytest.mark.parametrize("old, new", deprecated.MODULES.items())
def test_an_old_module_path_has_the_names_of_the_new_one(old, new, monkeypatch):
    monkeypatch.setitem(vars(ds), old.split(".")[1], None)  # restored afterwards: `modes` is a function, too
    monkeypatch.delitem(sys.modules, old, raising=False)
    with pytest.warns(DeprecationWarning, match=f"{old} is called {new};") as caught:
        module = import_module(old)
    assert all(getattr(module, name) is value for name, value in vars(import_module(new)).items() if name[:2] != "__")
    monkeypatch.delitem(sys.modules, old)
    assert len(caught) == 1


@pytest.mark.parametrize("old, new", deprecated.NAMES.items())
def test_an_old_name_of_the_package_is_the_new_one(old, new):
    with pytest.warns(DeprecationWarning, match=f"diffsim_ti.{old} is called diffsim_ti.{new};") as caught:
        assert getattr(ds, old) is getattr(ds, new)
    assert caught[0].filename == __file__ and old not in ds.__all__


@pytest.mark.parametrize("function, old, new", [(ds.Length, "tie", "of"), (ds.Tension, "tie", "of")])
def test_an_old_argument_is_the_new_one(function, old, new):
    with pytest.warns(DeprecationWarning, match=f"argument '{old}' is called '{new}';") as caught:
        assert repr(function(**{old: "rope"})) == repr(function(**{new: "rope"}))
    assert caught[0].filename == __file__
    with pytest.raises(TypeError, match="are the same argument; give one"), pytest.warns(DeprecationWarning):
        function(**{old: "rope", new: "rope"})


def test_a_backend_was_an_arch():
    with pytest.warns(DeprecationWarning, match="init: argument 'arch' is called 'backend';") as caught:
        with pytest.raises(ValueError, match="backend must be one of cpu, cuda, vulkan, got 'metal'"):
            ds.init(arch="metal")
    assert caught[0].filename == __file__


def test_pairs_need_not_be_asked_to_be_a_stage():
    for stage in (True, False):
        with pytest.warns(DeprecationWarning, match="leave `stage` out, which goes with the next version"):
            ds.SelfContact(stage=stage)


def test_an_obstacle_of_users_may_say_its_kernels_by_the_old_name():
    with pytest.warns(DeprecationWarning, match="Ball.twin is called counterpart;") as caught:

        class Ball(ds.Capsule):
            twin = ds.Capsule.counterpart

    assert Ball.counterpart is ds.Capsule.counterpart and caught[0].filename == __file__


def test_an_import_statement_warns_where_it_stands_and_hides_no_function():
    """In a process of its own: an import of the old module `modes` sets the attribute `modes` of the package."""
    program = """
import warnings
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import diffsim_ti.modes
    import diffsim_ti.simulator as simulator
    from diffsim_ti.reduced import *
    diffsim_ti.strength.check_strength
print([w.filename for w in caught if w.category is DeprecationWarning and "diffsim_ti" in str(w.message)])
print(simulator.Simulator is diffsim_ti.Simulator)
try:
    diffsim_ti.modes(None, k=0)
except Exception as error:
    print(type(error).__name__)
try:
    import diffsim_ti.no_such_module
except ModuleNotFoundError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    files, same, raised, missing = done.stdout.strip().splitlines()
    assert files == str(["<string>"] * 4) and same == "True" and raised != "TypeError"
    assert missing == "No module named 'diffsim_ti.no_such_module'"


def test_a_name_that_never_was_is_an_error():
    with pytest.raises(AttributeError, match="module 'diffsim_ti' has no attribute 'Spling'"):
        ds.Spling  # noqa: B018
