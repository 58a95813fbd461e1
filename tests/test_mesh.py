"""TetrahedralMesh: what it builds, what it refuses and how, and what survives a file."""

import copy
import pickle
import re
import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.checks import surface_of

ASSETS = Path(__file__).parents[1] / "assets" / "tetmesh"
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
REGULAR = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
TET = np.array([[0, 1, 2, 3]])
UNITS = pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3], ids=["mm", "m", "km"])
PATTERN = pytest.mark.parametrize("pattern", ["kuhn", "five"])


def sliver(quality: float) -> np.ndarray:
    """Four vertices near a square of side 1, at a height that gives the quality."""
    low, high = 0.0, 1.0
    for _ in range(100):
        h = (low + high) / 2
        x = np.array([[0, 0, 0], [1, 0, h], [1, 1, 0], [0, 1, h]], float)
        V = abs(np.linalg.det(x[1:] - x[0])) / 6
        squares = sum(((x[a] - x[b]) ** 2).sum() for a in range(4) for b in range(a))
        low, high = (h, high) if 12 * (3 * V) ** (2 / 3) / squares < quality else (low, h)
    return x


def face_counts(mesh) -> np.ndarray:
    faces = np.sort(np.concatenate([np.delete(mesh.tetrahedra, a, 1) for a in range(4)]), 1)
    return np.unique(faces, axis=0, return_counts=True)[1]


# Boxes


@PATTERN
@pytest.mark.parametrize("resolution", [2, 3, 5, 8])
@pytest.mark.parametrize("size", [1.0, 0.1, 1 / 3, 7e-3])
def test_cube_is_filled_exactly(resolution, size, pattern):
    mesh = TetrahedralMesh.create_cube(resolution, size, pattern)
    cells = (resolution - 1) ** 3
    assert mesh.num_vertices == resolution**3
    assert mesh.num_tetrahedra == mesh.num_elements == cells * {"kuhn": 6, "five": 5}[pattern]
    assert np.all(mesh.volumes > 0)
    edges = mesh.vertices[mesh.tetrahedra[:, 1:]] - mesh.vertices[mesh.tetrahedra[:, :1]]
    assert np.all(np.linalg.det(edges) > 0)
    assert mesh.volume == pytest.approx(size**3, rel=1e-15, abs=0)
    assert np.array_equal(mesh.bounding_box, [[0, 0, 0], [size] * 3])


@PATTERN
@pytest.mark.parametrize("resolution", [2, 4, (2, 3, 5), (5, 4, 2)])
def test_box_is_conforming(resolution, pattern):
    mesh = TetrahedralMesh.create_box(resolution, pattern=pattern)
    counts = face_counts(mesh)
    nx, ny, nz = np.broadcast_to(resolution, 3) - 1
    assert set(counts) <= {1, 2}
    assert (counts == 1).sum() == len(mesh.surface_triangles) == 4 * (nx * ny + ny * nz + nz * nx)
    assert mesh.num_pieces == 1


def test_box_numbering_sides_size_and_origin():
    mesh = TetrahedralMesh.create_box((3, 4, 5), (0.2, 0.3, 0.4), origin=(1, 2, 3))
    i, j, k = 1, 2, 3
    assert mesh.vertices[(i * 4 + j) * 5 + k] == pytest.approx([1.1, 2.2, 3.3])
    assert mesh.volume == pytest.approx(0.024, rel=1e-14)
    for axis, name in enumerate("xyz"):
        for end, at in (("min", 0), ("max", 1)):
            expected = np.nonzero(mesh.vertices[:, axis] == mesh.bounding_box[at, axis])[0]
            assert np.array_equal(mesh.vertex_sets[name + end], expected)


def test_seed_spellings():
    mesh = TetrahedralMesh.create_cube(resolution=3, size=0.5, device="cpu")
    assert mesh._compute_rest_state() is None
    assert (mesh.num_vertices, mesh.num_tetrahedra) == (27, 48)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"resolution": 1}, r"resolution counts vertices a side.* got 1"),
        ({"resolution": 2.5}, r"resolution .* got 2\.5"),
        ({"resolution": (2, 2, 0)}, r"resolution .* got \(2, 2, 0\)"),
        ({"size": -1.0}, r"size must be positive and finite .* got -1\.0"),
        ({"size": (1.0, np.nan, 1.0)}, r"size must be finite"),
        ({"pattern": "six"}, r"pattern must be one of kuhn, five; got 'six'"),
    ],
)
def test_box_arguments_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        TetrahedralMesh.create_box(**arguments)


# Geometry


@UNITS
def test_shape_gradients_reproduce_linear_functions(unit):
    mesh = random_mesh(unit)
    gradients = mesh.shape_gradients
    assert np.abs(gradients.sum(1)).max() <= 1e-12 / unit
    A = np.random.default_rng(1).normal(size=(3, 3))
    u = mesh.vertices @ A.T
    H = np.einsum("eai,eaj->eij", u[mesh.tetrahedra], gradients)
    assert np.abs(H - A).max() < 1e-11


