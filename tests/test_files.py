"""Mesh files as people have them: every format, what is lost is said, dirty surfaces, what `check` finds, damaged files."""

import re
import warnings
from pathlib import Path

import fuzz_files
import mesh_files
import mesh_variants
import numpy as np
import pytest
from mesh_files import BAR, TAGS, P, T
from mesh_variants import VARIANTS

import diffsim_ti as ds
from diffsim_ti.cli import app
from diffsim_ti.mesh import filling
from diffsim_ti.mesh.doctor import findings, mended
from diffsim_ti.mesh.files import read_mesh

read = ds.TetrahedralMesh.from_file
SOFT, STIFF = np.arange(6), np.arange(6, 12)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return mesh_files.written(tmp_path_factory.mktemp("files"))


def silent(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read(path, **options)


# ---- formats -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*mesh_files.SOLID, "tetgen"])
def test_every_format_keeps_both_materials(files, name):
    mesh = silent(files[name])
    assert np.allclose(mesh.vertices, P, atol=1e-4 if name == "nastran" else 1e-12)
    assert np.array_equal(mesh.tetrahedra, T)
    soft, stiff = mesh.tetrahedron_sets.values()
    assert np.array_equal(soft, SOFT) and np.array_equal(stiff, STIFF)
    if name in ("gmsh22", "gmsh41"):
        assert list(mesh.tetrahedron_sets) == ["soft", "stiff"] and len(mesh.surface_sets["clamp"]) == 2
    if name == "medit":
        assert mesh.vertex_sets["RequiredVertices"].tolist() == [0, 1] and len(mesh.surface_sets["tag_3"]) == 2


@pytest.mark.parametrize("one", VARIANTS, ids=lambda one: f"{one.format} {one.name}")
def test_every_cell_of_the_guides_table(one, tmp_path):
    """Volume, sets and straight edges are those of the body that another program has written, or it is said why not."""
    path = one.write(tmp_path)
    if one.outcome == mesh_variants.REFUSED:
        with pytest.raises((ValueError, ImportError), match=one.words):
            read(path)
        return
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        mesh = read(path)
    assert bool(said) == (one.outcome == mesh_variants.SAID), said
    assert re.search(one.words, " ".join(str(warning.message) for warning in said))
    assert mesh.volume == pytest.approx(one.volume, rel=one.within) and len(mesh.tetrahedron_sets) >= one.num_sets
    if mesh.order == 2:  # Nastran's numbers have eight characters
        x = mesh.vertices[mesh.elements]
        middles = (x[:, [0, 1, 2, 0, 1, 2]] + x[:, [1, 2, 0, 3, 3, 3]]) / 2
        np.testing.assert_allclose(x[:, 4:], middles, atol=1e-6)


def test_the_guide_shows_that_table():
    page = Path(__file__).parents[1] / "examples" / "guides" / "meshes.md"
    assert mesh_variants.page() in page.read_text(), "print the table by python tests/mesh_variants.py"


def test_what_gmsh_writes(tmp_path):
    """Groups are kept, or it is said that the file does not give them their elements."""
    found = {}
    mesh_variants.of_gmsh("order3")(tmp_path)
    for name, path in mesh_variants.KNOWN.items():
        if name in ("order3", "hexahedra"):
            continue
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            mesh = read(path)
        assert mesh.volume == pytest.approx(2, rel=1e-6), name
        assert mesh.order == (1 if "order1" in name or "partitioned" in name else 2), name
        text = " ".join(str(warning.message) for warning in said)
        has_sets = len(mesh.tetrahedron_sets) >= 2 and len(mesh.surface_sets) >= 1
        if re.search(r"_(1\.0|2\.2)_.1", name):  # SaveAll of old formats writes no groups
            assert not has_sets and ("clamp, soft, stiff" in text and "Mesh.SaveAll" in text) == ("2.2" in name), name
        else:
            assert has_sets and (not said or path.suffix == ".mesh"), (name, text)
            found[name] = mesh.tetrahedron_sets
    assert len(found) > 20 and {"soft", "stiff"} <= set(found["export.med"]) | set(found["partitioned_4.1"])


def test_numbers_of_cells_by_any_name(tmp_path):
    meshio = pytest.importorskip("meshio")

    def sets(**data):
        path = tmp_path / "grid.vtu"
        meshio.write(path, meshio.Mesh(P, [("tetra", T)], cell_data={name: [v] for name, v in data.items()}))
        return {name: len(rows) for name, rows in read(path).tetrahedron_sets.items()}

    assert sets(region=TAGS) == sets(MaterialIds=TAGS.astype(float)) == {"tag_7": 6, "tag_9": 6}
    assert sets(material=np.repeat([0, 1], 6)) == {"tag_0": 6, "tag_1": 6}
    assert sets(a=TAGS, b=np.tile([1, 2], 6)) == {"tag_7": 6, "tag_9": 6, "b_1": 6, "b_2": 6}
    assert sets(cell_ids=TAGS) == sets(number=np.arange(12)) == sets(stress=np.linspace(0, 1, 12)) == {}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("suffix", ["msh", "inp"])
def test_numbers_and_order_of_nodes_do_not_matter(tmp_path, suffix, seed):
    """Nodes are listed in any order, with any numbers."""
    rng = np.random.default_rng(seed)
    number, listed = rng.choice(10**6, len(P), replace=False) + 1, rng.permutation(len(P))
    between = ", " if suffix == "inp" else " "
    nodes = "".join(between.join(map(str, [number[k], *P[k].tolist()])) + "\n" for k in listed)
    first = dict(msh="4 2 7 7 ", inp="")[suffix]
    cells = "".join(f"{k}{between}{first}" + between.join(map(str, number[t])) + "\n" for k, t in enumerate(T, 5))
    heads = dict(
        msh=f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n{len(P)}\n{nodes}$EndNodes\n"
        f"$Elements\n{len(T)}\n{cells}$EndElements\n",
        inp=f"*NODE\n{nodes}*ELEMENT, TYPE=C3D4\n{cells}",
    )
    path = tmp_path / f"any.{suffix}"
    path.write_text(heads[suffix])
    mesh = silent(path)
    np.testing.assert_array_equal(mesh.vertices[mesh.tetrahedra], P[T])


# ---- Abaqus ------------------------------------------------------------------------------------------------------------


def deck(tmp_path, text: str, **options):
    path = tmp_path / "deck.inp"
    path.write_text(text)
    return read(path, **options)


NODES = "*NODE\n" + mesh_files.numbered(P.tolist(), 1, ", ")
ELEMENTS = mesh_files.numbered((T + 1).tolist(), 1, ", ")


def test_instances_are_placed_and_turned(tmp_path):
    part = f"*Part, name=Bar\n{NODES}*Element, type=C3D4\n{ELEMENTS}*Nset, nset=End\n 1, 2, 3, 4\n*End Part\n"
    mesh = deck(
        tmp_path,
        f"{part}*Assembly, name=A\n*Instance, name=One, part=Bar\n0.5, 0, 0\n*End Instance\n*Instance, name=Two, part=Bar\n"
        "1., 0., 0.\n1., 0., 0., 1., 0., 1., 90.\n*End Instance\n*Nset, nset=Clamp, instance=Two\n1, 3\n*Nset, nset=Both\n"
        "One.End, Two.End\n*End Assembly\n",
    )
    one, two = mesh.tetrahedron_sets["One"], mesh.tetrahedron_sets["Two"]
    places = mesh.vertices[12:]
    assert np.allclose(mesh.vertices[:12], P + [0.5, 0, 0])
    assert np.allclose(places, np.stack([1 - P[:, 1], P[:, 0], P[:, 2]], 1), atol=1e-12)  # a quarter turn about z
    assert len(one) == len(two) == 12 and mesh.num_pieces == 2
    assert mesh.vertex_sets["Clamp"].tolist() == [12, 14]
    assert np.array_equal(mesh.vertex_sets["Both"], mesh.vertex_sets["End"])
    assert mesh.vertex_sets["Two.End"].tolist() == [12, 13, 14, 15]


@pytest.mark.parametrize(
    "text, sets",
    [
        (f"{NODES}*ELEMENT, TYPE=C3D4\n{ELEMENTS}*NSET, NSET=A, GENERATE\n1, 7, 3\n", {"A": [0, 3, 6]}),
        (
            f"{NODES}*ELEMENT, TYPE=C3D4\n{ELEMENTS}*NSET, NSET=A\n1\n*NSET, NSET=A\n2\n*NSET, NSET=B\nA, 5\n",
            {"B": [0, 1, 4]},
        ),
        (f"{NODES}*element, type=c3d4h, elset=All\n{ELEMENTS}*nset, elset=ALL, nset=n\n", {"n": list(range(12))}),
        (f"{NODES.replace('*NODE', '*Node, nset=All')}*ELEMENT,\nTYPE=C3D4\n{ELEMENTS}", {"All": list(range(12))}),
    ],
)
def test_sets_of_decks(tmp_path, text, sets):
    mesh = deck(tmp_path, text)
    assert {name: mesh.vertex_sets[name].tolist() for name in sets} == sets


def test_surfaces_of_decks(tmp_path):
    inside = f"{NODES}*ELEMENT, TYPE=C3D4, ELSET=ALL\n{ELEMENTS}*SURFACE, NAME=SKIN\nALL\n*SURFACE, NAME=ONE\n1, S1\n"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mesh = deck(tmp_path, inside)
    assert len(mesh.surface_sets["SKIN"]) == len(mesh.surface_triangles)
    assert set(mesh.vertex_sets["ONE"]) == set(T[0, :3])


@pytest.mark.parametrize(
    "text, message",
    [
        (f"{NODES}*ELEMENT, TYPE=C3D8\n1, 1, 2, 3, 4, 5, 6, 7, 8\n", "C3D8 are no tetrahedra"),
        (f"{NODES}*NGEN\n1, 5\n*ELEMENT, TYPE=C3D4\n{ELEMENTS}", r"\*NGEN makes nodes"),
        (f"{NODES}1, 0.5, 0, 0\n*ELEMENT, TYPE=C3D4\n{ELEMENTS}", "node 1 is listed twice"),
        (f"{NODES}*ELEMENT, TYPE=C3D4\n{ELEMENTS}*NSET, NSET=A\n99\n", "'A' names node 99"),
        (f"{NODES}*ELEMENT, TYPE=C3D4\n{ELEMENTS}*NSET, NSET=A\nB\n", "node set 'B', which is not there"),
        (f"{NODES}*ELEMENT, TYPE=C3D4\n{ELEMENTS}*NSET, NSET=A\nA\n", "names itself"),
        (f"*Part, name=Bar\n{NODES}*Element, type=C3D4\n{ELEMENTS}*End Part\n", "have no instance"),
        (f"*INCLUDE, INPUT=../secret.inp\n{NODES}", "outside of the folder of"),
    ],
)
def test_decks_that_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        deck(tmp_path, text)


def test_what_a_deck_loses_is_said(tmp_path):
    skin = "*ELEMENT, TYPE=S4R, ELSET=SHELL\n900, 1, 2, 4, 3\n*MATERIAL, NAME=RUBBER\n*ELASTIC\n1e5, 0.3\n*NSET, NSET=NONE\n"
    with pytest.warns(UserWarning, match=r"S4R \(1\).*\*MATERIAL, \*ELASTIC") as said:
        deck(tmp_path, f"{NODES}*ELEMENT, TYPE=C3D4\n{ELEMENTS}{skin}")
    assert "NONE, which is empty" in str(said[0].message) and said[0].filename == __file__


# ---- pieces of VTK's files ---------------------------------------------------------------------------------------------


def test_pieces_of_vtu_and_pvtu(tmp_path):
    far = P + [0.5, 0, 0]
    both = mesh_files.piece(P, T, TAGS), mesh_files.piece(far, T, TAGS)
    (tmp_path / "both.vtu").write_text(mesh_files.vtu(*both))
    for k, piece in enumerate(both):
        (tmp_path / f"p_{k}.vtu").write_text(mesh_files.vtu(piece))
    named = '<VTKFile type="PUnstructuredGrid"><PUnstructuredGrid>{}</PUnstructuredGrid></VTKFile>'
    sources = "".join(f'<Piece Source="p_{k}.vtu"/>' for k in range(2))
    (tmp_path / "all.pvtu").write_text(named.format(sources))
    for name in ("both.vtu", "all.pvtu"):
        mesh = silent(tmp_path / name)
        assert mesh.volume == pytest.approx(2 * BAR.volume) and len(mesh.tetrahedron_sets["tag_9"]) == 12
    (tmp_path / "out.pvtu").write_text(named.format('<Piece Source="../p_0.vtu"/>'))
    with pytest.raises(ValueError, match="no .vtu file within its folder"):
        read(tmp_path / "out.pvtu")


# ---- surfaces ----------------------------------------------------------------------------------------------------------


def test_parts_of_surfaces_keep_their_names(tmp_path):
    faces = BAR.surface_triangles + 1
    text = "".join(
        f"o {name}\n"
        + mesh_files.rows((P + [x, 0, 0]).tolist(), "v ")
        + mesh_files.rows((faces + first).tolist(), "f ")
        for name, x, first in (("left", 0.0, 0), ("right", 0.5, 12))
    )
    path = tmp_path / "two.obj"
    path.write_text(text)
    mesh = silent(path)
    left, right = (mesh.tetrahedron_sets[name] for name in ("left", "right"))
    assert len(left) + len(right) == mesh.num_tetrahedra and mesh.volumes[left].sum() == pytest.approx(BAR.volume)
    assert mesh.vertices[mesh.vertex_sets["right"], 0].min() == pytest.approx(0.5)
    assert len(mesh.surface_sets["left"]) == len(faces)
    finer = silent(path, cells=20)
    assert finer.num_tetrahedra > 20 * mesh.num_tetrahedra and finer.volume == pytest.approx(2 * BAR.volume)
    assert finer.volumes[finer.tetrahedron_sets["right"]].sum() == pytest.approx(BAR.volume)
    edges = finer.vertices[finer.edges]
    assert np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).max() < 2 * 0.7 / 20
    with pytest.raises(ValueError, match="size and cells exclude each other"):
        read(path, size=0.1, cells=3)


