"""All loads, springs, chambers and an obstacle in one scene: what one of them writes is nowhere another's."""

import numpy as np
import pytest
from chamber_meshes import hollow_cube
from test_every_adjoint import assert_transposed
from test_term_order import SOLVERS

import diffsim_ti as ds
from diffsim_ti.monitor.stability import Stiffness

every = pytest.mark.parametrize("kind", SOLVERS, ids=lambda s: s.__name__)
STEPS = 2
ROUGH = dict(stiffness_per_area=1e5, width=0.03, friction=0.3, friction_speed=5.0)


def body() -> ds.TetrahedralMesh:
    mesh = hollow_cube()
    middle = mesh.vertices[mesh.surface_triangles].mean(1)
    return mesh.with_surface_set("top", middle[:, 2] > 0.29).with_surface_set("side", middle[:, 1] < 0.01)


BODY = body()
TOP = np.flatnonzero(BODY.vertices[:, 2] > 0.29)


def terms() -> dict[str, ds.terms.Term]:
    """Loads given in all ways: constant, for each step, by keyframes."""
    return {
        "weight": ds.Gravity([1.0, -2.0, -9.81]),
        "drag": ds.Drag(2.0),
        "wind": ds.Traction(lambda t: [40 + 1e3 * t, 5.0, 0.0], "side", name="wind"),
        "push": ds.Pressure(np.array([30.0, 45.0]), "top", name="push"),
        "pull": ds.BodyForce([50.0, 0, 0], name="pull"),
        "gas": ds.GasChamber(([0.0, 0.1], [1.05e5, 1.2e5]), "cavity", exponent=1.3, name="gas"),
        "strut": ds.Spring(
            TOP[:2], ds.Anchor([[0.5, 0.1, 0.6], [-0.2, 0.1, 0.5]]), [200.0, 90.0], tension=2.0, name="strut"
        ),
        "tie": ds.Spring([0.28, 0.2, 0.25], [0.02, 0.2, 0.22], 60.0, name="tie"),
        "tendon": ds.Cable(
            [int(TOP[2]), [0.15, 0.05, 0.27], ds.Anchor([0.4, 0.1, 0.6])], tension=lambda t: 3 + 20 * t, name="tendon"
        ),
        "rope": ds.Cable([int(TOP[3]), int(TOP[-1])], length=np.array([0.1, 0.12]), stiffness=80.0, name="rope"),
        "bed": ds.ElasticFoundation(2e4, 1e3, "top", name="bed"),
        # its friction_speed counts while the body sticks
        "wall": ds.HalfSpace([0.31, 0, 0], [-1, 0, 0], **ROUGH, name="wall"),
    }


def scene_of(order=None, leave=(), more=(), precision="f64", **options) -> ds.Scene:
    named = terms()
    listed = [*more, *(named[name] for name in (order or named) if name not in leave)]
    law = ds.StableNeoHookean(1e5 * np.random.default_rng(2).uniform(0.7, 1.3, BODY.num_tetrahedra), 0.3)
    moving = np.random.default_rng(6).standard_normal(BODY.vertices.shape)  # so that all springs act at once
    moving[BODY.vertex_sets["bottom"]] = 0
    given = dict(fixed="bottom", precision=precision, initial_velocities=moving)
    return ds.Scene(BODY, law, 1000.0, listed, **given | options)


def rollout_of(kind, scene=None, **options) -> ds.Rollout:
    scene = scene or scene_of()
    if kind.explicit:
        solver = kind(scene, dt=2e-4, substeps=2)
    elif kind is ds.StaticSolver:
        solver = kind(scene, tolerance=1e-12, dt=0.02)
    else:
        solver = kind(scene, dt=4e-3, substeps=2, tolerance=1e-12)
    return ds.Rollout(solver, STEPS, save_every=1, gradients="all", **options)


@every
def test_every_number_beside_all_others(kind):
    without = ("drag_rate",) if kind is ds.StaticSolver else ()
    assert_transposed(rollout_of(kind), 1e-12 if kind.explicit else 1e-8, without)


