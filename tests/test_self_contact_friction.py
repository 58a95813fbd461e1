"""Friction of surfaces on each other: slopes, energy, momentum, gradients, coefficients of pairs of sets, refusals."""

from functools import lru_cache

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.solvers.implicit.linear import conjugate_gradients

SLOPE, G = 0.5, 9.81
EXPLICIT = (ds.SemiImplicitSolver, ds.VelocityVerletSolver)
IMPLICIT = (ds.ImplicitEulerSolver, ds.BDF2Solver, ds.ImplicitMidpointSolver)


# ---- on a slope ------------------------------------------------------------------------------------------------------


def on_slope(friction, start=None, drag=0.0, friction_speed=1e-3):
    """A soft slab on a soft board of tan = 1/2, whose underside is held; the slope is down the x axis."""
    board = ds.TetrahedralMesh.create_box((2, 2, 2), size=(0.9, 0.1, 0.4))
    slab = ds.TetrahedralMesh.create_box((2, 2, 2), size=(0.2, 0.06, 0.2)).translated([0.15, 0.103, 0.11])
    angle = np.arctan(SLOPE)
    gravity = G * np.array([np.sin(angle), -np.cos(angle), 0])
    contact = ds.SelfContact(1e4, 4e-3, friction=friction, friction_speed=friction_speed)
    terms = [ds.Gravity(gravity), contact, ds.Drag(drag)]  # without drag, too, so that tests share their kernels
    scene = ds.Scene(
        ds.TetrahedralMesh.joined([board, slab]),
        ds.KelvinVoigt(ds.StableNeoHookean(1e6, 0.3), time=2e-3),
        1000.0,
        terms,
        fixed=np.flatnonzero(board.vertices[:, 1] == 0),
        initial_positions=start,
        precision="f64",
    )
    return scene, float(gravity[0] - friction * -gravity[1])


def went(solver, dt, scene, steps):
    """Frames of a run, and how far the slab goes [m]."""
    frames = ds.Rollout(solver(scene, dt=dt), steps, gradients=[]).forward()
    return frames, (frames.positions[-1] - frames.positions[0])[8:].mean(0)[0]


@lru_cache
def settled():
    """The slab at rest in the barrier, with the friction that just holds it."""
    return went(ds.ImplicitEulerSolver, 1e-2, on_slope(SLOPE, drag=30.0)[0], 60)[0].positions[-1]


@pytest.mark.parametrize("solver, dt", [(ds.SemiImplicitSolver, 2.5e-4), (ds.BDF2Solver, 4e-3)])
def test_slope(solver, dt):
    """0.51 holds, 0.49 slides, 0.3 slides as far as Coulomb's law says."""
    steps = round(0.3 / dt)
    end = steps * dt
    assert 0 <= went(solver, dt, on_slope(0.51, settled())[0], steps)[1] <= 1e-3 * end
    scene, down = on_slope(0.49, settled())
    assert went(solver, dt, scene, steps)[1] > 0.9 * (0.5 * down * end**2)
    scene, down = on_slope(0.3, settled())
    np.testing.assert_allclose(went(solver, dt, scene, steps)[1], 0.5 * down * end**2, rtol=0.02)


def test_linear_solves_on_the_device_know_friction():
    """Conjugate gradients of multigrid solve what products on the host say, where all that presses also sticks."""
    solver = ds.ImplicitEulerSolver(on_slope(0.51, settled())[0], dt=1e-2, preconditioner="multigrid")
    simulator = ds.Simulator(solver)
    simulator.step()
    newton = simulator.workspace.newton
    newton.preconditioner.update(newton.potential.held_at)
    b = np.random.default_rng(0).standard_normal((solver.scene.mesh.num_vertices, 3)) * newton.free
    x, residual, *_ = conjugate_gradients(newton.operator(), b, newton.preconditioner, 1e-8, 1000, 1e-16)
    assert residual <= 1e-8
    left = b - newton.operator()(x)
    assert np.linalg.norm(left) <= 1e-7 * np.linalg.norm(b)
    with newton.potential.without_friction():  # which is no small part of it
        assert np.linalg.norm(b - newton.operator()(x)) > 0.1 * np.linalg.norm(b)


# ---- energy and momentum ---------------------------------------------------------------------------------------------


