"""Tractions, follower pressures and body forces: totals and closed forms, over time, and every derivative of theirs."""

import numpy as np
import pytest
from test_every_adjoint import assert_transposed
from test_gradients import random_mesh
from test_term_order import SOLVERS

import diffsim_ti as ds
from diffsim_ti.mechanics.pressure.follower_pressure import FollowerPressure, is_symmetric
from diffsim_ti.solvers.implicit.linear import Operator, gmres

STEPS = 4
TIMES = np.array([0.0, 0.003, 0.1])


def lidded(resolution=2) -> ds.TetrahedralMesh:
    return random_mesh(resolution).with_surface_set("lid", lambda x, n: x[:, 0] > 0.6)


def loads(steps=STEPS) -> list:
    """Of each kind what is constant, what is given for each step, and what is linear within steps; several of a kind."""
    rng = np.random.default_rng(1)
    return [
        ds.Pressure(300 * rng.normal(size=steps), "lid"),
        ds.Pressure(lambda t: 500 + 2e5 * t),
        ds.Pressure(400.0, name="gauge"),
        ds.Traction((TIMES, 1e3 * rng.normal(size=(3, 3))), "lid"),
        ds.Traction([0, 100.0, 0]),
        ds.BodyForce(1e3 * rng.normal(size=(steps, 3))),
        ds.BodyForce(lambda t: [0, 10 + t, 0], per="mass"),
        ds.ExternalForce(50 * rng.normal(size=(steps, 3, 3)), [1, 5, 6]),
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


def solver_of(kind, of: ds.Scene):
    exact = {} if kind.explicit else dict(tolerance=1e-12 if of.precision == "f64" else 1e-6)
    return (
        kind(of, load_steps=2, dt=2e-3, **exact) if kind is ds.StaticSolver else kind(of, dt=2e-3, substeps=2, **exact)
    )


def rollout_of(kind, terms, precision="f64", steps=STEPS, **options) -> ds.Rollout:
    solver = solver_of(kind, scene(terms, precision, **options))
    return ds.Rollout(solver, steps, save_every=2, gradients="all")


every = pytest.mark.parametrize("kind", SOLVERS, ids=lambda s: s.__name__)


@pytest.mark.executed_ptx
@pytest.mark.parametrize(
    "kind, precision",
    [(kind, "f64") for kind in SOLVERS]
    + [(kind, "f32") for kind in (ds.VelocityVerletSolver, ds.ImplicitEulerSolver, ds.StaticSolver)],
)
def test_every_number_of_a_load(kind, precision):
    """By a dot product each, with a free edge of the surface; f32 in one solver of each family."""
    gate = (1e-12 if kind.explicit else 1e-8) if precision == "f64" else (3e-5 if kind.explicit else 1e-3)
    assert_transposed(rollout_of(kind, loads(), precision), gate, ("drag_rate",) if kind is ds.StaticSolver else ())


@pytest.mark.parametrize(
    "kind", [ds.SemiImplicitSolver, ds.VelocityVerletSolver, ds.StaticSolver], ids=lambda s: s.__name__
)
def test_gradients_against_differences(kind):
    names = ("pressure", "pressure_2", "gauge.pressure", "traction", "body_force_2", "rest_positions")
    rollout = rollout_of(kind, loads(), steps=2)
    table = ds.check_gradients(rollout, inputs=names if kind.explicit else names[1:4:2])
    assert all(row.relative_error < 1e-5 for row in table.rows), table


@every
def test_a_simulator_takes_the_loads_of_each_step(kind):
    rollout = rollout_of(kind, loads())
    sim = ds.Simulator(rollout.solver)
    expected = rollout.forward().positions[-1]
    for _ in range(2):
        sim.run(STEPS)
        np.testing.assert_allclose(sim.positions, expected, rtol=0, atol=1e-10)
        sim.reset()


def test_a_simulator_takes_the_forces_of_each_step_beside_other_loads():
    """A single ExternalForce is read as it is given, whatever else has rows of steps."""
    forces = np.random.default_rng(3).normal(size=(3, lidded().num_vertices, 3))
    solver = ds.SemiImplicitSolver(scene([ds.ExternalForce(forces), ds.Pressure(10.0, "lid")]), dt=1e-3)
    simulator = ds.Simulator(solver)
    simulator.run(3)
    np.testing.assert_array_equal(simulator.positions, ds.Rollout(solver, 3).forward().positions[-1])


def test_a_simulator_beyond_the_loads_says_so():
    sim = ds.Simulator(ds.VelocityVerletSolver(scene([ds.Pressure([1.0, 2.0], "lid")]), dt=1e-3))
    sim.run(2)
    with pytest.raises(ValueError, match="pressure is given for 2 steps, this is step 2"):
        sim.step()


def first_push(terms, kind=ds.SemiImplicitSolver) -> np.ndarray:
    """Momentum [N s] per time that the first step gives to each free vertex of a body at rest: the forces there."""
    mesh = lidded(3)
    of = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, precision="f64")
    sim = ds.Simulator(kind(of, dt=1e-6))
    sim.step()
    mass = of.inputs.derive(of.inputs.values).mass
    return mass[:, None] * sim.velocities / 1e-6


