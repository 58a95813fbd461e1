"""Supports by component: closed forms that need rollers, every derivative of what they prescribe, what statics says."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from test_every_adjoint import assert_transposed
from test_gradients import random_mesh
from test_loads import loads, solver_of
from test_term_order import SOLVERS

import diffsim_ti as ds
from diffsim_ti.diff_simulator import rollout_frames
from diffsim_ti.terms.supports import Supports, rigid_motions_left

STEPS = 4
MIXED = {"xmin": "x", "ymin": "y", "zmin": "z", "lid": [[1, 1, 0.5]]}
MOTIONS = {
    "held": None,
    "by set": {
        "lid": lambda t: [0.3 * t, 10 * t * t, 0.2 * t],
        "ymin": ([0, 0.004, 1], [[0, 0, 0], [0, 0.01, 0], [0, 1, 1]]),
    },
    "of all": lambda t: np.array([0.2 * t, 0.05 * np.sin(20 * t), 0.3 * t * t]),
}
every = pytest.mark.parametrize("kind", SOLVERS, ids=lambda s: s.__name__)


def supported(motion=None, terms=(), **options) -> ds.Scene:
    """A distorted body on three rollers at right angles, and one askew, from a deformed start that moves."""
    mesh = random_mesh(2).with_surface_set("lid", lambda x, n: x[:, 0] > 0.8)
    rng, shape = np.random.default_rng(1), mesh.vertices.shape
    start = dict(
        initial_positions=mesh.vertices + 0.01 * rng.normal(size=shape), initial_velocities=0.3 * rng.normal(size=shape)
    )
    options = dict(fixed=MIXED, motion=motion, precision="f64") | start | options
    return ds.Scene(
        mesh, ds.StableNeoHookean(1e5, 0.3), 1000 * rng.uniform(0.8, 1.2, mesh.num_tetrahedra), terms, **options
    )


def made(kind, scene):
    solver = solver_of(kind, scene)
    return solver if kind is not ds.StaticSolver else ds.StaticSolver(scene, load_steps=2, tolerance=1e-12, dt=2e-3)


@pytest.mark.parametrize("motion", MOTIONS)
@every
def test_every_number_is_transposed(kind, motion):
    scene = supported(MOTIONS[motion], [ds.Gravity(), *loads()])
    rollout = ds.Rollout(made(kind, scene), STEPS, save_every=2, gradients="all")
    assert_transposed(rollout, 1e-12 if kind.explicit else 1e-8, ("drag_rate",) if kind is ds.StaticSolver else ())


@pytest.mark.parametrize(
    "kind", [ds.SemiImplicitSolver, ds.VelocityVerletSolver, ds.BDF2Solver], ids=lambda s: s.__name__
)
def test_gradients_against_differences(kind):
    rollout = ds.Rollout(made(kind, supported(MOTIONS["by set"])), 2, gradients="all")
    names = ("prescribed_motion", "initial_positions", "initial_velocities") if kind.explicit else "prescribed_motion"
    table = ds.check_gradients(rollout, inputs=[names] if isinstance(names, str) else names)
    assert all(row.relative_error < 1e-6 for row in table.rows), table


@pytest.mark.executed_ptx
@every
def test_what_is_held_is_held_and_the_rest_is_free(kind):
    scene = supported(MOTIONS["by set"])
    solver = made(kind, scene)
    frames = ds.Rollout(solver, STEPS, save_every=1).forward()
    moved = frames.positions - frames.positions[0]
    mesh = scene.mesh
    assert np.abs(moved[:, mesh.vertex_indices("xmin"), 0]).max() < 1e-14
    assert np.abs(moved[1:, mesh.vertex_indices("xmin"), 1:]).max() > 1e-7
    n = np.array([1, 1, 0.5]) / 1.5
    for frame, t in zip(moved, frames.times):
        want = np.dot([0.3 * t, 10 * t * t, 0.2 * t], n)
        np.testing.assert_allclose(frame[mesh.vertex_indices("lid")] @ n, want, rtol=0, atol=1e-14)
    if kind is not ds.StaticSolver:
        assert np.abs(frames.velocities[:, mesh.vertex_indices("xmin"), 0]).max() < 1e-14
    sim = ds.Simulator(solver)
    sim.run(STEPS)
    np.testing.assert_allclose(sim.positions, frames.positions[-1], rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    "kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver, ds.StaticSolver], ids=lambda s: s.__name__
)
def test_a_turned_scene_moves_as_one_along_axes(kind):
    """Directions of supports mean nothing: rollers along axes, and the same turned, with rollers along any direction."""
    mesh = random_mesh(2).with_surface_set("lid", lambda x, n: x[:, 0] > 0.8)
    R = ds.TetrahedralMesh.create_cube(2).rotated([1.0, 2.0, -0.5], 0.7).vertices[[4, 2, 1]].T
    turned = mesh.rotated(R)
    axes = {"xmin": "x", "ymin": "y", "zmin": "z", "lid": "x"}
    along = {name: R[:, ["xyz".index(a) for a in how]].T for name, how in axes.items()}
    g, ends = np.array([0, -9.81, 3.0]), []
    for body, fixed, Q in ((mesh, axes, np.eye(3)), (turned, along, R)):
        motion = {"lid": lambda t, Q=Q: Q @ [0.5 * t, 0, 0]}
        terms = [ds.Gravity(Q @ g), ds.Pressure(200.0, "ymax")] if "ymax" in body.surface_sets else [ds.Gravity(Q @ g)]
        scene = ds.Scene(body, ds.StableNeoHookean(1e4, 0.3), 1000.0, terms, fixed, motion, precision="f64")
        ends.append(ds.Rollout(made(kind, scene), STEPS).forward().positions[-1])
    np.testing.assert_allclose(ends[0] @ R.T, ends[1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", [ds.SemiImplicitSolver, ds.VelocityVerletSolver], ids=lambda s: s.__name__)
def test_explicit_energy_is_followed_with_supports_that_move(kind):
    """Nothing is gained by the steps: what rollers do on the body is work from outside."""
    mesh = ds.TetrahedralMesh.create_box((4, 3, 3), (1.0, 0.5, 0.5))
    fixed, motion = (
        {"xmin": "x", "xmax": [1, 0, 0], "ymin": "y", "zmin": "z"},
        {"xmax": lambda t: [0.2 * np.sin(30 * t), 0, 0]},
    )
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, [ds.Gravity()], fixed, motion, precision="f64")
    sim = ds.Simulator(kind(scene, dt=2e-4))
    watch = sim.workspace.energy_watch
    watch.every = 20
    sim.run(400)
    assert watch.moving > 1 and watch.share < 2e-3


# ---- closed forms --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [ds.StaticSolver, pytest.param(ds.VelocityVerletSolver, marks=pytest.mark.thorough)])
def test_the_shape_of_a_held_body_moves_its_supports(kind):
    """`shape` against differences, in NumPy, torch and batches; the gradient by rest_positions alone is another."""
    mesh, rng = ds.TetrahedralMesh.create_box((4, 2, 2), (0.3, 0.1, 0.1)), np.random.default_rng(0)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity()], fixed="xmin", precision="f64")
    solver = kind(scene, tolerance=1e-12) if kind is ds.StaticSolver else kind(scene, dt=1e-3, substeps=4)
    steps = 1 if kind is ds.StaticSolver else 4
    rollout, batch = (make(solver, steps, *n, gradients="shape") for make, n in ((ds.Rollout, ()), (ds.Batch, (2,))))
    X, along = (x + 1e-3 * rng.normal(size=mesh.vertices.shape) for x in (mesh.vertices, 0.0))
    tip = lambda x: rollout.forward(shape=x).positions[-1, -1, 1]  # noqa: E731
    slope = (tip(X + 1e-3 * along) - tip(X - 1e-3 * along)) / 2e-3
    frames = rollout.forward(shape=X)
    seed = np.zeros(frames.positions.shape)
    seed[-1, -1, 1] = 1
    gradients = rollout.vjp(frames, seed)
    assert (gradients["shape"] * along).sum() == pytest.approx(slope, rel=1e-6)
    assert (gradients["rest_positions"] * along).sum() != pytest.approx(slope, rel=0.05)
    assert (rollout.jvp(frames, shape=along)[0] * seed).sum() == pytest.approx(slope, rel=1e-6)
    x = torch.tensor(X, requires_grad=True)
    rollout_frames(rollout, shape=x).positions[-1, -1, 1].backward()
    np.testing.assert_allclose(x.grad.numpy(), gradients["shape"], rtol=0, atol=1e-12)
    many = batch.forward(shape=np.stack([mesh.vertices, X]))
    by = batch.vjp(many, np.stack([0 * seed, seed]))["shape"]
    np.testing.assert_allclose(by, [0 * along, gradients["shape"]], rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="leave out rest_positions"):
        rollout.forward(shape=X, rest_positions=X)
    with pytest.raises(ValueError, match="places of all vertices"):
        rollout.forward(shape=X[1:])


def test_hanging_bar():
    """0.05 x 0.05 x 1 m on rollers at its top, one edge guided along z, E 125 kPa, nu 0.25, rho 1000: tip 0.0406034 m and
    its derivative by E -3.359588747e-7 m/Pa, by integration of the law of a bar under uniaxial stress."""
    mesh = ds.TetrahedralMesh.create_box((3, 41, 3), (0.05, 1.0, 0.05))
    fixed = {"ymax": "y", "xmin": "x", "zmin": "z"}  # a quarter: planes of symmetry leave the sides free
    scene = ds.Scene(mesh, ds.StableNeoHookean(125e3, 0.25), 1000.0, [ds.Gravity()], fixed, precision="f64")
    rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-10), 1, gradients=["youngs_modulus"])
    frames = rollout.forward()
    tip = mesh.vertex_indices("ymin")
    assert abs(-frames.displacements[-1][tip, 1].mean() / 0.0406034 - 1) < 5e-3
    w = np.zeros_like(frames.positions)
    w[-1, tip, 1] = -1 / len(tip)
    assert abs(rollout.vjp(frames, w)["youngs_modulus"] / -3.359588747e-7 - 1) < 5e-3


def uniaxial(E, nu, s):
    """(lateral stretch, nominal stress) of psi = mu/2 (I_C - 3) - mu log J + lam/2 (J - 1)^2 under uniaxial stress."""
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))

    def lateral(q):
        J = s * q * q
        return mu * (q - 1 / q) + lam * (J - 1) * s * q

    q = brentq(lateral, 0.3, 3, xtol=1e-15)
    return q, mu * (s - 1 / s) + lam * (s * q * q - 1) * q * q


@pytest.mark.parametrize("nu", [0.3, 0.45, 0.49])
@pytest.mark.parametrize("s", [1.5, 2.0, 0.5])
def test_uniaxial_stretch(s, nu):
    """By displacement on rollers, against the closed form: lateral stretch and force to 1e-8."""
    E, mesh = 1e5, ds.TetrahedralMesh.create_box(3, (1.0, 0.5, 0.5))
    fixed = {"xmin": "x", "ymin": "y", "zmin": "z", "xmax": "x"}
    start = mesh.vertices * [s, s**-0.4, s**-0.4]
    with pytest.warns(UserWarning) if nu > 0.45 else nullcontext():
        scene = ds.Scene(mesh, ds.StableNeoHookean(E, nu), 1000.0, (), fixed, initial_positions=start, precision="f64")
    frames = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 1).forward()
    q, P = uniaxial(E, nu, s)
    x = frames.positions[-1].astype(float)
    np.testing.assert_allclose(x, mesh.vertices * [s, q, q], rtol=0, atol=1e-8)
    fields = ds.Simulator(ds.StaticSolver(scene.replace(initial_positions=x), tolerance=1e-9)).tetrahedron_fields()
    np.testing.assert_allclose(fields.von_mises, abs(P) / (q * q), rtol=1e-8)  # nominal stress over the area left


def test_uniaxial_traction_finds_the_stretch_back():
    E, nu, s = 1e5, 0.3, 1.5
    q, P = uniaxial(E, nu, s)
    mesh = ds.TetrahedralMesh.create_box(3, (1.0, 0.5, 0.5))
    fixed = {"xmin": "x", "ymin": "y", "zmin": "z"}
    scene = ds.Scene(mesh, ds.StableNeoHookean(E, nu), 1000.0, [ds.Traction([P, 0, 0], "xmax")], fixed, precision="f64")
    frames = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 1).forward()
    np.testing.assert_allclose(frames.positions[-1], mesh.vertices * [s, q, q], rtol=0, atol=1e-8)


def tube(n: int, radii=(1.0, 1.5), length=0.3) -> ds.TetrahedralMesh:
    """A quarter of a tube along z, n cells through its wall; "inner" is its inside."""
    box = ds.TetrahedralMesh.create_box((n + 1, 2 * n + 1, 2), (1.0, 1.0, length), pattern="five")
    s, t, z = box.vertices.T
    r, angle = radii[0] + (radii[1] - radii[0]) * s, np.pi / 2 * t
    sets = dict(box.vertex_sets) | {"x0": t > 1 - 1e-9, "y0": t < 1e-9}
    placed = np.stack([r * np.cos(angle), r * np.sin(angle), z], 1)
    mesh = ds.TetrahedralMesh(placed, box.tetrahedra, vertex_sets=sets)
    inside = (s < 1e-9)[mesh.surface_triangles].all(1)
    return mesh.with_surface_set("inner", np.flatnonzero(inside))


def test_thick_tube_under_pressure():
    """Lame, plane strain by rollers on both ends: u(r) = (1 + nu) p a^2 / (E (b^2 - a^2)) [(1 - 2 nu) r + b^2 / r], the
    stress along it 2 nu p a^2 / (b^2 - a^2), and what the planes of symmetry carry, p a on each. Errors fall by h^2, which
    leaves 1 % with six cells through the wall; forces are in balance on any mesh."""
    E, nu, (a, b), length, errors = 1e5, 0.3, (1.0, 1.5), 0.3, []
    p = 1e-6 * E
    fixed = dict(x0="x", y0="y", zmin="z", zmax="z")
    sides = [ds.Reaction(name, name=name) for name in ("x0", "y0", "zmax")]
    for n in (3, 6):
        mesh = tube(n)
        scene = ds.Scene(mesh, ds.StableNeoHookean(E, nu), 1000.0, ds.Pressure(p, "inner"), fixed, precision="f64")
        rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-10), 1, outputs=sides, gradients=["youngs_modulus"])
        frames = rollout.forward()
        R = np.linalg.norm(mesh.vertices[:, :2], axis=1)
        u = np.linalg.norm(frames.positions[-1][:, :2], axis=1) - R
        exact = (1 + nu) * p * a**2 / (E * (b**2 - a**2)) * ((1 - 2 * nu) * R + b**2 / R)
        errors.append(np.abs(u / exact - 1).max())
        assert np.abs(frames.displacements[-1][:, 2]).max() < 1e-3 * np.abs(u).max()
        carried = [frames["x0"][-1][0], frames["y0"][-1][1]]
        np.testing.assert_allclose(carried, [-p * a * length] * 2, rtol=1e-5)  # the follower's, on what is deformed
        along = 2 * nu * p * a**2 / (b**2 - a**2) * np.pi / 4 * (b**2 - a**2)
        assert frames["zmax"][-1][2] == pytest.approx(along, rel=6 * errors[-1])
    seed = np.zeros(frames.positions.shape)
    seed[-1, :, :2] = mesh.vertices[:, :2] / R[:, None] / len(R)
    assert rollout.vjp(frames, seed)["youngs_modulus"] == pytest.approx(-u.mean() / E, rel=1e-4)
    assert errors[1] < 0.01 and errors[1] < errors[0] / 3.3, errors


def octant(n, radii=(1.0, 1.5)) -> ds.TetrahedralMesh:
    """An eighth of a hollow sphere, from a cube's three faces blown up; inner and outer surface named."""
    box = ds.TetrahedralMesh.create_box((n + 1, n + 1, n + 1), 1.0, pattern="five")
    parts = []
    for axis in range(3):  # three pyramids of directions meet along edges
        a, b, c = box.vertices.T
        direction = np.stack([np.ones_like(a), np.tan(np.pi / 4 * a), np.tan(np.pi / 4 * b)], 1)
        direction = np.roll(direction / np.linalg.norm(direction, axis=1, keepdims=True), axis, 1)
        parts.append(direction * (radii[0] + (radii[1] - radii[0]) * c)[:, None])
    whole = np.concatenate(parts)
    tets = np.concatenate([box.tetrahedra + k * box.num_vertices for k in range(3)])
    _, first, inverse = np.unique(np.round(whole, 9), axis=0, return_index=True, return_inverse=True)
    mesh = ds.TetrahedralMesh(whole[first], inverse.ravel()[tets], fix_orientation=True)
    middle = sum(radii) / 2
    for name, inside in (("inner", True), ("outer", False)):
        mesh = mesh.with_surface_set(
            name,
            lambda x, n, i=inside: (
                (abs((x * n).sum(1)) > 0.9 * np.linalg.norm(x, axis=1)) & ((np.linalg.norm(x, axis=1) < middle) == i)
            ),
        )
    for k, axis in enumerate("xyz"):
        mesh = mesh.with_vertex_set(axis, np.abs(mesh.vertices[:, k]) < 1e-9)
    return mesh


