"""Many scenes at once: each is, bit for bit, the scene alone; gradients, tangents, scenes that die, tensors."""

import pickle
import warnings

import numpy as np
import pytest
import torch
from gradient_fuzz.loads import load, over_time
from gradient_fuzz.ties import tie

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.batch.joined_newton import JoinedNewton
from diffsim_ti.batch.joined_scene import JoinedArrays
from diffsim_ti.batch.joined_workspace import JoinedSweep
from diffsim_ti.diff_simulator import rollout_frames
from diffsim_ti.runtime import Piecewise
from diffsim_ti.solvers.implicit.preconditioners import Preconditioner
from diffsim_ti.solvers.implicit.rounds import Rounds

MESH = ds.TetrahedralMesh.create_box(3, 0.1)
LOW = MESH.vertices[:, 1].min()
HOW = "constant", "per step", "keyed"
EXPLICIT = ds.SemiImplicitSolver, ds.VelocityVerletSolver
ROUND_OFF = {"f32": 2e-6, "f64": 1e-13}  # of sums, in another order


def floor(friction: float = 0.3) -> ds.Ground:
    return ds.Ground(LOW - 0.008, friction=friction, stiffness_per_area=2e5, width=0.01)


def drawn(seed: int) -> tuple[ds.Batch, dict]:
    """A random batch and values of its inputs, some of which scenes have of their own."""
    rng = np.random.default_rng(seed)
    precision, steps, B = ("f32", "f64")[seed % 2], int(rng.integers(2, 6)), int(rng.choice([1, 3, 8, 11]))
    few = lambda share: rng.random() < share  # noqa: E731
    terms, own = [], {}
    if few(0.7):
        terms.append(ds.Gravity(-9.8))
        own["gravity"] = 5 * rng.normal(size=(B, 3))
    if few(0.6):
        terms.append(ds.Drag(0.5))
        own["drag_rate"] = rng.uniform(0, 3, B)
    if few(0.5):
        rows = (steps, len(MESH.vertices), 3) if few(0.5) else (len(MESH.vertices), 3)
        terms.append(ds.ExternalForce(0.05 * rng.normal(size=rows)))
        own["external_forces"] = 0.05 * rng.normal(size=(B, *rows))
    wall = rng.integers(4)
    if wall == 1:
        terms.append(floor())
        own["friction"] = rng.uniform(0, 0.5, B)
    if wall == 2:
        turns = few(0.5)
        push = lambda t: np.array([0.0, 0.3 * t, 0.2 * t] + [0.0, 0.0, 0.5 * t] * turns)  # noqa: E731
        terms.append(
            ds.HalfSpace((0, LOW - 0.008, 0), (0.1, 1, 0), path=push, friction=0.2, stiffness_per_area=2e5, width=0.01)
        )
        own["half_space_point"] = [0, LOW - 0.008, 0] + 1e-3 * rng.normal(size=(B, 3))
    if wall == 3:
        terms.append(ds.Sphere((0.05, 0.05, 0.05), 0.12, inside=True, stiffness_per_area=2e5, width=0.01))
        own["sphere_radius"] = rng.uniform(0.115, 0.125, B)
    held = rng.integers(3)
    options = [{}, dict(fixed={"xmin": "xyz"}), dict(fixed={"xmin": "x"})][held]
    if held and few(0.5):
        options["motion"] = lambda t: np.array([0.1 * t, 0.0, 0.0])
        if few(0.5):
            own["prescribed_motion"] = None
    law = (ds.StableNeoHookean, ds.LinearElastic, ds.SmithNeoHookean, ds.StVenantKirchhoff)[rng.integers(4)]
    scene = ds.Scene(MESH, law(2e4, 0.3), 1000.0, terms=terms, precision=precision, **options)
    solver = EXPLICIT[rng.integers(2)](scene, dt=2e-3, substeps=int(rng.integers(2, 6)))
    more = dict(save_every=1 if few(0.5) else None, memory=0.3 * B if few(0.4) else None)
    more["outputs"] = [ds.ContactForce(term, per_vertex=True) for term in scene.obstacles]
    batch = ds.Batch(solver, steps, B, gradients="all", lanes=True, **more)
    own["youngs_modulus"] = rng.uniform(1e4, 3e4, (B,) if few(0.6) else (B, MESH.num_tetrahedra))
    own["density"] = rng.uniform(800, 1200, B)
    own["rest_positions"] = MESH.vertices + 1e-3 * rng.normal(size=(B, *MESH.vertices.shape))
    known = batch.one.sweep.values
    if "prescribed_motion" in own:
        own["prescribed_motion"] = np.stack([known["prescribed_motion"] * k for k in rng.uniform(0.5, 2, B)])
    out = {name: x for name, x in own.items() if name in batch.inputs and few(0.6)}
    return batch, out | {"initial_velocities": 0.1 * rng.normal(size=(B, *MESH.vertices.shape)) + [0, -1, 0]}


@pytest.mark.parametrize("seed", [*range(6), *(pytest.param(k, marks=pytest.mark.thorough) for k in range(6, 60))])
def test_scenes_are_bit_for_bit_those_alone(seed):
    batch, own = drawn(seed)
    check(batch, own, np.random.default_rng(100 + seed), seed % 3 == 0)


ACTING = (
    *("Spring within", "Spring anchored", "ElasticFoundation one", "ElasticFoundation each"),
    *(f"{what} {how}" for what in ("Cable tension", "Cable length", "Pressure", "BodyForce") for how in HOW),
    *(f"{what} {how}" for what in ("Muscle", "Growth") for how in HOW),
    "SurfaceDrag",
    "RotatingFrame",
)


