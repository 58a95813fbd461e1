"""Numbers from measurements: estimates, intervals that hold as often as they say, what data do not tell, and its price."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

import diffsim_ti as ds
from diffsim_ti.accuracy.finer import rollout_on_finer
from diffsim_ti.identification.mesh_check import _finer
from diffsim_ti.identification.problem import Point, Problem
from diffsim_ti.identification.result import save_picture
from diffsim_ti.identification.search import Ended, Search, levenberg_marquardt
from diffsim_ti.identification.unknowns import EDGE, Priors

identify = partial(ds.identify, check_mesh=False)  # data are of the mesh that is fitted
MESH = ds.TetrahedralMesh.create_box([4, 2, 2], [0.6, 0.2, 0.2], pattern="five")
TRUE = dict(youngs_modulus=8e4, poissons_ratio=0.3)
NOISE = 1e-3
MARKERS = MESH.vertex_indices("xmax")


def body(steps=20, save_every=2, terms=None, **options) -> ds.Rollout:
    scene = ds.Scene(MESH, ds.StableNeoHookean(**TRUE), terms=terms or [ds.Gravity()], fixed="xmin", precision="f64")
    return ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-2, substeps=4), steps, save_every=save_every, **options)


@pytest.fixture(scope="module")
def swing():
    return body()


def tracks(exact, rng, noise=NOISE, **options):
    seen = exact.positions[:, MARKERS]
    return ds.Measurement("positions", seen + noise * rng.standard_normal(seen.shape), noise, MARKERS, **options)


START = dict(youngs_modulus=4e4, poissons_ratio=0.2)


def test_intervals_of_marker_tracks_hold_as_often_as_they_say(swing):
    exact, inside, fits = swing.forward(**TRUE), np.zeros((100, 2), bool), 0
    for seed in range(100):
        start = dict(youngs_modulus=7.6e4, poissons_ratio=0.28)
        found = identify(swing, tracks(exact, np.random.default_rng(seed)), start)
        assert found.converged
        inside[seed] = [low < TRUE[name] < high for name, (low, high) in found.intervals.items()]
        fits += found.residuals_fit
    assert inside.sum(0).min() >= 87 and 0.92 <= inside.mean() <= 0.98 and fits >= 95


def test_no_more_simulations_than_least_squares_with_differences(swing):
    data = tracks(swing.forward(**TRUE), np.random.default_rng(1))
    found, runs = identify(swing, data, START), []

    def residual(t):
        runs.append(1)
        return data.residual(swing.forward(youngs_modulus=np.exp(t[0]), poissons_ratio=t[1]), 0.0)

    theirs = least_squares(residual, [np.log(4e4), 0.2], bounds=([0, -0.9], [20, 0.49]), xtol=1e-4, ftol=1e-4)
    assert found.simulations <= len(runs)
    assert found.chi_square <= 2 * theirs.cost * (1 + 1e-3)
    assert found.estimates["poissons_ratio"] == pytest.approx(
        theirs.x[1], abs=0.1 * found.standard_errors["poissons_ratio"]
    )
    assert str(found).splitlines()[0].startswith("youngs_modulus = ") and "as the noise explains" in str(found)


def test_what_gravity_alone_does_not_tell_is_said(swing):
    data = tracks(swing.forward(**TRUE), np.random.default_rng(2))
    found = identify(swing, data, dict(youngs_modulus=7e4, density=900.0))
    assert len(found.unseen) == 1 and found.converged and "NOT SEEN" in str(found)
    assert found.unseen[0]["youngs_modulus"] == pytest.approx(found.unseen[0]["density"], abs=0.02)
    assert found.estimates["youngs_modulus"] / found.estimates["density"] == pytest.approx(80, rel=0.02)
    low, high = found.intervals["density"]
    assert low < 100 and high > 1e4
    known = identify(swing, data, dict(youngs_modulus=7e4, density=900.0), prior={"density": ds.Normal(1000.0, 0.02)})
    assert known.standard_errors["youngs_modulus"] == pytest.approx(0.02 * 8e4, rel=0.2)


@pytest.mark.parametrize("share", [1e-9, 0.3])
def test_residuals_below_the_noise_explain_the_data(swing, share):
    data = tracks(swing.forward(**TRUE), np.random.default_rng(3), noise=share * NOISE)
    found = identify(swing, ds.Measurement("positions", data.values, NOISE, MARKERS), START)
    assert found.residuals_fit and found.noise_overstated and len(found.starts) == 1
    for said in (str(found), repr(found), found.headline):
        assert "overstated" in said and "synthetic" in said and "NOT EXPL" not in said.upper()
    assert "95 % in [" in str(found)


def test_as_many_data_as_numbers_leave_nothing_to_test_by(swing):
    seen = np.full((11, MESH.num_vertices, 3), np.nan)
    seen[5, MARKERS[0], 1] = swing.forward(youngs_modulus=8e4).positions[5, MARKERS[0], 1]
    found = identify(swing, {"positions": seen}, dict(youngs_modulus=7e4), NOISE)
    assert found.degrees < 0.5 and found.residuals_fit and not found.noise_overstated and not found.headline
    assert "none left to test the fit by" in str(found)


def test_a_local_minimum_is_left_or_said_to_explain_nothing(tmp_path):
    """One late frame of a swing: periods that fit it are many."""
    rollout = body(60, 60)
    data = tracks(rollout.forward(**TRUE), np.random.default_rng(0), noise=1e-4)
    stuck = identify(rollout, data, dict(youngs_modulus=3e5), starts=1)
    assert stuck.converged and not stuck.residuals_fit and abs(stuck.estimates["youngs_modulus"] / 8e4 - 1) > 0.5
    for said in (str(stuck), repr(stuck), stuck.headline):
        assert said.startswith("THE FIT DOES NOT EXPLAIN THE DATA") and "intervals mean nothing" in said
        assert "95 % in" not in said and "starts=" in said
    save_picture(tmp_path / "fit.png", stuck, data, rollout.forward(**stuck.inputs[0]))
    for starts in (None, 4, [dict(youngs_modulus=9e4)]):
        found = identify(rollout, data, dict(youngs_modulus=3e5), starts=starts)
        assert abs(found.estimates["youngs_modulus"] - 8e4) < 3 * found.standard_errors["youngs_modulus"]
        assert found.residuals_fit and not found.headline and "starts" in str(found)
        np.testing.assert_allclose(found.starts[0]["start"], 3e5)
        assert min(row["cost"] for row in found.starts) < 0.1 * found.starts[0]["cost"]
    for starts, words in (
        (0, "number >= 1"),
        ([dict(E=1.0)], "a start is"),
        ([dict(youngs_modulus=-1.0)], "cannot be"),
    ):
        with pytest.raises(ValueError, match=words):
            identify(rollout, data, dict(youngs_modulus=3e5), starts=starts)


def test_a_long_motion_is_found_by_its_early_data_from_far_starts():
    """A search that is near a wrong minimum is set aside; what the first sixteenth of the motion says leads to the truth."""
    rollout = body(240, 4)
    data = tracks(rollout.forward(**TRUE), np.random.default_rng(0))
    for start in (3e5, 1e6):
        rows, stuck = [], identify(rollout, data, dict(youngs_modulus=start), starts=1)
        assert not stuck.residuals_fit and abs(stuck.estimates["youngs_modulus"] / 8e4 - 1) > 0.3
        found = identify(rollout, data, dict(youngs_modulus=start), callback=lambda row, frames: rows.append(row))
        assert found.residuals_fit and found.converged and found.simulations < stuck.simulations
        assert abs(found.estimates["youngs_modulus"] - 8e4) < 3 * found.standard_errors["youngs_modulus"]
        assert [row["start"] for row in rows] == sorted(row["start"] for row in rows) and rows[-1]["start"] == 1
        assert "set aside" in found.starts[0]["stopped"] and len(found.starts) == 2
    model = Problem([rollout], [[data]], dict(youngs_modulus=5e4))
    whole = model.run(np.zeros(1)).residual
    with model.until(0.25) as count:
        early = model.run(np.zeros(1))
        assert count == 16 * 3 * len(MARKERS) and np.array_equal(
            early.residual, whole * (np.arange(len(whole)) < count)
        )
        J, w = model.jacobian(early)[:, 0], np.linspace(-1, 1, len(whole))
        assert not np.any(J[count:]) and abs(J @ w - model.transposed(early, w)[0]) < 1e-9 * np.abs(J).sum()
    assert np.array_equal(model.run(np.zeros(1)).residual, whole)


def test_a_search_that_was_set_aside_goes_on_where_nothing_explains_the_data():
    """Data of two motions added up."""
    rollout = body(240, 4)
    one, other = (rollout.forward(youngs_modulus=E).positions[:, MARKERS] for E in (8e4, 4e5))
    data = ds.Measurement("positions", 0.5 * (one + other), 1e-4, MARKERS)
    found = identify(rollout, data, dict(youngs_modulus=1e5), max_iterations=12)
    assert (
        not found.residuals_fit
        and len(found.starts) > 2
        and found.starts[0]["stopped"] == "stopped after 12 iterations"
    )


def test_intervals_of_one_number_and_of_several_have_the_same_form(swing):
    x = swing.forward(**TRUE).positions
    regions = np.repeat(np.arange(3), len(MESH.tetrahedra) // 3)
    for unknown, shape in ((8e4, ()), (ds.Unknown(8e4, regions=regions), (3,))):
        found = identify(swing, {"positions": x}, {"youngs_modulus": unknown}, NOISE)
        low, high = found.intervals["youngs_modulus"]
        assert np.shape(low) == np.shape(high) == np.shape(found.estimates["youngs_modulus"]) == shape
        assert np.all((low < 8e4) & (8e4 < high))
        foreseen = ds.expected(swing, {"positions": x}, {"youngs_modulus": unknown}, NOISE)
        np.testing.assert_allclose(foreseen.intervals["youngs_modulus"], (low, high), rtol=1e-3)


COARSE = ds.TetrahedralMesh.create_box([5, 3, 3], [0.4, 0.2, 0.2], pattern="five")


def bar(mesh, terms=None, outputs=(), **options) -> ds.Rollout:
    """A clamped bar at rest under a load at its end."""
    load = [ds.Traction((0.0, -60.0, 0.0), "xmax")] if terms is None else terms
    scene = ds.Scene(mesh, ds.StableNeoHookean(8e4, 0.3), terms=load, precision="f64", **dict(fixed="xmin") | options)
    return ds.Rollout(ds.StaticSolver(scene), 1, outputs=outputs)


def test_intervals_hold_the_error_of_the_mesh():
    """Data of a mesh that is finer twice: the noise's interval never holds E, although residuals fit."""
    end = COARSE.vertex_indices("xmax")
    exact = bar(COARSE.refined().quadratic()).forward().positions[:, end]
    noise, rollout, inside = 4e-4, bar(COARSE), []  # 4 % of the largest displacement
    for seed in range(6):
        seen = exact + noise * np.random.default_rng(seed).standard_normal(exact.shape)
        found = ds.identify(rollout, ds.Measurement("positions", seen, noise, end), dict(youngs_modulus=7e4))
        low, high = found.intervals["youngs_modulus"]
        far = abs(found.estimates["youngs_modulus"] - 8e4) / found.standard_errors["youngs_modulus"]
        inside.append((far < 1.96, low < 8e4 < high))
        assert found.residuals_fit and found.mesh.matters and str(found).startswith("THE MESH MATTERS")
        assert found.mesh.simulations <= 8
    assert np.sum(inside, 0).tolist() == [0, 6]


