"""Places of adjoint code where one thing can be changed, found by walking the package: what `mutations.py` draws from."""

import ast
import difflib
import random
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "diffsim_ti"

# ---- what is adjoint code ----------------------------------------------------------------------------------------------

NAMES = re.compile(r"(^|_)(vjp|adjoints?|reverse|backward|mirror|transposed?|pull_back|fold|collect)(_|$)")
ARGUMENTS = re.compile(r"(^|_)adj(oint)?s?$")
CLASSES = re.compile("Adjoint")
ASIDE = ("study/", "cli", "examples/")  # they use gradients


def is_adjoint(function, owner) -> bool:
    """Whether a function computes adjoints, by its name, its arguments, or the class that it is a method of."""
    if function.name == "__init__" or function.name in NO_GRADIENTS or NO_NUMBERS.search(function.name):
        return False
    arguments = [a.arg for a in (*function.args.args, *function.args.kwonlyargs)]
    return bool(NAMES.search(function.name) or any(map(ARGUMENTS.search, arguments)) or CLASSES.search(owner))


def adjoint_functions(tree):
    """(qualified name, function) of the outermost functions that compute adjoints."""

    def walk(node, path, owner):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef):
                yield from walk(child, (*path, child.name), child.name)
            elif isinstance(child, ast.FunctionDef):
                name = (*path, child.name)
                if is_adjoint(child, owner):
                    yield ".".join(name), child
                else:
                    yield from walk(child, name, "")
            else:
                yield from walk(child, path, owner)

    yield from walk(tree, (), "")


# ---- what may be changed -----------------------------------------------------------------------------------------------

NO_NUMBERS = re.compile(r"(^|_)(warn|check|refuse|isfinite|loop_config|sync|synchronize)")  # calls that say or wait
EITHER_WAY = {"hypot", "dot", "inner", "minimum", "maximum", "array_equal"}  # calls whose arguments can be swapped
NO_GRADIENTS = {"fits"}  # says whether arrays of an earlier sweep can be used again
ONLY_SPEED = {"chunk", "atol"}  # how much work goes into one launch, how exact a solve is
NOT_HERE = {"is_cuda"}  # branches that this machine does not take


def called(node) -> str:
    """The name of what an expression statement or a call calls."""
    f = node.func if isinstance(node, ast.Call) else None
    return f.attr if isinstance(f, ast.Attribute) else f.id if isinstance(f, ast.Name) else ""


def named(node) -> set:
    return {n.id for n in ast.walk(node) if isinstance(n, ast.Name)} | {
        n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute)
    }


def without_effect(node) -> bool:
    """Whether no change below a node can change a gradient: messages, checks, speed, branches of other machines."""
    if isinstance(node, (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom, ast.arguments, ast.Global)):
        return True
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):  # a docstring
        return True
    if isinstance(node, ast.Call):
        keeps_in_bounds = called(node) == "min" and "shape" in named(node)
        return keeps_in_bounds or bool(NO_NUMBERS.search(called(node)))
    if isinstance(node, ast.Expr):
        return without_effect(node.value)
    if isinstance(node, ast.If):
        return bool(named(node.test) & NOT_HERE) or (not node.orelse and all(map(without_effect, node.body)))
    return False


def used(node) -> set:
    """Names that are read where it can matter."""
    if without_effect(node):
        return set()
    own = {node.id} if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load) else set()
    return own.union(*map(used, ast.iter_child_nodes(node)))


def unused(node, names: set) -> bool:
    """Whether a statement sets names alone that nothing else reads, or that only say how fast it goes."""
    if not isinstance(node, ast.Assign):
        return False
    targets = [t for target in node.targets for t in getattr(target, "elts", [target])]
    return all(isinstance(t, ast.Name) and (t.id not in names or t.id in ONLY_SPEED) for t in targets)


@dataclass(frozen=True)
class Mutation:
    """One change: `old`, the bytes start..stop of a file, becomes `new`."""

    path: str
    function: str
    line: int
    kind: str
    start: int
    stop: int
    new: str

    def apply(self, source: bytes) -> bytes:
        return source[: self.start] + self.new.encode() + source[self.stop :]

    def is_change(self, source: bytes) -> bool:
        """Whether what is left is Python, and other Python."""
        try:
            return ast.dump(ast.parse(source)) != ast.dump(ast.parse(self.apply(source)))
        except SyntaxError:
            return False

    def diff(self, source: bytes) -> str:
        old, new = (text.decode().splitlines() for text in (source, self.apply(source)))
        lines = difflib.unified_diff(old, new, self.path, self.path, lineterm="", n=1)
        return "\n".join(line for line in lines if not line.startswith(("---", "+++")))


