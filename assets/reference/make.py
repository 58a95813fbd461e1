"""The site, of guides, gallery, reference and pages for whoever carries it on, by mkdocs: needs pip install ".[docs]".

python assets/reference/make.py [FOLDER]           # default html beside it, which git ignores
python assets/reference/make.py --serve [FOLDER]   # also serves it, since the search needs a server
"""

import functools
import http.server
import importlib
import logging
import re
import shutil
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
# what the reference is about: all names without an underscore, or those of __all__
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
# page of the reference: where names of diffsim_ti come from, and modules whose other names it takes, too
REFERENCE = {
    "Start and meshes": ("runtime mesh", ""),
    "Materials": ("materials", "materials"),
    "Contact": ("terms.obstacles terms.self_contact terms.pose", "obstacles"),
    "Loads and supports": ("terms", "terms"),
    "Scenes and solvers": ("scene solvers state.schedule rollout.adaptive_steps", "solvers"),
    "Runs": ("rollout batch torch_bridge.ensemble outputs.output", ""),
    "Results": ("outputs accuracy", "outputs"),
    "Gradients": ("verify common.differences", "verify"),
    "Identification": ("identification", ""),
    "Design and optimisation": ("designs", "designs optimization optimization_picture"),
    "Torch": ("torch_bridge", "diff_simulator diff_physics"),
    "Pictures and films": ("visual", "picture film visualizer"),
    "Files of runs": ("writers", "writers"),
    "Charts and advice": ("study", "study"),
    "Errors and reports": ("", ""),  # of all other folders
}
# guides in the order in which they are read; others follow
GUIDES = "first_steps meshes materials which_material loads_and_supports limit_loads contact_and_friction "
GUIDES += "solvers_and_steps gradients identify design batches_and_cards results_and_pictures accuracy "
GUIDES += "force_and_touch robots extend units_and_limits coming_from_others"
BOOST = {"examples": 3, "README": 2, "tests": 0.5, "CHANGELOG": 0.3}  # how much of it the search counts; else 1
PAGES = {
    "Examples": ["examples/README.md", "examples/benchmarks/README.md"],
    "Glossary": ["examples/glossary.md"],
    "Inside": ["diffsim_ti/README.md", "CONTRIBUTING.md", "tests/README.md", "CHANGELOG.md"],
}
LINK = re.compile(r"(!?\[(?:[^\[\]]|\[[^\]]*\])*\]\()(?!https?:|#|mailto:)([^)#]+)")


def names_of(module) -> list[str]:
    """Those that a page of the reference shows of a module."""
    own = [n for n, x in vars(module).items() if getattr(x, "__module__", "") == module.__name__ and n[0] != "_"]
    return getattr(module, "__all__", own)


def reference() -> dict[str, list[str]]:
    """{title: dotted names}, each public name once."""
    out, seen = {title: [] for title in REFERENCE}, []
    package, *others = map(importlib.import_module, MODULES)
    for name in package.__all__:
        thing = getattr(package, name)
        seen.append(thing)
        place = thing.__module__.partition(".")[2]
        titles = (t for t, (folders, _) in REFERENCE.items() if place.startswith(tuple(folders.split())))
        out[next(titles, "Errors and reports")].append(f"diffsim_ti.{name}")
    for module in others:
        short = module.__name__.partition(".")[2]
        title = next(t for t, (_, modules) in REFERENCE.items() if short in modules.split())
        for name in names_of(module):
            if not any(getattr(module, name) is thing for thing in seen):
                seen.append(getattr(module, name))
                out[title].append(f"{module.__name__}.{name}")
    return out


def file_of(title: str) -> str:
    return f"reference/{title.lower().replace(' ', '_')}.md"


def thing_of(name: str):
    module, _, last = name.rpartition(".")
    return getattr(importlib.import_module(module), last)