def bodies(turn=0.1):
    """Two tetrahedra that meet edge across edge, a little askew."""
    corners = np.array([[-0.05, 0, 0], [0.05, 0, 0], [0, -0.08, -0.05], [0, -0.08, 0.05]])
    lower = ds.TetrahedralMesh(corners, [[0, 1, 2, 3]], fix_orientation=True)
    upper = lower.rotated([1, 0, 1], np.pi).rotated([1, 0.3, 0.2], turn).translated([0.01, 7e-3, 0.005])
    mesh = ds.TetrahedralMesh.joined([lower, upper])
    sets = mesh.vertex_sets | {"rail": [6], "rest": [7]}
    return ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, vertex_sets=sets)


STILL_AIR = (ds.Drag(0.0),)  # so that those without drag share the kernels of those with it


def rough(friction=0.4, terms=STILL_AIR, precision="f64", material=None, **options):
    """They meet with friction: the upper one comes down and sidewards."""
    velocity = np.zeros((8, 3))
    velocity[4:] = [0.5, -3.0, 0.2]
    contact = ds.SelfContact(2e4, 5e-3, friction=friction, friction_speed=0.05)
    material = ds.StableNeoHookean(5e4, 0.3) if material is None else material
    return ds.Scene(
        bodies(), material, 1000.0, [contact, *terms], initial_velocities=velocity, precision=precision, **options
    )


@pytest.mark.parametrize("solver", EXPLICIT)
def test_momentum(solver):
    """Linear momentum is kept to round-off; friction takes energy that goes nowhere else."""
    simulators = [ds.Simulator(solver(rough(mu), dt=1e-4)) for mu in (0.0, 0.4)]
    kinetic = []
    for simulator in simulators:
        mass, before = simulator._start.mass[:, None], simulator.velocities
        simulator.run(80)
        after = simulator.velocities
        assert np.abs((mass * (after - before)).sum(0)).max() <= 1e-13 * (mass * np.abs(before)).sum()
        kinetic.append(simulator.compute_energy())
    assert kinetic[1] < 0.999 * kinetic[0]


@pytest.mark.parametrize("solver", [ds.ImplicitEulerSolver, ds.BDF2Solver, ds.ImplicitMidpointSolver])
def test_momentum_of_implicit_steps(solver):
    """Linear momentum is kept to the tolerance of the solves."""
    for tolerance in (1e-4, 1e-10):
        simulator = ds.Simulator(solver(rough(0.4), dt=5e-4, tolerance=tolerance))
        mass, before = simulator._start.mass[:, None], simulator.velocities
        simulator.run(8)
        lost = np.abs((mass * (simulator.velocities - before)).sum(0)).max() / (mass * np.abs(before)).sum()
        assert lost <= tolerance


def turned(width, friction, solver, steps, **options):
    """(|angular momentum gained|, |impulse of friction|) of the two bodies, as stiff as makes all scale with the width."""
    places = bodies().vertices + np.repeat([0, 1.2 * width - 7e-3], 4)[:, None] * [0, 1, 0]
    velocity = np.repeat([[0, 0, 0], [0.5, -3.0, 0.2]], 4, axis=0)
    contact = ds.SelfContact(0.5 / width**2, width, friction=friction, friction_speed=0.05)
    mesh = ds.TetrahedralMesh(places, bodies().tetrahedra)
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(5e4, 0.3), 1000.0, [contact, *STILL_AIR], initial_velocities=velocity, precision="f64"
    )
    impulse, dt = ds.SelfContactForce(range(4, 8), "friction"), 1.6 * width / steps
    frames = ds.Rollout(solver(scene, dt=dt, **options), steps, save_every=1, outputs=impulse, gradients=[]).forward()
    mass = scene.inputs.derive(scene.inputs.values).mass[:, None]
    L = (mass * np.cross(frames.positions, frames.velocities)).sum(1)
    return np.linalg.norm(L[-1] - L[0]), np.linalg.norm(frames["self_contact_force"].sum(0) * dt)