def test_hollow_sphere_under_pressure():
    """Lame: u(r) = p a^3 / (b^3 - a^3) [(1 - 2 nu) r + (1 + nu) b^3 / (2 r^2)] / E, reached at second order; and the volume
    inside is the potential of the pressure, held edges in planes of symmetry."""
    E, nu, p, (a, b) = 1e5, 0.3, 10.0, (1.0, 1.5)
    errors = []
    for n in (3, 6):
        mesh = octant(n)
        fixed = dict(x="x", y="y", z="z")
        scene = ds.Scene(mesh, ds.StableNeoHookean(E, nu), 1000.0, [ds.Pressure(p, "inner")], fixed, precision="f64")
        rollout = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-9), 1, gradients=["pressure"])
        frames = rollout.forward()
        assert not rollout.sweep.workspace.newton.by_residual
        inner = mesh.vertex_indices("inner")
        u = np.linalg.norm(frames.positions[-1], axis=1) - np.linalg.norm(mesh.vertices, axis=1)
        exact = p * a**3 / (b**3 - a**3) * ((1 - 2 * nu) * a + (1 + nu) * b**3 / (2 * a**2)) / E
        errors.append(abs(u[inner].mean() / exact - 1))
        if n == 3:
            w = np.zeros_like(frames.positions)
            w[-1, inner] = mesh.vertices[inner] / len(inner)
            np.testing.assert_allclose(rollout.vjp(frames, w)["pressure"] * p, u[inner].mean(), rtol=1e-3)
    assert errors[1] < 0.01 and errors[1] < errors[0] / 2.5


