"""Obstacles, and surfaces that meet each other, feel the faces of ten-node tetrahedra as curved as they are."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from quadratic_meshes import ball, turned_by
from test_every_adjoint import assert_transposed

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.mechanics.obstacles.face_lattice import lattices
from diffsim_ti.mechanics.surfaces.curved_pairs import CurvedPairs
from diffsim_ti.mechanics.surfaces.surface_pairs import SurfacePairs
from diffsim_ti.mesh import curved_triangles, reference_face
from diffsim_ti.mesh.collision_surface import CollisionSurface, cuts_of
from diffsim_ti.mesh.ten_nodes import QUARTERS
from diffsim_ti.terms.obstacles.barrier import beta

R, W = 0.1, 0.004
CORNERS = np.array([[0, 0], [1, 0], [0, 1], [0.5, 0], [0.5, 0.5], [0, 0.5]])
EXPLICIT, IMPLICIT = ds.VelocityVerletSolver, ds.ImplicitEulerSolver


def slope(s):
    """beta'(s)"""
    s = np.clip(s, 1e-9, 1)
    return 2 * (1 - s) * np.log(s) - (1 - s) ** 2 / s


def force_of_a_sphere(gap, per_area):
    """Integral of the barrier's pressure over a sphere above a plane [N]."""
    d = gap + np.linspace(0, W, 20001)
    return np.trapezoid(-per_area * W * slope(d / W) * 2 * np.pi * R, d)


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


def obstacle(kind: str, below=0.1, **options):
    """Below a ball of radius R."""
    options = dict(width=0.01) | options
    level = -R - below * options["width"]
    if kind == "plane":
        return ds.HalfSpace((0, level, 0), (0.02, 1, 0.01), **options)
    if kind == "bowl":
        return ds.Sphere((0, 0.15, 0), 0.15 - level, inside=True, **options)
    if kind == "ground":
        return ds.Ground(level, **options)
    return ds.Capsule((-0.2, -R - 0.012, 0.01), (0.2, -R - 0.012, 0.0), 0.01, **options)


def energy_by_the_formula(scene, x, arrays) -> float:
    """k c w^2 beta(s) h(1 - r) over lattice points of curved triangles, a stiffness per area."""
    (term,), mesh = scene.terms, scene.mesh
    k, w = (float(term.values[name]) for name in ("barrier_stiffness_per_area", "barrier_width"))
    parts = lattices(arrays)[0][:, 0]
    total, areas = 0.0, np.linalg.norm(_normals(mesh.vertices[mesh.surface_triangles]), axis=1) / 2
    for f, (corners, p) in enumerate(zip(mesh.surface_triangles, parts)):
        s = np.array([[p - i - j, i, j] for i in range(p + 1) for j in range(p + 1 - i) if p not in (i, j, p - i - j)])
        s, inner = s / p, (s > 0).all(1)
        at = s @ CORNERS[QUARTERS[f % 4]]
        points = reference_face.functions(at) @ x[mesh.surface_faces[f // 4]]
        b = beta(np.clip(term.distance(points) / w, None, 1))
        r = s @ beta(np.clip(term.distance(x[corners]) / w, None, 1)) / np.maximum(b, 1e-300)
        y = np.maximum(1 - r, 0)
        each = areas[f] / p**2 * np.where(inner, 2, 1)
        total += (k * w**2 * each * b * y**3 * (6 - 8 * y + 3 * y * y))[b > 0].sum()
    return total


def _normals(x):
    return np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])


