"""Gates for gradients: dot products, Taylor tests, differences, exact identities, a closed form; scenes for other tests."""

from functools import cache

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.materials import MATERIALS
from diffsim_ti.solvers import SOLVERS as ALL_SOLVERS

SOLVERS = [s for s in ALL_SOLVERS if s.explicit]  # the implicit ones: test_implicit*.py
DT = 2e-3
INPUTS = (
    "initial_positions",
    "initial_velocities",
    "youngs_modulus",
    "poissons_ratio",
    "density",
    "gravity",
    "drag_rate",
    "ground_height",
    "barrier_stiffness",
    "barrier_width",
    "external_forces",
    "prescribed_motion",
    "rest_positions",
)
by_solver = pytest.mark.parametrize("solver", SOLVERS)
by_material = pytest.mark.parametrize("material", MATERIALS)


def random_mesh(resolution=3, seed=0) -> ds.TetrahedralMesh:
    """A cube cut in Kuhn tetrahedra whose vertices are moved at random by up to a tenth of an edge."""
    cube = ds.TetrahedralMesh.create_cube(resolution)
    moved = np.random.default_rng(seed).uniform(-0.1, 0.1, cube.vertices.shape) / (resolution - 1)
    return ds.TetrahedralMesh(cube.vertices + moved, cube.tetrahedra, vertex_sets=dict(cube.vertex_sets))


def random_start(mesh, rng) -> dict:
    """Moduli and density per tetrahedron, a start that is deformed and moving."""
    m = mesh.num_tetrahedra
    return dict(
        moduli=(1e5 * rng.uniform(0.7, 1.3, m), rng.uniform(0.2, 0.35, m)),
        density=1000 * rng.uniform(0.8, 1.2, m),
        initial_positions=mesh.vertices + rng.normal(size=mesh.vertices.shape) * 0.01,
        initial_velocities=rng.normal(size=mesh.vertices.shape) * 0.2,
    )


def full_scene(material=ds.StableNeoHookean, precision="f64", steps=100, resolution=3, seed=0) -> ds.Scene:
    """Everything at once: all terms, contact from the start, forces per step, moving fixed vertices."""
    mesh, rng = random_mesh(resolution, seed), np.random.default_rng(seed)
    start = random_start(mesh, rng)
    terms = [
        ds.Gravity(),
        ds.Drag(2.0),
        ds.Ground(-0.15, 1e3, 0.2),
        ds.ExternalForce(50 * rng.normal(size=(steps, mesh.num_vertices, 3))),
    ]
    return ds.Scene(
        mesh,
        material(*start.pop("moduli")),
        terms=terms,
        fixed="xmin",
        precision=precision,
        motion=lambda t: np.array([0.0, 0.05 * np.sin(20 * t), 0.02 * t]),
        **start,
    )


def free_scene(
    material=ds.StableNeoHookean, gravity=(0.3, -9.81, 1.0), precision="f64", resolution=3, seed=0, **changes
):
    """A deformed body of random moduli in free flight."""
    mesh, rng = random_mesh(resolution, seed), np.random.default_rng(seed)
    start = random_start(mesh, rng)
    return ds.Scene(
        mesh, material(*start.pop("moduli")), terms=ds.Gravity(gravity), precision=precision, **start | changes
    )


def rollout_of(
    scene, solver=ds.SemiImplicitSolver, steps=10, dt=DT, substeps=2, gradients="all", **options
) -> ds.Rollout:
    return ds.Rollout(solver(scene, dt=dt, substeps=substeps), steps, gradients=gradients, **options)


def error(a, b) -> float:
    """Norm of the difference over the norm."""
    return float(np.linalg.norm(np.subtract(a, b)) / max(np.linalg.norm(b), 1e-300))


# ---- one step ---------------------------------------------------------------------------------------------------------


