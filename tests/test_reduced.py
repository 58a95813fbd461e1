"""Bodies that move by few numbers: what they tend to, what they keep, contact and friction, derivatives, refusals."""

from functools import lru_cache

import numpy as np
import pytest
import taichi as ti

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.designs import Cage

SHELL = {"shell": "affine"}
KINDS = ("affine", "rigid", "functions", "fields")


def motions(kind, mesh):
    """A kind of motions, or a basis of these: of each component, or of fields; both can move and turn rigidly."""
    X = mesh.vertices - mesh.vertices.mean(0)
    if kind == "functions":
        return np.column_stack([np.ones(len(X)), X, X[:, 0] * X[:, 1] / 0.1])
    turns = [np.cross(axis, X) for axis in np.eye(3)]
    bends = 0.03 * np.random.default_rng(6).standard_normal((3, *X.shape))
    return kind if kind in ("affine", "rigid") else np.stack([*(0 * X + axis for axis in np.eye(3)), *turns, *bends])


@lru_cache
def bar():
    """A bar of six cells whose upper half is a set of tetrahedra."""
    mesh = ds.TetrahedralMesh.create_box((4, 2, 2), size=(0.3, 0.1, 0.1), pattern="five")
    far = np.flatnonzero(mesh.vertices[mesh.tetrahedra].mean(1)[:, 0] > 0.1)
    return ds.TetrahedralMesh(
        mesh.vertices, mesh.tetrahedra, vertex_sets=mesh.vertex_sets, tetrahedron_sets={"shell": far}
    )


def scene_of(reduced=SHELL, stiff=1e6, terms=None, precision="f64", **options):
    E = np.full(bar().num_tetrahedra, 1e5)
    E[bar().tetrahedron_sets["shell"]] = stiff
    terms = [ds.Gravity()] if terms is None else terms
    return ds.Scene(bar(), ds.StableNeoHookean(E, 0.3), 1000.0, terms, reduced=reduced, precision=precision, **options)


def test_a_stiff_part_tends_to_what_moves_by_twelve_numbers():
    ends = {}
    for stiff in (1e6, 1e8):
        tips = []
        for reduced in (None, SHELL):
            solver = ds.StaticSolver(scene_of(reduced, stiff, fixed="xmin"), tolerance=1e-9)
            tips.append(ds.Rollout(solver, 1, gradients=[]).forward().positions[-1, :, 1].min())
        ends[stiff] = abs(tips[1] / tips[0] - 1)
    assert ends[1e8] < 1e-3 < 10 * ends[1e8] < ends[1e6]


def test_one_body_alone_stretches_as_its_material_says():
    """All of it is affine: a pull at both ends is a uniform stretch, and E its slope."""
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), size=(0.2, 0.1, 0.1), pattern="five")
    mesh = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, vertex_sets=mesh.vertex_sets | {"all": np.arange(12)})
    pulls = [
        ds.ExternalForce(np.tile([s * 0.25, 0, 0], (4, 1)), vertices=end) for end, s in (("xmin", -1), ("xmax", 1))
    ]
    bed = ds.ElasticFoundation(
        1e5, 1e2, np.flatnonzero(np.all(mesh.vertices[mesh.surface_triangles, 0] < 1e-9, axis=1))
    )
    scene = ds.Scene(mesh, ds.LinearElastic(1e5, 0.3), terms=[*pulls, bed], reduced={"all": "affine"}, precision="f64")
    end = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-10), 1, gradients=[]).forward().positions[-1]
    assert np.ptp(end[:, 0]) / 0.2 - 1 == pytest.approx(1.0 / 0.01 / 1e5, rel=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_tumbling_keeps_momentum(kind):
    """To the tolerance of the midpoint rule, whose rotations are affine motions; fields know small ones alone."""
    omega, X = np.array([2.0, -3.0, 5.0]), bar().vertices
    spin = np.cross(omega, X - X.mean(0)) + [0.3, 0.2, 0.1]
    scene = scene_of({"shell": motions(kind, bar())}, terms=[], stiff=1e7, initial_velocities=spin)
    solver = ds.ImplicitMidpointSolver(scene, dt=5e-3, tolerance=1e-12)
    frames = ds.Rollout(solver, 60, save_every=20, gradients=[]).forward()
    m = scene.inputs.derive(scene.inputs.values).mass[:, None]
    P, L = (m * frames.velocities).sum(1), (m * np.cross(frames.positions, frames.velocities)).sum(1)
    assert np.abs(P - P[0]).max() < 1e-10 and "tied" not in scene.describe()
    assert (np.abs(L - L[0]).max() < 1e-9 * np.linalg.norm(L[0])) == (kind != "fields")
    assert np.linalg.norm(frames.positions[-1] - frames.positions[0], axis=1).max() > 0.05
    shell = np.unique(bar().tetrahedra[bar().tetrahedron_sets["shell"]])
    u = frames.displacements[-1]
    np.testing.assert_allclose(scene.reduced.of(u)[shell], u[shell], atol=1e-15)
    if kind == "rigid":
        x = frames.positions[:, shell]
        lengths = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)
        np.testing.assert_allclose(lengths, np.tile(lengths[0], (4, 1, 1)), atol=1e-15)


