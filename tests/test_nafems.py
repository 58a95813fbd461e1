"""NAFEMS benchmarks of stress at points of curved bodies (The Standard NAFEMS Benchmarks, TNSB rev. 3, 1990), and cuts."""

import numpy as np
import pytest
from quadratic_meshes import with_vertices

import diffsim_ti as ds
from diffsim_ti.outputs.deformation import PatchRecovery, PointMeans


def graded_box(cells, size, *powers) -> ds.TetrahedralMesh:
    """Straight ten-node tetrahedra of a box whose cells become larger along x, y, z."""
    box = ds.TetrahedralMesh.create_box(np.add(cells, 1), size, "five")
    return with_vertices(box, np.array(box.vertices) ** (*powers, *[1.0] * (3 - len(powers)))).quadratic()


def stress_at(scene, place, i: int, at: str) -> float:
    frames = ds.Rollout(ds.StaticSolver(scene), 1, outputs=[ds.Stress(at=at)]).forward()
    return frames["stress"][-1, np.linalg.norm(scene.mesh.vertices - place, axis=1).argmin(), i, i]


def bar_of_mean(scene, coordinates, shape, places, place, i: int, radius: float = 0.1) -> ds.Accuracy:
    """The error bar of sigma_ii [MPa] at a place as a mean over the body within a radius [m].

    It is that of weights (1 - d^2 / radius^2)^2 which is exact for linear fields: theirs times what makes it so. shape: from
    coordinates in a box, which vertices have, to where these lie; places: coordinates of what the mean is over.
    """
    n, x = len(coordinates), shape(places)
    x = x[np.linalg.norm(x - place, axis=1) < radius]
    P = np.insert((x - place) / radius, 0, 1, 1)
    W = (1 - (P[:, 1:] ** 2).sum(1, keepdims=True)) ** 2 * P
    weights = np.zeros((len(x), 3, 3))
    weights[:, i, i] = W @ np.linalg.inv(P.T @ W)[0] / 1e6

    def finer(mesh):  # whose vertices lie where the shape is, too
        P = mesh.refined().refinement.from_coarse
        return mesh.refined(onto=lambda _: shape((P @ coordinates)[n:]))

    rollout = ds.Rollout(ds.StaticSolver(scene), 1, outputs=ds.Stress(at=x))
    return rollout.accuracy("stress", weights, finer)


