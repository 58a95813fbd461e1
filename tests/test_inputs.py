"""Inputs: each link by itself, what is kept, names of terms, what each input may be, and inputs of a user's own."""

import copy
import pickle
import re

import numpy as np
import pytest
from gradient_fuzz import scenes as random_scenes

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.inputs import POSITIVE, Chain, Input, Link, RunSize, links
from diffsim_ti.inputs.chain import Recording
from diffsim_ti.inputs.rest_shape import RestShape
from diffsim_ti.terms import ExternalForce, HalfSpace, Term

MESH = ds.TetrahedralMesh.create_box(3, size=[1, 0.4, 0.6], origin=[0, 0.05, 0])
N, M = MESH.num_vertices, MESH.num_tetrahedra
SOFT = dict(stiffness=300.0, width=0.2)
PATH = dict(path=lambda t: [0.3 * t, 0.1 * t, 0])


def random(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape)


def rising(low, high):
    return np.linspace(low, high, M)


def scene(material=None, density=800.0, terms=(), **options) -> ds.Scene:
    return ds.Scene(MESH, material or ds.StableNeoHookean(2e4, 0.3), density, terms, precision="f64", **options)


def everything() -> ds.Scene:
    """All kinds of inputs, per tetrahedron where they may be."""
    return scene(
        ds.StableNeoHookean(rising(1e4, 2e4), rising(0.2, 0.3)),
        rising(700.0, 900.0),
        [
            ds.Gravity(),
            ds.Drag(0.5),
            ds.ExternalForce(random(4, N, 3)),
            ds.Ground(-0.1, **SOFT, **PATH),
            ds.Sphere([0.5, -0.9, 0.3], 0.8, **SOFT, friction=0.3, name="ball"),
            ds.Box([0.5, -0.5, 0.3], [1, 0.6, 1], **SOFT, **PATH, name="table"),
            ds.SelfContact(300.0, 0.05),
        ],
        fixed="xmin",
        motion=lambda t: [0.1 * t, 0, 0],
        initial_positions=MESH.vertices * [1.1, 1, 1],
        initial_velocities=random(N, 3, seed=1),
    )


# ---- inputs of a user's own: a vector per tetrahedron, numbers per step, numbers that are not the kernel's -------------


class FibreStiffness(Recording, Link):
    """mu (1 + |a|^2), lam of a field a, one vector per tetrahedron."""

    reads, writes = ("youngs_modulus", "poissons_ratio", "fibre"), ("coefficients",)

    def __init__(self, material):
        self.material = material

    def value(self, E, nu, a):
        size = (a**2).sum(-1)
        lame = self.material.coefficients(dict(youngs_modulus=E, poissons_ratio=nu))
        return (lame * np.stack([1 + size, 1 + 0 * size], -1),)


class Fibred(ds.StableNeoHookean):
    """A material whose shear modulus grows with a field of vectors."""

    def __init__(self, E, nu, fibre):
        super().__init__(E, nu)
        self.fibre = fibre

    def described(self, mesh):
        return [*super().described(mesh), Input("fibre", self.fibre, (("tetrahedra", 3),))]

    def links(self):
        return [FibreStiffness(self)]


class GustLink(Link):
    """Forces strength(t) direction V_i / V of each step t, V_i a quarter of the volumes around a vertex at rest."""

    writes = ("forces",)

    def __init__(self, strength, direction):
        self.reads = strength, direction, "volumes"

    def share(self, V):
        return np.bincount(MESH.tetrahedra.ravel(), np.repeat(V / 4, 4), N) / V.sum()

    def value(self, s, d, V):
        return (s[:, None, None] * self.share(V)[:, None] * d,)

    def jvp(self, x, dx):
        s, d, V = x
        d_share = (self.share(dx[2]) * dx[2].sum() - self.share(V) * dx[2].sum()) / V.sum()
        by_share = s[:, None, None] * d_share[:, None] * d
        return (self.value(dx[0], d, V)[0] + self.value(s, dx[1], V)[0] + by_share,)

    def vjp(self, x, y_adj):
        (s, d, V), share = x, self.share(x[2])
        by_share = np.einsum("tkd,t,d->k", y_adj[0], s, d)
        by_V = (by_share[MESH.tetrahedra].sum(1) / 4 - by_share @ share) / V.sum()
        return np.einsum("tkd,k,d->t", y_adj[0], share, d), np.einsum("tkd,t,k->d", y_adj[0], s, share), by_V


