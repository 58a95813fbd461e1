"""Five of the guides as notebooks: python examples/notebooks.py [FOLDER], default output/notebooks. Needs nbformat.

A block of Python becomes a cell of code, what stands between two of them a cell of text.
"""

import os
import re
import sys
from pathlib import Path

import nbformat

GUIDES = Path(__file__).resolve().parent / "guides"
NOTEBOOKS = ("first_steps", "contact_and_friction", "gradients", "identify", "design")


def notebook(guide: Path, folder: Path) -> nbformat.NotebookNode:
    """Its links lead from `folder` to where they led from the guide."""

    def moved(link: re.Match) -> str:
        return link[1] + Path(os.path.relpath(guide.parent / link[2], folder)).as_posix()

    new, cells = nbformat.v4, []
    parts = re.split(r"^```python\n(.*?)^```\n", guide.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for k, part in enumerate(parts):
        text = part if k % 2 else re.sub(r"(\]\()(?!https?:|#)([^)#]+)", moved, part)
        if text.strip():
            cells.append((new.new_code_cell if k % 2 else new.new_markdown_cell)(text.strip()))
    for k, cell in enumerate(cells):
        cell.id = f"cell-{k}"  # the same each time
    return new.new_notebook(cells=cells, metadata={"kernelspec": {"name": "python3", "display_name": "Python 3"}})


def main(folder: str = "output/notebooks") -> list[Path]:
    out = Path(folder).resolve()
    out.mkdir(parents=True, exist_ok=True)
    written = [out / f"{name}.ipynb" for name in NOTEBOOKS]
    for path in written:
        nbformat.write(notebook(GUIDES / f"{path.stem}.md", out), path)
    return written


if __name__ == "__main__":
    print("\n".join(map(str, main(*sys.argv[1:]))))
