"""Paths that are poses: obstacles that turn, and fixed vertices that do."""

import imageio.v2 as imageio
import numpy as np
import pytest
from contact_scenes import G, points, resting_gap, tetrahedron, with_options
from matplotlib.image import imread

import diffsim_ti as ds
from diffsim_ti.common import rotations
from diffsim_ti.film import render_series
from diffsim_ti.inputs.poses import PoseColumns
from diffsim_ti.obstacles import obstacle_surfaces
from diffsim_ti.terms.pose import as_pose, sampled_path
from diffsim_ti.visual.frame import Frame
from diffsim_ti.visual.frame_sources import LiveFrames
from diffsim_ti.visual.series import SavedSeries
from diffsim_ti.writers import View, writer_for
from diffsim_ti.writers.adaptive_run import ForwardRun, run_and_write

MU, CREEP = 0.5, 1e-4
SOLVERS = with_options(ds.SemiImplicitSolver, contact_damping=1.0), ds.ImplicitEulerSolver


def slid(solver, path, frames, normal=(0, 1, 0), velocity=None) -> tuple[np.ndarray, np.ndarray]:
    """Positions of point masses that rest on a moving plane at frames 0.1 s apart, and where they begin [m]."""
    mass, k = 0.05, 1e4
    gap, mesh = resting_gap(mass * G * normal[1], k), tetrahedron()
    turn = np.array([0, 0, np.arctan2(-normal[0], normal[1])])
    mesh = ds.TetrahedralMesh(
        rotations.turned(rotations.quaternion(turn), mesh.vertices) + gap * np.array(normal), mesh.tetrahedra
    )
    floor = ds.HalfSpace((0, 0, 0), normal, stiffness=k, width=0.01, friction=MU, friction_speed=CREEP, path=path)
    start = np.zeros((4, 3))
    if velocity is not None:
        start[:3] = velocity(mesh.vertices[:3])
    scene = points(mesh, floor, mass, terms=[ds.Gravity()], initial_velocities=start, precision="f64")
    dt = 5e-4 if solver.explicit else 2e-3
    each = round(0.1 / dt)
    return ds.Rollout(solver(scene, dt=dt), steps=frames * each, save_every=each).forward().positions[
        :, :3
    ], mesh.vertices


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_turning_table_holds_below_the_speed_of_friction(solver):
    limit, out = np.sqrt(MU * G / 0.5), []  # of the vertex at (0.5, 0, 0)
    for omega in (0.99 * limit, 1.01 * limit):
        there, start = slid(
            solver, lambda t, w=omega: [0, 0, 0, 0, w * t, 0], 2, velocity=lambda x, w=omega: np.cross([0, w, 0], x)
        )
        out.append(np.linalg.norm(there[-1, 2, [0, 2]]) - np.linalg.norm(start[2, [0, 2]]))
    assert abs(out[0]) <= 0.2 * CREEP and out[1] > 10 * CREEP


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_plane_that_tilts_lets_go_at_the_angle_of_friction(solver):
    rate = 0.03
    first = np.arctan(MU) - 0.2 * rate
    there, start = slid(solver, lambda t: [0, 0, 0, 0, 0, -rate * t], 6, normal=(np.sin(first), np.cos(first), 0.0))
    turns = rotations.quaternion(np.outer(0.1 * np.arange(7), [0, 0, -rate]))
    gone = np.linalg.norm(
        there[:, 0] - rotations.turned(turns, start[:1]), axis=1
    )  # of the vertex where the plane turns
    faster = G * (1 + MU**2) / np.sqrt(1 + MU**2) * rate  # gone grows as faster t^3 / 6 from when it lets go
    let_go = 0.6 - np.cbrt(6 * gone[6] / faster)
    assert gone[1] <= 0.1 * CREEP * 1.01 and abs(np.tan(first + rate * let_go) / MU - 1) < 0.002


# ---- gradients ---------------------------------------------------------------------------------------------------------


def turning(t, width):
    """A pose whose rotation passes half a turn, from zero."""
    out = np.array([0.2 * t, -0.1 * t, 0.05 * t, 0.4 * t, 8 * t, -0.2 * t])
    return out if width == 6 else np.concatenate([out[:3], 1.3 * rotations.quaternion(out[3:])])


