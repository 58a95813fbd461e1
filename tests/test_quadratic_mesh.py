"""Meshes of ten-node tetrahedra: made, read, checked, turned into linear ones and back, searched, saved, shown."""

import copy
import pickle
import re
import warnings
from itertools import combinations, product

import meshio
import numpy as np
import pytest
from quadratic_meshes import (
    MIDDLES,
    box,
    crumpled,
    face_rule,
    renumbered,
    ring,
    six,
    six_by,
    turned,
    wavy,
    with_vertices,
)
from scipy.spatial import cKDTree

from diffsim_ti.mesh import TetrahedralMesh, jacobian
from diffsim_ti.mesh.jacobian import lowest_jacobian
from diffsim_ti.mesh.reference_element import QUADRATIC, quadrature
from diffsim_ti.visual.colouring import to_vertices
from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.visual.series import SavedSeries
from diffsim_ti.writers import View, writer_for

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
TEN = np.concatenate([CORNERS, CORNERS[np.array(MIDDLES)].mean(1)])
ROW = np.arange(10)[None]
CURVED = {"straight": lambda: box().quadratic(), "wavy": wavy, "crumpled": crumpled, "ring": lambda: ring(2)}
MESHES = pytest.mark.parametrize("make", CURVED.values(), ids=CURVED)
PATTERNS = pytest.mark.parametrize("pattern", ["kuhn", "five"])


def sets(mesh) -> dict:
    found = {"v": mesh.vertex_sets, "t": mesh.tetrahedron_sets, "s": mesh.surface_sets}
    return {(kind, name): rows.tolist() for kind, own in found.items() for name, rows in own.items()}


def reference_points(count: int, seed=0) -> np.ndarray:
    return np.random.default_rng(seed).dirichlet(np.ones(4), count)[:, 1:]


# From linear tetrahedra and back


@PATTERNS
def test_quadratic_and_back(pattern):
    mesh = box(pattern)
    ten = mesh.quadratic()
    n, edges = mesh.num_vertices, mesh.edges
    assert (ten.order, mesh.order, ten.reference.num_nodes, mesh.reference.num_nodes) == (2, 1, 10, 4)
    assert mesh.elements is mesh.tetrahedra and mesh.surface_faces is mesh.surface_triangles
    assert ten.num_vertices == n + len(edges) and ten.num_elements == mesh.num_tetrahedra
    assert np.array_equal(ten.vertices[:n], mesh.vertices) and np.array_equal(ten.tetrahedra, mesh.tetrahedra)
    ends = ten.vertices[ten.elements[:, np.array(MIDDLES)]]
    assert np.array_equal(ten.vertices[ten.elements[:, 4:]], ends.mean(2)) and not ten.curved.any()
    assert np.array_equal(ten.edges, edges) and np.array_equal(ten.middles[:, 1:], edges)
    assert np.array_equal(ten.volumes, mesh.volumes) and ten.num_pieces == 1 and not len(ten.unused_vertices)
    back = ten.linear()
    assert back.content_hash == mesh.content_hash != ten.content_hash and sets(back) == sets(mesh)
    assert ten.quadratic() is ten and mesh.linear() is mesh
    assert np.array_equal(ten.corners, np.arange(n)) and np.array_equal(mesh.corners, np.arange(n))


@PATTERNS
def test_sets_of_sides_stay_on_their_sides(pattern):
    ten = box(pattern).quadratic()
    triangles = ten.vertices[ten.surface_triangles]
    for axis, name in enumerate("xyz"):
        for end, at in (("min", 0), ("max", 1)):
            value = ten.bounding_box[at, axis]
            assert np.array_equal(ten.vertex_sets[name + end], np.nonzero(ten.vertices[:, axis] == value)[0])
            on_side = (triangles[:, :, axis] == value).all(1)
            assert np.array_equal(ten.surface_sets[name + end], np.nonzero(on_side)[0])
    assert np.array_equal(ten.surface_sets["lid"], ten.surface_sets["ymax"])
    assert np.array_equal(ten.tetrahedron_sets["core"], [1, 2, 3])