def acting(name: str, rng, steps: int, dt: float):
    """A term that acts on a body of MESH besides tetrahedra, of random numbers."""
    kind, how = name.split(" ")[0], name.split(" ", 1)[-1]
    if kind == "RotatingFrame":
        return ds.RotatingFrame(rng.normal(size=3), rng.normal(size=3))
    if kind == "SurfaceDrag":
        return ds.SurfaceDrag(
            500.0, normal=2.0, tangential=0.1, stream=rng.normal(size=3), surface=("xmax", None)[rng.integers(2)]
        )
    if kind in ("Pressure", "BodyForce"):
        return load(name, rng, MESH, steps, steps * dt, 1.0)
    some = np.sort(rng.permutation(MESH.num_tetrahedra)[:40])
    if kind == "Growth":
        return ds.Growth(over_time(rng, steps, steps * dt, how)(0.02), (None, some)[rng.integers(2)])
    if kind != "Muscle":
        return tie(name, rng, MESH, steps, steps * dt, np.full(len(MESH.vertices), 0.01), dt)
    return ds.Muscle(rng.normal(size=(40, 3)), 5e3, over_time(rng, steps, steps * dt, how)(1.0), some)


@pytest.mark.parametrize("seed", [*range(5), *(pytest.param(k, marks=pytest.mark.thorough) for k in range(5, 60))])
def test_what_acts_on_bodies(seed):
    """Springs, cables, muscles, foundations, pressures, fluids, growth, forces over time, some of them, side by side."""
    rng = np.random.default_rng([1, seed])
    steps, B, dt = int(rng.integers(2, 5)), int(rng.choice([5, 9, 11])), 1e-3
    names = rng.choice(ACTING, rng.integers(1, 5))
    if seed < 5:  # all come
        names = np.random.default_rng(0).permutation(ACTING)[5 * seed :][:5]
    terms = [acting(name, rng, steps, dt) for name in names]
    terms += [floor()] if seed % 3 == 0 else []
    scene = ds.Scene(MESH, ELASTIC, 1000.0, terms=[ds.Gravity(-9.8), *terms], precision=("f64", "f32")[seed % 2])
    solver = EXPLICIT[seed % 2](scene, dt=dt, substeps=int(rng.integers(2, 5)))
    if seed % 3 == 1:  # unequal steps
        steps = ds.UnequalSteps(dt * rng.uniform(0.6, 1.2, steps), rng.integers(2, 5, steps))
    batch = ds.Batch(solver, steps, B, gradients="all", lanes=True, memory=(None, 0.1 * B)[seed % 2])
    own = {name: x * rng.uniform(0.9, 1.1, (B, *x.shape)) for name, x in batch.one.values.items() if rng.random() < 0.6}
    own = {name: x for name, x in own.items() if name not in ("rest_positions", "initial_positions", "poissons_ratio")}
    if rng.random() < 0.5:
        own["rest_positions"] = MESH.vertices + 1e-3 * rng.normal(size=(B, *MESH.vertices.shape))
    own["initial_velocities"] = 0.1 * rng.normal(size=(B, *MESH.vertices.shape))
    check(batch, own, rng, True)


ELASTIC = ds.StableNeoHookean(2e4, 0.3)


def test_a_pressure_without_gradients_of_the_rest_shape():
    """Its adjoints of places are there only where the rest shape's are asked for."""
    solver = ds.SemiImplicitSolver(
        ds.Scene(MESH, ELASTIC, 1000.0, terms=[ds.Pressure(300.0)], precision="f64"), dt=1e-3
    )
    batch, alone = ds.Batch(solver, 2, 3, lanes=True), ds.Rollout(solver, 2)
    frames, frame = batch.forward(pressure=np.array([300.0, 200.0, 100.0])), alone.forward()
    seed = np.random.default_rng(3).normal(size=frames.displacements.shape)
    by, by_alone = batch.vjp(frames, seed)["pressure"], alone.vjp(frame, seed[0])["pressure"]
    np.testing.assert_allclose(by[0], by_alone, rtol=1e-12)


@pytest.mark.parametrize(
    "material, order, solver",
    [
        (ds.KelvinVoigt(ELASTIC, time=1e-3), 1, ds.VelocityVerletSolver),
        pytest.param(  # in single precision: test_backends
            ds.Prony(ELASTIC, [0.3, 0.2], [1e-2, 1e-1]), 1, ds.SemiImplicitSolver, marks=pytest.mark.thorough
        ),
        pytest.param(ELASTIC, 2, ds.SemiImplicitSolver, marks=pytest.mark.thorough),  # compiles for ten seconds
    ],
    ids=["viscous", "relaxing", "ten nodes"],
)
def test_other_matter(material, order, solver):
    mesh = MESH if order == 1 else ds.TetrahedralMesh.create_box(2, 0.1).quadratic()
    terms = [ds.Gravity(-9.8), ds.Drag(0.4), floor()]
    scene = ds.Scene(mesh, material, 1000.0, terms=terms, precision="f64")
    batch = ds.Batch(solver(scene, dt=1e-3, substeps=4), 3, 3, gradients="all", lanes=True)
    rng = np.random.default_rng(0)
    own = dict(density=rng.uniform(800, 1200, 3), drag_rate=rng.uniform(0.1, 0.5, 3))
    own["initial_velocities"] = 0.3 * rng.normal(size=(3, mesh.num_vertices, 3)) + [0, -1, 0]
    check(batch, own, rng, True)


@pytest.mark.parametrize(
    "order, precision, law",
    [
        (1, "f64", ds.StableNeoHookean),
        pytest.param(1, "f32", ds.SmithNeoHookean, marks=pytest.mark.thorough),
        pytest.param(2, "f64", ds.StableNeoHookean, marks=pytest.mark.thorough),
    ],
)
def test_patches(order, precision, law):
    """Sums over patches, whose places repeat some tetrahedra: linear ones, or of ten nodes, patches by themselves."""
    mesh = MESH if order == 1 else ds.TetrahedralMesh.create_box(2, 0.1).quadratic()
    terms = [ds.Gravity(-9.8), ds.Muscle((0, 1, 0), 2e3, 1.0), floor()]
    scene = ds.Scene(mesh, law(2e4, 0.45), 1000.0, terms=terms, precision=precision, volume="patches")
    batch = ds.Batch(ds.SemiImplicitSolver(scene, dt=5e-4, substeps=3), 2, 3, gradients="all", lanes=True)
    rng, shape = np.random.default_rng(0), (3, *mesh.vertices.shape)
    own = dict(poissons_ratio=rng.uniform(0.4, 0.48, 3), activation=rng.uniform(0.5, 1.5, 3))
    own |= dict(youngs_modulus=rng.uniform(1e4, 3e4, (3, mesh.num_tetrahedra)))
    own |= dict(rest_positions=mesh.vertices + 1e-3 * rng.normal(size=shape))
    own |= dict(initial_velocities=0.3 * rng.normal(size=shape) + [0, -1, 0])
    check(batch, own, rng, True)