@pytest.mark.executed_ptx
@by_solver
@by_material
@pytest.mark.parametrize("precision, gate", [("f64", 1e-13), ("f32", 1e-5)])
def test_one_step_is_the_transpose_of_its_tangent(solver, material, precision, gate):
    rollout = rollout_of(full_scene(material, precision), solver, 1, substeps=1)
    assert set(rollout.wanted) == set(INPUTS)
    assert verify.dot_product_test(rollout) <= gate
    for name in INPUTS:  # together a small input could hide behind a large one; one direction may be small by chance
        assert min(verify.dot_product_test(rollout, [name], seed=s) for s in (1, 2)) <= gate, name


@by_solver
def test_many_steps_are_the_transpose_of_their_tangent(solver):
    rollout = rollout_of(full_scene(), solver, 20, save_every=5, checkpoint_every=4)
    assert verify.dot_product_test(rollout) <= 1e-12  # round-off grows with the steps


# ---- Taylor tests and differences -------------------------------------------------------------------------------------


@cache
def differentiated(solver, steps):
    """A rollout of the full scene, its loss and its gradients, shared by the tests of single inputs."""
    rollout = rollout_of(full_scene(), solver, steps)
    loss = verify.linear_loss(rollout)
    frames = rollout.forward()
    return rollout, loss, rollout.vjp(frames, *loss(frames)[1:])


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("steps", [1, 10, 100])
@by_solver
def test_every_input_by_itself(solver, steps, name):
    rollout, loss, gradients = differentiated(solver, steps)
    x = rollout.values[name]
    direction = np.random.default_rng(3).standard_normal(x.shape) * verify.input_scale(rollout, name)

    def along(t):
        return loss(rollout.forward(**{name: x + t * direction}))[0]

    slope = float((gradients[name] * direction).sum())
    taylor = ds.taylor_test(along, 0.0, slope, 1.0, epsilon=1e-2)
    assert taylor.rate >= 1.95
    changes = [abs(along(t) - along(0.0)) for t in (2e-3, 1e-3)]
    assert 0.95 <= np.log2(changes[0] / changes[1]) <= 1.05  # the change itself is of first order
    differences, _ = verify.central_difference(along)
    assert slope == pytest.approx(differences, rel=1e-7)


@by_solver
def test_a_smooth_thousand_steps(solver):
    mesh = ds.TetrahedralMesh.create_cube(2)
    material = ds.StableNeoHookean(np.full(mesh.num_tetrahedra, 1e5), 0.3)
    scene = ds.Scene(mesh, material, terms=ds.Gravity(-1.0), fixed="ymax", precision="f64")
    rollout = rollout_of(scene, solver, 1000)
    report = ds.check_gradients(rollout, inputs=["youngs_modulus", "initial_velocities", "gravity"], verbose=False)
    assert report.passed, str(report)
    assert all(row.taylor_rate >= 1.95 for row in report.rows), str(report)


@by_solver
@by_material
def test_f32_gradients_agree_with_f64(solver, material):
    """100 steps; each input's gradient as a whole."""
    single = rollout_of(full_scene(material, "f32"), solver, 100)
    double = single.with_scene(precision="f64")
    frames = double.forward()
    w, z = verify.linear_loss(double)(frames)[1:]
    exact, rough = double.vjp(frames, w, z), single.vjp(single.forward(), w, z)
    for name in INPUTS:
        # by the drag rate little is left of much: what contacts push cancels in it
        assert error(rough[name], exact[name]) <= (2e-3 if name == "drag_rate" else 1e-3), name


# ---- identities that hold on any mesh (I1 to I9) ------------------------------------------------------------------------


def final_loss_gradient(rollout, by_final, velocities=None):
    """Gradients for a loss of the last frame: its adjoints there."""
    frames = rollout.forward()
    adjoints = []
    for last in (by_final, velocities):
        adjoint = np.zeros(frames.positions.shape)
        adjoint[-1] = 0 if last is None else last
        adjoints.append(adjoint)
    return rollout.vjp(frames, *adjoints)


