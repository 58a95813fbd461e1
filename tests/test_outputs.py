"""Outputs that a loss may name: their derivatives, in NumPy, under a tape and in torch; one of ours, one of a user."""

from functools import lru_cache

import numpy as np
import pytest
import taichi as ti
import torch
from test_gradients import free_scene, full_scene, random_mesh, rollout_of

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.diff_simulator import rollout_frames
from diffsim_ti.differentiation import arrays
from diffsim_ti.outputs import Change, Output
from diffsim_ti.solvers.explicit.solver import ExplicitWorkspace

RNG = np.random.default_rng(3)
STEPS = 6


@lru_cache(maxsize=None)
def scalar_field():
    """One field for all tests of this file: kernels compile anew for each."""
    return ti.field(ti.f64, (), needs_grad=True)


def tight_bdf2(scene, **options):
    return ds.BDF2Solver(scene, tolerance=1e-13, **options)


by_solver = pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.VelocityVerletSolver, tight_bdf2])


def inside(mesh, count=7) -> np.ndarray:
    """Points at random places of random tetrahedra."""
    weights = RNG.dirichlet(np.ones(4), count)
    return np.einsum("pa,pai->pi", weights, mesh.vertices[mesh.tetrahedra[RNG.integers(0, mesh.num_tetrahedra, count)]])


POINTS = inside(random_mesh())


class KineticEnergy(Output):
    """Kinetic energy [J] of the tetrahedra's vertices, for each of some sets of vertices; written as a user would."""

    name = "kinetic_energy"

    def __init__(self, *sets):
        self.sets = sets

    def settled(self, scene):
        out = KineticEnergy(*self.sets)
        out.mesh, out.masks = scene.mesh, np.zeros((len(self.sets), scene.mesh.num_vertices))
        for mask, chosen in zip(out.masks, self.sets):
            mask[scene.mesh.vertex_indices(chosen)] = 1
        return out

    def shape(self, num_frames):
        return num_frames, len(self.sets)

    def _volumes(self, X):
        edges = X[self.mesh.tetrahedra[:, 1:]] - X[self.mesh.tetrahedra[:, :1]]
        return np.linalg.det(edges) / 6, np.linalg.inv(edges)

    def _to_vertices(self, per_tetrahedron):
        return np.bincount(self.mesh.tetrahedra.ravel(), np.repeat(per_tetrahedron / 4, 4), self.mesh.num_vertices)

    def value(self, frames):
        V, _ = self._volumes(frames.inputs["rest_positions"])
        mass = self._to_vertices(frames.inputs["density"] * V)
        return 0.5 * (frames.velocities.astype(float) ** 2).sum(2) @ (self.masks * mass).T

    def jvp(self, frames, change):
        V, inverse = self._volumes(frames.inputs["rest_positions"])
        v, mass = frames.velocities.astype(float), self._to_vertices(frames.inputs["density"] * V)
        dX = change.inputs.get("rest_positions", np.zeros(v.shape[1:]))
        dV = V * np.einsum("eij,eji->e", inverse, dX[self.mesh.tetrahedra[:, 1:]] - dX[self.mesh.tetrahedra[:, :1]])
        dmass = self._to_vertices(change.inputs.get("density", 0.0) * V + frames.inputs["density"] * dV)
        dv = 0.0 if change.velocities is None else change.velocities
        return (v * dv).sum(2) @ (self.masks * mass).T + 0.5 * (v**2).sum(2) @ (self.masks * dmass).T

    def vjp(self, frames, seed):
        V, inverse = self._volumes(frames.inputs["rest_positions"])
        v, density = frames.velocities.astype(float), frames.inputs["density"]
        by_vertex = seed @ self.masks  # (frames, vertices)
        mass_adj = 0.5 * ((v**2).sum(2) * by_vertex).sum(0)
        per_tetrahedron = mass_adj[self.mesh.tetrahedra].sum(1) / 4
        by_density = V * per_tetrahedron
        edges = (V * density * per_tetrahedron)[:, None, None] * np.swapaxes(inverse, 1, 2)
        by_rest = np.zeros(v.shape[1:])
        np.add.at(by_rest, self.mesh.tetrahedra[:, 1:], edges)
        np.add.at(by_rest, self.mesh.tetrahedra[:, 0], -edges.sum(1))
        mass = self._to_vertices(density * V)
        return Change(
            velocities=v * (mass * by_vertex)[:, :, None],
            inputs={"density": by_density if np.ndim(density) else by_density.sum(), "rest_positions": by_rest},
        )


