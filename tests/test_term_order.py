"""The order of a scene's terms means nothing: the same bits of motion and of every gradient, compared term by term.

Two obstacles of one kind keep their order. Swapped, they agree to round-off, except where the friction of both acts on one
vertex in explicit steps: their frictions act one after the other, and what that splitting leaves falls with the substep.
"""

from functools import cache

import numpy as np
import pytest
import taichi as ti
import torch
from contact_scenes import SHAPES, tetrahedron
from kernel_sizes import traced_alone

import diffsim_ti as ds
from diffsim_ti.diff_physics import DifferentiableBarrierContact, DifferentiableMaterial
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver, rollout_frames
from diffsim_ti.terms import Obstacle, Term

EXPLICIT = (ds.SemiImplicitSolver, ds.VelocityVerletSolver)
IMPLICIT = (ds.ImplicitEulerSolver, ds.ImplicitMidpointSolver, ds.BDF2Solver)
SOLVERS = (*EXPLICIT, *IMPLICIT, ds.StaticSolver)
ORDERS = 6
ROUGH = dict(friction=0.3, friction_speed=20.0)  # so that it sticks, and friction_speed counts
MESH = ds.TetrahedralMesh.joined([tetrahedron(0.15), tetrahedron(0.7)])  # an apex 5 cm below a face


@cache
def crowd() -> dict[str, Term]:
    """Eight terms that all act: two rough obstacles on the same vertices, two half spaces, one obstacle that moves and is
    stiff per area."""
    rng, own, area = np.random.default_rng(0), dict(stiffness=300.0, width=0.2), dict(stiffness_per_area=2e3, width=0.2)
    return {
        "gravity": ds.Gravity(),
        "drag": ds.Drag(0.5),
        "force": ds.ExternalForce(rng.standard_normal((8, 3))),
        "pairs": ds.SelfContact(300.0, 0.1),
        "ground": SHAPES["ground"](**own, **ROUGH),
        "slope": SHAPES["half_space"](**own, **ROUGH),
        "wall": ds.HalfSpace([-0.1, 0, 0], [1, 0, 0], **own),
        "sphere": ds.Sphere([0.25, -0.8, 0.2], 0.85, **area, path=lambda t: [0.3 * t, 0.1 * np.sin(5 * t), -0.2 * t]),
    }


def orders(names, count=ORDERS, seed=0):
    """The names as they stand, backwards, and at random; of "slope" and "wall", two half spaces, always "slope" first."""
    names, rng = list(names), np.random.default_rng(seed)
    for k in range(count):
        order = names if k == 0 else names[::-1] if k == 1 else [str(name) for name in rng.permutation(names)]
        places = sorted(order.index(name) for name in ("slope", "wall") if name in order)
        order = list(order)
        for place, name in zip(places, ("slope", "wall")):
            order[place] = name
        yield order


def scene_of(order, static=False, precision="f64", terms=None, mesh=MESH) -> ds.Scene:
    terms = terms or crowd()
    return ds.Scene(
        mesh,
        ds.StableNeoHookean(2e4, 0.3),
        100.0,
        [terms[name] for name in order],
        precision=precision,
        fixed=[1, 2, 3, 5, 6, 7] if static else None,
        initial_velocities=[0.8, -1.0, 0.3],
    )


def rollout_of(
    order, solver, precision="f64", terms=None, mesh=MESH, dt=4e-3, steps=4, save_every=2, **options
) -> ds.Rollout:
    static = solver is ds.StaticSolver
    scene = scene_of(order, static, precision, terms, mesh)
    tolerance = {} if solver.explicit else dict(tolerance=1e-10 if precision == "f64" else 1e-5)
    made = solver(scene, dt=dt, **tolerance) if static else solver(scene, dt=dt, substeps=2, **tolerance)
    steps, save_every = (2, 1) if static else (steps, save_every)
    return ds.Rollout(made, steps, save_every, gradients="all", **options)


def by_term(scene, order, values: dict, terms=None) -> dict:
    """Numbers by input name, as numbers by (term, the term's own name) or by name where no term has it."""
    terms, out = terms or crowd(), dict(values)
    for name in order:
        for own, here in scene.input_names(terms[name]).items():
            if here in values:
                out[name, own] = out.pop(here)
    return out