def random_mesh(unit=1.0) -> TetrahedralMesh:
    box = TetrahedralMesh.create_box((3, 4, 3), 1.0)
    moved = box.vertices + 0.05 * np.random.default_rng(0).uniform(-1, 1, box.vertices.shape)
    return TetrahedralMesh(unit * moved, box.tetrahedra, vertex_sets=box.vertex_sets)


def test_regular_tetrahedron_measures():
    mesh = TetrahedralMesh(REGULAR, TET, fix_orientation=True)
    edge = np.sqrt(8)
    assert mesh.quality[0] == pytest.approx(1, rel=1e-14)
    assert mesh.volume == pytest.approx(edge**3 / (6 * np.sqrt(2)), rel=1e-14)
    assert mesh.altitudes[0] == pytest.approx(np.full(4, edge * np.sqrt(2 / 3)), rel=1e-14)
    assert mesh.centroids[0] == pytest.approx([0, 0, 0])
    assert len(mesh.edges) == 6


@PATTERN
def test_surface_is_closed_and_points_outwards(pattern):
    mesh = TetrahedralMesh.create_box((3, 4, 2), (1, 2, 3), pattern)
    a, b, c = (mesh.vertices[mesh.surface_triangles[:, k]] for k in range(3))
    area = np.cross(b - a, c - a) / 2
    assert np.abs(area.sum(0)).max() < 1e-13
    assert np.einsum("ij,ij->", a, area) / 3 == pytest.approx(6, rel=1e-13)  # divergence theorem
    assert np.linalg.norm(area, axis=1).sum() == pytest.approx(22, rel=1e-13)
    on_side = np.unique(np.concatenate(list(mesh.vertex_sets.values())))
    assert np.array_equal(mesh.surface_vertices, on_side)


def test_surface_is_the_same_where_indices_no_longer_fit_one_key():
    mesh = TetrahedralMesh.create_cube(4, pattern="five")
    assert np.array_equal(surface_of(mesh.tetrahedra, 5_000_000), mesh.surface_triangles)


def test_edges_are_unique_and_satisfy_euler():
    mesh = TetrahedralMesh.create_cube(4)
    faces = (4 * mesh.num_tetrahedra + len(mesh.surface_triangles)) // 2
    assert np.all(mesh.edges[:, 0] < mesh.edges[:, 1])
    assert mesh.num_vertices - len(mesh.edges) + faces - mesh.num_tetrahedra == 1


@UNITS
def test_nothing_depends_on_the_unit(unit):
    one, mesh = random_mesh(1.0), random_mesh(unit)
    assert mesh.quality == pytest.approx(one.quality, rel=1e-12)
    assert mesh.volumes / unit**3 == pytest.approx(one.volumes, rel=1e-12)
    assert np.array_equal(mesh.surface_triangles, one.surface_triangles)
    with pytest.warns(UserWarning, match="quality below 0.1"):
        TetrahedralMesh(unit * sliver(1e-4), TET, fix_orientation=True)
    with pytest.raises(ValueError, match="is flat"):
        TetrahedralMesh(unit * (CORNERS * [1, 1, 1e-13] + [0.3, 0.2, 0.1]), TET)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        TetrahedralMesh(unit * CORNERS, TET)


def test_flatness_far_from_the_origin_allows_for_rounding():
    flat = np.array([[0.1, 0.2, 0.3], [0.7, 0.1, 0.9], [0.3, 0.9, 0.2], [0, 0, 0]])
    flat[3] = flat[0] + 0.3 * (flat[1] - flat[0]) + 0.4 * (flat[2] - flat[0])
    with pytest.raises(ValueError, match="is flat"):
        TetrahedralMesh(flat + 1e4, TET, fix_orientation=True)
    assert TetrahedralMesh(CORNERS + 1e4, TET).volume == pytest.approx(1 / 6, rel=1e-10)


# Refusals: rule, value, remedy


@pytest.mark.parametrize(
    "tetrahedra, message",
    [
        ([[0, 1, 2, 4]], r"indices must lie in 0\.\.3: tetrahedron 0 has 4 in \[0, 1, 2, 4\] .* count from 0"),
        ([[0, 1, 2, 3], [0, 1, 2, -1]], r"tetrahedron 1 has -1 in"),
        (np.array([[0.0, 1.0, 2.0, 3.0]]), r"must be integers, got dtype float64; convert with \.astype"),
        (np.array([[0, 1, 2, 3]]) > 1, r"must be integers, got dtype bool"),
        ([[0, 1, 2]], r"shape \(num_tetrahedra, 4\), or .* got \(1, 3\)"),
        ([0, 1, 2, 3], r"shape \(num_tetrahedra, 4\), or .* got \(4,\)"),
        ([list(range(10))], r"indices must lie in 0\.\.3: tetrahedron 0 has 4 in"),
        ([[*range(4), *[0] * 6]], r"ten different vertices: tetrahedron 0 is \[0, 1, 2, 3, 0"),
        ([], r"at least one tetrahedron, got an array of shape \(0,\)"),
        (np.zeros((0, 4), int), r"at least one tetrahedron, got an array of shape \(0, 4\)"),
        ([[0, 1, 2, 3], [0, 1, 1, 3]], r"four different vertices: tetrahedron 1 is \[0, 1, 1, 3\] .*remove"),
        ([[0, 1, 2, 3], [1, 2, 0, 3]], r"tetrahedra must differ: 0 and 1 .* \[0, 1, 2, 3\]; remove one"),
    ],
)
def test_bad_tetrahedra_refused(tetrahedra, message):
    with pytest.raises(ValueError, match=message):
        TetrahedralMesh(CORNERS, tetrahedra)