# functions of arrays that record, with the shapes of their arguments, whose numbers are above 0.5
RECORDED = [
    (lambda a, b: (a + b) * a / b - 2.0 * b, (4, 3), (3,)),
    (lambda a: np.sqrt(a) + np.exp(-a) * np.log(a) + abs(a) ** 3 + np.sin(a) * np.cos(a), (4, 3)),
    (
        lambda a, b: np.arctan2(a, b) + np.maximum(a, b) + np.clip(a, 0.6, 1.0) + np.where(a > b, a * b, b),
        (4, 3),
        (4, 3),
    ),
    (lambda a: a[1:, [0, 2]].sum(1) + a[0, 0] + a[2].mean() + sum(k * row[0] for k, row in enumerate(a)), (4, 3)),
    (lambda a, b, c: a @ b @ c + c @ c, (5, 4, 3), (3, 2), (2,)),
    (
        lambda a, b: np.cross(a[None], b) + np.cross(b, [0, 0, 1]) + b.T.sum() + np.moveaxis(b, 0, 1)[0],
        (5, 3),
        (5, 5, 3),
    ),
    (lambda a, b: np.einsum("ij,kj->k", a, b), (2, 3), (4, 3)),
    (lambda a: np.linalg.inv(a) + np.linalg.det(a)[:, None, None] + a.swapaxes(-1, -2), (4, 3, 3)),
    (lambda a: np.linalg.eigvalsh(a @ a.swapaxes(-1, -2)), (4, 3, 3)),
    (lambda a, b: np.linalg.solve(a, b[..., None])[..., 0], (3, 3), (4, 3)),
    (lambda a, b: np.concatenate([np.stack([a, 2 * a], 1).reshape(-1, 3), b, np.ones((1, 3))]), (4, 3), (2, 3)),
    (
        lambda a: np.roll(a, 1, 0) + np.repeat(a[:1], 4, 0) + np.tile(a[0], (4, 1)) + np.broadcast_to(a[2], (4, 3)),
        (4, 3),
    ),
    (lambda a: (a - 1.5) ** 0 + a[(0, 0, 1, 1),] + a[:, [2, 2, 0]] + np.einsum("i j -> j", a) + np.square(a), (4, 3)),
    (
        lambda a: np.tanh(np.stack([a[0], a[1]], -1)).T + np.minimum(a[2], 1.0) + np.squeeze(np.transpose(a)[:, :1]),
        (4, 3),
    ),
    (lambda a, b: a**b + 2.0**b + np.minimum(a, b) + np.minimum(1.2, np.maximum(b, 0.8)), (4, 3), (4, 3)),
    (lambda a, b: arrays.ratio(a, np.linalg.norm(b, axis=1, keepdims=True)), (4, 3), (4, 3)),
    (lambda a, b: arrays.replaced(b, np.array([3, 1]), a) + arrays.summed_at(np.array([0, 2]), a, 4), (2, 3), (4, 3)),
]


