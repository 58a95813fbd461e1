"""What is kept for the reverse sweep changes memory and time, never a bit of the gradient."""

import gc
import math
from functools import cache

import numpy as np
import pytest
from test_gradients import by_solver, full_scene, rollout_of

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.monitor.guard import Guard
from diffsim_ti.rollout.checkpoints import Checkpoints, choose_checkpoints
from diffsim_ti.solvers.explicit.solver import ExplicitWorkspace

STEPS = 24
rng = np.random.default_rng(4)
W, Z = rng.normal(size=(2, 4, 27, 3))  # 4 frames


def gradients_of(rollout, **values):
    return rollout.vjp(rollout.forward(**values), W, Z)


def rollout(solver=ds.SemiImplicitSolver, **options):
    return rollout_of(full_scene(), solver, STEPS, save_every=8, **options)


def assert_same_bits(a: dict, b: dict):
    assert set(a) == set(b)
    for name in a:
        assert a[name].tobytes() == b[name].tobytes(), name


@cache
def stored_whole(solver):
    whole = rollout(solver)
    assert whole.checkpoints.num_segments == 1
    return gradients_of(whole)


@by_solver
@pytest.mark.parametrize("every", [1, 2, round(math.sqrt(STEPS)), 7, STEPS, 10 * STEPS])
def test_segments_give_the_same_bits(solver, every):
    assert_same_bits(gradients_of(rollout(solver, checkpoint_every=every)), stored_whole(solver))


STATE = 4 * 27 * 8 / 1e6  # MB of one array of vertex vectors, which have four components


@by_solver
@pytest.mark.parametrize("states", [8, 9, 10, 12, 14, 20, 40, 80, 200])
def test_budgets_give_the_same_bits(solver, states):
    small = rollout(solver, memory=states * STATE)
    assert small.checkpoints.states() <= states and small.memory <= states * STATE * (1 + 1e-12)
    assert_same_bits(gradients_of(small), stored_whole(solver))


@pytest.mark.executed_ptx
@by_solver
def test_budget_and_segments_together(solver):
    both = rollout(solver, checkpoint_every=2, memory=21 * STATE)
    assert both.checkpoints.segment == 4 and both.checkpoints.snapshots == 3 < both.checkpoints.num_segments
    assert_same_bits(gradients_of(both), stored_whole(solver))


def test_budgets_reach_every_kind_of_schedule():
    """One snapshot, several levels of repeats, two levels, everything: the tests above mean something."""
    schedules = [choose_checkpoints(48, 1, None, states / 1e6) for states in (8, 9, 10, 12, 14, 20, 40, 80, 200)]
    assert schedules[0] == Checkpoints(48, 1, 1) and schedules[-1].num_segments == 1
    assert any(1 < s.snapshots < s.num_segments for s in schedules)
    assert any(s.snapshots == s.num_segments > 1 for s in schedules)
    assert all(s.states() <= states for s, states in zip(schedules, (8, 9, 10, 12, 14, 20, 40, 80, 200)))


@by_solver
def test_too_little_memory(solver):
    least = 8 * STATE  # one snapshot (2) and a recorded pass (2 slots of 3)
    with pytest.raises(ValueError, match=f"too little to differentiate at all: {least:.3g} MB is the least"):
        rollout(solver, memory=0.99 * least)
    rollout(solver, memory=1.01 * least)
    with pytest.raises(ValueError, match="too little for segments of 10 passes"):
        rollout(solver, checkpoint_every=5, memory=20 * STATE)


# ---- memory -----------------------------------------------------------------------------------------------------------


def allocated(**options) -> tuple[float, float]:
    """(megabytes that a gradient keeps beyond a forward run of no steps, megabytes that the schedule says)."""
    scene = full_scene(steps=1000)
    idle = rollout_of(scene, steps=0)
    gc.collect()  # failed runs of other tests, held by their tracebacks
    sizes = []
    for r in (idle, rollout_of(scene, steps=1000, **options)):
        before = runtime.allocated_megabytes()
        r.vjp(r.forward(), np.zeros((r.num_frames, 27, 3)))
        sizes.append(runtime.allocated_megabytes() - before)
    return sizes[1] - sizes[0], r.memory


