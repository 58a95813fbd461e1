"""Rollouts inside `ti.ad.Tape`, between kernels of the user's."""

from functools import cache

import numpy as np
import pytest
import taichi as ti
import torch
from test_gradients import by_solver, free_scene, full_scene, rollout_of

import diffsim_ti as ds
from diffsim_ti import runtime, verify
from diffsim_ti.diff_simulator import rollout_frames

STEPS = 12


@cache
def scalar_field(name="total"):
    """One field for all tests: kernels compile anew for each."""
    return ti.field(ti.f64, (), needs_grad=True)


@ti.kernel
def spread(positions: ti.template(), velocities: ti.template(), total: ti.template()):
    """Some loss over all frames."""
    for f, i in positions:
        weight = 0.1 + f + ti.sin(1.0 * i)
        total[None] += weight * positions[f, i].norm_sqr() + positions[f, i].y + velocities[f, i].dot(positions[f, i])


def spread_adjoint(frames):
    """The same loss's gradients in NumPy."""
    x, v = frames.positions.astype(float), frames.velocities.astype(float)
    f, i = np.indices(x.shape[:2])
    return 2 * (0.1 + f + np.sin(i))[..., None] * x + [0, 1, 0] + v, x


def small(solver=ds.SemiImplicitSolver, precision="f64", **options):
    return rollout_of(full_scene(precision=precision, steps=STEPS), solver, STEPS, save_every=4, **options)


def taped(rollout, total, **options):
    with ti.ad.Tape(total, **options):
        rollout.run()
        spread(rollout.positions, rollout.velocities, total)


@by_solver
def test_a_tape_gives_the_bits_of_vjp(solver):
    """In f64: the tape's adjoint of the frames is the same kernel's as ours by hand."""
    rollout, total = small(solver), scalar_field()
    fields = {name: rollout.field(name) for name in rollout.inputs}
    taped(rollout, total)
    by_hand = small(solver)
    frames = by_hand.forward()
    adjoints = [rollout.field(name).grad.to_numpy() for name in ("positions", "velocities")]
    expected = by_hand.vjp(frames, *adjoints)
    assert np.array_equal(rollout.positions.to_numpy(), frames.positions)
    assert np.array_equal(rollout.velocities.to_numpy(), frames.velocities)
    for got, want in zip(adjoints, spread_adjoint(frames)):
        np.testing.assert_allclose(got, want, rtol=1e-14, atol=1e-14)
    for name, value in expected.items():
        assert rollout.gradients[name].tobytes() == value.tobytes(), name
        grad = fields[name].grad
        assert np.array_equal(grad.to_numpy(), value), name


@by_solver
def test_the_loss_is_differentiated_and_not_only_handed_on(solver):
    """Sixty nonlinear steps in one tape: the rollout keeps or restores the states that its reverse sweep reads."""
    rollout, total = rollout_of(full_scene(), solver, 60), scalar_field()
    E = rollout.field("youngs_modulus")
    base = E.to_numpy()
    direction = np.random.default_rng(0).normal(size=base.shape) * 1e4

    def loss(t):
        E.from_numpy(base + t * direction)
        taped(rollout, total)
        return total[None]

    loss(0.0)
    slope = float((E.grad.to_numpy() * direction).sum())
    assert slope == pytest.approx(verify.central_difference(loss)[0], rel=1e-7)
    assert ds.taylor_test(loss, 0.0, slope, 1.0, epsilon=1e-2).rate >= 1.95


def test_two_tapes_give_the_same():
    """A tape clears gradients; without clearing they add up."""
    rollout, total = small(), scalar_field()
    E, v = rollout.field("youngs_modulus"), rollout.field("initial_velocities")
    taped(rollout, total)
    one = E.grad.to_numpy(), v.grad.to_numpy()
    taped(rollout, total)
    two = E.grad.to_numpy(), v.grad.to_numpy()
    assert all(np.array_equal(a, b) for a, b in zip(one, two)) and one[0].any()
    assert np.array_equal(rollout.gradients["youngs_modulus"], one[0])


