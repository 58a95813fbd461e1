"""Volume averaged over patches: derivatives, invariances, exactness for constant strain, and how much less it locks."""

from functools import lru_cache

import numpy as np
import pytest
from example_files import example

import diffsim_ti as ds
from diffsim_ti.materials import MATERIALS
from diffsim_ti.mechanics.energy.assembled import assemble
from diffsim_ti.mesh.patches import SIZE, in_eights, volume_patches
from diffsim_ti.monitor import quantities
from diffsim_ti.monitor.stability import element_limit, lanczos_limit

locking = example("benchmarks/locking")

SOLVERS = (ds.SemiImplicitSolver, ds.VelocityVerletSolver, ds.ImplicitMidpointSolver, ds.StaticSolver)
every_law = pytest.mark.parametrize("law", MATERIALS, ids=lambda law: law.__name__)
pytestmark = pytest.mark.filterwarnings("ignore:.*linear tetrahedra lock")


@lru_cache(maxsize=None)
def mesh(pattern="five") -> ds.TetrahedralMesh:
    box = ds.TetrahedralMesh.create_box((4, 2, 3), (0.6, 0.2, 0.4), pattern)
    shift = 0.03 * np.random.default_rng(0).uniform(-1, 1, box.vertices.shape)
    return ds.TetrahedralMesh(box.vertices + shift, box.tetrahedra, vertex_sets=box.vertex_sets)


def moduli() -> dict:
    rng, m = np.random.default_rng(1), mesh().num_tetrahedra
    return {"E": 1e5 * (1 + rng.random(m)), "nu": 0.4 + 0.09 * rng.random(m)}


def scene(law=ds.StableNeoHookean, volume="patches", precision="f64", terms=(), **changes) -> ds.Scene:
    return ds.Scene(mesh(), law(**moduli()), 1000.0, terms, precision=precision, volume=volume, **changes)


@lru_cache(maxsize=None)
def potential(law=ds.StableNeoHookean, volume="patches", precision="f64"):
    solver = ds.ImplicitEulerSolver(scene(law, volume, precision), 1e-2)
    workspace = solver.workspace(solver.start_values())
    workspace.potential.keep = workspace  # which it belongs to
    return workspace.potential


def state(seed=2, size=0.02) -> np.ndarray:
    return size * np.random.default_rng(seed).standard_normal(mesh().vertices.shape)


