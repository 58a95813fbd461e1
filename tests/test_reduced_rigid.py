"""Sets that do not deform in implicit steps and equilibria: their motion, contact, and derivatives beside all else."""

import warnings
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from battery_of_impacts import SOLVERS as ALL
from battery_of_impacts import battery, draw
from chamber_meshes import hollow_cube
from test_chambers import assert_outputs_transposed
from test_every_adjoint import assert_transposed
from test_reduced import bar, scene_of
from test_reduced_explicit import distances, on_slope, spinning

import diffsim_ti as ds
from diffsim_ti import verify

SHELL = np.unique(bar().tetrahedra[bar().tetrahedron_sets["shell"]])
RIGID = {"shell": "rigid"}
SOLVERS = (ds.ImplicitEulerSolver, ds.BDF2Solver, ds.ImplicitMidpointSolver)


# ---- motion ----------------------------------------------------------------------------------------------------------


@lru_cache
def plate():
    """A free rigid body that turns about its middle axis, which is unstable."""
    mesh = ds.TetrahedralMesh.create_box((2, 2, 2), size=(0.3, 0.2, 0.1))
    mesh = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, vertex_sets={"all": np.arange(mesh.num_vertices)})
    spin = np.cross([0.1, 4.0, 0.0], mesh.vertices - mesh.vertices.mean(0))
    law = ds.StableNeoHookean(1e9, 0.3)
    return ds.Scene(mesh, law, reduced={"all": "rigid"}, initial_velocities=spin, precision="f64")


@lru_cache
def expected_end():
    solver = ds.VelocityVerletSolver(plate(), dt=0.5 / 20, substeps=400)
    return ds.Rollout(solver, 20, gradients=[]).forward().positions[-1]


@pytest.mark.parametrize("solver, order", [*zip(SOLVERS, (1, 2, 2))])
def test_a_free_rigid_body_turns_as_eulers_equations_say(solver, order):
    """Against explicit steps fifty times as fine, which turn by exact rotations; without a word of energy gained."""
    m, errors = plate().inputs.derive(plate().inputs.values).mass[:, None], []
    for steps in (80, 160):
        with warnings.catch_warnings(action="error"):
            rollout = ds.Rollout(solver(plate(), dt=0.5 / steps, tolerance=1e-12), steps, save_every=1, gradients=[])
            frames = rollout.forward()
        errors.append(np.abs(frames.positions[-1] - expected_end()).max())
        L = (m * np.cross(frames.positions, frames.velocities)).sum(1)
        T = (m * frames.velocities**2).sum((1, 2))
        assert T.max() < (1 + 1e-10) * T[0]
        if solver is ds.ImplicitMidpointSolver:
            assert np.ptp(T) < 1e-10 * T[0] and np.abs(L - L[0]).max() < 1e-10 * np.linalg.norm(L[0])
        assert np.abs(distances(frames.positions) - distances(plate().mesh.vertices)).max() < 1e-14
    assert 0.7 * 2**order < errors[0] / errors[1] < 1.4 * 2**order and errors[1] < 0.03


@pytest.mark.parametrize("solver", [*SOLVERS, ds.StaticSolver])
def test_the_limit_of_growing_stiffness(solver):
    ends = {}
    for stiff, kind in ((1e6, None), (1e8, None), (1e6, RIGID), (1e8, RIGID)):
        options = {} if solver is ds.StaticSolver else dict(dt=5e-3)
        rollout = ds.Rollout(solver(scene_of(kind, stiff, fixed="xmin"), **options), 10, gradients=[])
        ends[stiff, kind is None] = rollout.forward().positions[-1]
    moved = np.abs(ends[1e6, False] - bar().vertices).max()
    soft, stiff, same = (np.abs(ends[key] - ends[1e6, False]).max() for key in ((1e6, True), (1e8, True), (1e8, False)))
    assert moved > 5e-3 and stiff < 1e-3 * moved < 5e-3 * moved < soft and same == 0.0


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_they_keep_their_shape(precision):
    """Whatever happens: steps one by one, from a start that is none of theirs, beside frames of a run."""
    scene = scene_of(RIGID, precision=precision, fixed="xmin", initial_velocities=spinning())
    solver, eps = ds.ImplicitMidpointSolver(scene, dt=5e-3), {"f32": 2e-7, "f64": 1e-15}[precision]
    frames = ds.Rollout(solver, 6, save_every=1, gradients=[]).forward()
    expected = distances(bar().vertices[SHELL])
    assert np.abs(distances(frames.positions[:, SHELL].astype(float)) - expected).max() < eps
    simulator = ds.Simulator(solver)
    simulator.run(6)
    np.testing.assert_allclose(simulator.positions, frames.positions[-1], atol=2e-6)
    askew = simulator.positions + np.random.default_rng(0).normal(size=bar().vertices.shape) * 1e-3
    simulator.set_state(askew)
    for _ in range(2):
        assert np.abs(distances(simulator.positions[SHELL].astype(float)) - expected).max() < eps
        simulator.step()


