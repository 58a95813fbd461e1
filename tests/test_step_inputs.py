"""Inputs of single steps: a Simulator that is given rows has the states of a Rollout that is given the same."""

import numpy as np
import pytest
import torch

import diffsim_ti as ds
from diffsim_ti.diff_simulator import TorchSimulator

STEPS, DT = 4, 2e-3
MESH = ds.TetrahedralMesh.create_cube(2).with_surface_set("lid", lambda x, n: x[:, 0] > 0.9)


def over_time(value, ramped: bool):
    """A constant, or the same by a function."""
    value = np.asarray(value, float)
    return (lambda t: value) if ramped else value


def scene(ramped: bool, precision="f64") -> ds.Scene:
    of = lambda value: over_time(value, ramped)  # noqa: E731
    barrier = dict(stiffness=1e3, width=0.1)
    terms = [
        ds.Pressure(of(300.0), "lid", name="pressure"),
        ds.Traction(of([10.0, 200.0, 0.0]), "ymax", name="traction"),
        ds.BodyForce(of([0.0, 50.0, 900.0]), name="body"),
        ds.ExternalForce([[0.0, 5.0, 1.0]] * 2, [3, 7], name="force"),  # which has no function of time
        ds.Cable([1, 6], tension=of(20.0), name="cable"),
        ds.Cable([2, 5], length=of(1.2), stiffness=200.0, name="cord"),
        ds.Muscle((1, 0, 0), 2e3, of(0.3), name="muscle"),
        ds.Muscle((0, 1, 0), 1e3, of(np.full(MESH.num_tetrahedra, 0.2)), per="tetrahedron", name="fibres"),
        ds.Growth(of(0.02), name="growth"),
        ds.Ground(-0.06, path=lambda t: np.zeros(3), **barrier, name="moves"),
        ds.HalfSpace([0.5, 1.06, 0.5], [0.1, -1.0, 0.0], path=lambda t: np.zeros(6), **barrier, name="turns"),
    ]
    options = dict(fixed="zmin", motion=lambda t: np.zeros(3), precision=precision)
    return ds.Scene(MESH, ds.StableNeoHookean(1e5, 0.3), terms=terms, **options)


def rows_of(of: ds.Scene, name: str, rng: np.random.Generator, steps: int = STEPS) -> np.ndarray:
    """Random values of an input over a run, in the shape that a Rollout takes."""
    known = of.inputs.at_times(np.zeros(2))[name]
    rule = next(rule for rule in of.inputs.described[name].shapes if rule and isinstance(rule[0], str))
    ramped = rule[0] == "steps + 1"
    value = known[0] if ramped else known
    about = rng.uniform(0.5, 1.5, (steps + ramped, *value.shape)) * value
    small = 0.001 * rng.standard_normal((steps + ramped, *value.shape))
    return about if value.any() else np.cumsum(small, 0) - small[0]


def solver_of(kind, of: ds.Scene):
    exact = {} if kind.explicit or of.precision == "f32" else dict(tolerance=1e-12)
    return kind(of, dt=DT, substeps=3, **exact)


