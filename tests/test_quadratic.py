"""Ten-node tetrahedra: forces of an energy, exact where fields are quadratic, gradients by all numbers, masses, steps."""

import warnings
from functools import cache

import numpy as np
import pytest
import taichi as ti
import torch
from quadratic_meshes import ring
from test_every_adjoint import assert_transposed
from test_gradients import random_mesh

import diffsim_ti as ds
from diffsim_ti.diff_simulator import rollout_frames
from diffsim_ti.inputs import StressPoints
from diffsim_ti.inputs.surface_areas import SurfaceAreas
from diffsim_ti.materials import MATERIALS
from diffsim_ti.mechanics.energy.potential import Potential
from diffsim_ti.mesh.face_points import bow
from diffsim_ti.mesh.reference_element import quadrature
from diffsim_ti.state.arrays import SceneArrays

STEPS = 4
VOLUMES = pytest.mark.parametrize("volume", ["tetrahedra", "patches"])
EXPLICIT = pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.VelocityVerletSolver], ids=lambda s: s.__name__)


@cache
def curved_mesh(cells: int = 1, seed: int = 0) -> ds.TetrahedralMesh:
    """Corners moved at random, edges bent at random."""
    straight = random_mesh(cells + 1).quadratic()
    rng, moved = np.random.default_rng(seed), straight.vertices.copy()
    middles = np.unique(straight.elements[:, 4:])
    moved[middles] += 0.02 / cells * rng.uniform(-1, 1, (len(middles), 3))
    return ds.TetrahedralMesh(moved, straight.elements, vertex_sets=straight.vertex_sets)


@cache
def loaded(volume: str = "tetrahedra", precision: str = "f64", law=ds.StableNeoHookean) -> ds.Scene:
    """A cube of six curved tetrahedra: moduli and density of each, forces per step, moving supports, a floor, a strained
    start."""
    mesh, rng = curved_mesh(), np.random.default_rng(0)
    m, shape = mesh.num_tetrahedra, mesh.vertices.shape
    terms = [
        ds.Ground(-0.15, 1e3, 0.2),
        ds.Gravity(),
        ds.Drag(2.0),
        ds.ExternalForce(50 * rng.normal(size=(STEPS, 3, 3)), [1, 5, 20]),
    ]
    return ds.Scene(
        mesh,
        law(1e5 * rng.uniform(0.7, 1.3, m), rng.uniform(0.2, 0.35, m)),
        1000 * rng.uniform(0.8, 1.2, m),
        terms,
        fixed="xmin",
        precision=precision,
        volume=volume,
        motion=lambda t: np.array([0.02 * t, 0.05 * np.sin(20 * t), 0.02 * t * t]),
        initial_positions=mesh.vertices + rng.normal(size=shape) * 0.005,
        initial_velocities=rng.normal(size=shape) * 0.2,
    )


def rollout_of(solver, volume="tetrahedra", precision="f64", **options) -> ds.Rollout:
    made = solver(loaded(volume, precision), dt=2e-3, substeps=4)
    return ds.Rollout(made, STEPS, save_every=2, gradients="all", **options)


def potential_of(scene, u) -> Potential:
    arrays = SceneArrays(scene)
    arrays.load(scene.inputs.derive(scene.inputs.values))
    out = Potential(arrays, scene.mesh.tetrahedra, False)
    out.place(u)
    return out


def free(material, volume="tetrahedra") -> ds.Scene:
    return ds.Scene(curved_mesh(), material, precision="f64", volume=volume)


@pytest.mark.parametrize(
    "material, volume",
    [*((m, "tetrahedra") for m in MATERIALS), (ds.StableNeoHookean, "patches"), (ds.Corotated, "patches")],
    ids=lambda x: getattr(x, "__name__", x),
)
def test_forces_and_stiffness_are_derivatives_of_the_energy(material, volume):
    """By differences of the energy along random ways; blocks are those of the product."""
    spelling = material.spellings[0]
    sizes = dict(youngs_modulus=1e5, poissons_ratio=0.3, mu=4e4, lam=6e4, c10=1e4, c01=5e3, bulk_modulus=1e5)
    scene, rng = free(material(**{name: sizes[name] for name in spelling}), volume), np.random.default_rng(1)
    X = scene.mesh.vertices
    u, w, h = rng.normal(size=X.shape) * 0.01, rng.normal(size=X.shape), 1e-6
    potential = potential_of(scene, u)
    forces, product, blocks = potential.forces()[0], potential.product(w), potential.blocks()
    energies, moved = [], []
    for side in (1, -1):
        potential.place(u + side * h * w)
        energies.append(potential.energy()[0])
        moved.append(potential.forces()[0])
    assert -(forces * w).sum() == pytest.approx((energies[0] - energies[1]) / (2 * h), rel=2e-8)
    difference = -(moved[0] - moved[1]) / (2 * h)
    assert np.abs(product - difference).max() < 2e-8 * np.abs(product).max()
    potential.place(u)
    for i in (0, X.shape[0] - 1):
        for d in range(3):
            unit = np.zeros_like(X)
            unit[i, d] = 1
            assert np.allclose(potential.product(unit)[i], blocks[i, :, d], atol=1e-10 * np.abs(blocks).max())