def test_what_no_program_fills_is_refused(monkeypatch):
    pytest.importorskip("pytetwild")
    monkeypatch.setattr(filling, "FTETWILD", "raise SystemExit(3)")
    with pytest.raises(ValueError, match="fTetWild cannot fill it"):
        ds.TetrahedralMesh.from_surface(P, BAR.surface_triangles[1:])


# ---- what `check` finds ------------------------------------------------------------------------------------------------


def beside(gap=0.0, resolution=3):
    """Two boxes that touch, or nearly."""
    a = ds.TetrahedralMesh.create_box(3, 0.1)
    b = ds.TetrahedralMesh.create_box(resolution, 0.1, origin=(0.1 + gap, 0, 0))
    return np.vstack([a.vertices, b.vertices]), np.vstack([a.tetrahedra, b.tetrahedra + a.num_vertices])


def test_nodes_that_coincide_are_said_and_merged():
    with pytest.warns(UserWarning, match=r"9 vertices coincide .*2 pieces.*merged\(\)") as said:
        mesh = ds.TetrahedralMesh(*beside())
    assert said[0].filename == __file__ and "9 vertices coincide" in str(mesh.check())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one = mesh.merged()
        ds.TetrahedralMesh(*beside(1e-3))
        ds.TetrahedralMesh.joined(
            [ds.TetrahedralMesh.create_box(2), ds.TetrahedralMesh.create_box(2, origin=(1, 0, 0))]
        )
    assert (
        one.num_pieces == 1 and one.num_vertices == mesh.num_vertices - 9 and one.volume == pytest.approx(mesh.volume)
    )
    assert not any("coincide" in str(finding) for finding in one.check())


