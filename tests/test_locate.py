"""Which tetrahedron a point lies in: the map from vertices to points, points outside, and the nearest point of a body."""

import numpy as np
import pytest
from test_gradients import random_mesh

import diffsim_ti as ds
from diffsim_ti.mesh.locate import nearest_on_triangles

RNG = np.random.default_rng(5)


def graded_mesh() -> ds.TetrahedralMesh:
    """Tetrahedra whose edges differ by a factor of 40."""
    box = ds.TetrahedralMesh.create_box((7, 4, 4), 1.0)
    return ds.TetrahedralMesh(np.exp(4 * box.vertices) - 1, box.tetrahedra)


def random_points(mesh, count=200) -> tuple[np.ndarray, np.ndarray]:
    """Points and the tetrahedra that they were put into."""
    tetrahedra = RNG.integers(0, mesh.num_tetrahedra, count)
    return np.einsum(
        "pa,pai->pi", RNG.dirichlet(np.ones(4), count), mesh.vertices[mesh.tetrahedra[tetrahedra]]
    ), tetrahedra


@pytest.mark.filterwarnings("ignore:.*slivers")
@pytest.mark.parametrize("make", [random_mesh, graded_mesh])
def test_points_inside(make):
    mesh = make()
    points, tetrahedra = random_points(mesh)
    found = mesh.locate(points)
    assert np.array_equal(found.tetrahedra, tetrahedra) and np.array_equal(found.points, points)
    assert found.weights.min() >= 0 and np.allclose(found.weights.sum(1), 1, rtol=1e-14)
    np.testing.assert_allclose(found.matrix @ mesh.vertices, points, rtol=0, atol=1e-12 * np.abs(points).max())
    linear = mesh.vertices @ [1.0, -2.0, 3.0] + 4
    np.testing.assert_allclose(found.matrix @ linear, points @ [1.0, -2.0, 3.0] + 4, rtol=1e-11)


def test_points_on_vertices_edges_and_faces():
    """Round-off does not put them outside, also where the surface is oblique; and any tetrahedron beside them will do."""
    mesh = random_mesh().rotated([1.0, 2.0, 3.0], 0.7)
    middles = mesh.vertices[mesh.edges].mean(1), mesh.vertices[mesh.surface_triangles].mean(1)
    points = np.concatenate([mesh.vertices, *middles])
    found = mesh.locate(points)
    np.testing.assert_allclose(found.matrix @ mesh.vertices, points, atol=1e-13)
    assert found.weights.min() >= -1e-9


def test_points_outside_are_named():
    mesh = ds.TetrahedralMesh.create_cube(3)
    points = [[0.5, 0.5, 0.5], [0.5, 1.25, 0.5], [0.2, 0.2, -0.1]]
    with pytest.raises(
        ValueError, match=r"2 of 3 points lie outside.*point 1 at \(0.5, 1.25, 0.5\) by 0.25 m.*nearest=True"
    ):
        mesh.locate(points)
    found = mesh.locate(points, nearest=True)
    np.testing.assert_allclose(found.points, [[0.5, 0.5, 0.5], [0.5, 1, 0.5], [0.2, 0.2, 0]], atol=1e-15)
    np.testing.assert_allclose(found.matrix @ mesh.vertices, found.points, atol=1e-15)
    for bad in ([0.5, 0.5, 0.5], [[0.5, np.nan, 0.5]], [[1.0, 2.0]]):
        with pytest.raises(ValueError, match="points: expected finite numbers of shape"):
            mesh.locate(bad)


def test_a_hole_is_outside():
    """Near tetrahedra on all sides are not enough."""
    cube = ds.TetrahedralMesh.create_cube(4)
    hollow = np.abs(cube.centroids - 0.5).max(1) > 1 / 6
    mesh = ds.TetrahedralMesh(cube.vertices, cube.tetrahedra[hollow])
    with pytest.raises(ValueError, match="point 0 at .* by 0.167 m"):
        mesh.locate([[0.5, 0.5, 0.5]])


def test_nearest_points_of_triangles():
    """Against many points of each triangle: none is nearer, and one is as near."""
    triangles, s = RNG.normal(size=(40, 3, 3)), np.linspace(0, 1, 60)
    weights = np.array([(a, b, 1 - a - b) for a in s for b in s if a + b <= 1])
    for point in 2 * RNG.normal(size=(10, 3)):
        distance = np.linalg.norm(nearest_on_triangles(point, triangles) - point, axis=1)
        tried = np.linalg.norm(np.einsum("wa,kai->kwi", weights, triangles) - point, axis=2).min(1)
        assert np.all(distance <= tried + 1e-12) and np.all(tried - distance <= 0.1)