@pytest.mark.parametrize("function, shapes", [(function, shapes) for function, *shapes in RECORDED])
def test_sweeps_over_what_arrays_record(function, shapes):
    """They are transposes of each other, and agree with differences; values are those of plain arrays."""
    rng = np.random.default_rng(0)
    x, dx = ([sign + rng.random(shape) for shape in shapes] for sign in (0.5, -0.5))
    leaves = [arrays.Recorded(a) for a in x]
    y = function(*leaves)
    change, seed = arrays.forward(y, zip(leaves, dx)), rng.standard_normal(y.shape)
    ahead, back = (function(*(a + h * b for a, b in zip(x, dx))) for h in (1e-6, -1e-6))
    np.testing.assert_allclose(change, (ahead - back) / 2e-6, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(y.value, function(*x), rtol=1e-14)
    pulled = sum((a * b).sum() for a, b in zip(arrays.reverse(y, seed, leaves), dx))
    assert (seed * change).sum() == pytest.approx(pulled, rel=1e-12)


def test_roots_powers_and_bounds_have_derivatives_at_their_ends():
    x, dx = arrays.Recorded(np.array([0.0, 0.0, 2.0])), np.array([1.0, -1.0, 3.0])
    y = np.sqrt(x) + x**2 + x**0 + x**1.0 + np.linalg.norm(x[:2]) + np.clip(x, None, 1.0) + np.clip(x, 0.5, None)
    np.testing.assert_allclose(arrays.forward(y, [(x, dx)]), [2.0, -2.0, 3 / 8**0.5 + 18.0])
    np.testing.assert_allclose(arrays.reverse(y, np.ones(3), [x])[0], [2.0, 2.0, 1 / 8**0.5 + 6.0])


def changed(x):
    x += 1.0


@pytest.mark.parametrize(
    "function",
    [
        np.floor,
        np.sort,
        np.array,
        np.add.accumulate,
        changed,
        lambda x: np.add.at(np.zeros(3), [0, 0, 1], x),
        lambda x: np.linalg.norm(x, 1),
        lambda x: np.einsum("ii->", x[:, None] * x),
        lambda x: x.astype(int),
        lambda x: x.max(),
        lambda x: np.concatenate([x, x], axis=None),
    ],
)
def test_functions_without_a_derivative_say_so(function):
    with pytest.raises((TypeError, AttributeError), match="derivative"):
        function(arrays.Recorded(np.ones(3)))


def test_a_function_without_a_derivative_is_given_one_as_its_error_says():
    x, dx = arrays.Recorded(np.array([0.5, 2.0])), np.array([1.0, -3.0])
    with pytest.raises(TypeError, match="np.log1p has no derivative here: give a derivative by made or with_slopes"):
        np.log1p(x)
    slope = 1 / (1 + x.value)
    for y in (
        arrays.with_slopes(np.log1p(x.value), (x, lambda: slope)),
        arrays.made(np.log1p(x.value), (x, lambda d: d * slope, lambda seed: seed * slope)),
    ):
        np.testing.assert_array_equal(arrays.forward(y, [(x, dx)]), dx * slope)
        np.testing.assert_array_equal(arrays.reverse(y, dx, [x])[0], dx * slope)


def test_another_output_within_an_output_is_refused_in_derivatives():
    class Twice(Output):
        name = "twice"

        def shape(self, num_frames):
            return (num_frames, 3)

        def value(self, frames):
            return 2.0 * frames["center_of_mass"]

    scene = ds.Scene(ds.TetrahedralMesh.create_cube(2), ds.StableNeoHookean(1e4, 0.3), precision="f64")
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-4), 1, outputs=[ds.CenterOfMass(), Twice()])
    frames = rollout.forward()
    np.testing.assert_array_equal(frames["twice"], 2 * frames["center_of_mass"])
    with pytest.raises(TypeError, match="another output has no derivative here"):
        rollout.vjp(frames, twice=np.ones((2, 3)))


def outputs():
    return [ds.MaterialPoints(POINTS, name="markers"), KineticEnergy("ymax", "xmax")]


def small(solver=ds.SemiImplicitSolver, scene=None, steps=STEPS, **options):
    scene = full_scene(steps=steps) if scene is None else scene
    return rollout_of(scene, solver, steps, save_every=3, **dict(outputs=outputs()) | options)


