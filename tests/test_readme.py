"""The pages' code blocks run as they stand and print what they say; their commands, links and pictures are there."""

import contextlib
import io
import os
import re
import shlex
import sys
from itertools import dropwhile
from pathlib import Path

import areas
import nbclient
import nbformat
import pytest
import typer
from PIL import Image

import diffsim_ti as ds
from diffsim_ti.cli.app import app

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "examples"))

import notebooks  # noqa: E402

GUIDES = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "examples/guides").glob("*.md"))
PLAIN = "README.md", "examples/README.md", "examples/glossary.md", "examples/benchmarks/README.md", "tests/README.md"
PAGES = {name: (ROOT / name).read_text(encoding="utf-8") for name in (*PLAIN, *GUIDES)}


def blocks(text: str) -> list[tuple[str, str]]:
    """(code, what it prints or nothing) of each Python block of a page."""
    return re.findall(r"```python\n(.*?)```(?:\s*```text\n(.*?)```)?", text, re.DOTALL)


BLOCKS = [
    pytest.param(*block, id=f"{page.removesuffix('README.md')}block{k}")
    for page in PLAIN
    for k, block in enumerate(blocks(PAGES[page]))
]


def numbers(text: str) -> list[tuple[float, float]]:
    """(a number, one in its last digit behind the point) for all of a text."""
    found = re.findall(r"(-?\d+\.?(\d*)(?:e([+-]?\d+))?)", text)
    return [(float(x), 10.0 ** (int(power or 0) - len(digits)) if digits else 0.0) for x, digits, power in found]


def run(code: str) -> str:
    """What a script prints, run in the working folder. The session has its runtime: ds.init chooses the precision alone,
    which is float32 without."""
    path = Path("script.py").resolve()
    path.write_text(code, encoding="utf-8")  # Taichi reads kernels from their file
    out = io.StringIO()
    init, ds.init = ds.init, lambda backend="cpu", precision="f32": ds.runtime.set_precision(precision)
    ds.runtime.set_precision("f32")
    try:
        with contextlib.redirect_stdout(out):
            exec(compile(code, str(path), "exec"), {"__name__": "readme"})
    finally:
        ds.init = init
        ds.runtime.set_precision("f64")
    return out.getvalue()


def compare(got: str, printed: str) -> None:
    """The numbers of what was printed, line by line, with those that a page shows; some at the end may be left out."""
    for line, expected in zip(got.splitlines(), printed.splitlines()):
        a, b = numbers(line), numbers(expected)
        assert len(a) == len(b), (line, expected)
        if "right" in expected:  # a row of check_gradients: the error itself is round-off
            a, b = a[:2], b[:2]
        for (x, _), (y, digit) in zip(a, b):  # what is rounded may be rounded the other way
            assert x == pytest.approx(y, rel=2e-5, abs=1.01 * digit), (line, expected)
    assert len(got.splitlines()) >= len(printed.splitlines())


