"""The stable step: bounds, the tight limit, refusals, and runs that go wrong."""

import pickle
import re
import warnings

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.materials import MATERIALS
from diffsim_ti.monitor import stability
from diffsim_ti.solvers import SOLVERS as ALL_SOLVERS

SOLVERS = [s for s in ALL_SOLVERS if s.explicit]  # the implicit ones: test_implicit*.py
E, RHO = 1e5, 1000.0
solvers = pytest.mark.parametrize("solver", SOLVERS)
materials = pytest.mark.parametrize("material", MATERIALS)


def graded():
    """Cells from 0.5 down to 0.01 along x."""
    mesh = ds.TetrahedralMesh.create_box((6, 3, 3), pattern="five")
    x = mesh.vertices.copy()
    x[:, 0] = (50 ** x[:, 0] - 1) / 49
    return ds.TetrahedralMesh(x, mesh.tetrahedra)


def slivers():
    """A box squeezed to a plate, its tetrahedra of quality 0.05."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return ds.TetrahedralMesh.create_box(3).scaled([1, 1, 0.01])


def shaken():
    mesh = ds.TetrahedralMesh.create_box(4)
    move = np.random.default_rng(0).uniform(-0.07, 0.07, mesh.vertices.shape)
    return ds.TetrahedralMesh(mesh.vertices + move, mesh.tetrahedra)


MESHES = {
    "one": lambda: ds.TetrahedralMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]]),
    "regular": lambda: ds.TetrahedralMesh.create_box(4),
    "five": lambda: ds.TetrahedralMesh.create_box(4, pattern="five"),
    "graded": graded,
    "slivers": slivers,
    "shaken": shaken,
}
meshes = pytest.mark.parametrize("name", MESHES)


def block(material=ds.StableNeoHookean, nu=0.3, **options):
    return ds.Scene(ds.TetrahedralMesh.create_box(3, pattern="five"), material(E, nu), RHO, **options)


def any_step(scene, solver=ds.SemiImplicitSolver, **options):
    return solver(scene, dt=1e-9, parallel=False, **options)


def dense_stiffness(scene):
    """M^-1/2 K M^-1/2 column by column."""
    solver = any_step(scene)
    stiffness = stability.Stiffness(solver.workspace(solver.start_values()))
    n = scene.mesh.num_vertices
    return np.stack([stiffness.product(e.reshape(n, 3)).ravel() for e in np.eye(3 * n)], 1)


def without_gravity_modes(eigenvalues):
    return eigenvalues[np.abs(eigenvalues) > 1e-9 * eigenvalues.max()]


# ---- the numbers --------------------------------------------------------------------------------------------------------


@meshes
@materials
def test_element_bound_is_safe_and_not_wasteful(name, material):
    for nu in (0.0, 0.3, 0.45, -0.5):
        scene = ds.Scene(MESHES[name](), material(E, nu), RHO)
        bound, tight = stability.element_limit(scene).dt, any_step(scene).stable_dt(tight=True).dt
        assert bound <= tight * (1 + 1e-9), (name, nu)
        assert bound >= 0.3 * tight, (name, nu)  # a bound of 0 would be safe too


@meshes
def test_lanczos_is_the_dense_eigenvalue(name):
    """On the safe side of it, within 1e-3."""
    for fixed in (None, [0, 1]):
        scene = ds.Scene(MESHES[name](), ds.StableNeoHookean(E, 0.3), RHO, fixed=fixed)
        K = dense_stiffness(scene)
        assert np.abs(K - K.T).max() <= 1e-13 * np.abs(K).max()
        omega2 = np.linalg.eigvalsh((K + K.T) / 2)
        assert omega2[0] >= -1e-12 * omega2[-1]  # rest is stable
        if fixed is None:
            assert len(without_gravity_modes(omega2)) == 3 * scene.mesh.num_vertices - 6  # six rigid modes, no more
        exact, tight = 2 / np.sqrt(omega2[-1]), any_step(scene).stable_dt(tight=True)
        assert exact * (1 - 1e-3) <= tight.dt <= exact * (1 + 1e-12)
        assert tight.method == "Lanczos"


def test_lanczos_sees_the_state_and_the_contact():
    """A vertex deep in the barrier is stiffer than the body: 2 / sqrt(b'' / m)."""
    mesh = ds.TetrahedralMesh.create_box(2, 0.1, origin=(0, 1e-4, 0))
    ground = ds.Ground(stiffness=1e6, width=0.01)
    free, pressed = (ds.Scene(mesh, ds.StableNeoHookean(E, 0.3), RHO, terms=terms) for terms in ([], [ground]))
    s = 1e-2
    curvature = 1e6 * (-2 * np.log(s) - 4 * (s - 1) / s + ((s - 1) / s) ** 2)
    lightest = (
        ds.SemiImplicitSolver(pressed, dt=1e-9)
        .workspace(pressed.inputs.derive(pressed.inputs.values))
        .arrays.values.mass[mesh.vertices[:, 1] < 0.01]
        .min()
    )
    tight, staged = (any_step(pressed, contact=c).stable_dt(tight=True).dt for c in ("force", "stage"))
    assert tight == pytest.approx(2 / np.sqrt(curvature / lightest), rel=0.01)  # the body adds a little
    assert tight < 0.1 * any_step(free).stable_dt(tight=True).dt == 0.1 * staged  # which a stage does not limit


def test_limit_scales_as_it_must():
    """dt ~ L sqrt(rho / E)."""

    def limit(size, young, density):
        scene = ds.Scene(ds.TetrahedralMesh.create_box(3, size), ds.StableNeoHookean(young, 0.3), density)
        return np.array([any_step(scene).stable_dt(tight=t).dt for t in (False, True)])

    assert limit(1e-3, 1e9, 10.0) == pytest.approx(limit(1.0, 1e5, 1000.0) * 1e-3 * np.sqrt(1e-2 * 1e-4), rel=1e-9)


def test_worst_tetrahedron_is_named():
    """TORTURE 28: sizes 1 : 1e3, moduli 1 : 1e6, densities 1 : 1e4 in one mesh."""
    mesh = ds.TetrahedralMesh.create_box((5, 2, 2), (4, 1, 1), "five")
    stiff, light = 7, 12
    young, density = np.full(mesh.num_tetrahedra, 1e3), np.full(mesh.num_tetrahedra, 1e3)
    for changed, values, factor in ((stiff, young, 1e6), (light, density, 1e-4)):
        values = values.copy()
        values[changed] *= factor
        scene = ds.Scene(
            mesh,
            ds.StableNeoHookean(values if changed == stiff else young, 0.3),
            values if changed == light else density,
        )
        assert stability.element_limit(scene).tetrahedron == changed
        tight = any_step(scene).stable_dt(tight=True)
        assert stability.element_limit(scene).dt <= tight.dt
        if changed == stiff:
            assert tight.tetrahedron == stiff and str(stiff) in str(tight)
    x = mesh.vertices.copy()
    x[x[:, 0] == 4, 0] = 3.001
    with pytest.warns(UserWarning, match="sliver"):
        small = ds.TetrahedralMesh(x, mesh.tetrahedra)
    scene = ds.Scene(small, ds.StableNeoHookean(1e3, 0.3), 1e3)
    thin = {stability.element_limit(scene).tetrahedron, any_step(scene).stable_dt(tight=True).tetrahedron}
    assert (small.altitudes[list(thin)].min(1) < 2e-3).all()


def test_limit_falls_as_elements_are_squeezed():
    """To about a quarter at stretch 0.1 (design, section 6)."""
    scene = block()
    squeezed = scene.replace(initial_positions=scene.mesh.vertices * [1, 0.1, 1])
    assert any_step(squeezed).stable_dt(tight=True).dt < 0.27 * any_step(scene).stable_dt(tight=True).dt


# ---- near the limit -----------------------------------------------------------------------------------------------------


@solvers
@pytest.mark.parametrize("share", [0.95, 0.99])
def test_bounded_below_the_limit(solver, share):
    """1e5 steps at small amplitude. At 0.99 the highest mode's amplitude may grow 1 / sqrt(1 - 0.99^2) = 7 times."""
    scene = block()
    X = scene.mesh.vertices
    kick = 1e-6 * np.random.default_rng(0).standard_normal(X.shape)
    dt = share * any_step(scene, solver).stable_dt(tight=True).dt
    frames = ds.Rollout(solver(scene.replace(initial_positions=X + kick), dt=dt), 100_000, save_every=1000).forward()
    moved = frames.positions - X
    moved -= moved.mean(1, keepdims=True)
    assert np.abs(moved).max() < 20 * np.abs(kick).max()