def test_a_rigid_motion_has_no_forces_and_forces_turn_with_it():
    scene, rng = free(ds.StableNeoHookean(1e5, 0.3)), np.random.default_rng(2)
    X, u = scene.mesh.vertices, 0.02 * rng.normal(size=scene.mesh.vertices.shape)
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    Q *= np.sign(np.linalg.det(Q))
    f = potential_of(scene, u).forces()[0]
    rigid = potential_of(scene, X @ Q.T - X + [1, 2, 3]).forces()[0]
    turned = potential_of(scene, (X + u) @ Q.T - X + [1, 2, 3]).forces()[0]
    size = np.abs(f).max()
    assert np.abs(rigid).max() < 1e-9 * size and np.abs(turned - f @ Q.T).max() < 1e-9 * size
    assert np.abs(f.sum(0)).max() < 1e-12 * size
    assert np.abs(np.cross(X + u, f).sum(0)).max() < 1e-12 * size


def test_a_quadratic_displacement_has_the_exact_energy_where_edges_are_straight():
    """The energy of linear elasticity is a quadratic of a linear gradient: four points are exact."""
    straight = random_mesh(3).quadratic()
    scene = ds.Scene(straight, ds.LinearElastic(1e5, 0.3), precision="f64")
    rng = np.random.default_rng(3)
    A = rng.normal(size=(3, 3, 3)) * 0.01  # u_i = A_ijk X_j X_k
    A = A + np.swapaxes(A, 1, 2)
    u = np.einsum("ijk,nj,nk->ni", A, straight.vertices, straight.vertices)
    mu, lam = 1e5 / 2.6, 1e5 * 0.3 / (1.3 * 0.4)
    xi, weights = quadrature(2)
    corners = straight.vertices[straight.tetrahedra]
    X = corners[:, :1] + np.einsum("qk,mkd->mqd", xi, corners[:, 1:] - corners[:, :1])
    H = 2 * np.einsum("ijk,mqj->mqik", A, X)
    e = 0.5 * (H + np.swapaxes(H, 2, 3))
    density = mu * (e**2).sum((2, 3)) + 0.5 * lam * np.trace(e, axis1=2, axis2=3) ** 2
    exact = (straight.volumes * (density @ weights)).sum()
    assert potential_of(scene, u).energy()[0] == pytest.approx(exact, rel=1e-12)


@EXPLICIT
@VOLUMES
def test_explicit_adjoints_are_the_transposes_of_tangents(solver, volume):
    assert_transposed(rollout_of(solver, volume), 1e-12)


@pytest.mark.parametrize(
    "parallel", [pytest.param(False, marks=pytest.mark.thorough), pytest.param(True, marks=pytest.mark.backends)]
)
def test_explicit_adjoints_in_single_precision(parallel):
    made = ds.VelocityVerletSolver(loaded(precision="f32"), dt=2e-3, substeps=4, parallel=parallel)
    assert_transposed(ds.Rollout(made, STEPS, save_every=2, gradients="all"), 2e-4)


@VOLUMES
def test_explicit_gradients_are_those_of_differences(volume):
    rollout = rollout_of(ds.VelocityVerletSolver, volume)
    report = ds.verify.check_gradients(rollout, ds.verify.linear_loss(rollout))
    assert report.passed, str(report)


def test_order_of_elements_and_numbering_of_nodes_change_nothing():
    """The same frames to round-off, whatever the numbers of vertices and elements and the first corner of each."""
    mesh, rng = curved_mesh(), np.random.default_rng(4)
    new = rng.permutation(mesh.num_vertices)  # of vertex i
    even = np.array([[0, 1, 2, 3], [1, 2, 0, 3], [2, 0, 1, 3], [1, 0, 3, 2], [3, 2, 1, 0]])
    ends = [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]
    place = {frozenset(pair): k for k, pair in enumerate(ends)}
    rows = []
    for row in mesh.elements:
        turn = even[rng.integers(len(even))]
        rows.append([*row[turn], *(row[4 + place[frozenset((turn[a], turn[b]))]] for a, b in ends)])
    vertices = np.empty_like(mesh.vertices)
    vertices[new] = mesh.vertices
    other = ds.TetrahedralMesh(vertices, new[np.array(rows)[rng.permutation(len(rows))]])
    frames = []
    for body, order in ((mesh, np.arange(len(new))), (other, new)):
        velocity = np.empty_like(mesh.vertices)
        velocity[order] = np.random.default_rng(5).normal(size=mesh.vertices.shape)
        scene = ds.Scene(
            body, ds.StableNeoHookean(1e5, 0.3), terms=ds.Gravity(), initial_velocities=velocity, precision="f64"
        )
        frames.append(ds.Rollout(ds.VelocityVerletSolver(scene, 2e-3, 4), 10).forward().positions[-1][order])
    assert np.abs(frames[0] - frames[1]).max() < 1e-12