def test_a_body_is_less_stiff_the_more_its_cage_can_do():
    """Bernstein's polynomials hold those of lower degree, so that the work of the weight grows with them (Ritz)."""
    drops = []
    for basis in (*(Cage(bar(), shape).weights for shape in ((2, 2, 2), (3, 2, 2))), None):
        scene = scene_of(basis if basis is None else {"shell": basis}, 1e5, fixed="xmin")
        u = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-9), 1, gradients=[]).forward().displacements[-1]
        drops.append(-(scene.mass_matrix().diagonal()[1::3] * u[:, 1]).sum())
    assert 0 < drops[0] < drops[1] - 1e-9 and drops[1] == pytest.approx(drops[2], rel=1e-6)


def test_modes_ring_as_the_whole_body_does():
    """Three modes of a held bar, which nothing else moves: what starts in them stays in them (Galerkin)."""
    free = np.setdiff1d(np.arange(16), bar().vertex_sets["xmin"])
    mesh = ds.TetrahedralMesh(bar().vertices, bar().tetrahedra, vertex_sets=bar().vertex_sets | {"free": free})
    scene = ds.Scene(mesh, ds.LinearElastic(1e5, 0.3), fixed="xmin", precision="f64")
    shapes = ds.modes(scene, 3).shapes
    scene = scene.replace(initial_velocities=0.02 * shapes.sum(0))
    ends = []
    for reduced in (None, {"free": shapes}):
        scene = scene.replace(reduced=reduced)
        solvers = ds.ImplicitMidpointSolver(scene, dt=5e-3, tolerance=1e-12), ds.VelocityVerletSolver(scene, dt=5e-4)
        for solver, steps in zip(solvers, (20, 200)):
            ends.append(ds.Rollout(solver, steps, gradients=[]).forward().displacements[-1])
    for whole, few in (ends[::2], ends[1::2]):
        assert np.abs(few - whole).max() < 1e-9 * np.abs(whole).max()
    assert "'free' 3 for 36, tied to its place" in solver.scene.describe()


# ---- contact, friction, derivatives ----------------------------------------------------------------------------------


def touching(kind="affine", **options):
    """A box of few numbers comes down askew on a soft one that slides on a rough floor."""
    low = ds.TetrahedralMesh.create_box(2, size=0.1, origin=(-0.05, 0.004, -0.05))
    up = ds.TetrahedralMesh.create_box(2, size=0.08, origin=(-0.03, 0, -0.03)).rotated([1, 0.3, 0.2], 0.5)
    mesh = ds.TetrahedralMesh.joined([low, up.translated([0, 0.107 - up.bounding_box[0, 1], 0])])
    velocity = np.repeat([[0.2, 0.0, 0.0], [0.3, -1.5, 0.1]], 8, axis=0)
    floor = ds.Ground(stiffness=2e4, width=0.01, friction=0.3, friction_speed=0.3)
    contact = ds.SelfContact(2e4, 5e-3, friction=0.4, friction_speed=0.3)
    E = np.repeat([5e4, 5e6], [low.num_tetrahedra, up.num_tetrahedra])
    given = dict(reduced={"body_1": motions(kind, mesh)}, precision="f64", initial_velocities=velocity) | options
    return ds.Scene(mesh, ds.StableNeoHookean(E, 0.3), 1000.0, [contact, ds.Gravity(), floor], **given)


