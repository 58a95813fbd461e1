"""Designs: tangents and adjoints, harmonic insides, smooth gradients, volume, guarded steps."""

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.designs import (
    Cage,
    SurfaceDisplacement,
    guarded_step,
    rest_volume,
    smallest_ratio,
    smoothed,
    tangential,
)

MESH = ds.TetrahedralMesh.create_box([5, 4, 4], [0.6, 0.2, 0.2])
RNG = np.random.default_rng(0)


@pytest.mark.parametrize("kind", ["cage", "cage of ten nodes", "surface"])
def test_tangents_and_adjoints(kind):
    mesh = MESH.quadratic() if "ten" in kind else MESH
    design = SurfaceDisplacement(mesh) if kind == "surface" else Cage(mesh, (3, 2, 4))
    d, w = RNG.standard_normal(design.shape), RNG.standard_normal(mesh.vertices.shape)
    assert (w * design.jvp(d)).sum() == pytest.approx((design.vjp(w) * d).sum(), rel=1e-12)
    np.testing.assert_allclose(design.value(0 * d), mesh.vertices)
    np.testing.assert_allclose(design.value(d) - mesh.vertices, design.jvp(d))
    np.testing.assert_allclose(design.jvp(np.ones(design.shape)), 1.0)  # a translation stays one


def test_the_inside_follows_linear_maps():
    design, A = SurfaceDisplacement(MESH), RNG.standard_normal((3, 3))
    np.testing.assert_allclose(design.jvp(MESH.vertices[design.surface] @ A.T), MESH.vertices @ A.T, atol=1e-12)
    with pytest.raises(ValueError, match=r"mesh\.linear\(\)"):
        SurfaceDisplacement(MESH.quadratic())


def test_gradients_by_the_cage_are_those_of_the_rest_shape():
    scene = ds.Scene(MESH, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity()], fixed="xmin", precision="f64")
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-3), 20, gradients=["rest_positions", "initial_positions"])
    cage, d = Cage(MESH, (2, 2, 2)), 0.01 * RNG.standard_normal((2, 2, 2, 3))
    change = RNG.standard_normal(d.shape)

    def run(d):
        X = cage.value(d)
        return rollout.forward(rest_positions=X, initial_positions=X)

    frames, eps = run(d), 1e-6
    w = RNG.standard_normal(frames.positions.shape)
    found = rollout.vjp(frames, w)
    analytic = (cage.vjp(found["rest_positions"] + found["initial_positions"]) * change).sum()
    differences = (w * (run(d + eps * change).positions - run(d - eps * change).positions)).sum() / (2 * eps)
    assert analytic == pytest.approx(differences, rel=1e-6)


def test_smooth_gradients_descend_and_are_smooth():
    raw = np.random.default_rng(1).standard_normal(MESH.vertices.shape)
    g = smoothed(MESH, raw, 0.2)
    assert (g * raw).sum() > 0
    edges = MESH.tetrahedra[:, :2].T
    rough = lambda x: np.abs(x[edges[0]] - x[edges[1]]).mean() / np.abs(x).mean()  # noqa: E731
    assert rough(g) < 0.5 * rough(raw)


def test_volume_and_guard():
    cage = Cage(MESH, (3, 2, 2))
    d, change, eps = 0.02 * RNG.standard_normal(cage.shape), RNG.standard_normal(cage.shape), 1e-6
    volume, gradient = rest_volume(MESH, MESH.vertices)
    assert volume == pytest.approx(0.024) and smallest_ratio(MESH, MESH.vertices) == pytest.approx(1)
    _, by = rest_volume(MESH, cage.value(d))
    ends = [rest_volume(MESH, cage.value(d + s * eps * change))[0] for s in (1, -1)]
    assert (cage.vjp(by) * change).sum() == pytest.approx((ends[0] - ends[1]) / (2 * eps), rel=1e-7)
    held = tangential(change, cage.vjp(gradient))
    assert (cage.vjp(gradient) * held).sum() == pytest.approx(0, abs=1e-12)
    step = guarded_step(cage, 0 * d, 5 * change, least=0.3)
    assert 0.3 <= smallest_ratio(MESH, cage.value(step)) < 1 and np.abs(step).max() > 0
    with pytest.raises(ValueError, match="before the step"):
        guarded_step(cage, 5 * change, d)
