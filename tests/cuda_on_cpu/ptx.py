"""Reads PTX, the assembly that Taichi's CUDA backend hands to the driver, into functions, instructions and operands.

Source: NVIDIA, Parallel Thread Execution ISA, chapters 4 (syntax) and 5 (variables). Only what LLVM writes is read.
"""

import re
from dataclasses import dataclass, field

BYTES = {f"{kind}{bits}": bits // 8 for kind in "bsu" for bits in (8, 16, 32, 64)} | {"f32": 4, "f64": 8}
_SPACE_OR_COMMENT = re.compile(r"\s+|//[^\n]*|/\*.*?\*/", re.S)
_TOKEN = re.compile(r'"[^"]*"|[%$_.]?[A-Za-z_$][\w$.]*|\d[\w.]*|.', re.S)
_LINKING = (".visible", ".extern", ".weak", ".common")
_SIMPLE_LINES = re.compile(r"^\s*\.(version|target|address_size|file|loc|section)\b[^\n]*", re.M)


@dataclass
class Variable:
    """.param, .local, .shared, .global or .const: `bytes` from a multiple of `alignment` on, with first values."""

    space: str
    name: str
    bytes: int
    alignment: int
    kind: str
    values: list[str] | None = None


@dataclass
class Registers:
    """.reg: registers name0, name1, ... of one kind, or one register `name` where count is None."""

    kind: str
    name: str
    count: int | None


@dataclass
class Address:
    """[base + offset]; base is a register, a symbol or a number."""

    base: str
    offset: int = 0


@dataclass
class Instruction:
    """@guard opcode operands. An operand is a word, an Address, or a list of words: {a, b}, (a, b) or a|b."""

    guard: str | None
    opcode: str
    operands: list


@dataclass
class Function:
    """.entry (a kernel) or .func. The body holds instructions, registers, variables, labels ("name:") and braces."""

    name: str
    is_entry: bool
    results: list[Variable]
    parameters: list[Variable]
    body: list | None = field(default_factory=list)


@dataclass
class Module:
    variables: list[Variable]
    functions: list[Function]


class Reader:
    """Walks over the words of a module from first to last."""

    def __init__(self, text: str):
        text = _SIMPLE_LINES.sub("", text)
        self._words = [word for part in _SPACE_OR_COMMENT.split(text) for word in _TOKEN.findall(part)]
        self._place = 0

    def module(self) -> Module:
        module = Module([], [])
        while self._place < len(self._words):
            if self._peek() in _LINKING or self._peek() == ";":
                self._take()
            elif self._peek() in (".entry", ".func"):
                module.functions.append(self._function())
            else:
                module.variables.append(self._variable())
                self._take(";")
        return module

    def _peek(self, ahead: int = 0) -> str:
        place = self._place + ahead
        return self._words[place] if place < len(self._words) else ""

    def _take(self, expected: str | None = None) -> str:
        word = self._peek()
        if not word or (expected and word != expected):
            raise SyntaxError(
                f"PTX: {expected or 'more'} expected, found {' '.join(self._words[self._place - 9 : self._place + 3])}"
            )
        self._place += 1
        return word

    def _has(self, word: str) -> bool:
        found = self._peek() == word
        self._place += found
        return found

    def _function(self) -> Function:
        is_entry = self._take() == ".entry"
        results = self._parameters()
        name = self._take()
        function = Function(name, is_entry, results, self._parameters())
        while self._peek() not in ("{", ";"):  # .maxntid and its like say how to launch, which the launch says too
            self._take()
        if self._has(";"):
            function.body = None
            return function
        self._take("{")
        depth = 1
        while depth:
            if self._peek() in ("{", "}"):
                depth += 1 if self._peek() == "{" else -1
                if depth:
                    function.body.append(self._peek())
                self._take()
            else:
                function.body += self._statement()
        return function

    def _parameters(self) -> list[Variable]:
        out = []
        if self._has("("):
            while not self._has(")"):
                out.append(self._variable())
                self._has(",")
        return out

    def _statement(self) -> list:
        if self._peek(1) == ":":
            label = self._take() + ":"
            self._take(":")
            if self._peek() == ".callprototype":  # the call's own operands say as much
                while not self._has(";"):
                    self._take()
                return []
            return [label]
        if self._peek() == ".reg":
            out = self._registers()
        elif self._peek() in (".local", ".shared", ".param"):
            out = [self._variable()]
        elif self._peek() == ".pragma":
            self._take(), self._take()
            out = []
        else:
            out = [self._instruction()]
        self._take(";")
        return out

    def _registers(self) -> list[Registers]:
        self._take(".reg")
        kind, out = self._take()[1:], []
        while not out or self._has(","):
            name, count = self._take(), None
            if self._has("<"):
                count = int(self._take())
                self._take(">")
            out.append(Registers(kind, name, count))
        return out

    def _variable(self) -> Variable:
        space, alignment, kind = self._take()[1:], None, None
        while self._peek().startswith("."):
            word = self._take()[1:]
            if word == "align":
                alignment = int(self._take())
            elif word in BYTES:
                kind = word
        name, count, values = self._take(), 1, None
        while self._has("["):
            count *= 0 if self._peek() == "]" else int(self._take(), 0)
            self._take("]")
        if self._has("="):
            values = self._list("{", "}") if self._peek() == "{" else [self._take()]
        return Variable(space, name, count * BYTES[kind], alignment or BYTES[kind], kind, values)

    def _instruction(self) -> Instruction:
        guard = None
        if self._has("@"):
            guard = ("!" if self._has("!") else "") + self._take()
        opcode, operands = self._take(), []
        while self._peek() != ";":
            operands.append(self._operand())
            self._has(",")
        return Instruction(guard, opcode, operands)

    def _operand(self):
        if self._peek() == "{":
            return self._list("{", "}")
        if self._peek() == "(":
            return self._list("(", ")")
        if self._has("["):
            base, offset = self._take(), 0
            if self._peek() in "+-":
                sign = -1 if self._take() == "-" else 1
                offset = sign * int(self._signed(), 0)
            self._take("]")
            return Address(base, offset)
        word = self._signed()
        if self._has("|"):
            return [word, self._take()]
        return word

    def _signed(self) -> str:
        return "-" + self._take() if self._has("-") else "!" + self._take() if self._has("!") else self._take()

    def _list(self, first: str, last: str) -> list[str]:
        out = []
        self._take(first)
        while not self._has(last):
            out.append(self._signed())
            self._has(",")
        return out


def read(text: str) -> Module:
    return Reader(text).module()