def push(t):
    return np.array([0.0, 0.3 * t, 0.2 * t])


@pytest.mark.backends
@pytest.mark.parametrize("law", ["elastic", "relaxing"])
def test_backends(law):
    """Scenes side by side, in lanes or innermost, with what kernels of a vertex have; float32, which Vulkan has alone.

    Given forces are in other tests, and contact forces are not asked for on Vulkan: with them a tangent takes more arrays
    than lavapipe lends a kernel, 32.
    """
    wall = ds.HalfSpace((0, LOW - 0.008, 0), (0.1, 1, 0), path=push, friction=0.2, stiffness_per_area=2e5, width=0.01)
    elastic = law == "elastic"
    terms = [ds.Gravity(-9.8), ds.Drag(0.5), *([wall] if elastic else [])]
    material = ELASTIC if elastic else ds.Prony(ELASTIC, [0.3, 0.2], [1e-2, 1e-1])
    held = dict(fixed={"xmin": "x", "xmax": "xyz"}, motion=lambda t: np.array([0.1 * t, 0.0, 0.0])) if elastic else {}
    scene = ds.Scene(MESH, material, 1000.0, terms=terms, precision="f32", **held)
    obstacles = () if runtime.arch_name() == "vulkan" else scene.obstacles
    outputs = [ds.ContactForce(term, per_vertex=True) for term in obstacles]
    solver = ds.VelocityVerletSolver(scene, dt=2e-3, substeps=4)
    batch = ds.Batch(solver, 3, 5, gradients="all", lanes=True, outputs=outputs)
    rng = np.random.default_rng(0)
    own = dict(youngs_modulus=rng.uniform(1e4, 3e4, 5), drag_rate=rng.uniform(0.1, 1, 5))
    own["initial_velocities"] = 0.1 * rng.normal(size=(5, MESH.num_vertices, 3)) + [0, -1, 0]
    if elastic:
        own["friction"] = rng.uniform(0.1, 0.4, 5)
        own["rest_positions"] = MESH.vertices + 1e-3 * rng.normal(size=(5, *MESH.vertices.shape))
    check(batch, own, rng, True)


def check(batch, own, rng, tangents: bool):
    B = batch.num_scenes
    frames = batch.forward(**own)
    assert frames.alive.all()
    seeds = dict(positions=rng.normal(size=frames.positions.shape))
    seeds |= {name: 0.01 * rng.normal(size=frames[name].shape) for name in batch.outputs if name != "positions"}
    gradients, total = batch.vjp(frames, **seeds), {}
    for name, again in batch.vjp(frames, **seeds).items():
        np.testing.assert_array_equal(gradients[name], again, err_msg=name)
    for b in range(B):
        alone = batch.one.forward(**{name: x[b] for name, x in own.items()})
        np.testing.assert_array_equal(frames.displacements[b], alone.displacements)
        for name in seeds:
            np.testing.assert_array_equal(frames[name][b], alone[name], err_msg=name)
        assert str(frames.contact_resolution[b]) == str(alone.contact_resolution)
        for name, by in batch.one.vjp(alone, **{name: x[b] for name, x in seeds.items()}).items():
            if name not in own:
                total[name] = total.get(name, 0) + by
                continue
            bound = ROUND_OFF[batch.scene.precision] * (100 if name == "drag_rate" else 1)  # a sum whose parts cancel
            np.testing.assert_allclose(gradients[name][b], by, rtol=bound, atol=bound * np.abs(by).max(), err_msg=name)
    for name, by in total.items():
        bound = ROUND_OFF[batch.scene.precision] * max(np.abs(by).max(), 1e-300)
        np.testing.assert_allclose(gradients[name], by, rtol=0, atol=bound, err_msg=name)
    if tangents:
        _check_dot_product(batch, frames, own, seeds, gradients, rng)


def _check_dot_product(batch, frames, own, seeds, gradients, rng):
    """Tangents along all inputs, those that scenes share too, against gradients."""
    along = {name: 0.1 * np.abs(x) * rng.normal(size=x.shape) for name, x in own.items()}
    for name in set(batch.inputs) - set(own):
        value = batch.one.sweep.values[name]
        along[name] = 0.01 * np.abs(value) * rng.normal(size=value.shape)
    changes = batch.tangents(frames, **along)
    parts = [(changes[name] * seed).ravel() for name, seed in seeds.items()]
    there = sum(part.sum() for part in parts)
    here = sum((gradients[name] * dot).sum() for name, dot in along.items())
    size = sum(np.abs(part).sum() for part in parts) + sum(np.abs(gradients[n] * dot).sum() for n, dot in along.items())
    assert abs(there - here) <= {"f32": 1e-5, "f64": 1e-13}[batch.scene.precision] * size


def simple(B: int, precision="f64", **options) -> ds.Batch:
    scene = ds.Scene(MESH, ds.StableNeoHookean(2e4, 0.3), 1000.0, terms=[ds.Gravity(-9.8)], precision=precision)
    return ds.Batch(ds.SemiImplicitSolver(scene, dt=2e-3, substeps=4), 4, B, save_every=2, **options)


def test_neighbours_and_places_do_not_matter():
    E = np.random.default_rng(0).uniform(1e4, 3e4, 11)
    all_of_them = simple(11).forward(youngs_modulus=E).positions
    some = [7, 2, 9]
    np.testing.assert_array_equal(simple(3).forward(youngs_modulus=E[some]).positions, all_of_them[some])