class Gusts(ExternalForce):
    """A load whose strength is a number per step."""

    def __init__(self, strength, direction, name=None):
        self.vertices = None
        described = Input("strength", strength, (("steps",),), "N"), Input("direction", direction, ((3,),))
        Term.__init__(self, *described, name=name)

    def check(self, mesh):
        pass

    def settled(self, *start):
        return self

    def links(self, names, own):
        return [GustLink(names["strength"], names["direction"])]


class Tilt(Link):
    """Six numbers of a plane, a point and a normal, of a height and an angle."""

    def __init__(self, height, angle, width, stiffness, own):
        self.reads, self.writes = (height, angle, stiffness, width), (own,)

    def value(self, height, angle, stiffness, width):
        zero = np.zeros(())
        return (np.stack([zero, height, zero, np.sin(angle), np.cos(angle), zero, stiffness, width]),)

    def jvp(self, x, dx):
        (dh, da, dk, dw), a, zero = dx, x[1], np.zeros(())
        return (np.stack([zero, dh, zero, np.cos(a) * da, -np.sin(a) * da, zero, dk, dw]),)

    def vjp(self, x, y_adj):
        y, a = y_adj[0], x[1]
        return y[1], np.cos(a) * y[3] - np.sin(a) * y[4], y[6], y[7]


class Ramp(HalfSpace):
    """A plane that is given by an angle, which its kernel does not know."""

    num_numbers = 8

    def __init__(self, height, angle, name=None):
        super().__init__([0, height, 0], [np.sin(angle), np.cos(angle), 0], **SOFT, name=name)
        self.described = (
            Input("height", height, ((),), "m", plain="ramp_height"),
            Input("angle", angle, ((),), plain="ramp_angle"),
            *self.described[2:],
        )

    def distance(self, positions):
        angle = self.values["ramp_angle"]
        return positions[:, 0] * np.sin(angle) + (positions[:, 1] - self.values["ramp_height"]) * np.cos(angle)

    def links(self, names, own):
        return [Tilt(*(names[n] for n in ("ramp_height", "ramp_angle", "barrier_width", "barrier_stiffness")), own)]


def of_our_own() -> ds.Scene:
    fibre = random(M, 3, seed=2)
    load = Gusts(20 + random(4, seed=3), [1.0, -2.0, 0.5], name="wind")
    return scene(Fibred(rising(1e4, 2e4), 0.3, fibre), terms=[ds.Gravity(), load, Ramp(-0.1, 0.2, name="ramp")])


# ---- each link by itself -----------------------------------------------------------------------------------------------


SCENES = {
    "everything": everything,
    "uniform": lambda: scene(terms=[ds.ExternalForce(random(N, 3))]),
    "uniform E": lambda: scene(ds.Corotated(2e4, rising(0.2, 0.3))),
    "mu, lam": lambda: scene(ds.SmithNeoHookean(mu=1e4, lam=rising(1e4, 2e4))),
    "c10, c01, bulk modulus": lambda: scene(ds.MooneyRivlin(c10=3e3, c01=rising(1e3, 2e3), bulk_modulus=2e4)),
    "of our own": of_our_own,
}


