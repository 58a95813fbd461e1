"""Springs, cables and elastic foundations: closed forms, every derivative, the stable step, energy."""

import numpy as np
import pytest
from test_every_adjoint import assert_transposed
from test_gradients import random_mesh
from test_term_order import SOLVERS

import diffsim_ti as ds
from diffsim_ti.mechanics.host_force import HostForces
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.mechanics.lines.interaction import SpringsAndCables

STEPS = 4
TIMES = np.array([0.0, 0.003, 0.1])
every = pytest.mark.parametrize("kind", SOLVERS, ids=lambda s: s.__name__)


def upper(x, n):
    return x[:, 0] > 0.6


def lidded() -> ds.TetrahedralMesh:
    return random_mesh(2).with_surface_set("lid", upper)


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
        ds.Gravity(),
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
    """By a dot product each, in f32 in one solver of each family; a slack cable does not act."""
    gate = (1e-12 if kind.explicit else 1e-8) if precision == "f64" else (3e-5 if kind.explicit else 1e-3)
    without = ("slack.length", "slack.stiffness") + (("drag_rate",) if kind is ds.StaticSolver else ())
    assert_transposed(rollout_of(kind, attached(lidded()), precision), gate, without)


@every
def test_a_simulator_takes_the_tensions_of_each_step(kind):
    rollout = rollout_of(kind, attached(lidded()))
    sim = ds.Simulator(rollout.solver)
    expected = rollout.forward().positions[-1]
    for _ in range(2):
        sim.run(STEPS)
        np.testing.assert_allclose(sim.positions, expected, rtol=0, atol=1e-10)
        sim.reset()


@pytest.mark.parametrize("kind", [ds.ImplicitEulerSolver, ds.StaticSolver], ids=lambda s: s.__name__)
def test_a_run_again_has_the_same_bits(kind):
    """Also the first one again: nothing is put into order on the way, as corners of tetrahedra are that do not ascend."""
    mesh = lidded()
    turned = mesh.tetrahedra[:, [2, 0, 1, 3]]
    mesh = ds.TetrahedralMesh(mesh.vertices, turned, vertex_sets=mesh.vertex_sets).with_surface_set("lid", upper)
    rollout = rollout_of(kind, attached(mesh), mesh=mesh)
    assert rollout.scene.interaction(SpringsAndCables).paths.matrix(mesh.num_vertices).has_canonical_format
    first, seed = rollout.forward(), np.random.default_rng(5)
    seed = seed.normal(size=first.positions.shape)
    gradients = rollout.vjp(first, seed)
    rollout.forward(density=1.1 * rollout.values["density"])
    again = rollout.forward()
    assert np.array_equal(again.displacements, first.displacements)
    for name, value in rollout.vjp(again, seed).items():
        assert np.array_equal(value, gradients[name]), name


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.StaticSolver], ids=lambda s: s.__name__)
def test_gradients_against_differences(kind):
    names = ["spring_rest_length", "struts.anchors", "cable_length", "tendon.tension", "tendon.anchors"]
    names += ["foundation_tangential", "spring_stiffness"] + ["rest_positions"] * kind.explicit
    rollout = ds.Rollout(solver_of(kind, scene(attached(lidded()))), 2 if kind.explicit else 1, gradients="all")
    table = ds.check_gradients(rollout, inputs=names)
    assert all(row.relative_error < 1e-5 for row in table.rows), table


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_reactions_know_them(kind):
    solver = solver_of(kind, scene(attached(lidded())))
    rollout = ds.Rollout(solver, STEPS, save_every=2, outputs=[ds.Reaction()], gradients="all")
    assert ds.dot_product_test(rollout) < 1e-8


def watched() -> list:
    """Length and tension of each kind of spring and cable."""
    lines = "struts", "tendon", "slack", "spring", "rope"
    return [
        kind(name, name=f"{what}_{name}")
        for kind, what in ((ds.Length, "length"), (ds.Tension, "pull"))
        for name in lines
    ]