def test_gradients_add_up_where_a_tape_does_not_clear():
    rollout, total = small(), scalar_field()
    E = rollout.field("youngs_modulus")
    taped(rollout, total)
    one, by_run = E.grad.to_numpy(), rollout.gradients["youngs_modulus"].copy()
    rollout.positions.grad.fill(0)
    rollout.velocities.grad.fill(0)
    taped(rollout, total, clear_gradients=False)
    np.testing.assert_allclose(E.grad.to_numpy(), 2 * one, rtol=1e-14)
    assert np.array_equal(rollout.gradients["youngs_modulus"], by_run)  # this is of the last run alone


@by_solver
def test_two_rollouts_in_one_tape(solver):
    """Side by side, with one parameter; and the sum of what each gives alone."""
    a, b, total = small(solver), small(solver, checkpoint_every=3), scalar_field()
    b.field("gravity").from_numpy(np.array([1.0, -5.0, 2.0]))
    E_a, E_b = a.field("youngs_modulus"), b.field("youngs_modulus")
    with ti.ad.Tape(total):
        a.run()
        b.run()
        spread(b.positions, b.velocities, total)
        spread(a.positions, a.velocities, total)
    both = E_a.grad.to_numpy(), E_b.grad.to_numpy(), total[None]
    taped(a, total)
    alone_a = total[None]
    assert np.array_equal(E_a.grad.to_numpy(), both[0])
    taped(b, total)
    assert np.array_equal(E_b.grad.to_numpy(), both[1])
    assert both[2] == pytest.approx(alone_a + total[None], rel=1e-14)
    assert not np.array_equal(both[0], both[1])


def test_one_rollout_after_another():
    """The second starts where the first ends."""
    scene = full_scene(steps=STEPS)
    first, second, total = rollout_of(scene, steps=5), rollout_of(scene, steps=5), scalar_field()
    x, v = second.field("initial_positions"), second.field("initial_velocities")

    @ti.kernel
    def hand_over(x0: ti.template(), v0: ti.template(), x1: ti.template(), v1: ti.template()):
        for i in x1:
            x1[i] = x0[1, i]
            v1[i] = v0[1, i]

    E = first.field("youngs_modulus")
    base = E.to_numpy()

    def loss(t):
        E.from_numpy(base * (1 + t))
        with ti.ad.Tape(total):
            first.run()
            hand_over(first.positions, first.velocities, x, v)
            second.run()
            spread(second.positions, second.velocities, total)
        return total[None]

    loss(0.0)
    slope = float((E.grad.to_numpy() * base).sum())
    assert slope == pytest.approx(verify.central_difference(loss)[0], rel=1e-7)


@by_solver
def test_kernels_before_and_after(solver):
    """A parameter of the user's own: log E by a wave over the tetrahedra, drag and start besides."""
    rollout, total, parameter = small(solver), scalar_field(), scalar_field("parameter")
    E, drag, v0 = (rollout.field(n) for n in ("youngs_modulus", "drag_rate", "initial_velocities"))

    @ti.kernel
    def write():
        for e in E:
            E[e] = 1e5 * ti.exp(parameter[None] * ti.cos(1.0 * e))
        for i in v0:
            v0[i] = ti.Vector([parameter[None], 0.3, parameter[None] ** 2 * i])
        for _ in range(1):
            drag[None] = 1.0 + parameter[None]

    def loss(p):
        parameter[None] = float(p)
        with ti.ad.Tape(total):
            write()
            rollout.run()
            spread(rollout.positions, rollout.velocities, total)
        return total[None]

    loss(0.2)
    slope = parameter.grad[None]
    assert slope != 0
    differences, _ = verify.central_difference(lambda t: loss(0.2 + t), 0.1)
    assert slope == pytest.approx(differences, rel=1e-7)
    assert ds.taylor_test(loss, 0.2, slope, 1.0, epsilon=1e-2).rate >= 1.95


