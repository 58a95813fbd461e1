"""Self-contact of meshes with parts near each other at rest: widths of their own, derivatives, and that nothing passes."""

from functools import lru_cache

import numpy as np
import pytest
from near_meshes import c_shape, shaken, slit
from pairs_alone import evaluate_pairs

import diffsim_ti as ds
from diffsim_ti import runtime, verify
from diffsim_ti.mechanics.surfaces.proximity import EDGE_EDGE, PARALLEL, VERTEX_TRIANGLE
from diffsim_ti.mesh.geometry import edges_of
from diffsim_ti.terms.obstacles.barrier import beta

LAW, STIFFNESS, WIDTH = ds.StableNeoHookean(5e4, 0.3), 2e3, 5e-3
MESHES = {"slit": slit, "c": lambda: c_shape(gap=2e-3), "shaken 0": lambda: shaken(0), "shaken 1": lambda: shaken(1)}
meshes = pytest.mark.parametrize("mesh", MESHES, ids=lambda name: name.replace(" ", "_"))
pytestmark = pytest.mark.filterwarnings("ignore:.*sliver")


def scene_of(mesh, stiffness=STIFFNESS, precision="f64", **options):
    return ds.Scene(mesh, LAW, terms=[ds.SelfContact(stiffness, WIDTH)], precision=precision, **options)


def all_pairs(mesh):
    """Corners of all pairs of a body's surface that share no vertex: (vertex-triangle, edge-edge)."""
    s, t, e = mesh.surface_vertices, mesh.surface_triangles, edges_of(mesh.surface_triangles)[0]
    vt = np.array([[i, *row] for i in s for row in t if i not in row])
    ee = np.array([[*e[a], *e[b]] for a in range(len(e)) for b in range(a) if not set(e[a]) & set(e[b])])
    return vt, ee


def energy_of_all(mesh, x, width):
    """Contact energy at positions x, pair by pair, by the formulas of the docstrings."""
    total, X = 0.0, mesh.vertices
    for kind, pairs in enumerate(all_pairs(mesh)):
        d, D = evaluate_pairs(kind, x[pairs]).distance, evaluate_pairs(kind, X[pairs]).distance
        own = np.minimum(width, D / 2)
        fade = np.ones(len(pairs))
        if kind == EDGE_EDGE:
            a, b = x[pairs[:, 1]] - x[pairs[:, 0]], x[pairs[:, 3]] - x[pairs[:, 2]]
            A, B = X[pairs[:, 1]] - X[pairs[:, 0]], X[pairs[:, 3]] - X[pairs[:, 2]]
            q = (np.cross(a, b) ** 2).sum(1) / (PARALLEL * (A**2).sum(1) * (B**2).sum(1))
            fade = np.where(q < 1, q * (2 - q), 1)
        total += STIFFNESS * width * (fade * own * beta(d / own) * (d < own)).sum()
    return total


def crossings(mesh, x):
    """Number of (edge, triangle) of the surface that pass through each other, by signed volumes."""
    t, e = mesh.surface_triangles, edges_of(mesh.surface_triangles)[0]

    def volume(a, b, c, d):
        return np.linalg.det(np.stack([b - a, c - a, d - a], -1))

    e, t = np.repeat(e, len(t), 0), np.tile(t, (len(e), 1))
    own = (e[:, :, None] == t[:, None]).any((1, 2))
    p, q, a, b, c = (x[k] for k in (*e[~own].T, *t[~own].T))
    ends = volume(p, a, b, c) * volume(q, a, b, c) < 0
    sides = np.sign([volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)])
    return int((ends & (np.abs(sides.sum(0)) == 3)).sum())


def squeezed(mesh, share, seed=0):
    """Positions in which all lies nearer in a random direction, and is shaken a little."""
    rng = np.random.default_rng(seed)
    n = np.array([1.0, 0.1, 0.05]) @ np.linalg.qr(np.eye(3) + 0.1 * rng.normal(size=(3, 3)))[0]
    n /= np.linalg.norm(n)
    x = mesh.vertices - share * np.outer(mesh.vertices @ n, n)
    return x + 1e-5 * rng.normal(size=x.shape)


