"""What comes in and goes out: surfaces, Abaqus files, objects of meshio and PyVista, animated glTF."""

import builtins
import contextlib
import importlib.util
import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import diffsim_ti as ds
from diffsim_ti.cli import app
from diffsim_ti.mesh import filling
from diffsim_ti.writers import Frame, View, open_writer

BOX = ds.TetrahedralMesh.create_box((4, 3, 3), (0.3, 0.2, 0.2))
USD = importlib.util.find_spec("pxr") is not None
MESH = BOX.with_tetrahedron_set("core", BOX.centroids[:, 0] < 0.1)


def same(a, b) -> bool:
    sets = ("vertex_sets", "tetrahedron_sets", "surface_sets")
    equal = np.array_equal(a.vertices, b.vertices) and np.array_equal(a.elements, b.elements)
    return equal and all(
        getattr(a, s).keys() == getattr(b, s).keys()
        and all(np.array_equal(rows, getattr(b, s)[name]) for name, rows in getattr(a, s).items())
        for s in sets
    )


# ---- surfaces ---------------------------------------------------------------------------------------------------------


def saved_surface(path, mesh=MESH):
    import meshio

    meshio.Mesh(mesh.vertices, [("triangle", mesh.surface_triangles)]).write(path)
    return path


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply"])
def test_surfaces_are_filled(tmp_path, suffix):
    body = ds.TetrahedralMesh.from_file(saved_surface(tmp_path / f"body{suffix}"))
    assert body.volume == pytest.approx(MESH.volume, rel=1e-6) and body.quality.min() > 0.1  # stl and ply in float32
    found = {tuple(np.round(x, 6)) for x in body.vertices[body.surface_vertices]}
    assert found == {tuple(np.round(x, 6)) for x in MESH.vertices[MESH.surface_vertices]}  # all points, and no other


def test_size_and_parts():
    coarse = ds.TetrahedralMesh.from_surface(MESH.vertices, MESH.surface_triangles)
    fine = ds.TetrahedralMesh.from_surface(MESH.vertices, MESH.surface_triangles, size=0.03)
    assert fine.num_tetrahedra > 5 * coarse.num_tetrahedra and np.median(fine.volumes) < 0.03**3 / 72**0.5
    apart = MESH.translated((1, 0, 0))
    points = np.concatenate([MESH.vertices, apart.vertices])
    both = np.concatenate([MESH.surface_triangles, MESH.surface_triangles + MESH.num_vertices])
    assert ds.TetrahedralMesh.from_surface(points, both).volume == pytest.approx(2 * MESH.volume)


@pytest.mark.parametrize("turned", [False, True])
def test_parts_within_others_are_cavities(turned):
    X, surface, middle = MESH.vertices, MESH.surface_triangles, MESH.vertices.mean(0)
    points = np.concatenate([X, middle + 0.5 * (X - middle), middle + 0.25 * (X - middle), X + (1, 0, 0)])
    inner = surface[:, ::-1] if turned else surface
    parts = [surface, inner + len(X), surface + 2 * len(X), surface + 3 * len(X)]
    body = ds.TetrahedralMesh.from_surface(points, np.concatenate(parts))
    assert body.volume == pytest.approx((2 - 1 / 8 + 1 / 64) * MESH.volume, rel=1e-12)
    assert len(body.surface_triangles) == 4 * len(surface)


