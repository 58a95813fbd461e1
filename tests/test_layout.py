"""What the folder tree promises: imports go one way, nobody reaches into others, no file is long, no class stands deep."""

import ast
import re
from functools import lru_cache
from pathlib import Path

from package_source import PACKAGE, modules, nodes


def room(path: Path) -> str:
    """The folder that a module lies in, of mechanics the folder there, or the module itself where it lies at the top."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return _of_mechanics(parts)


def _of_mechanics(parts) -> str:
    return ".".join(parts[:2]) if parts[0] == "mechanics" and len(parts) > 1 else parts[0]


def rooms_used(nodes: list[ast.AST]) -> set[str]:
    """Rooms that a module imports from, also inside functions; what only type checkers read does not count."""
    ifs = [node for node in nodes if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    typing_only = {id(inner) for node in ifs for inner in node.body}
    found = set()
    for node in nodes:
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "diffsim_ti":
            parts = node.module.split(".")[1:]
            found |= {_of_mechanics([*parts, name]) for name in [a.name for a in node.names]} if parts else set()
            found |= set() if parts else {alias.name for alias in node.names}
    return found


def circles(uses: dict[str, set[str]]) -> list[str]:
    """Rooms that can be reached from themselves."""

    def reached(start: str) -> set[str]:
        seen, waiting = set(), [start]
        while waiting:
            fresh = uses.get(waiting.pop(), set()) - seen
            seen |= fresh
            waiting += fresh
        return seen

    return sorted(name for name in uses if name in reached(name))


def test_imports_between_folders_go_one_way():
    uses = {}
    for path, inside in nodes().items():
        uses.setdefault(room(path), set()).update(rooms_used(inside) - {room(path)})
    del uses["__init__"]
    assert len(uses) > 30 and "mechanics.energy" in uses["monitor"] and not circles(uses)


def test_all_warnings_point_at_the_line_of_the_user():
    """By `warn` of common/warn.py."""
    assert [p.name for p in modules() if re.search(r"warnings\.warn\b|stacklevel", p.read_text())] == []


def test_texts_are_read_and_written_in_utf_8():
    """And not in what the system's locale says."""
    for path, inside in nodes().items():
        for call in (node for node in inside if isinstance(node, ast.Call)):
            name = getattr(call.func, "id", getattr(call.func, "attr", ""))
            named = {word.arg for word in call.keywords}
            modes = [x.value for x in call.args if isinstance(x, ast.Constant) and isinstance(x.value, str)]
            opens = name == "open" and isinstance(call.func, ast.Name) and not any("b" in mode for mode in modes)
            if opens or name in ("read_text", "write_text") and isinstance(call.func, ast.Attribute):
                assert "encoding" in named, f"{path.name}, line {call.lineno}"


def test_at_the_top_stand_folders_and_doors():
    """Modules there are what pages teach to import; all else lies in folders."""
    assert len(list(PACKAGE.glob("*.py"))) <= 12


def test_a_circle_would_be_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]


def private_attributes(nodes: list[ast.AST]) -> list[str]:
    """Names with one underscore that are read off something else than self, and that the module does not make itself."""
    own = {node.name for node in nodes if isinstance(node, ast.FunctionDef)}
    read = []
    for node in nodes:
        if isinstance(node, ast.Attribute) and re.match(r"_[a-z]", node.attr):
            if isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"):
                own.add(node.attr)
            else:
                read.append(node.attr)
    return [name for name in read if name not in own]


def test_no_module_reaches_into_another():
    taichis = PACKAGE / "runtime"  # the one place that knows Taichi's internals
    reached = {str(path): private_attributes(x) for path, x in nodes().items() if taichis not in path.parents}
    assert {name: names for name, names in reached.items() if names} == {}
    assert private_attributes(list(ast.walk(ast.parse("def f(x):\n    return x._secret")))) == ["_secret"]


def internals(nodes: list[ast.AST]) -> list[str]:
    """Modules of Taichi's that are imported, but for itself and its window."""
    found = []
    for node in nodes:
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        found += [name for name in names if name.startswith("taichi.") and name != "taichi.ui"]
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "ti":
            found += [f"ti.{node.attr}"] if node.attr in ("lang", "_lib") else []
    return found


def test_one_folder_alone_knows_taichis_internals():
    assert internals(list(ast.walk(ast.parse("from taichi.lang import impl\nti.lang.impl")))) == [
        "taichi.lang",
        "ti.lang",
    ]
    found = {str(path): internals(x) for path, x in nodes().items() if room(path) != "runtime"}
    assert {name: names for name, names in found.items() if names} == {}


def lines(text: str) -> int:
    """How many there are, examples in docstrings aside."""
    return len(re.sub(r"^ *>>> (.*\n)+?(?= *(\n|\"\"\"))", "", text, flags=re.MULTILINE).splitlines())


def test_files_are_short():
    lengths = {str(path): lines(path.read_text()) for path in modules()}
    assert {name: length for name, length in lengths.items() if length > 600} == {}
    assert sorted(lengths.values())[len(lengths) // 2] <= 130


@lru_cache
def classes() -> dict[tuple[Path, str], ast.ClassDef]:
    found = [(path, node) for path, tree in modules().items() for node in tree.body if isinstance(node, ast.ClassDef)]
    return {(path, node.name): node for path, node in found}


OF_BATCHES = "elements of a batch are those of one scene with other places of their numbers"
DEEP = {  # classes that may stand more than three deep, and why
    "PatchOfEight": "elements of a batch read elements of one scene",
    "HeldPressure": "of the pressures in chambers those that are found with a volume, told apart by their class",
    "PressedFace": "a curved face stores and sums what a flat one does",
    "JoinedWorkspace": "the scenes of a batch, solved together, are a run of an implicit solver",
    "SharesOfScenes": "obstacles of a batch are those of one scene with other places of their numbers",
    "Muscle": "to users a muscle is a cable, and a cable a spring",
    "_AtStart": "a solver of users that checks less",
}


def found_in(path: Path, name: str) -> tuple[Path, str] | None:
    """Where a class of the package is defined that a module calls by a name; None of other classes."""
    if (path, name) in classes():
        return path, name
    for node in modules()[path].body:
        for alias in node.names if isinstance(node, ast.ImportFrom) else []:
            if name == (alias.asname or alias.name) and (node.module or "").split(".")[0] == "diffsim_ti":
                place = PACKAGE.joinpath(*node.module.split(".")[1:])
                return found_in(place.with_suffix(".py") if not place.is_dir() else place / "__init__.py", alias.name)
    return None


def depth(path: Path, name: str) -> int:
    """How many classes of the package stand from it to the farthest of its bases, itself included."""
    bases = [found_in(path, base.id) for base in classes()[path, name].bases if isinstance(base, ast.Name)]
    return 1 + max((depth(*base) for base in bases if base), default=0)


def test_classes_stand_at_most_three_deep():
    depths = {place: depth(*place) for place in classes()}
    assert len(depths) > 500 and sum(d == 3 for d in depths.values()) > 30
    assert {name for (_, name), d in depths.items() if d > 3} == set(DEEP)


def test_kernels_are_those_of_runtime():
    """Which are traced faster (runtime/sources.py): `ti.kernel` stands nowhere else."""
    found = [
        str(path)
        for path, inside in nodes().items()
        if room(path) != "runtime"
        for node in inside
        if isinstance(node, ast.FunctionDef) and any(ast.unparse(d) == "ti.kernel" for d in node.decorator_list)
    ]
    assert found == []