def areas(mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.surface_triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def test_totals_are_exact():
    mesh = lidded(3)
    lid = areas(mesh)[mesh.surface_sets["lid"]]
    t, b = np.array([3.0, -2.0, 5.0]), np.array([10.0, 20.0, -5.0])
    np.testing.assert_allclose(
        first_push([ds.Traction(t, "lid")]).sum(0), t * np.linalg.norm(lid, axis=1).sum(), rtol=1e-9
    )
    np.testing.assert_allclose(first_push([ds.Pressure(7.0, "lid")]).sum(0), -7 * lid.sum(0), rtol=1e-9)
    np.testing.assert_allclose(first_push([ds.BodyForce(b)]).sum(0), b * mesh.volume, rtol=1e-9)
    core = mesh.with_tetrahedron_set("core", mesh.centroids[:, 0] < 0.5)
    assert 0 < len(core.tetrahedron_sets["core"]) < mesh.num_tetrahedra
    part = first_push([ds.BodyForce(b, np.arange(5))]).sum(0)
    np.testing.assert_allclose(part, b * mesh.volumes[:5].sum(), rtol=1e-9)
    moment = np.cross(mesh.vertices, first_push([ds.Pressure(7.0)])).sum(0)  # of a closed surface: none, and no force
    assert np.abs(first_push([ds.Pressure(7.0)]).sum(0)).max() < 1e-9 > np.abs(moment).max()
    outwards = (first_push([ds.Pressure(-7.0, "lid")]) * lid.sum(0)).sum()
    assert outwards > 0
    np.testing.assert_allclose(first_push([ds.BodyForce(b, per="mass")]), first_push([ds.Gravity(b)]), rtol=1e-8)


@every
def test_loads_of_a_kind_add_up(kind):
    t, f = np.array([30.0, -20.0, 50.0]), np.random.default_rng(3).normal(size=(2, 3, 3))
    two = [ds.Traction(t, "lid"), ds.Traction(-2 * t, "lid"), ds.Pressure(300.0), ds.Pressure(-700.0)]
    two += [ds.ExternalForce(x, [1, 5, 6]) for x in f]
    one = [ds.Traction(-t, "lid"), ds.Pressure(-400.0), ds.ExternalForce(f.sum(0), [1, 5, 6])]
    got, expected = (rollout_of(kind, terms).forward().positions[-1] for terms in (two, one))
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_linear_within_steps(kind):
    """A body that nothing holds: b = a + c t gives it the velocity (a + c t / 2) t / rho, exactly in velocity Verlet, and
    half a substep ahead in backward Euler."""
    mesh, a, b, dt = lidded(), 20.0, 4e3, 1e-3
    of = ds.Scene(
        mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, [ds.BodyForce(lambda t: [0, a + b * t, 0])], precision="f64"
    )
    substeps = 3
    exact = {} if kind.explicit else dict(tolerance=1e-12)
    frames = ds.Rollout(kind(of, dt=dt, substeps=substeps, **exact), 5).forward()
    T = 5 * dt
    late = 0.0 if kind.explicit else dt / substeps / 2
    expected = (a * T + b * T * (T / 2 + late)) / 1000
    np.testing.assert_allclose(frames.velocities[-1][:, 1], expected, rtol=1e-7)


def ball(mesh):
    return mesh.surface_triangles, np.zeros(len(mesh.surface_triangles), int)


def test_a_closed_surface_has_a_potential_and_an_open_one_has_none():
    mesh, rng = lidded(3), np.random.default_rng(4)
    free = np.tile(np.eye(3), (mesh.num_vertices, 1, 1))
    triangles, load_of = ball(mesh)
    x = mesh.vertices
    v, w = rng.normal(size=(2, *x.shape))

    def volume(x):
        a, b, c = (x[triangles[:, k]] for k in range(3))
        return (np.cross(a, b) * c).sum() / 6

    for own, closed in ((triangles, True), (triangles[mesh.surface_sets["lid"]], False)):
        pressure = FollowerPressure(own, load_of[: len(own)], mesh.num_vertices).at([5.0])
        one, other = (w * pressure.jvp(x, v)).sum(), (v * pressure.jvp(x, w)).sum()
        assert is_symmetric(own, load_of[: len(own)], free, x) == closed
        assert (abs(one - other) < 1e-12 * abs(one)) == closed
        np.testing.assert_allclose((v * pressure.vjp(x, w)[0]).sum(), one, rtol=1e-12)
        difference = (pressure.forces(x + 1e-6 * v) - pressure.forces(x - 1e-6 * v)) / 2e-6
        np.testing.assert_allclose(pressure.jvp(x, v), difference, rtol=0, atol=1e-7)
        if closed:
            step = 0.3 * v
            np.testing.assert_allclose(pressure.work(x, step), -5 * (volume(x + step) - volume(x)), rtol=1e-12)
    held = free.copy()
    lid = triangles[mesh.surface_sets["lid"]]
    held[np.unique(lid)] = np.diag([0.0, 1.0, 1.0])  # its edge may move in a plane that it lies in
    assert is_symmetric(lid, load_of[: len(lid)], held, np.where(np.arange(3) == 0, 1.0, x))


def blown(kind=ds.StaticSolver, **options) -> ds.Rollout:
    """A block on its side, under a pressure on one side that bends it far: nothing there is symmetric."""
    mesh = ds.TetrahedralMesh.create_box((6, 3, 3), (1.0, 0.2, 0.2), pattern="five")
    of = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, [ds.Pressure(800.0, "ymax")], "xmin", precision="f64")
    return ds.Rollout(kind(of, tolerance=1e-11, **options), 1, gradients="all")