def test_kinds_of_input_fields():
    """A number, a number per tetrahedron, a 3-vector, vectors per vertex, per step and vertex."""
    rollout = small()
    shapes = {name: tuple(rollout.field(name).shape) for name in rollout.inputs}
    assert shapes["drag_rate"] == shapes["gravity"] == () and rollout.field("gravity").n == 3
    assert shapes["youngs_modulus"] == (48,) and shapes["initial_positions"] == (27,)
    assert shapes["external_forces"] == (STEPS, 27) and shapes["prescribed_motion"] == (STEPS + 1, 9)
    for name in rollout.inputs:
        assert np.array_equal(rollout.field(name).to_numpy(), rollout.values[name]), name
        assert rollout.field(name) is rollout.field(name)
    with pytest.raises(ValueError, match="no input named 'colour'.*youngs_modulus"):
        rollout.field("colour")


def test_uniform_moduli_take_one_number():
    mesh = ds.TetrahedralMesh.create_cube(2)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=ds.Gravity(), fixed="ymax", precision="f64")
    rollout, total = rollout_of(scene, steps=STEPS), scalar_field()
    E = rollout.field("youngs_modulus")
    assert E.shape == ()
    taped(rollout, total)
    slope = E.grad[None]
    assert slope == float(rollout.gradients["youngs_modulus"])

    def loss(t):
        E[None] = 1e5 * (1 + t)
        taped(rollout, total)
        return total[None]

    assert 1e5 * slope == pytest.approx(verify.central_difference(loss)[0], rel=1e-7)


def test_only_wanted_gradients_reach_fields():
    rollout, total = small(gradients=["gravity"]), scalar_field()
    g, E = rollout.field("gravity"), rollout.field("youngs_modulus")
    taped(rollout, total)
    assert g.grad.to_numpy().any() and not E.grad.to_numpy().any() and list(rollout.gradients) == ["gravity"]


@ti.kernel
def squares(positions: ti.template(), velocities: ti.template(), total: ti.template()):
    for f, i in positions:
        total[None] += positions[f, i].norm_sqr() + velocities[f, i].norm_sqr()


@pytest.mark.backends
@by_solver
def test_backend_tape(solver):
    """In f32 all the way, as Vulkan needs it."""
    scene = full_scene(precision="f32", resolution=2, steps=4)
    rollout, by_hand = (rollout_of(scene, solver, 4, save_every=2) for _ in range(2))
    total = ti.field(ti.f32, (), needs_grad=True)
    fields = {name: rollout.field(name) for name in rollout.inputs}
    with ti.ad.Tape(total):
        rollout.run()
        squares(rollout.positions, rollout.velocities, total)
    frames = by_hand.forward()
    expected = by_hand.vjp(frames, 2 * frames.positions, 2 * frames.velocities)
    assert np.array_equal(rollout.positions.to_numpy(), frames.positions)
    loss = float((frames.positions.astype(float) ** 2).sum() + (frames.velocities.astype(float) ** 2).sum())
    assert total[None] == pytest.approx(loss, rel=1e-5)
    for name, field in fields.items():
        size = np.abs(expected[name]).max()
        np.testing.assert_allclose(field.grad.to_numpy(), expected[name], rtol=1e-5, atol=1e-5 * size)


# ---- many runs in one tape --------------------------------------------------------------------------------------------

RUNS = 5


@ti.kernel
def hand_over(x: ti.template(), v: ti.template(), k: int, x0: ti.template(), v0: ti.template()):
    """The start of the next run from the last frame of run k: damped by a wave, and drawn to a point."""
    for i in x0:
        x0[i] = x[k, 1, i]
        v0[i] = 0.9 * v[k, 1, i] + 0.1 * ti.sin(3.0 * x[k, 1, i]) * v[k, 1, i].norm_sqr()


