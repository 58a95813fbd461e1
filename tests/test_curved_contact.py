"""Obstacles, and surfaces that meet each other, act on the faces of ten-node tetrahedra as curved as they are."""

import re
import warnings

import numpy as np
import pytest
from pairs_alone import follow_parts
from quadratic_meshes import ball, turned_by
from test_every_adjoint import assert_transposed

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.accuracy.replay import Replay
from diffsim_ti.diff_simulator import TorchSimulator
from diffsim_ti.mechanics.surfaces import curved_pairs
from diffsim_ti.mechanics.surfaces.curved_pairs import CurvedPairs
from diffsim_ti.mechanics.surfaces.surface_pairs import SurfacePairs
from diffsim_ti.mesh import reference_face
from diffsim_ti.mesh.collision_surface import CollisionSurface, cuts_of

R, W = 0.1, 0.004
EXPLICIT, IMPLICIT = ds.VelocityVerletSolver, ds.ImplicitEulerSolver


def lowest(mesh, positions) -> float:
    """Of the curved surface [m]."""
    grid = np.array([[x, y] for x in range(21) for y in range(21 - x)]) / 20
    return float((reference_face.functions(grid) @ positions[mesh.surface_faces])[:, :, 1].min())


def face_down(mesh, face=7):
    """Turned so that a face looks downwards."""
    n = mesh.vertices[mesh.surface_faces[face, :3]].mean(0)
    return turned_by(mesh, n / np.linalg.norm(n), (0, -1, 0))


def scene_of(mesh, obstacle, *terms, E=1e5, precision="f64", **options) -> ds.Scene:
    return ds.Scene(mesh, ds.StableNeoHookean(E, 0.3), 1000.0, [obstacle, *terms], precision=precision, **options)


def ball_on_a_ball(solver, **options) -> ds.Rollout:
    """A face that bows towards a small ball, which is half a width from it and two from all nodes."""
    mesh, width = face_down(ball(2)), 2e-3
    low = mesh.vertices[mesh.surface_faces[7]]
    top = reference_face.functions(np.full((1, 2), 1 / 3)) @ low
    small = ds.Sphere(
        top[0] - [0, 0.5 * width + 0.01, 0], 0.01, width=width, stiffness_per_area=1e7, name="small", **options
    )
    scene = scene_of(mesh, small, ds.Gravity(), initial_velocities=(0.05, -0.2, 0.02))
    dt = dict(dt=5e-5) if solver.explicit else dict(dt=2e-3, tolerance=1e-12)
    return ds.Rollout(solver(scene, **dt), 3, save_every=1, gradients="all")


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, IMPLICIT])
def test_a_ball_acts_on_curved_faces_where_they_are(solver):
    """The gap is that of the curved face to a tenth of a width; gradients know the smaller triangles."""
    rollout = ball_on_a_ball(solver, friction=0.3)
    simulator = ds.Simulator(rollout.solver)
    assert isinstance(simulator.workspace.pairs, CurvedPairs)
    assert simulator.smallest_gap() == pytest.approx(1e-3, abs=2e-4)
    assert simulator.compute_energy().parts["contact"] > 1e-4
    assert ds.dot_product_test(rollout) < (1e-11 if solver.explicit else 1e-8)


def test_what_acts_at_nodes_alone_is_said():
    with pytest.warns(
        UserWarning, match=r"lie up to .* m from the triangles of their nodes, where Ground.*a width of (\S+) m"
    ) as said:
        scene_of(ball(2), ds.Ground(-1.0, stiffness=1.0, width=1e-4))
    enough = float(re.search(r"a width of (\S+) m", str(said[0].message))[1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene_of(ball(2), ds.Ground(-1.0, stiffness=1.0, width=enough))
        scene_of(ball(2), ds.Sphere((0, -1, 0), 0.5, stiffness=1.0, width=1e-4))


def bar_under_a_plate(height=0.06, width=2e-3, **options) -> ds.Scene:
    """A bar that is straight in the mesh is bent to an arch; without a height its weight, which is upwards, bends it."""
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), (0.4, 0.02, 0.1)).quadratic()
    x = mesh.vertices.copy()
    x[:, 1] += height * np.sin(np.pi * x[:, 0] / 0.4)
    plate = ds.HalfSpace((0, x[:, 1].max() + 0.5 * width, 0), (0, -1, 0), width=width, stiffness_per_area=1e7)
    terms = [plate]
    if not height:
        terms = [ds.HalfSpace((0, 0.04, 0), (0, -1, 0), width=width, stiffness_per_area=1e5), ds.Gravity((0, 40, 0))]
    return scene_of(mesh, *terms, initial_positions=x, fixed=["xmin", "xmax"])