@pytest.mark.parametrize("seed", range(8))
def test_middles_join_sets_by_triangles_of_the_surface_and_whole_tetrahedra(seed):
    rng = np.random.default_rng(seed)
    mesh = renumbered(box(), seed)[0]
    members = np.nonzero(rng.random(mesh.num_vertices) < rng.uniform(0.3, 1.0))[0]
    ten = mesh.with_vertex_set("some", members).quadratic()
    chosen, cells = set(members.tolist()), [*mesh.surface_triangles.tolist(), *mesh.tetrahedra.tolist()]
    expected = {frozenset(pair) for cell in cells if chosen >= set(cell) for pair in combinations(cell, 2)}
    joined = ten.vertex_sets["some"][ten.vertex_sets["some"] >= mesh.num_vertices]
    found = {frozenset(ends) for middle, *ends in ten.middles.tolist() if middle in joined}
    assert found == expected and np.array_equal(ten.vertex_sets["some"][: len(members)], members)
    assert sets(ten.linear()) == sets(mesh.with_vertex_set("some", members))


def test_vertices_in_no_tetrahedron_stay():
    mesh = box()
    with pytest.warns(UserWarning, match="1 vertex in no tetrahedron"):
        lone = TetrahedralMesh(
            np.concatenate([mesh.vertices[:5], [[9, 9, 9]], mesh.vertices[5:]]),
            mesh.tetrahedra + (mesh.tetrahedra >= 5),
        )
    ten = lone.quadratic()
    assert (
        ten.unused_vertices.tolist() == [5] and ten.num_pieces == 1 and ten.linear().content_hash == lone.content_hash
    )


@MESHES
def test_corners_pull_back(make):
    mesh, rng = renumbered(make(), 3)[0], np.random.default_rng(0)
    linear, P = mesh.linear(), mesh.from_corners
    assert np.array_equal(linear.vertices, mesh.vertices[mesh.corners]) and linear.num_vertices == len(mesh.corners)
    assert np.array_equal(mesh.corners[linear.tetrahedra], mesh.tetrahedra)
    moved = rng.normal(size=linear.vertices.shape)
    whole = P @ moved
    middle, i, j = mesh.middles.T
    new = {int(v): k for k, v in enumerate(mesh.corners)}
    assert np.array_equal(whole[mesh.corners], moved)
    np.testing.assert_allclose(whole[middle], (moved[[new[k] for k in i]] + moved[[new[k] for k in j]]) / 2, atol=1e-15)
    if not mesh.curved.any():
        np.testing.assert_allclose(P @ linear.vertices, mesh.vertices, atol=1e-15)
    assert np.array_equal(linear.from_corners @ moved, moved)


# The surface and volumes


@MESHES
def test_surface_is_closed_and_encloses_the_volume(make):
    """Faces of six nodes and their triangles point outwards; the divergence theorem on curved faces gives the volume."""
    for mesh in (make(), renumbered(make())[0]):
        faces, triangles = mesh.surface_faces, mesh.surface_triangles
        assert len(triangles) == 4 * len(faces) == 4 * len(mesh.linear().surface_triangles)
        a, b, c, ab, bc, ca = faces.T
        quarters = [[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]
        assert np.array_equal(np.moveaxis(np.array(quarters), 2, 0).reshape(-1, 3), triangles)
        assert np.array_equal(mesh.surface_vertices, np.unique(faces))
        L, weights = face_rule()
        x = np.einsum("qa,fai->fqi", six(L), mesh.vertices[faces])
        tangents = np.einsum("qad,fai->fqid", six_by(L), mesh.vertices[faces])
        normals = np.cross(tangents[..., 0], tangents[..., 1]) / 2
        assert np.abs(np.einsum("q,fqi->i", weights, normals)).max() < 1e-13
        assert np.einsum("q,fqi,fqi->", weights, x, normals) / 3 == pytest.approx(mesh.volume, rel=1e-13)
        edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
        assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}