@pytest.mark.parametrize("lanes", [None, False], ids=["lanes", "by turns"])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_scenes_fail_alone(lanes):
    E = np.array([2e4, 2e4, 5e9, 2e4, 1e4])  # the third is far beyond its stable step
    batch = simple(5, lanes=lanes)
    speed = 0.1 * np.random.default_rng(0).normal(size=MESH.vertices.shape)
    frames = batch.forward(youngs_modulus=E, initial_velocities=speed)
    good = simple(4).forward(youngs_modulus=np.delete(E, 2), initial_velocities=speed)
    np.testing.assert_array_equal(frames.alive, [True, True, False, True, True])
    np.testing.assert_array_equal(np.delete(frames.positions, 2, 0), good.positions)
    assert np.isfinite(frames.positions).all()
    last = frames.last_good[2]
    np.testing.assert_array_equal(frames.positions[2, last:], np.repeat(frames.positions[2, last][None], 3 - last, 0))
    assert isinstance(frames.error(2), ds.Divergence) and frames.error(0) is None
    with pytest.raises(ds.Divergence, match="stable step"):
        batch.forward(youngs_modulus=E, initial_velocities=speed, raise_errors=True)
    with pytest.warns(UserWarning, match=r"scenes \[2\] did not come to their end"):
        gradient = batch.vjp(frames, np.ones_like(frames.positions))["youngs_modulus"]
    by_good = simple(4).vjp(good, np.ones_like(good.positions))["youngs_modulus"]
    assert gradient[2] == 0
    np.testing.assert_array_equal(np.delete(gradient, 2), by_good)


def test_a_scene_that_crosses_an_obstacle_fails_alone():
    scene = ds.Scene(
        MESH, ds.StableNeoHookean(2e4, 0.3), 1000.0, terms=[ds.Ground(LOW - 0.05, stiffness=10.0, width=0.01)]
    )
    batch = ds.Batch(ds.SemiImplicitSolver(scene, dt=1e-3), 30, 3, save_every=5, lanes=True)
    speed = np.zeros((3, *MESH.vertices.shape))
    speed[:, :, 1] = np.array([-0.1, -20.0, 0.1])[:, None]
    frames = batch.forward(initial_velocities=speed)
    np.testing.assert_array_equal(frames.alive, [True, False, True])
    assert isinstance(frames.error(1), ds.Crossing)
    heights = frames.positions[1, :, :, 1].min(1)
    assert (heights > LOW - 0.05).all()


GIVEN = dict(  # over time: terms and options of a scene
    path=(lambda: [], {}),
    pose=(
        lambda: [ds.HalfSpace((0, -9.0, 0), (0, 1, 0), path=lambda t: (0, t, 0, 0, 0, t), stiffness=1e3, width=0.01)],
        {},
    ),
    load=(
        lambda: [
            ds.Traction(lambda t: (10 * t, 0, 0), "ymax"),
            ds.ExternalForce(np.full((8, len(MESH.vertices), 3), 1e-3)),
        ],
        {},
    ),
    muscle=(lambda: [ds.Muscle((0, 1, 0), 1e3, np.linspace(0, 1, 8))], {}),
    motion=(lambda: [], dict(fixed="xmin", motion=lambda t: (0, 0.01 * t, 0))),
)
BY_TURNS = ds.BDF2Solver, ds.VelocityVerletSolver, ds.ImplicitMidpointSolver, ds.SemiImplicitSolver


@pytest.mark.parametrize(
    "given, solver",
    [
        ("path load muscle motion", ds.BDF2Solver),
        *(pytest.param(given, solver, marks=pytest.mark.thorough) for given in GIVEN for solver in BY_TURNS),
    ],
)
def test_a_scene_by_turns_fails_alone_whatever_is_given_over_time(given, solver):
    """The first and the last fly into the floor, far too fast, after a while."""
    path = (lambda t: (0, t, 0)) if "path" in given else None
    terms, options = [ds.Ground(-10.0, stiffness_per_area=1e4, width=0.01, path=path, name="floor")], {}
    for name in given.split():
        terms, options = terms + GIVEN[name][0](), options | GIVEN[name][1]
    scene = ds.Scene(MESH, ELASTIC, 1000.0, terms=terms, precision="f64", **options)
    solver = solver(scene, dt=1e-3) if solver.explicit else solver(scene, dt=1e-3, max_iterations=12)
    outputs, rng = [ds.ContactForce("floor")], np.random.default_rng(0)
    batch = ds.Batch(solver, 8, 4, save_every=2, outputs=outputs, lanes=False)
    speed = 0.1 * rng.normal(size=(4, *MESH.vertices.shape))
    speed[[0, 3]] = 0, -4000, 0
    own = {name: x * rng.uniform(0.9, 1.1, (4, *x.shape)) for name, x in batch.one.values.items() if x.ndim == 3}
    own["initial_velocities"] = speed
    frames = batch.forward(**own)
    np.testing.assert_array_equal(frames.alive, [False, True, True, False])
    for b in (0, 3):
        last = frames.last_good[b]
        assert last > 0 and isinstance(frames.error(b), FloatingPointError)
        np.testing.assert_array_equal(frames.positions[b, last:], frames.positions[[b], last].repeat(5 - last, 0))
    seed = rng.normal(size=frames.positions.shape)
    with pytest.warns(UserWarning, match=r"scenes \[0, 3\] did not come to their end: their gradients are zero"):
        gradients = batch.vjp(frames, seed)
    with pytest.warns(UserWarning, match="their changes are zero") as said:
        changes = batch.tangents(frames, initial_velocities=speed)
    assert said[0].filename == __file__
    total = {}
    for b in (1, 2):
        alone = batch.one.forward(**{name: x[b] for name, x in own.items()})
        np.testing.assert_array_equal(alone.positions, frames.positions[b])
        for name, gradient in batch.one.vjp(alone, seed[b]).items():
            total[name] = total.get(name, 0) + gradient
            if name in own:
                np.testing.assert_array_equal(gradients[name][b], gradient, err_msg=name)
        for name, change in batch.one.tangents(alone, initial_velocities=speed[b]).items():
            np.testing.assert_array_equal(changes[name][b], change, err_msg=name)
    for name, gradient in gradients.items():
        if name in own:
            assert not gradient[[0, 3]].any(), name
        else:
            np.testing.assert_allclose(gradient, total[name], rtol=0, atol=1e-13 * np.abs(gradient).max(), err_msg=name)
    assert not any(change[[0, 3]].any() for change in changes.values())


