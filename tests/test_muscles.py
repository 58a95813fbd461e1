"""Muscles: the closed form of a bar, every derivative in every solver, momentum, long steps, errors."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_every_adjoint import assert_transposed
from test_gradients import random_mesh
from test_term_order import SOLVERS

import diffsim_ti as ds
from diffsim_ti.solvers.explicit.kernels import ExplicitKernels, explicit_kernels
from diffsim_ti.solvers.explicit.vertex_parts import ItemForces

STEPS = 3


def mesh_of(order: int = 1) -> ds.TetrahedralMesh:
    mesh = random_mesh(2)
    m = mesh.num_tetrahedra
    mesh = mesh.with_tetrahedron_set("left", np.arange(m // 2)).with_tetrahedron_set("right", np.arange(m // 2, m))
    return mesh.quadratic() if order == 2 else mesh


def muscles(mesh) -> list:
    """Every spelling of activations."""
    rng, m = np.random.default_rng(1), mesh.num_tetrahedra
    fibres = rng.normal(size=(m, 3))
    return [
        ds.Muscle([1, 0.2, 0], 2e4, (np.array([0.0, 0.003, 0.1]), np.array([0.2, 0.6, 1.0])), name="keyed"),
        ds.Muscle([0, 1, 0], [1e4, 2e4], rng.uniform(size=(STEPS, 2)), ["left", "right"], per="set", name="pair"),
        ds.Muscle(fibres, 1e4, rng.uniform(size=m), per="tetrahedron"),
        ds.Muscle([0, 0, 1], 8e3, lambda t: np.full(2, 0.3 + 20 * t), ["right", "left"], per="set", name="wave"),
        ds.Gravity(),
    ]


def rollout_of(kind, terms=None, order=1, steps=STEPS, precision="f64", gradients="all", **options) -> ds.Rollout:
    mesh, rng = mesh_of(order), np.random.default_rng(2)
    start = mesh.vertices + 0.01 * rng.normal(size=mesh.vertices.shape)
    options = dict(fixed="xmin", initial_positions=start) | options
    law, terms = ds.StableNeoHookean(1e5, 0.3), muscles(mesh) if terms is None else terms
    scene = ds.Scene(mesh, law, 1000.0, terms, precision=precision, **options)
    exact = {} if kind.explicit else dict(tolerance=1e-12)
    static = kind is ds.StaticSolver
    solver = kind(scene, load_steps=2, dt=2e-3, **exact) if static else kind(scene, dt=2e-3, substeps=4, **exact)
    return ds.Rollout(solver, steps, save_every=1, gradients=gradients)


@pytest.mark.parametrize("kind", SOLVERS)
def test_every_number(kind):
    """By a dot product each: activations of every spelling, stresses, the rest shape."""
    assert_transposed(rollout_of(kind), 1e-11 if kind.explicit else 1e-8)


@pytest.mark.parametrize(
    "kind, order, precision", [(ds.VelocityVerletSolver, 1, "f64"), (ds.SemiImplicitSolver, 2, "f32")]
)
def test_eight_fibres_at_once_are_eight_fibres(kind, order, precision, monkeypatch):
    """To the last digit, forward and in both derivatives, whatever stands beside them, and how many are left over."""
    mesh, rng = mesh_of(order), np.random.default_rng(4)
    some = rng.permutation(mesh.num_tetrahedra)[:11]
    beside = [ds.Muscle([1, 0, 1], 1e4, 0.5, some, name="few"), ds.Spring(0, ds.Anchor([2.0, 0, 0]), 1e3)]
    beside += [ds.Pressure(100.0), ds.Cable([0, 5, 7], 5.0)]
    found = []
    for blocks in (True, False):
        with monkeypatch.context() as patch:
            if not blocks:
                one_by_one = property(lambda self: ItemForces(self.vertex.features))
                patch.setattr(ExplicitKernels, "items", one_by_one)
                explicit_kernels.cache_clear()
            rollout = rollout_of(kind, beside + muscles(mesh), order, precision=precision, gradients=None)
            frames, seed = rollout.forward(), np.random.default_rng(5)
            by = rollout.vjp(frames, *seed.normal(size=(2, *frames.positions.shape)))
            change = {name: seed.normal(size=np.shape(rollout.values[name])) for name in by}
            moved = rollout.jvp(frames, **change)
            found.append([frames.positions, *moved, *by.values()])
    explicit_kernels.cache_clear()
    assert all(np.array_equal(x, y) for x, y in zip(*found, strict=True))


def test_gradients_against_differences():
    names = ["keyed.activation", "pair.activation", "pair.stress", "activation", "rest_positions"]
    table = ds.check_gradients(rollout_of(ds.VelocityVerletSolver, steps=STEPS), inputs=names)
    assert all(row.relative_error < 1e-5 for row in table.rows), table


@pytest.mark.parametrize("order", [1, 2])
def test_a_bar_shortens_as_its_closed_form_says(order):
    """With linear elasticity by alpha s / E, whatever the mesh, and no stress is left in it."""
    mesh, E, s = ds.TetrahedralMesh.create_cube(2, size=1.0), 1e5, 2e4
    mesh = mesh.quadratic() if order == 2 else mesh
    X = mesh.vertices
    low = X.min(0)
    fixed = {"xmin": "x", "ymin": "y", "zmin": "z"}
    scene = ds.Scene(mesh, ds.LinearElastic(E, 0.3), 1000.0, [ds.Muscle([2, 0, 0], s, 0.5)], fixed, precision="f64")
    u = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 1).forward().positions[-1] - X
    np.testing.assert_allclose(u, (X - low) * [-0.1, 0.03, 0.03], atol=1e-9)


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_momentum_stays_to_round_off(kind):
    frames = (rollout := rollout_of(kind, muscles(mesh_of())[:-1], fixed=None)).forward()
    m = rollout.scene.inputs.derive(rollout.scene.inputs.values).mass[:, None]
    v = frames.velocities[-1]
    size = np.abs(m * v).sum()
    assert size > 0.1 and np.linalg.norm((m * v).sum(0)) < 1e-10 * size
    if kind.explicit:
        half = frames.positions[-1]
        assert np.linalg.norm(np.cross(half, m * v).sum(0)) < 1e-10 * size


@pytest.mark.parametrize("kind", [ds.SemiImplicitSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_long_steps_gain_nothing(kind):
    """Fibres of 10 kPa, 80 steps of 2.5 ms: swings stay as wide as the first, or are damped."""
    mesh = ds.TetrahedralMesh.create_cube(2, size=0.1)
    scene = ds.Scene(mesh, ds.StableNeoHookean(3e4, 0.4), 1000.0, [ds.Muscle([1, 0, 0], 1e4, 1.0)], precision="f64")
    frames = ds.Rollout(kind(scene, dt=2.5e-3), 80, save_every=1).forward()
    speed = np.sqrt((frames.velocities**2).sum((1, 2)))
    assert speed[:40].max() > 0.1 and speed[40:].max() < (1.1 if kind.explicit else 0.8) * speed[:40].max()


@pytest.mark.parametrize(
    "options, words",
    [
        (dict(per="bone"), "per must be"),
        (dict(fibre=[0, 0, 0]), "directions"),
        (dict(activation=-0.1), "activation must be >= 0"),
        (dict(stress=-1.0), ">= 0"),
        (dict(tetrahedra="left", per="set"), "names of sets"),
        (dict(activation=np.ones(3), tetrahedra=["left", "right"], per="set"), "must have shape"),
        (dict(activation=np.ones(2), per="tetrahedron"), "activations of shape"),
        (dict(fibre=np.eye(3)[:2]), "2 directions"),
    ],
)
def test_what_does_not_fit_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        terms = [ds.Muscle(**(dict(fibre=[1, 0, 0], stress=1e4, activation=0.5) | options))]
        ds.Scene(mesh_of(), ds.StableNeoHookean(1e5, 0.3), 1000.0, terms)


@pytest.mark.parametrize("order", [1, 2])
def test_it_is_drawn_along_its_fibres(order):
    mesh = mesh_of(order)
    (lines,) = ds.Muscle([0, 2, 0], 1e4, 0.5, "left", name="calf").drawn(
        SimpleNamespace(mesh=mesh, positions=mesh.vertices)
    )
    along = lines.ends[:, 1] - lines.ends[:, 0]
    assert lines.label == "calf" and np.all(along[:, 1] > 0) and np.abs(along[:, [0, 2]]).max() < 1e-12
