"""Paths that are poses: obstacles that turn, and held vertices that do."""

import numpy as np
import pytest
from contact_scenes import G, points, resting_gap, tetrahedron, with_options

import diffsim_ti as ds
from diffsim_ti import rotations
from diffsim_ti.inputs.poses import PoseColumns
from diffsim_ti.obstacles import obstacle_surfaces
from diffsim_ti.terms.pose import sampled_path

MU, CREEP, DT = 0.5, 1e-4, 5e-4
SOLVERS = with_options(ds.SemiImplicitSolver, contact_damping=1.0), ds.ImplicitEulerSolver


def slid(solver, path, frames, normal=(0, 1, 0), velocity=None) -> tuple[np.ndarray, np.ndarray]:
    """Positions of point masses that rest on a moving plane at frames 0.1 s apart, and where they begin [m]."""
    mass, k = 0.05, 1e4
    gap, mesh = resting_gap(mass * G * normal[1], k), tetrahedron()
    turn = np.array([0, 0, np.arctan2(-normal[0], normal[1])])
    mesh = ds.TetrahedralMesh(
        rotations.turned(rotations.quaternion(turn), mesh.vertices) + gap * np.array(normal), mesh.tetrahedra
    )
    floor = ds.HalfSpace((0, 0, 0), normal, stiffness=k, friction=MU, friction_speed=CREEP, path=path)
    start = np.zeros((4, 3))
    if velocity is not None:
        start[:3] = velocity(mesh.vertices[:3])
    scene = points(mesh, floor, mass, terms=[ds.Gravity()], initial_velocities=start, precision="f64")
    each = round(0.1 / DT)
    return ds.Rollout(solver(scene, dt=DT), steps=frames * each, save_every=each).forward().positions[
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
    "within faces": lambda: rollout(
        ds.SemiImplicitSolver,
        lambda **o: ds.Capsule((-0.3, -0.015, 0.05), (0.3, -0.015, 0.04), 0.01, **o),
        7,
        substeps=4,
    ),
    "implicit": lambda: rollout(
        ds.ImplicitEulerSolver, lambda **o: ds.HalfSpace((0, -0.004, 0), (0, 1, 0.1), **o), 6, tolerance=1e-12
    ),
}


@pytest.mark.parametrize("name", ROLLOUTS)
def test_gradients_are_right(name):
    run = ROLLOUTS[name]()
    assert ds.dot_product_test(run) < (1e-8 if name == "implicit" else 1e-13)
    if name != "within faces":
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
    left, right = (np.flatnonzero(mesh.vertices[:, 0] == x) for x in (0.0, 0.1))
    mesh = mesh.replace(vertex_sets={"left": left, "right": right}) if hasattr(mesh, "replace") else mesh
    motion = {
        "left": ds.Pose(lambda t: turning(t, 7), about=(0.0, 0.05, 0.04)),
        "right": lambda t: [0.1 * t, 0, 0],
    }
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(1e5, 0.3), fixed={"left": "xyz", "right": "y"}, motion=motion, precision="f64"
    )
    return ds.Rollout(solver(scene, dt=2e-3, **more), steps=6, save_every=3, gradients="all")