@MESHES
def test_volumes_are_exact(make):
    mesh = make()
    xi, weights = quadrature(3)
    J = np.linalg.det(np.einsum("qaj,eai->eqij", QUADRATIC.derivatives(xi), mesh.vertices[mesh.elements]))
    assert mesh.volumes == pytest.approx(J @ weights / 6, rel=1e-13)
    assert mesh.volume == pytest.approx(mesh.volumes.sum(), rel=1e-14)


def test_a_curved_ring_is_nearer_to_its_volume_than_a_straight_one():
    errors = [ring(cells).volume / (0.75 * np.pi) - 1 for cells in (1, 2, 4)]
    assert abs(errors[2]) < 4e-6 and np.log2(np.divide(errors[:2], errors[1:])) == pytest.approx([4, 4], abs=0.05)
    assert np.array_equal(np.unique(ring(1).curved), [True])


@MESHES
def test_numbering_does_not_matter(make):
    mesh = make()
    other, new, order = renumbered(mesh, 1)
    assert other.volumes == pytest.approx(mesh.volumes[order], rel=1e-13)
    assert np.array_equal(other.curved, mesh.curved[order])
    assert other.quality == pytest.approx(mesh.quality[order]) and other.num_pieces == 1
    rows = mesh.surface_indices(mesh.surface_triangles)
    again = other.surface_indices(new[mesh.surface_triangles])
    assert len(rows) == len(again) == len(mesh.surface_triangles)
    assert sorted(map(sorted, new[mesh.middles].tolist())) == sorted(map(sorted, other.middles.tolist()))


# J > 0


@pytest.mark.parametrize("size", [0.02, 0.08, 0.15])
def test_bounds_of_j_hold(size):
    """Coefficients bound J from both sides and are J at corners; elements are refused where J falls to nothing, only."""
    rng = np.random.default_rng(int(1e3 * size))
    nodes = TEN + size * rng.normal(size=(300, 10, 3))
    grid = np.array([ijk for ijk in product(range(13), repeat=3) if sum(ijk) < 13]) / 12
    xi = np.concatenate([CORNERS, grid])
    J = np.linalg.det(np.einsum("qaj,eai->eqij", QUADRATIC.derivatives(xi), nodes))
    b = jacobian.coefficients(jacobian.corner_gradients(nodes))
    assert np.all(b.min(1) <= J.min(1) + 1e-12) and np.all(b.max(1) >= J.max(1) - 1e-12)
    assert np.allclose(np.sort(J[:, :4], 1)[:, 0], b[:, [0, 10, 16, 19]].min(1), atol=1e-12)
    refused = np.isin(np.arange(300), jacobian.not_above(nodes, np.zeros(300)))
    assert np.all(refused[J.min(1) <= 0])
    assert np.all(J[refused].min(1) < 0.01)  # what is refused is wrong, or nearly so
    crude = b.min(1) <= 0
    assert np.all(crude[refused]) and (size == 0.02 or (crude & ~refused).any())


def test_lowest_jacobian_is_that_of_the_worst_element():
    mesh = wavy()
    J = np.linalg.det(
        np.einsum("qaj,eai->eqij", QUADRATIC.derivatives(reference_points(500)), mesh.vertices[mesh.elements])
    )
    bound = lowest_jacobian(mesh)
    assert np.all(bound <= J.min(1) / (6 * mesh.volumes)) and bound.min() > 0
    assert np.all(lowest_jacobian(box().quadratic()) == 1)