@ti.kernel
def spread_rows(positions: ti.template(), velocities: ti.template(), total: ti.template()):
    """Some loss over all frames of all runs."""
    for r, f, i in positions:
        weight = 0.1 + r + 2 * f + ti.sin(1.0 * i)
        total[None] += weight * positions[r, f, i].norm_sqr() + velocities[r, f, i].dot(positions[r, f, i])


def chained(rollout, total):
    x0, v0 = rollout.field("initial_positions"), rollout.field("initial_velocities")
    with ti.ad.Tape(total):
        for k in range(RUNS):
            rollout.run(k)
            if k + 1 < RUNS:
                hand_over(rollout.positions, rollout.velocities, k, x0, v0)
        spread_rows(rollout.positions, rollout.velocities, total)
    return total[None]


def chained_in_torch(rollout, E, x, v):
    total, wave = 0.0, torch.sin(torch.arange(27.0, dtype=torch.float64))[:, None]
    for r in range(RUNS):
        frames = rollout_frames(rollout, youngs_modulus=E, initial_positions=x, initial_velocities=v)
        for f in range(2):
            p, q = frames.positions[f], frames.velocities[f]
            total = total + ((0.1 + r + 2 * f + wave) * p**2).sum() + (p * q).sum()
        x, v = frames.positions[1], frames.velocities[1]
        v = 0.9 * v + 0.1 * torch.sin(3 * x) * (v**2).sum(1, keepdim=True)
    return total


def tight_euler(scene, **options):
    return ds.ImplicitEulerSolver(scene, tolerance=1e-13, **options)


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.VelocityVerletSolver, tight_euler])
def test_kernels_close_a_loop_between_runs(solver):
    """One rollout five times, each from where a kernel puts it: against differences, and against torch's chain."""
    scene = free_scene(fixed="ymax")
    rollout, total = rollout_of(scene, solver, 4, runs=RUNS), scalar_field()
    E, x0, v0 = (rollout.field(name) for name in ("youngs_modulus", "initial_positions", "initial_velocities"))
    starts = [scene.inputs.values[name] for name in ("youngs_modulus", "initial_positions", "initial_velocities")]
    rng = np.random.default_rng(0)
    directions = [scale * rng.normal(size=x.shape) for scale, x in zip((1e4, 0.01, 0.1), starts)]

    def loss(t):
        for field, start, direction in zip((E, x0, v0), starts, directions):
            field.from_numpy(start + t * direction)
        return chained(rollout, total)

    tensors = [torch.tensor(x, requires_grad=True) for x in starts]
    of_torch = chained_in_torch(rollout, *tensors)
    of_torch.backward()
    assert loss(0.0) == pytest.approx(float(of_torch), rel=1e-12)
    gradients = [field.grad.to_numpy() for field in (E, x0, v0)]
    # kernels overwrite the start after each run: what is left there is the gradient by the first one
    for got, tensor in zip(gradients, tensors):
        np.testing.assert_allclose(got, tensor.grad.numpy(), rtol=1e-8, atol=1e-9 * float(tensor.grad.abs().max()))
    assert np.array_equal(rollout.gradients["youngs_modulus"], gradients[0])
    slope = sum((gradient * direction).sum() for gradient, direction in zip(gradients, directions))
    assert slope == pytest.approx(verify.central_difference(loss)[0], rel=1e-7)