def test_what_is_given_by_indices_is_carried_to_ten_nodes():
    """By indices as by names: supports, their motion, surfaces, reactions; forces on single vertices keep their sum."""
    end, held = COARSE.vertex_indices("xmax"), COARSE.vertex_indices("xmin")
    rows = np.flatnonzero(np.isin(COARSE.surface_triangles, end).all(1))
    both = np.union1d(end, held)
    drawn = 0.02 * np.isin(both, end)[:, None] * [[1.0, 0.0, 0.0]]
    motion = (np.array([0.0, 1.0]), np.stack([0 * drawn, drawn]))
    load = ds.ExternalForce((0.0, -0.1, 0.0), end)
    by_index = bar(COARSE, [load], ds.Reaction(held), fixed=held)
    np.testing.assert_allclose(
        rollout_on_finer(by_index, ds.TetrahedralMesh.quadratic).forward()["reaction"][1],
        [0, 0.1 * len(end), 0],
        atol=1e-6,
    )
    pairs = (
        (bar(COARSE, [ds.Traction((0, -60.0, 0), rows)], fixed=held), bar(COARSE)),
        (
            bar(COARSE, [], ds.Reaction(end), fixed=both, motion=motion),
            bar(
                COARSE,
                [],
                ds.Reaction("xmax"),
                fixed=["xmin", "xmax"],
                motion=lambda t: np.asarray(motion[1][0] + min(t, 1.0) * drawn),
            ),
        ),
    )
    for one, other in pairs:
        a, b = (rollout_on_finer(rollout, ds.TetrahedralMesh.quadratic).forward() for rollout in (one, other))
        np.testing.assert_allclose(a.positions, b.positions, atol=1e-9)
        for name in one.computed:
            np.testing.assert_allclose(a[name], b[name], atol=1e-6 * np.abs(b[name]).max())
    moved = rollout_on_finer(pairs[1][0], ds.TetrahedralMesh.quadratic).forward().displacements[1]
    sides = pairs[1][0].scene.mesh.quadratic().vertex_indices("xmax")
    np.testing.assert_allclose(moved[sides, 0], 0.02, rtol=1e-6)


