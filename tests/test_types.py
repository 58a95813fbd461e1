"""What users type: annotations, named options, answers to misspelt ones, help; tests/typed_client.py is run."""

import importlib
import inspect
import pydoc
import re
from pathlib import Path

import numpy as np
import pytest
import typed_client

import diffsim_ti as ds
from diffsim_ti.common.names import ELSEWHERE, edits, nearest
from diffsim_ti.common.public import Public, Readable
from diffsim_ti.rollout.rollout import RolloutOptions
from diffsim_ti.runtime.kernels import Kernel
from diffsim_ti.scene.scene import SceneArguments
from diffsim_ti.terms.obstacles.obstacle import Obstacle, ObstacleOptions
from diffsim_ti.visual.drawing import Drawing, Look

CALLED = ("TetrahedralMesh", "Simulator", "Frames", "Measurement", "Identification")
DOORS = "designs diff_physics diff_simulator film identification materials optimization optimization_picture outputs "
DOORS += "picture study terms verify visualizer writers"


def public() -> dict:
    """{name: class or function} of the package and of the modules that pages teach, those of Python's and torch's aside."""
    found = {name: getattr(ds, name) for name in ds.__all__}
    for door in DOORS.split():
        module = importlib.import_module(f"diffsim_ti.{door}")
        own = {name: x for name, x in vars(module).items() if getattr(x, "__module__", "") == module.__name__}
        names = getattr(module, "__all__", [name for name in own if not name.startswith("_")])
        found |= {f"{door}.{name}": getattr(module, name) for name in names if name not in found}
    return {name: x for name, x in found.items() if inspect.isclass(x) or inspect.isfunction(x)}


PUBLIC = public()
MESHES = "create_cube create_box joined from_file from_surface from_meshio from_pyvista"
# what users make and call by names; `init` hands on what Taichi takes, and answers itself
TAKES = {name: x for name, x in PUBLIC.items() if isinstance(x, Public) or hasattr(x, "__signature__")}
TAKES |= {f"TetrahedralMesh.{name}": getattr(ds.TetrahedralMesh, name) for name in MESHES.split()}
TAKES = {name: x for name, x in TAKES.items() if not (inspect.isclass(x) and issubclass(x, BaseException | tuple))}


def named(thing) -> list[inspect.Parameter]:
    """What may be given by name."""
    unnamed = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD, inspect.Parameter.POSITIONAL_ONLY
    return [p for p in inspect.signature(thing).parameters.values() if p.kind not in unnamed]


def functions_of(name: str, thing) -> dict:
    """{name: function} of a function, or of a class's constructor and of the methods that it and its bases here write."""
    if inspect.isfunction(thing):
        return {name: thing}
    own = {}
    for base in thing.__mro__:
        if base.__module__.startswith("diffsim_ti"):
            for part, value in vars(base).items():
                value = getattr(value, "__func__", value)
                if inspect.isfunction(value) and (part == "__init__" or not part.startswith("_")):
                    own.setdefault(f"{name}.{part}", value)
    return own


def gaps() -> list[str]:
    """Named parameters of public functions and constructors, and those of what everyone calls, without an annotation."""
    out = []
    for name in ds.__all__:
        thing = getattr(ds, name)
        functions = {name: thing} if inspect.isfunction(thing) else {}
        for own, value in vars(thing).items() if inspect.isclass(thing) else ():
            value = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
            called = name in CALLED and not own.startswith("_")
            if (called or own == "__init__") and inspect.isfunction(value):
                functions[f"{name}.{own}"] = value
        for label, function in functions.items():
            if getattr(function, "__module__", "").startswith("diffsim_ti"):
                signature = inspect.signature(function)
                for parameter in list(signature.parameters.values()):
                    named = parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
                    if named and parameter.name not in ("self", "cls") and parameter.annotation is parameter.empty:
                        out.append(f"{label}({parameter.name})")
                if signature.return_annotation is signature.empty and not label.endswith("__init__"):
                    out.append(f"{label} ->")
    return sorted(set(out))


def test_the_public_interface_is_annotated():
    bare = {name: [p.name for p in named(x) if p.annotation is p.empty] for name, x in PUBLIC.items()}
    assert gaps() == [] and not {name: names for name, names in bare.items() if names}


def test_what_users_name_stands_in_a_list_with_types():
    """Parameters, or a TypedDict; what takes names of inputs and outputs says what they are."""
    silent = []
    for name, thing in PUBLIC.items():
        for label, function in functions_of(name, thing).items():
            rest = [p for p in inspect.signature(function).parameters.values() if p.kind is p.VAR_KEYWORD]
            silent += [label for p in rest if p.annotation is p.empty]
    assert not silent, silent


def test_constructors_show_what_every_obstacle_takes():
    shown = {p.name: p for p in named(ds.Capsule)}
    assert list(shown)[:3] == ["start", "end", "radius"] and {"friction", "path", "stiffness_per_area"} <= shown.keys()
    assert shown["friction"].default == 0.0 and repr(shown["friction"].annotation) == "float"
    assert repr({p.name: p for p in named(ds.Scene)}["motion"].annotation).startswith(
        "Motion | Pose | Mapping[str, Motion"
    )