@solvers
@pytest.mark.parametrize("share", [1.01, 1.05])
def test_refused_above_the_limit(solver, share):
    scene = block()
    tight = any_step(scene, solver).stable_dt(tight=True)
    message = (
        r"exceeds the stable step \S+ s \(Lanczos, set by tetrahedron \d+\): "
        r"reduce dt, pass substeps=2, .*allow_unstable"
    )
    with pytest.raises(ValueError, match=message):
        solver(scene, dt=share * tight.dt, substeps=1)
    assert solver(scene, dt=share * tight.dt, substeps=2).substeps == 2  # the remedy works
    assert solver(scene, dt=0.999 * tight.dt).dt < tight.dt


@solvers
def test_ten_times_the_limit_says_how_many_substeps(solver):
    scene = block()
    dt = 10 * any_step(scene, solver).stable_dt(tight=True).dt
    with pytest.raises(ValueError, match="exceeds the stable step") as caught:
        solver(scene, dt=dt, substeps=1)
    substeps = int(re.search(r"substeps=(\d+)", str(caught.value)).group(1))
    assert 10 < substeps <= 12 and solver(scene, dt=dt, substeps=substeps).substeps == substeps
    with pytest.raises(ValueError, match="exceeds"):
        solver(scene, dt=dt, substeps=9)


