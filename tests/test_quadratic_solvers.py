"""Ten-node tetrahedra at rest, in implicit steps and in vibration: against scikit-fem's, closed forms, differences."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_every_adjoint import assert_transposed
from test_quadratic import curved_mesh, loaded

import diffsim_ti as ds
from diffsim_ti.inputs.consistent_mass import ConsistentMass, ElementMasses
from diffsim_ti.outputs.output import Change
from diffsim_ti.solvers.implicit.linear import Operator, conjugate_gradients
from diffsim_ti.solvers.implicit.multigrid import Multigrid

IMPLICIT = (ds.ImplicitEulerSolver, ds.ImplicitMidpointSolver, ds.BDF2Solver)
VOLUMES = pytest.mark.parametrize("volume", ["tetrahedra", "patches"])
MU, LAM = 1e5 / 2.6, 1e5 * 0.3 / (1.3 * 0.4)


def rollout_of(solver, volume="tetrahedra", precision="f64", **changes) -> ds.Rollout:
    scene = loaded(volume, precision).replace(**changes) if changes else loaded(volume, precision)
    tolerance = 1e-12 if precision == "f64" else 1e-5
    if solver is ds.StaticSolver:
        return ds.Rollout(solver(scene, tolerance=tolerance), 2, gradients="all")
    made = solver(scene, dt=2e-3, substeps=2, tolerance=tolerance)
    return ds.Rollout(made, 4, save_every=2, gradients="all")


# ---- masses -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("uniform", [True, False])
def test_element_masses_and_their_derivatives(uniform):
    mesh, rng = curved_mesh(), np.random.default_rng(0)
    link, X = ElementMasses(mesh.elements), np.array(mesh.vertices)
    density = np.array(800.0) if uniform else rng.uniform(500, 900, mesh.num_tetrahedra)
    x = density, X
    dx = rng.normal(size=density.shape), rng.normal(size=X.shape)
    (M,), (dM,) = link.value(*x), link.jvp(x, dx)
    assert np.allclose(M.sum((1, 2)), density * mesh.volumes, rtol=1e-13)
    assert np.linalg.eigvalsh(M).min() > 0
    h = 1e-6
    difference = [link.value(*(a + side * h * b for a, b in zip(x, dx)))[0] for side in (1, -1)]
    assert np.abs((difference[0] - difference[1]) / (2 * h) - dM).max() < 1e-7 * np.abs(dM).max()
    w = rng.normal(size=M.shape)
    by = link.vjp(x, (w,))
    assert sum((a * b).sum() for a, b in zip(by, dx)) == pytest.approx((w * dM).sum(), rel=1e-12)


def test_row_sums_of_masses_are_negative_at_corners():
    """-1/20 and 1/5 of an element with straight edges."""
    mesh = ds.TetrahedralMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]]).quadratic()
    (M,) = ElementMasses(mesh.elements).value(np.array(6.0), mesh.vertices)
    assert np.allclose(ConsistentMass.of(mesh, M).row_sums[:, 0], [-1 / 20] * 4 + [1 / 5] * 6, atol=1e-14)


@pytest.mark.parametrize("solver", IMPLICIT, ids=lambda s: s.__name__)
def test_free_fall_is_rigid(solver):
    scene = ds.Scene(curved_mesh(2), ds.StableNeoHookean(1e5, 0.3), terms=ds.Gravity(), precision="f64")
    moved = ds.Rollout(solver(scene, 2e-3, 2), 10).forward().displacements[-1]
    assert np.ptp(moved, axis=0).max() < 1e-14 and moved[0, 1] < -1.9e-3


@pytest.mark.parametrize("solver", [ds.ImplicitMidpointSolver, ds.VelocityVerletSolver], ids=lambda s: s.__name__)
def test_kinetic_energy_is_of_the_masses_in_use(solver):
    """v . M v / 2, consistent in implicit steps and lumped in explicit ones; of sets with all its derivatives."""
    scene = loaded()
    every = np.arange(scene.mesh.num_vertices)
    output = ds.KineticEnergy([every, every[:9], every[9:]])
    rollout = ds.Rollout(solver(scene, 2e-3, 4), 4, save_every=2, outputs=[output])
    frames, out, rng = rollout.forward(), output.settled(rollout.scene), np.random.default_rng(3)
    energies, v = frames["kinetic_energy"], frames.velocities
    mass = scene.mass_matrix()[::3, ::3].toarray()
    if solver.explicit:
        mass = np.diag(scene.inputs.derive(scene.inputs.values).mass)
    assert energies[:, 0] == pytest.approx(0.5 * np.einsum("kai,ab,kbi->k", v, mass, v), rel=1e-12)
    assert energies[:, 1] + energies[:, 2] == pytest.approx(energies[:, 0], rel=1e-12)
    changes = {name: rng.normal(size=frames.inputs[name].shape) for name in ("density", "rest_positions")}
    dv, seed = rng.normal(size=v.shape), rng.normal(size=energies.shape)
    by = out.vjp(frames, seed)
    forward = (seed * out.jvp(frames, Change(velocities=dv, inputs=changes))).sum()
    backward = (by.velocities * dv).sum() + sum((by.inputs[name] * change).sum() for name, change in changes.items())
    assert backward == pytest.approx(forward, rel=1e-10)
    moved = [out.value(replace(frames, velocities=v + side * 1e-4 * dv)) for side in (1, -1)]
    slope = out.jvp(frames, Change(velocities=dv, inputs={}))
    assert (moved[0] - moved[1]) / 2e-4 == pytest.approx(slope, rel=1e-8, abs=1e-10)


# ---- gradients ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "solver, volume",
    [*((solver, "tetrahedra") for solver in (ds.StaticSolver, *IMPLICIT)), (ds.StaticSolver, "patches")],
    ids=lambda x: getattr(x, "__name__", x),
)
def test_adjoints_are_the_transposes_of_tangents(solver, volume):
    """To the solver's tolerance, for densities and places of nodes through consistent masses too."""
    assert_transposed(rollout_of(solver, volume), 1e-8, ("drag_rate",) if solver is ds.StaticSolver else ())


