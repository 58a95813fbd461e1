"""Mass added where slivers limit the step: bounds hold, free fall stays, gradients are exact."""

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti import verify


def with_slivers(resolution: int = 8, close: float = 0.97, seed: int = 0) -> ds.TetrahedralMesh:
    """A cube with some inner vertices moved nearly into a face of a tetrahedron of theirs."""
    mesh = ds.TetrahedralMesh.create_cube(resolution, 1.0)
    rng, x = np.random.default_rng(seed), mesh.vertices.copy()
    inner = np.setdiff1d(np.arange(mesh.num_vertices), mesh.surface_vertices)
    for vertex in rng.choice(inner, 1, replace=False):
        around = mesh.tetrahedra[(mesh.tetrahedra == vertex).any(1)]
        own = around[rng.integers(len(around))]
        x[vertex] += close * (x[own[own != vertex]].mean(0) - x[vertex])
    return ds.TetrahedralMesh(x, mesh.tetrahedra, vertex_sets=mesh.vertex_sets)


def scene(share=0.01, mesh=None, **changes) -> ds.Scene:
    own = dict(density=1000.0, terms=[ds.Gravity()], precision="f64", mass_scaling=share)
    return ds.Scene(with_slivers() if mesh is None else mesh, ds.StableNeoHookean(1e5, 0.3), **own | changes)


def mass_of(s: ds.Scene) -> np.ndarray:
    return s.inputs.derive(s.inputs.values).mass


@pytest.mark.parametrize("volume", ["tetrahedra", "patches"])
@pytest.mark.parametrize("seed", range(3))
def test_the_step_is_longer_and_its_bound_holds(seed, volume):
    mesh = with_slivers(seed=seed)
    nu = np.random.default_rng(seed).uniform(0.2, 0.45, mesh.num_tetrahedra)
    limits = []
    for share in (None, 0.03):
        s = scene(share, mesh, volume=volume)
        s = s.replace(material=ds.StableNeoHookean(1e5, nu))
        solver = ds.VelocityVerletSolver(s, dt=1e-7)
        assert solver.stable_dt() <= solver.stable_dt(tight=True) * (1 + 1e-3)  # Lanczos stops there
        limits.append(solver.stable_dt(tight=True).dt)
    assert limits[1] > 1.5 * limits[0]


def test_no_more_is_added_than_allowed_and_where_it_is_needed():
    plain, scaled = mass_of(scene(None)), scene(0.01)
    factors = mass_of(scaled) / plain
    assert np.all(factors >= 1 - 1e-12) and (factors > 1.001).sum() < 0.5 * len(factors)
    assert 0.0099 < mass_of(scaled).sum() / plain.sum() - 1 <= 0.01 + 1e-9
    assert scaled.mass_scaling.share == pytest.approx(mass_of(scaled).sum() / plain.sum() - 1, rel=1e-9)
    assert "mass scaling: 1.000% of the mass added" in scaled.describe()
    assert 1 < scene(1e-4).mass_scaling.gain < scaled.mass_scaling.gain


@pytest.mark.parametrize("share", [1e-4, 0.01])
@pytest.mark.parametrize("seed", range(3))
def test_what_it_says_to_have_won_is_what_the_stable_step_wins(share, seed):
    mesh = with_slivers(seed=seed)
    scaled = scene(share, mesh)
    won = ds.stable_dt(scaled) / ds.stable_dt(scene(None, mesh))
    assert scaled.mass_scaling.gain == pytest.approx(won, rel=3e-3) and won > 1
    assert f"the stable step by a factor of {scaled.mass_scaling.gain:.3g}" in scaled.describe()


def test_what_is_held_takes_no_mass():
    """A sliver at the clamp does not limit the step of the others, nor does its bound."""
    mesh = with_slivers()
    sliver = mesh.tetrahedra[np.argmin(mesh.volumes)]
    s = scene(0.01, mesh, fixed=sliver)
    assert np.all(s.mass_scaling.factors[sliver] == 1) and s.mass_scaling.factors.max() > 1
    solver = ds.VelocityVerletSolver(s, dt=1e-7)
    assert solver.stable_dt() <= solver.stable_dt(tight=True) * (1 + 1e-3)
    whole = scene(0.01, mesh, fixed=np.arange(mesh.num_vertices))
    assert np.all(whole.mass_scaling.factors == 1) and whole.mass_scaling.share == 0
    assert "the stable step by a factor of 1" in whole.describe()