@pytest.mark.backends
def test_a_chain_is_one_long_run():
    """Displacements and velocities handed over as they are, in f32: the same bits, and the same gradient."""
    scene = free_scene(precision="f32", fixed="ymax")
    chain, whole, total = (
        rollout_of(scene, steps=4, runs=3),
        rollout_of(scene, steps=12),
        ti.field(ti.f32, (), needs_grad=True),
    )
    u0, v0, E = (chain.field(name) for name in ("initial_displacements", "initial_velocities", "youngs_modulus"))

    @ti.kernel
    def hand_on(u: ti.template(), v: ti.template(), k: int):
        for i in u0:
            u0[i], v0[i] = u[k, 1, i], v[k, 1, i]

    @ti.kernel
    def squares_of_last(x: ti.template(), v: ti.template()):
        for i in range(27):
            total[None] += x[2, 1, i].norm_sqr() + v[2, 1, i].norm_sqr()

    with ti.ad.Tape(total):
        for k in range(3):
            chain.run(k)
            if k < 2:
                hand_on(chain.field("displacements"), chain.velocities, k)
        squares_of_last(chain.positions, chain.velocities)
    frames = whole.forward()
    assert np.array_equal(chain.positions.to_numpy()[2, 1], frames.positions[1])
    seeds = [2 * x * np.array([0, 1])[:, None, None] for x in (frames.positions, frames.velocities)]
    expected = whole.vjp(frames, *seeds)
    for field, name in ((u0, "initial_positions"), (v0, "initial_velocities"), (E, "youngs_modulus")):
        size = np.abs(expected[name]).max()
        np.testing.assert_allclose(field.grad.to_numpy(), expected[name], rtol=1e-4, atol=1e-5 * size, err_msg=name)


def test_two_spellings_of_the_start():
    rollout = rollout_of(free_scene(), steps=4)
    rollout.field("initial_displacements")
    with pytest.raises(ValueError, match="two spellings of one input"):
        rollout.field("initial_positions")
    with pytest.raises(ValueError, match="with rest_positions, use initial_positions"):
        rollout.field("rest_positions")


def test_runs_and_their_rows():
    """Fields have a row for each run; a run that is repeated, or out of range, is refused; a new tape is a new chance."""
    rollout, total = rollout_of(free_scene(), steps=4, runs=2), scalar_field()
    assert rollout.positions.shape == (2, 2, 27) and rollout.field("youngs_modulus").shape == (48,)
    with pytest.raises(RuntimeError, match="run 1 already ran in this tape"):
        with ti.ad.Tape(total):
            rollout.run(0)
            rollout.run(1)
            rollout.run(1)
    for bad in (2, -1, 0.5, None):
        with pytest.raises(ValueError, match="this rollout has 2 runs: give a whole number of 0 .. 1"):
            rollout.run(bad)
    with pytest.raises(ValueError, match="no numbered runs: make the Rollout with runs=..."):
        rollout_of(free_scene(), steps=4).run(0)
    with pytest.raises(ValueError, match="runs must be a whole number >= 1"):
        rollout_of(free_scene(), steps=4, runs=0)
    rollout.field("initial_velocities").from_numpy(np.full((27, 3), np.nan))
    with pytest.raises(ValueError, match="initial_positions and initial_velocities must be finite: those of vertex 0"):
        rollout.run(0)


def test_a_run_between_a_tapes_runs():
    """Another run of the same rollout, before the tape goes back: each run owns what its backward needs."""
    rollout, total = rollout_of(free_scene(), steps=4, save_every=2), scalar_field()
    E, x0 = rollout.field("youngs_modulus"), rollout.field("initial_positions")
    taped(rollout, total)
    expected = E.grad.to_numpy(), x0.grad.to_numpy()
    with ti.ad.Tape(total):
        rollout.run()
        rollout.forward(youngs_modulus=2 * rollout.values["youngs_modulus"])
        spread(rollout.positions, rollout.velocities, total)
    assert np.array_equal(E.grad.to_numpy(), expected[0]) and np.array_equal(x0.grad.to_numpy(), expected[1])


