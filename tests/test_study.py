"""Charts and advice: what they measure is right, what they promise is kept."""

import itertools
import json
import time
import warnings
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from example_files import example

import diffsim_ti as ds
from diffsim_ti.solvers import SOLVERS
from diffsim_ti.study import PROBLEMS, Problem, chart, charts, pareto_front, problem, problems, recommend
from diffsim_ti.study.alternatives import stiff_sets
from diffsim_ti.study.elements import ElementTrials, halved_grid
from diffsim_ti.study.quantity import Quantity
from diffsim_ti.study.work_precision import Point, choose_substeps, make_rollout, reference, run

EXPLICIT = [kind for kind in SOLVERS if kind.explicit]


@lru_cache
def quick_chart(name: str):
    asked = problem(name)
    asked = replace(asked, cells=asked.cells[:1], patterns=asked.patterns[:1], levels=4)
    return chart(asked, precisions=("f64",), repeats=1)


# ---- problems ---------------------------------------------------------------------------------------------------------


def test_closed_forms_are_those_of_the_references():
    omega, decay = problems.lame(0.3).exact
    assert omega / (2 * np.pi) == pytest.approx(4.385290, rel=1e-6) and decay == 0
    assert problems.lame(0.0).exact[0] / (2 * np.pi) == pytest.approx(5.0, rel=1e-12)
    for nu, drop in ((0.0, 0.37965), (0.3, 0.38288), (0.45, 0.38450), (0.49, 0.38493)):
        assert -problems.sag(nu).exact[0] == pytest.approx(drop, rel=2e-5)


@pytest.mark.parametrize("speed, deepest", [(1.0, 3.292e-3), (2.0, 8.956e-4)])
def test_time_in_contact_is_that_of_the_equation_of_motion(speed, deepest):
    """The energy integral against the equation of motion itself, integrated by another method."""
    from scipy.integrate import solve_ivp

    def fall(t, y):
        d = max(y[0], 1e-12)
        return [y[1], 1e4 * (2 * (d - 0.01) * np.log(d / 0.01) + (d - 0.01) ** 2 / d)] if d < 0.01 else [y[1], 0.0]

    leaves = lambda t, y: y[0] - 0.01 if t > 1e-5 else -1.0  # noqa: E731
    leaves.terminal = True
    way = solve_ivp(fall, (0, 0.1), [0.01, -speed], rtol=1e-10, atol=1e-13, events=leaves)
    assert problems.time_in_contact(speed) == pytest.approx(way.t[-1], rel=1e-4)
    assert way.y[0].min() == pytest.approx(deepest, rel=2e-2)


def test_fit_finds_frequency_and_decay():
    t = np.linspace(0, 1, 17)
    omega, sigma = problems.fit_oscillation(t, np.exp(-0.7 * t) * np.cos(6.9 * t + 0.3), 6.3)
    assert (omega, sigma) == pytest.approx((6.9, 0.7), rel=1e-6)


@pytest.mark.parametrize("name", PROBLEMS)
def test_every_problem_runs_quickly_and_gets_better_with_smaller_steps(name):
    if name == "sag":
        result = chart(replace(problem(name), cells=(1, 2), patterns=("five",)), precisions=("f64",), repeats=1)
        errors = {(p.cells, p.element): p.error for p in result.points}
        assert all(errors[2, element] < 0.7 * errors[1, element] for element in ("linear", "patches"))
        assert errors[2, "patches"] < 0.9 * errors[2, "linear"]
        # the drop itself: 6 cells across give 0.928 of beam theory's (an independent code's value), 4 give 0.871
        for cells, share in ((4, 0.871),):
            scene = problem(name).scene(cells, "five", "f64")
            drop = run(problem(name), make_rollout(problem(name), scene, ds.StaticSolver, 1))[1]
            assert drop[0] / problem(name).exact[0] == pytest.approx(share, abs=2e-3)
        return
    asked = problem(name)
    cells, pattern = asked.cells[0], asked.patterns[0]
    asked = replace(asked, reference_cells=None)  # of this mesh: steps alone
    if name.startswith("lame"):  # the exact number is of the finest mesh; on one mesh steps converge to that mesh's own
        asked = replace(asked, exact=None)
    right, own_error = reference(asked, cells, pattern)
    assert own_error < 1e-2
    scene = asked.scene(cells, pattern, "f64")
    k = 4 * choose_substeps(asked, scene, ds.VelocityVerletSolver, 1)[0]
    errors = []
    for substeps in (k, 2 * k):
        numbers = run(asked, make_rollout(asked, scene, ds.VelocityVerletSolver, substeps))[1]
        errors.append(np.abs(numbers - right).max() / np.abs(right).max())
    assert errors[1] < 0.55 * errors[0] < 0.05 or errors[1] < 1e-9


