"""What users call: wrong names of arguments are answered with the right ones, and `help()` fits on a screen.

`class X(metaclass=Public)` does this for a class and all that descend from it, also those of users, and `@public` for a
function. Both read the parameters that stand in signatures, so that a new option is written there and nowhere else. What a
constructor hands on with **options are options of the next constructor among its bases; what a function hands on are those
of the TypedDict that it is annotated with, `**look: Unpack[Look]`.
"""

import functools
import inspect
import sys
import textwrap
import types
from abc import ABCMeta
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from inspect import Parameter, Signature
from typing import TYPE_CHECKING, ForwardRef, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, is_typeddict

from numpy.typing import ArrayLike
from typing_extensions import TypeAliasType

from diffsim_ti.common.names import check_arguments, edits, nearest

P = ParamSpec("P")  # one by one: mypy reads no others
R = TypeVar("R")
OWN_DOC = type.__dict__["__doc__"]
ROOM = 116  # columns of docstrings
UNNAMED = Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD


class Public(ABCMeta):
    # The class of the classes that users make. (A docstring here would be the property below.)

    if not TYPE_CHECKING:  # who checks types sees the constructors alone

        def __init__(cls, name, bases, namespace, **options):
            super().__init__(name, bases, namespace, **options)
            if cls.__new__ is object.__new__:
                cls.__new__ = staticmethod(_new)

        @property
        def __signature__(cls) -> Signature:
            return _takes(cls).signature

        @property
        def __doc__(cls) -> str | None:
            own = OWN_DOC.__get__(cls)
            return own and f"{inspect.cleandoc(own)}\n{_parts(cls)}"

        @__doc__.setter
        def __doc__(cls, text):
            OWN_DOC.__set__(cls, text)

    def __dir__(cls):
        asks = inspect.currentframe().f_back.f_code
        if asks is inspect.classify_class_attrs.__code__:
            return []  # help() asks: the docstring lists them
        return super().__dir__()


def _new(cls, *arguments, **named):
    # Runs before the constructor and leaves no frame between it and who calls it, whose line warnings name.
    if arguments or named:
        _takes(cls).check(cls.__name__, arguments, named)
    return object.__new__(cls)