BENT = r"faces .* have bent by .* m towards HalfSpace.*acts at their nodes alone: .* a width of (\S+) m"


def solved_by(solver, scene):
    return solver(scene, dt=2e-5 if solver.explicit else 1e-3)


@pytest.mark.parametrize("solver", [EXPLICIT, IMPLICIT])
def test_a_run_says_where_faces_bend_farther_than_nodes_tell(solver):
    """Once, and not where it is as wide as it advises, or where faces bend away from it."""

    def run(height, width):
        ds.Simulator(solved_by(solver, bar_under_a_plate(height, width))).run(3)

    with pytest.warns(UserWarning, match=BENT) as said:
        run(0.06, 2e-3)
    assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(0.06, float(re.search(BENT, str(said[0].message))[1]))
        run(-0.06, 2e-3)


def test_rollouts_equilibria_batches_and_torch_say_it_too():
    for solver in (EXPLICIT, ds.SemiImplicitSolver, ds.BDF2Solver, ds.ImplicitMidpointSolver):
        rollout = ds.Rollout(solved_by(solver, bar_under_a_plate()), 3, gradients=[])
        with pytest.warns(UserWarning, match=BENT):
            rollout.forward()
    with pytest.warns(UserWarning, match=BENT):
        ds.rollout_frames(ds.Rollout(ds.StaticSolver(bar_under_a_plate(0)), 1, gradients=[]))
    with pytest.warns(UserWarning, match=BENT):
        TorchSimulator(solved_by(EXPLICIT, bar_under_a_plate())).step()
    batch = ds.Batch(solved_by(EXPLICIT, bar_under_a_plate()), 3, 2, gradients=[])
    with pytest.warns(UserWarning, match="have bent by .* m where obstacles act at their nodes alone: .* a width of"):
        batch.forward()


# ---- surfaces that meet each other -----------------------------------------------------------------------------------


def test_the_collision_surface_is_closed_and_tends_to_the_curved_one():
    mesh = ball(2)
    missing = []
    for cuts in range(3):
        surface = CollisionSurface(mesh, cuts)
        triangles, x = surface.surface_triangles, surface.vertices
        edges, twice = np.unique(
            np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0, return_counts=True
        )
        assert len(triangles) == 4 ** (cuts + 1) * len(mesh.surface_faces) and np.all(twice == 2)
        assert len(surface.surface_vertices) - len(edges) + len(triangles) == 2
        np.testing.assert_allclose(surface.matrix @ np.ones(mesh.num_vertices), 1, rtol=0, atol=1e-15)
        np.testing.assert_array_equal(x[: mesh.num_vertices], mesh.vertices)
        missing.append(mesh.volume - np.linalg.det(x[triangles]).sum() / 6)
    assert 3.9 < missing[0] / missing[1] < 4.1 and 3.9 < missing[1] / missing[2] < 4.1


def balls_face_to_face(gap=0.5 * W, precision="f64", **options) -> ds.Scene:
    """Whose curved faces are the width's half apart, and the flat triangles twice of it."""
    mesh = ball(2)
    n = mesh.vertices[mesh.surface_faces[7, :3]].mean(0)
    low, top = (turned_by(mesh, n / np.linalg.norm(n), (0, side, 0)) for side in (1, -1))
    high = -2 * lowest(top, top.vertices) + gap
    both = ds.TetrahedralMesh.joined([low.rotated([0, 1, 0], 0.3), top.translated([0.003, high, 0.002])])
    velocity = np.zeros((both.num_vertices, 3))
    velocity[both.vertex_sets["body_1"]] = [0.02, -0.5, 0]
    options = dict(initial_velocities=velocity) | options
    return scene_of(both, ds.SelfContact(2e3, W), E=5e4, precision=precision, **options)


@pytest.mark.parametrize("solver, precision", [(EXPLICIT, "f64"), (ds.BDF2Solver, "f64"), (EXPLICIT, "f32")])
def test_curved_faces_press_on_each_other(solver, precision):
    scene = balls_face_to_face(precision=precision)
    tolerance = {} if solver.explicit else dict(tolerance=1e-12)
    rollout = ds.Rollout(solver(scene, dt=5e-5 if solver.explicit else 2e-3, **tolerance), 4, gradients="all")
    simulator = ds.Simulator(rollout.solver)
    assert isinstance(simulator.workspace.pairs, CurvedPairs)
    assert 0.4 * W < simulator.smallest_gap() < 0.6 * W and simulator.compute_energy().parts["contact"] > 0.1
    assert_transposed(rollout, {"f64": 1e-11 if solver.explicit else 1e-9, "f32": 1e-3}[precision])
    if solver.explicit and precision == "f64":
        names = ["rest_positions", "self_contact_width", "self_contact_stiffness", "youngs_modulus"]
        assert ds.check_gradients(rollout, inputs=names, verbose=False).passed
        frames, mass = rollout.forward(), simulator.workspace.arrays.values.mass[:, None]
        p, q = ((mass * frames.velocities[k]).sum(0) for k in (0, -1))
        np.testing.assert_allclose(q, p, rtol=0, atol=1e-12 * np.abs(p).max())


