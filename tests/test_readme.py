"""The README's code blocks run as they stand and print what it says."""

import contextlib
import io
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```(?:\s*```text\n(.*?)```)?", README, re.DOTALL)


def numbers(text: str) -> list[float]:
    return [float(x) for x in re.findall(r"-?\d+\.?\d*(?:e[+-]?\d+)?", text)]


def run(code: str) -> str:
    code = code.replace('ds.init(precision="f64")', 'ds.runtime.set_precision("f64")')  # the session has its runtime
    path = ROOT / "tests" / f"_readme_{abs(hash(code))}.py"
    path.write_text(code)  # Taichi reads kernels from their file
    out = io.StringIO()
    try:
        with contextlib.redirect_stdout(out):
            exec(compile(code, str(path), "exec"), {"__name__": "readme"})
    finally:
        path.unlink()
    return out.getvalue()


@pytest.mark.parametrize("code, printed", BLOCKS, ids=[f"block{k}" for k in range(len(BLOCKS))])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_code_block_runs_and_prints_what_is_shown(code, printed):
    got = run(code)
    if not printed:
        return
    for line, expected in zip(got.splitlines(), printed.splitlines()):
        a, b = numbers(line), numbers(expected)
        assert len(a) == len(b), (line, expected)
        if "right" in expected:  # a row of check_gradients: the error itself is round-off
            a, b = a[:2], b[:2]
        assert a == pytest.approx(b, rel=2e-5), (line, expected)
    assert len(got.splitlines()) >= len(printed.splitlines())


def test_every_command_that_the_readme_names_exists():
    commands = set(re.findall(r"diffsim-ti ([a-z-]+)", README))
    shown = subprocess.run(
        [sys.executable, "-m", "diffsim_ti", "--help"], capture_output=True, text=True, cwd=ROOT
    ).stdout
    assert commands and all(command in shown for command in commands), commands