@pytest.mark.parametrize(
    "vertices, message",
    [
        (np.zeros((0, 3)), r"shape \(num_vertices, 3\) .* got \(0, 3\)"),
        (CORNERS[:, :2], r"shape \(num_vertices, 3\) .* got \(4, 2\)"),
        (CORNERS.ravel(), r"got \(12,\)"),
        (CORNERS + [[0, 0, 0], [0, 0, 0], [0, np.nan, 0], [0, 0, 0]], r"finite: vertex 2 is at .*nan.*\(1 such"),
        (CORNERS + [[0, 0, 0], [np.inf, 0, 0], [0, 0, 0], [0, 0, 0]], r"finite: vertex 1 is at .*inf"),
        (CORNERS * [1, 1, 0], r"tetrahedron 0 is flat: volume 0 m\^3, longest edge 1\.41 m, .*remesh"),
    ],
)
def test_bad_vertices_refused(vertices, message):
    with pytest.raises(ValueError, match=message):
        TetrahedralMesh(vertices, TET)


def test_inside_out_refused_with_count_and_worst():
    cube = TetrahedralMesh.create_cube(3)
    one = cube.tetrahedra.copy()
    one[17] = one[17][[0, 2, 1, 3]]
    expected = r"^tetrahedron 17 is inside-out \(volume -0\.0208 m\^3\); pass fix_orientation=True or swap two"
    with pytest.raises(ValueError, match=expected):
        TetrahedralMesh(cube.vertices, one)
    with pytest.raises(ValueError, match=r"48 of 48 tetrahedra are inside-out, worst is tetrahedron \d+ \(volume -"):
        TetrahedralMesh(cube.vertices, cube.tetrahedra[:, [0, 1, 3, 2]])
    some = TetrahedralMesh.create_box((4, 2, 2)).vertices * [1, 1, 1]
    some[some[:, 0] > 0.5] *= [2, 1, 1]
    stretched = TetrahedralMesh.create_box((4, 2, 2)).tetrahedra[:, [0, 1, 3, 2]]
    worst = np.argmax(TetrahedralMesh(some, stretched, fix_orientation=True).volumes)
    with pytest.raises(ValueError, match=rf"worst is tetrahedron {worst} "):
        TetrahedralMesh(some, stretched)


def test_fix_orientation_turns_all_and_changes_nothing_else():
    cube = TetrahedralMesh.create_cube(4, pattern="five")
    swapped = cube.tetrahedra.copy()
    swapped[::3] = swapped[::3][:, [1, 0, 2, 3]]
    mesh = TetrahedralMesh(cube.vertices, swapped, fix_orientation=True)
    assert mesh.volume == pytest.approx(1, rel=1e-15)
    edges = mesh.vertices[mesh.tetrahedra[:, 1:]] - mesh.vertices[mesh.tetrahedra[:, :1]]
    assert np.all(np.linalg.det(edges) > 0)
    assert np.array_equal(np.sort(mesh.tetrahedra), np.sort(cube.tetrahedra))
    assert {tuple(sorted(f)) for f in mesh.surface_triangles} == {tuple(sorted(f)) for f in cube.surface_triangles}


def test_face_of_three_tetrahedra_refused():
    vertices = np.concatenate([CORNERS, [[0.0, 0, -1], [1, 1, 2]]])
    with pytest.raises(ValueError, match=r"at most two tetrahedra: \[0, 1, 2\] belongs to tetrahedra \[0, 1, 2\]"):
        TetrahedralMesh(vertices, [[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]], fix_orientation=True)


def test_overlapping_neighbours_refused():
    vertices = np.concatenate([CORNERS, [[0.2, 0.2, 2]]])
    with pytest.raises(ValueError, match=r"two sides of their common face: tetrahedra 0 and 1 overlap"):
        TetrahedralMesh(vertices, [[0, 1, 2, 3], [0, 1, 2, 4]])


@pytest.mark.parametrize("quality", [0.09, 1e-2, 1e-3, 1e-4])
def test_sliver_is_accepted_with_one_warning(quality):
    with pytest.warns(UserWarning) as caught:
        mesh = TetrahedralMesh(sliver(quality), TET, fix_orientation=True)
    assert len(caught) == 1
    assert re.search(rf"1 sliver .* worst {quality:.3g} in tetrahedron 0 .*altitude", str(caught[0].message))
    assert mesh.quality[0] == pytest.approx(quality, rel=1e-6)


