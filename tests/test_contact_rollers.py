"""Obstacles at vertices that are fixed in some directions: the contact stage acts on them in the others."""

import numpy as np
import pytest
from contact_scenes import EXPLICIT, points, tetrahedron
from test_contact_stage import check_rows

import diffsim_ti as ds

solvers = pytest.mark.parametrize("solver", EXPLICIT)


def mirrored(half: ds.TetrahedralMesh) -> ds.TetrahedralMesh:
    """A body from its half x >= 0."""
    other = half.vertices * [-1, 1, 1]
    whole = np.concatenate([half.vertices, other])
    tets = np.concatenate([half.tetrahedra, half.tetrahedra[:, [0, 2, 1, 3]] + half.num_vertices])
    _, first, inverse = np.unique(np.round(whole, 9), axis=0, return_index=True, return_inverse=True)
    return ds.TetrahedralMesh(whole[first], inverse.ravel()[tets])


@solvers
def test_rollers_in_a_plane_of_symmetry_change_nothing(solver):
    """A body symmetric in x strikes a rough floor and a ball: its middle does not leave the plane, held there or not."""
    mesh = mirrored(ds.TetrahedralMesh.create_box(3, size=(0.05, 0.1, 0.1), origin=(0, 0.002, 0)))
    mesh = mesh.with_vertex_set("middle", np.flatnonzero(np.abs(mesh.vertices[:, 0]) < 1e-9))
    terms = [
        ds.Gravity(),
        ds.Ground(width=0.004, stiffness_per_area=3e6, friction=0.3, name="floor"),
        ds.Sphere((0, 0.05, 0.125), 0.02, width=0.004, stiffness_per_area=3e6, friction=0.3, name="ball"),
    ]
    ends = []
    for fixed in ({"middle": "x"}, None):
        scene = ds.Scene(
            mesh, ds.StableNeoHookean(3e4, 0.3), 1000.0, terms, fixed, initial_velocities=(0, -1, 0.6), precision="f64"
        )
        outputs = [ds.ContactForce("floor"), ds.ContactForce("ball", name="on_ball")]
        ends.append(ds.Rollout(solver(scene, dt=5e-4), 60, save_every=10, outputs=outputs).forward())
    assert ends[0].contact_resolution.smallest_gap < 0.002
    np.testing.assert_allclose(ends[0].positions, ends[1].positions, rtol=0, atol=1e-12)
    for name in ("contact_force", "on_ball"):
        assert np.abs(ends[1][name]).max() > 0.1
        np.testing.assert_allclose(ends[0][name], ends[1][name], rtol=0, atol=1e-8 * np.abs(ends[1][name]).max())


@solvers
@pytest.mark.parametrize("damping", [0.0, 0.4])
def test_energy_never_grows(solver, damping):
    """Vertices on rails and in planes askew to up to three walls, or to a rough one, at any stiffness, speed and step."""
    rng, lost = np.random.default_rng(3), []
    for friction in (0.0, 0.0, 0.0, 0.4, 0.4, 0.4):
        normals = rng.uniform([-0.08, 0.3, -0.08], [1, 1, 1], (1 if friction else rng.integers(1, 4), 3))
        dt, speed = 10 ** rng.uniform(-3.3, -2), rng.uniform(0.5, 2)
        walls = [
            ds.HalfSpace(
                -0.05 * n / np.linalg.norm(n), n, stiffness=10 ** rng.uniform(4, 6), width=0.1, friction=friction
            )
            for n in normals
        ]
        mesh = tetrahedron().with_vertex_set("rail", [0]).with_vertex_set("table", [1]).with_vertex_set("apex", [3])
        fixed = dict(rail=rng.normal(size=(2, 3)), table=rng.normal(size=3), apex="xyz")
        scene = points(mesh, walls, initial_velocities=[0.1, -speed, 0.2], precision="f64", fixed=fixed)
        simulator = ds.Simulator(solver(scene, dt=dt, contact_damping=damping, allow_unstable=True))
        energies = [float(simulator.compute_energy())]
        for _ in range(min(60, int(0.4 / speed / dt) + 4)):
            simulator.step()
            energies.append(float(simulator.compute_energy()))
        rise = np.diff(energies)
        assert rise.max() < 1e-9 * energies[0] and (damping or friction or np.abs(rise).max() < 1e-9 * energies[0])
        lost.append(1 - energies[-1] / energies[0])
    assert max(lost) > 1e-4  # friction takes some


@solvers
def test_without_friction_and_damping_energy_stays(solver):
    """A bead on an inclined rail bounces off a floor: no energy is lost, though the rail turns the push."""
    mesh = tetrahedron(0.02).with_vertex_set("beads", [0, 1, 2]).with_vertex_set("apex", [3])
    rail = np.array([1.0, -1.0, 0.3])
    across = np.linalg.svd(rail[None])[2][1:]
    scene = points(
        mesh,
        ds.Ground(stiffness=1e5, width=0.01),
        initial_velocities=0.5 * rail,
        precision="f64",
        fixed=dict(beads=across, apex="xyz"),
    )
    frames = ds.Rollout(solver(scene, dt=1e-3, contact_damping=0.0), 200, save_every=1).forward()
    v, moved = frames.velocities[:, :3], frames.positions[:, :3] - frames.positions[0, :3]
    assert np.abs(moved @ across.T).max() < 1e-12 and frames.positions[:, :3, 1].min() > 0
    np.testing.assert_allclose(v[-1], -v[0], rtol=1e-9, atol=1e-9)


