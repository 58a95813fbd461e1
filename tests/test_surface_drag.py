"""A fluid on the surface: closed forms, every derivative in every solver, energy, momentum, what is refused."""

import numpy as np
import pytest
from test_every_adjoint import assert_transposed
from test_muscles import mesh_of
from test_term_order import SOLVERS

import diffsim_ti as ds

MOVING = [kind for kind in SOLVERS if kind is not ds.StaticSolver]


def rollout_of(kind, **options) -> ds.Rollout:
    mesh, rng = mesh_of(), np.random.default_rng(2)
    rows = np.arange(len(mesh.surface_triangles) // 2)
    terms = [
        ds.SurfaceDrag(900.0, 1.2, 0.3, [0.4, -0.2, 0.1]),
        ds.SurfaceDrag(300.0, 0.7, 0.9, surface=rows, name="oil"),
        ds.Gravity(),
        ds.Drag(2.0),
        ds.Pressure(200.0),
    ]
    start = dict(fixed="xmin", initial_positions=mesh.vertices + 0.01 * rng.normal(size=mesh.vertices.shape))
    start |= dict(initial_velocities=rng.normal(size=mesh.vertices.shape))
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, precision="f64", **start | options)
    exact = {} if kind.explicit else dict(tolerance=1e-12)
    return ds.Rollout(kind(scene, dt=2e-3, substeps=4, **exact), 3, save_every=1, gradients="all")


@pytest.mark.parametrize("kind", MOVING)
def test_every_number(kind):
    assert_transposed(rollout_of(kind), 1e-11 if kind.explicit else 1e-8)


NUMBERS = ["water_density", "normal_drag", "tangential_drag", "stream", "oil.density", "oil.stream"]
NUMBERS += ["initial_velocities", "rest_positions"]


@pytest.mark.parametrize(
    "kind, names",
    [
        (ds.VelocityVerletSolver, NUMBERS),
        (ds.BDF2Solver, NUMBERS[1:8:3]),
        pytest.param(ds.BDF2Solver, NUMBERS, marks=pytest.mark.thorough),
    ],
)
def test_gradients_against_differences(kind, names):
    table = ds.check_gradients(rollout_of(kind), inputs=names)
    assert all(row.relative_error < 1e-5 for row in table.rows), table