BY_MASS = ("density", "rest_positions", "prescribed_motion")  # what consistent masses have to do with


@pytest.mark.parametrize(
    "solver",
    [ds.ImplicitMidpointSolver, pytest.param(ds.BDF2Solver, marks=pytest.mark.thorough)],
    ids=lambda s: s.__name__,
)
def test_gradients_are_those_of_differences(solver):
    rollout = rollout_of(solver)
    report = ds.verify.check_gradients(rollout, ds.verify.linear_loss(rollout), BY_MASS)
    assert report.passed, str(report)


@pytest.mark.parametrize("by_differences", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_gradients_where_supports_guide_and_move(by_differences):
    """Held neighbours act by inertia: rollers along directions that are no axes, moved."""
    rollout = rollout_of(ds.ImplicitMidpointSolver, fixed={"xmin": (1, 1, 0), "xmax": (0, 1, 2)})
    if by_differences:
        report = ds.verify.check_gradients(rollout, ds.verify.linear_loss(rollout), BY_MASS)
        assert report.passed, str(report)
    assert_transposed(rollout, 1e-8)


# ---- against scikit-fem ---------------------------------------------------------------------------------------------------


class Peer:
    """The same body by scikit-fem's elements and bases: StableNeoHookean, E 1e5 Pa, nu 0.3, 1000 kg/m^3."""

    def __init__(self, mesh: ds.TetrahedralMesh):
        skfem = pytest.importorskip("skfem")
        linear = mesh.linear()
        theirs = skfem.MeshTet(linear.vertices.T.copy(), linear.tetrahedra.T.copy())
        self.basis = basis = skfem.Basis(theirs, skfem.ElementTetP2(), intorder=2)
        places = basis.doflocs.T
        gaps = np.linalg.norm(places[:, None] - mesh.vertices[None], axis=2)
        self.own = gaps.argmin(1)  # our vertex of each of their unknowns
        assert gaps.min(1).max() < 1e-12 and len(np.unique(self.own)) == mesh.num_vertices
        self.n, self.nodes, self.dx = mesh.num_vertices, self.own[basis.element_dofs.T], basis.dx
        self.N = np.stack([np.broadcast_to(b[0].grad, (3, *basis.dx.shape)) for b in basis.basis]).transpose(2, 3, 0, 1)
        exact = skfem.Basis(theirs, skfem.ElementTetP2(), intorder=4)
        mass = skfem.BilinearForm(lambda u, v, w: 1000 * u * v).assemble(exact).tocoo()
        from scipy.sparse import csr_matrix

        self.mass = csr_matrix((mass.data, (self.own[mass.row], self.own[mass.col])), shape=mass.shape)

    def gradients(self, u):
        return np.einsum("eai,eqaj->eqij", u[self.nodes], self.N)

    def forces(self, u):
        F = np.eye(3) + self.gradients(u)
        J, T = np.linalg.det(F)[..., None, None], np.swapaxes(np.linalg.inv(F), 2, 3)
        P = MU * (F - T) + LAM * (J - 1) * J * T
        out = np.zeros((self.n, 3))
        np.add.at(out, self.nodes, -np.einsum("eqij,eqaj,eq->eai", P, self.N, self.dx))
        return out

    def weight(self, g):
        return np.outer(self.mass.sum(1), g)


def bar(cells=(5, 2, 2)) -> ds.TetrahedralMesh:
    return ds.TetrahedralMesh.create_box(cells, (1.0, 0.2, 0.2), "five").quadratic()


def clamped(mesh, **options) -> ds.Scene:
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, ds.Gravity(), fixed="xmin", precision="f64", **options)


