"""The package's modules as syntax trees, which are parsed and walked once in a process."""

import ast
from functools import lru_cache
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "diffsim_ti"


@lru_cache
def modules() -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


@lru_cache
def nodes() -> dict[Path, list[ast.AST]]:
    """Of each module all nodes of its tree."""
    return {path: list(ast.walk(tree)) for path, tree in modules().items()}