def weights(shape) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((2, *shape))


def found(order, solver, terms=None, **options) -> dict:
    """Frames and gradients."""
    rollout = rollout_of(order, solver, terms=terms, **options)
    frames = rollout.forward()
    gradients = rollout.vjp(frames, *weights(frames.positions.shape))
    return dict(positions=frames.positions, velocities=frames.velocities) | by_term(
        rollout.scene, order, gradients, terms
    )


def assert_same_bits(ours: dict, theirs: dict, order) -> None:
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        np.testing.assert_array_equal(ours[name], value, err_msg=f"{name} in the order {', '.join(order)}")


@pytest.mark.parametrize(
    "solver, precision",
    [
        *((kind, "f64") for kind in SOLVERS),
        *(pytest.param(kind, "f32", marks=pytest.mark.thorough) for kind in SOLVERS),
    ],
    ids=lambda x: getattr(x, "__name__", x),
)
def test_any_order_gives_the_same_bits(solver, precision):
    first, *others = orders(crowd(), ORDERS if precision == "f64" else ORDERS // 3)
    expected = found(first, solver, precision=precision)
    for name, value in expected.items():
        assert np.any(value) or (solver is ds.StaticSolver and name == ("drag", "drag_rate")), name
    for order in others:
        assert_same_bits(found(order, solver, precision=precision), expected, order)


@pytest.mark.parametrize("solver", [ds.VelocityVerletSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_gradients_are_right_in_any_order(solver):
    """Not only the same."""
    order = ["slope", "drag", "ground", "gravity", "pairs", "wall", "force", "sphere"]
    rollout = rollout_of(order, solver)
    assert ds.dot_product_test(rollout) < (1e-12 if solver.explicit else 1e-9)
    if solver.explicit:
        names = [*rollout.scene.input_names(crowd()["wall"]).values(), "sphere_path", "rest_positions"]
        report = ds.check_gradients(rollout, inputs=names, verbose=False)
        assert all(row.relative_error < 1e-6 for row in report.rows), str(report)


def test_names_follow_the_list_as_written():
    """A second obstacle's numbers end in _2, whatever stands between, and `input_names` says whose they are."""
    for order in orders(crowd(), 3):
        scene, count = scene_of(order), 0
        for name in order:
            term = crowd()[name]
            if isinstance(term, Obstacle):
                count += 1
                expected = "barrier_width" + (f"_{count}" if count > 1 else "")
                assert scene.input_names(term)["barrier_width"] == expected
            for own, here in scene.input_names(term).items():
                if own in term.values:
                    np.testing.assert_array_equal(scene.inputs.values[here], term.values[own])


@pytest.mark.thorough
@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_tape(precision):
    """By a Taichi loss; gradients also in the fields of inputs."""
    expected = None
    for order in orders(crowd(), 2):
        rollout = rollout_of(order, ds.SemiImplicitSolver, precision)
        names = rollout.scene.input_names(crowd()["ground"])
        fields = {own: rollout.field(here) for own, here in names.items()}
        loss = ti.field(ti.f64 if precision == "f64" else ti.f32, shape=(), needs_grad=True)

        @ti.kernel
        def size(x: ti.template(), v: ti.template()):
            for f, i in x:
                loss[None] += x[f, i].norm_sqr() + v[f, i].norm_sqr()

        with ti.ad.Tape(loss):
            rollout.run()
            size(rollout.positions, rollout.velocities)
        got = by_term(rollout.scene, order, rollout.gradients)
        for own, field in fields.items():
            assert field.grad[None] == got["ground", own].astype(rollout.positions.to_numpy().dtype) != 0
        got |= dict(loss=np.array(loss[None]), positions=rollout.positions.to_numpy())
        expected = expected or got
        assert_same_bits(got, expected, order)


@pytest.mark.parametrize(
    "dtype", [torch.float64, pytest.param(torch.float32, marks=pytest.mark.thorough)], ids=["f64", "f32"]
)
def test_torch(dtype):
    """A simulator, whose own ground comes before the terms that it is given; tensors for every number of a term."""
    names, expected = ("drag", "sphere", "force", "slope", "pairs", "wall"), None
    for order in orders(names, 2):
        contact = DifferentiableBarrierContact(300.0, 0.2, ground_height=0.0)
        material = DifferentiableMaterial(E=torch.tensor(2e4, dtype=dtype), nu=torch.tensor(0.3, dtype=dtype))
        simulator = DifferentiableSimulator(
            MESH,
            material,
            DifferentiableSolver(dt=4e-3, substeps=8),
            100.0,
            contact=contact,
            terms=[crowd()[name] for name in order],
        )
        velocity = torch.tensor([[0.8, -1.0, 0.3]], dtype=dtype).expand(8, 3).clone().requires_grad_()
        simulator.reset(velocities=velocity)
        frames = simulator.rollout(4, save_every=2)
        w, z = (torch.from_numpy(x).to(dtype) for x in weights(frames.positions.shape))
        ((w * frames.positions).sum() + (z * frames.velocities).sum()).backward()
        got = dict(x=frames.positions.detach().numpy(), velocity=velocity.grad.numpy(), E=material.E.grad.numpy())

        core = simulator.last_rollout
        tensors = {
            name: torch.tensor(value, dtype=dtype, requires_grad=True)
            for name, value in core.values.items()
            if name not in ("initial_positions", "rest_positions")
        }
        frames = rollout_frames(core, **tensors)
        ((w * frames.positions).sum() + (z * frames.velocities).sum()).backward()
        by = {name: tensor.grad.numpy() for name, tensor in tensors.items()}
        got |= dict(v=frames.velocities.detach().numpy()) | by_term(core.scene, order, by)
        expected = expected or got
        assert got["ground_height"] != 0 and np.any(got["sphere", "sphere_path"]) and np.any(got["slope", "friction"])
        assert_same_bits(got, expected, order)


# ---- two of one kind ----------------------------------------------------------------------------------------------------


def swapped(solver, wall, substep=2e-3) -> tuple[float, float]:
    """Largest difference of positions by the way gone, and of a gradient by its size, with two rough half spaces swapped."""
    own = dict(stiffness=300.0, width=0.2)
    terms = {
        "gravity": ds.Gravity(),
        "slope": SHAPES["half_space"](**own, **ROUGH),
        "wall": ds.HalfSpace(*wall, **own, friction=0.4, friction_speed=2.0),
    }
    steps = round(32e-3 / (2 * substep))
    options = dict(terms=terms, mesh=tetrahedron(0.15), dt=2 * substep, steps=steps, save_every=steps)
    a, b = (found(order, solver, **options) for order in (["gravity", "slope", "wall"], ["wall", "slope", "gravity"]))
    assert np.any(a["slope", "friction"]) and np.any(a["wall", "friction"])
    way, apart = a["positions"][-1] - a["positions"][0], b["positions"] - a["positions"]
    gradients = [np.abs(b[n] - a[n]).max() / np.abs(a[n]).max() for n in a if n not in ("positions", "velocities")]
    return np.abs(apart).max() / np.abs(way).max(), max(gradients)


CEILING = [0, 0.8, 0], [0, -1, 0]  # acts on another vertex than the slope
CORNER = [-0.1, 0, 0], [1, 0.1, 0]  # by the same


@pytest.mark.parametrize(
    "solver, wall",
    [(ds.SemiImplicitSolver, CEILING), (ds.VelocityVerletSolver, CEILING), (ds.ImplicitEulerSolver, CORNER)],
    ids=["semi_implicit", "verlet", "implicit_euler"],
)
def test_two_of_one_kind_swapped(solver, wall):
    assert max(swapped(solver, wall)) < 1e-12


@pytest.mark.parametrize("solver", EXPLICIT, ids=lambda s: s.__name__)
def test_two_frictions_on_one_vertex_swapped(solver):
    """What the `Obstacle` docstring says: at 2 ms 7e-4 of the way and up to 12 % of a gradient, half of that at 1 ms."""
    (way, gradient), (half_way, half_gradient) = swapped(solver, CORNER), swapped(solver, CORNER, 1e-3)
    assert 1e-5 < way < 1e-3 and 1e-5 < gradient < 0.15
    assert 0.4 < half_way / way < 0.6 and half_gradient < 0.7 * gradient


def test_kernels_of_a_state_do_not_know_what_else_acts():
    """Energies, forces and distances of a law before a floor are the same kernels whatever else moves the body."""
    mesh, floor = (
        ds.TetrahedralMesh.create_box(2, 0.1).translated([0, 0.004, 0]),
        ds.Ground(stiffness=1e3, width=0.01, friction=0.3),
    )
    others = [], [ds.Gravity()], [ds.Drag(0.5), ds.Gravity(), ds.Muscle((0, 1, 0), 1e3, np.ones(3))]
    found = []
    for terms in others:
        scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[*terms, floor], precision="f64")
        solver = ds.ImplicitEulerSolver(scene, 1e-3)
        found.append(solver.workspace(solver.start_values()).potential.kernels)
    assert all(kernels is found[0] for kernels in found)


KEYS = [0, 1e-2], np.array([[0.0, 0, 0], [0, 1e-3, 0]])
ALONE = {
    "nothing": dict,
    "gravity": lambda: dict(terms=[ds.Gravity()]),
    "drag": lambda: dict(terms=[ds.Drag(1.0)]),
    "force": lambda: dict(terms=[ds.ExternalForce(np.ones((8, 3)))]),
    "forces by steps": lambda: dict(terms=[ds.ExternalForce(np.ones((2, 8, 3)))]),
    "pressures by steps": lambda: dict(terms=[ds.Pressure([10.0, 20.0], "xmax")]),
    "spring": lambda: dict(terms=[ds.Spring(0, 7, 10.0, rest_length=0.1)]),
    "cable": lambda: dict(terms=[ds.Cable([0, 7], tension=1.0)]),
    "muscle": lambda: dict(terms=[ds.Muscle((0, 1, 0), 1e3, 0.5)]),
    "foundation": lambda: dict(terms=[ds.ElasticFoundation(1e5, 1e4, "ymin")]),
    "fluid": lambda: dict(terms=[ds.SurfaceDrag(1000.0)], initial_velocities=(1.0, 0, 0)),
    "rotating frame": lambda: dict(terms=[ds.RotatingFrame((0, 3.0, 0))]),
    "self-contact": lambda: dict(terms=[ds.SelfContact(stiffness=10.0, width=1e-3)]),
    "floor": lambda: dict(terms=[ds.Ground(-0.005, stiffness=100.0, width=0.01, friction=0.2)]),
    "moving floor": lambda: dict(terms=[ds.Ground(-0.005, stiffness=100.0, width=0.01, path=KEYS)]),
    "clamp": lambda: dict(fixed="xmin"),
    "rollers": lambda: dict(fixed={"xmin": "x"}),
    "moving clamp": lambda: dict(fixed="xmin", motion=KEYS),
    "moving rollers": lambda: dict(fixed={"xmin": "x"}, motion=KEYS),
    "growth": lambda: dict(terms=[ds.Growth(([0, 1e-2], np.array([1.0, 1.1])))]),
}


def derivatives_alone(name) -> tuple[float, float]:
    """Of a scene with one thing, in a random direction, by the adjoint and by the tangent."""
    mesh = ds.TetrahedralMesh.create_cube(2, size=0.1)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e4, 0.3), **ALONE[name]())
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-3), 2, gradients="all")
    frames, rng = rollout.forward(), np.random.default_rng(0)
    w = rng.standard_normal(frames.positions.shape)
    gradients = rollout.vjp(frames, w)
    d = {key: rng.standard_normal(g.shape) for key, g in gradients.items()}
    return sum((gradients[key] * d[key]).sum() for key in d), (w * rollout.jvp(frames, **d)[0]).sum()


@pytest.mark.parametrize("name", ALONE)
def test_each_thing_alone(name):
    """Kernels get the arrays that a scene has something for: what a thing needs is there, when they are traced, without any
    other one."""
    found = {}
    with traced_alone(found):
        derivatives_alone(name)
    assert {"step", "step_vjp", "step_jvp"} <= {*found}


@pytest.mark.parametrize("name", ["nothing", "cable", "floor"])
def test_derivatives_of_some_of_them(name):
    by_adjoint, by_tangent = derivatives_alone(name)
    assert by_adjoint == pytest.approx(by_tangent, rel=1e-10)