def test_a_ball_rolls_down_a_slope():
    """With its mesh's own inertia, hopping over corners of 9 degrees, in six times longer steps than explicit ones."""
    scene = on_slope(0.5)
    m, X = scene.inputs.derive(scene.inputs.values).mass, scene.mesh.vertices
    with warnings.catch_warnings(action="error"):
        frames = ds.Rollout(
            ds.ImplicitMidpointSolver(scene, dt=0.01, substeps=5), 45, save_every=1, gradients=[]
        ).forward()
    x = np.einsum("n,fnd->fd", m, frames.positions) / m.sum()
    inertia = (m * ((X - X[-1])[:, :2] ** 2).sum(1)).sum()
    expected = 9.81 * np.sin(np.arctan(0.3)) / (1 + inertia / (m.sum() * x[:, 1].mean() ** 2))
    assert 2 * (x[-1, 0] - x[0, 0]) / 0.45**2 == pytest.approx(expected, rel=0.015)
    assert np.abs(distances(frames.positions[-1, :40]) - distances(X[:40])).max() < 1e-14


@pytest.mark.parametrize("number", [1, 6, 16, 20])
def test_nothing_passes_through_them(number):
    """What a battery of impacts found hard: a needle, plates and balls that come, turn and slide."""
    solvers = {name: kind for name, kind in ALL.items() if not kind.explicit}
    case = replace(draw(number, 7, solvers, number % 2 == 1, 1, True, number % 3 == 0), reduced="rigid")
    (row,) = battery([case], show=lambda text: None).values()
    assert not row["silent"] and (not row["raised"] or row["finished_then"])


# ---- derivatives -----------------------------------------------------------------------------------------------------


def everything(order=1, volume="tetrahedra", law=None):
    """A bar with a rigid end that all kinds of loads pull on, turning fast."""
    mesh = bar()
    mesh, corner = mesh.quadratic() if order == 2 else mesh, int(SHELL[0])
    end = mesh.surface_where(lambda x, n: x[:, 0] > 0.29)
    terms = [
        ds.Gravity(),
        ds.Drag(2.0),
        ds.Pressure(3e3, end),
        ds.Traction([20.0, -300.0, 100.0], end),
        ds.Spring(corner, ds.Anchor([0.3, 0.3, -0.1]), stiffness=40.0, tension=3.0),
        ds.Cable([0, corner, ds.Anchor([0.1, 0.4, 0.0])], tension=2.0),
        ds.ElasticFoundation(1e4, 2e3, end),
        ds.SurfaceDrag(1000.0, 1.0, 0.1, stream=[1.0, 0, 0]),
        *([ds.Muscle([1.0, 0.2, 0.1], 2e4, 0.7)] if order == 1 else []),
    ]
    spin = np.cross([2.0, -30.0, 5.0], mesh.vertices - mesh.vertices.mean(0))
    given = dict(reduced=RIGID, volume=volume, initial_velocities=spin, precision="f64")
    return ds.Scene(mesh, law or ds.StableNeoHookean(1e5, 0.4), 1000.0, terms, **given)


# the sets in order, how the other end is held, whether steps are unequal
BESIDE = [
    (("left", "rigid"), ("right", "rigid"), None, False),
    (("right", "rigid"), ("left", "affine"), "xmin", True),
    (("left", "affine"), ("right", "rigid"), {"xmin": "y"}, True),
    (("right", "rigid"), ("left", "rigid"), "moving", False),
]


@pytest.mark.parametrize("which", range(len(BESIDE)))
@pytest.mark.parametrize("solver", [*SOLVERS, ds.StaticSolver])
def test_several_sets_beside_supports(solver, which):
    """Two sets with soft cells between them and to what is held, on rough ground: of any kinds, in any order."""
    *sets, held, unequal = BESIDE[which]
    static = solver is ds.StaticSolver
    mesh = ds.TetrahedralMesh.create_box((7, 2, 3), size=(0.6, 0.1, 0.12), pattern="five")
    along = mesh.centroids[:, 0]
    parts = dict(left=(along > 0.1) & (along < 0.25), right=along > 0.4)
    parts = {name: np.flatnonzero(chosen) for name, chosen in parts.items()}
    mesh = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, vertex_sets=mesh.vertex_sets, tetrahedron_sets=parts)
    fixed = "xmin" if held == "moving" or static else held
    motion = (lambda t: [0.004 * t if static else 0.05 * t, 0.0, 0.0]) if held == "moving" else None
    floor = ds.Ground(-0.012, stiffness=3e4, width=0.02, friction=0.3, friction_speed=0.1)
    spin = 0 * mesh.vertices if static else np.cross([0.4, -1.0, 0.7], mesh.vertices - mesh.vertices.mean(0))
    law, given = ds.StableNeoHookean(2e5, 0.3), dict(fixed=fixed, motion=motion, initial_velocities=spin)
    scene = ds.Scene(mesh, law, 1000.0, [floor, ds.Gravity()], reduced=dict(sets), precision="f64", **given)
    steps = ds.UnequalSteps([2e-3, 3e-3, 1.5e-3], 2) if unequal and not static else 3
    options = dict(load_steps=2) if static else dict(dt=3e-3, substeps=2)
    rollout = ds.Rollout(solver(scene, tolerance=1e-12, **options), steps, save_every=1, gradients="all")
    frames = rollout.forward()
    for name, kind in sets:
        own = np.unique(mesh.tetrahedra[parts[name]])
        off = np.abs(distances(frames.positions[-1, own]) - distances(mesh.vertices[own])).max()
        assert (off < 1e-14) == (kind == "rigid")
    assert verify.dot_product_test(rollout) <= 1e-9