def named(mesh) -> list:
    """The same terms, those with names for `watched`."""
    a = inside(mesh)
    more = [
        ds.Spring(7, 2, 900.0, rest_length=0.7, name="spring"),
        ds.Cable([3, a, 7], length=lambda t: 1.2 - 20 * t, stiffness=2000.0, name="rope"),
    ]
    return [*attached(mesh), *more]


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.StaticSolver], ids=lambda s: s.__name__)
def test_lengths_and_tensions_have_gradients(kind):
    """Of springs of several kinds, and cables over time, one of them slack: seeds are the transpose of tangents for every
    input, and an own field of a loss agrees with differences."""
    rollout = ds.Rollout(solver_of(kind, scene(named(lidded()))), 2, save_every=1, outputs=watched(), gradients="all")
    frames, rng = rollout.forward(), np.random.default_rng(5)
    assert frames["length_struts"].shape == (3, 2) and frames["pull_rope"].shape == (3,)
    assert not frames["pull_slack"].any() and frames["pull_tendon"] == pytest.approx(
        [10, 10 + 20 * 2 / 3, 30 + 20 / 97]
    )
    seeds = {name: rng.normal(size=frames[name].shape) for name in rollout.computed}
    gradients = {name: rollout.vjp(frames, **{name: seed}) for name, seed in seeds.items()}
    for key in rollout.inputs:
        direction = rng.normal(size=rollout.values[key].shape) * ds.verify.input_scale(rollout, key)
        if key in ("initial_velocities", "initial_positions"):
            direction[rollout.scene.fixed] = 0
        tangents = rollout.tangents(frames, **{key: direction})
        for name, seed in seeds.items():
            terms = tangents[name] * seed
            pulled = (gradients[name][key] * direction).sum()
            scale = max(np.abs(terms).max(), 1e-9 * np.abs(frames[name]).max())
            assert abs(terms.sum() - pulled) <= (1e-11 if kind.explicit else 1e-7) * scale, (key, name)
    if kind.explicit:
        keys = ["struts.anchors", "rope.length", "rope.stiffness", "struts.tension", "spring.rest_length"]
        table = ds.check_gradients(rollout, inputs=[*keys, "rest_positions", "tendon.anchors"], verbose=False)
        assert all(row.relative_error < 1e-5 for row in table.rows), table


def test_one_anchor_that_holds_many():
    """Its gradient is the sum of those by an anchor of each, which stand at one place."""
    mesh, place, many = ds.TetrahedralMesh.create_cube(2, 1.0), np.array([0.3, 2.0, 0.4]), [2, 3, 6]
    found = []
    for anchors in (place, np.tile(place, (3, 1))):
        terms = [ds.Spring(many, ds.Anchor(anchors), 900.0, rest_length=0.4, name="ropes"), ds.Gravity()]
        made = ds.Scene(mesh, ds.StableNeoHookean(1e4, 0.3), terms=terms, precision="f64")
        rollout = ds.Rollout(ds.SemiImplicitSolver(made, dt=1e-3), 5, gradients="all")
        frames = rollout.forward()
        found.append(rollout.vjp(frames, positions=np.cos(3 * frames.positions))["ropes.anchors"])
    assert found[0].shape == (3,) and found[1].shape == (3, 3) and np.abs(found[1]).min() > 0
    np.testing.assert_allclose(found[0], found[1].sum(0), rtol=1e-12)


def test_tension_is_what_holds_an_anchor():
    """A spring's pull is k (L - l), and by direction the force on its ends; a term may be named by itself."""
    mesh, place = lidded(), np.array([0.5, 2.0, 0.4])
    spring = ds.Spring(7, ds.Anchor(place), 900.0, rest_length=0.4)
    of = scene([spring, ds.Gravity()], mesh=mesh, fixed="xmin", initial_positions=None)
    outputs = [ds.Length(spring), ds.Tension(spring)]
    frames = ds.Rollout(ds.StaticSolver(of, tolerance=1e-11), 1, outputs=outputs).forward()
    L = np.linalg.norm(frames.positions[:, 7] - place, axis=1)
    np.testing.assert_allclose(frames["length"], L, rtol=1e-12)
    np.testing.assert_allclose(frames["tension"], 900 * (L - 0.4), rtol=1e-10)
    sim = ds.Simulator(ds.VelocityVerletSolver(of, dt=1e-4))
    assert sim.output(ds.Tension(spring)) == pytest.approx(frames["tension"][0])
    with pytest.raises(ValueError, match="this scene has no spring or cable 'rope'; it has .*: give them a name="):
        ds.Rollout(sim.solver, 1, outputs=ds.Length("rope"))


