"""Taichi functions that share variables compute what Python computes, whatever is stored, renamed, swapped and changed."""

import ast
import linecache
import random

import numpy as np
import pytest
import taichi as ti

from diffsim_ti import runtime

if runtime.QUADRANTS:
    pytest.skip("Quadrants has a tracer of its own", allow_module_level=True)

from diffsim_ti.runtime import tracer

CALLEES = """
def same(x):
    return x

def doubled(x):
    x *= 2.0
    return x

def turned(x, y):
    x, y = y, x
    return x, y

def both(x, y):
    z = same(x)
    w = doubled(y)
    return z + w, z, w

def counted(x, y):
    for i in ti.static(range(2)):
        step = same(y)
        x += step * i
    return x, y
"""


def program(seed: int) -> str:
    """A random function of two numbers that writes all of its variables to out[0] .. out[7]."""
    draw, names, lines = random.Random(seed), ["a", "b"], []
    for k in range(14):
        x, y = draw.choice(names), draw.choice(names)
        new, other = f"v{k}", f"w{k}"
        kind = draw.randrange(10)
        if kind == 0:
            lines.append(f"{new} = {x} * 0.5 + {y}")
        elif kind == 1:
            lines.append(f"{new} = {x}")  # must not follow what comes to x later
        elif kind == 2:
            lines.append(f"{new} = {draw.choice(['same', 'doubled'])}({x})")
        elif kind == 3:
            lines.append(f"{new}, {other} = {draw.choice(['turned', 'counted'])}({x}, {y})")
        elif kind == 4:
            lines.append(f"_, _, {new} = both({x}, {y} - 0.25)")
        elif kind == 5:
            lines.append(f"{new}, {other} = {x}, {y}")
        elif kind == 6:
            lines.append(f"{x} {draw.choice(['+=', '-='])} {y} + 0.125")
        elif kind == 7:
            lines.append(f"{x} = {y} - 0.75 * {x}")
        elif kind == 8:
            lines.append(f"{x}, {y} = {y}, {x}" if x != y else f"out[6] = {x}")
        else:
            lines += [
                f"if {x} > {y}:",
                f"    {x} = {y} + 1.0",
                "else:",
                f"    out[7] = doubled({y})",
                f"    {x} += out[7]",
            ]
        if kind in (0, 1, 2, 4):
            names.append(new)
        elif kind in (3, 5):
            names += [new, other]
    lines += [f"out[{k}] = {name}" for k, name in enumerate(draw.sample(names, min(6, len(names))))]
    return "def run(a, b, out):\n" + "".join(f"    {line}\n" for line in lines)


def functions(source: str, name: str, wrap) -> dict:
    """The functions of a text, each wrapped, so that they call each other as they are wrapped."""
    linecache.cache[name] = (len(source), None, source.splitlines(True), name)  # Taichi reads a function's source
    scope = {"ti": ti}
    exec(compile(source, name, "exec"), scope)
    own = {key: value for key, value in scope.items() if getattr(value, "__code__", None)}
    scope.update({key: wrap(value) for key, value in own.items()})
    return scope


def by_taichi(run, start) -> np.ndarray:
    out = np.zeros(8)

    @runtime.kernel
    def kernel(out: ti.types.ndarray(ti.f64, 1), a: ti.f64, b: ti.f64):
        for _ in range(1):
            run(a, b, out)

    kernel(out, *start)
    return out


@pytest.fixture
def shared(monkeypatch):
    """Functions of any file are taken as those of the package."""
    monkeypatch.setattr(tracer, "may_share", lambda file: True)


@pytest.mark.parametrize("seed", range(24))
def test_random_functions_compute_what_python_does(seed, shared):
    source, start = CALLEES + program(seed), (0.7, -1.3)
    source_of_taichi = source.replace("def run(a, b, out)", "def run(a, b, out: ti.template())")
    expected = np.zeros(8)
    functions(source, f"<python {seed}>", lambda f: f)["run"](*start, expected)
    found = by_taichi(functions(source_of_taichi, f"<taichi {seed}>", ti.func)["run"], start)
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-14, err_msg=source)
    assert np.ptp(expected) > 0.1


def test_what_is_changed_is_known():
    text = """
def f(a, b, c, d, e):
    b = 1
    c[0] = 2
    ti.atomic_add(d, 3)
    x = a
    x += 1
    y = 2
    for k in range(3):
        z = k
    e.part = y
"""
    assert tracer.changed_names(ast.parse(text).body[0]) == {"b", "c", "d", "e", "x"}


BY_REFERENCE = """
def bump(x: ti.template()):
    x += 1.0

def bumped(x):
    bump(x)
    return x

def run(a, b, out: ti.template()):
    c = a + b
    d = c
    out[0] = bumped(c)
    out[1] = c
    bump(c)
    out[2], out[3] = c, d
"""


def test_functions_from_elsewhere_keep_copies():
    run = functions(BY_REFERENCE, "<elsewhere>", ti.func)["run"]
    np.testing.assert_array_equal(by_taichi(run, (1.0, 2.0))[:4], [4.0, 3.0, 4.0, 3.0])


def test_what_changes_by_reference_must_be_a_variable(shared):
    run = functions(BY_REFERENCE, "<ours>", ti.func)["run"]
    with pytest.raises(ti.TaichiCompilationError, match=r"bump changes x: give it a variable\(\)"):
        by_taichi(run, (1.0, 2.0))