# ---- charts -----------------------------------------------------------------------------------------------------------


def test_front_holds_what_nothing_beats():
    rng = np.random.default_rng(3)
    points = [Point("S", 1, "p", "linear", "f32", 1, 1.0, 1, seconds=s, error=e) for s, e in rng.uniform(size=(60, 2))]
    points.append(Point("S", 1, "p", "linear", "f32", 1, 1.0, 1, said="refused"))
    front = pareto_front(points)
    for p in points[:-1]:
        beaten = any(q.seconds <= p.seconds and q.error <= p.error and q is not p for q in points)
        assert (p in front) == (not beaten)


def test_chart_of_the_oscillator_shows_each_solvers_order():
    """Halving the step divides the error by 2 to the order, in the closed form's own problem."""
    result = quick_chart("oscillator")
    for kind in SOLVERS:
        errors = [p.error for p in result.points if p.solver == kind.__name__]
        fine = kind in EXPLICIT or kind.order == 2
        assert len(errors) >= 4 and all(np.isfinite(errors))
        if fine:  # backward Euler's first steps are too coarse to show it
            assert np.log2(errors[-2] / errors[-1]) == pytest.approx(kind.order, abs=0.35)
    assert result.front and result.time_to(1e-1) is not None and result.time_to(1e-9) is None


def test_chart_writes_picture_table_and_record(tmp_path):
    result = quick_chart("oscillator")
    names = charts.write_chart(result, tmp_path, peers={"another": [(0.1, 0.1)]})
    assert [name.rsplit(".")[-1] for name in names] == ["png", "csv", "json"]
    record = json.loads((tmp_path / "chart_oscillator.json").read_text())
    assert len(record["points"]) == len(result.points) and record["peers"]["another"] == [[0.1, 0.1]]
    assert sum(p["on_front"] for p in record["points"]) == len(result.front)
    lines = (tmp_path / "chart_oscillator.csv").read_text().splitlines()
    assert len(lines) == 1 + len(result.points) and lines[0].startswith("solver,cells,pattern")
    assert (tmp_path / "chart_oscillator.png").stat().st_size > 10_000


def test_runs_that_raise_are_shown_as_refused_and_long_ones_are_named():
    asked = replace(problem("lame"), cells=(2,), patterns=("five",), elements=("linear",))
    unstable = replace(asked, scene=lambda *a, **k: asked.scene(*a, **k).replace(density=1e3))
    result = chart(unstable, solvers=(ds.VelocityVerletSolver,), precisions=("f32",), levels=2, repeats=1, limit=1e-9)
    assert not result.points and len(result.left_out) == 2 and "would take" in result.left_out[0]
    with pytest.raises(ValueError, match="is a motion"):
        chart(asked, solvers=(ds.StaticSolver,))
    with pytest.raises(ValueError, match="no problem is called 'x'"):
        problem("x")


# ---- advice -----------------------------------------------------------------------------------------------------------