def test_statics_are_scikit_fems():
    """A beam that hangs down by its length: their forces and weight balance at our equilibrium."""
    mesh = bar()
    u = ds.Rollout(ds.StaticSolver(clamped(mesh), tolerance=1e-12, load_steps=4), 1).forward().displacements[-1]
    assert u[:, 1].min() < -0.6
    peer, free = Peer(mesh), np.setdiff1d(np.arange(mesh.num_vertices), mesh.vertex_sets["xmin"])
    left = peer.forces(u) + peer.weight([0, -9.81, 0])
    assert np.abs(left[free]).max() < 1e-8 * np.abs(peer.forces(u)).max()


def test_verlet_is_scikit_fems():
    """100 steps with their forces and the same lumped masses."""
    mesh = bar((3, 2, 2))
    scene, h = clamped(mesh), 5e-4
    frames = ds.Rollout(ds.VelocityVerletSolver(scene, h), 100, save_every=100).forward()
    peer, mass = Peer(mesh), scene.inputs.derive(scene.inputs.values).mass[:, None]
    free = np.ones((mesh.num_vertices, 1))
    free[mesh.vertex_sets["xmin"]] = 0
    u, v = np.zeros((2, mesh.num_vertices, 3))
    acceleration = lambda u: free * (peer.forces(u) / mass + [0, -9.81, 0])  # noqa: E731
    a = acceleration(u)
    for _ in range(100):
        u = u + h * v + h * h / 2 * a
        a, before = acceleration(u), a
        v = v + h / 2 * (before + a)
    moved = frames.displacements[-1]
    assert np.abs(moved - u).max() < 1e-8 * np.abs(u).max()
    assert np.abs(frames.velocities[-1] - v).max() < 1e-8 * np.abs(v).max()


def test_midpoint_is_scikit_fems():
    """Each of 20 steps solves their equation, M (v' - v) = h (f((u + u') / 2) + M g)."""
    mesh, h = bar((3, 2, 2)), 5e-3
    frames = ds.Rollout(ds.ImplicitMidpointSolver(clamped(mesh), h, tolerance=1e-13), 20, save_every=1).forward()
    peer, free = Peer(mesh), np.setdiff1d(np.arange(mesh.num_vertices), mesh.vertex_sets["xmin"])
    weight = peer.weight([0, -9.81, 0])
    for k in range(20):
        (u, after), (v, faster) = frames.displacements[k : k + 2], frames.velocities[k : k + 2]
        assert np.abs(after - u - h / 2 * (v + faster)).max() < 1e-12
        left = peer.mass @ (faster - v) - h * (peer.forces((u + after) / 2) + weight)
        assert np.abs(left[free]).max() < 1e-8 * np.abs(h * weight).max()