@by_solver
@pytest.mark.parametrize("name", ["positions", "velocities", "displacements", "markers", "kinetic_energy"])
def test_seeds_are_the_transpose_of_tangents(solver, name):
    """For every input by itself: a small one could hide behind a large one."""
    rollout = small(solver)
    frames, rng = rollout.forward(), np.random.default_rng(1)
    seed = rng.normal(size=frames[name].shape)
    gradients, gate = rollout.vjp(frames, **{name: seed}), 1e-11 if rollout.solver.explicit else 1e-8
    for key in rollout.inputs:
        direction = rng.normal(size=rollout.values[key].shape) * verify.input_scale(rollout, key)
        if key == "initial_velocities":
            direction[rollout.scene.fixed] = 0
        terms = rollout.tangents(frames, **{key: direction})[name] * seed
        pushed, pulled = terms.sum(), (gradients[key] * direction).sum()
        assert abs(pushed - pulled) <= gate * max(abs(pushed), np.linalg.norm(terms), 1e-30), key


@by_solver
@pytest.mark.parametrize(
    "name, key",
    [
        *(("markers", key) for key in ("rest_positions", "youngs_modulus", "initial_positions", "prescribed_motion")),
        *(("kinetic_energy", key) for key in ("density", "rest_positions", "gravity")),
        ("displacements", "rest_positions"),
    ],
)
def test_gradients_agree_with_differences(solver, name, key):
    rollout, rng = small(solver), np.random.default_rng(2)
    frames = rollout.forward()
    seed = rng.normal(size=frames[name].shape)
    direction = rng.normal(size=rollout.values[key].shape) * verify.input_scale(rollout, key)
    slope = (rollout.vjp(frames, **{name: seed})[key] * direction).sum()
    base = rollout.values[key]
    differences, _ = verify.central_difference(
        lambda t: (rollout.forward(**{key: base + t * direction})[name] * seed).sum()
    )
    assert slope == pytest.approx(differences, rel=1e-6)


class Wrong(KineticEnergy):
    """A transpose that is right by velocities, and leaves out what it owes the density."""

    def settled(self, scene):
        out = super().settled(scene)
        out.__class__ = Wrong
        return out

    def vjp(self, frames, seed):
        change = super().vjp(frames, seed)
        del change.inputs["density"]
        return change


def test_checks_see_outputs():
    right, wrong = (small(outputs=[of]) for of in (KineticEnergy("ymax"), Wrong("ymax")))
    assert verify.dot_product_test(right) <= 1e-11 and verify.dot_product_test(wrong) >= 1e-4
    assert verify.dot_product_test(wrong, ["gravity", "youngs_modulus"]) <= 1e-11  # which it does not owe anything
    names = ["density", "gravity", "rest_positions"]
    options = dict(inputs=names, verbose=False)
    assert ds.check_gradients(right, **options).passed
    assert [row.passed for row in ds.check_gradients(wrong, **options).rows] == [False, True, True]


def test_a_loss_may_name_outputs_in_checks():
    rollout = small()

    def loss(frames):
        energy = frames["kinetic_energy"]
        return float((energy**2).sum()), None, None, {"kinetic_energy": 2 * energy}

    assert ds.check_gradients(rollout, loss, inputs=["density", "gravity", "youngs_modulus"], verbose=False).passed
    direction = {"gravity": np.array([0.0, 1.0, 0.0])}
    assert np.abs(verify.hessian_product(rollout, loss, direction)["gravity"]).max() > 0