@pytest.mark.parametrize(
    "solver, kind",
    [
        (ds.ImplicitEulerSolver, "affine"),
        (ds.BDF2Solver, "affine"),
        (ds.ImplicitMidpointSolver, "affine"),
        *((solver, "rigid") for solver in (ds.ImplicitEulerSolver, ds.BDF2Solver, ds.ImplicitMidpointSolver)),
        (ds.ImplicitMidpointSolver, "functions"),
        (ds.BDF2Solver, "fields"),
    ],
)
def test_tangent_and_adjoint_agree_with_contact_and_friction(solver, kind):
    force = ds.SelfContactForce("body_1")
    rollout = ds.Rollout(
        solver(touching(kind), dt=2e-3, tolerance=1e-12), 4, save_every=2, gradients="all", outputs=force
    )
    assert np.abs(rollout.forward()["self_contact_force"]).max() > 1
    assert verify.dot_product_test(rollout) <= 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_gradients(kind):
    """By the rest shape with the motions of the mesh as it was made; rigid sets keep that of the run."""
    names = ["rest_positions", "self_contact_friction"]
    solver = ds.ImplicitEulerSolver(touching(kind), dt=2e-3, tolerance=1e-12)
    assert ds.check_gradients(ds.Rollout(solver, 1, gradients=names), verbose=False).passed


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_equilibria(kind):
    solver = ds.StaticSolver(scene_of({"shell": motions(kind, bar())}, fixed="xmin"), tolerance=1e-12)
    rollout = ds.Rollout(solver, 1, gradients=["youngs_modulus", "gravity", "rest_positions"])
    assert verify.dot_product_test(rollout) <= 1e-9 and ds.check_gradients(rollout, verbose=False).passed


@pytest.mark.parametrize("name", ["initial_velocities", "initial_positions", "initial_displacements"])
def test_a_start_from_a_field_is_what_the_sets_can_do(name):
    """A field's start that no affine motion follows: the frames and gradients of `forward` and `vjp`."""
    start = 0.01 * np.random.default_rng(4).standard_normal(bar().vertices.shape)
    solver = ds.ImplicitEulerSolver(scene_of(), dt=0.01)
    rollout, other = ds.Rollout(solver, 2), ds.Rollout(solver, 2)
    plain = {"initial_displacements": "initial_positions"}.get(name, name)
    frames = rollout.forward(**{plain: start + (bar().vertices if plain == "initial_positions" else 0)})
    other.field(name).from_numpy(start + (bar().vertices if name == "initial_positions" else 0))
    loss = ti.field(ti.f64, (), needs_grad=True)
    x = other.positions

    @ti.kernel
    def weigh():
        for k, i in x:
            loss[None] += x[k, i].sum() * (1 + k + i)

    with ti.ad.Tape(loss):
        other.run()
        weigh()
    assert np.abs(other.positions.to_numpy() - frames.positions).max() < 1e-14
    k, i = np.indices(frames.positions.shape[:2])
    seed = np.repeat((1.0 + k + i)[..., None], 3, 2)
    expected = rollout.vjp(frames, seed)[plain]
    assert np.abs(other.field(name).grad.to_numpy() - expected).max() < 1e-9 * np.abs(expected).max()


def test_clip_measures_what_the_sets_can_do():
    """An adjoint that no affine motion has is no reason to scale back."""
    seed = np.zeros((3, bar().num_vertices, 3))
    body = bar().tetrahedra[bar().tetrahedron_sets["shell"]]
    noise = np.random.default_rng(5).standard_normal(seed.shape[1:])
    noise[np.setdiff1d(np.arange(bar().num_vertices), body)] = 0
    solver = ds.ImplicitEulerSolver(scene_of(), dt=0.01)
    seed[1] = 1e6 * (noise - solver.scene.reduced.of(noise))
    seed[2] = noise
    plain, clipped = (ds.Rollout(solver, 2, save_every=1, **more) for more in ({}, dict(clip=1e4, health=True)))
    expected, found = (r.vjp(r.forward(), seed)["density"] for r in (plain, clipped))
    assert all(h["scaled"] == 1.0 for h in clipped.health)
    assert found == pytest.approx(expected, rel=1e-12)


def test_steps_one_by_one_and_single_precision():
    solver = ds.ImplicitEulerSolver(scene_of(fixed="xmin"), dt=5e-3)
    frames = ds.Rollout(solver, 4, gradients=[]).forward()
    simulator = ds.Simulator(solver)
    simulator.run(4)
    np.testing.assert_allclose(simulator.positions, frames.positions[-1], atol=1e-9)
    single = ds.Rollout(ds.ImplicitEulerSolver(scene_of(precision="f32", fixed="xmin"), dt=5e-3), 4, gradients=[])
    np.testing.assert_allclose(single.forward().positions[-1], frames.positions[-1], atol=1e-5)
    askew = simulator.positions + np.random.default_rng(0).normal(size=(16, 3)) * 1e-3
    simulator.set_state(askew)
    u = simulator.displacements
    np.testing.assert_allclose(scene_of().reduced.of(u), u, atol=1e-15)