def test_slivers_are_counted_and_the_worst_named():
    parts = [sliver(0.05), REGULAR, sliver(1e-3), sliver(0.02)]
    vertices = np.concatenate([x + [10 * k, 0, 0] for k, x in enumerate(parts)])
    with pytest.warns(UserWarning, match=r"^3 slivers \(quality below 0\.1\), worst 0\.001 in tetrahedron 2 "):
        mesh = TetrahedralMesh(vertices, np.arange(16).reshape(4, 4), fix_orientation=True)
    assert mesh.num_pieces == 4


def test_orphan_vertices_warn_with_count_and_first():
    with pytest.warns(UserWarning, match=r"2 vertices in no tetrahedron, first 4: .*drop_orphans=True"):
        mesh = TetrahedralMesh(np.concatenate([CORNERS, [[5.0, 5, 5], [6, 6, 6]]]), TET)
    assert mesh.num_pieces == 1 and "6 vertices (2 unused)" in mesh.describe()
    assert np.array_equal(mesh.surface_vertices, [0, 1, 2, 3])


# Sets and choosing


def test_sets_are_sorted_and_can_be_chosen_in_four_ways():
    mesh = TetrahedralMesh.create_cube(3).with_vertex_set("some", [5, 3, 3])
    assert np.array_equal(mesh.vertex_sets["some"], [3, 5])
    assert np.array_equal(mesh.vertex_indices("xmin"), np.arange(9))
    assert np.array_equal(mesh.vertex_indices(["xmin", "xmax"]), np.r_[0:9, 18:27])
    assert np.array_equal(mesh.vertex_indices(np.arange(27) < 3), [0, 1, 2])
    assert np.array_equal(mesh.vertex_indices((4, 2)), [2, 4])
    assert len(mesh.vertex_indices([])) == 0
    assert np.array_equal(mesh.vertices_where(lambda x: x[:, 0] < 0.1), mesh.vertex_sets["xmin"])
    core = mesh.with_tetrahedron_set("core", mesh.centroids[:, 2] < 0.5)
    assert np.array_equal(core.tetrahedron_indices("core"), np.nonzero(mesh.centroids[:, 2] < 0.5)[0])
    assert "core" not in mesh.tetrahedron_sets and "xmin" in core.vertex_sets


@pytest.mark.parametrize(
    "chosen, message",
    [
        ("left", r"no vertex set is called 'left'; there are: xmin, xmax, ymin"),
        (["xmin", "left"], r"no vertex set is called 'left'"),
        ([27], r"indices must lie in 0\.\.26, got 27"),
        ([-1], r"indices must lie in 0\.\.26, got -1"),
        ([0.5], r"indices must be integers, got dtype float64"),
        (np.ones(5, bool), r"mask must have shape \(27,\), got \(5,\)"),
    ],
)
def test_bad_choices_refused(chosen, message):
    with pytest.raises(ValueError, match=message):
        TetrahedralMesh.create_cube(3).vertex_indices(chosen)


def test_bad_sets_refused():
    with pytest.raises(ValueError, match=r"vertex set 'tip': indices must lie in 0\.\.3, got 4"):
        TetrahedralMesh(CORNERS, TET, vertex_sets={"tip": [4]})
    with pytest.raises(ValueError, match=r"a tetrahedron set needs a name .* got ''"):
        TetrahedralMesh(CORNERS, TET, tetrahedron_sets={"": [0]})
    with pytest.raises(ValueError, match="predicate must return 4 Booleans"):
        TetrahedralMesh(CORNERS, TET).vertices_where(lambda x: x[:, 0])


# Immutability, copies, moves


def test_arrays_are_read_only_copies():
    given = CORNERS.copy()
    mesh = TetrahedralMesh(given, TET, vertex_sets={"a": [0]})
    given[0] = 9
    assert np.array_equal(mesh.vertices, CORNERS)
    for again in (mesh, pickle.loads(pickle.dumps(mesh)), copy.deepcopy(mesh), mesh.translated([1, 0, 0])):
        arrays = [again.vertices, again.tetrahedra, again.volumes, again.surface_triangles, again.surface_vertices]
        arrays += [again.shape_gradients, again.quality, again.altitudes, again.centroids, again.vertex_sets["a"]]
        assert not any(array.flags.writeable for array in arrays)
    with pytest.raises(AttributeError):
        mesh.vertices = CORNERS
    with pytest.raises(TypeError):
        mesh.vertex_sets["b"] = [0]


def test_moves_keep_connectivity_and_sets():
    mesh = random_mesh()
    mesh.quality, mesh.shape_gradients  # noqa: B018  (cached values must not leak into the moved mesh)
    moved = mesh.translated((1, 2, 3)).rotated((0, 0, 1), np.pi / 2).scaled(2.0)
    x, y, z = (mesh.vertices + [1, 2, 3]).T
    assert moved.vertices == pytest.approx(2 * np.stack([-y, x, z], 1))
    assert moved.volume == pytest.approx(8 * mesh.volume) and moved.volumes == pytest.approx(8 * mesh.volumes)
    assert moved.shape_gradients == pytest.approx(TetrahedralMesh(moved.vertices, moved.tetrahedra).shape_gradients)
    assert np.array_equal(moved.tetrahedra, mesh.tetrahedra)
    assert dict(moved.vertex_sets).keys() == dict(mesh.vertex_sets).keys()