def test_seeds_of_several_outputs_add_up():
    rollout = small()
    frames = rollout.forward()
    seeds = {name: RNG.normal(size=frames[name].shape) for name in rollout.outputs}
    together = rollout.vjp(frames, **seeds)
    apart = [rollout.vjp(frames, **{name: seed}) for name, seed in seeds.items()]
    for name, value in together.items():
        parts = [g[name] for g in apart]
        size = max(np.abs(p).max() for p in parts)
        np.testing.assert_allclose(sum(parts), value, rtol=1e-9, atol=1e-11 * size, err_msg=name)


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.ImplicitEulerSolver])
@pytest.mark.parametrize("scene", [full_scene, free_scene], ids=["prescribed motion", "free"])
def test_numpy_tape_and_torch_agree(scene, solver):
    """One run and one pull-back, read in three ways; a start that kernels or tensors give is copied on the device."""
    scene = scene(steps=STEPS) if scene is full_scene else scene()
    rollout, total = small(solver, scene), scalar_field()
    given = dict(initial_positions=scene.inputs.values["initial_positions"] + 0.01 * RNG.normal(size=(27, 3)))
    given["density"] = 1.1 * scene.inputs.values["density"]
    frames = rollout.forward(**given)
    seeds = {name: RNG.normal(size=frames[name].shape) for name in rollout.outputs}
    expected = rollout.vjp(frames, **seeds)

    fields = {name: rollout.field(name) for name in (*given, *rollout.outputs)}
    for name, value in given.items():
        fields[name].from_numpy(value)
    weights = {name: fields_like(fields[name]) for name in rollout.outputs}
    for name, weight in weights.items():
        weight.from_numpy(seeds[name])

    @ti.kernel
    def add(y: ti.template(), w: ti.template()):
        for I in ti.grouped(y):
            if ti.static(isinstance(y, ti.MatrixField)):
                total[None] += y[I].dot(w[I])
            else:
                total[None] += y[I] * w[I]

    with ti.ad.Tape(total):
        rollout.run()
        for name in rollout.outputs:
            add(fields[name], weights[name])
    assert total[None] == pytest.approx(sum((frames[name] * seed).sum() for name, seed in seeds.items()), rel=1e-10)
    for name in given:
        np.testing.assert_allclose(fields[name].grad.to_numpy(), expected[name], rtol=1e-7, atol=1e-12)
    for name in rollout.outputs:
        np.testing.assert_allclose(fields[name].to_numpy(), frames[name], rtol=1e-12, atol=1e-14)

    tensors = {name: torch.tensor(value, requires_grad=True) for name, value in given.items()}
    shown = rollout_frames(rollout, **tensors)
    sum((shown[name] * torch.from_numpy(seed)).sum() for name, seed in seeds.items()).backward()
    for name, tensor in tensors.items():
        np.testing.assert_allclose(tensor.grad.numpy(), expected[name], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(shown[name].detach() if name in shown.outputs else 0, frames.outputs.get(name, 0))


def fields_like(field):
    if isinstance(field, ti.MatrixField):
        return ti.Vector.field(3, ti.f64, field.shape)
    return ti.field(ti.f64, field.shape)


def test_gradcheck_in_torch():
    rollout = small(steps=3)

    def markers(E, rest, density):
        frames = rollout_frames(rollout, youngs_modulus=1e5 * E, rest_positions=rest, density=1e3 * density)
        return frames["markers"], frames.outputs["kinetic_energy"], frames["displacements"]

    inputs = (np.ones(48), rollout.values["rest_positions"], np.ones(48))
    inputs = tuple(torch.tensor(x, requires_grad=True) for x in inputs)
    assert torch.autograd.gradcheck(markers, inputs, eps=1e-6, atol=1e-8, rtol=1e-5, fast_mode=True)
    with pytest.raises(RuntimeError, match="second derivatives are not available"):
        (g,) = torch.autograd.grad(markers(*inputs)[0].sum(), inputs[0], create_graph=True)
        g.sum().backward()


def test_markers_keep_their_digits_in_float32():
    """10 m from the origin: positions have 1e-6 of a metre, displacements and hence markers' changes have more."""
    mesh = random_mesh().translated([10.0, 0.0, 0.0])
    points = POINTS + [10.0, 0, 0]
    shown = []
    for precision in ("f32", "f64"):
        scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=ds.Gravity(), fixed="xmin", precision=precision)
        shown.append(rollout_of(scene, steps=4, outputs=ds.MaterialPoints(points)).forward()["material_points"])
    assert np.abs(shown[0] - shown[1]).max() <= 1e-9 and np.abs(shown[1][-1] - points).max() > 1e-4


