"""Gradients through implicit steps and equilibria: the gates of the explicit ones, and those that only solves have."""

from functools import lru_cache

import numpy as np
import pytest
import taichi as ti

import diffsim_ti as ds
from diffsim_ti.solvers.implicit import recorded_passes

DYNAMIC = (ds.ImplicitEulerSolver, ds.ImplicitMidpointSolver, ds.BDF2Solver)
ALL = (*DYNAMIC, ds.StaticSolver)
LAWS = (ds.StableNeoHookean, ds.SmithNeoHookean, ds.Corotated, ds.MooneyRivlin, ds.StVenantKirchhoff, ds.LinearElastic)
dynamic = pytest.mark.parametrize("solver", DYNAMIC, ids=lambda s: s.__name__)
every = pytest.mark.parametrize("solver", ALL, ids=lambda s: s.__name__)


@lru_cache(maxsize=None)
def mesh() -> ds.TetrahedralMesh:
    return ds.TetrahedralMesh.create_box((3, 2, 2), (0.8, 0.4, 0.4))


def make(
    solver,
    law=ds.StableNeoHookean,
    steps=4,
    precision="f64",
    tolerance=1e-12,
    gradients="all",
    save_every=None,
    checkpoint_every=None,
    **changes,
) -> ds.Rollout:
    """Everything at once: damping, forces per step, moduli per tetrahedron, moving supports, a floor."""
    rng, m = np.random.default_rng(0), mesh()
    static = solver is ds.StaticSolver
    steps = 2 if static else steps
    terms = [ds.Gravity(), ds.Drag(0.7), ds.ExternalForce(20 * rng.standard_normal((steps, 2, 3)), [3, 7])]
    if not static:
        terms.append(ds.Ground(height=-0.03, stiffness=2e3, width=0.05))
    arguments = (
        dict(
            density=1000 + 100 * rng.random(m.num_tetrahedra),
            terms=terms,
            fixed="xmin",
            precision=precision,
            motion=lambda t: [0.03 * t, 0.05 * t * t, 0.02 * np.sin(t)],
            initial_velocities=0.3 * rng.standard_normal(m.vertices.shape),
        )
        | changes
    )
    E = 1e5 * (1 + rng.random(m.num_tetrahedra))
    numbers = {"E": E, "nu": 0.3}
    scene = ds.Scene(m, law(**numbers), **arguments)
    made = solver(scene, tolerance=tolerance) if static else solver(scene, dt=2e-2, tolerance=tolerance)
    return ds.Rollout(made, steps, save_every or max(steps // 2, 1), checkpoint_every, gradients=gradients)


@every
def test_every_input_agrees_with_differences(solver):
    report = ds.check_gradients(make(solver, steps=2), verbose=False)
    assert report.passed, str(report)


@pytest.mark.parametrize("law", LAWS[1:], ids=lambda law: law.__name__)
def test_moduli_and_state_of_every_law(law):
    rollout = make(ds.ImplicitEulerSolver, law, steps=1, gradients=["youngs_modulus", "initial_positions"])
    report = ds.check_gradients(rollout, verbose=False)
    assert report.passed, str(report)


@pytest.mark.executed_ptx
@every
def test_the_reverse_sweep_is_the_transpose_of_the_tangent(solver):
    """To the solver's tolerance: both are linear solves."""
    assert ds.dot_product_test(make(solver)) < 1e-9


@pytest.mark.executed_ptx
@dynamic
def test_checkpoints_give_the_same_bits(solver):
    results = []
    for every in (None, 1, 2, 3):
        rollout = make(solver, steps=6, checkpoint_every=every, gradients=None)
        frames = rollout.forward()
        weights = np.random.default_rng(1).standard_normal(frames.positions.shape)
        results.append(rollout.vjp(frames, weights, weights))
    for other in results[1:]:
        for name, gradient in results[0].items():
            np.testing.assert_array_equal(gradient, other[name])


@every
def test_float32_gradients_are_near_float64_ones(solver):
    gradients = []
    for precision, tolerance in (("f64", 1e-10), ("f32", 1e-6)):
        rollout = make(solver, precision=precision, tolerance=tolerance, gradients=None)
        frames = rollout.forward()
        weights = np.random.default_rng(1).standard_normal(frames.positions.shape)
        gradients.append(rollout.vjp(frames, weights))
    for name, exact in gradients[0].items():
        if np.abs(exact).max() > 0:
            assert np.abs(gradients[1][name] - exact).max() <= 1e-3 * np.abs(exact).max(), name


@dynamic
def test_a_second_run_and_a_second_backward_change_nothing(solver):
    rollout = make(solver, gradients=None)
    frames = rollout.forward()
    weights = np.ones(frames.positions.shape)
    first = rollout.vjp(frames, weights)
    rollout.forward(gravity=[0, -5.0, 0])
    again = rollout.vjp(frames, weights)
    for name in first:
        np.testing.assert_array_equal(first[name], again[name])


# ---- identities ---------------------------------------------------------------------------------------------------------


@dynamic
def test_identities_of_a_free_body(solver):
    """Sums over vertices of the gradients by start positions, start velocities and gravity; E and density together."""
    n, dt, m = 5, 1e-2, mesh()
    rng = np.random.default_rng(3)
    start = m.vertices + 0.02 * rng.standard_normal(m.vertices.shape)
    scene = ds.Scene(m, ds.StableNeoHookean(1e4, 0.3), terms=[ds.Gravity()], initial_positions=start, precision="f64")
    rollout = ds.Rollout(solver(scene, dt=dt, tolerance=1e-13), n)
    frames = rollout.forward()
    w = np.zeros(frames.positions.shape)
    w[-1] = rng.standard_normal(m.vertices.shape)
    g, total = rollout.vjp(frames, w), w[-1].sum(0)
    scale = np.abs(w).sum()
    np.testing.assert_allclose(g["initial_positions"].sum(0), total, atol=1e-10 * scale)
    np.testing.assert_allclose(g["initial_velocities"].sum(0), n * dt * total, atol=1e-10 * scale)
    if solver is not ds.BDF2Solver:
        times = n * (n + 1) / 2 if solver is ds.ImplicitEulerSolver else n**2 / 2
        np.testing.assert_allclose(g["gravity"], dt**2 * times * total, atol=1e-10 * scale)
    by_E, by_density = 1e4 * g["youngs_modulus"], 1000 * g["density"]
    assert abs(by_E + by_density) <= 1e-9 * abs(by_E)


def test_statics_under_dead_loads_scale():
    """E du/dE + f du/df + g du/dg = 0."""
    m = mesh()
    scene = ds.Scene(
        m,
        ds.StableNeoHookean(1e5, 0.3),
        terms=[ds.Gravity(), ds.ExternalForce([5.0, -40, 10], [3])],
        fixed="xmin",
        precision="f64",
    )
    rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 1)
    frames = rollout.forward()
    w = np.random.default_rng(0).standard_normal(frames.positions.shape)
    w[0] = 0
    g, v = rollout.vjp(frames, w), scene.inputs.values
    parts = [(v[name] * g[name]).sum() for name in ("youngs_modulus", "external_forces", "gravity")]
    assert abs(sum(parts)) <= 1e-10 * max(map(abs, parts))
    np.testing.assert_allclose(g["initial_velocities"], 0)


def test_gradient_of_the_static_twin_of_the_oscillator():
    """u = f h^2 / (mu V): E du/dE = -u, f du/df = u."""
    X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.25, 0.25, 0.5]])
    m, E, force = ds.TetrahedralMesh(X, np.array([[0, 1, 2, 3]])), 1e5, 2000.0
    scene = ds.Scene(
        m, ds.StableNeoHookean(E, 0.3), terms=[ds.ExternalForce([force, 0, 0], [3])], fixed=[0, 1, 2], precision="f64"
    )
    rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-13), 1)
    frames = rollout.forward()
    w = np.zeros((2, 4, 3))
    w[1, 3, 0] = 1
    g, u = rollout.vjp(frames, w), force * 0.25 / (E / 2.6 * m.volumes[0])
    assert E * g["youngs_modulus"] == pytest.approx(-u, rel=1e-9)
    assert force * g["external_forces"][0, 0] == pytest.approx(u, rel=1e-9)
    assert g["poissons_ratio"] == pytest.approx(u / 1.3, rel=1e-9)  # mu = E / 2 / (1 + nu)