# ---- what is refused -----------------------------------------------------------------------------------------------------


def test_statics_says_which_rigid_motions_are_free():
    mesh = ds.TetrahedralMesh.create_cube(3)
    law = ds.StableNeoHookean(1e5, 0.3)
    for fixed, words in (
        ({"ymin": "y"}, r"2 translations, 1 rotation: along x and z, about y"),
        ({"ymin": "y", "xmin": "x"}, r"1 translation: along z"),
        ({"ymin": [1, 1, 0]}, r"2 translations, 1 rotation: along .*, about \(0.707, 0.707, 0\)"),
    ):
        with pytest.raises(ValueError, match=f"the body is free to move rigidly \\({words}\\): hold it by fixed="):
            ds.StaticSolver(ds.Scene(mesh, law, fixed=fixed))
    ds.StaticSolver(ds.Scene(mesh, law, fixed={"ymin": "y", "xmin": "x", "zmin": "z"}))
    two = ds.TetrahedralMesh.joined([mesh, mesh.translated([3, 0, 0])])
    with pytest.raises(ValueError, match=r"piece 1 of 2 of the body is free to move rigidly \(6 rigid modes"):
        ds.StaticSolver(ds.Scene(two, law, fixed={"body_0": "xyz"}))
    assert rigid_motions_left(np.zeros((1, 3)), np.eye(3)[None]) == "3 rotations"
    corners = np.array([[0.0, 0, 0], [1, 0, 0]])
    assert rigid_motions_left(corners, np.tile(np.eye(3), (2, 1, 1))) == "1 rotation: about x"


