"""The command that says what may be wrong with a mesh file: `diffsim-ti check`."""

import warnings
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from diffsim_ti.cli import options as opt
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.doctor import findings, mended, step_in_words
from diffsim_ti.mesh.files import read_mesh


def check(
    mesh: opt.MeshFile,
    mend: Annotated[Path | None, Option(help="write the mesh there without what can be mended in one way only")] = None,
) -> None:
    """Say what may be wrong with a mesh file, with a remedy for each; exit code 1 if there is anything."""
    parts, left_out = read_mesh(mesh)
    found = findings(parts)
    for text in left_out:
        print(f"- left out: {text}")
    print(found)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            vertices, elements, vertex_sets, tetrahedron_sets, triangles = mended(parts)
            sets = dict(vertex_sets=vertex_sets, tetrahedron_sets=tetrahedron_sets, surface_sets=triangles)
            body = TetrahedralMesh(vertices, elements, **sets)
            print(f"- {step_in_words(body)}")
        except ValueError as error:
            if mend:
                raise
            print(f"- it cannot be used as it is: {error}")
        if mend:
            body.save(mend)
            print(f"written: {mend}, with {sum(finding.mended for finding in found)} of {len(found)} findings mended")
    if found or left_out:
        raise typer.Exit(1)