@pytest.mark.parametrize(
    "solver, steps, options", [(ds.SemiImplicitSolver, 200, {}), (ds.ImplicitMidpointSolver, 60, dict(tolerance=1e-11))]
)
def test_angular_momentum_but_for_the_couple_of_friction_across_the_gap(solver, steps, options):
    """The couple's arm is the gap, half the width here; it falls with the width, and there is none without friction."""
    (wide, by_wide), (narrow, by_narrow) = (turned(width, 0.4, solver, steps, **options) for width in (4e-3, 2e-3))
    assert narrow == pytest.approx(0.5 * wide, rel=0.05)
    for gained, impulse, width in ((wide, by_wide, 4e-3), (narrow, by_narrow, 2e-3)):
        assert 0.45 * width * impulse < gained < 0.65 * width * impulse
    assert turned(4e-3, 0.0, solver, steps, **options)[0] < (1e-9 if options else 1e-15)


# ---- gradients -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", EXPLICIT)
def test_tangent_and_adjoint_agree(solver):
    rollout = ds.Rollout(solver(rough(terms=[ds.Drag(2.0)]), dt=1e-4), 60, save_every=20, gradients="all")
    assert verify.dot_product_test(rollout) <= 1e-13


@pytest.mark.parametrize("solver", IMPLICIT)
def test_tangent_and_adjoint_of_implicit_steps_agree(solver):
    scene = rough(terms=[ds.Drag(2.0)])
    rollout = ds.Rollout(solver(scene, dt=5e-4, tolerance=1e-12), 12, save_every=4, gradients="all")
    assert verify.dot_product_test(rollout) <= 1e-9


NAMES = ["initial_positions", "self_contact_friction", "self_contact_friction_speed"]
MORE = ["self_contact_width", "self_contact_stiffness", "density", "drag_rate", "rest_positions"]


@pytest.mark.parametrize(
    "solver, dt, names", [(ds.SemiImplicitSolver, 1e-4, NAMES + MORE), (ds.ImplicitEulerSolver, 5e-4, NAMES)]
)
def test_gradients(solver, dt, names):
    options = dict(tolerance=1e-12) if solver in IMPLICIT else {}
    made = solver(rough(terms=[ds.Drag(2.0)]), dt=dt, **options)
    assert ds.check_gradients(ds.Rollout(made, round(4e-3 / dt), gradients=names)).passed


@pytest.mark.parametrize("solver, dt, tolerance", [(ds.VelocityVerletSolver, 1e-4, 1e-13), (ds.BDF2Solver, 5e-4, 1e-9)])
def test_with_everything_else(solver, dt, tolerance):
    """An obstacle with friction too, what is held in one direction or moves, a law of rates, two coefficients."""
    ground = ds.Ground(height=-0.088, stiffness=2e4, width=0.01, friction=0.3, path=lambda t: [t, 0, 0])
    friction = {("body_0", "body_1"): 0.4, ("body_0", "body_0"): 0.1}
    scene = rough(
        friction,
        terms=[ds.Drag(2.0), ground],
        material=ds.KelvinVoigt(ds.StableNeoHookean(5e4, 0.3), time=1e-3),
        fixed={"rail": [0.1, 0.3, 1.0], "rest": "xyz"},
        motion={"rail": lambda t: [0.3 * t, 0.5 * t, t], "rest": lambda t: [0.1 * t, 0, 0]},
    )
    rollout = ds.Rollout(
        solver(scene, dt=dt, tolerance=1e-12) if solver in IMPLICIT else solver(scene, dt=dt),
        round(5e-3 / dt),
        gradients="all",
    )
    assert rollout.values["self_contact_friction"].shape == (2,)
    assert verify.dot_product_test(rollout) <= tolerance


# ---- forces as a loss names them ---------------------------------------------------------------------------------------


def test_forces_on_a_body_are_what_its_momentum_gains():
    """Nothing else acts on the whole of it; all forces add up to zero; friction lies across the normal part."""
    named = [ds.SelfContactForce("body_1"), ds.SelfContactForce(name="each", per_vertex=True)]
    named += [ds.SelfContactForce("body_1", part, name=part) for part in ("normal", "friction")]
    scene, dt = rough(), 1e-4
    made = ds.SemiImplicitSolver(scene, dt=dt, substeps=2)
    frames = ds.Rollout(made, 60, save_every=3, outputs=named, gradients=[]).forward()
    mass = scene.inputs.derive(scene.inputs.values).mass[4:, None]
    gained = np.diff((mass * frames.velocities[:, 4:]).sum(1), axis=0) / (3 * dt)
    force = frames["self_contact_force"]
    assert np.abs(force).max() > 10 and np.abs(frames["friction"]).max() > 1
    np.testing.assert_allclose(gained, force[1:], atol=1e-11 * np.abs(force).max())
    assert not force[0].any()
    np.testing.assert_allclose(frames["each"][:, 4:].sum(1), force, atol=1e-12)
    np.testing.assert_allclose(frames["each"].sum(1), 0, atol=1e-12)
    np.testing.assert_allclose(frames["normal"] + frames["friction"], force, atol=1e-12)