def assert_zero_sum(*terms, gate=1e-12):
    """The terms of all arrays cancel, to round-off of the largest; columns, if any, one by one."""
    total = sum(np.atleast_2d(t).sum(0) for t in terms)
    largest = max(np.abs(t).max() for t in terms)
    assert largest > 0
    assert np.abs(total).max() <= gate * largest


STEPS = 20
weights = np.random.default_rng(8).normal


@by_solver
@by_material
def test_stiffness_and_density_scale_together(solver, material):
    """I1: scaling all E and rho together changes nothing, so both cannot be found from motion under gravity."""
    scene = free_scene(material, fixed="ymax")
    g = final_loss_gradient(rollout_of(scene, solver, STEPS), weights(size=(27, 3)), weights(size=(27, 3)))
    values = scene.inputs.values
    E_part, rho_part = (values[name] * g[name] for name in ("youngs_modulus", "density"))
    assert_zero_sum(E_part[:, None], rho_part[:, None])


@by_solver
@by_material
def test_free_flight(solver, material):
    """I2, I3, I4: the mean of a free body moves as a point does."""
    n, w = STEPS, weights(size=(27, 3))
    rollout = rollout_of(free_scene(material), solver, n)
    g = final_loss_gradient(rollout, w)
    assert_zero_sum(g["initial_positions"], -w)
    assert_zero_sum(g["initial_velocities"], -n * DT * w)
    passes, h = n * 2, DT / 2
    fall = passes * (passes + 1) / 2 if solver is ds.SemiImplicitSolver else passes**2 / 2
    assert_zero_sum(g["gravity"][None], -(h**2) * fall * w)


@by_solver
@pytest.mark.parametrize("material", [m for m in MATERIALS if m is not ds.LinearElastic])
def test_rotation(solver, material):
    """I5: a loss that does not see rotations, a law that does not either."""
    rollout = rollout_of(free_scene(material, gravity=(0.0, 0.0, 0.0)), solver, STEPS)
    frames, values = rollout.forward(), rollout.values
    a, b, c = weights(size=(3, 27, 1))
    x, v = frames.positions[-1], frames.velocities[-1]  # L = sum a |x|^2 / 2 + b x . v + c |v|^2 / 2
    g = final_loss_gradient(rollout, a * x + b * v, b * x + c * v)
    assert_zero_sum(*(np.cross(values[name], g[name]) for name in ("initial_positions", "initial_velocities")))


def test_linear_elasticity_sees_rotations():
    """The test above can fail: I5 does not hold for a law that is not frame indifferent."""
    rollout = rollout_of(free_scene(ds.LinearElastic, gravity=(0.0, 0.0, 0.0)), steps=STEPS)
    frames, values = rollout.forward(), rollout.values
    g = final_loss_gradient(rollout, frames.positions[-1] * weights(size=(27, 1)))
    with pytest.raises(AssertionError):
        assert_zero_sum(*(np.cross(values[n], g[n]) for n in ("initial_positions", "initial_velocities")), gate=1e-6)


@by_solver
@by_material
def test_free_fall_knows_no_stiffness(solver, material):
    """I6: from the rest shape nothing strains."""
    mesh = random_mesh()
    scene = free_scene(material, initial_positions=mesh.vertices, initial_velocities=np.zeros(mesh.vertices.shape))
    rollout, w = rollout_of(scene, solver, STEPS), weights(size=(27, 3))
    frames = rollout.forward()
    g = final_loss_gradient(rollout, w)
    scale = np.abs(w * (frames.positions[-1] - frames.positions[0])).sum() / rollout.values["youngs_modulus"].min()
    assert np.abs(g["youngs_modulus"]).max() <= 1e-12 * scale