@pytest.mark.parametrize("code, printed", BLOCKS)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_code_block_runs_and_prints_what_is_shown(code, printed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    compare(run(code), printed)


def as_a_notebook(page: str, folder: Path) -> list[str]:
    """What each cell of code of a guide prints, as a notebook in a process of its own."""
    made = notebooks.notebook(ROOT / page, folder)
    client = nbclient.NotebookClient(made, timeout=300, resources={"metadata": {"path": str(folder)}})
    cells = [cell for cell in client.execute().cells if cell.cell_type == "code"]
    return ["".join(out.get("text", "") for out in cell.outputs if out.get("name") == "stdout") for cell in cells]


@pytest.mark.parametrize("page", GUIDES)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_guide_runs_from_top_to_bottom_and_prints_what_is_shown(page, tmp_path, monkeypatch):
    """Its blocks share one namespace; the picture that it shows is one that it makes. One runs as a notebook."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT), prepend=os.pathsep)
    shown = blocks(PAGES[page])
    if Path(page).stem == "gradients":  # which has a Taichi kernel in a cell
        printed = as_a_notebook(page, tmp_path)
    else:
        printed = run("\nprint(chr(0))\n".join(code for code, _ in shown)).split("\0\n")
    for got, (_, expected) in zip(printed, shown, strict=True):
        compare(got, expected)
    for name in re.findall(r"guide_(\w+\.(?:png|gif))", PAGES[page]):
        with Image.open(tmp_path / name) as made:
            assert made.width >= 300 and len(made.convert("RGB").getcolors(1 << 24)) > 50


def test_notebooks_are_written_by_one_command(tmp_path):
    written = notebooks.main(tmp_path / "made")
    assert len(written) == 5
    for path in written:
        shown = nbformat.read(path, as_version=4)
        nbformat.validate(shown)
        for target in re.findall(r"\]\((?!http|#)([^)#]+)", "".join(cell.source for cell in shown.cells)):
            assert (path.parent / target).exists(), target


LENGTHS = {"README.md": 180, "examples/README.md": 120, **dict.fromkeys(GUIDES, 150)}


@pytest.mark.parametrize("page", LENGTHS)
def test_pages_are_short(page):
    assert len(PAGES[page].splitlines()) <= LENGTHS[page]


def without_blocks(text: str) -> str:
    return re.sub(r"```.*?```", "", text, flags=re.DOTALL)


def commands(text: str) -> list[str]:
    """What is to be typed in a shell: the lines of sh blocks, and the code in text that begins like a command."""
    lines = "\n".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL)).splitlines()
    inline = re.findall(r"`((?:diffsim-ti|python|torchrun|pip|ruff) [^`]+)`", without_blocks(text))
    parts = [part for line in lines + inline for part in re.split(r"&&|;", line.split(" #")[0])]
    return [part.strip() for part in parts if part.strip()]


def check(command: str) -> None:
    """That the program, the files of this repository and the options of a command exist; nothing is run."""
    words = list(dropwhile(lambda word: re.match(r"\w+=", word), shlex.split(command)))
    program, *words = Path(words[0]).name, *words[1:]
    if program == "diffsim-ti":
        name, *options = words
        click_command = typer.main.get_command(app).commands[name]
        context = click_command.context_class(click_command)
        click_command.make_parser(context).parse_args(list(options))
    elif program in ("python", "python3", "torchrun"):
        if words[:2] == ["-m", "pytest"]:
            known = ["-n", "--dist", "-k", "-m", "--minutes", "--thorough"]
            assert all((ROOT / word).exists() for word in words[2:] if word.startswith("tests"))
            assert all(word in known for word in words[2:] if word.startswith("-"))
        elif words[0] != "-m":
            script = next(k for k, word in enumerate(words) if word.endswith(".py"))
            path = ROOT / words[script]
            text = path.read_text()
            beside = [path.with_name(f"{name}.py") for name in re.findall(r"^from (\w+) import", text, re.MULTILINE)]
            text += "".join(other.read_text() for other in beside if other.exists())
            assert all(f'"{word}"' in text for word in words[script + 1 :] if word.startswith("-"))
    elif program == "git":
        assert words[0] == "clone"
    elif program == "pip":
        extras = (ROOT / "pyproject.toml").read_text().partition("[project.optional-dependencies]")[2]
        assert words[0] == "install" and all(f"\n{name} = [" in extras for name in re.findall(r"\[(\w+)\]", command))
    else:
        assert program == "ruff" and all((ROOT / word).exists() for word in words[1:])


@pytest.mark.parametrize("page", PAGES)
def test_commands_are_there(page):
    shown = commands(PAGES[page])
    assert len(shown) >= 3 or page in GUIDES or page == "examples/glossary.md"
    for command in shown:
        try:
            check(command)
        except Exception as error:
            raise AssertionError(f"{page}: {command}: {error}") from error


WRONG = """diffsim-ti chart --no-such-option 1
diffsim-ti nothing
python examples/benchmark.py
python examples/gallery.py --quick
python -m pytest tests/test_nothing.py
pip install '.[gpu]'
make all"""


@pytest.mark.parametrize("wrong", WRONG.splitlines())
def test_commands_that_are_not_there_are_found(wrong):
    with pytest.raises(Exception):  # noqa: B017
        check(wrong)


def anchors(page: Path) -> set[str]:
    """What a link can name behind #, of each heading."""
    titles = re.findall(r"^#+ (.+)$", without_blocks(page.read_text(encoding="utf-8")), re.M)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES)