def test_an_element_that_folds_is_refused():
    mesh = box().quadratic()
    x = mesh.vertices.copy()
    x[mesh.elements[7, 4]] += 0.8 * (x[mesh.elements[7, 2]] - x[mesh.elements[7, 4]])
    with pytest.raises(ValueError, match=r"J = det dx/dxi must be positive.* tetrahedron \d+ has .*HighOrderOptimize"):
        with_vertices(mesh, x)
    with pytest.raises(ValueError, match="J = det dx/dxi must be positive"):
        TetrahedralMesh(np.where(np.arange(10)[:, None] == 4, [0.8, 0, 0], TEN), ROW)
    assert TetrahedralMesh(np.where(np.arange(10)[:, None] == 4, [0.7, 0, 0], TEN), ROW).curved.all()


# The order of mid-edge vertices


@pytest.mark.parametrize("make", [CURVED["straight"], wavy], ids=["straight", "wavy"])
@pytest.mark.parametrize("seed", range(4))
def test_another_order_of_mid_edge_vertices_is_refused_or_repaired(make, seed):
    mesh = make()
    columns = np.array([0, 1, 2, 3, 4, 5, 6, 7, 9, 8])  # Gmsh's
    if seed:
        columns[4:] = 4 + np.random.default_rng(seed).permutation(6)
    wrong = mesh.elements[:, columns]
    remedy = re.escape(f"take tetrahedra[:, {np.argsort(columns).tolist()}], or pass fix_orientation=True")
    with pytest.raises(ValueError, match=f"another order .*VTK.* Gmsh swaps the last two.*{remedy}"):
        TetrahedralMesh(mesh.vertices, wrong)
    assert np.array_equal(TetrahedralMesh(mesh.vertices, wrong[:, np.argsort(columns)]).elements, mesh.elements)
    assert np.array_equal(TetrahedralMesh(mesh.vertices, wrong, fix_orientation=True).elements, mesh.elements)


@MESHES
def test_inside_out_elements_are_repaired_with_their_middles(make):
    mesh = make()
    some = np.random.default_rng(2).random(mesh.num_tetrahedra) < 0.4
    wrong = np.where(some[:, None], mesh.elements[:, turned([0, 1, 3, 2])], mesh.elements)
    with pytest.raises(ValueError, match="are inside-out"):
        TetrahedralMesh(mesh.vertices, wrong)
    assert np.array_equal(TetrahedralMesh(mesh.vertices, wrong, fix_orientation=True).elements, mesh.elements)


def doubled(mesh, row, column):
    """A vertex of its own for one mid-edge vertex of one element, at the same place."""
    elements = mesh.elements.copy()
    elements[row, column] = mesh.num_vertices
    return np.concatenate([mesh.vertices, mesh.vertices[mesh.elements[row, column]][None]]), elements


def test_mid_edge_vertices_that_do_not_fit_are_refused():
    mesh = box().quadratic()
    shared = next(k for k in range(4, 10) if (mesh.elements == mesh.elements[5, k]).sum() > 1)
    with pytest.raises(
        ValueError, match=r"an edge has one vertex at its middle: the edge of vertices \d+ and \d+ has \d+ "
    ):
        TetrahedralMesh(*doubled(mesh, 5, shared))
    two = np.stack([np.arange(10), np.arange(10, 20)])
    assert TetrahedralMesh(np.concatenate([TEN, TEN + [0, 0, 3]]), two).num_pieces == 2
    near = TEN + [0.5, 0, 0]  # its corner 0 is where the first has the middle of 01
    elements = np.stack([np.arange(10), np.arange(10, 20)])
    elements[1, 0] = 4
    with pytest.raises(ValueError, match="a vertex is a corner or stands on an edge: vertex 4 does both"):
        TetrahedralMesh(np.concatenate([TEN, near]), elements)
    elements = np.stack([np.arange(10), np.arange(10, 20)])
    elements[1, 4] = 4
    turned_over = TEN * [1, -1, -1]  # its edge 01 lies on that of the first, with other ends
    with pytest.raises(ValueError, match="a mid-edge vertex belongs to one edge: vertex 4 stands on those of vertices"):
        TetrahedralMesh(np.concatenate([TEN, turned_over]), elements)


