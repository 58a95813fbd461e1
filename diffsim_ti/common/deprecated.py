"""Old public names, which work for one version: each use gives a DeprecationWarning that names the new one.

Module paths and names of the package stand in tables here; arguments at their functions (`renamed_arguments`), and what a
subclass of a user's may still write where it is read (`warn`: `Obstacle.twin`). What is of a version is deleted when the
next one is released; tests/test_deprecated.py goes through all of it.
"""

import functools
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import ParamSpec, TypeVar

from diffsim_ti.common import answers
from diffsim_ti.common.warn import warn as warn_user

# modules at the top of version 0.2.0 -> where they are
_MOVED = """
writers.adaptive_run rollout.adaptive_steps common.checked common.copies common.differences torch_bridge.ensemble
common.interrupts scene.locking terms.mass_scaling outputs.modes common.progress common.ranks terms.reduced
common.rotations common.rows rollout.simulator runtime.slots scene.strength terms.supports
"""
MODULES = {f"diffsim_ti.{place.rpartition('.')[2]}": f"diffsim_ti.{place}" for place in _MOVED.split()}
# names of the package -> their new names there
NAMES = {"TieLength": "Length", "TieTension": "Tension"}

P = ParamSpec("P")  # one by one: mypy reads no others
R = TypeVar("R")


def warn(old: str, new: str) -> None:
    """Warn that `old` goes with the next version."""
    warn_user(f"{old} is called {new}; the old name goes with the next version", DeprecationWarning)


def renamed_arguments(**new: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator of a function or constructor that also takes old names of arguments, old="new"."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def call(*arguments: P.args, **named: P.kwargs) -> R:
            for old in new.keys() & named.keys():
                warn(f"{function.__qualname__}: argument {old!r}", repr(new[old]))
                if new[old] in named:
                    raise TypeError(
                        f"{function.__qualname__}: {old!r} and {new[old]!r} are the same argument; give one"
                    )
                named[new[old]] = named.pop(old)
            return function(*arguments, **named)

        call.old_names = frozenset(new)  # type: ignore[attr-defined]
        return call

    return decorate


def package_attribute(name: str) -> object:
    """What the package's `__getattr__` gives for an old name of a class, function or module, or for one that needs torch."""
    package, old = import_module("diffsim_ti"), f"diffsim_ti.{name}"
    if name in NAMES:
        warn(old, f"diffsim_ti.{NAMES[name]}")
        return getattr(package, NAMES[name])
    if old in MODULES:
        warn(old, MODULES[old])
        return import_module(MODULES[old])
    return answers.package_attribute(name)


class MovedModule(ModuleType):
    """A module under its old path. A call of it is one of the function of that name: `diffsim_ti.modes` is a function, which
    an import of the old module `diffsim_ti.modes` hides."""

    def __call__(self, *arguments, **named):
        return getattr(self, self.__name__.rpartition(".")[2])(*arguments, **named)


class MovedModules(MetaPathFinder, Loader):
    """Finds modules by their old paths, after all other finders, so that imports of others take no longer."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        return ModuleSpec(name, self) if name in MODULES else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return MovedModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        warn(module.__name__, MODULES[module.__name__])
        own = vars(import_module(MODULES[module.__name__]))
        vars(module).update({name: value for name, value in own.items() if not name.startswith("__")})