# ---- energies, forces, momentum ------------------------------------------------------------------------------------------


def ties_of(terms, mesh) -> HostForces:
    """Springs, cables and foundations on the host, at the start."""
    of = scene(terms, mesh=mesh)
    return host_forces(of).with_energy.take(of.inputs.derive(of.inputs.at_step(0, 1e-3)))


def test_forces_are_derivatives_of_energies():
    mesh, rng = lidded(), np.random.default_rng(3)
    held = ties_of(attached(mesh), mesh)
    u = 0.05 * rng.normal(size=mesh.vertices.shape)
    v, h = rng.normal(size=u.shape), 1e-6
    slope = (held.energies(u + h * v).sum() - held.energies(u - h * v).sum()) / (2 * h)
    assert -(held.forces(u) * v).sum() == pytest.approx(slope, rel=1e-7)
    curve = (held.forces(u - h * v) - held.forces(u + h * v)) / (2 * h)
    np.testing.assert_allclose(held.product(u, v), curve, rtol=0, atol=1e-7 * np.abs(curve).max())
    for i, d in ((2, 0), (5, 1), (7, 2)):  # its diagonal blocks
        unit = np.zeros_like(u)
        unit[i, d] = 1
        np.testing.assert_allclose(held.product(u, unit)[i], held.blocks(u)[i, :, d], atol=1e-9)
    blocks = np.linalg.norm(matrix(held, u).reshape(len(u), 3, len(u), 3), 2, axis=(1, 3)).sum(1)
    assert np.all(blocks <= held[0].row_sums(u) + np.abs(held[1].K).sum((1, 2)).max())


def matrix(held, u, convex=False) -> np.ndarray:
    """d2E/du2 of what is attached."""
    K = np.stack([held.product(u, x.reshape(-1, 3), convex).ravel() for x in np.eye(u.size)])
    np.testing.assert_allclose(K, K.T, atol=1e-9)
    return K


def test_what_is_pressed_yields_sideways_but_for_its_convex_part():
    mesh = lidded()
    held = ties_of([ds.Spring(7, ds.Anchor([0.0, 2.0, 0.0]), 900.0, tension=-500.0)], mesh)
    still = np.zeros_like(mesh.vertices)
    assert np.linalg.eigvalsh(matrix(held, still)).min() < -100
    assert np.linalg.eigvalsh(matrix(held, still, convex=True)).min() > -1e-9


def first_push(terms, mesh, precision="f64") -> np.ndarray:
    """Momentum [N s] per time that the first step gives to each free vertex of a body at rest."""
    of = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, precision=precision)
    sim = ds.Simulator(ds.SemiImplicitSolver(of, dt=1e-6))
    sim.step()
    return of.inputs.derive(of.inputs.values).mass[:, None] * sim.velocities / 1e-6


@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_between_points_of_the_body_nothing_is_left(precision):
    """Neither force nor moment; explicit passes and the host have the same forces."""
    mesh = lidded()
    a, b = inside(mesh), inside(mesh, 3)
    own = [ds.Spring([7, 5], a, [900.0, 700.0], tension=50.0), ds.Cable([1, b, 5, a, 2], tension=40.0)]
    f = first_push(own, mesh, precision)
    small = 1e-7 if precision == "f64" else 1e-3
    assert np.abs(f.sum(0)).max() < small and np.abs(np.cross(mesh.vertices, f).sum(0)).max() < small
    held = ties_of(own, mesh)
    np.testing.assert_allclose(f, held.forces(np.zeros_like(f)), atol=small)
    assert np.abs(f).max() > 10