@pytest.mark.parametrize("kind", ["plane", "bowl"])
def test_energy_is_that_of_the_formula_and_all_solvers_feel_it(kind):
    mesh = face_down(ball(2))
    scene = scene_of(mesh, obstacle(kind, stiffness_per_area=1e6))
    x = mesh.vertices + 2e-4 * np.random.default_rng(0).standard_normal(mesh.vertices.shape)
    ours, theirs = ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-7)), ds.Simulator(IMPLICIT(scene, dt=1e-3))
    for simulator in (ours, theirs):
        simulator.set_state(positions=x)
    potential, u = theirs.workspace.potential, theirs.displacements
    potential.place(u)
    energy, forces = potential.faces.energies().sum(), potential.faces.forces()
    assert (
        energy == pytest.approx(energy_by_the_formula(scene, x, theirs.workspace.arrays), rel=1e-10) and energy > 1e-2
    )
    assert ours.compute_energy().parts["contact"] == pytest.approx(theirs.compute_energy().parts["contact"], rel=1e-12)
    expected = potential.forces()[0]
    ours.step()
    found = ours.workspace.arrays.values.mass[:, None] * ours.velocities / 1e-7
    np.testing.assert_allclose(found, expected, atol=2e-8 * np.abs(expected).max(), rtol=0)
    d, at = np.random.default_rng(1).standard_normal(u.shape), []
    for step in (1e-6, -1e-6):
        potential.place(u + step * d)
        at.append((potential.faces.energies().sum(), potential.faces.forces()))
    assert (at[1][0] - at[0][0]) / 2e-6 == pytest.approx((forces * d).sum(), rel=1e-5)
    potential.place(u)
    runtime.fill(potential.w, d[None])
    product = potential.faces.product()
    np.testing.assert_allclose((at[0][1] - at[1][1]) / 2e-6, product, atol=1e-5 * np.abs(product).max(), rtol=0)


def test_gaps_of_a_ball_converge_to_those_of_the_sphere():
    """Where it is pressed down by the integral of the barrier over a sphere, whichever way it is turned."""
    off = {}
    for cells in (2, 4, 8):
        per_area, off[cells] = 1e8, []
        for turn in ((0.3, -1, 0.2), (1, 0.4, -0.6), (0, -1, 0)):
            mesh = turned_by(ball(cells), np.array(turn) / np.linalg.norm(turn), (0, -1, 0))
            scene = scene_of(mesh, ds.Ground(-R - 2 * W, stiffness_per_area=per_area, width=W))
            simulator = ds.Simulator(IMPLICIT(scene, dt=1e-3))
            for gap in (0.5 * W, 0.2 * W):
                found = _gap(simulator.workspace.potential, force_of_a_sphere(gap, per_area))
                off[cells].append(abs(found - gap) / W)
    assert max(off[2]) < 0.2 and max(off[4]) < 0.05 and max(off[8]) < 0.005


def _gap(potential, target) -> float:
    """Where a ball is pressed with a force [N], of the sphere [m]."""
    low, high = -0.9 * W, 1.5 * W
    u = np.zeros((potential.arrays.num_vertices, 3))
    for _ in range(12):
        u[:, 1] = (low + high) / 2 - 2 * W
        potential.place(u)
        stronger = potential.forces()[0][:, 1].sum() > target
        low, high = ((low + high) / 2, high) if stronger else (low, (low + high) / 2)
    return (low + high) / 2


def wobbling(t):
    return 0.3 * t, 0.2 * t - 3 * t * t, -0.1 * t


PER_AREA, OF_VERTICES = dict(stiffness_per_area=1e6), dict(stiffness=100.0)


@pytest.mark.parametrize(
    "solver, kind, options, precision",
    [
        (EXPLICIT, "plane", PER_AREA, "f64"),
        (EXPLICIT, "capsule", OF_VERTICES, "f32"),
        pytest.param(IMPLICIT, "plane", PER_AREA | dict(friction=0.3), "f64", marks=pytest.mark.thorough),
        (ds.BDF2Solver, "bowl", OF_VERTICES | dict(friction=0.3), "f64"),
    ],
)
def test_the_adjoint_is_the_transpose_of_the_tangent(solver, kind, options, precision):
    made = obstacle(kind, path=wobbling, **options)
    scene = scene_of(face_down(ball(2)), made, ds.Gravity(), precision=precision, initial_velocities=(0.1, -0.1, 0.02))
    made = solver(scene, dt=1e-4) if solver.explicit else solver(scene, dt=2e-3, tolerance=1e-12)
    assert_transposed(ds.Rollout(made, 4, gradients="all"), 1e-9 if precision == "f64" else 1e-3)