@pytest.mark.parametrize("share", [1e-3, 0.01])
def test_a_sliver_within_a_rigid_set_limits_nothing(share):
    """Neither is mass spent on it; what is said to be won is won."""
    mesh = with_slivers()
    sliver = mesh.tetrahedra[np.argmin(mesh.volumes)]
    part = np.flatnonzero(np.isin(mesh.tetrahedra, sliver).sum(1) >= 3)
    mesh = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, tetrahedron_sets={"part": part})
    body = np.unique(mesh.tetrahedra[part])
    inner = np.setdiff1d(body, mesh.tetrahedra[~np.isin(mesh.tetrahedra, body).all(1)])
    plain, s = (scene(amount, mesh, reduced={"part": "rigid"}) for amount in (None, share))
    assert np.all(s.mass_scaling.factors[inner] == 1) and s.mass_scaling.factors.max() > 1
    solver = ds.VelocityVerletSolver(s, dt=1e-7)
    assert solver.stable_dt() <= solver.stable_dt(tight=True) * (1 + 1e-3)
    assert s.mass_scaling.gain < scene(share, mesh).mass_scaling.gain  # which the sliver rules
    assert ds.stable_dt(s) > ds.stable_dt(plain) * (1 - 1e-3)


def test_vertices_of_no_tetrahedron_count_for_nothing():
    mesh = with_slivers()
    apart = np.concatenate([mesh.vertices, [[5.0, 5, 5], [6, 6, 6]]])
    with pytest.warns(UserWarning):
        more = ds.TetrahedralMesh(apart, mesh.tetrahedra)
    one, other = scene(0.01, mesh).mass_scaling, scene(0.01, more).mass_scaling
    np.testing.assert_array_equal(other.factors, np.append(one.factors, [1, 1]))
    assert other.share == pytest.approx(one.share, rel=1e-14)  # sums over arrays of two lengths


def test_free_fall_stays_as_it_is():
    s = scene(0.05)
    frames = ds.Rollout(ds.VelocityVerletSolver(s, dt=1e-3), 50).forward()
    fall = frames.positions[-1] - frames.positions[0]
    np.testing.assert_allclose(fall, np.broadcast_to([0, -9.81 * 0.05**2 / 2, 0], fall.shape), rtol=0, atol=1e-12)


def test_motion_is_that_of_the_body_with_steps_twice_as_long():
    """A clamped cube shaken for a swing: 3 % of mass at some vertices change it by less."""
    ends = []
    for share in (None, 0.03):
        s = scene(share, fixed="xmin")
        limit = ds.VelocityVerletSolver(s, dt=1e-7).stable_dt(tight=True).dt
        steps = int(np.ceil(0.3 / (0.8 * limit)))
        ends.append((steps, ds.Rollout(ds.VelocityVerletSolver(s, dt=0.3 / steps), steps).forward().displacements[-1]))
    (many, plain), (few, scaled) = ends
    assert few < 0.7 * many
    assert np.abs(scaled - plain).max() < 0.05 * np.abs(plain).max()


def test_gradients_by_density_and_rest_shape_are_exact():
    s = scene(0.02, with_slivers(4), fixed="xmin", terms=[ds.Gravity(), ds.Ground(-0.01, 1e3, 0.05)])
    rollout = ds.Rollout(ds.SemiImplicitSolver(s, dt=1e-3), 12, gradients="all")
    assert verify.dot_product_test(rollout) < 1e-12
    report = ds.check_gradients(rollout, verbose=False)
    assert report.passed, report


def test_implicit_steps_and_statics_add_no_mass():
    for solver, options in ((ds.BDF2Solver, dict(dt=1e-2)), (ds.StaticSolver, {})):
        plain, scaled = (
            ds.Rollout(solver(scene(share, fixed="xmin"), **options), 1).forward() for share in (None, 0.05)
        )
        assert plain.positions.tobytes() == scaled.positions.tobytes()


@pytest.mark.parametrize(
    "share, mesh, words",
    [
        (0.0, None, r"mass_scaling must lie in \(0, 0.2\], got 0.0"),
        (np.nan, None, "mass_scaling must lie in"),
        (1.0, None, "0.01 adds at most 1 %"),
        (0.01, ds.TetrahedralMesh.create_cube(2, 1.0).quadratic(), "linear tetrahedra"),
    ],
)
def test_what_is_refused(share, mesh, words):
    with pytest.raises(ValueError, match=words):
        scene(share, mesh)


@pytest.mark.parametrize("density", ["x", [1.0, 2.0], 0.0, np.nan])
def test_wrong_densities_are_refused_in_our_words(density):
    with pytest.raises(ValueError, match="density must be"):
        scene(density=density)