@pytest.mark.parametrize(
    "elements, message",
    [
        (np.arange(5)[None], r"shape \(num_tetrahedra, 4\), or \(num_tetrahedra, 10\) .* got \(1, 5\)"),
        (np.arange(1, 11)[None], r"indices must lie in 0\.\.9: tetrahedron 0 has 10"),
        (np.array([[*range(9), 8]]), r"ten different vertices: tetrahedron 0 is"),
        (np.array([[*range(10)], [*range(10)]]), r"tetrahedra must differ: 0 and 1 have"),
    ],
)
def test_bad_elements_are_refused(elements, message):
    with pytest.raises(ValueError, match=message):
        TetrahedralMesh(TEN, elements)


# Copies, moves, bodies together


@MESHES
def test_moves_copies_and_hashes(make):
    mesh = make()
    moved = mesh.translated((1, 2, 3)).rotated((1, 2, 0), 0.4).scaled(2.0)
    assert moved.volumes == pytest.approx(8 * mesh.volumes) and sets(moved) == sets(mesh)
    assert np.array_equal(moved.elements, mesh.elements) and np.array_equal(moved.middles, mesh.middles)
    assert mesh.scaled((1, 2, 1.5)).volumes == pytest.approx(3 * mesh.volumes)
    assert np.array_equal(moved.curved, mesh.curved) and moved.order == 2
    for again in (mesh, pickle.loads(pickle.dumps(mesh)), copy.deepcopy(mesh), moved, mesh.linear().quadratic()):
        for (
            name
        ) in "elements tetrahedra vertices surface_faces surface_triangles middles curved corners volumes".split():
            assert not getattr(again, name).flags.writeable
    assert mesh.content_hash == make().content_hash != mesh.scaled(1 + 1e-15).content_hash
    text = mesh.describe()
    assert f"{len(mesh.corners)} corners, {len(mesh.middles)} mid-edge vertices" in text
    assert ("straight edges" in text) == (not mesh.curved.any()) == ("of J over its mean" not in text)


def test_bodies_of_one_order_are_joined():
    straight, bent = box().quadratic(), wavy().translated((4, 0, 0))
    both = TetrahedralMesh.joined([straight, bent])
    assert both.order == 2 and both.num_pieces == 2
    assert both.volumes == pytest.approx(np.concatenate([straight.volumes, bent.volumes]))
    assert len(both.surface_sets["lid"]) == 2 * len(straight.surface_sets["lid"])
    assert np.array_equal(both.vertex_sets["body_1"], straight.num_vertices + np.arange(bent.num_vertices))
    with pytest.raises(
        ValueError, match=r"must be of one order: mesh 0 is of order 2, mesh 1 of order 1; call .quadratic"
    ):
        TetrahedralMesh.joined([straight, box().translated((4, 0, 0))])


def test_surface_sets_by_faces_triangles_and_predicates():
    mesh = wavy(0.05)
    rows = np.arange(8, 16)
    for given in (mesh.surface_faces[2:4], mesh.surface_faces[2:4, :3], mesh.surface_triangles[8:16]):
        shuffled = np.random.default_rng(0).permutation(given)
        assert np.array_equal(mesh.surface_indices(shuffled), rows)
        made = TetrahedralMesh(mesh.vertices, mesh.elements, surface_sets={"some": shuffled})
        assert np.array_equal(made.surface_sets["some"], rows)
    part = mesh.with_surface_set("part", [8, 9, 10, 12, 13, 14, 15])
    assert np.array_equal(part.linear().surface_sets["part"], [3])
    inner = mesh.elements[0, [4, 5, 9]]
    with pytest.raises(ValueError, match=r"is not on the surface \(1 of 2 are not\)"):
        mesh.surface_indices([mesh.surface_triangles[0], inner])
    linear = box()
    for predicate in (lambda x, n: n[:, 1] > 0.9, lambda x, n: x[:, 0] < 0.4, lambda x, n: n[:, 2] + x[:, 1] > 1.3):
        chosen = linear.surface_where(predicate)
        assert 0 < len(chosen) < len(linear.surface_triangles)
        expected = (4 * chosen[:, None] + np.arange(4)).ravel()
        assert np.array_equal(linear.quadratic().surface_where(predicate), expected)
    with pytest.raises(ValueError, match="must return .* Booleans"):
        mesh.surface_where(lambda x, n: n[:, 1])