def public(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator of a function that users call."""
    takes, owner = _Takes.of([function]), function.__qualname__

    @functools.wraps(function)
    def call(*arguments: P.args, **named: P.kwargs) -> R:
        takes.check(owner, arguments, named)
        return function(*arguments, **named)

    call.__signature__ = takes.signature  # type: ignore[attr-defined]
    return call


def check_options(owner: str, kind: type, options: Iterable[str]) -> None:
    """Raise TypeError for an option that `owner` is to hand on to a class that does not take it."""
    check_arguments(f"{owner} with {kind.__name__}", options, _takes(kind).names)


@dataclass(frozen=True)
class _Takes:
    """What a function or a constructor takes."""

    parameters: dict[str, Parameter]
    old: frozenset[str]  # names that still work (deprecated.py)
    more: Parameter | None  # what takes any other names, and answers wrong ones itself
    result: object

    @classmethod
    def of(cls, functions: list, bound: bool = False) -> "_Takes":
        """Of a function; or of constructors, each of which hands on what it does not name to the next."""
        taken: dict[str, Parameter] = {}
        listed: dict[str, object] = {}
        old: set[str] = set()
        more, signature = None, Signature()
        for k, function in enumerate(functions):
            signature = inspect.signature(function)
            old |= getattr(function, "old_names", frozenset())
            own = list(signature.parameters.values())[bound:]
            more = next((p for p in own if p.kind is Parameter.VAR_KEYWORD), None)
            options = get_args(more.annotation) if more else ()
            if options and is_typeddict(options[0]):
                listed |= options[0].__annotations__
            for p in own:
                if p.kind not in UNNAMED and (k == 0 or p.default is not p.empty):
                    taken.setdefault(p.name, p if k == 0 else p.replace(kind=Parameter.KEYWORD_ONLY))
                elif p.kind is Parameter.VAR_POSITIONAL and k == 0:
                    taken[p.name] = p
            if more is None:
                break
        for name, kind in listed.items():  # what no constructor has a default for
            own = Parameter(name, Parameter.KEYWORD_ONLY, default=_Words(...), annotation=kind)
            taken.setdefault(name, own)
        more = None if listed else more
        return cls(taken, frozenset(old), more, signature.return_annotation)

    @functools.cached_property
    def names(self) -> list[str]:
        return [name for name, p in self.parameters.items() if p.kind not in UNNAMED]

    @functools.cached_property
    def most(self) -> int:
        """How many go without a name."""
        kinds = [p.kind for p in self.parameters.values()]
        return sys.maxsize if Parameter.VAR_POSITIONAL in kinds else sum(x < Parameter.VAR_POSITIONAL for x in kinds)

    def check(self, owner: str, arguments: tuple, named: dict) -> None:
        """Raise TypeError for a name that is not among them, and for more than go without a name."""
        if len(arguments) > self.most:
            raise TypeError(
                f"{owner} takes at most {self.most} arguments without a name, got {len(arguments)}; it takes "
                f"{', '.join(self.names) or 'none'}"
            )
        if named.keys() <= self.parameters.keys():
            return
        unknown = [name for name in named if name not in self.parameters and name not in self.old]
        if self.more:  # inputs of a scene, say: a name that is one slip from an option was meant to be that
            near = {name: nearest(name, self.names) for name in unknown}
            unknown = [name for name, x in near.items() if x and len(x) > 3 and edits(name, x) == 1]
        check_arguments(owner, unknown, self.names)

    @functools.cached_property
    def signature(self) -> Signature:
        """As `help` prints it."""
        shown = sorted([*self.parameters.values(), *([self.more] if self.more else [])], key=lambda p: p.kind)
        shown = [p if p.annotation is p.empty else p.replace(annotation=_Words(p.annotation)) for p in shown]
        result = self.result if self.result is Signature.empty else _Words(self.result)
        return Signature(shown, return_annotation=result)


@functools.lru_cache(maxsize=1024)
def _takes(cls: type) -> _Takes:
    makers = [vars(base)["__init__"] for base in cls.__mro__[:-1] if "__init__" in vars(base)]
    return _Takes.of([x for x in makers if inspect.isfunction(x)], bound=True)


class _Words:
    """An annotation as it is printed: by the names of types and of their aliases, without modules."""

    def __init__(self, annotation: object):
        self.annotation = annotation

    def __repr__(self) -> str:
        return _words(self.annotation)


def _words(kind: object) -> str:
    if isinstance(kind, str):
        return kind
    if isinstance(kind, ForwardRef):
        return kind.__forward_arg__
    if kind is None or kind is type(None):
        return "None"
    if kind is ...:
        return "..."
    if isinstance(kind, TypeAliasType):
        return kind.__name__
    origin, parts = get_origin(kind), list(get_args(kind))
    if origin is Literal:
        return " | ".join(map(repr, parts))
    if isinstance(kind, list):
        return f"[{', '.join(map(_words, kind))}]"
    if origin in (Union, types.UnionType):
        numbers = get_args(ArrayLike)
        if set(numbers) <= set(parts):
            rest = [x for x in parts if x not in numbers]
            return " | ".join(["ArrayLike", *map(_words, rest)])
        return " | ".join(map(_words, parts))
    if origin is not None:
        return f"{_words(origin)}[{', '.join(map(_words, parts))}]"
    return getattr(kind, "__name__", repr(kind))


def _parts(cls: type) -> str:
    """Names of its attributes and methods, those of bases in the package included."""
    found: dict[str, object] = {}
    for base in cls.__mro__:
        if base.__module__.split(".")[0] not in sys.stdlib_module_names:
            found = {name: x for name, x in vars(base).items() if not name.startswith("_")} | found
    methods = sorted(x for x in found if callable(found[x]) or isinstance(found[x], classmethod | staticmethod))
    said = {
        "Attributes": sorted(found.keys() - set(methods)),
        f"Methods, of which help({cls.__name__}.NAME) says more": methods,
    }
    lines = [f"{what}: {', '.join(names)}" for what, names in said.items() if names]
    return "".join(f"\n{textwrap.fill(line, ROOM, subsequent_indent='    ')}" for line in lines)