@pytest.mark.parametrize(
    "listed, constructor",
    [(SceneArguments, ds.Scene), (RolloutOptions, ds.Rollout), (ObstacleOptions, Obstacle), (Look, Drawing)],
)
def test_typed_lists_say_what_constructors_do(listed, constructor):
    taken = {p.name: repr(p.annotation) for p in named(constructor)}
    said = {name: repr(Readable(kind)) for name, kind in listed.__annotations__.items()}
    assert said == {name: taken[name] for name in said}


def slipped(word: str, rng: np.random.Generator) -> str:
    """The word with a letter left out, doubled, replaced or swapped with the next."""
    k, other = int(rng.integers(len(word) - 1)), chr(int(rng.integers(97, 123)))
    last = word[k + 1 :]
    return [
        word[:k] + last,
        word[: k + 1] + word[k:],
        word[:k] + other + last,
        word[:k] + last[0] + word[k] + last[1:],
    ][int(rng.integers(4))]


def answer(thing, wrong: str) -> str:
    with pytest.raises(TypeError) as raised:
        thing(**{wrong: None})
    return str(raised.value)


def test_misspelt_options_are_answered_with_the_right_ones(monkeypatch):
    """500 random slips, each in the name of what was called, and before anything is computed."""
    monkeypatch.setattr(Kernel, "bind", lambda *a, **more: pytest.fail("a kernel"))
    rng, known = np.random.default_rng(5), [(name, p.name) for name in TAKES for p in named(TAKES[name])]
    known = [(name, right) for name, right in known if len(right) > 3]
    assert len(known) > 400
    for k in rng.choice(len(known), 500):
        name, right = known[k]
        options = [p.name for p in named(TAKES[name])]
        wrong = slipped(right, rng)
        if wrong in options:
            continue
        said = answer(TAKES[name], wrong)
        found = re.search(r"no argument .*; did you mean '(\w+)'\?", said)
        assert said.startswith(f"{TAKES[name].__qualname__} has") and all(x in said for x in options), said
        assert found and (found[1] == right or edits(wrong, found[1]) <= edits(wrong, right)), said


def test_words_of_other_programs_are_answered():
    """Wherever what they mean is among the options, and they are not themselves."""
    count = 0
    for thing in TAKES.values():
        options = [p.name for p in named(thing)]
        for word, meant in ELSEWHERE.items():
            meant = [x for x in meant if x in options and word not in options]
            near = nearest(word, options) if meant else None
            count += bool(meant)
            assert not meant or near == meant[0] or edits(word, near) == 1, (thing, word, near)
    assert count > 100


def test_a_class_of_ones_own_answers_in_its_own_name():
    class Bowl(ds.Sphere):
        def __init__(self, depth: float = 0.1, **options):
            super().__init__(inside=True, **options)

    assert answer(Bowl, "frictoin").startswith(
        "Bowl has no argument 'frictoin'; did you mean 'friction'? It takes depth, "
    )
    assert Bowl(friction=0.2, radius=2.0).values["friction"] == 0.2
    with pytest.raises(TypeError, match=r"Gravity takes at most \d arguments without a name, got 9"):
        ds.Gravity(*range(9))


def test_solvers_answer_for_those_that_they_hand_options_to():
    from diffsim_ti.diff_simulator import DifferentiableSolver

    with pytest.raises(TypeError, match="DifferentiableSolver with BDF2Solver has no argument 'contact'"):
        DifferentiableSolver(method=ds.BDF2Solver, contact="force")
    scene = ds.Scene(ds.TetrahedralMesh.create_cube(2), ds.StableNeoHookean(1e5, 0.3))
    with pytest.raises(TypeError, match="a scene has its own density; give them to Scene"):
        ds.SemiImplicitSolver(scene, density=2.0)
    with pytest.raises(TypeError, match="Scene has no argument 'densty'; did you mean 'density'"):
        scene.replace(densty=1.0)


def test_help_fits_on_a_screen():
    classes = {name: x for name, x in PUBLIC.items() if inspect.isclass(x)}
    long = {name: len(pydoc.render_doc(x, renderer=pydoc.plaintext).splitlines()) for name, x in classes.items()}
    assert {name: lines for name, lines in long.items() if lines >= 80} == {}
    shown = pydoc.render_doc(ds.TetrahedralMesh, renderer=pydoc.plaintext)
    assert "TetrahedralMesh(vertices: ArrayLike, tetrahedra: ArrayLike, *, vertex_sets: dict | None = None" in shown
    assert "create_cube" in shown and "surface_vertices" in shown and "create_cube" in dir(ds.TetrahedralMesh)


def test_the_typed_client_runs(monkeypatch):
    monkeypatch.setattr(ds, "init", lambda precision, **_: ds.runtime.set_precision(precision))
    assert typed_client.fall() > 0
    assert typed_client.parts() > 50


def test_the_typed_client_uses_every_name():
    source = Path(typed_client.__file__).read_text()
    assert [name for name in ds.__all__ if not re.search(rf"\bds\.{name}\b", source)] == []