def test_a_cable_has_one_tension():
    """At each of its points it pulls with T towards the next and the one before."""
    mesh = lidded()
    x, place, T = mesh.vertices, np.array([0.5, 1.5, 0.4]), 40.0
    f = first_push([ds.Cable([1, 6, ds.Anchor(place), 4], tension=T)], mesh)

    def towards(a, b):
        return (b - a) / np.linalg.norm(b - a)

    expected = np.zeros_like(f)
    expected[1] = T * towards(x[1], x[6])
    expected[6] = T * (towards(x[6], x[1]) + towards(x[6], place))
    expected[4] = T * towards(x[4], place)
    np.testing.assert_allclose(f, expected, atol=1e-7)


# ---- closed forms --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind", [ds.SemiImplicitSolver, ds.VelocityVerletSolver, ds.ImplicitMidpointSolver], ids=lambda s: s.__name__
)
def test_period_of_a_mass_on_a_spring(kind):
    """A spring at each vertex, as stiff as this is heavy: the body swings with 2 pi sqrt(m / k), as the method has it."""
    mesh, omega, h = lidded(), 40.0, 2e-3
    mass = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0).inputs
    k = omega**2 * mass.derive(mass.values).mass
    spring = ds.Spring(np.arange(8), ds.Anchor(mesh.vertices - [2.0, 0, 0]), k)
    start = mesh.vertices + [0.3, 0, 0]
    exact = {} if kind.explicit else dict(tolerance=1e-12)
    of = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, [spring], precision="f64", initial_positions=start)
    x = ds.Rollout(kind(of, dt=h, **exact), 150, save_every=1).forward().displacements[:, :, 0]
    numeric = 2 / h * (np.arctan if kind is ds.ImplicitMidpointSolver else np.arcsin)(omega * h / 2)
    t = h * np.arange(151)
    swing = np.cos(numeric * t)
    if kind is ds.SemiImplicitSolver:  # starts with a whole kick
        swing = np.cos(numeric * (t + h / 2)) / np.cos(numeric * h / 2)
    np.testing.assert_allclose(x, 0.3 * np.tile(swing, (8, 1)).T, atol=1e-8)
    assert numeric == pytest.approx(omega, rel=1e-3)


def column(terms, n=5, **options) -> ds.Scene:
    mesh = ds.TetrahedralMesh.create_box((3, n, 3), (0.4, 1.0, 0.4), pattern="five")
    return ds.Scene(mesh, ds.LinearElastic(1e5, 0.3), 1000.0, terms, precision="f64", **options)


def test_settlement_of_a_body_on_a_foundation():
    """m g / (k A), and the foundation holds the body: nothing else has to but for its sway."""
    c, bottom = 5e5, lambda X: X[:, 1] < 1e-9
    of = column([ds.Gravity(), ds.ElasticFoundation(c, 2e3, "ymin", name="bed")])
    rollout = ds.Rollout(ds.StaticSolver(of, tolerance=1e-11), 1, gradients=("bed.normal",))
    frames = rollout.forward()
    X, w = of.mesh.vertices, of.inputs.derive(of.inputs.values).foundation[1::3, 1]
    w = w / w.sum()  # areas
    u = frames.displacements[-1][bottom(X), 1]
    expected = -1000 * 9.81 * 1.0 / c
    assert (w * u).sum() == pytest.approx(expected, rel=1e-8)
    seed = np.zeros(frames.positions.shape)
    seed[-1, bottom(X), 1] = w
    assert rollout.vjp(frames, seed)["bed.normal"] == pytest.approx(-expected / c, rel=1e-7)