def test_scenes_that_are_refused_are_named():
    batch = ds.Batch(ds.ImplicitEulerSolver(simple(1).scene, dt=1e-3), 2, 2)
    inside_out = np.stack([MESH.vertices, -MESH.vertices])
    with pytest.raises(ValueError, match="^scene 1: "):
        batch.forward(rest_positions=inside_out)


@pytest.mark.parametrize("lanes", [None, False], ids=["lanes", "by turns"])
def test_outputs_of_all_scenes(lanes):
    points = MESH.vertices[:4] * 0.9 + 0.005
    batch = simple(3, outputs=[ds.MaterialPoints(points), ds.ElasticEnergy()], lanes=lanes)  # the latter reads E itself
    frames = batch.forward(youngs_modulus=[1e4, 2e4, 3e4], initial_positions=MESH.vertices * [1.1, 1, 1])
    assert frames["material_points"].shape == (3, 3, 4, 3)
    along = dict(youngs_modulus=np.array([3e3, 1e3, 2e3]))
    changes = batch.tangents(frames, **along)
    for name, values in frames.outputs.items():
        seed = np.random.default_rng(0).normal(size=values.shape)
        gradient = batch.vjp(frames, **{name: seed})["youngs_modulus"]
        assert (changes[name] * seed).sum() == pytest.approx(gradient @ along["youngs_modulus"], rel=1e-10)


def test_a_scene_whose_adjoint_is_not_solved_has_its_gradient_alone(monkeypatch):
    solver = ds.ImplicitEulerSolver(simple(1).scene, dt=5e-3, tolerance=1e-11)
    batch = ds.Batch(solver, 1, 3, outputs=[ds.ElasticEnergy()], gradients="youngs_modulus", lanes=True)
    frames = batch.forward(youngs_modulus=[1e4, 2e4, 3e4], initial_positions=MESH.vertices * [1.1, 1, 1])
    seed = np.ones((3, 2))
    together = batch.vjp(frames, elastic_energy=seed)["youngs_modulus"]
    monkeypatch.setattr(JoinedSweep, "left", [1])
    np.testing.assert_allclose(batch.vjp(frames, elastic_energy=seed)["youngs_modulus"], together, rtol=1e-8)


def test_scenes_by_turns_where_lanes_do_not_serve():
    solver = ds.ImplicitEulerSolver(simple(1).scene.replace(terms=[ds.SelfContact()]), dt=5e-3)
    with pytest.raises(ValueError, match="side by side: it has self contact; leave out lanes=True"):
        ds.Batch(solver, 2, 3, lanes=True)
    batch = ds.Batch(solver, 2, 3)
    assert not batch.lanes and batch.why_not in repr(batch)
    batch = ds.Batch(simple(1).solver, 2, 3, lanes=False)
    E = np.array([1e4, 2e4, 3e4])
    frames = batch.forward(youngs_modulus=E)
    seed = np.random.default_rng(0).normal(size=frames.positions.shape)
    gradients = batch.vjp(frames, seed)
    for b in range(3):
        alone = batch.one.forward(youngs_modulus=E[b])
        np.testing.assert_array_equal(alone.positions, frames.positions[b])
        assert gradients["youngs_modulus"][b] == batch.one.vjp(alone, seed[b])["youngs_modulus"]


SLAP = np.zeros((3, len(MESH.vertices), 3))
SLAP[1, :, 1] = -3000.0  # [m/s], in one scene of three


def implicit(kind: str, **options) -> tuple[ds.Batch, dict]:
    """A batch of implicit or static scenes, and numbers that they have of their own."""
    law, own = ds.StableNeoHookean(1e5, 0.3), dict(youngs_modulus=[6e4, 1e5, 1.7e5])
    exact = dict(tolerance=1e-9)
    if kind in ("Euler", "as on a card", "midpoint", "slapped", "on a floor at rest"):
        floor = ds.Ground(LOW - 1e-3, friction=0.4, path=None if "rest" in kind else lambda t: (t, 0.1 * t, 0))
        scene = ds.Scene(MESH, law, terms=[ds.Gravity(), floor], precision="f64")
        options["outputs"] = [ds.ContactForce(floor, per_vertex=True)]
        start = np.broadcast_to([0.3, -0.3, 0.0], SLAP.shape) if kind != "slapped" else SLAP
        own |= dict(
            friction=[0.1, 0.4, 0.0], ground_height=LOW - np.array([1e-3, 2e-3, 5e-4]), initial_velocities=start
        )
        own |= dict(gravity=[[0, -9.8, 0], [1, -5, 0], [0, -12, 1]])
        midpoint, euler = (
            ds.ImplicitMidpointSolver(scene, dt=0.001, **exact),
            ds.ImplicitEulerSolver(scene, dt=0.005, **exact),
        )
        return ds.Batch(midpoint if kind == "midpoint" else euler, 4, 3, gradients="all", **options), own
    pull = ds.Traction(lambda t: (100 * t, 0, 300 * np.cos(30 * t)), surface="ymax")
    muscle = ds.Muscle(fibre=(0, 1, 0), stress=2e4, activation=0.5)
    scene = ds.Scene(MESH, law, terms=[ds.Gravity(), pull, muscle], fixed={"ymin": "xyz", "xmin": "x"}, precision="f64")
    solver = ds.StaticSolver(scene, **exact) if kind == "statics" else ds.BDF2Solver(scene, dt=0.01, **exact)
    return ds.Batch(solver, 2, 3, gradients="all", **options), own | dict(activation=[0.1, 0.5, 0.9])