def rollout(solver, obstacle, width, speed=1.0, **more) -> ds.Rollout:
    """A cube that falls on an obstacle that turns."""
    mesh = ds.TetrahedralMesh.create_box(2, 0.1, origin=(0.02, 0, 0.01))
    given = dict(friction=0.4, stiffness_per_area=2e6, width=0.01, about=(0.05, -0.02, 0.04), name="table")
    terms = [ds.Gravity(), obstacle(path=lambda t: turning(t, width), **given)]
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(1e5, 0.3), terms=terms, precision="f64", initial_velocities=(0.3, -speed, 0.1)
    )
    return ds.Rollout(solver(scene, dt=2e-3, **more), steps=12, save_every=6, gradients="all")


ROLLOUTS = {  # the rest of solvers and obstacles: the gradient fuzz
    "a stage": lambda: rollout(
        ds.SemiImplicitSolver, lambda **o: ds.Box((0, -0.0545, 0), (0.3, 0.05, 0.3), **o), 6, substeps=4
    ),
    "a force": lambda: rollout(
        ds.VelocityVerletSolver, lambda **o: ds.Ground(-0.004, **o), 7, substeps=20, contact="force"
    ),
    "implicit": lambda: rollout(
        ds.ImplicitEulerSolver, lambda **o: ds.HalfSpace((0, -0.004, 0), (0, 1, 0.1), **o), 6, tolerance=1e-12
    ),
}


@pytest.mark.parametrize("name", ROLLOUTS)
def test_gradients_are_right(name):
    run = ROLLOUTS[name]()
    assert ds.dot_product_test(run) < (1e-8 if name == "implicit" else 1e-13)
    assert ds.check_gradients(run, inputs=["table.friction", "table.about", "table.path"], verbose=False).passed


# ---- nothing passes in silence ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", [ds.ImplicitEulerSolver, ds.SemiImplicitSolver])
def test_a_plate_that_turns_takes_a_body_along(solver):
    """Half a radian in an implicit step: its end goes twice the body's width."""
    omega, more = (50.0, {}) if solver is not ds.SemiImplicitSolver else (8.0, dict(substeps=50))
    mesh = ds.TetrahedralMesh.create_box(2, 0.1, origin=(0.2, 0, 0))
    plate = ds.Box(
        (0.25, 0.05, -0.02), (0.5, 0.2, 0.01), width=0.005, stiffness=1e4, path=lambda t: [0, 0, 0, 0, -omega * t, 0]
    )
    simulator = ds.Simulator(solver(ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[plate]), dt=1e-2, **more))
    for _ in range(2 if omega > 10 else 5):  # then it has flown off
        simulator.step()
        assert plate.gap(simulator.positions, plate.path(simulator.time)).min() > 0
        back = rotations.quaternion(np.array([0, omega * simulator.time, 0]))
        assert rotations.turned(back, simulator.positions)[:, 2].min() > -0.015  # on its side
    assert np.linalg.norm(simulator.velocities.mean(0)) > 0.8 * 0.25 * omega


# ---- clamps ------------------------------------------------------------------------------------------------------------


def clamped(solver, **more) -> ds.Rollout:
    mesh = ds.TetrahedralMesh.create_box(2, 0.1)
    motion = {"xmin": ds.Pose(lambda t: turning(t, 7), about=(0.0, 0.05, 0.04)), "xmax": lambda t: [0.1 * t, 0, 0]}
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(1e5, 0.3), fixed={"xmin": "xyz", "xmax": "y"}, motion=motion, precision="f64"
    )
    return ds.Rollout(solver(scene, dt=2e-3, **more), steps=6, save_every=3, gradients="all")


@pytest.mark.parametrize("solver, more", [(ds.SemiImplicitSolver, dict(substeps=4)), (ds.StaticSolver, {})])
def test_a_clamp_turns(solver, more):
    run = clamped(solver, **more)
    frames, mesh = run.forward(), run.scene.mesh
    held, about, (t, q) = mesh.vertex_indices("xmin"), np.array([0, 0.05, 0.04]), as_pose(turning(0.012, 7))
    there = about + t + rotations.turned(q, mesh.vertices[held] - about)
    assert np.allclose(frames.positions[-1, held], there, atol=1e-14)
    names = "prescribed_pose.xmin", "prescribed_about.xmin", "prescribed_motion", "initial_positions", "rest_positions"
    assert ds.dot_product_test(run) < (1e-6 if solver is ds.StaticSolver else 1e-13)
    assert ds.check_gradients(run, inputs=names, verbose=False).passed
    simulator = ds.Simulator(solver(run.scene, dt=2e-3, **more))
    for _ in range(6):
        simulator.step()
    assert np.allclose(simulator.positions, frames.positions[-1], atol=1e-12 if more else 1e-7)