def test_places_and_normals_of_curved_faces_are_their_middles():
    mesh = ring(4)
    seen = {}
    mesh.surface_where(lambda x, n: seen.update(x=x, n=n) or x[:, 0] > 9)
    L = np.full((1, 3), 1 / 3)
    np.testing.assert_allclose(
        seen["x"], np.einsum("qa,fai->fi", six(L), mesh.vertices[mesh.surface_faces]), atol=1e-14
    )
    outer = np.linalg.norm(seen["x"][:, :2], axis=1) > 1.99
    radial = seen["x"][outer] * [1, 1, 0] / np.linalg.norm(seen["x"][outer, :2], axis=1)[:, None]
    assert outer.sum() == 2 * 4 * 8 and (seen["n"][outer] * radial).sum(1).min() > 0.9999


# Points


@MESHES
def test_points_are_found_and_quadratic_functions_kept(make):
    mesh, rng = renumbered(make(), 5)[0], np.random.default_rng(1)
    e, xi = rng.integers(0, mesh.num_tetrahedra, 150), reference_points(150, 2)
    N = QUADRATIC.functions(xi)
    points = np.einsum("pa,pai->pi", N, mesh.vertices[mesh.elements[e]])
    found = mesh.locate(points)
    assert np.array_equal(found.tetrahedra, e) and np.array_equal(found.vertices, mesh.elements[e])
    np.testing.assert_allclose(found.weights, N, atol=1e-10)
    on_vertices = mesh.locate(mesh.vertices)
    np.testing.assert_allclose(on_vertices.matrix @ mesh.vertices, mesh.vertices, atol=1e-11)
    if not mesh.curved.any():
        x, y, z = mesh.vertices.T
        px, py, pz = points.T
        np.testing.assert_allclose(found.matrix @ (x * y - 2 * z**2 + x), px * py - 2 * pz**2 + px, atol=1e-13)


@MESHES
def test_nearest_points_of_curved_bodies(make):
    mesh, rng = make(), np.random.default_rng(3)
    points = mesh.vertices.mean(0) + 2 * rng.normal(size=(40, 3))
    found = mesh.locate(points, nearest=True)
    np.testing.assert_allclose(found.matrix @ mesh.vertices, found.points, atol=1e-13)
    distance = np.linalg.norm(found.points - points, axis=1)
    grid = np.array([(i, j) for i in range(21) for j in range(21 - i)]) / 20
    L = np.concatenate([1 - grid.sum(1, keepdims=True), grid], 1)
    sampled = np.einsum("qa,fai->fqi", six(L), mesh.vertices[mesh.surface_faces]).reshape(-1, 3)
    away = cKDTree(sampled).query(points)[0]
    outside = distance > 1e-12
    assert outside.sum() > 20 and np.all((distance <= away + 1e-12)[outside])
    assert np.all((away - distance)[outside] < 0.01)
    with pytest.raises(ValueError, match="points lie outside the mesh"):
        mesh.locate(points)


def test_points_between_the_flat_and_the_curved_surface():
    mesh = ring(2)
    at = np.array([[np.cos(a) * r, np.sin(a) * r, 0.37] for a in np.linspace(0.1, 1.4, 9) for r in (1.0005, 1.9995)])
    assert np.allclose(mesh.locate(at).matrix @ mesh.vertices, at, atol=1e-11)
    with pytest.raises(ValueError, match="lie outside"):
        mesh.linear().quadratic().locate(at)