def test_a_potential_that_is_interrupted_is_what_it_was():
    solver = dragged(ds.ImplicitEulerSolver, 0.02)
    workspace = solver.workspace(solver.start_values())
    workspace.advance(0, 3, 4)  # the step ends with parts that slide
    potential, u = workspace.potential, workspace.u_star

    def seen():
        potential.place(u)
        return potential.energy()[0], potential.forces()[0], potential.product(np.ones_like(u))

    before = seen()
    friction = potential.surface_friction
    for way in (potential.at_rest, potential.without_friction, potential.without_viscosity, friction.without):
        with pytest.raises(KeyboardInterrupt):
            with way():
                raise KeyboardInterrupt
        for a, b in zip(seen(), before):
            np.testing.assert_array_equal(a, b)


def test_forces_on_supports_are_counted_however_these_hold():
    """Fixed vertices take forces, beside others that are fixed in some directions too; a simulator notes what is read."""
    low = ds.TetrahedralMesh.create_box(2, size=0.1)
    up = ds.TetrahedralMesh.create_box(2, size=0.08, origin=(0.01, 0.104, 0.02)).rotated([0, 1, 0], 0.1)
    mesh, fall = ds.TetrahedralMesh.joined([low, up]), np.repeat([[0, 0, 0], [0, -0.5, 0]], 8, axis=0)
    terms = [ds.SelfContact(2e4, 5e-3, friction=0.3), ds.Ground(-0.01, stiffness=1e4, width=5e-3)]
    named = [ds.SelfContactForce("body_0", name="low"), ds.SelfContactForce(name="each", per_vertex=True)]
    for fixed in ({"body_0": "xyz"}, {"body_0": "xyz", "body_1": "x"}, {"body_0": "y"}):
        options = dict(fixed=fixed, initial_velocities=fall, precision="f64")
        scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.3), 1000.0, terms, **options)
        solver = ds.SemiImplicitSolver(scene, dt=1e-3, contact="force")  # whose obstacles cannot be noted
        frames = ds.Rollout(solver, 16, save_every=16, outputs=named, gradients=[]).forward()
        assert frames["low"][-1, 1] < -10
        np.testing.assert_allclose(frames["each"].sum(1), 0, atol=1e-10)
        assert np.isnan(frames.contact_forces[:, 0]).all()
    simulator = ds.Simulator(solver, contact_forces="surfaces")
    simulator.step()
    assert simulator.output(named[1]).shape == (16, 3)
    with pytest.raises(ValueError, match="contact_forces must be"):
        ds.Simulator(solver, contact_forces="all")


def test_forces_have_derivatives():
    named = [
        ds.SelfContactForce("body_1", name="on"),
        ds.SelfContactForce("body_0", "normal", name="p", about=(0, 0.1, 0)),
    ]
    named += [ds.SelfContactForce(name="each", per_vertex=True, part="friction")]
    solver, rng = ds.SemiImplicitSolver(rough(terms=[ds.Drag(2.0)]), dt=1e-4), np.random.default_rng(0)
    rollout = ds.Rollout(solver, 20, save_every=10, outputs=named, gradients="all")
    frames = rollout.forward()
    seeds = {name: rng.normal(size=frames[name].shape) for name in rollout.computed}
    gradients = {name: rollout.vjp(frames, **{name: seed}) for name, seed in seeds.items()}
    for key, value in rollout.values.items():
        way = rng.normal(size=np.shape(value)) * verify.input_scale(rollout, key)
        tangents = rollout.tangents(frames, **{key: way})
        ends = [rollout.forward(**{key: value + sign * 1e-5 * way}) for sign in (1, -1)]
        for name, seed in seeds.items():
            pushed, scale = (tangents[name] * seed).sum(), np.abs(tangents[name] * seed).sum()
            assert abs(pushed - (gradients[name][key] * way).sum()) <= 1e-12 * scale, (key, name)
            difference = ((ends[0][name] - ends[1][name]) * seed).sum() / 2e-5
            floor = 1e-8 * np.abs(frames[name] * seed).sum()  # round-off of the difference
            assert abs(pushed - difference) <= 1e-4 * scale + floor, (key, name)


