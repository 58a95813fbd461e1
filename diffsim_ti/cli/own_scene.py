"""Scenes that commands take: from a Python file, or a mesh under its own weight."""

import runpy
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from diffsim_ti.cli.options import fixed_vertices, load_body, make_material
from diffsim_ti.scene import Scene

Fixed = Annotated[list[str] | None, typer.Option(help="vertex set, or xmin .. zmax, to fix; may be repeated")]
Workers = Annotated[int, typer.Option(help="processes that share the work")]


def own_scene(
    path: Path, material: str, youngs_modulus: float, poissons_ratio: float, density: float, fixed: Sequence[str] | None
) -> Scene:
    """A scene from a Python file that defines `scene` or `scene()`, or from a mesh under its own weight."""
    from diffsim_ti.terms import Gravity

    if not path.exists():
        raise ValueError(f"{path}: no such file; give a mesh, or a Python file that defines scene()")
    if path.suffix == ".py":
        made = runpy.run_path(str(path)).get("scene")
        made = made() if callable(made) else made
        if not isinstance(made, Scene):
            raise ValueError(f"{path} must define `scene`, a diffsim_ti.Scene or a function that returns one")
        return made
    body = load_body(path)
    law = make_material(material, youngs_modulus, poissons_ratio)
    return Scene(body, law, density, Gravity(), fixed_vertices(body, fixed or []))