def all_links():
    for name, build in SCENES.items():
        of = build()
        known = of.inputs.chain.value(of.inputs.at_times(np.linspace(0, 0.3, 4)))
        for link in of.inputs.chain.links:
            if name in ("everything", "of our own") or type(link).__name__ in ("Coefficients", "LumpedMass", "PerStep"):
                x = [known[read] for read in link.reads]
                label = f"{type(link).__name__} of {', '.join(link.reads)} in {name}"
                yield pytest.param(link, x, [known[written] for written in link.writes], id=label.replace(" ", "_"))


@pytest.fixture(scope="module")
def directions():
    rng = np.random.default_rng(7)

    def of(arrays):
        return [rng.standard_normal(part.shape) * (0.05 * np.abs(part).max() or 0.05) for part in arrays]

    return of


@pytest.mark.parametrize("link, x, y", list(all_links()))
def test_each_link(link, x, y, directions):
    """Transposed is transposed, by dot products; the tangent is the slope of the value, by extrapolated differences."""
    dx, y_adj = directions(x), [random(*part.shape, seed=4) / (np.abs(part).max() or 1) for part in y]
    dy, x_adj = link.jvp(x, dx), link.vjp(x, y_adj)
    assert [np.shape(part) for part in dy] == [part.shape for part in y]
    assert [np.shape(part) for part in x_adj] == [part.shape for part in x]
    forward = sum((a * b).sum() for a, b in zip(y_adj, dy))
    backward = sum((a * b).sum() for a, b in zip(x_adj, dx))
    size = sum(np.abs(a * b).sum() for a, b in zip(y_adj, dy))
    assert size > 0 and abs(forward - backward) <= 1e-13 * size

    def along(t):
        moved = link.value(*(a + t * d for a, d in zip(x, dx)))
        return sum((a * part).sum() for a, part in zip(y_adj, moved))

    h = 2e-3  # of a hundredth of the values; two steps take the error of h^2 away
    slope = (8 * (along(h) - along(-h)) - (along(2 * h) - along(-2 * h))) / (12 * h)
    assert slope == pytest.approx(forward, abs=2e-8 * size)


def test_links_that_are_wrong_are_noticed(directions):
    """The test above sees a tangent or an adjoint that is off by a thousandth."""
    link = everything().inputs.chain.links[0]

    class Wrong(type(link)):
        def vjp(self, x, y_adj):
            return [1.001 * part for part in super().vjp(x, y_adj)]

    class Off(Wrong):
        def jvp(self, x, dx):
            return [1.001 * part for part in super().jvp(x, dx)]

    x = [MESH.vertices]
    for kind in (Wrong, Off):
        with pytest.raises(AssertionError):
            test_each_link(kind(MESH), x, link.value(*x), directions)


def test_the_chain_is_the_product_of_its_links():
    """Tangents and adjoints of all links together, in one scene with everything."""
    for build in (everything, of_our_own):
        of = build()
        values, rng = of.inputs.at_times(np.linspace(0, 0.3, 4)), np.random.default_rng(1)
        dots = {name: rng.standard_normal(x.shape) for name, x in values.items()}
        tangent = of.inputs.derive_jvp(values, dots)
        adjoint = of.inputs.derive(values).zeros()
        for name, part in adjoint.parts().items():
            if part is not None:
                setattr(adjoint, name, rng.standard_normal(part.shape))
        pulled = of.inputs.derive_vjp(values, adjoint, tuple(values))
        terms = {n: adjoint.parts()[n] * d for n, d in tangent.parts().items() if d is not None}
        forward, size = sum(t.sum() for t in terms.values()), sum(np.abs(t).sum() for t in terms.values())
        assert abs(sum((pulled[n] * dots[n]).sum() for n in values) - forward) <= 1e-13 * size
        assert {n: x.shape for n, x in pulled.items()} == {n: x.shape for n, x in values.items()}


# ---- what is kept ------------------------------------------------------------------------------------------------------