@pytest.mark.parametrize(
    "options", [{}, {"checkpoint_every": 1}, {"checkpoint_every": 25}, {"memory": 0.5}, {"memory": 0.05}]
)
def test_what_is_kept_is_what_the_schedule_says(options):
    kept, said = allocated(**options)
    # frames, prescribed motion and their adjoints grow with the run too, whatever the schedule
    inputs = 2 * 1000 * 9 * 32 / 1e6
    idle = 8 * STATE
    assert kept == pytest.approx(said - idle + inputs, abs=2 * STATE + 0.02)


def test_memory_falls_as_the_theory_says():
    """Everything: 3 n states; roots: a multiple of sqrt(n); binomial: the budget, whatever n."""
    n = 2000
    whole, root = choose_checkpoints(n, 100, None, 1.0), choose_checkpoints(n, 100, None, 0.1)
    assert whole.states() == 2 + 3 * (n + 1)
    assert (
        root.snapshots == root.num_segments and root.states() <= 2 * math.sqrt(6 * n) + 8
    )  # 2 n / s + 3 s at its least
    for states in (20, 50, 100):
        assert choose_checkpoints(n, 100, None, states * 1e-4).states() <= states


# ---- work -------------------------------------------------------------------------------------------------------------


@cache
def optimal(length: int, snapshots: int) -> int:
    """Least advances to reverse `length` segments with `snapshots` (one of them the start), by trying everything."""
    if length <= 1:
        return 0
    if snapshots == 1:
        return length * (length - 1) // 2
    return min(m + optimal(length - m, snapshots - 1) + optimal(m, snapshots) for m in range(1, length))


def griewank(length: int, snapshots: int) -> int:
    """The closed form: r l - C(s + r, r - 1), with r the least number for which l <= C(s + r, r)."""
    r = 0
    while math.comb(snapshots + r, r) < length:
        r += 1
    return r * length - math.comb(snapshots + r, r - 1) if r else 0