@meshes
@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_no_force_at_rest(mesh, precision):
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene_of(MESHES[mesh](), precision=precision), dt=1e-3))
    workspace = simulator.workspace
    potential = workspace.potential
    potential.place(np.zeros_like(simulator.displacements))
    assert 0 < simulator.smallest_gap() < WIDTH and not potential.forces()[0].any()
    assert simulator.compute_energy().parts["contact"] == 0
    simulator.run(3)
    assert np.abs(simulator.displacements).max() <= 1e-7


@meshes
@pytest.mark.parametrize("share", [0.3, 0.8])
def test_energy_is_that_of_all_pairs(mesh, share):
    mesh = MESHES[mesh]()
    x = squeezed(mesh, share)
    assert crossings(mesh, x) == 0
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene_of(mesh, initial_positions=x), dt=1e-3))
    expected = energy_of_all(mesh, x, WIDTH)
    assert expected > 0 or share < 0.5
    assert simulator.compute_energy().parts["contact"] == pytest.approx(expected, rel=1e-9)


@meshes
def test_forces_and_products_are_derivatives(mesh):
    mesh = MESHES[mesh]()
    x = squeezed(mesh, 0.75, seed=1)
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene_of(mesh, initial_positions=x), dt=1e-3))
    workspace = simulator.workspace
    potential, pairs, a = workspace.potential, workspace.pairs, workspace.arrays
    u, rng, eps = x - mesh.vertices, np.random.default_rng(0), 1e-8
    w = 1e-2 * rng.standard_normal(u.shape)

    def at(s):
        potential.place(u + s * w)
        return pairs.energies().sum(), runtime.fetch(a.corner)[a.first_contact_corner :].copy()

    (low, before), (high, after) = at(-eps), at(eps)
    _, force = at(0.0)
    push = -(force * w[mesh.surface_vertices]).sum()
    assert abs(push) > 0 and (high - low) / (2 * eps) == pytest.approx(push, rel=1e-5)
    runtime.fill(potential.w, w[None])
    pairs.launch(pairs.multiplying(potential.u, potential.w, False))
    product = runtime.fetch(a.corner)[a.first_contact_corner :]
    np.testing.assert_allclose((after - before) / (2 * eps), product, atol=1e-4 * np.abs(product).max())
    v = 1e-2 * rng.standard_normal(u.shape)
    runtime.fill(potential.w, v[None])
    left = (product * v[mesh.surface_vertices]).sum()
    pairs.launch(pairs.multiplying(potential.u, potential.w, False))
    right = (runtime.fetch(a.corner)[a.first_contact_corner :] * w[mesh.surface_vertices]).sum()
    assert left == pytest.approx(right, rel=1e-9, abs=1e-9 * np.abs(product).max())


@lru_cache
def closing(kind, solver, dt, passes, precision="f64", speed=0.5, stiffness=STIFFNESS, **options):
    """Walls of a slit, or ends of a C, that close; they are not quite parallel, for their distance has a kink there."""
    mesh, rng = slit(gap=2e-4) if kind == "slit" else c_shape(gap=2e-3), np.random.default_rng(0)
    mesh = ds.TetrahedralMesh(mesh.vertices + 2e-5 * rng.normal(size=mesh.vertices.shape), mesh.tetrahedra)
    x, y, z = mesh.vertices.T
    v = np.zeros((mesh.num_vertices, 3))
    if kind == "slit":
        v[:, 0] = -speed * np.sign(x) * (y > 0.05 + 1e-9) * (y / 0.1)
    else:
        v[:, 1] = -speed * np.sign(y) * (x > 0)
    v += 0.02 * rng.normal(size=v.shape)
    scene = scene_of(mesh, stiffness, precision=precision, initial_velocities=v)
    return ds.Rollout(solver(scene, dt=dt, **options), passes, gradients="all")


