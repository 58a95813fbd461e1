"""Copies by pickle: scenes, solvers and rollouts by what they were made from, errors with what they carry."""

from collections.abc import Mapping

from diffsim_ti.common.public import Public


def made_again(kind: type, arguments: dict):
    """kind(**arguments)"""
    return kind(**arguments)


class MadeAgain(metaclass=Public):
    """What is copied by the `arguments` of its constructor, in its precision. Raises TypeError for functions that another
    process cannot import."""

    arguments: dict
    precision: str

    def __reduce__(self):
        given = self.arguments
        paths = {f"path of {term!r}": term.path for term in given["terms"]}
        check_functions(type(self).__name__, motion=given["motion"], **paths)
        return made_again, (type(self), given | dict(precision=self.precision))


def check_functions(owner: str, **given) -> None:
    """Raise TypeError for functions that no other process can import."""
    for name, value in given.items():
        for part in value.values() if isinstance(value, Mapping) else [value]:
            if callable(part) and ("<" in part.__qualname__ if hasattr(part, "__qualname__") else False):
                raise TypeError(
                    f"{owner} does not pickle: its {name} is {part.__qualname__}, which another process cannot import: "
                    "define the function in a module, or give keyframes (times, values)"
                )


class CarriesMore(Exception, metaclass=Public):
    """An error or warning whose constructor takes more than its message."""

    def __reduce__(self):
        return _error_again, (type(self), self.args, dict(vars(self)))


def _error_again(kind: type, arguments: tuple, carried: dict):
    error = kind.__new__(kind, *arguments)
    error.args = arguments
    vars(error).update(carried)
    return error