# Files


def named(mesh) -> TetrahedralMesh:
    """With a part of the surface that cuts through faces."""
    return mesh.with_surface_set("part", np.arange(6, 17)).with_tetrahedron_set("all", np.arange(mesh.num_tetrahedra))


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk", ".inp", ".xdmf"])
def test_round_trip(tmp_path, suffix):
    if suffix == ".xdmf":
        pytest.importorskip("h5py")
    path = tmp_path / f"a{suffix}"
    for mesh in (box().quadratic(), crumpled(), renumbered(wavy(), 4)[0]):
        bare = TetrahedralMesh(mesh.vertices, mesh.elements)
        bare.save(path)
        assert TetrahedralMesh.from_file(path).content_hash == bare.content_hash
    if suffix in (".msh", ".vtu", ".vtk"):
        mesh = named(crumpled())
        mesh.save(path)
        again = TetrahedralMesh.from_file(path)
        kept = sets(again)
        assert sets(mesh).items() <= kept.items() and again.content_hash == mesh.content_hash
        assert set(kept) - set(sets(mesh)) == {("v", "part"), ("v", "lid")}  # a surface set stands for its vertices


def test_formats_without_ten_nodes_refuse(tmp_path):
    with pytest.raises(
        ValueError, match=r"cannot save .*a\.mesh: ten-node tetrahedra go into \.msh, .*or save mesh\.linear"
    ):
        TetrahedralMesh(TEN, ROW).save(tmp_path / "a.mesh")
    assert not list(tmp_path.iterdir())


def gmsh_text(mesh, version: str) -> str:
    """A Gmsh file as Gmsh itself would write it: its own order of the mid-edge nodes, numbers from 1."""
    rows = mesh.elements[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]] + 1
    faces = mesh.surface_faces[mesh.surface_sets["lid"][::4] // 4] + 1
    points = [" ".join(map(repr, x)) for x in mesh.vertices.tolist()]
    n, m, k = len(points), len(rows), len(faces)
    head = [
        "$MeshFormat",
        f"{version} 0 8",
        "$EndMeshFormat",
        "$PhysicalNames",
        "2",
        '2 7 "lid"',
        '3 3 "body"',
        "$EndPhysicalNames",
    ]
    if version == "2.2":
        nodes = ["$Nodes", str(n), *(f"{v + 1} {x}" for v, x in enumerate(points)), "$EndNodes"]
        lines = [f"{f + 1} 9 2 7 1 " + " ".join(map(str, row)) for f, row in enumerate(faces)]
        lines += [f"{k + e + 1} 11 2 3 1 " + " ".join(map(str, row)) for e, row in enumerate(rows)]
        return "\n".join([*head, *nodes, "$Elements", str(m + k), *lines, "$EndElements", ""])
    entities = ["$Entities", "0 0 1 1", "1 0 0 0 1 1 1 1 7 0", "1 0 0 0 1 1 1 1 3 0", "$EndEntities"]
    nodes = ["$Nodes", f"1 {n} 1 {n}", f"3 1 0 {n}", *map(str, range(1, n + 1)), *points, "$EndNodes"]
    lines = [f"2 1 9 {k}", *(f"{f + 1} " + " ".join(map(str, row)) for f, row in enumerate(faces))]
    lines += [f"3 1 11 {m}", *(f"{k + e + 1} " + " ".join(map(str, row)) for e, row in enumerate(rows))]
    return "\n".join([*head, *entities, *nodes, "$Elements", f"2 {m + k} 1 {m + k}", *lines, "$EndElements", ""])


@pytest.mark.parametrize("version", ["2.2", "4.1"])
@pytest.mark.parametrize("make", [CURVED["straight"], wavy], ids=["straight", "wavy"])
def test_files_of_gmsh_with_its_own_order_and_groups(tmp_path, version, make):
    mesh, path = make(), tmp_path / "a.msh"
    path.write_text(gmsh_text(mesh, version))
    read = TetrahedralMesh.from_file(path)
    assert read.content_hash == mesh.content_hash
    assert np.array_equal(read.surface_sets["lid"], mesh.surface_sets["lid"])
    assert np.array_equal(read.vertex_sets["lid"], np.unique(mesh.surface_triangles[mesh.surface_sets["lid"]]))
    assert np.array_equal(read.tetrahedron_sets["body"], np.arange(mesh.num_tetrahedra))


def test_other_orders_in_files(tmp_path):
    mesh = wavy()
    path = tmp_path / "gmsh_order.vtu"
    meshio.Mesh(mesh.vertices, [("tetra10", mesh.elements[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]])]).write(path)
    with pytest.raises(ValueError, match=r"gmsh_order\.vtu: J .* another order .* fix_orientation=True"):
        TetrahedralMesh.from_file(path)
    assert TetrahedralMesh.from_file(path, fix_orientation=True).content_hash == mesh.content_hash