@EXPLICIT
def test_free_fall_is_rigid(solver):
    scene = ds.Scene(curved_mesh(2), ds.StableNeoHookean(1e5, 0.3), terms=ds.Gravity(), precision="f64")
    moved = ds.Rollout(solver(scene, 2e-3, 4), 20).forward().positions[-1] - scene.mesh.vertices
    assert np.ptp(moved, axis=0).max() < 1e-14 and moved[0, 1] < -0.007


def test_masses_are_positive_and_the_whole():
    """Of curved elements too, whose volume is the integral of a cubic."""
    mesh = curved_mesh(2)
    mass = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 700.0, precision="f64").inputs
    mass = mass.derive(mass.values).mass
    xi, weights = quadrature(5)
    D = np.einsum("eai,qak->eqik", mesh.vertices[mesh.elements], mesh.reference.derivatives(xi))
    volume = (np.linalg.det(D) @ weights).sum() / 6
    assert mass.min() > 0 and mass.sum() == pytest.approx(700 * volume, rel=1e-13)
    assert mesh.volume == pytest.approx(volume, rel=1e-13)


@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.49])
@VOLUMES
def test_the_bound_of_the_step_is_safe_and_not_far_off(ratio, volume):
    for mesh in (curved_mesh(2), ds.TetrahedralMesh.create_cube(4, pattern="five").quadratic()):
        scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, ratio), precision="f64", volume=volume)
        solver = ds.VelocityVerletSolver(scene, 1e-4)
        assert 0.4 < solver.stable_dt() / solver.stable_dt(tight=True) <= 1


def test_points_of_the_host_are_those_of_the_kernels():
    scene, rng = free(ds.StableNeoHookean(1e5, 0.3)), np.random.default_rng(6)
    u = rng.normal(size=scene.mesh.vertices.shape) * 0.01
    H = StressPoints.of(scene.mesh, scene.inputs.derive(scene.inputs.values)).displacement_gradients(u)
    J = np.linalg.det(np.eye(3) + H)
    assert np.allclose(potential_of(scene, u).energy()[1], J, rtol=1e-12)


def test_fields_show_where_an_element_folds():
    """J = 1 - 0.8 x of a quadratic stretch along x is least at a corner, beyond the points of stresses."""
    cube = ds.TetrahedralMesh.create_cube(2).quadratic()
    x = cube.vertices + np.array([1, 0, 0]) * -0.4 * cube.vertices[:, :1] ** 2
    scene = ds.Scene(cube, ds.StableNeoHookean(1e5, 0.3), initial_positions=x, precision="f64")
    fields = ds.Simulator(ds.VelocityVerletSolver(scene, 1e-4)).tetrahedron_fields()
    assert fields.J.min() == pytest.approx(1 - 0.8, abs=1e-12)
    total = potential_of(scene, x - cube.vertices).energy()[0]
    assert (fields.energy_density * cube.volumes).sum() == pytest.approx(total, rel=1e-12)


# ---- contact ------------------------------------------------------------------------------------------------------------


def test_areas_of_faces_lie_at_their_middles():
    """A twentieth of a corner's share stays with it; the sides of a cube keep their area; derivatives are exact."""
    cube = ds.TetrahedralMesh.create_cube(3, 0.2, "five").quadratic()
    areas, y = SurfaceAreas(cube).value(cube.vertices)[0], cube.vertices[:, 1]
    assert areas[np.isclose(y, 0)].sum() == pytest.approx(0.04, rel=1e-12)
    corner, middle = (np.argmin(np.linalg.norm(cube.vertices - x, axis=1)) for x in ([0.1, 0, 0.1], [0.1, 0, 0.05]))
    assert areas[corner] == pytest.approx(0.05 * 0.01 / 4, rel=1e-12) and areas[middle] > 10 * areas[corner]
    mesh, rng = curved_mesh(2), np.random.default_rng(0)
    link, X, w = SurfaceAreas(mesh), np.array(mesh.vertices), rng.normal(size=mesh.num_vertices)
    dX = rng.normal(size=X.shape)
    (da,) = link.jvp((X,), (dX,))
    difference = (link.value(X + 1e-6 * dX)[0] - link.value(X - 1e-6 * dX)[0]) / 2e-6
    assert np.abs(da - difference).max() < 1e-7 * np.abs(da).max()
    assert (link.vjp((X,), (w,))[0] * dX).sum() == pytest.approx((w * da).sum(), rel=1e-12)


