"""Options of a command in a TOML file: `--write-config` writes all of them, `--config` reads what is there.

A key is the name of an option as it is typed, without its dashes in front, or `mesh`.
"""

import json
from difflib import get_close_matches
from enum import Enum
from pathlib import Path

import typer

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib

OWN = "config", "write-config"


def _parameters(context: typer.Context) -> dict:
    """The command's parameters by the keys of a file."""
    named = {max(p.opts, key=len).lstrip("-").lower(): p for p in context.command.params}
    return {key: p for key, p in named.items() if key not in (*OWN, "help")}


def read_options(context: typer.Context, path: Path | None) -> Path | None:
    """Take what a file says for what is not typed. Raises ValueError for keys that are no options, or what is no TOML."""
    if path is None:
        return None
    if not path.is_file():
        raise ValueError(f"--config {path}: no such file; --write-config writes one")
    try:
        with open(path, "rb") as file:
            given = tomllib.load(file)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"--config {path}: {error}; --write-config writes one to begin with") from error
    known = _parameters(context)
    for key in given.keys() - known.keys():
        near = get_close_matches(key.replace("_", "-"), known, 1, 0.5)
        meant = f"did you mean {near[0]!r}? " if near else ""
        raise ValueError(f"--config {path}: no option is called {key!r}: {meant}there are {', '.join(known)}")
    several = {key: [x] if known[key].multiple and isinstance(x, str) else x for key, x in given.items()}
    context.default_map = {known[key].name: x for key, x in several.items()}
    return path


def write_options(context: typer.Context, path: Path) -> None:
    """Write every option's value, to the bit, with its help; what is not set is left out, as a comment."""
    lines = [f"# options of `diffsim-ti {context.command.name} --config`"]
    for key, parameter in _parameters(context).items():
        value, about = context.params[parameter.name], " ".join((parameter.help or "").split())
        lines.append(f"# {key} =  # not set; {about}" if value is None else f"{key} = {_toml(value)}  # {about}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"options written to {path}")


def _toml(value) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Enum):
        value = value.value
    return repr(value) if isinstance(value, int | float) else json.dumps(str(value), ensure_ascii=False)