class Counted(Link):
    """y = a x, counting its calls."""

    def __init__(self, reads, writes):
        self.reads, self.writes, self.calls = (reads,), (writes,), []

    def value(self, x):
        self.calls.append("value")
        return (2 * x,)

    def jvp(self, x, dx):
        self.calls.append("jvp")
        return (2 * dx[0],)

    def vjp(self, x, y_adj):
        self.calls.append("vjp")
        return (2 * y_adj[0],)


def fixed_array(*numbers):
    out = np.array(numbers)
    out.flags.writeable = False
    return out


def test_a_link_is_computed_again_only_if_what_it_reads_changed():
    first, second, third = Counted("a", "b"), Counted("b", "c"), Counted("d", "e")
    chain = Chain([first, second, third], ["a", "d"])
    a, d = fixed_array(1.0), fixed_array(2.0)
    for _ in range(3):
        out = chain.value(dict(a=a, d=d))
    assert (out["c"], out["e"]) == (4, 4)
    assert [len(link.calls) for link in chain.links] == [1, 1, 1]
    assert chain.value(dict(a=a, d=fixed_array(5.0)))["e"] == 10
    assert [len(link.calls) for link in chain.links] == [1, 1, 2]
    writable = np.array([3.0])  # may change and stay the same array: never kept
    assert chain.value(dict(a=writable, d=d))["c"] == 12
    writable[0] = 4.0
    assert chain.value(dict(a=writable, d=d))["c"] == 16


class Product(Recording, Link):
    """c = a b^2, counting its calls."""

    reads, writes, calls = ("a", "b"), ("c",), 0

    def value(self, a, b):
        self.calls += 1
        yield a * b * b


@pytest.mark.parametrize("size", [1, Recording.fewest], ids=["by the matrix of derivatives", "by sweeps"])
def test_what_a_link_recorded_is_kept_while_it_holds(size):
    link, a, b, by_c = Product(), fixed_array(*np.arange(1.0, size + 1)), fixed_array(3.0), np.full(size, 0.7)
    first, x = link.vjp([a, b], [by_c]), [a, b]
    assert np.allclose(first[0], 6.3, rtol=1e-15) and first[1] == pytest.approx(4.2 * a.sum(), rel=1e-15)
    for _ in range(20):  # the same bits however often
        assert [*map(np.ndarray.tobytes, link.vjp(x, [by_c]))] == [*map(np.ndarray.tobytes, first)]
    assert link.calls == 1 and (link._record.slopes.size > 0) == (size == 1)
    assert link.jvp([a, b], [np.ones(size), np.ones(1)])[0] == pytest.approx(9.0 + 6.0 * a) and link.calls == 1
    x[1] = fixed_array(5.0)
    assert link.vjp(x, [np.ones(size)])[0] == pytest.approx(25.0) and link.calls == 2
    x[1] = fixed_array(6.0)  # in the list that was recorded
    assert link.vjp(x, [np.ones(size)])[0] == pytest.approx(36.0) and link.calls == 3
    changing = np.zeros(1)
    for number in (2.0, 4.0):  # may change and stay the same array
        changing[0] = number
        assert link.vjp([a, changing], [np.ones(size)])[0] == pytest.approx(number**2)


def test_only_links_on_the_way_are_pulled_back():
    first, second, third = Counted("a", "b"), Counted("b", "c"), Counted("d", "e")
    chain = Chain([first, second, third], ["a", "d"])
    values = dict(a=fixed_array(1.0), d=fixed_array(2.0))
    assert chain.vjp(values, dict(c=np.ones(1), e=np.ones(1), b=None), ["d"]) == dict(d=2.0)
    assert (first.calls, second.calls, third.calls) == ([], [], ["vjp"])
    assert chain.vjp(values, dict(c=np.ones(1), b=np.ones(1), e=None), ["a", "d"]) == dict(a=6.0, d=0.0)
    assert chain.jvp(values, dict(d=np.ones(1))) == dict(d=1.0, e=2.0)
    assert "jvp" not in first.calls + second.calls