@VOLUMES
def test_modes_are_those_of_the_matrices(volume):
    """K phi = lambda M phi for both ways to solve it, six of them rigid; plain elements have scikit-fem's M."""
    mesh = bar((4, 2, 2))
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, precision="f64", volume=volume)
    K, M = scene.stiffness_matrix(), scene.mass_matrix()
    found = ds.modes(scene, 9)
    shapes = found.shapes.reshape(9, -1)
    assert np.allclose(shapes @ (M @ shapes.T), np.eye(9), atol=1e-9)
    left = K @ shapes.T - (M @ shapes.T) * found.eigenvalues
    assert np.abs(left).max() < 1e-8 * np.abs(K @ shapes.T).max()
    assert np.abs(found.frequencies[:6]).max() < 1e-4 * found.frequencies[6]
    peer = Peer(mesh)
    assert abs(M[::3, ::3] - peer.mass).max() < 1e-12 * abs(peer.mass).max()
    u = np.random.default_rng(0).normal(size=mesh.vertices.shape)
    if volume == "tetrahedra":  # plain elements have their K, too
        there = 1e-5 * (peer.forces(-1e-5 * u) - peer.forces(1e-5 * u)).ravel() / 2e-10
        assert np.abs(K @ u.ravel() - there).max() < 1e-6 * np.abs(there).max()


def test_gradients_of_frequencies():
    """By moduli, density and places of nodes, against differences."""
    mesh, rng = curved_mesh(), np.random.default_rng(1)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, fixed="xmin", precision="f64")
    gradients = ds.modes(scene, 3).gradients([1.0, 0.5, -0.3])
    w, h = rng.normal(size=mesh.vertices.shape), 1e-6

    def loss(E=1e5, rho=1000.0, move=0.0):
        body = ds.TetrahedralMesh(mesh.vertices + move * w, mesh.elements, vertex_sets=mesh.vertex_sets)
        made = ds.Scene(body, ds.StableNeoHookean(E, 0.3), rho, fixed="xmin", precision="f64")
        return ds.modes(made, 3).frequencies @ [1.0, 0.5, -0.3]

    assert gradients["youngs_modulus"] == pytest.approx((loss(E=1e5 + 1) - loss(E=1e5 - 1)) / 2, rel=1e-7)
    assert gradients["density"] == pytest.approx((loss(rho=1000.1) - loss(rho=999.9)) / 0.2, rel=1e-7)
    by_shape = (gradients["rest_positions"] * w).sum()
    assert by_shape == pytest.approx((loss(move=h) - loss(move=-h)) / (2 * h), rel=1e-6)


# ---- known answers ------------------------------------------------------------------------------------------------------