def entry(name: str, public: list) -> str:
    """What mkdocstrings is asked for; a class also shows what it inherits from classes that have no entry themselves."""
    bases = [base for base in getattr(thing_of(name), "__mro__", ())[1:] if base not in public]
    inherited = sorted({x for b in bases if b.__module__.startswith("diffsim_ti") for x in vars(b) if x[0] != "_"})
    return f"::: {name}\n" + (f"    options: {{inherited_members: {inherited}}}\n" if inherited else "") + "\n"


def write_reference(folder: Path) -> list[dict]:
    """Its pages; what mkdocs calls a nav."""
    listed = ["# Reference\n\nEvery public name, from its docstring. Units are SI.\n"]
    pages = reference()
    public = [thing_of(name) for names in pages.values() for name in names]
    for title, names in pages.items():
        page = folder / file_of(title)
        page.parent.mkdir(exist_ok=True)
        page.write_text(f"# {title}\n\n" + "".join(entry(name, public) for name in names), encoding="utf-8")
        links = ", ".join(f"[`{name.rpartition('.')[2]}`][{name}]" for name in names)
        listed.append(f"\n**[{title}]({page.name})**: {links}\n")
    (folder / "reference/index.md").write_text("".join(listed), encoding="utf-8")
    return ["reference/index.md", *({title: file_of(title)} for title in REFERENCE)]


def copy_page(name: str, folder: Path) -> str:
    """A page with the pictures and scripts that it links; a script becomes a page of its own. Its title."""
    text = (ROOT / name).read_text(encoding="utf-8")
    for target in {found[2] for found in LINK.finditer(text)}:
        source = ((ROOT / name).parent / target).resolve()
        if source.suffix == ".md" or not source.is_file():
            continue  # mkdocs says of pages whether they are there
        copied = folder / source.relative_to(ROOT)
        copied.parent.mkdir(parents=True, exist_ok=True)
        if source.suffix == ".py":
            code = source.read_text(encoding="utf-8")
            page = f"---\nsearch: {{exclude: true}}\n---\n# {source.name}\n\n````python\n{code}````\n"
            copied.with_suffix(".md").write_text(page, encoding="utf-8")
            text = text.replace(f"]({target}", f"]({target.removesuffix('.py')}.md")
        else:
            shutil.copy(source, copied)
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    boost = next((number for start, number in BOOST.items() if name.startswith(start)), 1)
    (folder / name).write_text(f"---\nsearch: {{boost: {boost}}}\n---\n{text}", encoding="utf-8")
    return re.search(r"^# (.+)$", text, re.MULTILINE)[1]


def guides() -> list[str]:
    """Files of the guides, in the order of reading."""
    order, found = GUIDES.split(), [path.stem for path in (ROOT / "examples/guides").glob("*.md")]
    found.sort(key=lambda stem: (order.index(stem) if stem in order else len(order), stem))
    return [f"examples/guides/{stem}.md" for stem in found]


def main(folder: str = str(HERE / "html")) -> None:
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    with tempfile.TemporaryDirectory() as name:
        pages = Path(name)
        copy_page("README.md", pages)
        shutil.copy(HERE / "site.css", pages)
        nav = [{"Home": "README.md"}]
        for section, files in {"Guides": guides(), **PAGES}.items():
            files = [file for file in files if (ROOT / file).exists()]
            titles = [{copy_page(file, pages): file} for file in files]
            if section == "Guides":  # by their names: the questions are long
                titles = [{Path(file).stem.replace("_", " ").capitalize(): file} for file in files]
            nav.append({section: titles if len(titles) > 1 else files[0]})
        nav.insert(-2, {"Reference": write_reference(pages)})
        build(load_config(str(HERE / "mkdocs.yml"), docs_dir=name, site_dir=str(Path(folder).resolve()), nav=nav))


def serve(folder: str) -> None:
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=folder)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 8000), handler) as server:
        print("http://127.0.0.1:8000, until an interrupt (Ctrl-C)")
        server.serve_forever()


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if word != "--serve"]
    main(*words)
    if "--serve" in sys.argv:
        serve(*words or [str(HERE / "html")])