def test_links_and_pictures_are_there(page):
    for target in re.findall(r"\]\(([^)]+)\)", PAGES[page]):
        if not target.startswith("https://"):
            path, _, part = target.partition("#")
            file = (ROOT / page).parent / path if path else ROOT / page
            assert file.exists(), target
            assert not part or part in anchors(file), target


def prose(text: str) -> list[str]:
    """The sentences of a page; a link or code counts as the words that are read."""
    lines = [line for line in without_blocks(text).splitlines() if not line.startswith(("|", "#", "!", "    "))]
    lines = [line for line in lines if " · " not in line]  # a list of links
    out = []
    for block in re.split(r"\n\s*\n|\n(?=- |\d+\. )", "\n".join(lines)):
        block = re.sub(r"`[^`]*`", "code", re.sub(r"\]\([^)]*\)", "]", block)).replace("\n", " ")
        out += re.split(r"(?<=[.!?:;])\s+", block.strip("- "))
    return out


@pytest.mark.parametrize("page", PAGES)
def test_sentences_are_short_and_no_line_stands_twice(page):
    long = [s for s in prose(PAGES[page]) if len(re.findall(r"[\w'’./-]+", s)) > 25 and " = " not in s]
    assert not long
    own = re.sub(r"<!-- (\w+) -->.*?<!-- end of \1 -->", "", PAGES[page], flags=re.DOTALL)  # without what scripts write
    lines = [x for x in without_blocks(own).splitlines() if len(x) > 60 and not x.startswith("|")]
    assert len(lines) == len(set(lines))


def test_every_picture_is_shown():
    shown = {Path(target).name for text in PAGES.values() for target in re.findall(r"\]\(([^)]+\.(?:png|gif))\)", text)}
    assert {path.name for path in (ROOT / "assets" / "pictures").iterdir()} == shown


def test_named_tests_exist():
    named = re.findall(r"`(test_\w+\.py)(?:::(\w+))?`", PAGES["tests/README.md"])
    assert len(named) > 100
    for file, name in named:
        assert f"def {name}" in (ROOT / "tests" / file).read_text(), (file, name)


def test_every_test_file_is_in_an_area():
    files = {path.stem.removeprefix("test_") for path in (ROOT / "tests").glob("test_*.py")}
    assert files == set(areas.AREA_OF), "name each test file once in tests/areas.py"
    blank = re.sub(r"[\d.]+ \|$", " |", PAGES["tests/README.md"], flags=re.M)
    assert areas.table({}) in blank, "run the suite with --minutes"


@pytest.mark.parametrize("page", ["diffsim_ti/README.md", "CONTRIBUTING.md"])
def test_pages_for_whoever_carries_it_on_name_what_is_there(page):
    text = (ROOT / page).read_text()
    assert len(text.splitlines()) <= 150
    for name in re.findall(r"`([\w/]+(?:/|\.py|\.md))`", text) + re.findall(r"\]\((?!https)([^)#]+)", text):
        places = ROOT, (ROOT / page).parent, ROOT / "diffsim_ti", ROOT / "tests", *(ROOT / "diffsim_ti").rglob("*/")
        assert any((place / name).exists() for place in places), name