@by_solver
@by_material
@pytest.mark.parametrize("degree", [1, 2])
def test_scaling_of_lengths(solver, material, degree):
    """I8: lengths, velocities and gravity times s, moduli times s^2."""
    rollout = rollout_of(free_scene(material, fixed="ymax"), solver, STEPS)
    frames, values = rollout.forward(), rollout.values
    w, x = weights(size=(27, 3)), frames.positions[-1]
    g = final_loss_gradient(rollout, w if degree == 1 else w * x)  # L = w . x or L = w . x^2 / 2
    names = ("rest_positions", "initial_positions", "initial_velocities", "gravity")
    scaled = [values[name].ravel() * g[name].ravel() for name in names]
    loss = w * x if degree == 1 else w * x**2 / 2
    parts = (*scaled, 2 * values["youngs_modulus"] * g["youngs_modulus"], -degree * loss.ravel())
    assert_zero_sum(*(part[:, None] for part in parts))


@by_solver
@by_material
def test_scaling_of_time(solver, material):
    """I9, with the derivative by dt from differences, which resolve 1e-8."""
    scene, w = free_scene(material, fixed="ymax"), weights(size=(27, 3))
    rollout = rollout_of(scene, solver, STEPS)
    g, values = final_loss_gradient(rollout, w), rollout.values

    def loss(t):
        return float((w * rollout_of(scene, solver, STEPS, dt=DT * (1 + t)).forward().positions[-1]).sum())

    by_dt, _ = verify.central_difference(loss, 0.1)
    parts = [
        values["initial_velocities"] * g["initial_velocities"],
        2 * values["gravity"] * g["gravity"],
        2 * values["youngs_modulus"] * g["youngs_modulus"],
    ]
    assert_zero_sum(np.array([[by_dt]]), *(-part.reshape(-1, 1) for part in parts), gate=1e-7)


# ---- closed form ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "nu, u, by_E, by_rho, by_nu",
    [
        (0.0, -0.399914771245, 1.415950307e-6, -1.415950307e-4, -1.415950307e-1),
        (0.3, 0.380625161974, 1.527550728e-5, -1.527550728e-3, -1.175039021),
        (0.45, -0.024327235124, 4.692056810e-5, -4.692056810e-3, -3.235901248),
    ],
)
@pytest.mark.parametrize("apex", [(0.2, 0.3), (-0.7, 1.4)])
def test_shear_oscillator(nu, u, by_E, by_rho, by_nu, apex):
    """One tetrahedron on a fixed base, its apex moved sideways: a linear oscillator at any amplitude."""
    mesh = ds.TetrahedralMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [*apex, 0.5]], [[0, 1, 2, 3]])
    start = mesh.vertices + [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0.4, 0, 0]]
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean([1e5], nu),
        density=[1000.0],
        terms=ds.Gravity(0.0),
        fixed=[0, 1, 2],
        initial_positions=start,
        precision="f64",
    )
    rollout = rollout_of(scene, steps=1000, dt=1e-3, substeps=1)
    frames = rollout.forward()
    w = np.zeros((4, 3))
    w[3, 0] = 1
    g = final_loss_gradient(rollout, w)
    assert frames.positions[-1, 3, 0] - apex[0] == pytest.approx(u, rel=1e-9)
    # the table has ten digits
    assert g["youngs_modulus"][0] == pytest.approx(by_E, rel=1e-9)
    assert g["density"][0] == pytest.approx(by_rho, rel=1e-9)
    assert g["poissons_ratio"] == pytest.approx(by_nu, rel=1e-9)


# ---- what users run ---------------------------------------------------------------------------------------------------


@by_solver
def test_check_gradients_passes_and_prints(solver, capsys):
    report = ds.check_gradients(rollout_of(full_scene(), solver, 10, save_every=5))
    assert report.passed and {row.input for row in report.rows} == set(INPUTS)
    said = capsys.readouterr().out
    assert all(name in said for name in INPUTS) and "right" in said and "WRONG" not in said


def test_check_gradients_of_f32():
    report = ds.check_gradients(rollout_of(full_scene(precision="f32"), steps=10), verbose=False)
    assert report.passed, str(report)