@pytest.mark.parametrize("kind", ["Euler", "as on a card", "midpoint", "BDF2", "statics", "slapped"])
def test_implicit_scenes_are_solved_together(kind, monkeypatch):
    """As one by one, to the tolerance of the solver; of a scene that fails, its error, and nothing in the others."""
    if kind == "as on a card":
        monkeypatch.setattr(JoinedArrays, "by_scene", False)
    found, seeds = [], np.random.default_rng(0).normal(size=(4, 3, 2, len(MESH.vertices), 3))
    for lanes in (True, False):
        batch, own = implicit(kind, lanes=lanes)
        frames = batch.forward(**own)
        alive = kind != "slapped" or np.array([True, False, True])
        assert (frames.alive == alive).all() and frames.alone == ((1,) if kind == "slapped" and lanes else ())
        with pytest.warns(UserWarning, match="gradients are zero") if kind == "slapped" else warnings.catch_warnings():
            names = [*batch.outputs]
            found.append((frames, batch.vjp(frames, **dict(zip(names, seeds)))))
    (together, gradients), (by_turns, expected) = found
    for name in names:
        bound = 1e-7 * np.abs(by_turns[name]).max()
        np.testing.assert_allclose(together[name], by_turns[name], rtol=0, atol=bound, err_msg=name)
    np.testing.assert_allclose(together.displacements, by_turns.displacements, rtol=0, atol=1e-9)
    for name, gradient in gradients.items():
        np.testing.assert_allclose(
            gradient, expected[name], rtol=0, atol=1e-6 * np.abs(expected[name]).max(), err_msg=name
        )
    if kind == "slapped":
        assert type(together.error(1)) is type(by_turns.error(1)) and "step 0" in str(together.error(1))


def test_small_scenes_are_solved_in_few_launches(monkeypatch):
    """Each pass asks where to start and solves; where a launch ends early the next one goes on as if it had not."""
    launches, launch, found = [], Piecewise.__call__, []
    monkeypatch.setattr(
        Piecewise, "__call__", lambda self, *more, **own: (launches.append(self), launch(self, *more, **own))
    )
    for many in (200, 2):
        monkeypatch.setattr(Rounds, "many", many)
        batch, own = implicit("Euler")
        launches.clear()
        found.append((batch.forward(**own).displacements, len(launches)))
    (whole, few), (in_parts, more) = found
    np.testing.assert_array_equal(whole, in_parts)
    assert few <= 6 * 4 < 2 * 6 * 4 < more, (few, more)  # of four passes


@pytest.mark.backends
def test_backend_of_implicit_scenes():
    """Where each has a thread of its own that sums over a dozen chunks of vertices, and ends after rounds of its own."""
    if runtime.arch_name() == "vulkan":
        pytest.skip("lavapipe compiles its kernels for minutes")
    mesh = ds.TetrahedralMesh.create_box((3, 3, 10), (0.02, 0.02, 0.1))
    floor = ds.Ground(mesh.vertices[:, 1].min() - 1e-3, friction=0.4, stiffness_per_area=2e5, width=2e-3)
    scene = ds.Scene(mesh, ds.StableNeoHookean(5e4, 0.3), terms=[ds.Gravity(), floor], precision="f64")
    solver, moduli, found = ds.ImplicitEulerSolver(scene, dt=0.01, tolerance=1e-9), [4e3, 1e6, 3e4], []
    seed = np.random.default_rng(0).normal(size=(3, 2, mesh.num_vertices, 3))
    for lanes in (True, False):
        batch = ds.Batch(solver, 2, 3, gradients="youngs_modulus", lanes=lanes)
        frames = batch.forward(
            youngs_modulus=moduli, initial_velocities=np.broadcast_to([0.3, -0.5, 0.1], seed.shape[2:])
        )
        assert frames.alive.all() and not frames.alone
        found.append((frames.displacements, batch.vjp(frames, seed)["youngs_modulus"]))
    for together, alone in zip(*found):
        for x, expected in zip(together, alone):
            np.testing.assert_allclose(x, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_steps_of_implicit_scenes_go_on_from_their_ends():
    whole, own = implicit("on a floor at rest")
    batch, start = ds.Batch(whole.solver, 1, 3), own.pop("initial_velocities")
    state = dict(initial_velocities=start)
    for _ in range(4):
        state = batch.forward(**own, **state).end
    frames = whole.forward(**own, initial_velocities=start)
    np.testing.assert_allclose(state["initial_positions"], frames.positions[:, -1], rtol=0, atol=1e-8)


def test_blocks_of_a_scene_that_rests_take_what_hosts_add_once():
    """While others are judged, twice."""
    euler = implicit("Euler")[0].solver
    scene = euler.scene.replace(terms=[*euler.scene.terms, ds.ElasticFoundation(1e6, surface="ymax")])
    batch = ds.Batch(ds.ImplicitEulerSolver(scene, dt=0.005), 1, 3)
    batch.forward()
    potential = batch.sweep.workspace.potential
    for _ in range(2):
        potential.only(np.array([False, True, False]))
        potential.put_contact_blocks()
    blocks = np.swapaxes(runtime.fetch(potential.barriers.blocks), 0, 1)
    np.testing.assert_allclose(blocks, potential.contact_blocks(), rtol=1e-12)
    potential.put_contact_blocks()
    potential.only(np.array([False, True, False]))
    alone, hosts = potential.obstacle_blocks(met=True), potential.hosts.blocks(potential.held_at)
    np.testing.assert_allclose(alone + hosts, blocks, rtol=1e-12, atol=1e-12 * np.abs(blocks).max())


def test_gradients_of_a_scene_that_is_given_up_are_of_its_run_alone(monkeypatch):
    solve_all = JoinedNewton.solve_all

    def without_the_second(self, *more):
        u, solved = solve_all(self, *more)
        return u, solved & (np.arange(3) != 1)

    monkeypatch.setattr(JoinedNewton, "solve_all", without_the_second)
    scene = ds.Scene(MESH, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity()], fixed="ymin", precision="f64")
    solver, found = ds.ImplicitEulerSolver(scene, dt=0.005, tolerance=1e-9), []
    for lanes in (True, False):
        batch = ds.Batch(solver, 2, 3, gradients=["shape", "youngs_modulus"], lanes=lanes)
        frames = batch.forward(youngs_modulus=[6e4, 1e5, 1.7e5])
        assert frames.alive.all() and frames.alone == ((1,) if lanes else ())
        found.append(batch.vjp(frames, frames.displacements))
    for name, expected in found[1].items():
        np.testing.assert_allclose(found[0][name], expected, rtol=0, atol=1e-6 * np.abs(expected).max(), err_msg=name)