def test_an_open_surface_in_statics():
    """The equilibrium balances its forces, whatever found it; no symmetric solve finds the gradient of it."""
    rollout = blown()
    frames = rollout.forward()
    assert frames.displacements[-1].min() < -0.2  # far
    newton = rollout.sweep.workspace.newton
    assert newton.by_residual and len(newton.report.residuals) < 20
    other = blown(load_steps=3).forward()
    np.testing.assert_allclose(frames.positions, other.positions, rtol=0, atol=1e-9)
    assert ds.dot_product_test(rollout) < 1e-8
    row = ds.check_gradients(rollout, inputs=("pressure",)).rows[0]
    assert row.relative_error < 2e-5


def test_a_forgotten_transpose_would_be_found(monkeypatch):
    """The mutation that the dot product above is there for."""
    made = Operator.__init__

    def forgetful(self, potential, mass, free, others, transposed=False):
        made(self, potential, mass, free, others)

    monkeypatch.setattr(Operator, "__init__", forgetful)
    assert ds.dot_product_test(blown()) > 1e-4


def test_gmres_solves_what_is_not_symmetric():
    rng = np.random.default_rng(5)
    A = np.eye(60) * 4 + rng.normal(size=(60, 60)) * 0.3
    b = rng.normal(size=(20, 3))
    for restart in (80, 7):
        x, residual, count = gmres(lambda v: (A @ v.ravel()).reshape(-1, 3), b, lambda r: r / 4, 1e-10, 500, restart)
        assert residual <= 1e-10 and count < 120
        np.testing.assert_allclose(A @ x.ravel(), b.ravel(), atol=1e-8)


MISTAKES = {
    "no such set": (lambda: scene([ds.Pressure(1.0, "roof")]), "no surface set is called 'roof'; there are: lid|xmin"),
    "traction's shape": (
        lambda: ds.Traction([1.0, 2.0]),
        r"Traction: traction must have shape \(3,\) or \(steps, 3\), got \(2,\)",
    ),
    "pressure nan": (lambda: ds.Pressure(np.nan), "Pressure: pressure must be finite"),
    "per": (lambda: ds.BodyForce([0, 0, 1], per="area"), 'per must be "volume"'),
    "keyframes": (
        lambda: ds.Pressure(([0.0, 1.0], [1.0, 2.0, 3.0])),
        r"need values of shape \(2,\) for 2 times, got \(3,\)",
    ),
    "keyframe times": (lambda: ds.Pressure(([0.0, 0.0], [1.0, 2.0])), "keyframe times must increase"),
    "function": (
        lambda: ds.Traction(lambda t: [1.0, t]),
        r"must be finite and of shape \(3,\) at each time, got shape \(2,\)",
    ),
    "empty": (lambda: scene([ds.Pressure(1.0, np.zeros(len(lidded().surface_triangles), bool))]), "acts on nothing"),
    "too few steps": (
        lambda: ds.Rollout(ds.VelocityVerletSolver(scene([ds.Pressure([1.0, 2.0])]), dt=1e-3), 3).forward(),
        "pressure: 3 steps need as many rows, got 2",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_refused(mistake):
    make, message = MISTAKES[mistake]
    with pytest.raises(ValueError, match=message):
        make()
