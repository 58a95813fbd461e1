"""Springs, cables and elastic foundations: closed forms, every derivative, the stable step, energy."""

import numpy as np
import pytest
from test_every_adjoint import assert_transposed
from test_gradients import random_mesh
from test_term_order import SOLVERS

import diffsim_ti as ds

STEPS = 4
TIMES = np.array([0.0, 0.003, 0.1])
every = pytest.mark.parametrize("kind", SOLVERS, ids=lambda s: s.__name__)


def lidded() -> ds.TetrahedralMesh:
    return random_mesh(2).with_surface_set("lid", lambda x, n: x[:, 0] > 0.6)


def inside(mesh, tetrahedron=0, weights=(0.1, 0.2, 0.3, 0.4)) -> np.ndarray:
    """A place [m] in a tetrahedron."""
    return np.array(weights) @ mesh.vertices[mesh.tetrahedra[tetrahedron]]


def attached(mesh, steps=STEPS) -> list:
    """Springs and cables of every spelling, and foundations, over time in every way, beside loads."""
    rng, a, b = np.random.default_rng(1), inside(mesh), inside(mesh, 3)
    above = np.array([0.5, 1.5, 0.4])
    return [
        ds.Spring([7, 5], 2, [900.0, 700.0], rest_length=[0.7, 0.9]),
        ds.Spring(np.stack([a, b]), ds.Anchor([above, -above]), 800.0, tension=[60.0, -30.0], name="struts"),
        ds.Spring(6, ds.Anchor(mesh.vertices[6]), 500.0),  # without length
        ds.Cable([1, b, 5, ds.Anchor(above)], tension=40 * rng.uniform(size=steps)),
        ds.Cable([3, a, 7], length=lambda t: 1.2 - 20 * t, stiffness=2000.0),
        ds.Cable([0, 7], length=(TIMES, [5.0, 4.9, 5.2]), stiffness=900.0, name="slack"),
        ds.Cable([ds.Anchor(2 * above), 6, ds.Anchor(-above), 7], tension=(TIMES, [10.0, 30.0, 50.0]), name="tendon"),
        ds.ElasticFoundation(3e3, 2e3 * rng.uniform(size=5), "lid"),
        ds.ElasticFoundation(2e3, 0.0, name="bed"),
        ds.Pressure(lambda t: 500 + 2e4 * t, "lid"),
        ds.ExternalForce([0.0, 1.0, 0.0], [2, 7]),
        ds.Drag(2.0),
    ]


def scene(terms, precision="f64", mesh=None, **options) -> ds.Scene:
    mesh, rng = lidded() if mesh is None else mesh, np.random.default_rng(2)
    m = mesh.num_tetrahedra
    law = ds.StableNeoHookean(1e5 * rng.uniform(0.7, 1.3, m), 0.3)
    start = mesh.vertices + 0.01 * rng.normal(size=mesh.vertices.shape)
    options = dict(fixed="xmin", initial_positions=start) | options
    return ds.Scene(mesh, law, 1000 * rng.uniform(0.8, 1.2, m), terms, precision=precision, **options)


def solver_of(kind, of: ds.Scene, dt=2e-3):
    exact = {} if kind.explicit else dict(tolerance=1e-12 if of.precision == "f64" else 1e-6)
    return kind(of, load_steps=2, dt=dt, **exact) if kind is ds.StaticSolver else kind(of, dt=dt, substeps=2, **exact)


def rollout_of(kind, terms, precision="f64", steps=STEPS, **options) -> ds.Rollout:
    return ds.Rollout(solver_of(kind, scene(terms, precision, **options)), steps, save_every=2, gradients="all")


@pytest.mark.parametrize(
    "kind, precision",
    [(kind, "f64") for kind in SOLVERS]
    + [(kind, "f32") for kind in (ds.VelocityVerletSolver, ds.ImplicitEulerSolver, ds.StaticSolver)],
)
def test_every_number(kind, precision):
    """By a dot product each, in f32 in one solver of each family; a slack cable is not felt."""
    gate = (1e-12 if kind.explicit else 1e-8) if precision == "f64" else (3e-5 if kind.explicit else 1e-3)
    unfelt = ("slack.length", "slack.stiffness") + (("drag_rate",) if kind is ds.StaticSolver else ())
    assert_transposed(rollout_of(kind, attached(lidded()), precision), gate, unfelt)