def test_a_run_computes_what_changed(monkeypatch):
    """Another modulus leaves rest shape and masses alone, but for records of these; what is handed out cannot be changed."""
    calls = []
    for kind in (RestShape, links.LumpedMass):

        def value(self, *x, of=kind.value):
            calls.extend([type(self)] if isinstance(x[0], np.ndarray) else [])
            return of(self, *x)

        monkeypatch.setattr(kind, "value", value)
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene(terms=[ds.Gravity()]), dt=1e-4), 2, gradients="all")
    for E in (1e4, 2e4, 3e4):
        rollout.vjp(rollout.forward(youngs_modulus=E), np.ones((2, N, 3)))
    assert sorted(map(str, calls)) == sorted(map(str, (RestShape, links.LumpedMass)))
    derived = rollout.scene.inputs.derive(rollout.values)
    for array in (derived.mass, derived.coefficients, rollout.scene.inputs.values["density"]):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


# ---- what an input may be ----------------------------------------------------------------------------------------------


def test_shapes_by_rules():
    """Leading axes, lengths of a mesh or a run, and alternatives: one rule each."""
    sizes = dict(scenes=8, tetrahedra=6, sets=2)
    per_scene = Input("stiffness", None, ((), ("scenes",), ("scenes", "tetrahedra")))
    for shape in ((), (8,), (8, 6)):
        assert per_scene.checked("stiffness", np.ones(shape), sizes).shape == shape
    with pytest.raises(ValueError, match=r"expected one number or shape \(8,\) or shape \(8, 6\), got \(6,\)"):
        per_scene.checked("stiffness", np.ones(6), sizes)
    pressure = Input("pressure", None, (("steps", "sets"),), "Pa", POSITIVE)
    assert pressure.checked("pressure", np.ones((5, 2)), sizes).shape == (5, 2)
    with pytest.raises(ValueError, match=r"expected shape \(steps, 2\), got \(5, 3\)"):
        pressure.checked("pressure", np.ones((5, 3)), sizes)
    with pytest.raises(ValueError, match=r"pressure must be > 0 \[Pa\], got -1"):
        pressure.checked("pressure", -np.ones((5, 2)), sizes)
    with pytest.raises(ValueError, match="pressure: 6 steps need as many rows, got 5"):
        pressure.check_steps("pressure", (5, 2), 6)
    path = Input("path", None, (("steps + 1", 3),))
    path.check_steps("path", (7, 3), 6)
    with pytest.raises(ValueError, match=r"path: expected shape \(7, 3\), got \(8, 3\)"):
        path.check_steps("path", (8, 3), 6)


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("youngs_modulus", np.ones(M + 1), rf"expected one number or shape \({M},\), got \({M + 1},\)"),
        ("external_forces", np.ones((N, 2)), rf"expected shape \({N}, 3\) or shape \(steps, {N}, 3\), got \({N}, 2\)"),
        ("external_forces", np.ones((2, N, 3)), "3 steps need as many rows, got 2"),
        ("barrier_stiffness", -1.0, r"barrier_stiffness must be > 0 \[N/m\], got -1"),
        ("barrier_width", [0.1, 0.1], r"expected one number, got \(2,\)"),
        ("ball.radius", 0.0, r"ball.radius must be > 0 \[m\], got 0"),
        ("ball.center", [0, 1], r"ball.center: expected shape \(3,\), got \(2,\)"),
        ("table.path", np.zeros((3, 3)), r"table.path: expected shape \(4, 3\), got \(3, 3\)"),
        ("ground_path", np.full((4, 3), np.nan), "ground_path must be finite: 12 of 12 values are not"),
        ("prescribed_motion", np.zeros((4, 1, 3)), r"prescribed_motion: expected shape \(steps \+ 1, 9, 3\), got"),
    ],
)
def test_values_that_do_not_fit(name, value, message):
    rollout = ds.Rollout(ds.SemiImplicitSolver(everything(), dt=1e-4), 3)
    with pytest.raises(ValueError, match=message):
        rollout.forward(**{name: value})


