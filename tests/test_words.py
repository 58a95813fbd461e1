"""Pages, public docstrings and messages use the words of the field: some words of our own stand nowhere."""

import ast
import re
from pathlib import Path

import pytest
from package_source import nodes
from test_readme import GUIDES
from test_reference import PUBLIC, parts, said

ROOT = Path(__file__).parent.parent
PAGES = ("README.md", "examples/README.md", "examples/glossary.md", *GUIDES)

# what is not written -> what is
WORDS = {
    r"\b(?:a|each|every|one|per|the|this|last|next|first|of) pass(?:es)?\b": "substep, or kick-drift stage",
    r"\bfelt\b|\bfeels?\b": "contact points act, or an adjoint is accumulated",
    r"\brub(?:s|bed|bing)?\b": "friction acts",
    r"\blook(?:s|ed)? (?:after|at)\b|\bsomebody look": "check, monitor",
    r"\bof ours\b": "relative to diffsim_ti",
    r"\brows? of (?:a|the|its) path": "samples, keyframes",
    r"\btwins?\b": "device counterpart, copy for another precision",
    r"\bwalls\b": "obstacle's pose or velocity; boundary of a cavity",
    r"\bfounded\b": "on an elastic foundation",
    r"\bclamps\b": "supports, prescribed motion",
    r"\blaid on\b|\blays? .{1,20}\bon\b": "applied in steps, load stepping",
    r"\b(?:does|do) not know\b": "does not support",
    r"\bgiven (?:forces?|loads?)\b": "applied, prescribed",
    r"\bsets? can do\b": "admissible motions",
    r"\bloss (?:may|can) name": "differentiable outputs",
    r"\bnumbers of (?:(?:a|its|the|all|their) )?terms?\b": "parameters",
    r"\bfurther (?:elements|items)\b": "surface and line elements, interactions",
    r"\bat once\b": "simultaneously, in a batch",
    r"\bstatics\b": "static solves, equilibria",
    r"(?<![\w.)\]}\"':_])\.\d": "0.6, with its leading zero",
    r"\bheld (?:vertices|volumes?|stress)\b": "fixed or constrained, incompressible, frozen",
}
# where they stand all the same, and why
EXCEPTIONS = {
    r"(Law|InvariantLaw|StrainLaw|EnergyLaw|UnequalSteps|SolveReport|\w*Solver)(\.\w+)?: .*pass": "what extends the package "
    "takes the word of its architecture: an explicit substep, or an implicit or static solve",
    r"residual %\.2g": "a format of a number",
}


def messages() -> list[tuple[str, str]]:
    """(file, text) of every string of words in the package that is no docstring."""
    out = []
    for path, inside in nodes().items():
        plain = {id(node.value) for node in inside if isinstance(node, ast.Expr)}
        for node in inside:
            if (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and " " in node.value
                and id(node) not in plain
            ):
                out.append((path.relative_to(ROOT).as_posix(), node.value))
    return out


def docstrings() -> list[tuple[str, str]]:
    """(public name, its docstring), and those of methods and properties."""
    out = [(name, said(thing)) for name, thing in PUBLIC.items()]
    for name, kind in PUBLIC.items():
        if isinstance(kind, type):
            out += [(f"{name}.{part}", getattr(kind, part).__doc__ or "") for part in parts(kind)]
    return out


def pages() -> list[tuple[str, str]]:
    return [
        (name, re.sub(r"```.*?```", "", (ROOT / name).read_text(encoding="utf-8"), flags=re.DOTALL)) for name in PAGES
    ]


@pytest.mark.parametrize("texts", [messages, docstrings, pages])
def test_words_are_those_of_the_field(texts):
    found = []
    for where, text in texts():
        for pattern, better in WORDS.items():
            for hit in re.finditer(pattern, text):
                around = " ".join(text[max(0, hit.start() - 60) : hit.end() + 30].split())
                if not any(re.search(pattern, f"{where}: {around}") for pattern in EXCEPTIONS):
                    found.append(f"{where}: ... {around} ...: {better}")
    assert not found, "\n".join(sorted({*found}))