@solvers
@pytest.mark.parametrize("share", [1.01, 1.05])
@pytest.mark.parametrize("how", ["rollout", "simulator"])
def test_divergence_above_the_limit_is_named(solver, share, how):
    """Overridden, the run grows and is caught: step, vertex, tetrahedron, stable step; the last good state is kept."""
    scene = block()
    X, tight = scene.mesh.vertices, any_step(scene, solver).stable_dt(tight=True).dt
    kick = 1e-6 * np.random.default_rng(0).standard_normal(X.shape)
    unstable = solver(scene.replace(initial_positions=X + kick), dt=share * tight, allow_unstable=True)
    with pytest.raises(ds.Divergence) as caught:
        if how == "rollout":
            ds.Rollout(unstable, 20_000).forward()
        else:
            simulator = ds.Simulator(unstable)
            simulator.run(20_000)
    error = caught.value
    assert isinstance(error, FloatingPointError)
    assert re.search(
        rf"step {error.step}, t = [\d.e+-]+ s: (velocity|displacement) of vertex {error.vertex} is not finite",
        str(error),
    )
    assert re.search(rf"smallest J around it = [-\d.einf+]+ in tetrahedron {error.tetrahedron}", str(error))
    assert error.vertex in scene.mesh.tetrahedra[error.tetrahedron]
    assert "the last good state is kept" in str(error)
    assert error.stable_dt <= tight * 1.01 and f"exceeds the stable step {error.stable_dt:.4g} s" in str(error)
    # Growth by 2 acosh(share) a step from 1e-6 to order 1 takes some 14 / 0.28 = 50 steps at 1.01, not many more
    rate = 2 * np.arccosh(share)
    assert np.log(1e4) / rate / 2 < error.step < 20 * np.log(1e6) / rate + 200
    if how == "simulator":
        assert simulator.step_count == error.step
        assert np.isfinite(simulator.positions).all() and np.isfinite(simulator.velocities).all()


def test_divergence_reports_the_stable_step_of_the_good_state():
    """An unstable start caught at once: the step reported is that of the rest state, nearly."""
    scene = block(ds.LinearElastic)  # a linear law's limit does not depend on the state
    tight = any_step(scene).stable_dt(tight=True).dt
    start = scene.mesh.vertices + 1e-3 * np.random.default_rng(0).standard_normal(scene.mesh.vertices.shape)
    simulator = ds.Simulator(
        ds.SemiImplicitSolver(scene.replace(initial_positions=start), dt=1.2 * tight, allow_unstable=True)
    )
    with pytest.raises(
        ds.Divergence, match="exceeds the stable step .*reduce dt, raise substeps, or use an implicit solver"
    ) as caught:
        simulator.run(5000)
    assert caught.value.stable_dt == pytest.approx(tight, rel=2e-3)