def test_a_slab_under_a_plate_has_even_stress():
    """To two per cent, for the middles of faces carry what an even pressure gives them."""
    box = ds.TetrahedralMesh.create_box((5, 3, 5), (1, 0.25, 1), pattern="five").quadratic()
    X, squeeze, width = box.vertices, 0.02, 0.005
    sets = dict(bottom=X[:, 1] == 0, middle=[np.argmin(np.linalg.norm(X - [0.5, 0, 0.5], axis=1))])
    sets["side"] = [np.argmin(np.linalg.norm(X - [1, 0, 0.5], axis=1))]
    mesh = ds.TetrahedralMesh(X, box.elements, vertex_sets=sets)
    barrier = dict(stiffness_per_area=5e6, width=width)
    plate = ds.HalfSpace((0, 0.25 + width, 0), (0, -1, 0), path=lambda t: np.array([0, -squeeze * t, 0]), **barrier)
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(1e5, 0.3),
        terms=plate,
        fixed={"bottom": "y", "middle": "xz", "side": "z"},
        precision="f64",
    )
    frames = ds.Rollout(ds.StaticSolver(scene, load_steps=4), 1, outputs=[ds.Stress()]).forward()
    centres = X[mesh.tetrahedra].mean(1)
    inner = (np.abs(centres[:, [0, 2]] - 0.5) < 0.3).all(1)
    sigma = frames["stress"][-1][inner, 1, 1]
    assert sigma.mean() < -6e3 and np.abs(sigma / sigma.mean() - 1).max() < 0.02


# ---- the other faces ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, dict(checkpoint_every=2)], ids=["all kept", "segments"])
def test_torch_and_tape_give_the_same_gradients(options):
    """Of a run whose states are all kept, and one that is run again in segments."""
    ours, theirs, taped = (rollout_of(ds.VelocityVerletSolver, **options) for _ in range(3))
    frames = ours.forward()
    w = np.random.default_rng(9).normal(size=frames.positions.shape)
    expected = ours.vjp(frames, w, 0 * w)
    names = ("youngs_modulus", "density", "rest_positions", "initial_velocities")
    tensors = {name: torch.tensor(ours.values[name], requires_grad=True) for name in names}
    (torch.from_numpy(w) * rollout_frames(theirs, **tensors).positions).sum().backward()
    loss, weights = ti.field(ti.f64, shape=(), needs_grad=True), ti.Vector.field(3, ti.f64, shape=w.shape[:2])
    weights.from_numpy(w)

    @ti.kernel
    def weigh(x: ti.template()):
        for f, i in weights:
            loss[None] += x[f, i].dot(weights[f, i])

    with ti.ad.Tape(loss):
        taped.run()
        weigh(taped.positions)
    for name in names:
        size = np.abs(expected[name]).max()
        np.testing.assert_allclose(tensors[name].grad, expected[name], rtol=0, atol=1e-12 * size, err_msg=name)
        np.testing.assert_allclose(taped.gradients[name], expected[name], rtol=0, atol=1e-12 * size, err_msg=name)


def test_what_self_contact_leaves_out_of_curved_faces_is_said():
    """Four triangles stand for each: an edge that is a parabola of height b leaves b / 4."""
    mesh, law = ring(1), ds.StableNeoHookean(1e5, 0.3)
    corners = mesh.surface_faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 3, 2)
    middles = mesh.vertices[mesh.surface_faces[:, 3:]] - mesh.vertices[corners].mean(2)
    height = np.linalg.norm(middles, axis=2).max()
    assert height / 4 * (1 - 1e-12) <= bow(mesh) <= height and bow(mesh.linear().quadratic()) < 1e-15
    for width, options in ((0.9 / 64, {}), (0.9 / 64, dict(friction=0.1))):  # which cuts triangles no further
        with pytest.warns(UserWarning, match="SelfContact: faces of this mesh are curved, and lie up to"):
            ds.Scene(mesh, law, terms=ds.SelfContact(stiffness=1.0, width=width * bow(mesh), **options))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ds.Scene(mesh, law, terms=ds.SelfContact(stiffness=1.0, width=1.2 * width * bow(mesh), **options))