@pytest.mark.parametrize("what", ["an obstacle has come", "it has grown"])
def test_a_saved_run_goes_on_with_the_same_bits_where(what):
    """Matrices of the body at rest are not those of what is there by now."""
    lift = ds.Ground(-0.011, stiffness=2e4, width=0.01, path=lambda t: [0, 3.0 * t, 0])
    scene = scene_of(terms=[lift if "obstacle" in what else ds.Growth(lambda t: 4.0 * t)], precision="f64")
    one, other = (ds.Simulator(ds.ImplicitEulerSolver(scene, dt=2e-3)) for _ in range(2))
    one.run(10)
    kept = {name: x.copy() for name, x in one.state.items()}
    one.run(2)
    other.resume(kept)
    other.run(2)
    np.testing.assert_array_equal(other.positions, one.positions)


# ---- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "reduced, options, words",
    [
        (["shell"], {}, 'must be {name of a set: "affine", "rigid" or a basis}'),
        ({"shell": "modal"}, {}, "'shell' must be 'affine' or 'rigid' or a basis, got 'modal'"),
        ({"shell": None}, {}, "or a basis, got None"),
        ({"shell": Cage}, {}, "the basis of 'shell' must be numbers"),
        ({"shell": np.ones((16, 0))}, {}, r"shape \(16, m\).* or \(m, 16, 3\).*got \(16, 0\)"),
        ({"shell": np.ones((12, 1))}, {}, "at all vertices of the mesh; got"),
        ({"shell": np.full((16, 1), np.nan)}, {}, "must be finite"),
        (
            {"shell": np.vander(np.arange(16.0), 13)},
            {},
            "of the 13 columns .* combinations of the others at its 12 vert",
        ),
        ({"shell": np.zeros((1, 16, 3))}, {}, "of the 1 columns of the basis of 'shell' 1 are"),
        ({"skin": "affine"}, {}, "no set 'skin' of tetrahedra or vertices; it has .*'shell'"),
        ({"xmax": "affine"}, {}, "the 4 vertices of 'xmax' lie in a plane"),
        (SHELL, dict(fixed="xmax"), "vertex .* of 'shell' is also in what is fixed"),
        ({"half": "affine", "shell": "affine"}, {}, "of 'shell' is also in 'half'"),
    ],
)
def test_refused(reduced, options, words):
    mesh = ds.TetrahedralMesh(
        bar().vertices,
        bar().tetrahedra,
        vertex_sets=bar().vertex_sets | {"half": np.arange(12)},
        tetrahedron_sets=bar().tetrahedron_sets,
    )
    with pytest.raises(ValueError, match=words):
        ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), reduced=reduced, **options)


@pytest.mark.parametrize("kind", ["functions", "fields"])
@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.VelocityVerletSolver])
def test_gradients_of_bases_in_explicit_steps(solver, kind):
    """Functions of all affine motions go on as an affine set does."""
    start = dict(fixed="xmin", initial_velocities=np.random.default_rng(1).standard_normal((16, 3)))
    density = 1000.0 * np.linspace(0.5, 1.5, bar().num_tetrahedra)
    scene = scene_of({"shell": motions(kind, bar())}, **start).replace(density=density)
    rollout = ds.Rollout(solver(scene, dt=1e-4), 5, gradients="all")
    assert ds.dot_product_test(rollout) < 1e-12
    frames, way = rollout.forward(), 1e-3 * np.sin(np.arange(len(density)))
    found = rollout.vjp(frames, np.cos(frames.positions))["density"] @ way
    ends = [rollout.forward(density=density + s * way).positions for s in (1, -1)]
    assert found == pytest.approx((np.sin(ends[0]).sum() - np.sin(ends[1]).sum()) / 2, rel=1e-6)
    if kind == "functions":
        X = bar().vertices
        sets = [scene_of({"shell": basis}, **start) for basis in ("affine", np.column_stack([np.ones(len(X)), X]))]
        pair = [ds.Rollout(solver(scene, dt=1e-4), 5, gradients=[]).forward().positions for scene in sets]
        np.testing.assert_allclose(pair[0], pair[1], atol=1e-13)


def test_modes_refuse():
    with pytest.raises(ValueError, match="has no modes"):
        ds.modes(scene_of(fixed="xmin"), 2)
    assert "moving by few numbers: 'shell' 12 for 36" in scene_of().describe()