def test_a_rod_that_its_sides_hold():
    """Pulled at one end: E A u'' = t p u, so u = F / (E A b) cosh(b (L - x)) / sinh(b L), b^2 = t p / (E A)."""
    n, side, E, t, F = 41, 0.05, 1e5, 2e4, 2.0
    mesh = ds.TetrahedralMesh.create_box((n, 2, 2), (1.0, side, side))
    sides = lambda x, n: np.abs(n[:, 0]) < 0.5  # noqa: E731
    mesh = mesh.with_surface_set("sides", sides)
    pull = ds.Traction([-F / side**2, 0, 0], "xmin")
    of = ds.Scene(mesh, ds.LinearElastic(E, 0.0), 1000.0, [pull, ds.ElasticFoundation(0, t, "sides")], precision="f64")
    u = ds.Rollout(ds.StaticSolver(of, tolerance=1e-10), 1).forward().displacements[-1]
    x, b = mesh.vertices[:, 0], np.sqrt(t * 4 * side / (E * side**2))
    expected = -F / (E * side**2 * b) * np.cosh(b * (1 - x)) / np.sinh(b)
    assert 2 < b < 12 and np.abs(u[:, 0] - expected).max() < 0.01 * np.abs(expected).max()


def hung(cable, **options) -> ds.Scene:
    return column([ds.Gravity(), cable], fixed=dict(xmin="x", zmin="z", xmax="x", zmax="z"), **options)


def test_a_weight_on_a_cable_over_two_pulleys():
    """2 T sin(angle) = m g, T = k (L - l): a body that a cable carries, which slides through it."""
    sides, k, length = [np.array([x, 2.0, 0.2]) for x in (-1.0, 1.4)], 3e4, 2.5
    low = np.array([0.2, 0.93, 0.2])
    cable = ds.Cable([ds.Anchor(sides[0]), low, ds.Anchor(sides[1])], length=length, stiffness=k)
    of = hung(cable)
    of = of.replace(
        terms=[*of.terms, ds.ElasticFoundation(1e-2, 1e-2, "ymin")]
    )  # too little to count: it stands upright
    frames = ds.Rollout(ds.StaticSolver(of, tolerance=1e-11), 1).forward()
    (x,) = ds.MaterialPoints(low[None]).settled(of).value(frames)[-1]
    ways = [side - x for side in sides]
    L = sum(np.linalg.norm(way) for way in ways)
    T = k * (L - length)
    lift = T * sum(way[1] / np.linalg.norm(way) for way in ways)
    assert L > length and lift == pytest.approx(1000 * 0.16 * 9.81, rel=1e-5)


@every
def test_slack_carries_nothing(kind):
    got, expected = (
        rollout_of(kind, terms).forward().positions[-1]
        for terms in ([ds.Gravity(), ds.Cable([0, 7], length=3.0, stiffness=900.0)], [ds.Gravity()])
    )
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)


# ---- the stable step, energy ---------------------------------------------------------------------------------------------


STIFF = {
    "spring": lambda mesh: ds.Spring(0, 7, 3e5),
    "anchored": lambda mesh: ds.Spring(inside(mesh), ds.Anchor([3.0, 2.0, 1.0]), 3e5),
    "foundation": lambda mesh: ds.ElasticFoundation(3e5, 1e5, "lid"),
    "cable": lambda mesh: ds.Cable([0, 3, 7], length=2.0, stiffness=3e5),
    "tension": lambda mesh: ds.Cable([0, ds.Anchor(mesh.vertices[0] - 0.01)], tension=3e3),
}


def soft(stiff) -> ds.Scene:
    mesh = lidded()
    return ds.Scene(mesh, ds.StableNeoHookean(1e3, 0.3), 1000.0, STIFF[stiff](mesh), precision="f64")


@pytest.mark.parametrize("stiff", STIFF)
def test_the_stable_step_is_that_of_the_matrices(stiff):
    of = soft(stiff)
    root = np.sqrt(np.repeat(of.inputs.derive(of.inputs.values).mass, 3))
    K = of.stiffness_matrix().toarray() / root / root[:, None]
    limit = 2 / np.sqrt(np.linalg.eigvalsh(K).max())
    assert ds.stable_dt(of) == pytest.approx(limit, rel=1e-3)
    assert ds.stable_dt(of, tight=False) <= limit < 0.5 * ds.stable_dt(of.replace(terms=()))
    with pytest.raises(ValueError, match="exceeds the stable step"):
        ds.VelocityVerletSolver(of, dt=1.01 * limit, substeps=1)