def test_where_the_mesh_cannot_be_checked_it_is_said_why(swing):
    for rollout, words in (
        (bar(COARSE, outputs=ds.Reaction("xmin", per_vertex=True)), "of each vertex"),
        (bar(COARSE, outputs=ds.KineticEnergy([[0, 1]])), "by their indices"),
        (ds.Rollout(swing.solver, ds.UnequalSteps([0.01, 0.02], 8)), "unequal lengths"),
    ):
        with pytest.raises(ValueError, match=words):
            rollout_on_finer(rollout, ds.TetrahedralMesh.quadratic)
    with pytest.raises(ValueError, match="ten-node tetrahedra already"):
        _finer(SimpleNamespace(problem=SimpleNamespace(rollouts=[bar(COARSE.quadratic())])))
    data = tracks(swing.forward(**TRUE), np.random.default_rng(2))
    velocities = ds.Unknown(0.0, regions=np.zeros((MESH.num_vertices, 3), int), scale=1.0, input="initial_velocities")
    found = ds.identify(swing, data, dict(v=velocities), max_iterations=1)
    assert "cannot be had of ten-node" in found.mesh.reason and "not in the intervals: it cannot" in str(found)


def test_wrong_noise_is_noticed(swing):
    data = tracks(swing.forward(**TRUE), np.random.default_rng(3), noise=2 * NOISE)
    data = ds.Measurement("positions", data.values, NOISE, MARKERS)
    found = identify(swing, data, START)
    assert not found.residuals_fit and "NOT explained" in str(found)


