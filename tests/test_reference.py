"""Every public name says what it is, with formula, units and source where they apply; examples in docstrings are run."""

import ast
import doctest
import importlib
import inspect
import re
import sys
from pathlib import Path

import pytest

import diffsim_ti as ds
from diffsim_ti.materials import Material
from diffsim_ti.outputs import Output
from diffsim_ti.solvers import Solver
from diffsim_ti.terms import Term

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "assets" / "reference"))

from make import GUIDES, MODULES, names_of, reference  # noqa: E402

# what an argument or a property of this name is measured in; its docstring must say so
UNITS = {
    "Pa": "pressure youngs_modulus stress shear_viscosity c10 k1 bulk_modulus",
    "N/m^2": "traction",
    "m": "width radius center start about height positions displacements rest_length length",
    "s": "dt time times lengths",
    "m/s": "friction_speed velocities",
    "m/s^2": "acceleration",
    "1/s^2": "eigenvalues",
    "Hz": "frequencies",
    "N": "forces tension",
    "N/m": "stiffness",
    "N/m^3": "stiffness_per_area normal tangential",
    "kg/m^3": "density",
    "m^3": "volumes",
    "rad": "rotation angle",
    "MB": "memory",
}
UNIT_OF = {name: unit for unit, names in UNITS.items() for name in names.split()}
# these words mean something else, without a unit or with that of something else, in these places
OTHERWISE = {
    *(
        "HalfSpace.normal",
        "SurfaceDrag.normal",
        "SurfaceDrag.tangential",
        "square.normal",
        "SectionForce.normal",
        "Spring.start",
        "Unknown.start",
        "smooth_step.width",
        "Identifiability.eigenvalues",
    )
}
SOURCE = re.compile(r"doi:|arXiv|\b1[6-9]\d\d\b|\b20\d\d\b|sec(tion|\.) \d|ch(apter|\.) \d")


def members(module) -> dict:
    """{name: what a reference page shows}"""
    return {name: getattr(module, name) for name in names_of(module)}


def public() -> dict:
    """{name: class or function} of all pages, each once."""
    found = {}
    for page in MODULES:
        for name, thing in members(importlib.import_module(page)).items():
            if (inspect.isclass(thing) or inspect.isfunction(thing)) and thing not in found.values():
                found[name if name not in found else f"{page}.{name}"] = thing
    return found


PUBLIC = public()


def parts(kind: type) -> dict:
    """{name: method or property} that a class or one of its bases writes, without underscore."""
    own = {}
    for base in reversed(kind.__mro__):
        if base.__module__.startswith("diffsim_ti"):
            own |= {name: x for name, x in vars(base).items() if not name.startswith("_")}
    kinds = (property, staticmethod, classmethod)
    return {name: x for name, x in own.items() if inspect.isfunction(x) or isinstance(x, kinds)}


def said(thing) -> str:
    """The docstring; of a class also those of its bases in the package, and of how it is made."""
    if not inspect.isclass(thing):
        return inspect.getdoc(thing) or ""
    bases = [base for base in thing.__mro__ if base.__module__.startswith("diffsim_ti")]
    return "\n".join(base.__doc__ or "" for base in bases)


def words(text: str) -> set:
    return set(re.findall(r"\w+", text))


def test_every_name_has_a_docstring():
    missing = [name for name, thing in PUBLIC.items() if not (thing.__doc__ or "").strip()]
    for name, kind in PUBLIC.items():
        if inspect.isclass(kind):
            told = words(vars(kind)["__doc__"] or "")  # a class may name its parts itself
            missing += [
                f"{name}.{part}" for part in parts(kind) if not inspect.getdoc(getattr(kind, part)) and part not in told
            ]
    assert not missing, f"{len(missing)}: {missing}"


def arguments(thing) -> list[str]:
    """Names of what one passes, without self and collections of the rest."""
    try:
        parameters = inspect.signature(thing).parameters.values()
    except (TypeError, ValueError):
        return []
    named = [x.name for x in parameters if x.kind not in (x.VAR_POSITIONAL, x.VAR_KEYWORD)]
    return [name for name in named if name not in ("self", "args", "kwargs")]


def test_every_argument_is_spoken_of():
    """Of what stands on the first page, by its name, in the docstring of what takes it."""
    plain = {"mesh", "scene", "rollout", "name", "seed"}  # their type says it all
    silent = {}
    for name in ds.__all__:
        if gone := {*arguments(PUBLIC[name])} - words(said(PUBLIC[name])) - plain:
            silent[name] = sorted(gone)
    assert not silent, "\n".join(f"{name}: {gone}" for name, gone in silent.items())