def test_the_stable_step_sees_all_that_comes_over_time():
    """Keyframes and steps at once, functions when a run samples them: the stiffest counts, not what is there at time 0."""
    place = lidded().vertices[0] - 0.01
    pull = lambda how: ds.Scene(  # noqa: E731
        lidded(), ds.StableNeoHookean(1e3, 0.3), 1000.0, ds.Cable([0, ds.Anchor(place)], tension=how), precision="f64"
    )
    limit, slow = ds.stable_dt(pull(3e3)), ds.stable_dt(pull(1.0))
    assert limit < 0.5 * slow
    for how in ([1.0, 3e3, 2.0], ([0.0, 1.0, 2.0], [1.0, 3e3, 5.0])):
        assert ds.stable_dt(pull(how)) == pytest.approx(limit, rel=1e-6)
        assert ds.stable_dt(pull(how), tight=False) == pytest.approx(ds.stable_dt(pull(3e3), tight=False), rel=1e-9)
        with pytest.raises(ValueError, match="exceeds the stable step"):
            ds.SemiImplicitSolver(pull(how), dt=1.01 * limit, substeps=1)
    grows = pull(lambda t: 1.0 + 3e3 * t / (9 * limit))
    solver = ds.SemiImplicitSolver(grows, dt=1.01 * limit, substeps=1)
    ds.Rollout(solver, 3)
    with pytest.raises(ValueError, match="exceeds the stable step"):
        ds.Rollout(solver, 10)


@pytest.mark.parametrize("stiff", ["spring", "anchored", "foundation"])  # which are at rest
def test_noise_grows_beyond_the_stable_step_and_not_below(stiff):
    of, sizes = soft(stiff), []
    limit = ds.stable_dt(of)
    noise = 1e-9 * np.random.default_rng(0).normal(size=of.mesh.vertices.shape)
    for share in (0.99, 1.02):
        at = of.replace(initial_velocities=noise / limit)
        sim = ds.Simulator(ds.VelocityVerletSolver(at, dt=share * limit, allow_unstable=True))
        sim.run(40)
        sizes.append(np.abs(sim.displacements).max())
    assert sizes[0] < 1e-7 and sizes[1] > 1e-5


def test_the_limit_of_a_spring_on_soft_ground():
    """2 / sqrt(k (1 / m_a + 1 / m_b))"""
    mesh, k = lidded(), 1e6
    of = ds.Scene(mesh, ds.StableNeoHookean(10.0, 0.3), 1000.0, ds.Spring(0, 7, k), precision="f64")
    mass = of.inputs.derive(of.inputs.values).mass
    assert ds.stable_dt(of) == pytest.approx(2 / np.sqrt(k * (1 / mass[0] + 1 / mass[7])), rel=2e-3)


@pytest.mark.parametrize("kind", [ds.SemiImplicitSolver, ds.VelocityVerletSolver], ids=lambda s: s.__name__)
def test_energy_is_kept_and_what_cables_do_is_counted(kind):
    mesh = lidded()
    springs = [ds.Spring([7, 5], ds.Anchor([0.0, 2.0, 0.0]), 900.0), ds.ElasticFoundation(3e3, 2e3, "lid")]
    shaken = [*springs, ds.Cable([6, ds.Anchor([0.0, 2.0, 0.0])], tension=lambda t: 2e3 + 2e3 * np.sin(40 * t))]
    for terms in (springs, shaken):
        of = scene(terms, mesh=mesh)
        sim = ds.Simulator(kind(of, dt=0.2 * ds.stable_dt(of)))
        before = sim.compute_energy()
        assert {"springs", "foundations"} < set(before.parts)
        seen = []
        for _ in range(40):
            sim.run(50)
            seen.append(float(sim.compute_energy()))
        watch = sim.workspace.energy_watch
        assert watch.share < 2e-3
        if terms is springs and kind is ds.VelocityVerletSolver:
            assert np.ptp(seen) < 0.02 * watch.moving
        elif terms is shaken:
            assert np.ptp(seen) > 0.2 * watch.moving