# ---- while running ------------------------------------------------------------------------------------------------------


@solvers
@pytest.mark.parametrize("how", ["rollout", "simulator"])
def test_compression_outgrows_the_step_before_any_nan(solver, how):
    """TORTURE 24: a plate presses the block to a tenth; at 0.9 of the limit at rest that cannot go on."""
    scene = block(fixed=["ymin", "ymax"])
    top = np.isin(scene.fixed, scene.mesh.vertex_sets["ymax"])
    tight = any_step(scene, solver).stable_dt(tight=True).dt
    dt, T = 0.9 * tight, 4000 * tight

    def press(t):
        return -0.9 * min(t / T, 1.0) * top[:, None] * np.array([0, 1.0, 0])

    run = solver(scene.replace(motion=press, terms=[ds.Drag(5.0)]), dt=dt, substeps=1)
    steps = int(2 * T / dt)
    simulator = ds.Simulator(run)
    with pytest.raises(
        ds.Divergence, match="has outgrown the stable step .*(elements are squeezed).*reduce dt"
    ) as caught:
        ds.Rollout(run, steps).forward() if how == "rollout" else simulator.run(steps)
    error = caught.value
    assert 0 < error.step < steps and 0 <= error.tetrahedron < scene.mesh.num_tetrahedra
    assert error.stable_dt < dt
    if how == "rollout":  # which is looked at in the same steps wherever states are kept
        with pytest.raises(ds.Divergence) as again:
            ds.Rollout(run, steps, checkpoint_every=30).forward()
        assert again.value.step == error.step
    if how == "simulator":
        assert simulator.step_count == error.step
        assert np.abs(simulator.positions - scene.mesh.vertices).max() < 2  # stopped before anything flew off


@solvers
@pytest.mark.parametrize("vertex", [0, 13, 26])
def test_nan_in_one_vertex_is_found_in_its_step(solver, vertex):
    """TORTURE 66."""
    scene = block()
    simulator = ds.Simulator(solver(scene, dt=1e-3))
    simulator.run(100)
    velocities = simulator.velocities
    velocities[vertex, 1] = np.nan
    runtime.fill(simulator.workspace.state.v, velocities[None])  # which set_state would refuse
    with pytest.raises(ds.Divergence, match=rf"step 100, t = 0\.1 s: .* of vertex {vertex} is not finite") as caught:
        simulator.run(50)
    assert caught.value.step == 100 and caught.value.vertex == vertex
    assert vertex in scene.mesh.tetrahedra[caught.value.tetrahedron]
    assert simulator.step_count == 100


def test_infinite_force_is_found_in_its_step():
    """A force that overflows in step 40 of a rollout, many passes per look."""
    forces = np.zeros((100, 1, 3))
    forces[40] = 1e308
    scene = block(terms=[ds.ExternalForce(forces, [5])])
    for solver in SOLVERS:
        with pytest.raises(ds.Divergence) as caught:
            ds.Rollout(solver(scene, dt=1e-3, substeps=2), 100).forward()
        assert 40 <= caught.value.step <= 41  # the force is finite: its square in the energy's formula is not


def test_good_state_can_go_on():
    """After a Divergence the simulator stands at its last good state and runs on with smaller substeps."""
    scene = block()
    X, tight = scene.mesh.vertices, any_step(scene).stable_dt(tight=True).dt
    kick = 1e-6 * np.random.default_rng(0).standard_normal(X.shape)
    simulator = ds.Simulator(
        ds.SemiImplicitSolver(scene.replace(initial_positions=X + kick), dt=1.05 * tight, allow_unstable=True)
    )
    with pytest.raises(ds.Divergence):
        simulator.run(20_000)
    simulator.reset()
    simulator.set_substeps(2)
    simulator.run(1000)
    assert np.abs(simulator.positions - X).max() < 1e-3