def test_a_scene_whose_linear_solve_reaches_its_limit_fails_alone(monkeypatch):
    leave, left = JoinedNewton.leave, []
    monkeypatch.setattr(JoinedNewton, "leave", lambda self, *more: (left.append(more[1].tolist()), leave(self, *more)))
    monkeypatch.setattr(Preconditioner, "patience", 1)  # products
    scene = ds.Scene(MESH, ds.StableNeoHookean(1e3, 0.3), terms=[ds.Gravity()], fixed="ymin", precision="f64")
    batch = ds.Batch(ds.ImplicitEulerSolver(scene, dt=0.1, max_iterations=1), 1, 3, gradients=[])
    frames = batch.forward(gravity=[[0, 0, 0], [0, -9.81, 0], [0, 0, 0]])
    assert frames.alive.tolist() == [True, False, True] and frames.alone == (1,)
    assert left == [[False, True, False]]
    assert not frames.displacements[[0, 2]].any() and "Newton's method stopped after" in str(frames.error(1))


def test_scenes_of_other_drag_take_implicit_steps_by_turns():
    scene = ds.Scene(MESH, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity(), ds.Drag(1.0)], precision="f64")
    batch = ds.Batch(ds.ImplicitEulerSolver(scene, dt=0.01), 2, 2)
    with pytest.warns(UserWarning, match="differ in drag_rate take implicit steps one after the other"):
        frames = batch.forward(drag_rate=[0.5, 2.0])
    speed = frames.velocities[:, -1, 0, 1]
    np.testing.assert_allclose(speed, -0.0981 * (1 + np.exp([-0.005, -0.02])), rtol=1e-6)
    assert batch.vjp(frames, velocities=np.ones(frames.velocities.shape))["drag_rate"].shape == (2,)
    asked = ds.Batch(ds.ImplicitEulerSolver(scene, dt=0.01), 2, 2, lanes=True)
    with pytest.raises(
        ValueError, match="implicit steps have one drag_rate; give it once for all, or leave out lanes=True"
    ):
        asked.forward(drag_rate=[0.5, 2.0])
    assert asked.forward(drag_rate=0.5).alive.all()


def test_a_control_loop_goes_on_from_its_ends():
    batch = ds.Batch(simple(1).solver, 1, 4)
    E = np.array([1e4, 1.5e4, 2e4, 3e4])
    state = {}
    for _ in range(3):
        state = batch.forward(youngs_modulus=E, **state).end
    whole = ds.Batch(batch.solver, 3, 4).forward(youngs_modulus=E)
    np.testing.assert_allclose(state["initial_positions"], whole.positions[:, -1], rtol=0, atol=1e-16)
    np.testing.assert_allclose(state["initial_velocities"], whole.velocities[:, -1], rtol=0, atol=1e-15)


def test_substeps_follow_the_stiffest_scene():
    E = np.array([2e4, 8e6, 4e4])
    solver = ds.SemiImplicitSolver(simple(1).scene, dt=2e-3, substeps=1)
    with pytest.warns(UserWarning, match="the stable step of scene 1, the stiffest of 3, is"):
        solver.choose_substeps(values=dict(youngs_modulus=E))
    alone = ds.SemiImplicitSolver(
        simple(1).scene.with_values(dict(youngs_modulus=8e6)), dt=2e-3, check_start=False
    ).stable_dt(tight=True)
    assert solver.substeps == np.ceil(2e-3 / (0.7 * alone.dt))
    frames = ds.Batch(solver, 20, 3).forward(youngs_modulus=E, initial_velocities=0.1 * MESH.vertices)
    assert frames.alive.all()
    with warnings.catch_warnings():  # it is chosen, and stays
        warnings.simplefilter("error")
        solver.choose_substeps(values=dict(youngs_modulus=E))


def test_batches_are_copied_by_pickle():
    batch = simple(3, lanes=False)
    again = pickle.loads(pickle.dumps(batch))
    assert again.num_scenes == 3 and not again.lanes
    np.testing.assert_array_equal(again.forward().positions, batch.forward().positions)


def test_scenes_start_anew():
    batch = simple(4)
    frames = batch.forward(youngs_modulus=[1e4, 1.5e4, 2e4, 3e4])
    mask, there = np.array([False, True, False, True]), MESH.vertices + [0, 1, 0]
    state = frames.reset(mask, velocities=np.stack([0 * there, 0 * there + 1]))
    for name, value in frames.end.items():
        np.testing.assert_array_equal(state[name][~mask], value[~mask])
    np.testing.assert_array_equal(state["initial_positions"][mask], [MESH.vertices] * 2)
    np.testing.assert_array_equal(state["initial_velocities"][[1, 3], 0, 0], [0, 1])
    np.testing.assert_array_equal(frames.reset(mask, there)["initial_positions"][3], there)
    np.testing.assert_array_equal(frames.reset()["initial_positions"], frames.end["initial_positions"])
    with pytest.raises(ValueError, match="expected 4 booleans"):
        frames.reset([1, 3])
    with pytest.raises(ValueError, match="for the scenes that restart"):
        frames.reset(mask, np.zeros((3, *there.shape)))