def test_rotation_by_matrix_about_a_center_and_stretch():
    mesh = TetrahedralMesh.create_cube(2)
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = mesh.rotated(R, center=(1, 0, 0))
    assert turned.bounding_box == pytest.approx(np.array([[0.0, -1, 0], [1, 0, 1]]))
    assert mesh.scaled((1, 2, 3), center=(1, 1, 1)).bounding_box == pytest.approx(np.array([[0.0, -1, -2], [1, 1, 1]]))


@pytest.mark.parametrize(
    "move, message",
    [
        (lambda m: m.scaled(-1), r"factors must be positive, got -1; a mirrored body would be inside-out"),
        (lambda m: m.scaled((1, 0, 1)), r"factors must be positive"),
        (lambda m: m.scaled(np.nan), r"factor must be one or three finite numbers"),
        (lambda m: m.translated(1.0), r"offset must be three finite numbers, got 1\.0"),
        (lambda m: m.rotated(np.diag([1, 1, -1])), r"det \+1"),
        (lambda m: m.rotated(2 * np.eye(3)), r"a rotation is a matrix"),
        (lambda m: m.rotated((0, 0, 0), 1.0), r"axis of positive length"),
        (lambda m: m.translated((1e17, 0, 0)), r"is flat"),
    ],
)
def test_bad_moves_refused(move, message):
    with pytest.raises(ValueError, match=message):
        move(TetrahedralMesh.create_cube(2))


def test_stretching_into_slivers_warns():
    with pytest.warns(UserWarning, match="sliver"):
        TetrahedralMesh.create_cube(2).scaled((1, 1, 1e-3))


# Describing


def test_description_reads_well():
    mesh = TetrahedralMesh.create_box((3, 2, 2), (0.2, 0.1, 0.1))
    text = mesh.describe()
    for part in ("12 vertices, 12 tetrahedra, 1 piece", "0.2 x 0.1 x 0.1 m", "volume: 0.002 m^3", "xmin (4)", "worst"):
        assert part in text
    assert repr(mesh) == "TetrahedralMesh(12 vertices, 12 tetrahedra, 0.2 x 0.1 x 0.1 m)"


def test_content_hash_follows_content():
    mesh = TetrahedralMesh.create_cube(3)
    assert mesh.content_hash == TetrahedralMesh.create_cube(3).with_vertex_set("a", [0]).content_hash
    assert mesh.content_hash != mesh.scaled(1 + 1e-15).content_hash
    assert len({mesh.content_hash, TetrahedralMesh.create_cube(3, pattern="five").content_hash}) == 2
    assert re.fullmatch("[0-9a-f]{64}", mesh.content_hash)


# Files


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk", ".mesh", ".inp", ".xdmf"])
def test_round_trip(tmp_path, suffix):
    mesh = random_mesh()
    bare = TetrahedralMesh(mesh.vertices, mesh.tetrahedra)
    if suffix == ".xdmf":
        pytest.importorskip("h5py")
    bare.save(tmp_path / f"a{suffix}")
    again = TetrahedralMesh.from_file(tmp_path / f"a{suffix}")
    assert again.content_hash == bare.content_hash
    assert not again.vertex_sets and not again.tetrahedron_sets


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk"])
def test_round_trip_keeps_sets_that_overlap(tmp_path, suffix):
    mesh = random_mesh()
    x = mesh.centroids
    for name, chosen in (("left", x[:, 0] < 0.6), ("low", x[:, 1] < 0.5), ("core", x[:, 2] > 0.5)):
        mesh = mesh.with_tetrahedron_set(name, chosen)
    mesh.save(tmp_path / f"a{suffix}")
    again = TetrahedralMesh.load_from_msh(tmp_path / f"a{suffix}", device="cpu")
    assert again.content_hash == mesh.content_hash
    for sets, expected in ((again.vertex_sets, mesh.vertex_sets), (again.tetrahedron_sets, mesh.tetrahedron_sets)):
        assert list(sets) == list(expected) or suffix == ".msh" and set(sets) == set(expected)
        assert all(np.array_equal(sets[name], expected[name]) for name in expected)


def test_formats_that_lose_sets_say_so(tmp_path):
    with pytest.warns(UserWarning, match=r"cannot keep the sets xmin, .*these formats can: \.msh, \.vtu, \.vtk"):
        TetrahedralMesh.create_cube(2).save(tmp_path / "a.mesh")
    with pytest.raises(ValueError, match=r"cannot save .*a\.xyz.*use one of \.msh"):
        TetrahedralMesh(CORNERS, TET).save(tmp_path / "a.xyz")
    clash = TetrahedralMesh(CORNERS, TET, vertex_sets={"a": [0]}, tetrahedron_sets={"a": [0]})
    with pytest.raises(ValueError, match=r"'a' names a vertex set and a tetrahedron set; rename one"):
        clash.save(tmp_path / "a.msh")


def write(path, cells, points=CORNERS, **more):
    file_format = more.pop("file_format", None)
    meshio.Mesh(np.asarray(points, float), cells, **more).write(path, file_format=file_format)
    return path