@cache
def lame_error(nu: float, lumped: bool) -> float:
    """Of the frequency of the Lame mode of a free cube, on six cells."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import eigsh

    from diffsim_ti.study.problems import lame_mode

    mesh = ds.TetrahedralMesh.create_cube(7, 1.0, "five").quadratic()
    scene = ds.Scene(
        mesh, ds.LinearElastic(1e5, nu), 1000.0, precision="f64", volume="patches" if nu > 0.47 else "tetrahedra"
    )
    K, M = scene.stiffness_matrix(), scene.mass_matrix()
    if lumped:
        M = diags(np.repeat(scene.inputs.derive(scene.inputs.values).mass, 3)).tocsr()
    exact = np.pi * np.sqrt(1e5 / (1 + nu) / 1000)
    values, shapes = eigsh(K.tocsc(), 12, M, sigma=0.98 * exact**2, which="LM", tol=1e-9)
    mode = (M @ lame_mode(mesh.vertices).ravel()) @ shapes  # the share of the mode in each
    return abs(np.sqrt(values[np.abs(mode).argmax()]) / exact - 1)


@pytest.mark.parametrize("nu", [0.45, 0.499])
def test_lame_mode(nu):
    assert lame_error(nu, False) < 1e-3 and lame_error(nu, True) < 8e-3


@pytest.mark.parametrize("volume", ["tetrahedra", "patches"])
def test_patch_test(volume):
    """Linear displacements of the surface go on into the body, and quadratic ones where plain elements are loaded by
    their consistent body force."""
    mesh = ds.TetrahedralMesh.create_cube(3, 1.0, "five").quadratic()
    X, rng = mesh.vertices, np.random.default_rng(0)
    X = X + 0.1 * np.sin(3 * X[:, [1, 2, 0]]) * (X * (1 - X)).prod(1)[:, None]
    mesh = ds.TetrahedralMesh(X, mesh.elements).linear().quadratic()  # uneven, its edges straight
    X, surface = mesh.vertices, mesh.surface_vertices
    A, B = 0.02 * rng.normal(size=(3, 3)), 0.02 * rng.normal(size=(3, 3, 3)) * (volume == "tetrahedra")
    B = B + np.swapaxes(B, 1, 2)
    exact = X @ A.T + np.einsum("ijk,nj,nk->ni", B, X, X)
    # f = -div sigma of u_i,jk = 2 B_ijk: mu u_i,jj + (mu + lam) u_j,ji
    force = -(MU * 2 * np.einsum("ijj->i", B) + (MU + LAM) * 2 * np.einsum("jji->i", B))
    scene = ds.Scene(
        mesh,
        ds.LinearElastic(1e5, 0.3),
        terms=ds.BodyForce(force),
        fixed=surface,
        motion=lambda t: t * exact[surface],
        precision="f64",
        volume=volume,
    )
    u = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-13), 1).forward().displacements[-1]
    assert np.abs(u - exact).max() < 1e-11 * np.abs(exact).max() * 100


def test_hanging_bar_strains_are_linear():
    """A bar that hangs by its top, nu 0: e = rho g y / E at every point of two cells, by consistent weight."""
    mesh = ds.TetrahedralMesh.create_box((2, 3, 2), (0.1, 1.0, 0.1), "five").quadratic()
    scene = ds.Scene(mesh, ds.LinearElastic(1e5, 0.0), 1000.0, ds.Gravity(), fixed="ymax", precision="f64")
    u = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-13), 1).forward().displacements[-1]
    y = mesh.vertices[:, 1]
    exact = -1000 * 9.81 / 1e5 * (1 - y**2) / 2
    assert np.abs(u[:, 1] - exact).max() < 1e-10 and np.abs(u[:, [0, 2]]).max() < 1e-10


def iterations(mesh: ds.TetrahedralMesh, nu: float, volume: str) -> int:
    """Of conjugate gradients with multigrid, for the small drop of a clamped beam to 1e-6."""
    scene = ds.Scene(mesh, ds.LinearElastic(1e6, nu), fixed="xmin", precision="f64", volume=volume)
    workspace = ds.StaticSolver(scene).workspace(scene.inputs.derive(scene.inputs.values))
    potential, none = workspace.potential, np.zeros((mesh.num_vertices, 1))
    potential.place(np.zeros_like(mesh.vertices))
    multigrid = Multigrid(potential, none, workspace.free)
    multigrid.update(np.zeros_like(mesh.vertices))
    load = (none + [0, -1.0, 0]) * workspace.free
    return conjugate_gradients(Operator(potential, none, workspace.free), load, multigrid, 1e-6, 500, 1e-16)[2]


@pytest.mark.filterwarnings("ignore:.*tetrahedra lock")
@pytest.mark.parametrize("nu, volume", [(nu, volume) for nu in (0.3, 0.49) for volume in ("tetrahedra", "patches")])
def test_multigrid_takes_as_many_iterations_as_for_linear_tetrahedra(nu, volume):
    """Of about as many unknowns, within a factor of 1.5."""
    fine, coarse = (ds.TetrahedralMesh.create_box((4 * n + 1, n + 1, n + 1), (1.0, 0.25, 0.25), "five") for n in (8, 4))
    ours = iterations(coarse.quadratic(), nu, volume)
    assert ours <= 1.5 * iterations(fine, nu, volume)