@pytest.mark.parametrize("lanes", [None, False], ids=["lanes", "by turns"])
def test_numbers_by_named_sets(lanes):
    m = MESH.num_tetrahedra
    sets = dict(soft=np.arange(m // 2), stiff=np.arange(m // 2, m - 2))
    mesh = ds.TetrahedralMesh(MESH.vertices, MESH.tetrahedra, tetrahedron_sets=sets)
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(2e4, 0.3), 1000.0, terms=[ds.Gravity(-9.8)], fixed=[0, 1, 2, 3], precision="f64"
    )
    batch = ds.Batch(ds.SemiImplicitSolver(scene, dt=2e-3, substeps=4), 4, 3, gradients="all", lanes=lanes)
    numbers = dict(soft=np.array([1e4, 1.5e4, 2e4]), stiff=3e4)
    frames = batch.forward(youngs_modulus=numbers, poissons_ratio=dict(default=0.2))
    seed = np.random.default_rng(0).normal(size=frames.positions.shape)
    gradients, total = batch.vjp(frames, seed), 0.0
    for b in range(3):
        alone = batch.one.forward(
            youngs_modulus=dict(soft=numbers["soft"][b], stiff=3e4), poissons_ratio=dict(default=0.2)
        )
        np.testing.assert_array_equal(alone.positions, frames.positions[b])
        by = batch.one.vjp(alone, seed[b])
        assert gradients["youngs_modulus"]["soft"][b] == pytest.approx(by["youngs_modulus"]["soft"], rel=1e-12)
        total += by["youngs_modulus"]["stiff"]
    assert gradients["youngs_modulus"]["stiff"] == pytest.approx(total, rel=1e-12)
    tensors = {key: torch.tensor(x, dtype=torch.float64, requires_grad=True) for key, x in numbers.items()}
    moved = rollout_frames(batch, youngs_modulus=tensors, poissons_ratio=dict(default=0.2)).positions
    (moved * torch.as_tensor(seed)).sum().backward()
    for key, tensor in tensors.items():
        np.testing.assert_allclose(tensor.grad, gradients["youngs_modulus"][key], rtol=1e-12)
    along = dict(soft=np.array([1e3, -2e3, 5e2]), stiff=-4e3)
    change = batch.tangents(frames, youngs_modulus=along, poissons_ratio=dict(default=0.01))["positions"]
    here = sum((gradients["youngs_modulus"][key] * dot).sum() for key, dot in along.items())
    here += 0.01 * gradients["poissons_ratio"]["default"]
    assert (change * seed).sum() == pytest.approx(here, rel=1e-11)
    with pytest.raises(ValueError, match=r"youngs_modulus\['soft'\]: expected shape \(\), or \(3,\) for 3 scenes"):
        batch.forward(youngs_modulus=dict(soft=[1.0, 2.0]))
    with pytest.raises(ValueError, match="the mesh has no tetrahedron set"):
        batch.forward(youngs_modulus=dict(hard=1e4))


@pytest.mark.parametrize("lanes", [None, False], ids=["lanes", "by turns"])
def test_tensors(lanes):
    batch = simple(3, gradients="all", lanes=lanes)
    E = torch.tensor([1e4, 2e4, 3e4], dtype=torch.float64, requires_grad=True)
    rho = torch.tensor(1000.0, dtype=torch.float64, requires_grad=True)
    u0 = torch.zeros((3, *MESH.vertices.shape), dtype=torch.float64, requires_grad=True)
    v0 = torch.zeros(MESH.vertices.shape, dtype=torch.float64, requires_grad=True)

    def loss(E, rho, u0, v0):
        given = dict(youngs_modulus=E, density=rho, initial_displacements=u0, initial_velocities=v0)
        frames = rollout_frames(batch, **given)
        return frames.displacements[:, -1].square().sum() * 1e4 + frames.velocities[:, 1:, ::3].sum()

    assert torch.autograd.gradcheck(lambda E: loss(E, rho, u0, v0), E, eps=1.0, atol=1e-9, rtol=1e-5)
    loss(E, rho, u0, v0).backward()
    whole = [x.grad.clone() for x in (E, rho, u0, v0)]
    alone = [torch.zeros_like(x) for x in (E, rho, u0, v0)]
    for b in range(3):
        own = [E[b].detach().requires_grad_(), *(x.detach().clone().requires_grad_() for x in (rho, u0[b], v0))]
        names = ("youngs_modulus", "density", "initial_displacements", "initial_velocities")
        frames = rollout_frames(batch.one, **dict(zip(names, own)))
        (frames.displacements[-1].square().sum() * 1e4 + frames.velocities[1:, ::3].sum()).backward()
        alone[0][b], alone[2][b] = own[0].grad, own[2].grad
        alone[1] += own[1].grad
        alone[3] += own[3].grad
    for here, there in zip(whole, alone):
        torch.testing.assert_close(here, there, rtol=1e-11, atol=1e-12)


def test_several_seeds_run_forward_once(monkeypatch):
    batch = simple(3)
    frames = batch.forward()
    seed, runs = np.ones_like(frames.positions), []
    batch.vjp(frames, seed)
    forward = type(batch.sweep)._forward
    monkeypatch.setattr(type(batch.sweep), "_forward", lambda self, run: (runs.append(run), forward(self, run)))
    first, second = batch.vjp(frames, seed), batch.vjp(frames, 2 * seed)
    assert not runs
    np.testing.assert_allclose(2 * first["youngs_modulus"], second["youngs_modulus"], rtol=1e-13)


@pytest.mark.parametrize(
    "wrong, said",
    [
        (dict(youngs_modulus=np.ones((2, 1))), "behind an axis of 3 scenes, got"),
        (dict(gravity=np.ones((4, 3))), "behind an axis of 3 scenes, got"),
        (dict(youngs_modulus=[1e4, -1e4, 1e4]), "must be > 0|must lie in"),
        (dict(speed=1.0), "no input named 'speed'; this batch has"),
        (dict(density=[1e3, np.nan, 1e3]), "density must be finite"),
    ],
)
def test_wrong_values_are_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        simple(3).forward(**wrong)


def test_what_could_be_either_is_refused():
    scene = ds.Scene(MESH, ds.StableNeoHookean(2e4, 0.3), 1000.0, precision="f64")
    m = MESH.num_tetrahedra
    batch = ds.Batch(ds.SemiImplicitSolver(scene, dt=1e-3), 1, m)
    with pytest.raises(ValueError, match=rf"one value for all scenes or one for each of {m}"):
        batch.forward(youngs_modulus=np.full(m, 1e4))
    E, full = np.linspace(1e4, 2e4, m), (m, m)
    shared, own = np.broadcast_to(E, full), np.broadcast_to(E[:, None], full)
    ends = [batch.forward(youngs_modulus=x).positions[:, -1] for x in (shared, own)]
    np.testing.assert_array_equal(ends[0], np.broadcast_to(ends[0][0], ends[0].shape))
    np.testing.assert_array_equal(ends[1][3], batch.one.forward(youngs_modulus=E[3]).positions[-1])


def test_wrong_seeds_and_counts_are_refused():
    with pytest.raises(ValueError, match="scenes"):
        simple(0)
    batch = simple(2)
    frames = batch.forward()
    with pytest.raises(ValueError, match="expected shape"):
        batch.vjp(frames, np.ones(3))
    with pytest.raises(ValueError, match="no output named"):
        batch.vjp(frames, stress=np.ones(3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        batch.vjp(frames, np.zeros_like(frames.positions))