def grid(ends, steps) -> np.ndarray:
    """Middles of the cells of a box from 0 to its ends."""
    axes = [np.arange(h / 2, end, h) for end, h in zip(ends, steps)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def le10_shape(x: np.ndarray) -> np.ndarray:
    r, t, z = x.T
    return np.stack([(2 + 1.25 * r) * np.cos(np.pi / 2 * t), (1 + 1.75 * r) * np.sin(np.pi / 2 * t), 0.6 * z], 1)


def le10(cells=(6, 8, 4)) -> ds.Scene:
    """A thick elliptic plate under pressure."""
    return le10_with_coordinates(cells)[0]


def le10_with_coordinates(cells) -> tuple[ds.Scene, np.ndarray]:
    box = graded_box(cells, (1, 1, 1), 1.5, 1.3)
    r, _, z = box.vertices.T
    mesh = with_vertices(box, le10_shape(box.vertices))
    mesh = mesh.with_vertex_set("edge", (r > 1 - 1e-9) & (np.abs(z - 0.5) < 1e-9))
    fixed = {"ymin": "y", "ymax": "x", "xmax": "xy", "edge": "z"}
    load = ds.Traction((0, 0, -1e6), "zmax")
    law = ds.LinearElastic(E=210e9, nu=0.3)
    return ds.Scene(mesh, law, terms=[load], fixed=fixed, precision="f64"), box.vertices


def test_le10():
    assert stress_at(le10(), (2, 0, 0.6), 1, "recovered") == pytest.approx(-5.38e6, rel=0.02)


def test_le10_has_its_target_within_its_error_bar():
    """On this mesh, and on one that is far too coarse, where errors cancel, which is said."""
    places = grid((0.2, 0.2, 0.25), (0.0057, 0.0026, 0.0119)) * [1, 1, -1] + [0, 0, 1]
    found, coarse = (
        bar_of_mean(*le10_with_coordinates(cells), le10_shape, places, (2, 0, 0.6), 1)
        for cells in ((4, 6, 2), (2, 3, 1))
    )
    assert found.value == pytest.approx(-5.38, rel=0.02)
    for each in (found, coarse):
        assert abs(each.value + 5.38) < each.bar < 3 * abs(each.value + 5.38) and "mesh cancels" in each.doubts


def le11_shape(x: np.ndarray) -> np.ndarray:
    q, t, s = x.T
    inner = lambda s: (  # noqa: E731 - r and z, s from 0 at the equator to 4 at the top
        np.where(s < 2, np.cos(np.pi / 8 * np.minimum(s, 2)), 0.5**0.5),
        np.where(s < 2, np.sin(np.pi / 8 * np.minimum(s, 2)), 0.5**0.5 + (s - 2) / 2 * (1.79 - 0.5**0.5)),
    )
    knots = [1.4 * np.cos(np.pi / 6), 1.0, 1.0], [1.4 * np.sin(np.pi / 6), 1.39, 1.79]
    outer = lambda s: [  # noqa: E731
        np.where(s < 1, 1.4 * turn(np.pi / 6 * np.minimum(s, 1)), np.interp(s, (1, 3, 4), knots[k]))
        for k, turn in enumerate((np.cos, np.sin))
    ]
    r, z = (a + q * (b - a) for a, b in zip(inner(s), outer(s)))
    return np.stack([r * np.cos(np.pi / 2 * t), r * np.sin(np.pi / 2 * t), z], 1)


def le11(cells=(3, 6, 8)) -> ds.Scene:
    """A thick shell of revolution, heated to T = r + z; its section follows a sphere, a cone and a cylinder."""
    return le11_with_coordinates(cells)[0]


def le11_with_coordinates(cells) -> tuple[ds.Scene, np.ndarray]:
    box = graded_box(cells, (1, 1, 4))
    mesh = with_vertices(box, le11_shape(box.vertices))
    x = mesh.vertices[mesh.tetrahedra]
    heated = ds.Grown(ds.LinearElastic(E=210e9, nu=0.3), 2.3e-4 * (np.hypot(x[..., 0], x[..., 1]) + x[..., 2]).mean(1))
    fixed = {"ymin": "y", "ymax": "x", "zmin": "z", "zmax": "z"}
    return ds.Scene(mesh, heated, fixed=fixed, precision="f64"), box.vertices


def test_le11_has_its_target_within_its_error_bar():
    places = grid((0.5, 0.1, 0.3), (0.034, 0.00455, 0.0159))
    found = bar_of_mean(*le11_with_coordinates((2, 4, 8)), le11_shape, places, (1, 0, 0), 2)
    assert found.value == pytest.approx(-105, rel=0.02) and abs(found.value + 105) < found.bar < 0.03 * 105


def test_le11():
    assert stress_at(le11(), (1, 0, 0), 2, "vertices") == pytest.approx(-105e6, rel=0.02)


@pytest.mark.parametrize("of", ([], range(20)))
@pytest.mark.parametrize("order", [1, 2])
def test_recovery_knows_polynomials_and_errs_less_than_means(order, of):
    mesh = ds.TetrahedralMesh.create_box(4, 1.0, "five")
    mesh = with_vertices(mesh, mesh.vertices + 0.1 * np.sin(3 * mesh.vertices[:, [1, 2, 0]]))
    mesh = mesh if order == 1 else mesh.quadratic()
    recovery, element = PatchRecovery(mesh, np.array(of, int)), mesh.reference
    x = np.einsum("qa,eai->eqi", element.functions(element.points), mesh.vertices[mesh.elements]).reshape(-1, 3)
    field = lambda x: 1 + x @ [1, 2, -3] + (order > 1) * (x[:, 0] * x[:, 1] - 2 * x[:, 2] ** 2)  # noqa: E731
    found = recovery.value(field(x)[None, :, None], recovery.shares(mesh.vertices))[0, :, 0]
    np.testing.assert_allclose(found, field(mesh.vertices), atol=1e-9)

    wave = lambda x: np.sin(2 * x[:, 0]) * np.exp(x[:, 1] - x[:, 2])  # noqa: E731
    means, by_volume = PointMeans.of_vertices(mesh, np.array(of, int)), np.ones(len(x))
    errors = [
        np.abs(kind.value(wave(x)[None, :, None], shares)[0, :, 0] - wave(mesh.vertices)).mean()
        for kind, shares in ((recovery, recovery.shares(mesh.vertices)), (means, by_volume))
    ]
    assert errors[0] < 0.5 * errors[1]


def test_a_cut_carries_what_lies_beyond_it():
    mesh = ds.TetrahedralMesh.create_box((7, 3, 3), (0.6, 0.1, 0.1)).quadratic()
    end = ds.Traction((2e3, 0, 500.0), "xmax")
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=end, fixed="xmin", precision="f64")
    about = np.array([0.1, 0.2, 0.3])
    cuts = [((x, 0, 0), (1, 0.2 * x, -0.1)) for x in (0.15, 0.42)]
    outputs = [
        ds.SectionForce(*cut, f"{name}{k}", at)
        for k, cut in enumerate(cuts)
        for name, at in (("f", None), ("m", about))
    ]
    outputs.append(ds.Reaction("xmin", "moment", about))
    frames = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-13), 1, outputs=outputs).forward()
    for k in range(2):
        assert frames[f"f{k}"][-1] == pytest.approx([20.0, 0, 5.0], abs=1e-9)
        assert frames[f"m{k}"][-1] == pytest.approx(-frames["moment"][-1], abs=1e-9)
    with pytest.raises(ValueError, match="does not cut the body"):
        ds.SectionForce((0.7, 0, 0), (1, 0, 0)).settled(scene)