# --- patches ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", ["five", "kuhn"])
def test_patches_are_compact_and_nearly_full(pattern):
    big = ds.TetrahedralMesh.create_box((9, 7, 5), (0.8, 0.6, 0.4), pattern)
    patches = volume_patches(big)
    sizes = np.bincount(patches)
    assert sizes.max() <= SIZE and sizes.min() > 0 and sizes.mean() > 7.5
    order, place = in_eights(patches)
    assert np.array_equal(order[place], np.arange(big.num_tetrahedra)) and np.array_equal(place // SIZE, patches)
    assert np.array_equal(patches[order].reshape(-1, SIZE), np.repeat(np.arange(len(sizes))[:, None], SIZE, 1))
    centroids = big.vertices[big.tetrahedra].mean(1)
    assert max(np.ptp(centroids[patches == p], axis=0).max() for p in range(len(sizes))) < 0.3  # three cells


def test_patches_neither_bridge_gaps_nor_mix_tetrahedron_sets():
    box = ds.TetrahedralMesh.create_box((3, 3, 3), 0.2)
    two = np.concatenate([box.vertices, box.vertices + [0.21, 0, 0]])
    tets = np.concatenate([box.tetrahedra, box.tetrahedra + box.num_vertices])
    soft = np.flatnonzero(two[tets].mean(1)[:, 1] > 0.1)
    patches = volume_patches(ds.TetrahedralMesh(two, tets, tetrahedron_sets={"soft": soft}))
    kinds = 2 * (np.arange(len(tets)) >= box.num_tetrahedra) + np.isin(np.arange(len(tets)), soft)
    assert all(len(set(kinds[patches == p])) == 1 for p in range(patches.max() + 1))


def test_other_kinds_of_volume_are_refused():
    with pytest.raises(ValueError, match='volume must be "tetrahedra" or, against locking, "patches", got \'nodal\''):
        scene(volume="nodal")


# --- an energy and its derivatives ------------------------------------------------------------------------------------


@every_law
def test_forces_and_products_are_derivatives_of_the_energy(law):
    """Central differences; they see errors of 1e-6 and above."""
    p, u, w, h = potential(law), state(), state(3, 1.0), 1e-6
    p.place(u + h * w)
    ahead, forces_ahead = p.energy()[0], p.forces()[0]
    p.place(u - h * w)
    behind, forces_behind = p.energy()[0], p.forces()[0]
    p.place(u)
    forces = p.forces()[0]
    assert (ahead - behind) / (2 * h) == pytest.approx(-(forces * w).sum(), rel=1e-7)
    change, product = (forces_behind - forces_ahead) / (2 * h), p.product(w)
    assert np.abs(product - change).max() < 1e-6 * np.abs(product).max()
    v = state(4, 1.0)
    assert (v * product).sum() == pytest.approx((w * p.product(v)).sum(), rel=1e-12)


def test_energy_is_that_of_its_formula():
    """E = sum V psi(F; lam = 0) + sum W lam_p / 2 theta_p^2, with F and sums from NumPy."""
    p, u, m = potential(), state(), mesh()
    p.place(u)
    D = np.swapaxes(u[m.tetrahedra[:, 1:]] - u[m.tetrahedra[:, :1]], 1, 2)
    F = np.eye(3) + D @ m.shape_gradients[:, 1:]
    J, V, patches = np.linalg.det(F), m.volumes, volume_patches(m)
    mu, lam = ds.StableNeoHookean(**moduli()).lame({"youngs_modulus": moduli()["E"], "poissons_ratio": moduli()["nu"]})
    W, mean = np.bincount(patches, V), lambda x: np.bincount(patches, V * x) / np.bincount(patches, V)
    shear = (V * mu * (((F**2).sum((1, 2)) - 3) / 2 - np.log(J))).sum()
    assert p.energy()[0] == pytest.approx(shear + (W * mean(lam) / 2 * mean(J - 1) ** 2).sum(), rel=1e-12)


@every_law
def test_constant_strain_is_as_without_patches(law):
    """Affine displacements, uniform moduli: every tetrahedron has its patch's mean. The patch test follows."""
    X = mesh().vertices
    u = X @ np.array([[0.1, 0.03, 0.0], [-0.05, -0.08, 0.1], [0.02, 0.0, 0.06]])
    found = []
    for volume in ("patches", "tetrahedra"):
        solver = ds.ImplicitEulerSolver(ds.Scene(mesh(), law(1e5, 0.49), precision="f64", volume=volume), 1e-2)
        workspace = solver.workspace(solver.start_values())
        workspace.potential.place(u)
        found.append((workspace.potential.energy()[0], *workspace.potential.forces()))
    (energy, forces, _), (plain_energy, plain_forces, sizes) = found
    assert energy == pytest.approx(plain_energy, rel=1e-12)
    assert np.abs(forces - plain_forces).max() < 1e-11 * sizes.max()


@pytest.mark.parametrize("precision, rounding", [("f64", 1e-13), ("f32", 1e-5)])
def test_rigid_motions_are_free_of_force_and_no_motion_of_net_force(precision, rounding):
    p, X = potential(precision=precision), mesh().vertices
    R, _ = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))
    p.place(X @ (R * np.linalg.det(R)).T + [0.1, 0.2, 0.3] - X)
    forces, _ = p.forces()
    p.place(state())
    moved, sizes = p.forces()
    x = X + p.held_at
    assert np.abs(forces).max() < 20 * rounding * sizes.max()  # a rotation by O(1) against strains of 10 %
    assert np.abs(moved.sum(0)).max() < rounding * sizes.sum()
    assert np.abs(np.cross(x, moved).sum(0)).max() < rounding * (sizes * np.linalg.norm(x, axis=1)).sum()


# --- solvers ----------------------------------------------------------------------------------------------------------


def rollout(solver, law=ds.SmithNeoHookean, precision="f64", **changes) -> ds.Rollout:
    """Two steps with weight, drag, moduli per tetrahedron and, with symplectic Euler, self-contact (with corners too)."""
    static = solver is ds.StaticSolver
    terms = [ds.Gravity(), ds.Drag(0.7)] + ([ds.SelfContact(1e3, 0.01)] if solver is ds.SemiImplicitSolver else [])
    if not static:
        changes |= dict(initial_positions=mesh().vertices + state(6, 0.01), initial_velocities=state(7, 0.3))
    s = scene(law, precision=precision, terms=terms, fixed="xmin", **changes)
    made = solver(s, 1e-4) if solver.explicit else solver(s, **({} if static else {"dt": 1e-2}), tolerance=1e-12)
    names = ["youngs_modulus", "poissons_ratio", "rest_positions", "density" if static else "initial_positions"]
    return ds.Rollout(made, 2, 1, gradients=names)


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: solver.__name__)
def test_gradients_of_moduli_rest_shape_and_state(solver):
    made = rollout(solver)
    report = ds.check_gradients(made, verbose=False)
    assert report.passed, str(report)
    assert ds.dot_product_test(made) < (1e-13 if solver.explicit else 1e-10)  # the latter: to the solves' tolerance