def crowded(solver, motion=None, **options) -> ds.Rollout:
    """A cube in a corner of rough walls that move, its sides and edges on rollers along axes and askew."""
    mesh = ds.TetrahedralMesh.create_box(3, size=0.1, origin=(0, 0.002, 0))
    terms = [
        ds.Gravity(),
        ds.Drag(2.0),
        ds.Ground(width=0.004, stiffness=900.0, friction=0.3, path=lambda t: [0.1 * t, 0.3 * t, 0], name="floor"),
        ds.HalfSpace((-0.002, 0, 0), (1, 0.3, 0), width=0.004, stiffness=400.0, friction=0.2),
        ds.Sphere(
            (0.05, -0.1, 0.05),
            0.1,
            width=0.004,
            stiffness=300.0,
            path=lambda t: [0, 0.2 * t, 0],
            friction=0.4,
            name="ball",
        ),
    ]
    fixed = {"zmin": "z", "xmin": [[1, 0.2, 0.4]], "zmax": [[0.3, 0.1, 1]]}
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(3e4, 0.3),
        1000.0,
        terms,
        fixed,
        motion,
        initial_velocities=(-1.2, -1.0, 0.2),
        precision="f64",
    )
    return ds.Rollout(solver(scene, dt=1e-3, contact_damping=0.02), 12, save_every=3, gradients="all", **options)


MOTION = {"xmin": lambda t: [-0.1 * t, 0.3 * t, 5 * t * t], "zmax": lambda t: [0, 0.1 * t, 0.2 * t]}


@pytest.mark.parametrize("solver, alone", [(EXPLICIT[0], True), (EXPLICIT[1], True), (EXPLICIT[1], False)])
def test_every_number(solver, alone, request):
    """With supports that move; vertices alone, and by pairs."""
    if alone:
        request.getfixturevalue("vertices_alone")
    rollout = crowded(solver, MOTION)
    names = ["prescribed_motion", "initial_velocities", "rest_positions", "floor.path", "ball.friction", "density"]
    assert check_rows(rollout, None if alone and solver is EXPLICIT[1] else names) >= len(names)
    assert rollout.forward().contact_resolution.smallest_gap < 0.002


@pytest.mark.executed_ptx
@pytest.mark.usefixtures("vertices_alone")  # by pairs: test_obstacle_pairs.py
def test_contact_forces_have_gradients():
    """Forces on obstacles as a loss names them, of vertices on rollers."""
    rollout = crowded(EXPLICIT[0], MOTION, outputs=[ds.ContactForce("floor"), ds.ContactForce("ball", name="on_ball")])
    frames = rollout.forward()
    assert np.abs(frames["contact_force"]).max() > 1 and np.abs(frames["on_ball"]).max() > 0.01
    assert ds.dot_product_test(rollout) < 1e-11


@solvers
def test_of_friction_towards_another_wall_a_share_is_taken(solver):
    """A rough belt throws vertices on rails that move against a rough wall: every number, and every force on either."""
    belt = ds.Ground(-0.011, stiffness=1e6, width=0.01, friction=1.5, path=lambda t: [-20 * t, 0, 0], name="belt")
    wall = ds.HalfSpace([-0.011, 0, 0], [1, 0.2, 0.1], stiffness=1e6, width=0.01, friction=0.3, name="wall")
    mesh = tetrahedron().with_vertex_set("rail", [0]).with_vertex_set("rest", [1, 2, 3])
    options = dict(fixed={"rail": [0.1, 0.3, 1.0], "rest": "xyz"}, motion={"rail": lambda t: [0.3 * t, 0.5 * t, t]})
    scene = points(mesh, [belt, wall], initial_velocities=[-1.0, -6.0, 0.3], precision="f64", **options)
    parts = [
        ds.ContactForce(name, part, name=f"{part}_{name}")
        for name in ("belt", "wall")
        for part in ("normal", "friction")
    ]
    rollout = ds.Rollout(solver(scene, dt=1e-3, contact_damping=0.02), 3, 1, gradients="all", outputs=parts)
    assert np.abs(rollout.forward()["friction_belt"]).max() > 100
    assert check_rows(rollout) > 12


def test_work_of_supports_that_move_is_counted():
    """A roller leads a body along a rough floor that is askew to it and moves: what both do is no gain of the steps."""
    mesh = ds.TetrahedralMesh.create_box(3, size=0.1)
    motion = {"xmin": lambda t: [0.02 * np.sin(60 * t), 0, 0]}
    for friction, path in ((0.0, None), (0.4, lambda t: [0.3 * t, 0.09 * t, 0.2 * t])):
        floor = ds.HalfSpace((0, -0.003, 0), (0.3, 1, 0), width=0.004, stiffness=2000.0, friction=friction, path=path)
        scene = ds.Scene(
            mesh, ds.StableNeoHookean(3e4, 0.3), 1000.0, [ds.Gravity(), floor], {"xmin": "x"}, motion, precision="f64"
        )
        shares = []
        for dt in (2e-4, 1e-4):
            simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=dt, contact_damping=0.0))
            watch = simulator.workspace.energy_watch
            watch.every = 10
            simulator.run(round(0.1 / dt))
            shares.append(watch.share)
        assert watch.moving > 1 and shares[0] < 1e-4 and shares[1] < 0.4 * shares[0], shares