@pytest.mark.parametrize("second, at", [([0, 5, 4, 6], "[0]"), ([0, 1, 4, 5], "[0, 1]")])
def test_hinges_are_said_when_a_mesh_is_made(second, at):
    """Of two tetrahedra with a vertex, or an edge, in common; once, and not again of bodies that are put together."""
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1], [-1, 0, 0]][
        : 4 + len(set(second) - {0, 1})
    ]
    with pytest.warns(UserWarning, match="1 hinge: .*such parts turn freely .*common faces") as said:
        mesh = ds.TetrahedralMesh(vertices, [[0, 1, 2, 3], second], fix_orientation=True)
    assert [str(w.message) for w in said if "hinge" in str(w.message)] == [str(mesh.check()[-1])]
    assert f"by an edge or a vertex alone, at vertices {at};" in str(said[0].message) and said[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ds.TetrahedralMesh.joined([mesh, mesh.translated([3, 0, 0])])


def test_findings_name_what_is_wrong():
    clean = ds.TetrahedralMesh.create_box(3, 0.1)
    assert not clean.check() and str(clean.check()) == "nothing to mend"
    vertices, tetrahedra = beside(0.0, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        parts = ds.TetrahedralMesh(vertices, tetrahedra)
        far = ds.TetrahedralMesh.create_box(3, 0.1).translated([1e5, 0, 0])
        thin = ds.TetrahedralMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1e-3]], [[0, 1, 2, 3]])
    assert re.search(r"12 vertices lie on faces of another piece|\d+ vertices lie on faces", str(parts.check()))
    assert "float32 resolves" in str(far.check()) and "1 sliver" in str(thin.check())
    assert "looks like millimetres" in str(ds.TetrahedralMesh.create_box(3, 80.0).check())
    doubtful = (
        clean.with_tetrahedron_set("a", [0, 1])
        .with_tetrahedron_set("b", [1, 2])
        .with_vertex_set("none", np.zeros(0, int))
    )
    text = str(doubtful.check())
    assert (
        "1 tetrahedron is in several" in text
        and "45 tetrahedra are in no" in text
        and "empty: vertex set 'none'" in text
    )