@pytest.mark.executed_ptx
@pytest.mark.parametrize(
    "kind, parallel, options",
    [
        (ds.VelocityVerletSolver, True, dict(volume="patches")),
        (ds.SemiImplicitSolver, False, dict(more=[ds.SelfContact(300.0, 0.01)])),
        (ds.ImplicitEulerSolver, True, dict(volume="patches", more=[ds.SelfContact(300.0, 0.01)])),
    ],
    ids=lambda x: getattr(x, "__name__", None),
)
def test_and_beside_patches_and_self_contact(kind, parallel, options):
    """Which have corners of their own, before those of springs, pressures and chambers."""
    exact = {} if kind.explicit else dict(tolerance=1e-12)
    solver = kind(scene_of(**options), dt=2e-4 if kind.explicit else 4e-3, substeps=2, parallel=parallel, **exact)
    rollout = ds.Rollout(solver, STEPS, save_every=1, gradients="all")
    assert ds.dot_product_test(rollout) < (1e-12 if kind.explicit else 1e-8)


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_gradients_are_those_of_differences(kind):
    """Of every input that has some: slips in one term's place in an array would be another's gradient."""
    rollout = rollout_of(kind)
    frames, rng = rollout.forward(), np.random.default_rng(3)
    w = rng.standard_normal(frames.positions.shape)
    gradients = rollout.vjp(frames, positions=w)
    for name in rollout.inputs:
        base = rollout.values[name]
        d = rng.standard_normal(base.shape) * ds.verify.input_scale(rollout, name)
        if name.startswith("initial_"):
            d = rollout.scene.supports.free(d)
        off, got = [], float((gradients[name] * d).sum())
        for s in (1e-3, 1e-4, 1e-5):  # some numbers do little in two steps, friction has kinks of second order
            one, other = (rollout.forward(**{name: base + t * d}).displacements for t in (s, -s))  # which keep digits
            dx = (one - other) / (2 * s) + (d if name == "rest_positions" else 0)
            found, size = (w * dx).sum(), np.linalg.norm(w * dx)
            off.append(abs(found - got) / size)
            if off[-1] < 2e-5:
                break
        assert min(off) < 2e-5, (name, off)


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_any_order_gives_the_same_bits(kind):
    names, rng = list(terms()), np.random.default_rng(4)
    results = []
    for order in (names, names[::-1], [str(n) for n in rng.permutation(names)]):
        # two of a kind keep their order
        for pair in (("strut", "tie"), ("tendon", "rope")):
            places = sorted(order.index(name) for name in pair)
            order = list(order)
            order[places[0]], order[places[1]] = pair
        rollout = rollout_of(kind, scene_of(order))
        frames = rollout.forward()
        results.append(dict(frames=frames.positions, **rollout.vjp(frames, np.ones(frames.positions.shape))))
    for other in results[1:]:
        for name, array in results[0].items():
            np.testing.assert_array_equal(array, other[name], err_msg=name)


def test_forces_balance():
    """In an equilibrium what holds the bottom, the weight, all loads, springs and the wall add up to zero."""
    scene = scene_of()
    outputs = [ds.Reaction("bottom"), ds.ContactForce("wall", name="wall", per_vertex=True)]
    frames = rollout_of(ds.StaticSolver, scene, outputs=outputs).forward()
    from diffsim_ti.outputs.forces_at_frames import AppliedLoads

    free = np.delete(
        np.arange(BODY.num_vertices), scene.fixed
    )  # what the wall does to others, their support takes up unseen
    derived = scene.inputs.derive(scene.inputs.at_times([0.0, 0.02, 0.04]))
    for k in (1, 2):
        given = AppliedLoads(scene).forces(derived, frames.positions[k], int(frames.steps[k])).sum(0)
        size = np.abs(given).sum()
        assert np.abs(frames["reaction"][k] + given + frames["wall"][k][free].sum(0)).max() < 1e-7 * size


def test_work_is_what_energies_gain():
    """Of all loads, springs and gas, without what only takes; second order in the time between frames."""
    errors = []
    for steps in (10, 20, 40):
        scene = scene_of(leave=("drag", "wall", "push", "rope"))  # given for two steps
        solver = ds.VelocityVerletSolver(scene, dt=4e-3 / steps)
        outputs = [ds.WorkOfLoads(weight=True), ds.KineticEnergy(), ds.ElasticEnergy()]
        frames = ds.Rollout(solver, steps, save_every=1, outputs=outputs).forward()
        gained = frames["kinetic_energy"] + frames["elastic_energy"]
        errors.append(abs(gained[-1] - gained[0] - frames["work"][-1]) / abs(frames["work"][-1]))
    assert errors[-1] < 0.02 and errors[0] / errors[1] > 3 and errors[1] / errors[2] > 3, errors


def test_the_stable_step_knows_them_together():
    """The products that bound it are those of differences of forces, of all but pressures, which do not count in it."""
    scene = scene_of(leave=("push", "wall", "drag"))
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-4), 1)
    rollout.forward()
    workspace, rng = rollout.sweep.workspace, np.random.default_rng(5)
    stiffness = Stiffness(workspace)
    u = ds.runtime.fetch_row(workspace.state.u, 0)
    d = rng.standard_normal(u.shape)
    d[scene.fixed] = 0
    forces = []
    for t in (1e-7, -1e-7):
        ds.runtime.fill(workspace.state.u, (u + t * d)[None])
        forces.append(workspace.forces_at(0, 1))
    ds.runtime.fill(workspace.state.u, u[None])
    root = stiffness.root
    expected = -root * (forces[0] - forces[1]) / 2e-7
    got = stiffness.product(d / np.where(root > 0, root, 1.0))
    free = np.delete(np.arange(len(u)), scene.fixed)
    np.testing.assert_allclose(got[free], expected[free], atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize(
    "kind", [ds.SemiImplicitSolver, ds.ImplicitEulerSolver, ds.StaticSolver], ids=lambda s: s.__name__
)
def test_a_simulator_takes_the_steps_of_a_rollout(kind):
    rollout = rollout_of(kind)
    frames, simulator = rollout.forward(), ds.Simulator(rollout.solver)
    for k in (1, 2):
        simulator.step()
        if kind is not ds.StaticSolver or k == 1:
            np.testing.assert_array_equal(simulator.positions, frames.positions[k])