def dragged(solver, end, **options):
    """Two soft blocks, the upper one pressed down and dragged by its top until the time `end`, and a floor with friction."""
    low = ds.TetrahedralMesh.create_box((2, 2, 2), (0.2, 0.1, 0.2))
    up = ds.TetrahedralMesh.create_box((2, 2, 2), 0.1).rotated([0, 1, 0], 0.2).translated([0.05, 0.103, 0.05])
    mesh = ds.TetrahedralMesh.joined([low, up])
    y = mesh.vertices[:, 1]
    mesh = mesh.with_vertex_set("base", y < 1e-9).with_vertex_set("top", y > 0.2)
    floor = ds.Ground(-0.005, 2e4, 0.01, friction=0.3, name="floor", path=lambda t: [0.02 * t / end, 0, 0])
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(1e6, 0.3),
        1000.0,
        [ds.SelfContact(1e4, 0.003, friction=0.5), floor],
        fixed={"base": "xyz", "top": "xyz"},
        motion={"top": lambda t: [0.03 * max(t / end - 0.4, 0), -0.008 * min(t / end, 0.5), 0]},
        precision="f64",
    )
    return solver(scene, dt=end / 4, tolerance=1e-12, **options)


def parts_of(on):
    return [ds.SelfContactForce(on, part, name=part) for part in ("normal", "friction", "total")]


@pytest.mark.parametrize("load_steps", [1, 2])
def test_friction_at_rest_balances_the_supports(load_steps):
    solver = dragged(ds.StaticSolver, 4.0, load_steps=load_steps)
    named = [*parts_of("body_1"), ds.Reaction("top"), ds.SelfContactForce(name="each", per_vertex=True)]
    frames = ds.Rollout(solver, 4, save_every=1, outputs=named).forward()
    total, size = frames["total"], np.abs(frames["normal"]).max()
    assert np.abs(frames["friction"][2:]).max(1).min() > 0.05 * size
    np.testing.assert_allclose(frames["normal"] + frames["friction"], total, atol=1e-12 * size)
    np.testing.assert_allclose(frames["reaction"], -total, atol=1e-8 * size)
    np.testing.assert_allclose(frames["each"].sum(1), 0, atol=1e-12 * size)
    simulator = ds.Simulator(solver, contact_forces=True)
    with pytest.raises(ValueError, match="contact_forces=.surfaces"):
        ds.Simulator(solver).output(named[1])
    for k in range(5):
        np.testing.assert_allclose(simulator.output(named[1]), frames["friction"][k], atol=1e-8 * size)
        if k < 4:
            simulator.step()


def test_friction_of_implicit_steps_is_what_momentum_gains():
    scene, dt = rough(), 2e-4
    rollout = ds.Rollout(
        ds.ImplicitEulerSolver(scene, dt, tolerance=1e-11), 20, save_every=1, outputs=parts_of("body_1")
    )
    frames = rollout.forward()
    mass = scene.inputs.derive(scene.inputs.values).mass[4:, None]
    gained = np.diff((mass * frames.velocities[:, 4:]).sum(1), axis=0) / dt
    assert np.abs(frames["friction"]).max() > 1
    np.testing.assert_allclose(frames["normal"] + frames["friction"], frames["total"], atol=1e-12)
    np.testing.assert_allclose(frames["total"][1:], gained, atol=1e-6 * np.abs(gained).max())