def test_the_command_checks_and_mends(tmp_path, capsys):
    turned = T.copy()
    turned[3] = turned[3][[0, 2, 1, 3]]
    path, out = tmp_path / "turned.mesh", tmp_path / "out.vtu"
    text = mesh_files.medit().replace(" ".join(map(str, T[3] + 1)), " ".join(map(str, turned[3] + 1)))
    path.write_text(text)
    with pytest.raises(ValueError, match="inside-out"):
        read(path)
    with pytest.raises(SystemExit) as end:
        app.main(["check", str(path), "--mend", str(out)])
    said = capsys.readouterr().out
    assert end.value.code == 1 and "1 tetrahedron inside-out" in said and "explicit steps of about" in said
    assert silent(out).volume == pytest.approx(BAR.volume)
    found, _ = read_mesh(path)
    assert not findings(mended(found))
    path.write_text(re.sub(r"0\.10*1?\b", "nan", text, count=1))
    with pytest.raises(SystemExit):
        app.main(["check", str(path)])
    assert "1 vertex has coordinates that are not finite" in capsys.readouterr().out


def test_sets_that_are_empty_are_refused_where_they_are_used():
    mesh = BAR.with_vertex_set("nobody", np.zeros(0, int))
    for fixed in ("nobody", ["nobody"], {"nobody": "x"}, np.zeros(0, int), np.zeros(12, bool)):
        with pytest.raises(ValueError, match="(is empty|holds nothing).*xmin"):
            ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), fixed=fixed)
    ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), fixed=[])


# ---- damaged files -----------------------------------------------------------------------------------------------------


def test_damaged_files_are_read_or_refused():
    solid = [".msh", ".inp", ".mesh", ".vtk", ".vtu", ".bdf", ".ele"]
    counts, wrong = fuzz_files.run(400, 1, solid, verbose=False)
    assert not wrong, "\n".join(wrong)
    assert counts["refused"] > 200 and counts["read"] > 20