def lying(gap, order=1, gravity=(0, -9.81, 0), friction=0.0, fixed=None):
    """A block above a floor, which holds it along y."""
    mesh = ds.TetrahedralMesh.create_box(3, 0.1, origin=(0, gap, 0))
    floor = ds.Ground(0, stiffness_per_area=1e6, width=0.005, friction=friction, name="floor")
    fixed = {"xmin": "x", "zmin": "z"} if fixed is None else fixed
    mesh, terms = mesh if order == 1 else mesh.quadratic(), [ds.Gravity(gravity), floor]
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, terms, fixed, precision="f64")


@pytest.mark.parametrize("order", [1, 2])
def test_contact_holds_what_supports_leave(order):
    """From any gap up to the body's size the block goes to one equilibrium, with exact gradients."""
    ends = []
    for gap in (1e-4, 0.004, 0.02, 0.09) if order == 1 else (0.004, 0.02):
        solver = ds.StaticSolver(lying(gap, order), tolerance=1e-11)
        rollout = ds.Rollout(solver, 2, save_every=1, outputs=ds.ContactForce("floor"), gradients="all")
        with pytest.warns(UserWarning, match=r"free to move rigidly \(1 translation: along y\); contact holds it"):
            frames = rollout.forward()
        ends.append(frames.positions)
        np.testing.assert_allclose(frames["contact_force"][1:], [[0, 9.81, 0]] * 2, atol=1e-6)
        np.testing.assert_allclose(ends[-1][1:], ends[0][[1, 1]], atol=1e-9)
    assert order == 2 or ds.dot_product_test(rollout) < 1e-8