def test_check_gradients_takes_a_loss():
    rollout = rollout_of(full_scene(), steps=10, save_every=5)

    def loss(frames):
        return 0.5 * float((frames.velocities[1:] ** 2).sum()), None, np.r_[np.zeros((1, 27, 3)), frames.velocities[1:]]

    report = ds.check_gradients(rollout, loss, inputs=["youngs_modulus", "drag_rate"], verbose=False)
    assert report.passed and [row.input for row in report.rows] == ["youngs_modulus", "drag_rate"]


@pytest.mark.parametrize("name", ["density", "rest_positions", "gravity"])
def test_a_gradient_asked_for_alone_is_the_same(name):
    every, alone = (rollout_of(full_scene(), steps=10, gradients=names) for names in ("all", [name]))
    w = np.random.default_rng(3).standard_normal(every.forward().positions.shape)
    a, b = (r.vjp(r.forward(), w)[name] for r in (every, alone))
    assert np.abs(a - b).max() <= 1e-14 * np.abs(a).max()


@pytest.mark.parametrize("name", ["youngs_modulus", "gravity", "rest_positions"])
def test_check_gradients_says_wrong(monkeypatch, name):
    rollout = rollout_of(full_scene(), steps=10)
    right = rollout.vjp
    monkeypatch.setattr(rollout, "vjp", lambda *a: (g := right(*a)) | {name: g[name] * 1.001})
    report = ds.check_gradients(rollout, verbose=False)
    assert not report.passed and [row.input for row in report.rows if not row.passed] == [name]
    assert str(report).count("WRONG") == 1


def random_function(rng):
    """(f, f'(0)): waves with kinks of second order, some near 0, in 10 % of them a corner at 0, and noise."""
    w = 10 ** rng.uniform(-1, rng.choice([0.5, 1.5, 2.5]), 3)
    a, p, slope = rng.standard_normal(3) / w ** rng.uniform(0, 2), rng.uniform(0, 6.3, 3), rng.standard_normal()
    at = rng.choice([-1, 1], 10) * 10 ** rng.uniform(-7, 0, 10)
    kinks = rng.choice([0, 0, 1]) * rng.standard_normal(10) * 10 ** rng.uniform(-3, 2, 10)
    corner, noise = 1e-2 * rng.standard_normal() * (rng.random() < 0.1), 10 ** rng.uniform(-17, -7)

    def f(t):
        bent = (kinks * np.maximum(0, (t - at) * np.sign(at)) ** 2).sum() + corner * max(t, 0.0)
        own = np.random.default_rng(np.float64(t).view(np.uint64)).standard_normal()  # the same at the same t
        return float(1 + slope * t + (a * np.sin(w * t + p)).sum() + bent + noise * own)

    return f, float(slope + (a * w * np.cos(p)).sum() + rng.choice([0, corner]))


def test_verdicts_on_derivatives_of_random_functions():
    """No right one is called WRONG, none whose fault is above the resolution right; most are told apart."""
    told = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        f, slope = random_function(rng)
        right = verify.Judgement(verify.CentralDifferences(f), slope, 1e-6)
        wrong = slope * (1 + rng.choice([-1, 1]) * 10 ** rng.uniform(-4, 0))
        planted = verify.Judgement(verify.CentralDifferences(f), wrong, 1e-6)
        told.append((right.judge() == "right", planted.judge() == "WRONG"))
        assert right.verdict != "WRONG", seed
        fault = abs(wrong - slope) / max(abs(wrong), abs(slope))
        assert planted.verdict != "right" or fault <= planted.resolution, seed
    assert np.mean(told, 0).min() > 0.7
    for f in (lambda t: 3.0, lambda t: 3.0 + t * t):  # of which nothing depends on t, or has its least there
        assert [verify.Judgement(verify.CentralDifferences(f), a, 1e-6).judge() == "right" for a in (0.0, 1e-3)] == [
            True,
            False,
        ]


