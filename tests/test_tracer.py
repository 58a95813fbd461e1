"""Kernels of the package are traced as Taichi itself traces them, only faster; kernels of others by Taichi itself."""

import importlib.util
import itertools
import random
import re
import subprocess
import sys

import numpy as np
import pytest
import taichi as ti
from taichi.lang import impl

from diffsim_ti import runtime

if runtime.QUADRANTS:
    pytest.skip("Quadrants has a tracer of its own", allow_module_level=True)

from diffsim_ti.runtime import sources, tracer

LEVELS = itertools.count(random.SystemRandom().randrange(1000, 10**9))  # none that a cache on disk knows
HEADER = """import math
import taichi as ti
from taichi import static as known
from diffsim_ti import runtime

a_few, GLOBAL, VECTORS = [1, 2, 3], 2.5, ti.types.ndarray(ti.types.vector(3, ti.f64), 1)


@ti.func
def mixed(x, y):
    z = x * y + 1
    if z > 2:
        z -= y
    return z


@ti.func
def pair(x, y: ti.template()):
    return x + y, ti.max(x, y)


"""


class Writer:
    """A random kernel."""

    def __init__(self, seed: int, sums: bool = False):
        """sums: also of what Taichi's own functions of vectors and matrices compute."""
        self.random, self.floats, self.ints, self.sums = random.Random(seed), ["f", "GLOBAL"], ["i", "n"], sums

    def expression(self, depth: int = 0) -> str:
        pick = self.random.random
        if depth > 3 or pick() < 0.2:
            return self.random.choice(
                [*self.floats, "a[i]", "v[i][1]", "w[1]", str(round(pick(), 3)), "2", "ti.cast(3, ti.f64)"]
            )
        x, y, k = self.expression(depth + 1), self.expression(depth + 1), self.integer(depth + 1)
        return self.random.choice(
            [
                f"({x} {self.random.choice('+-*/')} {y})",
                f"({x}) ** 2",
                f"-({x})",
                f"mixed({x}, {y})",
                f"pair({x}, {y})[{self.random.randrange(2)}]",
                f"max({x}, {y}, 1)",
                f"abs({x})",
                f"ti.select({k} > 1, {x}, {y})",
                f"({x} if {k} % 2 == 0 else {y})",
                f"a[({k}) % 4]",
                f"(v[({k}) % 4] * {x})[{self.random.randrange(3)}]",
                f"(ti.Matrix([[1.0, {x}], [2.0, 3.0]]) * {y})[{self.random.randrange(2)}, 1]",
                f"ti.static(math.sqrt({self.random.randrange(1, 9)}))",
                f"float({k})",
                *(self.of_vectors(x, y, k) if self.sums else ()),
            ]
        )

    def of_vectors(self, x: str, y: str, k: str) -> list[str]:
        return [
            f"v[({k}) % 4].norm_sqr()",
            f"(v[i] * {x}).dot(w)",
            f"(w - {x}).norm({y} ** 2)",
            f"w.cross(v[{k} % 4])[{self.random.randrange(3)}]",
            f"(ti.Matrix([[1.0, {x}], [2.0, 3.0]]) @ ti.Vector([{y}, 1.0]))[{self.random.randrange(2)}]",
            f"ti.Matrix([[{x}, 1.0], [2.0, {y}]]).sum()",
            f"ti.max(w[0], (v[i] * {x}).max())",
        ]

    def integer(self, depth: int = 0) -> str:
        if depth > 3 or self.random.random() < 0.4:
            return self.random.choice([*self.ints, "1", "3", "a.shape[0]"])
        x, y = self.integer(depth + 1), self.integer(depth + 1)
        return self.random.choice(
            [
                f"({x} + {y})",
                f"({x} // 2)",
                f"({x} << 1)",
                f"({x} & {y})",
                f"({x} | 1)",
                f"({x} ^ {y})",
                f"int({x})",
                f"ti.abs({x})",
            ]
        )

    def statements(self, indent: str, depth: int = 0) -> list[str]:
        lines = []
        for _ in range(self.random.randrange(1, 4)):
            new, x = f"x{len(self.floats)}", self.expression()
            kind = self.random.randrange(8)
            if kind < 3:
                lines.append(f"{indent}{new} = {x} + 0.0")
                self.floats.append(new)
            elif kind == 3:
                lines.append(f"{indent}{new}, {new}_ = pair({x}, {self.expression()})")
                self.floats += [new, f"{new}_"]
            elif kind == 4:
                lines.append(f"{indent}a[i] {self.random.choice(['=', '+=', '*='])} {x} * 1.5")
            elif kind == 5:
                lines.append(f"{indent}w[{self.random.randrange(3)}] = {x} - 1")
            elif depth < 2:
                inner = [*self.floats]
                head = self.random.choice(
                    [
                        f"if {self.integer()} > 1 and {x} < 3:",
                        f"for k{depth} in range({self.random.randrange(1, 4)}):",
                        f"for k{depth} in ti.static(range(2)):",
                        f"for k{depth}, each{depth} in known(enumerate(a_few)):",
                    ]
                )
                lines += [indent + head, *self.statements(indent + "    ", depth + 1)]
                self.floats = inner
        return lines or [f"{indent}a[i] = {self.expression()}"]

    def kernel(self, last: str = "") -> str:
        body = self.statements(" " * 8)
        return HEADER + "\n".join(
            [
                "@ti.kernel",
                "def made(a: ti.types.ndarray(ti.f64, 1), v: VECTORS, n: ti.i32, f: ti.f64):",
                "    for i in range(a.shape[0]):",
                "        w = v[i] * 2",
                *body,
                *([" " * 8 + last] if last else []),
                "        a[i] += w.sum()" if self.sums else "        a[i] += w[0] + w[2]",
            ]
        )


