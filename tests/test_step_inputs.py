"""Inputs of single steps: a Simulator that is given rows has the states of a Rollout that is given the same."""

import numpy as np
import pytest

import diffsim_ti as ds

STEPS, DT = 4, 2e-3
MESH = ds.TetrahedralMesh.create_cube(2).with_surface_set("lid", lambda x, n: x[:, 0] > 0.9)
SOLVERS = [ds.SemiImplicitSolver, ds.VelocityVerletSolver, ds.ImplicitEulerSolver, ds.BDF2Solver, ds.StaticSolver]


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
    return kind(of, load_steps=1, dt=DT) if kind is ds.StaticSolver else kind(of, dt=DT, substeps=3)


@pytest.mark.parametrize("kind, precision", [(ds.SemiImplicitSolver, "f32"), (ds.ImplicitEulerSolver, "f64")])
@pytest.mark.parametrize("ramped", [False, True], ids=["held", "ramped"])
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