def test_a_run_that_finds_faces_bent_through_each_other_has_smaller_triangles_once_it_is_reset(monkeypatch):
    """It takes four triangles for each curved face until it finds that they bend; smaller ones are not apart there."""
    monkeypatch.setattr(curved_pairs, "cuts_of", lambda mesh, width, bend: 2 if bend else 0)
    simulator = ds.Simulator(EXPLICIT(balls_face_to_face(0.1 * W), dt=5e-4))
    simulator.run(8)
    bending = simulator.workspace.bending
    bending.limit = bending.of_pairs = 0.0
    with pytest.raises(ValueError, match=r"^step 8, .* bent by .* not apart there: reset\(\) the simulator"):
        simulator.run(1)
    simulator.reset()
    simulator.run(1)
    assert simulator.smallest_gap() > 0 and isinstance(simulator.workspace.pairs, CurvedPairs)


def test_what_a_run_took_faces_for_goes_with_its_gradient_and_its_state():
    """After another run whose faces bend more, the gradient is that of the frames; a state has how far they do."""
    low = ds.TetrahedralMesh.create_box((2, 2, 2), size=0.1)
    both = ds.TetrahedralMesh.joined({"low": low, "top": low.translated((0.01, 0.102, 0))}).quadratic()
    velocity = np.zeros((both.num_vertices, 3))
    velocity[both.vertex_sets["top"]] = [0.1, -1.0, 0.05]
    scene = scene_of(both, ds.SelfContact(2e3, 0.003), E=5e4, initial_velocities=velocity)
    solver = EXPLICIT(scene, dt=2e-3)
    rollout = ds.Rollout(solver, 3, gradients="youngs_modulus")
    slow = rollout.forward(initial_velocities=0.1 * velocity)
    before = rollout.vjp(slow, slow.positions)["youngs_modulus"]
    fast = rollout.forward()
    assert rollout.sweep.bend > 0 and rollout.vjp(slow, slow.positions)["youngs_modulus"] == before
    np.testing.assert_array_equal(rollout.forward(initial_velocities=0.1 * velocity).positions, slow.positions)
    parts = ds.VelocityVerletSolver(scene, dt=2e-3), ds.UnequalSteps([4e-3, 1e-3], substeps=[26, 7])
    once, often = ds.Rollout(*parts), ds.Rollout(*parts, memory=0.2)  # which is looked at no sooner
    np.testing.assert_array_equal(often.forward().positions, once.forward().positions)
    assert 26 % often.checkpoints.segment and often.sweep.bend == once.sweep.bend > 0
    batch = ds.Batch(solver, 3, scenes=2).forward(initial_velocities=np.stack([velocity, 0.1 * velocity]))
    np.testing.assert_array_equal(batch.positions, [fast.positions, slow.positions])
    one, other = ds.Simulator(solver), ds.Simulator(solver)
    one.run(3)
    state = {name: x.copy() for name, x in one.state.items()}
    one.step()
    other.resume(state)
    other.step()
    assert state["bend"] > 0 and np.array_equal(one.positions, other.positions)
    again = ds.Rollout(IMPLICIT(scene, dt=2e-3), 3)
    Replay(again)  # of estimated errors, whose passes end, too
    again.forward()
    assert again.sweep.bend > 0


def rough_balls(precision="f64", friction=0.4, **options) -> ds.Scene:
    contact = ds.SelfContact(2e3, W, friction=friction, friction_speed=5e-3)
    return balls_face_to_face(precision=precision, **options).replace(terms=[contact])