def traced(kernel, capfd) -> tuple:
    """(the error, the code before Taichi's first pass and where each part of it stands, what it computes)"""
    config, error = impl.get_runtime().prog.config(), ""
    a, v = ti.ndarray(ti.f64, 4), ti.Vector.ndarray(3, ti.f64, 4)
    a.from_numpy(np.arange(4.0)), v.from_numpy(np.arange(12.0).reshape(4, 3) / 7)
    capfd.readouterr()
    config.print_ir = config.print_ir_dbg_info = True
    config.opt_level = next(LEVELS)  # so that nothing is found in a cache
    try:
        kernel(a, v, 3, 0.7)
    except Exception as raised:
        error = f"{type(raised).__name__}: {raised}"
    finally:
        config.print_ir = config.print_ir_dbg_info = False
    return error, capfd.readouterr().out.partition("\n}\n")[0], a.to_numpy().tolist()


def both(source: str, path, capfd, monkeypatch) -> list[tuple]:
    """What `traced` finds as the package traces and as Taichi does."""
    path.write_text(source.replace("@ti.kernel", "@runtime.kernel"))
    found = []
    for left_out in ((), tracer.CHANGES):
        with monkeypatch.context() as patch:
            for place in left_out:
                patch.delitem(sources._CHANGES, place)
            spec = importlib.util.spec_from_file_location("kernels", path)
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            found.append(traced(module.made, capfd))
    return found


@pytest.fixture(autouse=True)
def level():
    config = impl.get_runtime().prog.config()
    before = config.opt_level
    yield
    config.opt_level = before


@pytest.mark.parametrize("seed", range(12))
def test_random_kernels_are_traced_as_taichi_traces_them(seed, tmp_path, capfd, monkeypatch):
    ours, theirs = both(Writer(seed).kernel(), tmp_path / "kernels.py", capfd, monkeypatch)
    assert ours == theirs and not ours[0] and ours[1].count("File") > 8