@pytest.mark.parametrize("dense", [True, False])
def test_regions_missing_samples_and_two_experiments(swing, dense, monkeypatch):
    regions, E = np.repeat(np.arange(3), len(MESH.tetrahedra) // 3), np.array([5e4, 1e5, 2e5])
    other = body(terms=[ds.Gravity((0.0, 0.0, -9.8))])
    rng, data = np.random.default_rng(4), []
    if not dense:
        monkeypatch.setattr("diffsim_ti.identification.search.DENSE", 1)
    for rollout in (swing, other):
        x = rollout.forward(youngs_modulus=E[regions]).positions
        x = x + 1e-4 * rng.standard_normal(x.shape)
        x[rng.random(x.shape) < 0.3] = np.nan
        data.append({"positions": x})
    unknowns = {"youngs_modulus": ds.Unknown(8e4, regions=regions)}
    found = identify([swing, other], data, unknowns, noise=1e-4, covariance=True)
    off = (found.estimates["youngs_modulus"] - E) / found.standard_errors["youngs_modulus"]
    assert found.converged and np.abs(off).max() < 3 and found.residuals_fit
    assert found.inputs[0]["youngs_modulus"].shape == (len(MESH.tetrahedra),)


def test_a_field_with_neighbours_alike(swing):
    x = swing.forward(youngs_modulus=np.where(MESH.centroids[:, 0] > 0.3, 2e5, 5e4)).positions
    unknowns = {"youngs_modulus": ds.Unknown(1e5, regions="each")}
    x = x + 1e-4 * np.random.default_rng(5).standard_normal(x.shape)
    for edges in (False, True):
        prior = {"youngs_modulus": ds.Smooth(0.3, edges)}
        found = identify(swing, {"positions": x}, unknowns, 1e-4, prior, covariance=True)
        E, s = found.estimates["youngs_modulus"], found.standard_errors["youngs_modulus"]
        assert found.converged and np.all(np.abs(np.log(E[MESH.centroids[:, 0] < 0.2] / 5e4)) < 0.3) and np.all(s > 0)


def test_an_offset_of_time(swing):
    fine = body(60, 1)
    exact = fine.forward(**TRUE)
    start, rng = 7, np.random.default_rng(6)
    seen = exact.positions[start:51:2, MARKERS]
    data = ds.Measurement(
        "positions", seen + 1e-4 * rng.standard_normal(seen.shape), 1e-4, MARKERS, exact.times[start:51:2] - 0.033
    )
    found = identify(fine, data, {"youngs_modulus": 6e4, "time_offset": ds.Unknown(0.0, scale=0.01)})
    assert found.estimates["time_offset"] == pytest.approx(0.033, abs=3 * found.standard_errors["time_offset"])
    assert found.standard_errors["time_offset"] < 1e-3 and found.residuals_fit
    whole = ds.Measurement("positions", exact.positions[:, MARKERS], 1e-4, MARKERS, exact.times)
    for scale in (0.01, -0.01):  # which the run holds in place, but not the other
        unknowns = {"youngs_modulus": 6e4, "time_offset": ds.Unknown(0.0, scale=scale)}
        found = identify(fine, whole, unknowns, starts=1)
        assert found.estimates["youngs_modulus"] == pytest.approx(TRUE["youngs_modulus"], rel=1e-3)
        assert found.converged and "time_offset at the end of what its range, or its run" in found.stopped


def test_products_are_transposes_and_derivatives():
    points = ds.MaterialPoints([[0.5, 0.1, 0.1], [0.3, 0.05, 0.1]])
    rollout = body(8, 2, outputs=[points, ds.Reaction("xmin", name="force")])
    at = np.linspace(0.01, 0.07, 5)
    data = [
        ds.Measurement("material_points", np.zeros((5, 2, 3)), 1e-3, times=at),
        ds.Measurement("force", np.zeros(rollout.outputs["force"].shape(5)), 2.0),
        ds.Measurement("positions", np.zeros((5, 4, 3)), 1e-3, MARKERS),
    ]
    each = ds.Unknown(8e4, regions="each")
    problem = Problem(
        [rollout],
        [data],
        {"E": ds.Unknown(each.start, regions="each", input="youngs_modulus"), "poissons_ratio": 0.3}
        | {"gravity": ds.Unknown(-9.8, regions=[-1, 0, -1], scale=1.0), "time_offset": ds.Unknown(0.0, scale=0.01)},
    )
    rng = np.random.default_rng(0)
    t, d = 0.1 * rng.standard_normal((2, problem.size))
    point = problem.run(t)
    w = rng.standard_normal(len(point.residual))
    Jd = problem.product(point, d)
    assert w @ Jd == pytest.approx(problem.transposed(point, w) @ d, rel=1e-11)
    eps = 1e-5
    differences = (problem.run(t + eps * d).residual - problem.run(t - eps * d).residual) / (2 * eps)
    np.testing.assert_allclose(Jd, differences, rtol=1e-5, atol=1e-6 * np.abs(Jd).max())
    for edges in (False, True):
        prior = Priors({"E": ds.Smooth(0.1, edges), "poissons_ratio": ds.Normal(0.35, 0.1)}, problem.unknowns, MESH)
        slope = (prior.cost(t + eps * d) - prior.cost(t - eps * d)) / (4 * eps)
        assert prior.gradient(t) @ d == pytest.approx(slope, rel=1e-7)


def test_stopped_and_resumed(swing, tmp_path):
    data, path = tracks(swing.forward(**TRUE), np.random.default_rng(7)), tmp_path / "state.json"
    whole = identify(swing, data, START)
    seen = []

    def stop(row, frames):
        seen.append((row["iteration"], *row["numbers"]))
        return row["iteration"] == 2

    part = identify(swing, data, START, callback=stop, resume=path)
    assert [k for k, *_ in seen] == [0, 1, 2]
    np.testing.assert_allclose(seen[0][1:], list(START.values()), rtol=1e-12)  # the start comes first
    assert part.stopped == "stopped by the callback" and len(part.iterations) == 2
    rest = identify(swing, data, START, resume=path)
    assert rest.estimates == whole.estimates and len(rest.iterations) == len(whole.iterations)
    with pytest.raises(ValueError, match="resume: the state is of"):
        identify(swing, data, dict(youngs_modulus=1e5), resume=part.state)


def test_a_number_that_was_driven_to_its_bound_comes_back():
    """Far from E the best nu lies at a bound; near E it does not. Where the cost does fall beyond a bound, nu ends there."""
    rollout = body(steps=100, save_every=1)
    seen = {"positions": rollout.forward(**TRUE).positions}

    def found(low):
        unknowns = ds.Unknown(2.4e3, range=(1e3, 1e6)), ds.Unknown(low + 0.03, range=(low, 0.45))
        return identify(rollout, seen, dict(zip(TRUE, unknowns)), noise=1e-5, covariance=False, starts=1)

    inside, ended = found(0.2), found(0.31)
    assert inside.converged and inside.simulations < 80
    assert inside.estimates == pytest.approx(TRUE, rel=1e-6)
    assert ended.converged and ended.estimates["poissons_ratio"] == pytest.approx(0.31, abs=2e-3 * 0.14)
    assert "with poissons_ratio at the end of what its range" in str(ended) and "range" not in inside.stopped


class Linear:
    """Numbers x between 0 and 1 from data A x, which lie partly beyond what any such x explains."""

    def __init__(self, size: int, seed: int):
        rng = np.random.default_rng(seed)
        rows = size + 5
        self.A = rng.normal(size=(rows, size)) * np.geomspace(1, 0.05, size) + 1.5 * rng.normal(size=(rows, 1))
        self.data, self.size, self.simulations = self.A @ rng.uniform(-0.4, 1.4, size), size, 0
        self.labels, self.offset = [f"x{k}" for k in range(size)], rng.normal(size=size)
        self.reach = np.stack([-EDGE - self.offset, EDGE - self.offset])
        self.unknowns = [SimpleNamespace(size=size, kind="bounded", label="x")]

    def x(self, t):
        return 1 / (1 + np.exp(-t - self.offset))

    def run(self, t) -> Point:
        self.simulations += 1
        return Point(np.array(t), [], 100 * (self.A @ self.x(t) - self.data))

    def jacobian(self, point):
        return 100 * self.A * (self.x(point.t) * (1 - self.x(point.t)))

    def product(self, point, d):
        return self.jacobian(point) @ d

    def transposed(self, point, w):
        return self.jacobian(point).T @ w


@pytest.mark.parametrize("size", [3, 30])  # by columns of J, by its products
@pytest.mark.parametrize("seed", range(4))
def test_searches_of_bounded_numbers_end_where_the_cost_is_least(size, seed):
    problem, iterations = Linear(size, seed), []

    def record(*row):
        iterations.append(row)
        if len(iterations) == 300:
            raise Ended("too many")

    search = Search(problem, Priors(None, problem.unknowns, None))
    assert levenberg_marquardt(search, record, 0.03) == ("converged", True)
    box = dict(bounds=problem.reach, x_scale=1.0, xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=500)
    least = least_squares(lambda t: problem.run(t).residual, np.zeros(size).clip(*problem.reach), **box)
    assert search.cost < 1.01 * 2 * least.cost + 0.1


def test_expected_intervals_and_the_best_markers(swing):
    foreseen = ds.expected(swing, ds.Measurement("positions", np.zeros((11, 4, 3)), NOISE, MARKERS), TRUE)
    found = identify(swing, tracks(swing.forward(**TRUE), np.random.default_rng(8)), TRUE)
    for name, s in found.standard_errors.items():
        assert foreseen.standard_errors[name] == pytest.approx(s, rel=0.1)
    places = {name: MESH.vertex_indices(name) for name in ("xmin", "xmax")}
    choices = {k: ds.Measurement("positions", np.zeros((11, len(v), 3)), NOISE, v) for k, v in places.items()}
    ranked = ds.compare(swing, choices, TRUE)
    assert list(ranked) == ["xmax", "xmin"] and len(ranked["xmin"].unseen) == 2 and not ranked["xmax"].unseen
    assert ranked["xmax"].standard_errors == pytest.approx(foreseen.standard_errors)
    noise = {"positions": NOISE, "velocities": 100 * NOISE}  # of all choices, each of which takes its own
    assert len(ds.compare(swing, {"places": "positions", "speeds": "velocities"}, TRUE, noise)) == 2


def test_refusals(swing):
    data = {"positions": np.zeros((11, MESH.num_vertices, 3))}
    for arguments, expected in (
        ((data, {"stiffness": 1.0}, 1.0), "no input named 'stiffness'"),
        (({"stress": 1.0}, {"density": 1.0}, 1.0), "no output named 'stress'"),
        (({"positions": np.zeros(3)}, {"density": 1.0}, 1.0), "expected values of shape"),
        ((data, {"density": 1.0}), "need noise"),
        ((data, {"density": 1.0}, 0.0), "noise must be > 0"),
        ((data, {}, 1.0), "nothing is unknown"),
        ((data, {"density": -1.0}, 1.0), "has no logarithm; give range or scale"),
        ((data, {"youngs_modulus": ds.Unknown(1.0, regions="soft")}, 1.0), "no set of tetrahedra named 'soft'"),
        ((data, {"density": 1.0}, 1.0, {"E": ds.Normal(1.0, 1.0)}), "prior: no unknown named 'E'"),
        ((data, {"density": 1.0}, {"velocities": 1.0}), "noise is of velocities, data of positions"),
        ((data, {"density": ds.Unknown(1.0, experiments=[-1])}, 1.0), "one or more indices in 0..0, got \\[-1"),
        ((data, {"density": 1.0, "rho": ds.Unknown(2.0, input="density")}, 1.0), "density and rho are both the same"),
        (
            (data, {"time_offset": ds.Unknown(0.0, scale=1.0)}, 1.0),
            "and experiment 0 has none: give its Measurement times",
        ),
    ):
        with pytest.raises(ValueError, match=expected):
            identify(swing, *arguments)
    modes, three = ds.ModalTest(swing.scene, 3), np.zeros((3, 2, 3))
    for rollout, measurement, expected in (
        (modes, ds.Measurement("frequencies", np.ones(2), 1.0, at=[0, 2]), "one axis, of which `at` chooses nothing"),
        (modes, ds.Measurement("frequencies", np.ones(1), 1.0, times=[0.0]), "one instant, which has no times"),
        (
            swing,
            ds.Measurement("positions", np.zeros((11, 2, 3)), 1.0, [0, 999]),
            "at must be a list of indices in 0..",
        ),
        (
            swing,
            ds.Measurement("positions", three, 1.0, [0, 1], [0.0, np.nan, 0.1]),
            "must be a list of finite numbers",
        ),
        (swing, ds.Measurement("positions", three, 1.0, [0, 1], [0.0, 0.1, 9.0]), "times must lie within"),
    ):
        with pytest.raises(ValueError, match=expected):
            ds.identify(rollout, measurement, {"density": 1.0})
    with pytest.raises(ValueError, match="time_offset = -2 s, must lie within .* got -2 to 7 s: simulate longer"):
        identify(swing, measurement, {"time_offset": ds.Unknown(-2.0, scale=1.0)})
    inside, priors = ds.Unknown(1e5, range=(1e4, 1e6)), (ds.Normal(2e6, 0.1), ds.Normal(1e6, 0.1), ds.Normal(1e5, 0.0))
    for prior in priors:
        with pytest.raises(ValueError, match="lies where the unknown cannot be, or its deviation is 0"):
            identify(swing, data, {"youngs_modulus": inside}, 1.0, {"youngs_modulus": prior})
    with pytest.raises(ValueError, match="scale must be finite and not 0"):
        identify(swing, data, {"youngs_modulus": ds.Unknown(2e5, scale=0.0)}, 1.0)
    for call in (identify, ds.expected):
        with pytest.raises(ValueError, match="2 rollouts need as many data, got 3, and as many noises, got 2"):
            call([swing, swing], [data] * 3, {"density": 1.0}, 1.0)
        with pytest.raises(ValueError, match="got 2, and as many noises, got 3"):
            call([swing, swing], [data] * 2, {"density": 1.0}, [1.0, 1.0, 1.0])
    with pytest.raises(ValueError, match="must lie inside range"):
        ds.Unknown(2.0, range=(0.0, 1.0))
    with pytest.raises(ValueError, match="range must be finite"):
        ds.Unknown(1e5, range=(1e4, np.inf))


def test_the_command(tmp_path, capsys):
    from diffsim_ti.cli import main

    MESH.save(tmp_path / "body.vtu")
    rollout = ds.Rollout(ds.VelocityVerletSolver(body().scene, dt=1e-2, substeps=4), 20, save_every=2)
    x, times = rollout.forward(**TRUE).positions[:, MARKERS], rollout.times
    x = x + 1e-3 * np.random.default_rng(9).standard_normal(x.shape) * (times > 0)[:, None, None]
    rows = [f"{t},{k},{','.join(map(str, p))}" for t, frame in zip(times, x) for k, p in enumerate(frame)]
    (tmp_path / "tracks.csv").write_text("\n".join(["time,marker,x,y,z", *rows[:9], *rows[10:]]))
    command = ["identify", str(tmp_path / "body.vtu"), str(tmp_path / "tracks.csv"), "--unknown", "youngs_modulus=5e4"]
    command += ["--nu", "0.3", "--noise", "1e-3", "--fixed", "xmin", "--output", str(tmp_path / "fit.png")]
    command += ["--no-check-mesh", "--starts", "1"]
    with pytest.raises(SystemExit) as end:
        main(command)
    assert end.value.code == 0 and (tmp_path / "fit.png").stat().st_size > 10_000
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("youngs_modulus = "))
    assert float(line.split()[2]) == pytest.approx(8e4, rel=0.02) and "95 %" in line