@pytest.mark.parametrize("free", [0, 1, 2])
def test_watch_never_overestimates(free):
    """Few free vertices have fewer motions than the watch takes products; none at all is no error."""
    scene = block(fixed=range(free, 27), terms=[ds.Gravity()])
    solver = ds.SemiImplicitSolver(scene, dt=5e-3)
    stiffness = stability.Stiffness(solver.workspace(solver.start_values()))
    omega2 = np.linalg.eigvalsh(dense_stiffness(scene))[-1]
    for _ in range(20):
        assert stiffness.lower_bound() <= omega2 * (1 + 1e-10)
    assert stiffness.lower_bound() >= 0.999 * omega2
    frames = ds.Rollout(solver, 2000).forward()
    assert np.array_equal(frames.positions[-1, free:], scene.mesh.vertices[free:])


def test_watch_sees_a_mode_overtake():
    """A vector that sits exactly on an eigenvector must not hide a larger eigenvalue."""
    scene = block()
    solver = any_step(scene)
    stiffness = stability.Stiffness(solver.workspace(solver.start_values()))
    values, vectors = np.linalg.eigh(dense_stiffness(scene))
    stiffness.vector = vectors[:, 40].reshape(-1, 3)
    seen = [stiffness.lower_bound() for _ in range(10)]
    assert values[40] < 0.9 * values[-1] and seen[-1] == pytest.approx(values[-1], rel=1e-2)


# ---- the seeds' spelling ------------------------------------------------------------------------------------------------


def test_seeds_spelling_divides_the_step_and_says_so_once():
    mesh, material = ds.TetrahedralMesh.create_cube(4), ds.StableNeoHookean(1e6, 0.3)
    with pytest.warns(
        UserWarning, match=r"dt = 0.01 s is divided into (\d+) substeps \(asked for at least 1\): the stable step is"
    ) as caught:
        solver = ds.SemiImplicitSolver(mesh, material, dt=0.01, substeps=1)
        ds.Simulator(solver).run(20)
    assert len(caught) == 1
    assert solver.substeps == int(re.search(r"into (\d+)", str(caught[0].message)).group(1)) > 1
    assert 0.5 * solver.stable_dt(tight=True).dt < solver.substep <= 0.7 * solver.stable_dt(tight=True).dt
    assert caught[0].filename == __file__  # it points to the user's line


def test_seeds_spelling_is_quiet_where_the_step_is_stable():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solver = ds.SemiImplicitSolver(ds.TetrahedralMesh.create_cube(3), ds.StableNeoHookean(1e3, 0.3), dt=0.01)
        assert solver.substeps == 1
        many = ds.SemiImplicitSolver(
            ds.TetrahedralMesh.create_cube(3), ds.StableNeoHookean(1e3, 0.3), dt=0.01, substeps=7
        )
    assert many.substeps == 7  # the least number, kept


def test_seeds_spelling_with_the_scene_in_the_simulator():
    mesh, material = ds.TetrahedralMesh.create_cube(3), ds.StableNeoHookean(1e4, 0.3)
    solver = ds.SemiImplicitSolver(dt=0.01, gravity=-5.0)
    simulator = ds.Simulator(mesh, material, solver)
    simulator.run(10)
    assert simulator.positions[:, 1] - mesh.vertices[:, 1] == pytest.approx(
        -5.0 * solver.substep**2 * 10 * solver.substeps * (10 * solver.substeps + 1) / 2
    )
    with pytest.raises(ValueError, match="already has a scene"):
        ds.Simulator(mesh, material, solver)
    with pytest.raises(ValueError, match="has no scene"):
        ds.Simulator(ds.SemiImplicitSolver(dt=0.01))


@solvers
def test_dt_may_go_without_its_name(solver):
    assert solver(block(), 1e-3).dt == 1e-3


# ---- arguments ----------------------------------------------------------------------------------------------------------


@solvers
@pytest.mark.parametrize("dt", [0.0, -1e-3, np.nan, np.inf])
def test_dt_must_be_positive(solver, dt):
    with pytest.raises(ValueError, match=r"dt must be > 0 \[s\], got"):
        solver(block(), dt=dt)


@solvers
@pytest.mark.parametrize("substeps", [0, -1, 1.5])
def test_substeps_must_be_a_whole_number(solver, substeps):
    with pytest.raises(ValueError, match=f"substeps must be a whole number >= 1, got {substeps}"):
        solver(block(), dt=1e-3, substeps=substeps)
    simulator = ds.Simulator(solver(block(), dt=1e-3))
    with pytest.raises(ValueError, match="substeps must be a whole number"):
        simulator.set_substeps(substeps)