@pytest.mark.parametrize("solver", [EXPLICIT, ds.BDF2Solver])
def test_gradients_agree_with_differences(solver):
    scene = scene_of(face_down(ball(2)), obstacle("plane", **PER_AREA), ds.Gravity(), initial_velocities=(0, -0.1, 0))
    rollout = ds.Rollout(
        solver(scene, dt=1e-4) if solver.explicit else solver(scene, dt=2e-3, tolerance=1e-12),
        4,
        gradients=["rest_positions", "half_space_normal"]
        + ["barrier_stiffness_per_area", "barrier_width", "youngs_modulus"] * solver.explicit,
    )
    assert ds.check_gradients(rollout, verbose=False).passed


@pytest.mark.parametrize("solver", [EXPLICIT, ds.BDF2Solver])
def test_a_ball_comes_to_rest_where_the_sphere_would(solver):
    """And its surface, not its vertices alone, stays above the ground on the way there."""
    mesh, k = face_down(ball(2)), 3e6
    ground = ds.Ground(-R - 1.2 * W, stiffness_per_area=k, width=W)
    scene = scene_of(mesh, ground, ds.Gravity(), ds.Drag(30.0), E=3e5)
    steps, dt = (300, 1e-3) if solver.explicit else (30, 1e-2)
    limit = ds.stable_dt(scene) if solver.explicit else dt
    simulator = ds.Simulator(solver(scene, dt=dt, substeps=int(np.ceil(dt / limit))))
    for _ in range(steps):
        simulator.step()
        assert lowest(mesh, simulator.positions) > -R - 1.2 * W
    weight = 9.81 * simulator.workspace.arrays.values.mass.sum()
    expected = np.linspace(0.02, 1, 500) * W
    expected = expected[np.argmin([abs(force_of_a_sphere(gap, k) - weight) for gap in expected])]
    assert np.abs(simulator.velocities).max() < 2e-2
    assert abs(lowest(mesh, simulator.positions) + R + 1.2 * W - expected) < 0.15 * W


def arch(sag: float) -> tuple[ds.TetrahedralMesh, np.ndarray]:
    """A bar of few ten-node tetrahedra that is straight in the mesh, and its vertices where it is bent to an arch."""
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), (0.4, 0.02, 0.1)).quadratic()
    x = mesh.vertices.copy()
    x[:, 1] += sag * np.sin(np.pi * x[:, 0] / 0.4)
    return mesh, x


@pytest.mark.parametrize("solver", [EXPLICIT, IMPLICIT])
def test_what_bends_in_a_run_is_felt_as_curved(solver):
    """A tilted plate that comes down on an arch feels the body's own face, not four flat triangles; gradients know it."""
    mesh, x = arch(0.06)
    n = np.array([0.3, -1, 0]) / np.hypot(0.3, 1)
    grid = np.array([[i, j] for i in range(21) for j in range(21 - i)]) / 20

    def nearest(positions):
        faces = reference_face.functions(grid) @ positions[mesh.surface_faces]
        return float(((faces - top) @ n).min())

    top = np.zeros(3)
    top = (nearest(x) - 0.002) * n  # the plate, 2 mm from the arch
    plate = ds.HalfSpace(top, n, width=0.01, stiffness_per_area=1e7, path=lambda t: [0, -1.0 * t, 0])
    scene = scene_of(mesh, plate, initial_positions=x, fixed=["xmin", "xmax"])
    made = solver(scene, dt=2e-5) if solver.explicit else solver(scene, dt=1e-3, tolerance=1e-12)
    simulator, steps = ds.Simulator(made), 60 if solver.explicit else 4
    assert not simulator.workspace.arrays.curved
    for _ in range(steps):
        simulator.step()
        assert nearest(simulator.positions) > -simulator.time * 1.0 * abs(n[1]) and simulator.workspace.arrays.curved
    assert simulator.step_count == steps and np.abs(simulator.velocities).max() > 0.1
    rollout = ds.Rollout(made, 4, gradients=["initial_positions", "youngs_modulus", "barrier_width"])
    assert_transposed(rollout, 1e-9)
    assert rollout.sweep.workspace.arrays.curved