def test_surfaces_that_cannot_be_filled(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fill = ds.TetrahedralMesh.from_surface
    X, surface = MESH.vertices, MESH.surface_triangles
    crossing = np.concatenate([X, X + 0.05]), np.concatenate([surface, surface + len(X)])
    with monkeypatch.context() as gone:
        gone.setattr(filling.importlib.util, "find_spec", lambda name: None)
        with pytest.raises(ValueError, match=r"not closed: 3 of .* edges .*the first is at.*pip install .*dirty"):
            fill(X, surface[1:])
        with pytest.raises(ValueError, match="TetGen cannot fill .*self-intersections.* mend it"):
            fill(*crossing)
    assert not any(tmp_path.iterdir())  # TetGen leaves no files of its own
    with pytest.raises(ValueError, match="size must be a length above 0"):
        fill(X, surface, size=-1.0)
    with pytest.raises(ValueError, match=r"triangles must be indices of shape \(n, 3\)"):
        fill(X, surface[:, :2])
    with pytest.raises(ValueError, match="must name points from 0 to 35"):
        fill(X, surface + 30)
    with pytest.raises(ValueError, match="must be finite"):
        fill(np.where(X == X.max(), np.nan, X), surface)
    path = saved_surface(tmp_path / "body.stl")
    (tmp_path / "empty.stl").write_text("solid\nendsolid\n")
    with pytest.raises(ValueError, match=r"empty\.stl"):
        ds.TetrahedralMesh.from_file(tmp_path / "empty.stl")
    known = builtins.__import__

    def without(name, *arguments):
        if name == "tetgen":
            raise ImportError(name)
        return known(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ValueError, match=r"body\.stl: surfaces are filled by TetGen, .*pip install .*surfaces"):
        ds.TetrahedralMesh.from_file(path)


def test_a_surface_falls_from_the_shell(tmp_path, capsys):
    out = [str(tmp_path / "fall.glb"), str(tmp_path / "fall.npz")]
    path = saved_surface(tmp_path / "body.stl")
    with pytest.raises(SystemExit) as end:
        app.main(["simulate", str(path), "--duration", ".04", "--fps", "100", "-o", out[0], "-o", out[1]])
    assert end.value.code == 0, capsys.readouterr().err
    places, times = animated(tmp_path / "fall.glb")[0]
    arrays = np.load(out[1])
    assert places.shape[0] == len(times) == len(arrays["time"]) > 3


# ---- files and objects -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mesh", [MESH, MESH.quadratic()], ids=["linear", "ten nodes"])
def test_meshio_s_objects_and_back(mesh):
    assert same(ds.TetrahedralMesh.from_meshio(mesh.to_meshio()), mesh)


def test_abaqus_keeps_sets_of_vertices_and_tetrahedra(tmp_path):
    with pytest.warns(UserWarning, match="cannot keep the sets lid"):
        MESH.with_surface_set("lid", lambda x, n: n[:, 1] > 0.9).save(tmp_path / "body.inp")
    back = ds.TetrahedralMesh.from_file(tmp_path / "body.inp")
    assert np.array_equal(back.tetrahedra, MESH.tetrahedra) and back.tetrahedron_sets.keys() == {"core"}
    assert all(np.array_equal(back.vertex_sets[name], rows) for name, rows in MESH.vertex_sets.items())


def test_abaqus_files_of_others(tmp_path):
    """Sets by ranges, as CAE writes them."""
    corners = "\n".join(f"{k}, {x}, {y}, {z}" for k, (x, y, z) in enumerate(np.vstack([np.zeros(3), np.eye(3)]), 1))
    (tmp_path / "part.inp").write_text(
        f"*Heading\n** made by hand\n*Node\n{corners}\n*Element, type=C3D4, elset=ALL\n1, 1, 2, 3, 4\n"
        "*Nset, nset=BASE, generate\n1, 3, 1\n*Elset, elset=CORE\n1\n"
    )
    part = ds.TetrahedralMesh.from_file(tmp_path / "part.inp")
    assert part.vertex_sets["BASE"].tolist() == [0, 1, 2] and part.tetrahedron_sets["CORE"].tolist() == [0]


def grid_of(mesh):
    """What PyVista makes of meshio's mesh, as far as we look at it."""
    numbers = {"tetra": 10, "tetra10": 24, "triangle": 5, "triangle6": 22}
    kept = mesh.to_meshio()
    order = [*range(1, len(kept.cells)), 0]  # PyVista does not sort cells by kind
    kinds = np.concatenate([np.full(len(kept.cells[k].data), numbers[kept.cells[k].type]) for k in order])
    cells = {numbers[block.type]: block.data for block in kept.cells}
    cell_data = {name: np.concatenate([parts[k] for k in order]) for name, parts in kept.cell_data.items()}
    return SimpleNamespace(
        points=kept.points, cells_dict=cells, celltypes=kinds, point_data=kept.point_data, cell_data=cell_data
    )


@pytest.mark.parametrize("mesh", [MESH, MESH.quadratic()], ids=["linear", "ten nodes"])
def test_grids_of_pyvista(mesh):
    assert same(ds.TetrahedralMesh.from_pyvista(grid_of(mesh)), mesh)
    hexahedra = SimpleNamespace(cells_dict={99: np.arange(8)[None]})
    with pytest.raises(ValueError, match=r"types \[99\] cannot be read"):
        ds.TetrahedralMesh.from_pyvista(hexahedra)


def test_pyvista_itself():
    pytest.importorskip("pyvista")
    assert same(ds.TetrahedralMesh.from_pyvista(MESH.to_pyvista()), MESH)


# ---- glTF ------------------------------------------------------------------------------------------------------------


def animated(path) -> list[tuple[np.ndarray, np.ndarray]]:
    """(places in each frame, times) of each node, by the specification."""
    data = path.read_bytes()
    assert data[:4] == b"glTF" and int.from_bytes(data[4:8], "little") == 2
    assert int.from_bytes(data[8:12], "little") == len(data)
    size = int.from_bytes(data[12:16], "little")
    tree, numbers = json.loads(data[20 : 20 + size]), data[28 + size :]
    assert data[16:20] == b"JSON" and data[24 + size : 28 + size] == b"BIN\0"

    def read(k):
        one = tree["accessors"][k]
        view, columns = tree["bufferViews"][one["bufferView"]], {"SCALAR": 1, "VEC3": 3}[one["type"]]
        kind = {5126: "<f4", 5125: "<u4"}[one["componentType"]]
        out = np.frombuffer(numbers, kind, one["count"] * columns, view["byteOffset"])
        assert view["byteOffset"] % 4 == 0 and view["byteLength"] == out.nbytes
        out = out.reshape(one["count"], columns)
        if "min" in one:
            assert np.allclose(out.min(0), one["min"]) and np.allclose(out.max(0), one["max"])
        return out

    moves = {channel["target"]["node"]: channel["sampler"] for channel in tree["animations"][0]["channels"]}
    found = []
    for k, node in enumerate(tree["nodes"]):
        (shape,) = tree["meshes"][node["mesh"]]["primitives"]
        first, times = read(shape["attributes"]["POSITION"])[None], np.zeros(1)
        assert read(shape["indices"]).max() == first.shape[1] - 1
        if k in moves:
            sampler = tree["animations"][0]["samplers"][moves[k]]
            times, targets = read(sampler["input"])[:, 0], [read(t["POSITION"]) for t in shape["targets"]]
            weights = read(sampler["output"]).reshape(len(times), len(targets))
            first = first + np.einsum("ft,tni->fni", weights, np.stack(targets))
        turn = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1]))
        found.append((turn.apply(first.reshape(-1, 3)).reshape(first.shape), times))
    return found


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """(folder, places of the surface, times): a run beside a moving ball and a wall, gravity along -z, in each format."""
    folder = tmp_path_factory.mktemp("animated")
    ball = ds.Sphere((0.5, 0.1, 0.1), 0.08, stiffness=1.0, width=0.01, path=lambda t: [0, t, 0])
    wall = ds.Box((-0.5, 0.1, 0.1), (0.1, 0.1, 0.1), stiffness=1.0, width=0.01)
    terms = [ds.Gravity(up="z"), ball, wall]
    scene = ds.Scene(MESH, ds.StableNeoHookean(2e4, 0.3), terms=terms, fixed="xmin")
    simulator, places, times = ds.Simulator(ds.SemiImplicitSolver(scene, dt=0.02, substeps=20)), [], []
    names = ["run.glb", "run.ply", "run_%04d.ply", *(["run.usda", "run.usdc"] if USD else [])]
    with contextlib.ExitStack() as stack:
        view = View(colour="displacement", fps=25.0)
        out = [stack.enter_context(open_writer(folder / name, scene, view)) for name in names]
        for _ in range(4):
            for writer in out:
                writer.write(Frame.of(simulator))
            places.append(simulator.positions[MESH.surface_vertices])
            times.append(simulator.time)
            simulator.step()
    return folder, np.array(places), np.array(times)