@pytest.mark.parametrize("seed", range(12, 20))
def test_sums_over_vectors_take_fewer_variables_and_have_the_same_bits(seed, tmp_path, capfd, monkeypatch):
    ours, theirs = both(Writer(seed, sums=True).kernel(), tmp_path / "kernels.py", capfd, monkeypatch)
    assert not ours[0] and ours[2] == theirs[2] and ours[1].count("alloca") < 0.9 * theirs[1].count("alloca")


WRONG = {
    "w[1] = nowhere + 1": 'Name "nowhere" is not defined',
    "w[1] = mixed(nowhere, 1)": 'Name "nowhere" is not defined',
    "w[1] = v[-1][0]": "Negative indices",
    "w[1] = mixed(1.0)": "missing",
    "w[1] = v[i].nothing": "no attribute 'nothing'",
    "w[1] = a[i] @ 2": "matmul",
    "w[1] = 1 << 2.5": "unsupported operand",
    "w[1] = 3000000000": "exceeded the range",
    "w[1] = a[i] + 'x'": "",
    "w[1] = a[i, 0]": "",
    "w[1] = f[0]": "",
    "w[1] = math.sqrt(f)": "",
    "lambda: 3": "Unsupported node",
    "n = 3": "immutable",
    "w[0] = v": "",
}


@pytest.mark.filterwarnings("ignore:.*non-taichi function")
@pytest.mark.parametrize("line", WRONG)
def test_what_is_wrong_is_said_as_taichi_says_it(line, tmp_path, capfd, monkeypatch):
    ours, theirs = both(Writer(3).kernel(line), tmp_path / "kernels.py", capfd, monkeypatch)
    assert ours[0] and WRONG[line] in ours[0]
    ours, theirs = (
        re.sub(r"(?s)Traceback .*\n(?=\w)", "", found[0]) for found in (ours, theirs)
    )  # frames of the tracer
    assert ours == theirs


def test_kernels_of_others_are_traced_by_taichi_itself():
    """While a kernel of the package is traced, the functions in question are ours; before and after, Taichi's own."""
    code = """
import importlib, taichi as ti
from taichi.lang import impl, kernel_impl, ops
from taichi.lang.ast.ast_transformer import ASTTransformer
from taichi.lang.expr import Expr

def found():
    owners = (ti, impl, kernel_impl, ops, ASTTransformer, Expr, importlib.import_module("taichi.lang.ast.ast_transformer"))
    return [dict(vars(owner)) for owner in owners]

before = found()
import numpy as np
import diffsim_ti as ds
from diffsim_ti.materials.evaluate import evaluate
assert [a.items() <= b.items() for a, b in zip(before, found())] == [True] * 7
ds.init(precision="f64")
started = found()
evaluate(ds.StableNeoHookean(1e5, 0.3).law("f64"), np.eye(3)[None], np.ones(2))
assert found() == started
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)


def test_a_kernel_that_fails_leaves_taichis_tracer_behind():
    @runtime.kernel
    def wrong(a: ti.f64):
        b = nowhere + a  # noqa: F821, F841

    before = [vars(owner).get(name) for owner, name in sources._CHANGES]
    with pytest.raises(ti.TaichiCompilationError, match="nowhere"):
        wrong(1.0)
    assert [vars(owner).get(name) for owner, name in sources._CHANGES] == before


def test_functions_of_taichi_copy_their_arguments_in_kernels_of_others():
    """Those that kernels of the package hand arguments to as they are, while these are traced alone."""

    @runtime.kernel
    def ours() -> ti.f64:
        return ti.Vector([3.0, 4.0], ti.f64).normalized()[0]

    @ti.func
    def spoil(x: ti.template()):
        x[0] = 100.0
        return 1.0

    @ti.func
    def first(x, _):
        return x[0]

    @ti.kernel
    def theirs() -> ti.f64:
        x = ti.Vector([3.0, 4.0], ti.f64)
        return first(x.normalized(), spoil(x))

    assert ours() == pytest.approx(0.6) and theirs() == pytest.approx(0.6)