@pytest.mark.parametrize("kind", ["slit", "c"])
@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.ImplicitEulerSolver])
def test_gradients_of_closing_parts(kind, solver):
    """By everything, width and rest shape included, which make the widths of near pairs."""
    dt, passes, options = (2e-5, 150, {}) if solver is ds.SemiImplicitSolver else (1e-3, 4, dict(tolerance=1e-12))
    rollout = closing(kind, solver, dt, passes, **options)
    frames = rollout.forward()
    loss = verify.linear_loss(rollout)
    _, *adjoints = loss(frames)
    gradients = rollout.vjp(frames, *adjoints)
    assert gradients["self_contact_stiffness"] != 0 and gradients["self_contact_width"] != 0
    rng = np.random.default_rng(0)
    for name in rollout.wanted:
        x = rollout.values[name]
        direction = rng.standard_normal(x.shape) * (np.abs(x).max() if x.ndim == 0 else 1e-3)
        slope = float((gradients[name] * direction).sum())
        central = []
        for s in (2e-5, 4e-6):
            high, low = (loss(rollout.forward(**{name: x + t * direction}))[0] for t in (s, -s))
            central.append((high - low) / (2 * s))
        assert min(abs(c - slope) for c in central) <= 3e-5 * abs(slope) + 1e-9, (name, central, slope)
    assert verify.dot_product_test(rollout) <= 1e-9


@pytest.mark.parametrize("kind", ["slit", "c"])
@pytest.mark.parametrize(
    "solver, dt",
    [
        (ds.SemiImplicitSolver, 1e-5),
        (ds.VelocityVerletSolver, 1e-5),
        (ds.ImplicitEulerSolver, 2e-3),
        (ds.BDF2Solver, 2e-3),
    ],
)
@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_nothing_passes_through(kind, solver, dt, precision):
    """Parts near at rest that are thrown at each other: no crossing by a test of its own, and they come apart again."""
    rollout = closing(kind, solver, dt, 1, precision, speed=1.0, stiffness=1e4)
    simulator = ds.Simulator(rollout.solver)
    mesh, contact = rollout.scene.mesh, 0.0
    for _ in range(10):
        simulator.run(round(4e-3 / dt))
        contact = max(contact, simulator.compute_energy().parts["contact"])
        assert crossings(mesh, simulator.positions) == 0 and simulator.smallest_gap() > 0
    assert contact > 1e-6


@pytest.mark.parametrize("share", [0.3, 0.7, 0.8, 0.9])
def test_parts_far_apart_at_rest_have_the_width_that_was_asked_for(share):
    """Ends of an open C, four widths apart at rest and bent towards each other, press when they are nearer than one."""
    mesh, opening = c_shape(gap=4 * WIDTH), 4 * WIDTH / 0.03
    x, y, z = mesh.vertices.T
    angle, radius = (np.arctan2(y, x) % (2 * np.pi)) * (1 + share * opening / (2 * np.pi - opening)), np.hypot(x, y)
    bent = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
    vt, ee = all_pairs(mesh)
    gap = min(
        evaluate_pairs(VERTEX_TRIANGLE, bent[vt]).distance.min(), evaluate_pairs(EDGE_EDGE, bent[ee]).distance.min()
    )
    assert gap == pytest.approx(4 * (1 - share) * WIDTH, rel=0.05)
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene_of(mesh, initial_positions=bent), dt=1e-3))
    energy = simulator.compute_energy().parts["contact"]
    assert (energy > 0) == (gap < WIDTH) and energy == pytest.approx(energy_of_all(mesh, bent, WIDTH), rel=1e-9)


def test_parts_that_touch_at_rest_are_refused():
    mesh = slit(gap=1e-3)
    x = np.array(mesh.vertices)
    left = np.nonzero((np.abs(x[:, 0] + 5e-4) < 1e-9) & (x[:, 1] > 0.09))[0]
    x[left, 0] += 1e-3  # onto the vertices of the other wall
    with pytest.raises(ValueError, match=r"touch at rest.*move them apart in the mesh"):
        ds.Simulator(ds.ImplicitEulerSolver(scene_of(ds.TetrahedralMesh(x, mesh.tetrahedra)), dt=1e-3))