# ---- several seeds of one run -----------------------------------------------------------------------------------------


@by_solver
def test_further_seeds_run_nothing_forward(solver, monkeypatch):
    """Neither a second seed nor a tangent between; and the first needs one recorded run where passes are no solves."""
    rollout = small(solver)
    kind, passes = type(rollout.solver.workspace(rollout.solver.start_values())), []
    advance = kind.advance
    frames = rollout.forward()
    seed = RNG.normal(size=frames.positions.shape)

    def counted(self, first, last, *arguments, **options):
        passes.append(last - first)
        return advance(self, first, last, *arguments, **options)

    monkeypatch.setattr(kind, "advance", counted)
    first = rollout.vjp(frames, positions=seed)
    assert sum(passes) == (rollout.sweep.num_passes if rollout.solver.explicit else 0)
    passes.clear()
    for name in rollout.outputs:
        rollout.vjp(frames, **{name: RNG.normal(size=frames[name].shape)})
    assert not passes
    rollout.jvp(frames, gravity=np.ones(3))
    again = rollout.vjp(frames, positions=seed)
    assert not passes and all(np.array_equal(again[name], first[name]) for name in first)
    assert issubclass(kind, ExplicitWorkspace) == rollout.solver.explicit


# ---- misuse -----------------------------------------------------------------------------------------------------------


def test_what_is_refused():
    with pytest.raises(ValueError, match="names of their own.*got 'density'"):
        rollout_of(free_scene(), outputs=ds.MaterialPoints(POINTS, name="density"))
    with pytest.raises(ValueError, match="names of their own.*'markers'"):
        rollout_of(free_scene(), outputs=[ds.MaterialPoints(POINTS, name="markers")] * 2)
    with pytest.raises(ValueError, match="expected an Output such as MaterialPoints"):
        rollout_of(free_scene(), outputs=["markers"])
    with pytest.raises(ValueError, match=r"points lie outside the mesh: point 1 .* by 8\.9[0-9]* m"):
        rollout_of(free_scene(), outputs=ds.MaterialPoints([POINTS[0], [10.0, 0.5, 0.5]]))
    rollout = small(scene=free_scene())
    frames = rollout.forward()
    with pytest.raises(ValueError, match="gradient by the frames' markers: expected shape"):
        rollout.vjp(frames, markers=np.ones(3))
    with pytest.raises(ValueError, match="no output named 'colour'.*markers"):
        rollout.vjp(frames, colour=np.ones(3))
    with pytest.raises(KeyError, match="no output named 'colour'.*markers"):
        frames["colour"]
    with pytest.raises(FloatingPointError, match="gradient by markers is not finite at step 3"):
        bad = np.zeros(frames["markers"].shape)
        bad[1] = np.nan
        rollout.vjp(frames, markers=bad)


def test_an_output_of_another_shape_than_it_says():
    class Wrong(KineticEnergy):
        def settled(self, scene):
            out = Wrong(*self.sets)
            out.__dict__.update(super().settled(scene).__dict__)
            return out

        def shape(self, num_frames):
            return (num_frames,)

    with pytest.raises(ValueError, match=r"kinetic_energy.*shape \(2, 1\), but it says \(2,\)"):
        rollout_of(free_scene(), outputs=Wrong("ymax")).forward()


def test_torch_refuses_gradients_that_the_rollout_does_not_compute():
    """... instead of a zero: adjoints by density cost extra."""
    rollout = rollout_of(free_scene(), gradients=["youngs_modulus"])
    density = torch.tensor(rollout.values["density"], requires_grad=True)
    with pytest.raises(ValueError, match="density requires a gradient, but this rollout computes youngs_modulus"):
        rollout_frames(rollout, density=density)
    with torch.no_grad():
        rollout_frames(rollout, density=density)
