"""Reference pages by pdoc: python assets/reference/make.py [FOLDER], default html beside it, which git ignores."""

import re
import sys
from pathlib import Path

from numpy.typing import ArrayLike

HERE = Path(__file__).parent
# what the pages are about: all names without an underscore, or those of __all__
MODULES = (
    "diffsim_ti",
    "diffsim_ti.diff_physics",
    "diffsim_ti.diff_simulator",
    "diffsim_ti.designs",
    "diffsim_ti.optimization",
    "diffsim_ti.optimization_picture",
    "diffsim_ti.verify",
    "diffsim_ti.picture",
    "diffsim_ti.film",
    "diffsim_ti.obstacles",
    "diffsim_ti.visualizer",
    "diffsim_ti.writers",
    "diffsim_ti.study",
    "diffsim_ti.materials",
    "diffsim_ti.terms",
    "diffsim_ti.solvers",
    "diffsim_ti.outputs",
)


def short(signature: str) -> str:
    """A signature in which NumPy's ArrayLike is called so, not by the list of its members."""
    members = str(ArrayLike).replace("typing.", "").removeprefix("Union[").removesuffix("]")
    plain = signature.replace("typing.", "").replace("collections.abc.", "").replace(members, "ArrayLike")
    return plain.replace("Union[ArrayLike]", "ArrayLike")


def literal(docstring: str) -> str:
    """A docstring whose "<name>" is no tag of HTML; code stays as it is."""
    parts = re.split(r"(`[^`\n]*`|^\s*>>>.*$)", docstring, flags=re.MULTILINE)
    return "".join(part if k % 2 else re.sub(r"<(?=\w)", "&lt;", part) for k, part in enumerate(parts))


def main(folder: str = str(HERE / "html")) -> None:
    import pdoc

    pdoc.doc._remove_collections_abc = short
    pdoc.docstrings.convert = lambda docstring, *_: literal(docstring)
    pdoc.render.configure(template_directory=HERE, show_source=False, footer_text="SI units throughout")
    pdoc.pdoc(*MODULES, output_directory=Path(folder))


if __name__ == "__main__":
    main(*sys.argv[1:])