class Finder:
    """All mutations of the adjoint code of one file."""

    def __init__(self, path: str, source: bytes):
        self.path, self.source, self.found = path, source, []
        lines = source.splitlines(keepends=True)
        self.offsets = [0]
        for line in lines:
            self.offsets.append(self.offsets[-1] + len(line))
        tree = ast.parse(source)
        keys = Counter(
            n.slice.value
            for n in ast.walk(tree)
            if isinstance(n, ast.Subscript) and isinstance(getattr(n.slice, "value", None), str)
        )
        self.keys = sorted(keys)
        for self.function, node in adjoint_functions(tree):
            self.names = set().union(*map(used, node.body))
            for child in node.body:
                self.visit(child)

    def span(self, node) -> tuple[int, int]:
        return self.offsets[node.lineno - 1] + node.col_offset, self.offsets[node.end_lineno - 1] + node.end_col_offset

    def text(self, node) -> str:
        start, stop = self.span(node)
        return self.source[start:stop].decode()

    def add(self, kind: str, node, new: str) -> None:
        self.found.append(Mutation(self.path, self.function, node.lineno, kind, *self.span(node), new))

    def visit(self, node, in_index: bool = False) -> None:
        if without_effect(node) or unused(node, self.names):
            return
        change = getattr(self, "change_" + type(node).__name__.lower(), None)
        if change:
            change(node, in_index)
        for name, value in ast.iter_fields(node):
            if name in (
                "annotation",
                "returns",
                "decorator_list",
                "keywords",
            ):  # options of calls are mostly not numbers
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    self.visit(child, in_index or (isinstance(node, ast.Subscript) and name == "slice"))

    # ---- one method for each kind of node ------------------------------------------------------------------------------

    def change_constant(self, node, in_index) -> None:
        if isinstance(node.value, str) and in_index:
            for other in self.keys:
                if other != node.value:
                    self.add("row", node, repr(other))
        elif isinstance(node.value, int) and not isinstance(node.value, bool) and in_index:
            self.add("index", node, str(node.value + 1))
            if node.value > 0:
                self.add("index", node, str(node.value - 1))
        elif isinstance(node.value, float) and node.value != 0:
            self.add("factor", node, f"{node.value * 1.001!r}")

    def change_binop(self, node, in_index) -> None:
        a, b = self.text(node.left), self.text(node.right)
        zero = any(isinstance(x, ast.Constant) and x.value == 0 for x in (node.left, node.right))
        if isinstance(node.op, ast.Add) and not zero:
            self.add("sign", node, f"({a} - ({b}))")
        if isinstance(node.op, ast.Sub) and not zero:
            self.add("sign", node, f"({a} + {b})")
        if isinstance(node.op, (ast.Sub, ast.Div, ast.MatMult)):
            op = {ast.Sub: "-", ast.Div: "/", ast.MatMult: "@"}[type(node.op)]
            self.add("operands", node, f"(({b}) {op} ({a}))")
        if isinstance(node.op, (ast.Mult, ast.Div, ast.MatMult)) and not in_index and not zero:
            for factor in ("1.001", "2"):
                self.add("factor", node, f"(({self.text(node)}) * {factor})")

    def change_unaryop(self, node, in_index) -> None:
        if isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
            self.add("sign", node, f"({self.text(node.operand)})")

    def change_call(self, node, in_index) -> None:
        if called(node) == "range":
            end = node.args[min(len(node.args) - 1, 1)]
            fewer = 2 if self.text(end) == "4" else 1  # the fourth component of a vector is zero
            self.add("range", end, f"{self.text(end)} - {fewer}")
        elif called(node) not in EITHER_WAY:
            like = (ast.Name, ast.Attribute, ast.Subscript, ast.BinOp)  # of one type, or most swaps would not compile
            for a, b in zip(node.args, node.args[1:]):
                if type(a) is not type(b) or not isinstance(a, like):
                    continue
                start, stop = self.span(a)[0], self.span(b)[1]
                between = self.source[self.span(a)[1] : self.span(b)[0]].decode()
                swapped = f"{self.text(b)}{between}{self.text(a)}"
                if self.text(a) != self.text(b):
                    self.found.append(Mutation(self.path, self.function, a.lineno, "arguments", start, stop, swapped))

    def change_augassign(self, node, in_index) -> None:
        self.add("dropped", node, "pass")
        op = {ast.Add: "-=", ast.Sub: "+="}.get(type(node.op))
        if op:
            self.add("sign", node, f"{self.text(node.target)} {op} {self.text(node.value)}")

    def change_assign(self, node, in_index) -> None:
        targets = [t for target in node.targets for t in getattr(target, "elts", [target])]
        again = {ast.dump(t).replace("Store", "Load") for t in targets} & {ast.dump(n) for n in ast.walk(node.value)}
        if again or any(isinstance(t, ast.Subscript) for t in targets):
            self.add("dropped", node, "pass")

    def change_expr(self, node, in_index) -> None:
        if isinstance(node.value, ast.Call):
            self.add("dropped", node, "pass")

    def change_if(self, node, in_index) -> None:
        if not (isinstance(node.test, ast.Call) and called(node.test) == "static"):
            self.add("condition", node.test, f"not ({self.text(node.test)})")

    change_ifexp = change_if


def all_mutations() -> list[Mutation]:
    """Every mutation that could be drawn, in the order of files and lines."""
    found = []
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        name = path.relative_to(ROOT / PACKAGE).as_posix()
        if not name.startswith(ASIDE):
            found += Finder(path.relative_to(ROOT).as_posix(), path.read_bytes()).found
    return found


def drawn(seed: int):
    """Mutations at random, never two of one line: a place first, then one of the changes that it offers."""
    places = {}
    for mutation in all_mutations():
        places.setdefault((mutation.path, mutation.line), []).append(mutation)
    rng = random.Random(seed)
    for place in rng.sample(sorted(places), len(places)):
        kinds = {}
        for mutation in places[place]:
            kinds.setdefault(mutation.kind, []).append(mutation)
        mutation = rng.choice(kinds[rng.choice(sorted(kinds))])
        if mutation.is_change((ROOT / mutation.path).read_bytes()):
            yield mutation
