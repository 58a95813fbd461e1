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


def le10(cells=(6, 8, 4)) -> ds.Scene:
    """A thick elliptic plate under pressure."""
    box = graded_box(cells, (1, 1, 1), 1.5, 1.3)
    r, t, z = box.vertices.T
    angle = np.pi / 2 * t
    mesh = with_vertices(box, np.stack([(2 + 1.25 * r) * np.cos(angle), (1 + 1.75 * r) * np.sin(angle), 0.6 * z], 1))
    mesh = mesh.with_vertex_set("edge", (r > 1 - 1e-9) & (np.abs(z - 0.5) < 1e-9))
    fixed = {"ymin": "y", "ymax": "x", "xmax": "xy", "edge": "z"}
    load = ds.Traction((0, 0, -1e6), "zmax")
    return ds.Scene(mesh, ds.LinearElastic(E=210e9, nu=0.3), terms=[load], fixed=fixed, precision="f64")


def test_le10():
    assert stress_at(le10(), (2, 0, 0.6), 1, "recovered") == pytest.approx(-5.38e6, rel=0.02)


def le11(cells=(3, 6, 8)) -> ds.Scene:
    """A thick shell of revolution, heated to T = r + z; its section follows a sphere, a cone and a cylinder."""
    box = graded_box(cells, (1, 1, 4))
    q, t, s = box.vertices.T
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
    mesh = with_vertices(box, np.stack([r * np.cos(np.pi / 2 * t), r * np.sin(np.pi / 2 * t), z], 1))
    x = mesh.vertices[mesh.tetrahedra]
    heated = ds.Grown(ds.LinearElastic(E=210e9, nu=0.3), 2.3e-4 * (np.hypot(x[..., 0], x[..., 1]) + x[..., 2]).mean(1))
    fixed = {"ymin": "y", "ymax": "x", "zmin": "z", "zmax": "z"}
    return ds.Scene(mesh, heated, fixed=fixed, precision="f64")


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