@pytest.mark.parametrize(
    "kind, precision, ramped",
    [
        (ds.SemiImplicitSolver, "f64", False),
        (ds.SemiImplicitSolver, "f64", True),
        (ds.ImplicitEulerSolver, "f32", True),
    ],
)
def test_steps_have_the_states_of_a_run(kind, precision, ramped):
    """To the bit, whatever is left as it was; a run goes on from a saved state with what it was given."""
    of, rng = scene(ramped, precision), np.random.default_rng(1)
    simulator = ds.Simulator(solver_of(kind, of))
    rows = {name: rows_of(of, name, rng) for name in simulator.step_inputs}
    held = [name for name, x in rows.items() if len(x) == STEPS]
    for name in simulator.step_inputs[::3]:  # given once, and then they stay
        rows[name][2:] = rows[name][1 if name in held else 2]
    frames = ds.Rollout(simulator.solver, STEPS, save_every=1).forward(**rows)

    def values(k: int) -> dict:
        stays = simulator.step_inputs[::3] if k > 1 else ()
        out = {name: rows[name][k if name in held else k + 1] for name in rows if name not in stays}
        return out | ({name: rows[name][:2] for name in rows if name not in held} if k == 0 else {})

    for k in range(STEPS):
        simulator.step(**values(k))
        np.testing.assert_array_equal(simulator.displacements, frames.displacements[k + 1])
        np.testing.assert_array_equal(simulator.velocities, frames.velocities[k + 1])
        if k == 1:
            state = simulator.state
    again = ds.Simulator(simulator.solver)
    again.resume(state)
    for k in range(2, STEPS):
        again.step(**values(k))
    np.testing.assert_array_equal(again.positions, simulator.positions)
    again.reset()
    again.step()
    simulator.reset()
    simulator.step()
    np.testing.assert_array_equal(again.positions, simulator.positions)  # as the scene gives them


# ---- in torch's graph ---------------------------------------------------------------------------------------------------


def leaf(x) -> torch.Tensor:
    return torch.tensor(x, dtype=torch.float64, requires_grad=True)


def loss_of(positions, velocities, rng) -> torch.Tensor:
    w = torch.from_numpy(rng.standard_normal((2, MESH.num_vertices, 3)))
    return (w[0] * positions).sum() + 1e-2 * (w[1] * velocities).sum()


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver])
def test_gradients_of_steps_are_those_of_a_run(kind):
    """By all that is given over time, by what stays, and by the start."""
    of, rng = scene(ramped=True), np.random.default_rng(3)
    solver = solver_of(kind, of)
    simulator = TorchSimulator(solver, values=dict(youngs_modulus=(E := leaf(1.1e5))))
    rows = {name: leaf(rows_of(of, name, rng)) for name in simulator.step_inputs}
    start, going = leaf(of.inputs.values["initial_positions"]), leaf(0.01 * rng.standard_normal((MESH.num_vertices, 3)))
    simulator.reset(start, going)
    for k in range(STEPS):
        simulator.step(**{n: x[k] if len(x) == STEPS else x[k : k + 2] for n, x in rows.items()})
    loss_of(simulator.positions, simulator.velocities, np.random.default_rng(4)).backward()

    rollout = ds.Rollout(solver, STEPS)
    known = {name: x.detach().numpy() for name, x in rows.items()} | dict(youngs_modulus=1.1e5)
    frames = rollout.forward(**known, initial_velocities=going.detach().numpy())
    np.testing.assert_allclose(simulator.displacements.detach(), frames.displacements[-1], rtol=0, atol=1e-12)
    seeds = [np.zeros(frames.positions.shape) for _ in range(2)]
    seeds[0][-1], seeds[1][-1] = np.random.default_rng(4).standard_normal((2, MESH.num_vertices, 3))
    expected = rollout.vjp(frames, seeds[0], 1e-2 * seeds[1])
    found = rows | dict(youngs_modulus=E, initial_positions=start, initial_velocities=going)
    for name, x in found.items():
        size = np.abs(expected[name]).max()
        np.testing.assert_allclose(x.grad, expected[name], rtol=0, atol=1e-8 * size, err_msg=name)


def controlled(solver, gain, scenes=None, steps=STEPS) -> torch.Tensor:
    """The loss of a loop that pulls on a cable as fast as a vertex moves."""
    simulator = TorchSimulator(solver, scenes)
    for _ in range(steps):
        speed = simulator.velocities[..., 6, 1]
        simulator.step(**{"cable.tension": 20.0 + gain * speed, "muscle.activation": 0.3})
    return (simulator.positions[..., 6, 1] ** 2 + simulator.velocities[..., 5, 0]).sum()


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver])
def test_a_control_loop_has_the_gradient_of_its_gain(kind):
    """By differences; scenes of a batch have those of each alone."""
    solver = solver_of(kind, scene(ramped=True))
    gain = leaf([900.0, 2000.0, 400.0])
    controlled(solver, gain, scenes=3).backward()
    for g, found in zip(gain.detach(), gain.grad):
        alone = leaf(float(g))
        controlled(solver, alone).backward()
        assert alone.grad == pytest.approx(float(found), rel=1e-9)
        up, down = (float(controlled(solver, g + d)) for d in (1.0, -1.0))
        assert alone.grad == pytest.approx((up - down) / 2, rel=1e-5)