def test_contact_that_does_not_hold_is_refused():
    for options, words in (
        (dict(gap=0.5), "leaves 1 translation: along y"),
        (dict(gap=0.01, gravity=(0, 9.81, 0)), "leaves 1 translation: along y"),
        (dict(gap=0.01, gravity=(0, 0, 0)), "leaves 1 translation: along y"),
        (dict(gap=0.004, fixed={"xmin": "x"}), "leaves 1 translation: along z"),
        (dict(gap=0.004, fixed=[]), "2 translations, 1 rotation: along x and z, about y"),
    ):
        simulator = ds.Simulator(ds.StaticSolver(lying(**options)))
        with pytest.raises(ds.NotConverged, match=f"contact .*{words}: hold it by"):
            simulator.step()
    within = ds.Simulator(ds.StaticSolver(lying(0.004, friction=0.5, fixed=[])))  # friction holds it
    with pytest.warns(UserWarning, match="6 rigid modes.*contact holds it") as said:
        within.step()
    assert said[0].filename == __file__


def test_sets_join():
    mesh = ds.TetrahedralMesh.create_cube(3).with_surface_set("lid", lambda x, n: n[:, 1] > 0.9)
    supports = Supports(mesh, {"xmin": "x", "lid": "normal", "zmin": "xyz", "xmax": [[1, 1, 0], [1, -1, 0]]})
    assert set(mesh.vertex_sets["zmin"]) <= set(supports.fixed)
    both = np.intersect1d(mesh.vertex_sets["xmin"], mesh.vertex_sets["ymax"])
    at = np.searchsorted(supports.vertices, np.setdiff1d(both, mesh.vertex_sets["zmin"]))
    np.testing.assert_allclose(supports.held[at], np.tile(np.diag([1.0, 1, 0]), (len(at), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(supports.held @ supports.held, supports.held, atol=1e-12)
    assert set(supports.partly_fixed).isdisjoint(supports.fixed) and len(supports.vertices) == len(supports.held)


CUBE = ds.TetrahedralMesh.create_cube(3).with_surface_set("round", lambda x, n: n[:, 0] > -0.5)
MISTAKES = {
    "no such set": ({"roof": "x"}, None, "no vertex set is called 'roof'"),
    "axes": ({"xmin": "xw"}, None, r"'xmin' must be fixed along axes such as \"x\" or \"xyz\".*got 'xw'"),
    "twice": ({"xmin": "xx"}, None, "must be fixed along axes"),
    "shape": ({"xmin": [1, 0]}, None, r"along directions, finite, of shape \(3,\) or \(k, 3\)"),
    "zero": ({"xmin": [0, 0, 0]}, None, "must not be zero"),
    "not flat": ({"round": "normal"}, None, "it is not flat"),
    "motion of none": (
        {"xmin": "x"},
        {"xmax": lambda t: [0, 0, 0]},
        "motion moves 'xmax', which is not fixed; fixed has xmin",
    ),
    "no names": ("xmin", {"xmin": lambda t: [0, 0, 0]}, "no sets by name"),
    "two motions": (
        {"xmin": "x", "ymin": "xy"},
        {"xmin": lambda t: [1, 0, 0]},
        "two sets move a vertex .* differently, by",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_refused(mistake):
    fixed, motion, message = MISTAKES[mistake]
    with pytest.raises(ValueError, match=message):
        ds.Scene(CUBE, ds.StableNeoHookean(1e5, 0.3), fixed=fixed, motion=motion)


REACTIONS = [
    ds.Reaction("ymin", name="bottom"),
    ds.Reaction("lid", name="moment", about=(0.1, 0.2, 0.3)),
    ds.Reaction(name="each", per_vertex=True),
]


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_reactions_of_supports_by_component(kind):
    """They have the directions of their supports, and every number by which they change."""
    scene = supported(MOTIONS["by set"], [ds.Gravity(), *loads()])
    rollout = ds.Rollout(made(kind, scene), 2, save_every=1, outputs=REACTIONS, gradients="all")
    found = rollout.forward()
    assert np.all(found["bottom"][:, [0, 2]] == 0) and np.all(found["bottom"][:, 1] != 0)
    held = np.einsum("kij,fkj->fki", scene.supports.held, found["each"])
    np.testing.assert_allclose(held, found["each"], atol=1e-12 * np.abs(held).max())
    assert ds.dot_product_test(rollout) < (1e-11 if kind.explicit else 1e-7)
    table = ds.check_gradients(
        rollout, inputs=["pressure", "traction", "youngs_modulus", "rest_positions"], verbose=False
    )
    assert all(row.relative_error < 1e-6 for row in table.rows), table


def test_reactions_balance_what_presses_and_pulls():
    """On rollers at rest: with the weight, tractions and pressures on the deformed body they add up to nothing."""
    mesh = ds.TetrahedralMesh.create_box((3, 3, 3), size=0.1).with_surface_set("top", lambda x, n: x[:, 1] > 0.0999)
    terms = [ds.Gravity(), ds.Traction((800.0, 0, 300.0), "top"), ds.Pressure(1500.0, "top")]
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(5e4, 0.3), terms=terms, fixed=dict(xmin="x", ymin="y", zmin="z"), precision="f64"
    )
    sides = [ds.Reaction(name, name=name) for name in ("xmin", "ymin", "zmin")]
    frames = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 1, outputs=sides).forward()
    x = frames.positions[-1][mesh.surface_triangles[mesh.surface_indices("top")]]
    area = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]).sum(0) / 2
    loads_on_it = (
        np.array([8.0, 0, 3.0]) - 1500.0 * area + [0, -9.81 * float(scene.inputs.values["density"]) * mesh.volume, 0]
    )
    np.testing.assert_allclose(sum(frames[name][-1] for name in ("xmin", "ymin", "zmin")), -loads_on_it, rtol=1e-7)