@pytest.mark.parametrize("file_format", ["gmsh22", "gmsh"])
def test_physical_groups_become_sets(tmp_path, file_format):
    cube = TetrahedralMesh.create_cube(2)
    tets, triangles = cube.tetrahedra, cube.surface_triangles
    on_floor = np.isin(triangles, cube.vertex_sets["zmin"]).all(1)
    floor, rest = triangles[on_floor], triangles[~on_floor]
    cells = [("triangle", floor), ("triangle", rest), ("tetra", tets[:2]), ("tetra", tets[2:])]
    tags = [np.full(len(block), tag) for (_, block), tag in zip(cells, (7, 9, 3, 4))]
    data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    names = {"floor": np.array([7, 2]), "hard": np.array([3, 3])}
    path = tmp_path / "a.msh"
    if file_format == "gmsh22":
        write(path, cells, cube.vertices, cell_data=data, field_data=names, file_format=file_format)
    else:
        path.write_text(gmsh41(cube.vertices, cells, (7, 9, 3, 4), names))
    mesh = TetrahedralMesh.from_file(path)
    assert np.array_equal(mesh.tetrahedra, tets)
    assert np.array_equal(mesh.vertex_sets["floor"], cube.vertex_sets["zmin"])
    assert np.array_equal(mesh.vertex_sets["tag_9"], np.arange(8))
    assert np.array_equal(mesh.tetrahedron_sets["hard"], [0, 1])
    assert np.array_equal(mesh.tetrahedron_sets["tag_4"], [2, 3, 4, 5])
    assert (len(mesh.vertex_sets), len(mesh.tetrahedron_sets)) == (2, 2)
    assert np.array_equal(mesh.surface_sets["floor"], cube.surface_sets["zmin"])
    assert len(mesh.surface_sets) == 2 and len(mesh.surface_sets["tag_9"]) == 10


def lidded() -> TetrahedralMesh:
    """A box of which two overlapping parts of the surface have names, one of them also a vertex set of other vertices."""
    mesh = TetrahedralMesh.create_box((3, 4, 3), pattern="five")
    mesh = mesh.with_surface_set("lid", lambda x, n: n[:, 1] > 0.9).with_vertex_set("tip", [3])
    return mesh.with_surface_set("half", lambda x, n: x[:, 0] < 0.4)


def test_surface_sets_by_predicate_triangles_and_names():
    mesh = lidded()
    assert np.array_equal(mesh.surface_sets["lid"], mesh.surface_sets["ymax"])
    triangles, rng = mesh.surface_triangles, np.random.default_rng(0)
    shuffled = rng.permuted(triangles[mesh.surface_sets["half"]], axis=1)[::-1]
    assert np.array_equal(mesh.surface_indices(shuffled), mesh.surface_sets["half"])
    both = np.union1d(mesh.surface_sets["half"], mesh.surface_sets["lid"])
    assert np.array_equal(mesh.surface_indices(["half", "lid"]), both)
    assert len(mesh.surface_indices(None)) == len(triangles)
    assert np.array_equal(mesh.vertex_indices("lid"), mesh.vertex_sets["ymax"])  # a surface set stands for its vertices
    assert "surface sets: xmin (12)" in mesh.describe()
    with pytest.raises(ValueError, match="no surface set is called 'roof'; there are: xmin"):
        mesh.surface_indices("roof")
    inner = next(f for t in mesh.tetrahedra for f in [t[:3]] if not (np.sort(triangles, 1) == np.sort(f)).all(1).any())
    with pytest.raises(ValueError, match=r"triangle .* is not on the surface \(1 of 1 are not\)"):
        mesh.surface_indices([inner])
    with pytest.raises(ValueError, match="the predicate must return .* Booleans"):
        mesh.surface_where(lambda x, n: n[:, 1])
    with pytest.raises(ValueError, match=r"surface set 'a': triangles must be vertex indices of shape \(k, 3\)"):
        TetrahedralMesh(CORNERS, TET, surface_sets={"a": [0, 1]})


def test_surface_sets_follow_the_mesh():
    mesh = lidded()
    for moved in (
        mesh.scaled((2, 1, 3)),
        mesh.translated((1, 2, 3)),
        mesh.rotated((0, 1, 0), 0.3),
        pickle.loads(pickle.dumps(mesh)),
    ):
        assert {k: v.tolist() for k, v in moved.surface_sets.items()} == {
            k: v.tolist() for k, v in mesh.surface_sets.items()
        }
        assert not moved.surface_sets["lid"].flags.writeable
    other = TetrahedralMesh.create_cube(3).translated((3, 0, 0))
    both = TetrahedralMesh.joined([other, mesh])
    expected = mesh.surface_triangles[mesh.surface_sets["lid"]] + other.num_vertices
    assert set(map(tuple, both.surface_triangles[both.surface_sets["lid"]])) == set(map(tuple, expected))
    assert len(both.surface_sets["ymin"]) == len(other.surface_sets["ymin"]) + len(mesh.surface_sets["ymin"])
    assert len(both.surface_sets["body_1"]) == len(mesh.surface_triangles)