def test_a_pose_that_does_not_turn_is_a_displacement():
    made = {}
    for name, path in (
        ("pose", lambda t: [0.5 * t, -0.2 * t, 0, 1, 0, 0, 0]),
        ("path", lambda t: [0.5 * t, -0.2 * t, 0]),
    ):
        mesh = ds.TetrahedralMesh.create_box(2, 0.1)
        terms = [ds.Gravity(), ds.Ground(-0.004, stiffness_per_area=2e6, width=0.01, friction=0.4, path=path)]
        scene = ds.Scene(
            mesh, ds.StableNeoHookean(1e5, 0.3), terms=terms, precision="f64", initial_velocities=(0.3, -1, 0)
        )
        made[name] = ds.Rollout(ds.SemiImplicitSolver(scene, dt=2e-3, substeps=4), steps=12).forward().positions
    assert np.abs(made["pose"] - made["path"]).max() < 1e-14


# ---- rows --------------------------------------------------------------------------------------------------------------


def test_rows_of_poses():
    rng, axis = np.random.default_rng(0), np.array([0.1, 0.9, 0.2])
    several = np.zeros((5, 6))
    several[:, 3:] = np.array([-3.0, 0, 2, 6, 11])[:, None] * axis  # up to 0.8 turns in a step, and at nothing
    link, x = PoseColumns(["a", "b", "c"], "path"), [rng.normal(size=(5, 3)), several, rng.normal(size=(5, 7))]
    phi = link.value(*x)[0][:, 3]
    assert np.allclose(phi[:-1], np.diff(several[:, 3:], axis=0), atol=1e-14)
    dx, e = [rng.normal(size=part.shape) for part in x], 1e-6
    after, before = (link.value(*(part + sign * e * d for part, d in zip(x, dx)))[0] for sign in (1, -1))
    differences, change = (after - before) / (2 * e), link.jvp(x, dx)[0]
    for c in (2, 5):  # theta
        q, p = (rotations.from_rodrigues(rows[:, c]) for rows in (after, before))
        differences[:, c] = rotations.vector(rotations.product(q, rotations.conjugate(p))) / (2 * e)
    assert np.abs(differences - change).max() < 1e-8
    w = rng.normal(size=change.shape)
    pulled = sum((by * d).sum() for by, d in zip(link.vjp(x, [w]), dx))
    assert abs((w * change).sum() - pulled) < 1e-13


def test_keyframes():
    turns = sampled_path("p", ([0, 1, 2], [[0] * 6, [1, 0, 0, 0, 10, 0], [1, 0, 0, 0, 0, 0]]), [0.25, 1.5])
    assert np.allclose(turns, [[0.25, 0, 0, 0, 2.5, 0], [1, 0, 0, 0, 5, 0]])
    half = np.sqrt(0.5)  # three quarters of a turn one way are a quarter the other way
    short = sampled_path("p", ([0, 1], [[0, 0, 0, 1, 0, 0, 0], [0, 0, 0, -half, half, 0, 0]]), [0.5])
    assert np.allclose(rotations.vector(short[:, 3:]), [[-np.pi / 4, 0, 0]])
    with pytest.raises(ValueError, match="more than half a turn apart and not on one axis; insert keyframes between"):
        sampled_path("p", ([0, 1], [[0, 0, 0, 0, 3, 0], [0, 0, 0, 3, 0, 0]]), [0.0])
    with pytest.raises(ValueError, match="less than a full turn; take shorter steps"):
        PoseColumns(["p"], "path").value(np.array([[0.0] * 6, [0, 0, 0, 0, 7, 0]]))
    with pytest.raises(ValueError, match="pass a path of 6 or 7 numbers, or no about"):
        ds.Ground(about=(0, 0, 0))


def test_obstacles_are_drawn_turned():
    mesh = ds.TetrahedralMesh.create_box(2, 0.1, origin=(0, 1, 0))
    floor = ds.Ground(path=lambda t: [0, 0, 0, 0, 0, t])
    box = ds.Box((-4.0, 0, 0), 0.1, stiffness=1.0, width=0.01, path=lambda t: [0, t, 0, 0, 0, t], about=(1.0, 0, 0))
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity(), box, floor])
    (solid, _), (square, _) = obstacle_surfaces(scene, np.pi / 2)
    assert np.abs(square[:, 0]).max() < 1e-12 and np.abs(square[:, 1]).max() > 0.1
    assert np.allclose(solid.mean(0), [1, np.pi / 2 - 5, 0])