def test_gltf_moves_as_the_run_does(written):
    folder, places, _ = written
    body, ball, wall = animated(folder / "run.glb")
    np.testing.assert_allclose(body[0], places[..., [0, 2, 1]] * [1, 1, -1], atol=1e-6)  # y is up in glTF
    np.testing.assert_allclose(body[1], [0, 0.02, 0.04, 0.06], atol=1e-7)
    np.testing.assert_allclose(np.ptp(ball[0], axis=0).max(0), [0, 0, 0.06], atol=1e-6)
    assert len(wall[0]) == 1  # what stands has no targets


@pytest.mark.skipif(not USD, reason="usd-core is not installed")
@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_usd_is_read_back_equal(written, suffix):
    from pxr import Usd, UsdGeom

    folder, places, times = written
    stage = Usd.Stage.Open(str(folder / f"run.{suffix}"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetDefaultPrim().GetPath() == "/run" and stage.GetTimeCodesPerSecond() == 25
    body, ball, wall = (UsdGeom.Mesh.Get(stage, f"/run/{name}") for name in ("body", "obstacle_1", "obstacle_2"))
    codes = body.GetPointsAttr().GetTimeSamples()
    np.testing.assert_allclose(np.array(codes) / stage.GetTimeCodesPerSecond(), times, atol=1e-12)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (codes[0], codes[-1])
    read = np.array([body.GetPointsAttr().Get(code) for code in codes])
    np.testing.assert_array_equal(read, places.astype(np.float32))
    corners = np.array(body.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    np.testing.assert_array_equal(MESH.surface_vertices[corners], MESH.surface_triangles)  # outwards, right-handed
    moved = np.array(ball.GetPointsAttr().Get(codes[-1])) - ball.GetPointsAttr().Get(codes[0])
    np.testing.assert_allclose(moved, np.broadcast_to([0, 0.06, 0], moved.shape), atol=1e-6)
    assert not wall.GetPointsAttr().GetTimeSamples()  # stands
    colours = np.array([body.GetDisplayColorPrimvar().Get(code) for code in codes])
    assert colours.shape == places.shape and np.ptp(colours[-1], axis=0).max() > 0.3
    low, high = body.GetExtentAttr().Get(codes[-1])
    np.testing.assert_allclose([low, high], [places[-1].min(0), places[-1].max(0)], atol=1e-6)


def test_sequences_of_ply_are_read_back_equal(written):
    import meshio

    folder, places, _ = written
    assert len(list(folder.glob("run_*.ply"))) == len(places)
    last, end = (meshio.read(folder / name).points for name in ("run_0003.ply", "run.ply"))
    np.testing.assert_array_equal(end, last)
    for k, x in enumerate(places):
        read = meshio.read(folder / f"run_{k:04d}.ply")
        np.testing.assert_array_equal(read.points[: len(x)], x)
        triangles = read.cells_dict["triangle"][: len(MESH.surface_triangles)]
        np.testing.assert_array_equal(MESH.surface_vertices[triangles], MESH.surface_triangles)
        assert all(read.point_data[name].dtype == np.uint8 for name in ("red", "green", "blue"))