@pytest.mark.parametrize("seed", range(4))
def test_numbers_too_many_or_too_few_are_refused(seed):
    """Of springs, muscles, loads and all else that random scenes have, an entry more or less along each axis."""
    checked = set()
    for structure in range(seed, 40, 4):
        try:
            rollout = random_scenes.build(8 * structure + seed).rollout()
        except ValueError:  # a body that starts on an obstacle
            continue
        for name, value in rollout.values.items():
            for axis in range(value.ndim):
                more = np.concatenate([value, value.take([-1], axis)], axis)
                over_time = rollout.scene.inputs.described[name].is_per_step and axis == 0
                for wrong in ([] if over_time else [more]) + ([value.take(range(value.shape[axis] - 1), axis)]):
                    with pytest.raises(ValueError, match=f"^{re.escape(name)}: (expected|.* steps? needs?)"):
                        rollout.forward(**{name: wrong})
                    checked.add(name)
    assert len(checked) > 12


def test_inputs_that_do_not_fit_what_kernels_read():
    class Idle(Term):
        def links(self, names, own):
            return []

    with pytest.raises(ValueError, match="no link reads the input 'idle'"):
        scene(terms=[Idle(Input("idle", []))])

    a, b = Counted("a", "b"), Counted("b", "c")
    for wrong, message in (
        ([b, a], "Counted reads 'b', which is no input and which no link before it writes"),
        ([a, a], "Counted writes 'b', which is an input or written by a link before it"),
        ([a, Counted("b", "a")], "Counted writes 'a', which is an input"),
    ):
        with pytest.raises(ValueError, match=message):
            Chain(wrong, ["a"])

    class Short(ds.Drag):
        num_numbers = 2

    with pytest.raises(ValueError, match=r"Short\(drag_rate=1.\): kernels take 2 numbers and its inputs have 1"):
        scene(terms=[Short(1.0)])
    with pytest.raises(ValueError, match="no input named 'colour'; this scene has initial_positions"):
        scene().inputs.check(dict(colour=1.0))


def test_sizes_of_changes():
    """Places by an edge, paths by an edge per step, velocities by an edge per run, all else by its own size."""
    rollout = ds.Rollout(ds.SemiImplicitSolver(everything(), dt=1e-3), 4)
    edge = float(np.cbrt(np.mean(MESH.volumes)))
    expected = dict.fromkeys(("rest_positions", "prescribed_motion", "ball.center", "table.center"), 0.1 * edge)
    expected |= dict.fromkeys(("ground_path", "table.path"), 0.1 * edge / 4)
    expected |= {"initial_velocities": 0.1 * edge / 4e-3, "gravity": 0.981, "ball.radius": 0.08, "drag_rate": 0.05}
    for name, size in expected.items():
        assert verify.input_scale(rollout, name) == pytest.approx(size, rel=1e-14), name
    assert Input("a", 0.0).change(np.zeros(()), RunSize(1.0, 1, 1.0)) == 0.1


# ---- names -------------------------------------------------------------------------------------------------------------


def named_and_plain():
    """The same scene twice: terms with names, and without."""
    for names in (
        dict(gravity="pull", drag="air", ground="floor", forces="load", contact="skin"),
        dict.fromkeys(("gravity", "drag", "ground", "forces", "contact")),
    ):
        yield scene(
            terms=[
                ds.Gravity(name=names["gravity"]),
                ds.Drag(0.5, name=names["drag"]),
                ds.Ground(0.0, **SOFT, friction=0.4, **PATH, name=names["ground"]),
                ds.ExternalForce(random(4, N, 3), name=names["forces"]),
                ds.SelfContact(300.0, 0.05, name=names["contact"]),
            ]
        )