def test_what_turns_moves_by_few_numbers_and_presses_is_written_and_shown(tmp_path):
    """A cube that moves affinely on a table that turns about its middle: series, arrays, picture, film and live frames."""
    cube = ds.TetrahedralMesh.create_cube(3, 0.2).translated([-0.1, 0.008, -0.1])
    cube = ds.TetrahedralMesh(cube.vertices, cube.tetrahedra, vertex_sets={"all": np.arange(cube.num_vertices)})
    contact = dict(width=0.01, friction=0.5)
    table = ds.Box((0.0, -0.05, 0.0), (0.6, 0.1, 0.6), path=lambda t: [0, 0, 0, 0, 4 * t, 0], **contact)
    law, reduced = ds.StableNeoHookean(1e5, 0.3), {"all": "affine"}
    scene = ds.Scene(cube, law, 500.0, [ds.Gravity(), table], reduced=reduced, precision="f64")
    run = ForwardRun(scene, ds.BDF2Solver, 0.05, outputs=[ds.ContactForce(table, name="contact", per_vertex=True)])
    view = View(size=(160, 120), colour="speed", arrows=("contact",))
    run_and_write(run, 3, [writer_for(tmp_path / name, view) for name in ("a.pvd", "a.npz", "a.gif", "a.png")])
    arrays, saved = np.load(tmp_path / "a.npz"), SavedSeries(tmp_path / "a.pvd")
    at_rest = obstacle_surfaces(scene, 0.0)[0][0]
    live = LiveFrames(run)
    live.advance()
    for frame in (*map(saved.frame, range(4)), live.frame(len(live) - 1)):
        turned = rotations.turned(rotations.quaternion(np.array([0, 4 * frame.time, 0])), at_rest)
        np.testing.assert_allclose(frame.obstacles[0], turned, atol=1e-7)
        np.testing.assert_allclose(scene.reduced.of(frame.displacements), frame.displacements, atol=1e-7)
    assert frame.time == pytest.approx(0.2) and frame.fields["contact"][:, 1].sum() > 10  # of 39 N
    np.testing.assert_allclose(saved.frame(3).fields["contact"], arrays["contact"][3], rtol=1e-6)
    spin = np.cross(frame.positions, frame.velocities)[:, 1].mean() / (frame.positions[:, [0, 2]] ** 2).sum(1).mean()
    assert 0.5 < spin < 4.2  # friction takes it along
    film = imageio.mimread(tmp_path / "a.gif")
    assert len(film) == 4 and np.abs(film[0].astype(float) - film[-1]).max() > 100
    render_series(
        tmp_path / "a.pvd", tmp_path / "again.png", "speed", size=(160, 120), backend="software", arrows=["contact"]
    )
    render_series(tmp_path / "a.pvd", tmp_path / "bare.png", "speed", size=(160, 120), backend="software")
    first, again, bare = (imread(tmp_path / f"{name}.png")[..., :3] for name in ("a", "again", "bare"))
    assert np.abs(first - again).mean() < 1e-3 < np.abs(again - bare).mean()


def test_a_tensor_of_poses_has_gradients_and_is_drawn():
    """Angles of a joint, by whatever package makes poses of them."""
    torch = pytest.importorskip("torch")
    from diffsim_ti.torch_bridge.rollout_node import rollout_frames

    floor = ds.Ground(
        -0.009, stiffness_per_area=2e5, width=0.01, friction=0.4, path=lambda t: [0, 0, 0, 1, 0, 0, 0], name="floor"
    )
    mesh = ds.TetrahedralMesh.create_box(2, 0.1)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity(), floor], precision="f64")
    run = ds.Rollout(ds.SemiImplicitSolver(scene, dt=2e-3, substeps=4), 20)

    def loss(angles):
        zero = 0 * angles
        half = 0.5 * angles
        rows = torch.stack([zero, zero, zero, torch.cos(half), zero, torch.sin(half), zero], 1)
        return rollout_frames(run, **{"floor.path": rows}).positions[-1, :, 0].sum()

    angles = torch.linspace(0, 0.3, 21, dtype=torch.float64).requires_grad_(True)
    loss(angles).backward()
    step = torch.zeros_like(angles)
    step[10] = 1e-5
    with torch.no_grad():
        differences = (loss(angles + step) - loss(angles - step)) / 2e-5
    assert abs(angles.grad[10] / differences - 1) < 1e-5
    tilted = [0, 0, 0, 0.8, 0, 0, -0.6]  # away from the body, by a given row, not by the scene's path
    frames = run.forward(**{"floor.path": np.array([[0, 0, 0, 1.0, 0, 0, 0]] * 20 + [tilted])})
    square = Frame.of_run(scene, frames, -1).obstacles[0]
    assert np.abs(square[:, 1]).max() > 0.1