@pytest.mark.parametrize("solver", [ds.StaticSolver, ds.BDF2Solver])
def test_solvers_are_solved_to_rounding_for_the_check(solver, monkeypatch):
    """At a loose tolerance right gradients are right, wrong ones wrong, and the rollout is as it was."""
    mesh = ds.TetrahedralMesh.create_box((4, 2, 2), (0.6, 0.2, 0.2), pattern="five")
    scene = ds.Scene(mesh, ds.StableNeoHookean(2e5, 0.3), terms=[ds.Gravity()], fixed="xmin", precision="f64")
    rollout = ds.Rollout(solver(scene, dt=1e-2, tolerance=1e-3), 2)
    names, before = ["youngs_modulus", "poissons_ratio"], rollout.forward().positions
    report = ds.check_gradients(rollout, inputs=names, verbose=False)
    assert report.passed and "tolerance of 1e-12" in str(report), report
    assert rollout.solver.tolerance == 1e-3 and np.array_equal(rollout.forward().positions, before)
    right = rollout.vjp
    monkeypatch.setattr(rollout, "vjp", lambda *a: (g := right(*a)) | {names[0]: g[names[0]] * 1.0001})
    report = ds.check_gradients(rollout, inputs=names, verbose=False)
    assert [row.verdict for row in report.rows] == ["WRONG", "right"], report


def test_what_noise_hides_is_not_resolved():
    """An input that the loss depends on less than it scatters: neither right nor WRONG, with advice."""
    rollout = rollout_of(full_scene(), steps=10)
    plain = verify.linear_loss(rollout)

    def loss(frames):
        value, *rest = plain(frames)
        return 1e12 + value, *rest

    report = ds.check_gradients(rollout, loss, inputs=["youngs_modulus"], verbose=False)
    row = report.rows[0]
    assert row.verdict == "NOT RESOLVED" and not report.passed and row.resolution > 0.1
    assert "rounding hides it" in row.advice and "fewer than its 10 steps" in str(report)


def test_taylor_test_tells_right_from_wrong():
    def f(x):
        return float(np.sin(x).sum())

    x = np.array([0.3, 1.0, -0.4])
    assert ds.taylor_test(f, x, np.cos(x)).rate >= 1.95
    assert ds.taylor_test(f, x, 1.001 * np.cos(x), epsilon=1e-3).rate < 1.5
    assert ds.taylor_test(lambda x: float(x.sum()), x, np.ones(3)).rate == np.inf  # linear: nothing is left over


def two_directions(rollout):
    rng = np.random.default_rng(5)
    names = ("youngs_modulus", "initial_velocities", "gravity")
    sizes = {name: verify.input_scale(rollout, name) for name in names}
    return [{n: rng.standard_normal(rollout.values[n].shape) * sizes[n] for n in names} for _ in range(2)]


def dot(a: dict, b: dict) -> float:
    return sum(float((a[name] * b[name]).sum()) for name in a)


@by_solver
def test_hessian_product(solver):
    rollout = rollout_of(full_scene(), solver, 20)
    loss = verify.linear_loss(rollout)
    a, b = two_directions(rollout)
    Ha, Hb = (verify.hessian_product(rollout, loss, d, epsilon=1e-3) for d in (a, b))
    assert dot(Ha, b) == pytest.approx(dot(Hb, a), rel=1e-5)

    def along(t):
        return loss(rollout.forward(**{name: rollout.values[name] + t * a[name] for name in a}))[0]

    t = 1e-2  # the second difference loses digits as 1 / t^2, and its error is t^2
    assert dot(Ha, a) == pytest.approx((along(t) - 2 * along(0.0) + along(-t)) / t**2, rel=1e-3)


@by_solver
def test_gauss_newton_product(solver):
    rollout = rollout_of(full_scene(), solver, 20, save_every=10)
    frames = rollout.forward()
    weight = np.random.default_rng(1).uniform(0, 1, frames.positions.shape)
    a, b = two_directions(rollout)
    Ga, Gb = (verify.gauss_newton_product(rollout, frames, d, weight) for d in (a, b))
    assert dot(Ga, b) == pytest.approx(dot(Gb, a), rel=1e-12)
    dx, _ = rollout.jvp(frames, **a)
    assert dot(Ga, a) == pytest.approx(float((weight * dx**2).sum()), rel=1e-12) and dot(Ga, a) > 0