@pytest.mark.parametrize("solver, precision", [(EXPLICIT, "f64"), (ds.BDF2Solver, "f64"), (EXPLICIT, "f32")])
def test_curved_faces_rub_on_each_other(solver, precision):
    scene, exact = rough_balls(precision), {} if solver.explicit else dict(tolerance=1e-12)
    dt, steps = (5e-5, 4) if solver.explicit else (2e-3, 2)
    rollout = ds.Rollout(solver(scene, dt=dt, **exact), steps, gradients="all")
    frames = rollout.forward()
    assert isinstance(rollout.sweep.workspace.pairs, CurvedPairs)
    assert_transposed(rollout, {"f64": 1e-11 if solver.explicit else 1e-8, "f32": 1e-3}[precision])
    if solver.explicit:
        mass, smooth = rollout.sweep.workspace.mass, scene.replace(terms=[ds.SelfContact(2e3, W)])
        without = ds.Rollout(solver(smooth, dt=5e-5), 4, gradients=[]).forward()
        p, q = ((mass * frames.velocities[k]).sum(0) for k in (0, -1))
        assert np.abs(q - p).max() < {"f64": 1e-12, "f32": 1e-5}[precision] * np.abs(p).max()
        assert np.abs(frames.velocities - without.velocities).max() > 0.1
    if solver.explicit and precision == "f64":
        names = ["rest_positions", "density", "self_contact_width", "self_contact_stiffness", "youngs_modulus"]
        names += ["self_contact_friction", "self_contact_friction_speed"]
        assert ds.check_gradients(rollout, inputs=names, verbose=False).passed


def test_friction_of_curved_faces_adds_no_energy(monkeypatch):
    """Whatever the coefficient and the friction speed."""
    seen = follow_parts(monkeypatch)
    for mu, eps in ((1e-2, 1e-5), (1e3, 1e-3)):
        scene = balls_face_to_face(fixed=[0]).replace(terms=[ds.SelfContact(2e3, W, friction=mu, friction_speed=eps)])
        rollout = ds.Rollout(EXPLICIT(scene, dt=5e-5, substeps=1), 3)
        rollout.vjp(rollout.forward(), np.ones((2, scene.mesh.num_vertices, 3)))  # for which passes are recorded
    assert max(lost for _, lost in seen) > 1e-2


def test_sets_that_rub_have_points_between_their_nodes():
    """Those whose nodes are all in the set; so named bodies have the friction that all have."""
    scene = rough_balls(friction={("body_0", "body_1"): 0.4})
    named, all_ = (ds.Rollout(EXPLICIT(s, dt=5e-5), 2, gradients=[]).forward() for s in (scene, rough_balls()))
    np.testing.assert_array_equal(named.positions, all_.positions)
    surface = CollisionSurface(scene.mesh, 1)
    both = np.concatenate([surface.vertex_sets[name] for name in ("body_0", "body_1")])
    np.testing.assert_array_equal(np.sort(both), np.arange(surface.num_vertices))


def test_forces_of_curved_faces_are_the_slope_of_their_energy():
    simulator = ds.Simulator(ds.BDF2Solver(balls_face_to_face(), dt=2e-3))
    potential, n = simulator.workspace.potential, simulator.scene.mesh.num_vertices
    d, e = 1e-2 * np.random.default_rng(0).standard_normal((2, n, 3))
    at = {}
    for step in (-1e-6, 1e-6, 0):
        potential.place(step * d)
        at[step] = potential.pairs.energies().sum(), _of_pairs(simulator)
    found = (at[1e-6][0] - at[-1e-6][0]) / 2e-6
    assert found == pytest.approx(-(at[0][1] * d).sum(), rel=1e-6) and abs(found) > 1e-3
    runtime.fill(potential.w, d[None])
    potential.pairs.launch(potential.pairs.multiplying(potential.u, potential.w, convex=False))
    np.testing.assert_allclose(
        ((at[1e-6][1] - at[-1e-6][1]) * e).sum() / 2e-6, (_at_corners(simulator) * e).sum(), rtol=1e-5
    )


def _of_pairs(simulator):
    simulator.workspace.potential.pairs.place(simulator.workspace.potential.u)
    return _at_corners(simulator)


def _at_corners(simulator):
    a = simulator.workspace.arrays
    out, surface = np.zeros((a.num_vertices, 3)), a.mesh.surface_vertices
    out[surface] = runtime.fetch(a.corner)[a.first_contact_corner :][: len(surface)]
    return out


def test_triangles_are_cut_only_where_curvature_asks():
    mesh, contact = ball(2), ds.SelfContact(1.0, W)
    assert [cuts_of(mesh, width) for width in (0.1, 0.01, W, 1e-4)] == [0, 1, 2, 3]
    assert cuts_of(mesh.linear(), W) == cuts_of(mesh.linear().quadratic(), W) == 0
    straight = scene_of(mesh.linear().quadratic(), contact)
    assert type(ds.Simulator(EXPLICIT(straight, dt=1e-5)).workspace.pairs) is SurfacePairs