@by_solver
def test_other_work_in_a_tape_is_not_taped(solver):
    """Runs, gradients, tangents, steps and looks between kernels of a user leave nothing that a tape would go through."""
    scene = full_scene(steps=4)
    rollout = rollout_of(scene, solver, 4, save_every=2, outputs=[ds.Stress(), ds.ElasticEnergy()])
    simulator, batch = ds.Simulator(rollout.solver.for_scene(scene)), ds.Batch(rollout.solver, 4, 2)
    with ti.ad.Tape(scalar_field()) as tape:
        frames = rollout.forward()
        rollout.vjp(frames, np.ones_like(frames.positions), stress=np.ones_like(frames["stress"]))
        rollout.tangents(frames, density=1.0)
        rollout_frames(rollout, youngs_modulus=torch.tensor(1e4))
        simulator.step()
        simulator.compute_energy(), simulator.output(ds.Stress()), simulator.describe()
        many = batch.forward()
        batch.vjp(many, np.ones_like(many.positions))
        rollout.field("density")
        assert len(tape.calls) == 0


# ---- misuse -----------------------------------------------------------------------------------------------------------


def test_the_same_rollout_twice_in_one_tape():
    rollout, total = small(), scalar_field()
    with pytest.raises(RuntimeError, match="already ran in this tape.*make a second Rollout"):
        with ti.ad.Tape(total):
            rollout.run()
            spread(rollout.positions, rollout.velocities, total)
            rollout.run()
    taped(rollout, total)  # and a new tape is a new chance
    assert rollout.gradients["youngs_modulus"].any()


def test_outside_a_tape():
    rollout, total = small(), scalar_field()
    rollout.run()
    rollout.run()
    plain = rollout.positions.to_numpy()
    assert np.array_equal(plain, small().forward().positions) and not rollout.gradients
    taped(rollout, total)
    assert np.array_equal(rollout.positions.to_numpy(), plain)


def test_bad_values_in_a_field():
    rollout, total = small(), scalar_field()
    rollout.field("drag_rate")[None] = float("nan")
    with pytest.raises(ValueError, match="drag_rate must be finite"):
        with ti.ad.Tape(total):
            rollout.run()


def test_a_loss_gradient_that_is_nan():
    rollout, total = small(), scalar_field()

    @ti.kernel
    def root(x: ti.template()):
        total[None] += ti.sqrt(x[1, 3].x - x[1, 3].x)

    with pytest.raises(FloatingPointError, match="gradient by positions is not finite at step 4"):
        with ti.ad.Tape(total):
            rollout.run()
            root(rollout.positions)


# ---- storage ----------------------------------------------------------------------------------------------------------


def test_fields_come_back(monkeypatch):
    """512 field trees end a process: dropped rollouts lend theirs to the next."""
    made, make = [], runtime.FieldPool._make
    monkeypatch.setattr(runtime.FieldPool, "_make", staticmethod(lambda *a: made.append(a) or make(*a)))
    scene, total = full_scene(steps=STEPS), scalar_field()

    def use():
        rollout = rollout_of(scene, steps=STEPS, save_every=4)
        E = rollout.field("youngs_modulus")
        assert not E.grad.to_numpy().any() and np.array_equal(E.to_numpy(), rollout.values["youngs_modulus"])
        taped(rollout, total)
        return E.grad.to_numpy()

    first = use()
    made.clear()
    for _ in range(50):
        assert np.array_equal(use(), first)
    assert not made


def test_device_memory_comes_back():
    total = scalar_field()

    def use():
        rollout = small()
        rollout.vjp(rollout.forward(), np.ones((4, 27, 3)))
        chain = rollout_of(free_scene(), steps=4, runs=RUNS)
        chained(chain, total)
        start = torch.zeros(27, 3, dtype=torch.float64, requires_grad=True)
        frames = rollout_frames(chain, initial_displacements=start)
        frames.positions.sum().backward()

    use()
    before = runtime.allocated_megabytes()
    for _ in range(10):
        use()
    assert runtime.allocated_megabytes() <= before * 1.01 + 1e-3