def unit_is_said(text: str, unit: str) -> bool:
    """In square brackets, alone or among other words: [m], [m, rad], "in [N/m^3]"."""
    return any(unit in re.split(r"[ ,;]+", bracket) for bracket in re.findall(r"\[([^\]]*)\]", text))


def test_every_physical_number_has_its_unit():
    gone = []
    for name, thing in PUBLIC.items():
        told = said(thing)
        for argument in arguments(thing):
            unit = UNIT_OF.get(argument)
            if unit and f"{name}.{argument}" not in OTHERWISE and not unit_is_said(told, unit):
                gone.append(f"{name}({argument}) [{unit}]")
        for part, x in parts(thing).items() if inspect.isclass(thing) else ():
            unit = UNIT_OF.get(part) if isinstance(x, property) else None
            if unit and not unit_is_said(f"{inspect.getdoc(x)} {told}", unit):
                gone.append(f"{name}.{part} [{unit}]")
    assert not gone, "\n".join(gone)


def test_physics_has_a_source():
    """What is a material, a term, an output or a solver, and every function whose docstring has an equation."""
    kinds = (Material, Term, Output, Solver)
    physics = [name for name, x in PUBLIC.items() if inspect.isclass(x) and issubclass(x, kinds) and x not in kinds]
    equation = re.compile(r"^ {4,}.* = .*[a-zA-Z)]", re.MULTILINE)  # set off from the text
    physics += [name for name, x in PUBLIC.items() if name not in physics and equation.search(inspect.getdoc(x) or "")]
    gone = [name for name in physics if not SOURCE.search(said(PUBLIC[name]))]
    assert len(physics) > 50 and not gone, gone


def test_what_pages_teach_is_in_the_reference():
    """Modules of the package that README.md and the guides import from, but the one that shows how to extend it."""
    pages = ROOT / "README.md", *(ROOT / "examples" / "guides").glob("*.md")
    texts = [page.read_text() for page in pages if page.stem != "extend"]
    blocks = [block for text in texts for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL)]
    taught = set()
    for block in blocks:
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("diffsim_ti"):
                taught.add(node.module)
    assert taught <= {*MODULES}, taught - {*MODULES}


def examples() -> dict:
    """{name: doctest} of all public names that have an example."""
    finder, found = doctest.DocTestFinder(exclude_empty=True, recurse=False), {}
    for name, thing in PUBLIC.items():
        for test in finder.find(thing, name, globs={}):
            if test.examples:
                found[name] = test
    return found


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", examples())
def test_example(name):
    said = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    assert runner.run(examples()[name], out=said.append).failed == 0, "".join(said)


def test_chief_entries_have_an_example():
    chief = (
        "TetrahedralMesh Scene Simulator Rollout Batch identify check_gradients modes stable_dt UnequalSteps".split()
    )
    chief += (
        "StableNeoHookean Gravity Traction Spring Ground VelocityVerletSolver ImplicitEulerSolver StaticSolver".split()
    )
    chief += "Reaction Stress MaterialPoints EnclosedVolume Cage DifferentiableMaterial DifferentiableSimulator".split()
    assert {*chief} <= {*examples()}, {*chief} - {*examples()}


def test_each_public_name_has_one_place_in_the_reference():
    """The site itself is built and opened by .ci/run."""
    names = [name for names in reference().values() for name in names]
    things = [getattr(importlib.import_module(name.rpartition(".")[0]), name.rpartition(".")[2]) for name in names]
    assert all(names for names in reference().values())
    assert all(sum(thing is other for other in things) == 1 for thing in [*PUBLIC.values(), *things])


def test_guides_have_an_order():
    assert {*GUIDES.split()} >= {path.stem for path in (ROOT / "examples/guides").glob("*.md")}


def test_docstrings_become_markdown():
    pytest.importorskip("griffe")
    from docstrings import legible

    given = "x: a `a<b`,\nor <name>.\ny: one.\n\n    E = a_i * b_i\n\n>>> f(1)\n2\n\nThe end."
    shown = "x: a `a<b`,\nor &lt;name>.  \ny: one.\n\n    E = a_i * b_i\n\n\n```pycon\n>>> f(1)\n2\n```\n\nThe end."
    assert legible(given) == shown