def test_straight_edges_and_linear_tetrahedra_know_nothing_of_it():
    cube, ground = ds.TetrahedralMesh.create_cube(2), ds.Ground(-0.01, stiffness=1e3, width=0.02)
    for mesh in (cube, cube.quadratic()):
        workspace = ds.Simulator(IMPLICIT(scene_of(mesh, ground), dt=1e-3)).workspace
        assert not workspace.arrays.features().curved and workspace.potential.faces is None
    bent, width = ball(2), 0.01
    far = ds.Ground(-1, stiffness=1.0, width=width)
    assert curved_triangles.are_treated_as_curved(bent, [far]) and not curved_triangles.are_treated_as_curved(
        bent.linear().quadratic(), [far]
    )
    wide = ds.Ground(-1, stiffness=1.0, width=width * curved_triangles.bow(bent) / (0.019 * width))
    assert not curved_triangles.are_treated_as_curved(bent, [wide]) and not curved_triangles.are_treated_as_curved(
        bent, []
    )


def test_obstacles_warn_of_no_bow():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene_of(ball(2), ds.Ground(-1.0, stiffness=1.0, width=1e-4))


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


def rubbing_balls(precision="f64", friction=0.4, **options) -> ds.Scene:
    contact = ds.SelfContact(2e3, W, friction=friction, friction_speed=5e-3)
    return balls_face_to_face(precision=precision, **options).replace(terms=[contact])


@pytest.mark.parametrize("solver, precision", [(EXPLICIT, "f64"), (ds.BDF2Solver, "f64"), (EXPLICIT, "f32")])
def test_curved_faces_rub_on_each_other(solver, precision):
    scene, exact = rubbing_balls(precision), {} if solver.explicit else dict(tolerance=1e-12)
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
        names = ["rest_positions", "density", "self_contact_friction", "self_contact_friction_speed"]
        assert ds.check_gradients(rollout, inputs=names, verbose=False).passed


def test_rubbing_of_curved_faces_adds_no_energy():
    """Whatever the velocities, the length of a pass, the coefficient and the friction speed."""
    rng, lost = np.random.default_rng(3), []
    for mu, eps in ((1e-2, 1e-5), (0.5, 1.0), (1e3, 1e-3)):
        contact = ds.SelfContact(2e3, W, friction=mu, friction_speed=eps)
        scene = balls_face_to_face(fixed=[0]).replace(terms=[contact])
        ws = ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-6)).workspace
        pairs, mass = ws.pairs, ws.mass
        for h in (1e-7, 1e-4, 1.0):
            pairs.forces(ws.state.u, 0, ws.arrays.corner)
            pairs.friction.measure(ws.state.u, 0)
            v = rng.normal(size=(1, scene.mesh.num_vertices, 3)) * 10.0 ** rng.uniform(-3, 1)
            v[0, 0] = 0
            runtime.fill(ws.state.v, v)
            pairs.friction.slide(ws.state, 0, SimpleNamespace(h=h, alpha=h, decay=1.0), recording=False)
            before, now = (0.5 * float((mass * x[0] ** 2).sum()) for x in (v, runtime.fetch(ws.state.v)))
            assert now <= before * (1 + 1e-14)
            lost.append(1 - now / before)
    assert max(lost) > 1e-3 and min(lost) < 1e-4


def test_sets_that_rub_have_points_between_their_nodes():
    """Those whose nodes are all in the set; so named bodies rub as all do."""
    scene = rubbing_balls(friction={("body_0", "body_1"): 0.4})
    named, all_ = (ds.Rollout(EXPLICIT(s, dt=5e-5), 2, gradients=[]).forward() for s in (scene, rubbing_balls()))
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
    potential.pairs.hessian_product(potential.u, potential.w, convex=False)
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
    assert [cuts_of(mesh, ds.SelfContact(1.0, width)) for width in (0.1, 0.01, W, 1e-4)] == [0, 1, 2, 3]
    assert cuts_of(mesh.linear(), contact) == cuts_of(mesh.linear().quadratic(), contact) == 0
    assert cuts_of(mesh, ds.SelfContact(1.0, W, friction=0.2)) == 2
    straight = scene_of(mesh.linear().quadratic(), contact)
    assert type(ds.Simulator(EXPLICIT(straight, dt=1e-5)).workspace.pairs) is SurfacePairs