def limited_displacement(name: str) -> tuple:
    """(scene, duration, tolerance) that the advice was not made with."""
    if name == "twist":
        mesh = ds.TetrahedralMesh.create_box((3, 3, 5), (0.1, 0.1, 0.3), "five")
        turn = np.cross(mesh.vertices - [0.05, 0.05, 0], [0, 0, 1.0]) * mesh.vertices[:, 2:] * 20
        law = ds.StableNeoHookean(5e4, 0.25)  # law and terms are those of other scenes of this file: the same kernels
        return ds.Scene(mesh, law, 900.0, ds.Gravity(), fixed="zmin", initial_velocities=turn), 0.15, 1e-2
    if name == "pull":  # slow, with a part so stiff that explicit steps take 4 us
        mesh = ds.TetrahedralMesh.create_box((4, 2, 2), (0.3, 0.1, 0.1), "five")
        law = ds.StableNeoHookean(np.where(mesh.centroids[:, 0] > 0.2, 1e11, 1e5), 0.3)
        return ds.Scene(mesh, law, 1000.0, fixed="xmin", motion=([0, 2.0], [[0, 0, 0], [0, 0.1, 0]])), 2.0, 1e-1
    mesh = ds.TetrahedralMesh.create_cube(3, 0.2).translated((0, 0.012, 0))
    floor = ds.Ground(width=0.01, stiffness=500.0)
    return ds.Scene(mesh, ds.Corotated(3e4, 0.3), 800.0, [ds.Gravity(), ds.Drag(2.0), floor]), 0.1, 2e-2


@lru_cache
def advised(name: str, gradients: bool = False):
    scene, duration, tolerance = limited_displacement(name)
    return recommend(
        scene, duration, tolerance, gradients=gradients, budget=8.0 if name == "pull" else 3.0, elements=False
    )


def moved(scene, kind, precision, duration, substeps) -> np.ndarray:
    """Displacements from the start at eight times, shape (9, num_vertices, 3) [m]."""
    rollout = ds.Rollout(kind(scene.replace(precision=precision), dt=duration / 8, substeps=substeps), 8, save_every=1)
    return from_start(rollout)


def from_start(rollout) -> np.ndarray:
    u = rollout.forward().displacements.astype(np.float64)
    return u - u[0]


def relative(motion, right) -> float:
    return np.linalg.norm(motion - right, axis=-1).max() / np.linalg.norm(right, axis=-1).max()


@pytest.mark.thorough
def test_advice_is_implicit_where_explicit_steps_are_tiny():
    """Against explicit steps at their limit: as right as promised, and the explicit run takes longer."""
    (scene, duration, tolerance), advice = limited_displacement("pull"), advised("pull")
    assert not advice.solver.explicit and advice.steps < 1000
    stable = ds.VelocityVerletSolver(scene, dt=1.0, allow_unstable=True).stable_dt(tight=True).dt
    rollout = ds.Rollout(
        ds.VelocityVerletSolver(scene, dt=duration / 8, substeps=int(duration / 8 / stable / 0.8)), 8, 1
    )
    begin = time.perf_counter()
    right = from_start(rollout)
    explicit, own = time.perf_counter() - begin, advice.rollout(scene, 8)
    own.forward()  # compiles
    begin = time.perf_counter()
    assert relative(from_start(own), right) <= tolerance
    assert time.perf_counter() - begin < explicit