def test_gradients_are_only_of_what_is_wanted():
    rollout = rollout_of(full_scene(), steps=2, gradients=["drag_rate"])
    assert list(rollout.vjp(rollout.forward(), weights(size=(2, 27, 3)))) == ["drag_rate"]
    assert "rest_positions" not in rollout_of(full_scene(), steps=2, gradients=None).wanted
    with pytest.raises(ValueError, match="no input named 'stiffness'.*youngs_modulus"):
        rollout_of(full_scene(), gradients=["stiffness"])


def test_arrays_that_the_caller_changes_later():
    """A caller that updates its array in place gets the run of the new numbers, and old frames keep their own."""
    rollout = rollout_of(full_scene(), steps=5)
    E = np.array(rollout.values["youngs_modulus"])
    w = weights(size=(2, 27, 3))
    frames = rollout.forward(youngs_modulus=E)
    before = rollout.vjp(frames, w)
    E *= 2
    twice = rollout.forward(youngs_modulus=E)
    assert np.array_equal(twice.positions, rollout.forward(youngs_modulus=E.copy()).positions)
    assert not np.array_equal(twice.positions, frames.positions)
    assert np.array_equal(rollout.vjp(frames, w)["youngs_modulus"], before["youngs_modulus"])


# ---- also on the backend that DIFFSIM_TI_ARCH names (Vulkan has f32 only) ------------------------------------------------


@pytest.mark.backends
@by_solver
def test_backend_transpose(solver):
    rollout = rollout_of(full_scene(precision="f32", resolution=2), solver, 3, save_every=1)
    assert verify.dot_product_test(rollout) <= 1e-5


@pytest.mark.backends
def test_backend_identities():
    n, w = 5, weights(size=(8, 3))
    g = final_loss_gradient(rollout_of(free_scene(precision="f32", resolution=2), steps=n, substeps=1), w)
    assert_zero_sum(g["initial_positions"], -w, gate=1e-4)
    assert_zero_sum(g["gravity"][None], -(DT**2) * n * (n + 1) / 2 * w, gate=1e-4)


@pytest.mark.backends
@pytest.mark.parametrize("checkpoint_every", [None, 6])
def test_backend_oscillator(checkpoint_every):
    """The closed form again, derivatives by complex steps: gradients here have the right size, not only symmetry."""
    n, dt, u0, h, E, rho, nu = 20, 4e-3, 0.4, 0.5, 1e5, 1000.0, 0.3

    def u(E, rho, nu):
        theta = 2 * np.arcsin(np.sqrt(E / (2 * (1 + nu)) / rho) / h * dt)
        return u0 * np.cos((n + 0.5) * theta) / np.cos(theta / 2)

    mesh = ds.TetrahedralMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.3, h]], [[0, 1, 2, 3]])
    start = mesh.vertices + [[0, 0, 0], [0, 0, 0], [0, 0, 0], [u0, 0, 0]]
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean([E], [nu]),
        density=[rho],
        terms=ds.Gravity(0.0),
        fixed=[0, 1, 2],
        initial_positions=start,
        precision="f32",
    )
    rollout = rollout_of(scene, steps=n, dt=dt, substeps=1, checkpoint_every=checkpoint_every)
    w = np.zeros((4, 3))
    w[3, 0] = 1
    g = final_loss_gradient(rollout, w)
    tiny = 1e-20j
    assert rollout.forward().positions[-1, 3, 0] - 0.2 == pytest.approx(u(E, rho, nu), abs=1e-4 * u0)
    assert g["youngs_modulus"] == pytest.approx(u(E + tiny, rho, nu).imag / 1e-20, rel=1e-3)
    assert g["density"] == pytest.approx(u(E, rho + tiny, nu).imag / 1e-20, rel=1e-3)
    assert g["poissons_ratio"] == pytest.approx(u(E, rho, nu + tiny).imag / 1e-20, rel=1e-3)