def test_sets_of_one_name_are_told_apart_when_bodies_are_joined():
    cube = TetrahedralMesh.create_cube(2).with_vertex_set("tip", [0])
    plain = TetrahedralMesh.create_cube(2).translated((3, 0, 0))
    both = TetrahedralMesh.joined([plain, cube]).translated((1, 0, 0))
    for k, mesh in enumerate((plain, cube)):
        np.testing.assert_array_equal(both.vertex_sets[f"body_{k}_xmin"], mesh.vertex_sets["xmin"] + 8 * k)
        faces = both.surface_triangles[both.surface_sets[f"body_{k}_ymax"]]
        np.testing.assert_array_equal(faces, mesh.surface_triangles[mesh.surface_sets["ymax"]] + 8 * k)
    assert "body_1_tip" not in both.vertex_sets and both.vertex_sets["tip"].tolist() == [8]
    law = ds.StableNeoHookean(1e5, 0.3)
    for fixed in ("xmin", ["tip", "xmin"], {"xmin": "x"}):
        with pytest.warns(UserWarning, match="'xmin' contains 2 bodies.*'body_0_xmin', 'body_1_xmin'"):
            ds.Scene(both, law, fixed=fixed)
    with warnings.catch_warnings(action="error"):
        for fixed in ("tip", "body_0_xmin", ["body_0_xmin", "body_1_xmin"], both.vertex_indices("xmin"), None):
            ds.Scene(both, law, fixed=fixed)


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk"])
def test_files_keep_surface_sets(tmp_path, suffix):
    mesh = lidded()
    mesh.save(tmp_path / f"a{suffix}")
    again = TetrahedralMesh.from_file(tmp_path / f"a{suffix}")
    assert set(again.surface_sets) == set(mesh.surface_sets)
    assert all(np.array_equal(again.surface_sets[name], rows) for name, rows in mesh.surface_sets.items())
    assert np.array_equal(again.vertex_sets["tip"], [3])
    assert np.array_equal(again.vertex_sets["ymax"], mesh.vertex_sets["ymax"])


def gmsh41(points, cells, tags, names) -> str:
    """The text of a Gmsh 4.1 file, one entity per block."""
    dims = [{"triangle": 2, "tetra": 3}[kind] for kind, _ in cells]
    lines = ["$MeshFormat", "4.1 0 8", "$EndMeshFormat", "$PhysicalNames", str(len(names))]
    lines += [f'{dim} {tag} "{name}"' for name, (tag, dim) in names.items()] + ["$EndPhysicalNames", "$Entities"]
    lines.append(f"0 0 {dims.count(2)} {dims.count(3)}")
    lines += [f"{k + 1} 0 0 0 1 1 1 {'0' if tag is None else f'1 {tag}'} 0" for k, tag in enumerate(tags)]
    lines += ["$EndEntities", "$Nodes", f"1 {len(points)} 1 {len(points)}", f"3 {len(cells)} 0 {len(points)}"]
    lines += [str(k + 1) for k in range(len(points))] + [" ".join(map(repr, map(float, p))) for p in points]
    total = sum(len(block) for _, block in cells)
    lines += ["$EndNodes", "$Elements", f"{len(cells)} {total} 1 {total}"]
    count = 0
    for k, (kind, block) in enumerate(cells):
        lines.append(f"{dims[k]} {k + 1} {dict(triangle=2, tetra=4)[kind]} {len(block)}")
        for row in np.asarray(block):
            count += 1
            lines.append(f"{count} " + " ".join(str(v + 1) for v in row))
    return "\n".join([*lines, "$EndElements", ""])


def test_gmsh41_with_groups_on_some_volumes_only(tmp_path):
    cube = TetrahedralMesh.create_cube(2)
    cells = [("tetra", cube.tetrahedra[:2]), ("tetra", cube.tetrahedra[2:])]
    path = tmp_path / "a.msh"
    path.write_text(gmsh41(cube.vertices, cells, (3, None), {"hard": (3, 3)}))
    mesh = TetrahedralMesh.from_file(path)
    assert mesh.num_tetrahedra == 6 and mesh.tetrahedron_sets["hard"].tolist() == [0, 1]


def test_medit_references_become_tag_sets(tmp_path):
    cube = TetrahedralMesh.create_cube(2)
    path = write(
        tmp_path / "a.mesh",
        [("tetra", cube.tetrahedra)],
        cube.vertices,
        cell_data={"medit:ref": [np.array([2, 2, 5, 5, 5, 0])]},
    )
    mesh = TetrahedralMesh.from_file(path)
    assert {k: v.tolist() for k, v in mesh.tetrahedron_sets.items()} == {"tag_2": [0, 1], "tag_5": [2, 3, 4]}


def test_several_blocks_with_lines_and_points_beside_them(tmp_path):
    cube = TetrahedralMesh.create_cube(2)
    cells = [("tetra", cube.tetrahedra[:2]), ("line", [[0, 1]]), ("vertex", [[0]]), ("triangle", [[0, 1, 2]])]
    path = write(tmp_path / "a.vtu", [*cells, ("tetra", cube.tetrahedra[2:])], cube.vertices)
    with pytest.warns(UserWarning, match=r"a\.vtu: left out: 1 triangles that are no faces of tetrahedra"):
        mesh = TetrahedralMesh.from_file(path)
    assert mesh.content_hash == cube.content_hash