@pytest.mark.parametrize("name", ["twist", "drop"])
def test_advice_keeps_its_promise(name):
    """Error below the tolerance against an independent converged run: another solver, eight times finer."""
    (scene, duration, tolerance), advice = limited_displacement(name), advised(name)
    fine = 8 * -(-advice.steps // 8)
    coarse, fine = (moved(scene, ds.SemiImplicitSolver, "f64", duration, k) for k in (fine, 2 * fine))
    assert relative(from_start(advice.rollout(scene, 8)), 2 * fine - coarse) <= tolerance
    assert advice.error <= tolerance and len(advice.reasons) == 3 and advice.left_out
    assert all(word in str(advice) for word in (advice.solver.__name__, "expect:", "left out:"))


@pytest.mark.parametrize("name", ["twist", "drop"])
def test_advice_overlooks_nothing_twice_as_cheap(name):
    """Every explicit solver, precision and step of a ladder: none that meets the tolerance takes half the time."""
    (scene, duration, tolerance), advice = limited_displacement(name), advised(name)
    own = -(-advice.steps // 8)
    right = moved(scene, ds.VelocityVerletSolver, "f64", duration, 16 * own)
    rollouts = {"advised": advice.rollout(scene, 8)}
    for kind, precision, k in itertools.product(SOLVERS, ("f32", "f64"), (own // 4, own // 2, own, 2 * own)):
        if k and (kind.explicit or (precision, k) == ("f64", own // 4)):  # finer implicit steps only take longer
            try:
                rollout = ds.Rollout(kind(scene.replace(precision=precision), dt=duration / 8, substeps=k), 8, 1)
                error = relative(from_start(rollout), right)
            except (ValueError, FloatingPointError):
                continue
            if error <= tolerance:
                rollouts[kind.__name__, precision, k] = rollout
    best = dict.fromkeys(rollouts, np.inf)
    for repeat in range(40):
        for key, rollout in rollouts.items():
            begin = time.perf_counter()
            rollout.forward()
            best[key] = min(best[key], time.perf_counter() - begin)
        if repeat > 4 and best["advised"] <= 2 * min(best.values()):
            return  # the machine may be busy at any one moment, not at all of them
    raise AssertionError(best)


def test_advice_states_memory_and_keeps_to_it():
    scene, duration, tolerance = limited_displacement("drop")
    advice = recommend(scene, duration, tolerance, memory=0.05, budget=2.0, elements=False)
    rollout = advice.rollout(scene, 4)
    assert 0 < advice.megabytes <= 0.05 and rollout.memory <= 0.05
    frames = rollout.forward()
    assert np.isfinite(rollout.vjp(frames, frames.positions)["youngs_modulus"])
    assert "contact: none" not in str(advice) and "damping: none" not in str(advice)


@pytest.mark.parametrize(
    "bulk_modulus, says", [(5e5, 'volume="patches" of a Scene is advised'), (2e4, "is at most 0.45")]
)
def test_advice_names_patches_where_tetrahedra_lock(bulk_modulus, says):
    """Whatever numbers the law is given by: mu is 10 kPa, so that nu is 0.49 or 0.29."""
    law = ds.MooneyRivlin(c10=4e3, c01=1e3, bulk_modulus=bulk_modulus)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of locking
        scene = ds.Scene(ds.TetrahedralMesh.create_cube(2, 0.1), law, 1000.0, [ds.Gravity()], fixed="ymin")
    advice = recommend(scene, 0.01, 0.05, gradients=False, budget=1.0, elements=False)
    assert says in " ".join(advice.left_out)


@pytest.mark.parametrize(
    "wrong, says",
    [
        (dict(duration=-1.0), "if not 0 for an equilibrium"),
        (dict(duration=None), "duration"),
        (dict(frames=0), "frames must be a whole number >= 1"),
        (dict(budget=-1.0), "budget must be > 0"),
        (dict(weights=1.0), "pass output="),
        (dict(output="end"), "output must be an output"),
        (dict(tolerance=2.0), "tolerance"),
        (dict(memory=-1.0), "memory"),
    ],
)
def test_advice_refuses_what_is_no_question(wrong, says):
    scene, duration, tolerance = limited_displacement("drop")
    with pytest.raises(ValueError, match=says):
        recommend(scene, **dict(duration=duration, tolerance=tolerance) | wrong)


def test_advice_for_a_body_that_stays_where_it_is():
    scene = ds.Scene(ds.TetrahedralMesh.create_cube(2, 0.1), ds.StableNeoHookean(1e5, 0.3), fixed="ymin")
    assert recommend(scene, 0.01, gradients=False, budget=1.0, elements=False).error == 0


def test_own_scene_is_charted_against_its_own_converged_motion():
    scene, duration, _ = limited_displacement("twist")
    result = chart(
        Problem.of_scene(scene, duration, frames=4), solvers=EXPLICIT, precisions=("f32",), levels=2, repeats=1
    )
    assert result.reference_error < 1e-3 and all(np.isfinite(p.error) for p in result.points)
    verlet = [p.error for p in result.points if p.solver == "VelocityVerletSolver"]
    assert verlet[1] < 0.4 * verlet[0]


def test_gradients_of_an_own_scene_are_charted_too():
    scene, duration, _ = limited_displacement("twist")
    asked = Problem.of_scene(scene, duration, "twist", frames=4, gradient="youngs_modulus")
    result = chart(asked, solvers=(ds.VelocityVerletSolver,), precisions=("f64",), levels=3, repeats=1)
    errors = [p.error for p in result.points]
    assert result.reference_error < 1e-2 and errors[2] < 0.6 * errors[0] < 0.5
    with pytest.raises(ValueError, match="no input named 'youngs'"):
        Problem.of_scene(scene, duration, gradient="youngs")


def test_advice_compares_elements_of_the_mesh():
    """A slender beam bends: linear tetrahedra are far off, ten-node ones keep to the tolerance, held by a name or by
    indices alike."""
    mesh = ds.TetrahedralMesh.create_box((6, 2, 2), (1, 0.2, 0.2), "five")
    start = mesh.vertices + 0.02 * mesh.vertices[:, [1, 0, 2]] * [0, 1, 0]
    names = []
    for fixed in ("xmin", mesh.vertex_sets["xmin"]):
        scene = ds.Scene(
            mesh, ds.StableNeoHookean(1e6, 0.3), 1000.0, ds.Gravity(), fixed=fixed, initial_positions=start
        )
        advice = recommend(scene, 0.2, 0.05, gradients=False, budget=20.0)
        error = {trial.element: trial.error for trial in advice.elements}
        assert error["linear"] > 0.1 and error["patches"] > 0.1 and np.nan_to_num(error["quadratic"]) < 0.03
        names.append(advice.element)
        assert "elements: " in str(advice) and "linear error" in str(advice)
    assert all(name.startswith("quadratic") for name in names)


def test_advice_on_a_number_is_by_its_error_bar_where_it_has_one():
    """A thick plate's equilibrium: the bar of ten nodes against the closed form."""
    rollout, _, down, exact = example("benchmarks/error_bars").thick_plate(2, 2)
    scene, middle = rollout.scene, ds.MaterialPoints([[5.0, 5.0, 0.5]], name="middle")
    (trial,) = ElementTrials(scene, 0.0, 1, 1e6, None, Quantity(middle, down))._by_bars({"quadratic": scene})
    y = rollout.forward()["middle"][:, 0, 2]
    assert trial.bar and trial.error == pytest.approx(abs((y[-1] - exact) / (exact - y[0])), rel=0.1)
    each = ElementTrials(scene, 0.0, 1, 1e6, None, Quantity(ds.Stress(at="vertices"), np.ones((3, 3))))
    assert not each._by_bars({"quadratic": scene}) and "runs of the finest elements were" in each.notes[0]
    advice = recommend(scene, 0.0, 0.4, gradients=False, output=middle, weights=down, elements=False)
    assert advice.solver is ds.StaticSolver and advice.error < 1e-3 and "of the change of middle" in str(advice)
    assert advice.rollout(scene, outputs=middle).forward()["middle"][-1, 0, 2] == pytest.approx(y[-1], rel=1e-5)


def test_ten_nodes_are_tried_on_half_the_cells():
    mesh = ds.TetrahedralMesh.create_box((5, 3, 3), (1, 0.2, 0.2), "five").translated([0.1, 0, 0])
    half = halved_grid(mesh)
    assert half.num_vertices == 3 * 2 * 2 and half.volume == pytest.approx(mesh.volume, rel=1e-14)
    assert len(half.vertex_sets["xmin"]) == 4 and len(half.surface_sets["ymax"]) == 4
    turned = ds.TetrahedralMesh(mesh.vertices[:, [1, 0, 2]] * [-1, 1, 1], mesh.tetrahedra)
    assert halved_grid(turned) is None is halved_grid(ds.TetrahedralMesh.create_box((4, 2, 2)))
    start = mesh.vertices + 0.02 * mesh.vertices[:, [1, 0, 2]] * [0, 1, 0]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.3), terms=ds.Gravity(), fixed="xmin", initial_positions=start)
    trials = ElementTrials(scene, 0.1, 2, 1e-3)
    found = {trial.element: trial for trial in trials.run()}
    own, coarse = (found[name] for name in ("linear", "quadratic, coarser mesh"))
    assert coarse.error < 0.5 * own.error and not trials.notes
    held = ElementTrials(scene.replace(fixed=mesh.vertex_sets["xmin"]), 0.1, 2, 1e-3)
    by_index = ElementTrials(scene.replace(terms=[ds.ExternalForce((0.0, 1.0, 0.0), [3])]), 0.1, 2, 1e-3)
    assert not by_index.on_coarser_mesh() and "by their indices: name them as a set" in by_index.notes[0]
    made = held.on_coarser_mesh()["quadratic, coarser mesh"]
    assert set(made.fixed) == set(made.mesh.vertex_sets["xmin"]) and not held.notes


def test_a_refined_mesh_is_the_same_body():
    mesh = ds.TetrahedralMesh.create_cube(3).with_tetrahedron_set("some", [1, 5])
    finer = mesh.refined()
    assert finer.num_tetrahedra == 8 * mesh.num_tetrahedra and finer.volume == pytest.approx(mesh.volume, rel=1e-14)
    some = finer.volumes[finer.tetrahedron_sets["some"]].sum()
    assert some == pytest.approx(mesh.volumes[[1, 5]].sum(), rel=1e-14)
    for name, rows in finer.surface_sets.items():
        assert set(finer.vertex_sets[name]) == set(finer.surface_triangles[rows].ravel())


def test_advice_takes_a_scene_of_ten_nodes_as_it_is():
    mesh = ds.TetrahedralMesh.create_box((4, 2, 2), (0.3, 0.1, 0.1), "five").quadratic()
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=ds.Gravity(), fixed="xmin")
    advice = recommend(scene, 0.02, 0.05, gradients=False, budget=1.0)
    assert advice.element == "quadratic" and not advice.elements
    assert "elements were not compared: the mesh has ten nodes already" in str(advice)


def test_advice_offers_mass_scaling_and_steps_where_they_are_needed():
    box = ds.TetrahedralMesh.create_cube(6, 0.1)
    x, rows = box.vertices.copy(), box.tetrahedra
    inner = np.setdiff1d(np.arange(box.num_vertices), box.surface_triangles)[0]
    own = rows[(rows == inner).any(1)][0]
    x[inner] += 0.98 * (x[own[own != inner]].mean(0) - x[inner])
    scene = ds.Scene(ds.TetrahedralMesh(x, rows), ds.StableNeoHookean(1e5, 0.3), terms=ds.Gravity(), fixed=inner)
    scene = scene.replace(fixed=np.unique(box.surface_triangles)[:40])
    advice = recommend(scene, 0.03, 0.3, gradients=False, budget=1.0, elements=False)
    ways = {way.how.split("=")[0].split("(")[0]: way for way in advice.alternatives}
    assert "mass_scaling" in ways or "mass_scaling" in str(advice.left_out)
    assert "adaptive_steps" in ways and ways["adaptive_steps"].search > 0
    assert all(way.error <= 0.3 and way.seconds > 0 and str(way) in str(advice) for way in advice.alternatives)


def stiff_bar(stiff):
    """A bar whose outer half is a set of other stiffness; a third set is soft."""
    mesh = ds.TetrahedralMesh.create_box((4, 2, 2), size=(0.3, 0.1, 0.1), pattern="five")
    x = mesh.vertices[mesh.tetrahedra].mean(1)[:, 0]
    for name, rows in (("shell", x > 0.2), ("grip", (x > 0.1) & (x < 0.2)), ("all", x > 0)):
        mesh = mesh.with_tetrahedron_set(name, np.flatnonzero(rows))
    E = np.where(x > 0.2, stiff, 1e5)
    return ds.Scene(mesh, ds.StableNeoHookean(E, 0.3), terms=ds.Gravity(), fixed="xmin")


def test_stiff_sets_are_those_a_hundred_times_stiffer_than_all_else():
    assert stiff_sets(stiff_bar(1e7)) == ["shell"] and not stiff_sets(stiff_bar(9.9e6))
    scene = stiff_bar(1e9)
    E = scene.material.values(scene.mesh)["youngs_modulus"].copy()
    E[scene.mesh.tetrahedron_sets["grip"]] = 1e10
    assert sorted(stiff_sets(scene.replace(material=ds.StableNeoHookean(E, 0.3)))) == ["grip", "shell"]


def test_advice_offers_stiff_parts_that_move_affinely():
    advice = recommend(stiff_bar(1e8), 0.03, 0.1, gradients=False, budget=1.0, elements=False)
    (way, *_) = [way for way in advice.alternatives if "reduced={'shell': 'affine'}" in way.how]
    assert way.error <= 0.1 and 1 <= way.steps < 200 and str(way) in str(advice)