PLAIN = {
    "pull.acceleration": "gravity",
    "air.rate": "drag_rate",
    "floor.height": "ground_height",
    "floor.stiffness": "barrier_stiffness",
    "floor.width": "barrier_width",
    "floor.friction": "friction",
    "floor.friction_speed": "friction_speed",
    "floor.path": "ground_path",
    "load.forces": "external_forces",
    "skin.stiffness": "self_contact_stiffness",
    "skin.width": "self_contact_width",
}


def test_names_of_terms_begin_those_of_their_inputs():
    """Same motion and same gradients, bit by bit, under other names."""
    rollouts = [ds.Rollout(ds.SemiImplicitSolver(of, dt=1e-3), 4, gradients="all") for of in named_and_plain()]
    named, plain = rollouts
    assert [PLAIN.get(name, name) for name in named.inputs] == list(plain.inputs)
    assert set(PLAIN) < set(named.inputs)
    frames = [rollout.forward() for rollout in rollouts]
    assert np.array_equal(frames[0].positions, frames[1].positions)
    by_named, by_plain = (r.vjp(f, random(*f.positions.shape)) for r, f in zip(rollouts, frames))
    for name in named.inputs:
        assert np.array_equal(by_named[name], by_plain[PLAIN.get(name, name)]), name
    other = named.forward(**{"floor.stiffness": 600.0, "floor.height": -0.05, "load.forces": np.zeros((4, N, 3))})
    same = plain.forward(barrier_stiffness=600.0, ground_height=-0.05, external_forces=np.zeros((4, N, 3)))
    assert np.array_equal(other.positions, same.positions) and not np.array_equal(other.positions, frames[0].positions)


def test_names_of_every_obstacle():
    closed = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
    corners = [[0, -2, 0], [1, -2, 0], [0, -2, 1], [0, -1, 0]]
    terms = [
        ds.HalfSpace([0, -1, 0], name="slope", **SOFT),
        ds.Sphere([0, -5, 0], 1.0, name="ball", **SOFT),
        ds.Box([0, -5, 0], name="box", **SOFT),
        ds.Capsule([0, -5, 0], [1, -5, 0], 1.0, name="arm", **SOFT),
        ds.Cylinder([0, -5, 0], [1, -5, 0], 1.0, name="roll", **SOFT),
        ds.MeshObstacle(corners, closed, name="stone", **SOFT),
    ]
    of, barrier = scene(terms=terms), ("stiffness", "width")
    own = [["point", "normal"], ["center", "radius"], ["center", "size", "rotation"], *[["start", "end", "radius"]] * 2]
    for term, numbers in zip(terms, [*own, ["position", "radius"]]):
        assert list(of.input_names(term).values()) == [f"{term.name}.{number}" for number in (*numbers, *barrier)]


def test_named_terms_by_torch_fields_and_checks():
    torch = pytest.importorskip("torch")
    from diffsim_ti.diff_simulator import rollout_frames

    of = scene(terms=[ds.Gravity(name="pull"), ds.Ground(0.0, **SOFT, **PATH, name="floor")])
    rollout = ds.Rollout(ds.SemiImplicitSolver(of, dt=1e-3), 5)
    numbers = {"floor.height": 0.01, "floor.stiffness": 400.0, "pull.acceleration": [0.1, -9.0, 0.2]}
    tensors = {name: torch.tensor(x, dtype=torch.float64, requires_grad=True) for name, x in numbers.items()}
    rollout_frames(rollout, **tensors).positions.square().sum().backward()
    frames = rollout.forward(**numbers)
    expected = rollout.vjp(frames, 2 * frames.positions)
    for name, tensor in tensors.items():
        assert tensor.grad.numpy() == pytest.approx(expected[name], rel=1e-12), name
    assert rollout.field("floor.path").shape == (6,) and rollout.field("floor.height").shape == ()
    report = ds.check_gradients(rollout, inputs=["floor.height", "floor.stiffness", "floor.path"], verbose=False)
    assert report.passed, report