def test_files_that_are_refused(tmp_path):
    ten = np.concatenate(
        [CORNERS, [(CORNERS[a] + CORNERS[b]) / 2 for a, b in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))]]
    )
    cube = TetrahedralMesh.create_cube(2)
    both = [("tetra", cube.tetrahedra), ("hexahedron", [[0, 4, 6, 2, 1, 5, 7, 3]])]
    refused = [
        (
            write(tmp_path / "surface.vtu", [("triangle", [[0, 1, 2]])]),
            r"holds no tetrahedra; cell types found: triangle \(1\); fill the surface with tetrahedra",
        ),
        (
            write(tmp_path / "ten.vtu", [("tetra10", [list(range(10))]), ("tetra", TET)], ten),
            r"of four nodes, or of ten; cell types found: tetra \(1\), tetra10 \(1\); export elements of order 1 or 2",
        ),
        (
            write(tmp_path / "mixed.vtu", both, cube.vertices),
            r"tetrahedra beside hexahedron cells .* cell types found: tetra \(6\), hexahedron \(1\); mesh the body",
        ),
        (write(tmp_path / "flat.vtu", [("tetra", TET)], CORNERS * [1, 1, 0]), r"flat\.vtu: tetrahedron 0 is flat"),
        (
            write(tmp_path / "twice.msh", [("tetra", [[0, 1, 2, 3], [0, 1, 2, 3]])], file_format="gmsh22"),
            r"twice\.msh: tetrahedra must differ: 0 and 1",
        ),
    ]
    for path, message in refused:
        with pytest.raises(ValueError, match=message):
            TetrahedralMesh.from_file(path)
    swapped = write(tmp_path / "out.vtu", [("tetra", [[0, 2, 1, 3]])])
    with pytest.raises(ValueError, match=r"out\.vtu: tetrahedron 0 is inside-out .*fix_orientation=True"):
        TetrahedralMesh.from_file(swapped)
    assert TetrahedralMesh.from_file(swapped, fix_orientation=True).volume == pytest.approx(1 / 6)


def test_unreadable_and_missing_files(tmp_path, capfd):
    broken = {"a.msh": b"$MeshFormat\nrubbish", "b.vtu": b"<xml", "c.xyz": b"", "d.msh": b"rubbish"}
    for name, content in broken.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=rf"{name}: .*cannot read this file .*suffix names its format"):
            TetrahedralMesh.from_file(tmp_path / name)
    with pytest.raises(FileNotFoundError, match=r"no\.msh does not exist \(looked in"):
        TetrahedralMesh.from_file(tmp_path / "no.msh")
    assert capfd.readouterr() == ("", "")


def test_orphans_in_a_file_can_be_dropped(tmp_path):
    points = np.concatenate([[[9.0, 9, 9]], CORNERS, [[8.0, 8, 8]]])
    path = write(
        tmp_path / "a.vtu",
        [("tetra", TET + 1)],
        points,
        point_data={"vertex_set:tip": np.array([1, 0, 0, 0, 1, 1], np.int32)},
    )
    with pytest.warns(UserWarning, match=r"2 vertices in no tetrahedron, first 0"):
        assert TetrahedralMesh.from_file(path).num_vertices == 6
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = TetrahedralMesh.from_file(path, drop_orphans=True)
    assert np.array_equal(mesh.vertices, CORNERS) and np.array_equal(mesh.vertex_sets["tip"], [3])


# The meshes that the project carries

GROUPS = {
    "bunny0.msh": {"feet", "ears"},
    "beam.msh": {"clamped", "tip"},
    "gripper_finger.msh": {"base", "pad"},
    "lattice.msh": {"bottom", "top"},
}


@pytest.mark.parametrize("name", GROUPS)
def test_assets_load_clean_with_their_groups(name):
    path = ASSETS / name
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = TetrahedralMesh.from_file(path)
    assert path.stat().st_size < 1e6
    assert set(mesh.vertex_sets) == GROUPS[name]
    assert all(3 <= len(rows) < mesh.num_vertices / 2 for rows in mesh.vertex_sets.values())
    assert mesh.num_pieces == 1 and mesh.quality.min() > 0.1
    assert mesh.bounding_box[0, 1] == pytest.approx(0, abs=1e-9)  # stands on y = 0


def test_bunny_stands_on_its_feet_with_its_ears_up():
    mesh = TetrahedralMesh.load_from_msh(ASSETS / "bunny0.msh")
    height = np.ptp(mesh.bounding_box[:, 1])
    y = mesh.vertices[:, 1]
    assert 0.2 <= height <= 1 and 3000 <= mesh.num_tetrahedra <= 8000
    assert y[mesh.vertex_sets["feet"]].max() < 0.1 * height < 0.6 * height < y[mesh.vertex_sets["ears"]].min()