@pytest.mark.parametrize("solver", [ds.StaticSolver, *IMPLICIT])
def test_friction_of_a_solve_has_derivatives(solver):
    """Of steps of two passes, every other of which is a frame, with an obstacle that a loss names too."""
    named = [
        ds.SelfContactForce("body_1", "friction", name="on"),
        ds.SelfContactForce("body_0", name="about", about=(0, 0.1, 0)),
        ds.SelfContactForce(name="each", per_vertex=True, part="friction"),
        ds.ContactForce("floor"),
    ]
    options = dict(load_steps=2) if solver is ds.StaticSolver else dict(substeps=2)
    made = dragged(solver, 4.0 if solver is ds.StaticSolver else 0.02, **options)
    rollout = ds.Rollout(made, 4, save_every=2, outputs=named, gradients="all")
    assert verify.dot_product_test(rollout) <= 1e-9
    if solver is not ds.StaticSolver:
        return
    rng, frames = np.random.default_rng(0), rollout.forward()
    for key in ("self_contact_friction", "rest_positions"):
        value = rollout.values[key]
        way = rng.normal(size=np.shape(value)) * verify.input_scale(rollout, key)
        tangents = rollout.tangents(frames, **{key: way})
        ends = [rollout.forward(**{key: value + sign * 1e-5 * way}) for sign in (1, -1)]
        for name in ("on", "about", "each"):
            difference = (ends[0][name] - ends[1][name]) / 2e-5
            np.testing.assert_allclose(tangents[name], difference, atol=1e-4 * np.abs(difference).max(), err_msg=key)


def test_forces_that_cannot_be():
    with pytest.raises(ValueError, match="part must be total, normal or friction"):
        ds.SelfContactForce("body_1", "all")
    with pytest.raises(ValueError, match="give on=.*or per_vertex=True"):
        ds.SelfContactForce()
    with pytest.raises(ValueError, match="has no SelfContact"):
        scene = ds.Scene(bodies(), ds.StableNeoHookean(5e4, 0.3), precision="f64")
        ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-4), 1, outputs=ds.SelfContactForce("body_1"))


# ---- pairs of sets, threads, checkpoints, refusals -------------------------------------------------------------------


def end_of(friction, **options):
    solver = ds.SemiImplicitSolver(rough(friction), dt=1e-4, **{k: v for k, v in options.items() if k == "parallel"})
    own = {k: v for k, v in options.items() if k != "parallel"}
    return ds.Rollout(solver, 60, gradients="all", **own)


def test_pairs_of_sets():
    """Pairs that are named have the friction that they would alone; others have none."""
    ends = {}
    for friction in (0.0, 0.4, {("body_0", "body_1"): 0.4}, {("body_1", "body_1"): 0.4, ("body_0", "body_1"): 0.0}):
        ends[str(friction)] = end_of(friction).forward().positions[-1]
    none, both, named, others = ends.values()
    np.testing.assert_array_equal(both, named)
    np.testing.assert_array_equal(none, others)
    assert np.abs(none - both).max() > 1e-5


def test_threads_and_checkpoints_do_not_change_a_bit():
    frames, gradients = [], []
    for options in ({}, dict(parallel=True), dict(checkpoint_every=7)):
        rollout = end_of(0.4, **options)
        frames.append(rollout.forward())
        adjoints = np.random.default_rng(1).normal(size=(2, *frames[0].positions.shape))
        gradients.append(rollout.vjp(frames[-1], *adjoints))
        np.testing.assert_array_equal(frames[-1].positions, frames[0].positions)
    for name, expected in gradients[0].items():
        np.testing.assert_array_equal(gradients[2][name], expected, err_msg=name)


def test_single_precision():
    rollout = ds.Rollout(ds.SemiImplicitSolver(rough(precision="f32"), dt=1e-4), 60, gradients="all")
    np.testing.assert_allclose(rollout.forward().positions[-1], end_of(0.4).forward().positions[-1], atol=2e-6)
    assert verify.dot_product_test(rollout) <= 2e-5


@pytest.mark.parametrize(
    "options, words",
    [
        (dict(friction=-0.1), "friction.*must be one number >= 0"),
        (dict(friction=0.1, friction_speed=0.0), "friction_speed.*must be > 0"),
        (dict(friction={"palm": 0.1}), "pairs of names of sets"),
        (dict(friction={("a", "b"): 0.1, ("b", "a"): 0.2}), "name it once"),
    ],
)
def test_wrong_numbers(options, words):
    with pytest.raises(ValueError, match=words):
        ds.SelfContact(1e4, 5e-3, **options)


def test_wrong_sets():
    with pytest.raises(ValueError, match="'palm', which is no set of vertices or tetrahedra of the mesh; it has"):
        rough({("palm", "body_0"): 0.5})
    with pytest.raises(ValueError, match="vertex 6 is in 'body_1' and in 'rail'"):
        rough({("rail", "body_1"): 0.5})