def test_a_named_load_is_read_step_by_step():
    of = scene(terms=[ds.ExternalForce(random(N, 3), name="load")])
    sim = ds.Simulator(ds.SemiImplicitSolver(of, dt=1e-4))
    sim.set_forces(np.zeros((N, 3)))
    sim.step()
    assert not sim.velocities.any()
    late = scene(terms=[ds.ExternalForce(random(2, N, 3), name="load")])
    with pytest.raises(ValueError, match="load.forces: 3 steps need as many rows, got 2"):
        ds.Rollout(ds.SemiImplicitSolver(late, dt=1e-4), 3).forward()


def test_terms_can_be_copied_and_pickled():
    """Simulators of the torch face are, with their terms."""
    ground = pickle.loads(pickle.dumps(copy.deepcopy(ds.Ground(-1.0, **SOFT, friction=0.2, name="floor"))))
    assert repr(ground) == repr(ds.Ground(-1.0, **SOFT, friction=0.2, name="floor"))
    assert "floor.friction" in scene(terms=[ground]).inputs.names


def test_names_that_are_refused():
    with pytest.raises(ValueError, match=r"two terms have the name 'it': Ground\(name='it', .*Gravity\(name='it'"):
        scene(terms=[ds.Ground(-1.0, stiffness=1e4, name="it"), ds.Gravity(name="it")])
    ground = ds.Ground(-1.0, stiffness=1e4, name="floor")
    with pytest.raises(ValueError, match="two terms have the name 'floor'"):
        scene(terms=[ground, ground])
    for name in ("", "left wall", "a.b", 3):
        with pytest.raises(ValueError, match=r"Ground: name must be a word such as 'floor', got "):
            ds.Ground(-1.0, stiffness=1e4, name=name)


def test_an_input_of_a_term_with_a_name_is_answered_by_that_name():
    of = scene(terms=[ds.Ground(-1.0, stiffness=1e4, name="floor"), ds.Gravity()])
    said = "'ground_height' is here called 'floor.height', for a term has the name 'floor'"
    rollout = ds.Rollout(ds.SemiImplicitSolver(of, dt=1e-4), 1)
    for call in (
        lambda: rollout.forward(ground_height=0.0),
        lambda: ds.Rollout(rollout.solver, 1, gradients=["ground_height"]),
        lambda: rollout.field("ground_height"),
        lambda: ds.Batch(rollout.solver, 1, scenes=2).forward(ground_height=[0.0, 1.0]),
    ):
        with pytest.raises(ValueError, match=said):
            call()
    with pytest.raises(ValueError, match="no input named 'grund_height'; this rollout has [^:]*$"):
        rollout.forward(grund_height=0.0)


def test_names_without_and_with():
    """A term with a name does not count among those that are numbered."""
    of = scene(
        terms=[
            ds.Ground(-1.0, stiffness=1e4, name="low"),
            ds.Ground(-2.0, stiffness=1e4),
            ds.Ground(-3.0, stiffness=1e4),
        ]
    )
    found = [list(of.input_names(term).values())[0] for term in of.terms]
    assert found == ["low.height", "ground_height", "ground_height_2"]


# ---- gradients of a user's own -----------------------------------------------------------------------------------------


def test_gradients_of_inputs_of_our_own():
    """A vector per tetrahedron, a number per step, an angle that a kernel does not know: one link each, nothing else."""
    rollout = ds.Rollout(ds.SemiImplicitSolver(of_our_own(), dt=1e-3), 4, gradients="all")
    names = ["fibre", "wind.strength", "wind.direction", "ramp.angle", "ramp.height", "rest_positions"]
    assert set(names) < set(rollout.inputs)
    report = ds.check_gradients(rollout, inputs=names, verbose=False)
    assert report.passed, report
    assert verify.dot_product_test(rollout) <= 1e-12