@pytest.mark.executed_ptx
@pytest.mark.parametrize(
    "law, precision, rounding",
    [(ds.StableNeoHookean, "f32", 1e-5), (ds.StVenantKirchhoff, "f64", 1e-13), (ds.MooneyRivlin, "f64", 1e-13)],
)
def test_the_reverse_sweep_is_the_transpose_of_the_tangent(law, precision, rounding):
    assert ds.dot_product_test(rollout(ds.VelocityVerletSolver, law, precision)) < rounding


def test_preconditioners_are_made_of_the_exact_matrix():
    p, n = potential(ds.SmithNeoHookean), mesh().num_vertices
    p.place(state())
    exact = np.stack([p.product(e.reshape(-1, 3)).ravel() for e in np.eye(3 * n)])
    p.place(state())
    blocks = p.blocks()
    largest = np.abs(exact).max()
    assert np.abs(assemble(p, np.zeros((n, 1)), np.ones((n, 1)))[0].toarray() - exact).max() < 1e-13 * largest
    assert (
        max(np.abs(blocks[i] - exact[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]).max() for i in range(n)) < 1e-13 * largest
    )


def test_step_limits():
    """The bound by elements is safe, and the tight step is no shorter than without patches (nu 0.4 to 0.49)."""
    tight = {}
    for volume in ("patches", "tetrahedra"):
        made = scene(volume=volume)
        solver = ds.SemiImplicitSolver(made, 1e-5)
        tight[volume] = lanczos_limit(solver.workspace(solver.start_values())).dt
        assert element_limit(made).dt <= tight[volume]
    assert tight["patches"] > tight["tetrahedra"]


def test_observed_energy_is_the_energy_of_the_forces():
    p = potential()
    p.place(state())
    workspace = p.keep
    workspace.state.u.from_numpy(p.u.to_numpy())
    assert quantities.energy(workspace).parts["elastic"] == pytest.approx(p.energy()[0], rel=1e-12)
    F_of = quantities.tetrahedron_fields(workspace).J
    D = np.swapaxes(p.held_at[mesh().tetrahedra[:, 1:]] - p.held_at[mesh().tetrahedra[:, :1]], 1, 2)
    assert np.allclose(F_of, np.linalg.det(np.eye(3) + D @ mesh().shape_gradients[:, 1:]), rtol=1e-12)


def test_without_patches_nothing_is_there():
    plain = ds.Scene(mesh(), ds.StableNeoHookean(1e5, 0.3), precision="f64")
    assert "patches" not in plain.describe() and "patches" in plain.replace(volume="patches").describe()
    assert plain.law == plain.material.law("f64") and plain.replace(volume="patches").law.base == plain.law
    solver = ds.SemiImplicitSolver(plain, 1e-5)
    assert solver.workspace(solver.start_values()).arrays.patches is None


# --- locking ----------------------------------------------------------------------------------------------------------


def test_side_by_side_with_other_elements():
    """The benchmark's small meshes: patches beat tetrahedra and nodal averages, and are what diffsim_ti computes."""
    out = locking.main(quick=True)
    assert out["agreement"] < 1e-7
    for pattern in ("five", "kuhn"):
        rows = {e: out[0.4999, pattern, e] for e in locking.ELEMENTS}
        for problem in ("beam", "cook"):
            assert rows["tetrahedra"][problem] < rows["nodal"][problem] < rows["patches"][problem] < 1
        assert rows["patches"]["step"] > rows["tetrahedra"]["step"] > rows["quadratic"]["step"]


def test_membrane_locks_several_times_less():
    """Cook's membrane, nu = 0.4999, eight cells: what is missing of the rise."""
    missing = [1 - locking.membrane(8, "five", 0.4999, e)[0] for e in ("patches", "tetrahedra")]
    assert missing[0] < 0.1 < 0.4 < missing[1]


def test_beam_of_kuhn_cells_bends():
    """A cantilever of 4 cells across, nu = 0.4999: 6 % of its drop with tetrahedra, 82 % with patches."""
    assert locking.product_drop(4, "kuhn", 0.4999, "patches") == pytest.approx(0.822, abs=1e-3)