SCENES = {
    "linear": everything,
    "ten nodes": lambda: everything(order=2),
    "patches": lambda: everything(volume="patches"),
    "viscous": lambda: everything(law=ds.KelvinVoigt(ds.StableNeoHookean(1e5, 0.4), time=2e-3)),
    "grown": lambda: everything(law=ds.Grown(ds.StableNeoHookean(1e5, 0.4), 0.01)),
    "relaxing": lambda: everything(law=ds.Prony(ds.StableNeoHookean(1e5, 0.4), [0.3], [5e-3])),
}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("solver", SOLVERS)
def test_tangent_and_adjoint_agree_beside_all_loads(solver, name):
    rollout = ds.Rollout(solver(SCENES[name](), dt=2e-3, tolerance=1e-12), 3, save_every=1, gradients="all")
    assert verify.dot_product_test(rollout) <= 1e-9


@pytest.mark.parametrize("solver", SOLVERS[1:])
def test_gradients_beside_all_loads(solver):
    """By differences, of all that moves and turns them, the rest positions that they keep included."""
    names = ["rest_positions", "initial_positions", "initial_velocities", "density", "traction", "spring_tension"]
    rollout = ds.Rollout(solver(everything(), dt=2e-3, tolerance=1e-13), 2, gradients=names)
    assert ds.check_gradients(rollout, verbose=False).passed


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_checkpoints_and_other_rest_positions_leave_no_trace(solver, precision):
    """To the bit, between runs of one Rollout and another that keeps a third of its states."""
    scene = scene_of(RIGID, precision=precision, fixed="xmin", initial_velocities=spinning())
    whole, parts = (
        ds.Rollout(solver(scene, dt=5e-3), 6, save_every=2, gradients="all", **more)
        for more in ({}, dict(checkpoint_every=2))
    )
    first = whole.forward()
    seed = np.random.default_rng(0).standard_normal(first.positions.shape)
    expected = whole.vjp(first, seed)
    stretched = whole.forward(rest_positions=bar().vertices * [1.0, 1.2, 1.0]).positions
    assert np.abs(stretched - first.positions).max() > 1e-3
    for rollout in (whole, parts):
        frames = rollout.forward()
        assert np.array_equal(frames.positions, first.positions)
        found = rollout.vjp(frames, seed)
        assert all(np.array_equal(found[name], expected[name]) for name in expected)


@pytest.mark.parametrize("solver", [*SOLVERS, ds.StaticSolver])
def test_a_volume_is_held_beside_them(solver):
    """Oil in a hollow cube whose lid is rigid, pressed; dot products, and the pressure by differences."""
    mesh = hollow_cube()
    X = mesh.vertices
    mesh = mesh.with_vertex_set("lid", X[:, 2] > X[:, 2].max() - 0.02).with_vertex_set("base", X[:, 2] < 0.02)
    lid = mesh.vertices[mesh.vertex_sets["lid"]]
    assert np.ptp(lid[:, 2]) > 1e-3  # not in a plane
    given = dict(reduced={"lid": "rigid"}, precision="f64")
    given |= dict(fixed="base") if solver is ds.StaticSolver else dict(initial_velocities=[0.3, 0.0, -0.5])

    def scene_with(volume):
        terms = [ds.FilledChamber(volume, "cavity", name="oil"), ds.BodyForce([0.0, 0.0, -3e3])]
        return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, **given)

    scene = scene_with(0.99 * scene_with(1.0).chamber_volume("oil"))
    options = dict(tolerance=1e-12) | ({} if solver is ds.StaticSolver else dict(dt=2e-3))
    outputs = [ds.ChamberPressure("oil"), ds.WorkOfLoads()]
    names = ["oil.volume", "rest_positions", "initial_velocities"]
    rollout = ds.Rollout(solver(scene, **options), 2, save_every=1, gradients="all", outputs=outputs)
    assert_transposed(rollout, 1e-9, ("density",) if solver is ds.StaticSolver else ())
    assert_outputs_transposed(rollout, 1e-8)
    few = ds.Rollout(solver(scene, **options), 1, gradients=names[: 2 if solver is ds.StaticSolver else 3])
    assert ds.check_gradients(few, verbose=False).passed