# ---- what only solves have ------------------------------------------------------------------------------------------------


def test_errors_fall_with_the_tolerance():
    exact, errors = None, []
    for tolerance in (1e-13, 1e-2, 1e-4, 1e-6, 1e-8):
        rollout = make(ds.ImplicitEulerSolver, tolerance=tolerance, gradients=["youngs_modulus", "initial_positions"])
        frames = rollout.forward()
        weights = np.random.default_rng(1).standard_normal(frames.positions.shape)
        found = [frames.positions[-1], *rollout.vjp(frames, weights).values()]
        if exact is None:
            exact = found
            continue
        errors.append([np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in zip(found, exact)])
        assert max(errors[-1]) <= 10 * tolerance
    assert np.all(np.array(errors[-1]) < 1e-4 * np.maximum(errors[0], 1e-4))


@pytest.mark.parametrize("mutation", ["scaled", "preconditioner only", "no inertia"])
def test_a_wrong_adjoint_is_noticed(mutation, monkeypatch):
    plain = recorded_passes.RecordedPasses.solve

    def wrong(self, b):
        if mutation == "scaled":
            return 1.001 * plain(self, b)
        if mutation == "no inertia":
            self.operator.mass = 0.999 * self.operator.mass
            return plain(self, b)
        plain(self, b)
        return self._preconditioner(b * self.ws.free) if b.any() else b

    monkeypatch.setattr(recorded_passes.RecordedPasses, "solve", wrong)
    rollout = make(ds.ImplicitEulerSolver, steps=2, gradients=["youngs_modulus"])
    assert not ds.check_gradients(rollout, verbose=False).passed


@pytest.mark.executed_ptx
def test_a_tape_differentiates_an_implicit_run():
    rollout = make(ds.BDF2Solver, gradients=None)
    loss = ti.field(ti.f64, shape=(), needs_grad=True)

    @ti.kernel
    def height(x: ti.template()):
        for i in range(x.shape[1]):
            loss[None] += x[x.shape[0] - 1, i].y

    with ti.ad.Tape(loss):
        rollout.run()
        height(rollout.positions)
    frames = rollout.forward()
    weights = np.zeros(frames.positions.shape)
    weights[-1, :, 1] = 1
    direct = rollout.vjp(frames, weights)
    np.testing.assert_allclose(rollout.gradients["youngs_modulus"], direct["youngs_modulus"], rtol=1e-12)
    assert loss[None] == pytest.approx(frames.positions[-1, :, 1].sum())