# ---- faces, mistakes -----------------------------------------------------------------------------------------------------


def test_many_threads_give_the_same():
    one, many = (
        ds.Rollout(ds.VelocityVerletSolver(scene(attached(lidded())), dt=1e-3, parallel=how), STEPS, gradients="all")
        for how in (False, True)
    )
    a, b = one.forward(), many.forward()
    np.testing.assert_array_equal(a.positions, b.positions)
    w = np.ones(a.positions.shape)
    for name, gradient in one.vjp(a, w).items():
        np.testing.assert_allclose(many.vjp(b, w)[name], gradient, rtol=1e-12, atol=1e-300, err_msg=name)


MISTAKES = {
    "outside": (lambda: scene(ds.Spring([9.0, 0, 0], 0, 1.0)), "1 of 1 points lie outside the mesh"),
    "point": (lambda: scene(ds.Spring("roof", 0, 1.0)), "no vertex set is called 'roof'"),
    "vertex": (lambda: scene(ds.Spring(99, 0, 1.0)), r"Spring: vertices must lie in 0 .. 7, got \[99\]"),
    "ends": (lambda: scene(ds.Spring([1, 2, 3], [4, 5], 1.0)), "start has 3 points and end 2; give as many, or one"),
    "two anchors": (
        lambda: scene(ds.Spring(ds.Anchor([0.0, 0, 0]), ds.Anchor([1.0, 0, 0]), 1.0)),
        "both ends are anchors",
    ),
    "stiffness": (lambda: ds.Spring(0, 1, -1.0), r"Spring: stiffness must be >= 0 \[N/m\], got -1"),
    "numbers": (
        lambda: scene(ds.Spring([0, 1], 2, [1.0, 2.0, 3.0])),
        "stiffness has 3 numbers for 2 springs; give one or 2",
    ),
    "both": (lambda: ds.Spring(0, 1, 1.0, rest_length=1.0, tension=2.0), "give one of them"),
    "anchor": (lambda: ds.Anchor([1.0, 2.0]), r"Anchor: position must be finite, of shape \(3,\) or \(k, 3\) \[m\]"),
    "neither": (lambda: ds.Cable([0, 1]), "give tension"),
    "length alone": (lambda: ds.Cable([0, 1], length=1.0), "give tension"),
    "push": (lambda: ds.Cable([0, 1], tension=-1.0), "Cable: tension must be >= 0, for it pulls only, got -1"),
    "one point": (lambda: ds.Cable([0], tension=1.0), "runs through two points at least, got 1"),
    "twice": (lambda: scene(ds.Cable([0, 1, 1, 2], tension=1.0)), "points 1 and 2 coincide at rest"),
    "sets": (lambda: scene(ds.Cable([0, "xmin"], tension=1.0)), "each of its points is one point, got 'xmin'"),
    "steps": (
        lambda: rollout_of(ds.VelocityVerletSolver, [ds.Cable([0, 1], tension=[1.0, 2.0])]).forward(),
        "cable_tension: 4 steps need as many rows, got 2",
    ),
    "no surface": (lambda: scene(ds.ElasticFoundation(1.0, 0.0, "roof")), "no surface set is called 'roof'"),
    "triangles": (lambda: scene(ds.ElasticFoundation(np.ones(7), 0.0, "lid")), "normal has 7 numbers for 5 triangles"),
    "negative": (lambda: ds.ElasticFoundation(1.0, -2.0), r"tangential must be >= 0 \[N/m\^3\], got -2"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_refused(mistake):
    make, message = MISTAKES[mistake]
    with pytest.raises(ValueError, match=message):
        make()
