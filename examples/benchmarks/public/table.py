"""What the scripts of this folder share: options, environments of peers, and tables of examples/benchmarks/README.md.

A script is run as `python examples/benchmarks/public/NAME.py [--quick] [--peers FOLDER]`. Its table stands on that page
between <!-- NAME --> and <!-- end of NAME -->, with versions, processor and day; --quick prints it alone.
"""

import argparse
import json
import os
import platform
import resource
import sys
import textwrap
from datetime import date
from importlib import metadata
from pathlib import Path

import diffsim_ti as ds

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
PAGE = HERE.parent / "README.md"

sys.path.insert(0, str(HERE.parent))
from peers import work  # noqa: E402


def parser(description: str, peers: bool = True) -> argparse.ArgumentParser:
    """With --quick and, if there are peers, --peers."""
    out = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    out.add_argument("--quick", action="store_true", help="small sizes, under a minute; the page stays as it is")
    if peers:
        out.add_argument("--peers", help="a folder that holds or gets the environments of other programs", type=Path)
    return out


def environment(folder: Path, name: str, *pins: str) -> tuple[str, str]:
    """(interpreter, "") of folder/name, where `pip install pins` has been done; ("", reason) if that fails."""
    home = folder.resolve() / name
    python, done = home / "bin" / "python", home / "installed.txt"
    if not done.exists() or done.read_text() != "\n".join(pins):
        install = [python, "-m", "pip", "install", "-q", "--disable-pip-version-check", *pins]
        for command in ([sys.executable, "-m", "venv", home], install):
            _, why = work.ran(command, 1500)
            if why:
                return "", why
        done.write_text("\n".join(pins))
    return str(python), ""


def asked(python: str, script: Path, *arguments, timeout: float = 1500) -> dict:
    """The last line that a script prints, read as JSON, from a process of its own; {"error": reason} if it fails."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    printed, why = work.ran([python, script, *arguments], timeout, PYTHONPATH=path)
    last = (printed.strip().splitlines() or [""])[-1]
    if why:
        return {"error": why}
    try:
        return json.loads(last)
    except json.JSONDecodeError:
        return {"error": f"its last line is not JSON: {last[:80]!r}" if last else "it printed nothing"}


def peak_memory() -> float:
    """The largest resident set of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def number(x) -> str:
    """Three digits; text as it is, and "" for None."""
    if x is None or isinstance(x, str):
        return x or ""
    return f"{x:.3g}" if isinstance(x, float) and abs(x) < 1000 else f"{x:.0f}"


def ratio(theirs, ours) -> str:
    """Theirs, and in brackets relative to ours: above one we are ahead."""
    return number(theirs) if isinstance(theirs, str) or theirs is None else f"{number(theirs)} ({theirs / ours:.2g}x)"


def markdown(head, rows) -> str:
    shown = [[number(cell) for cell in row] for row in rows]
    sides = ["---" if not k else "---:" for k in range(len(head))]
    return "\n".join("| " + " | ".join(line) + " |" for line in [list(head), sides, *shown])


def circumstances(**peers: str) -> str:
    """Versions, processor and day."""
    versions = (
        dict(diffsim_ti=ds.__version__, taichi=metadata.version("taichi"), numpy=metadata.version("numpy")) | peers
    )
    cpu = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    named = ", ".join(f"{name} {version}" for name, version in versions.items())
    return f"{date.today():%d %B %Y}, {os.cpu_count()} cores of {cpu}, {platform.system()}; {named}."


def put(name: str, text: str, page: Path | None = None) -> None:
    """Text between the marks of a name on the page."""
    page = PAGE if page is None else page
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    before, found, rest = page.read_text().partition(begin)
    _, ends, after = rest.partition(end)
    if not (found and ends):
        raise ValueError(f"{page} has no {begin} ... {end}: add both lines where the table shall stand")
    page.write_text(f"{before}{begin}\n{text.strip()}\n{end}{after}")


def report(name: str, head, rows, quick: bool, notes: str = "", **peers: str) -> None:
    """Print a table with what it was measured on, and put it on the page unless it was a quick or a partial run."""
    said = textwrap.fill(
        f"{notes} {circumstances(**peers)}".strip(), 120, break_long_words=False, break_on_hyphens=False
    )
    text = f"{markdown(head, rows)}\n\n{said}"
    print(text, flush=True)
    if not quick:
        put(name, text)