@solvers
def test_solver_describes_itself(solver):
    described = solver(block(), dt=1e-3, substeps=2).describe()
    how = "serial" if runtime.runs_on_cpu() else "parallel, up to 16 substeps per launch"
    assert re.match(rf"{solver.__name__}: dt 0.001 s, 2 substeps of 0.0005 s; {how}", described)
    how = "one launch per substep" if runtime.runs_on_cpu() else "up to 16 substeps per launch"
    assert f"parallel, {how}" in solver(block(), dt=1e-3, parallel=True).describe()
    assert repr(solver(block(), dt=1e-3)) == f"{solver.__name__}(dt=0.001, substeps=1)"


# ---- asked of a scene, and checked when told to ---------------------------------------------------------------------------


def test_a_scene_tells_its_stable_step():
    scene = block()
    tight, bound = ds.stable_dt(scene), ds.stable_dt(scene, tight=False)
    assert tight == any_step(scene, ds.VelocityVerletSolver).stable_dt(tight=True) and tight.method == "Lanczos"
    assert bound == stability.element_limit(scene) and bound.dt < tight.dt


@solvers
def test_a_start_that_is_not_checked_is_checked_on_the_way(solver):
    """A solver whose substeps are chosen later may be made with any step, but not run with it."""
    scene = block()
    dt = 1.05 * ds.stable_dt(scene).dt
    own = solver(scene, dt=dt, check_start=False)
    assert not own.allow_unstable and own.for_scene(scene).dt == dt
    with pytest.raises(ds.Divergence, match="outgrown the stable step"):
        ds.Rollout(own, 1000).forward()


# ---- substeps that are left to the solver --------------------------------------------------------------------------------


@solvers
def test_a_step_is_whole_where_it_is_stable_and_else_divided(solver):
    """By 0.7 of the stable step, with the numbers of a solver that is given them."""
    scene = block()
    tight = any_step(scene, solver).stable_dt(tight=True).dt
    for share, count in ((0.5, 1), (0.999, 1), (1.01, 2), (5.0, 8)):
        chosen = solver(scene, dt=share * tight)
        assert (chosen.substeps, chosen.choose_substeps(share=1.0)) == (count, count)
        known = solver(scene, dt=share * tight, substeps=count)
        runs = [
            ds.Rollout(x, 3, save_every=1).forward(initial_velocities=0.1 * scene.mesh.vertices)
            for x in (chosen, known)
        ]
        np.testing.assert_array_equal(runs[0].positions, runs[1].positions)
    again = pickle.loads(pickle.dumps(chosen))
    assert again.substeps == 8 and again.automatic and not known.automatic
    assert chosen.for_scene(scene).substeps == 8 and chosen.for_scene(block(ds.LinearElastic)).automatic
    softer, stiffer = (scene.replace(material=ds.StableNeoHookean(E, 0.3)) for E in (1e4, 4e5))
    assert chosen.for_scene(softer).substeps == 8 and chosen.for_scene(stiffer).substeps == 15
    assert list(ds.Rollout(chosen, [0.9 * tight, 2.0 * tight]).schedule.substeps) == [1, 3]
    with pytest.raises(ValueError, match=r"would take \d+ substeps, .* pass substeps=(\d+) if they are meant"):
        solver(scene, dt=1e4 * tight)
    with pytest.raises(ValueError, match='substeps must be "auto" or a whole number >= 1'):
        solver(scene, dt=tight, substeps="many")


def test_implicit_solvers_take_auto_for_one():
    assert ds.ImplicitEulerSolver(block(), dt=0.1, substeps="auto").substeps == 1