def test_a_batch_takes_ramps_of_each_scene_or_of_all():
    of, rng = scene(ramped=True), np.random.default_rng(5)
    solver = solver_of(ds.SemiImplicitSolver, of)
    tension, pressure = 20.0 + rng.uniform(0, 9, (STEPS, 3)), 300.0 + rng.uniform(0, 50, STEPS)
    batch = TorchSimulator(solver, scenes=3)
    alone = [ds.Simulator(solver) for _ in range(3)]
    for k in range(STEPS):
        own = dict() if k == 2 else {"cable.tension": tension[k]}  # which then stays
        batch.step(**own, **{"pressure.pressure": pressure[k]})
        for b, simulator in enumerate(alone):
            simulator.step(**{name: x[b] for name, x in own.items()}, **{"pressure.pressure": pressure[k]})
    np.testing.assert_allclose(batch.positions, [x.positions for x in alone], rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match=r"one value for all scenes or one for each of 2: .* shape \(2, 2\)"):
        TorchSimulator(solver, scenes=2).step(**{"cable.tension": np.ones(2)})


# ---- what is refused ----------------------------------------------------------------------------------------------------


def test_wrong_names_and_shapes_are_answered():
    simulator = ds.Simulator(solver_of(ds.SemiImplicitSolver, scene(ramped=True)))
    before = simulator.positions
    for given, said in (
        (
            {"cable.tensoin": 3.0},
            r"step: no input named 'cable.tensoin' .*did you mean 'cable.tension'\? .*prescribed_motion",
        ),
        ({"youngs_modulus": 1e5}, "youngs_modulus is one value of the whole run; .*: pressure.pressure, "),
        ({"moves.path": [0.0, 1.0]}, r"moves.path: expected a value of shape \(3,\) at the end .*got shape \(2,\)"),
        ({"force.forces": np.zeros((2, 2, 3))}, r"force.forces: expected a value of shape \(2, 3\) for the step, got"),
        ({"growth.growth": -2.0}, "growth.growth must be > -1"),
        ({"cable.tension": np.nan}, "cable.tension must be finite"),
        ({"cable.tension": leaf(3.0)}, "take diff_simulator.TorchSimulator"),
    ):
        with pytest.raises(ValueError, match=said):
            simulator.step(**given)
    assert simulator.step_count == 0 and not simulator.state.keys() & set(simulator.step_inputs)
    np.testing.assert_array_equal(simulator.positions, before)
    with pytest.raises(ValueError, match="BDF2Solver looks back two steps"):
        TorchSimulator(ds.BDF2Solver(simulator.scene))
    steps = solver_of(ds.ImplicitEulerSolver, simulator.scene)
    for name, said in (
        ("initial_positions", "to reset"),
        ("rest_positions", "make the scene with it"),
        ("moves.path", "to step"),
    ):
        with pytest.raises(ValueError, match=f"numbers that hold in all steps, got {name}: .*{said}"):
            TorchSimulator(steps, values={name: simulator.scene.inputs.values["rest_positions"]})
    with pytest.raises(ValueError, match="work counts from the start of a run, and each step starts afresh"):
        TorchSimulator(steps, outputs=[ds.WorkOfLoads()])
    turned = simulator.scene.replace(motion=ds.Pose(lambda t: np.zeros(6)))
    with pytest.raises(ValueError, match="a motion by a Pose"):
        TorchSimulator(ds.ImplicitEulerSolver(turned))