def count(rollout, monkeypatch) -> int:
    """Passes of a forward run and a reverse sweep."""
    passes, advance = [], ExplicitWorkspace.advance

    def counted(self, first, last, *arguments, **options):
        passes.append(last - first)
        advance(self, first, last, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(ExplicitWorkspace, "advance", counted)
        gradients_of(rollout)
    return sum(passes)


@pytest.mark.parametrize("states", [8, 10, 12, 14, 16])
def test_passes_of_the_binomial_schedule(monkeypatch, states):
    """One run forward; the optimal number of advances, less those up to the last snapshot of that run; each recorded."""
    small = rollout_of(full_scene(), steps=STEPS, substeps=1, save_every=8, memory=states * STATE)
    schedule = small.checkpoints
    assert schedule.segment == 1 and schedule.num_segments == STEPS
    kept = [0, *schedule.path(0, STEPS, schedule.snapshots - 1)]
    expected = STEPS + optimal(STEPS, schedule.snapshots) - kept[-1] + STEPS
    assert count(small, monkeypatch) == expected


@pytest.mark.parametrize("snapshots", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("length", [1, 2, 5, 6, 10, 21, 35, 56, 100])
def test_theory(length, snapshots):
    """The closed form is the least there is, and the schedule's splits reach it."""

    def advances(begin, end, free):
        if end - begin <= 1:
            return 0
        path = Checkpoints(end, 1, 1).path(begin, end, free)
        if not path:
            return (end - begin) * (end - begin - 1) // 2
        return path[0] - begin + advances(path[0], end, free - 1) + advances(begin, path[0], free)

    assert optimal(length, snapshots) == griewank(length, snapshots)
    assert advances(0, length, snapshots - 1) == optimal(length, snapshots)


def test_passes_of_simple_schedules(monkeypatch):
    passes = STEPS * 2
    assert count(rollout(), monkeypatch) == 2 * passes  # forward; recorded
    assert count(rollout(checkpoint_every=3), monkeypatch) == 2 * passes
    again = rollout()
    gradients_of(again)
    assert count(again, monkeypatch) == passes  # who asked once for a gradient records while running


# ---- order of calls ---------------------------------------------------------------------------------------------------

OPTIONS = [{}, {"checkpoint_every": 5}, {"memory": 12 * STATE}]
by_options = pytest.mark.parametrize("options", OPTIONS, ids=["whole", "segments", "binomial"])


@pytest.mark.executed_ptx
@by_options
@by_solver
def test_two_sweeps_of_the_same_frames(solver, options):
    r = rollout(solver, **options)
    frames = r.forward()
    first, second = r.vjp(frames, W, Z), r.vjp(frames, W, Z)
    assert_same_bits(first, second)
    assert_same_bits(first, stored_whole(solver))
    r.jvp(frames, gravity=np.ones(3))  # uses the same records
    assert_same_bits(first, r.vjp(frames, W, Z))


@by_options
def test_two_forwards_before_one_backward(options, monkeypatch):
    """The first is done again, and was looked after when it was done at first."""
    r = rollout(**options)
    stiffer = r.values["youngs_modulus"] * 1.3
    one, two = r.forward(), r.forward(youngs_modulus=stiffer)
    assert not np.array_equal(one.positions, two.positions)
    with monkeypatch.context() as patch:
        patch.delattr(Guard, "advance")
        g_one, g_two = r.vjp(one, W, Z), r.vjp(two, W, Z)
    assert_same_bits(g_one, stored_whole(ds.SemiImplicitSolver))
    assert_same_bits(g_two, gradients_of(rollout(**options), youngs_modulus=stiffer))
    assert_same_bits(r.vjp(one, W, Z), g_one)


@by_options
def test_backward_after_an_exception(options):
    r = rollout(**options)
    frames = r.forward()
    with pytest.raises(ValueError, match="gradient by the frames' positions: expected shape"):
        r.vjp(frames, W[:2])
    with pytest.raises(ValueError, match="expected shape"):
        r.forward(gravity=np.ones(4))
    with pytest.raises(ValueError, match="poissons_ratio must lie in"):
        r.forward(poissons_ratio=0.7)
    assert_same_bits(r.vjp(frames, W, Z), stored_whole(ds.SemiImplicitSolver))


@by_options
def test_an_interrupted_sweep(monkeypatch, options):
    """Ctrl-C in the middle of a sweep leaves nothing behind."""
    from diffsim_ti.solvers.explicit.sweeps import ExplicitAdjoint

    r = rollout(**options)
    frames, calls, reverse = r.forward(), [], ExplicitAdjoint.reverse

    def interrupted(self, *arguments):
        calls.append(1)
        if len(calls) == max(1, r.checkpoints.num_segments // 2):
            raise KeyboardInterrupt
        reverse(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(ExplicitAdjoint, "reverse", interrupted)
        with pytest.raises(KeyboardInterrupt):
            r.vjp(frames, W, Z)
    assert_same_bits(r.vjp(frames, W, Z), stored_whole(ds.SemiImplicitSolver))


@by_options
def test_two_rollouts_interleaved(options):
    a, b = rollout(**options), rollout(ds.VelocityVerletSolver, **options)
    fa, fb = a.forward(), b.forward()
    ga, gb = a.vjp(fa, W, Z), b.vjp(fb, W, Z)
    assert_same_bits(ga, stored_whole(ds.SemiImplicitSolver))
    assert_same_bits(gb, stored_whole(ds.VelocityVerletSolver))
    fa = a.forward()
    assert_same_bits(b.vjp(fb, W, Z), gb)
    assert_same_bits(a.vjp(fa, W, Z), ga)


def test_gradients_add_up_over_nothing():
    """Sweeps do not accumulate: a zero loss after another one has a zero gradient."""
    r = rollout()
    frames = r.forward()
    r.vjp(frames, W, Z)
    assert all(not g.any() for g in r.vjp(frames, 0 * W).values())


@by_solver
def test_no_steps_at_all(solver):
    r = rollout_of(full_scene(), solver, steps=0)
    frames = r.forward()
    w, z = W[:1], Z[:1]
    g = r.vjp(frames, w, z)
    free = np.setdiff1d(np.arange(27), r.scene.fixed)
    assert frames.positions.shape == (1, 27, 3)
    np.testing.assert_allclose(g["initial_positions"], w[0], rtol=1e-15)
    np.testing.assert_allclose(g["initial_velocities"][free], z[0][free], rtol=1e-15)
    assert not g["youngs_modulus"].any()


def test_a_solver_whose_substeps_changed_is_refused():
    scene = ds.Scene(ds.TetrahedralMesh.create_cube(2), ds.StableNeoHookean(1e4, 0.3), precision="f64")
    solver = ds.SemiImplicitSolver(scene, dt=1e-3)
    rollout = ds.Rollout(solver, 2)
    ds.Simulator(solver).set_substeps(2)
    with pytest.raises(RuntimeError, match="substeps changed"):
        rollout.forward()


@by_solver
def test_tangents_read_the_record_that_a_run_has_left(solver):
    """The same bits, whether a tangent records the run itself or comes before or after adjoints of one that is recorded."""
    change = dict(youngs_modulus=1e3, gravity=[1.0, 2.0, 3.0])
    fresh, used = rollout(solver), rollout(solver)
    first = fresh.jvp(fresh.forward(), **change)
    gradients_of(used)
    frames = used.forward()
    for _ in range(2):
        assert all(a.tobytes() == b.tobytes() for a, b in zip(used.jvp(frames, **change), first))
        assert_same_bits(used.vjp(frames, W, Z), stored_whole(solver))


@pytest.mark.parametrize("solver", [ds.ImplicitEulerSolver, ds.BDF2Solver, ds.ImplicitMidpointSolver, ds.StaticSolver])
def test_a_run_of_solves_is_solved_once(solver, monkeypatch):
    """Tangents and adjoints, in any order and however many, read the record that the run has left, and leave it as it is."""
    mesh = ds.TetrahedralMesh.create_cube(3, 0.1)
    ground = ds.Ground(mesh.vertices[:, 1].min() - 1e-3, 1e3, 5e-3, friction=0.3)
    fixed = "ymax" if solver is ds.StaticSolver else None
    scene = ds.Scene(mesh, ds.StableNeoHookean(2e4, 0.3), terms=[ds.Gravity(), ground], fixed=fixed, precision="f64")
    rollout = ds.Rollout(solver(scene, dt=5e-3), 3, save_every=1)
    frames, passes = rollout.forward(), []
    advance = type(rollout.sweep.workspace).advance
    monkeypatch.setattr(
        type(rollout.sweep.workspace), "advance", lambda self, *a, **k: passes.append(a) or advance(self, *a, **k)
    )
    seed = np.random.default_rng(0).standard_normal(frames.positions.shape)
    tangents, gradients = [], []
    for _ in range(2):
        tangents.append(rollout.jvp(frames, youngs_modulus=1e3, gravity=[1.0, 2.0, 3.0]))
        gradients.append(rollout.vjp(frames, seed))
    assert not passes
    assert all(a.tobytes() == b.tobytes() for a, b in zip(*tangents))
    assert all(gradients[0][name].tobytes() == gradients[1][name].tobytes() for name in gradients[0])
    again = ds.Rollout(solver(scene, dt=5e-3), 3, save_every=1, checkpoint_every=1)  # solved anew, from kept states
    found = again.vjp(again.forward(), seed)
    assert passes and all(found[name].tobytes() == gradients[0][name].tobytes() for name in found)
    without = ds.Rollout(solver(scene, dt=5e-3), 3, gradients=[])
    without.forward()
    assert without.sweep.workspace.record is None  # nobody will ask for it