@solvers
def test_the_first_run_settles_the_substeps(solver):
    """By its values, of a batch by the stiffest scene; a later run that needs more names the number, which works."""
    scene = block()
    E, tight = float(scene.inputs.values["youngs_modulus"]), any_step(scene, solver).stable_dt(tight=True).dt
    own = solver(scene, dt=5 * tight)
    rollout = ds.Rollout(own, 2)
    rollout.forward(youngs_modulus=4 * E)
    assert rollout.solver.substeps == 15 and own.substeps == 8  # twice as many
    frames = rollout.forward(youngs_modulus=E)
    known = ds.Rollout(solver(scene, dt=5 * tight, substeps=15), 2)
    np.testing.assert_array_equal(frames.positions, known.forward().positions)
    seed = np.random.default_rng(0).standard_normal(frames.positions.shape)
    by_E = [one.vjp(one.forward(), positions=seed)["youngs_modulus"] for one in (rollout, known)]
    np.testing.assert_array_equal(*by_E)  # gradients are of what was run
    for grown in (2.0, 4.0, 6.0, 7.9):  # an optimisation in which E grows
        rollout.forward(youngs_modulus=grown * E)
    with pytest.raises(ValueError, match="stable step of these values") as caught:
        rollout.forward(youngs_modulus=9 * E)
    count = int(re.search(r"substeps=(\d+)", str(caught.value)).group(1))
    ds.Rollout(solver(scene, dt=5 * tight, substeps=count), 2).forward(youngs_modulus=9 * E)
    for lanes in (True, False):
        batch = ds.Batch(own, 2, 3, lanes=lanes)
        batch.forward(youngs_modulus=[E, 4 * E, 2 * E])
        assert batch.solver.substeps == 15
        with pytest.raises(ValueError, match=f"stable step of these values .*substeps={count}"):
            batch.forward(youngs_modulus=[9 * E, E, E])
    ds.Rollout(solver(scene, dt=0.9 * tight), 2).forward(youngs_modulus=1.2 * E)  # whole as long as it is stable


def test_cables_over_time_are_counted_in_each_run():
    """Whose tension makes the body stiffer in one run than in another."""
    mesh = ds.TetrahedralMesh.create_cube(2)
    rope = ds.Cable([0, ds.Anchor(mesh.vertices[0] - 0.01)], tension=1.0, name="rope")
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e3, 0.3), terms=rope, precision="f64")
    slow = ds.Rollout(ds.SemiImplicitSolver(scene, dt=0.9 * ds.stable_dt(scene).dt), 2)
    slow.forward()
    fast = ds.Rollout(slow.solver, 2)
    fast.forward(**{"rope.tension": np.array([1.0, 3e3])})
    assert fast.solver.substeps > 2 * slow.solver.substeps
    with pytest.raises(ValueError, match=f"make the solver with substeps={fast.solver.substeps}, or another Rollout"):
        slow.forward(**{"rope.tension": np.array([1.0, 3e3])})


def test_a_simulator_takes_more_substeps_where_the_body_stiffens():
    """A plate presses a block: a simulator goes on and says so once, a rollout stops with the number."""
    scene = block(fixed=["ymin", "ymax"])
    top = np.isin(scene.fixed, scene.mesh.vertex_sets["ymax"])[:, None] * np.array([0, 1.0, 0])
    tight = ds.stable_dt(scene).dt
    end = 1500 * tight
    scene = scene.replace(motion=([0.0, end], np.stack([0 * top, -0.8 * top])), terms=[ds.Drag(5.0)])
    solver = ds.SemiImplicitSolver(scene, dt=4.3 * tight)
    assert solver.substeps == 7
    steps, simulator = int(end / solver.dt), ds.Simulator(solver)
    with pytest.warns(UserWarning, match=r"divided into more than 7 substeps from here on, 14 in this one") as caught:
        simulator.run(steps)
    assert len(caught) == 1 and simulator.solver.substeps >= 14 and solver.substeps == 7
    assert np.isfinite(simulator.positions).all() and np.abs(simulator.velocities).max() < 1
    state = simulator.state
    again = ds.Simulator(solver)
    again.resume(state)
    assert again.solver.substeps == simulator.solver.substeps
    for one in (again, simulator):
        one.run(3)
    np.testing.assert_array_equal(again.positions, simulator.positions)
    simulator.reset()
    assert simulator.solver is solver
    with pytest.raises(ds.Divergence, match=r"outgrown the stable step .*pass substeps=14, or reduce dt") as told:
        ds.Rollout(solver, steps).forward()
    assert 0 < told.value.enough < solver.substep and told.value.step > steps // 2