def test_orphans_can_be_dropped(tmp_path):
    path = tmp_path / "a.vtu"
    sides = {"vertex_set:side": np.array([1, 0, *[1] * 10], np.int32)}
    cells = [("tetra10", ROW + 2), ("triangle6", [[2, 3, 4, 6, 7, 8]])]
    data = {"surface_set:under": [np.zeros(1, np.int32), np.ones(1, np.int32)]}
    points = np.concatenate([[[9.0] * 3, [8.0] * 3], TEN])
    meshio.Mesh(points, cells, point_data=sides, cell_data=data).write(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = TetrahedralMesh.from_file(path, drop_orphans=True)
    assert np.array_equal(mesh.vertices, TEN) and np.array_equal(mesh.vertex_sets["side"], np.arange(10))
    assert len(mesh.surface_sets["under"]) == 4 and np.array_equal(mesh.vertex_sets["under"], [0, 1, 2, 4, 5, 6])


# Pictures and series


def test_series_hold_quadratic_cells_and_come_back(tmp_path):
    mesh = wavy()
    u = 0.1 * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    setting = Setting(mesh, None, mesh.vertex_sets["xmin"], [])
    for name in ("a.pvd", "a.npz"):
        writer = writer_for(tmp_path / name, View())
        writer.open(setting)
        fields = {"von_mises": np.arange(float(mesh.num_tetrahedra))}
        writer.write(Frame(0.5, mesh.vertices + u, u, 2 * u, fields))
        writer.close()
    assert 'type="UInt8"' in (text := (tmp_path / "a_0000.vtu").read_text()) and "types" in text
    saved = meshio.read(tmp_path / "a_0000.vtu")
    assert [block.type for block in saved.cells] == ["tetra10"] and np.array_equal(saved.cells[0].data, mesh.elements)
    series = SavedSeries(tmp_path / "a.pvd")
    assert series.setting.mesh.order == 2 and np.allclose(series.setting.mesh.vertices, mesh.vertices, atol=1e-15)
    assert np.allclose(series.frame(0).displacements, u) and np.array_equal(
        series.setting.fixed, mesh.vertex_sets["xmin"]
    )
    arrays = np.load(tmp_path / "a.npz")
    again = TetrahedralMesh(arrays["rest_positions"], arrays["tetrahedra"])
    assert again.content_hash == mesh.content_hash


def test_values_of_tetrahedra_reach_mid_edge_vertices():
    mesh = box().quadratic()
    assert np.allclose(to_vertices(mesh, np.full(mesh.num_tetrahedra, 3.0)), 3.0)
    values = np.random.default_rng(0).random(mesh.num_tetrahedra)
    found = to_vertices(mesh, values)
    for vertex in (0, mesh.num_vertices - 1):
        around = (mesh.elements == vertex).any(1)
        assert found[vertex] == pytest.approx(np.average(values[around], weights=mesh.volumes[around]))
