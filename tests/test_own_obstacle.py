"""An obstacle's shape of one's own, and a force of one's own: what a user writes outside the package."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import taichi as ti

import diffsim_ti as ds
from diffsim_ti.inputs import Input
from diffsim_ti.inputs.links import PerStep
from diffsim_ti.mechanics.host_force import HostForce
from diffsim_ti.mechanics.interaction import Interaction, VertexwiseForce
from diffsim_ti.obstacles import obstacle_surfaces, revolved
from diffsim_ti.runtime import traced
from diffsim_ti.terms.obstacles.obstacle import Obstacle, ObstacleForce
from diffsim_ti.visual.drawing import Drawing


@dataclass(frozen=True)
class RingForce(ObstacleForce):
    """d = |(|(x, z) - center| - radius, y - center)| - thickness."""

    count = 5

    @traced
    def distance_and_normal(self, g, p, X, u):
        x, y, z = ((a - c) + b for a, c, b in zip(X, p[:3], u))
        across = g.sqrt(x * x + z * z)
        out = across - p[3]
        length = g.sqrt(out * out + y * y)
        return length - p[4], [out / length * (x / across), y / length, out / length * (z / across)]


class Ring(Obstacle):
    """A ring that lies flat: all points within `thickness` [m] of a circle of `radius` [m] about `center` [m]."""

    counterpart = RingForce

    def __init__(self, center, radius: float, thickness: float, **options):
        super().__init__(dict(ring_center=center, ring_radius=radius, ring_thickness=thickness), **options)

    def distance(self, positions):
        x, y, z = (positions - self.values["ring_center"]).T
        out = np.hypot(x, z) - self.values["ring_radius"]
        return np.hypot(out, y) - self.values["ring_thickness"]

    def surface(self, size):
        angle, thickness = np.linspace(0, 2 * np.pi, 33), float(self.values["ring_thickness"])
        radius = self.values["ring_radius"] - thickness * np.cos(angle)
        return revolved(self.values["ring_center"], (0.0, 1.0, 0.0), -thickness * np.sin(angle), radius)


def ring(**options):
    return Ring((0.0, -0.055, 0.0), 0.1, 0.05, stiffness=200.0, width=0.01, friction=0.3, **options)


@pytest.fixture(scope="module")
def scene():
    """A cube that falls onto a ring, half a barrier's width above it."""
    cube = ds.TetrahedralMesh.create_cube(2, 0.2).translated((-0.11, 0.0, -0.09))
    law, terms = ds.StableNeoHookean(1e5, 0.3), [ds.Gravity(), ring(by_pairs=False)]
    return ds.Scene(cube, law, 1000.0, terms, initial_velocities=(0.1, -0.5, 0.05), precision="f64")


def test_that_it_does_not_act_between_vertices_is_said(scene):
    """Unless it was asked for, as in the scene."""
    with pytest.warns(UserWarning, match="Ring.*acts at their vertices alone: .* or pass by_pairs=False"):
        scene.replace(terms=[ring()])


def test_its_gradients_are_those_of_the_run(scene):
    assert {"ring_center", "ring_radius", "ring_thickness"} <= set(scene.inputs.values)
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=2e-4), 20, gradients="all")
    assert rollout.forward().contact_resolution.obstacle is not None  # it is touched
    assert ds.dot_product_test(rollout) < 1e-10
    loss = lambda frames: (float(frames.positions[-1, :, 1].sum()), *_up(frames))  # noqa: E731
    assert ds.check_gradients(rollout, loss, inputs=["ring_center", "ring_radius"]).passed


def _up(frames):
    by_positions = np.zeros(frames.positions.shape)
    by_positions[-1, :, 1] = 1
    return by_positions, None


def test_it_is_drawn(scene):
    ((points, triangles),) = obstacle_surfaces(scene)
    assert np.abs(scene.terms[1].distance(points)).max() < 1e-12
    a, b, c = (points[triangles[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert volume == pytest.approx(2 * np.pi**2 * 0.1 * 0.05**2, rel=0.03)  # closed, and faces outwards
    with Drawing(scene.mesh, (160, 120), obstacles=[(points, triangles)], backend="software") as drawing:
        image = drawing.image(scene.mesh.vertices).astype(float)
    grey = (np.ptp(image, axis=2) < 8) & (image.mean(2) < 200)
    assert grey.sum() > 300


MOVED = ([0.0, 1.0], [[0.0] * 6, [0.1, 0.0, 0.0, 0.0, 0.2, 0.0]])  # a pose over time
TERMS = {
    "smooth": ds.Ground(-0.1),
    "rough": ds.Sphere((0.0, -1.0, 0.0), 0.5, friction=0.3),
    "turning": ds.Box((0.0, -1.0, 0.0), 0.5, path=MOVED),
    "rough, turning, of a user": Ring((0.0, -1.0, 0.0), 0.1, 0.05, stiffness=200.0, friction=0.3, path=MOVED),
    "surfaces": ds.SelfContact(friction={("a", "b"): 0.2, ("a", "c"): 0.3}),
    "fluid": ds.SurfaceDrag(),
}


@pytest.mark.parametrize("term", TERMS.values(), ids=TERMS)
def test_parameters_that_kernels_read_by_name_stand_where_the_inputs_are(term):
    inputs = [described for described in term.described if described.value is not None]
    starts = np.cumsum([0, *(i.value.size for i in inputs)]).tolist()
    of_term = term if hasattr(term, "index") else replace(term.kernel("f64"), turns=term.turns)
    named = {name: at for name, at in vars(of_term.index).items() if name not in ("shape", "end")}
    first = min(named.values())  # what comes before is of the shape
    assert named == {i.name.removesuffix("_per_area"): at for i, at in zip(inputs, starts) if at >= first}


# ---- a force of one's own: a term, its Taichi functions, its host form ---------------------------------------------------


def tether(u, v, k, c, d):
    """f = -k (u - d) - c v, for kernels and for the host."""
    return -k * (u - d) - c * v


def tether_jvp(u, v, du, dv, k, c, d, dk, dc, dd):
    return -dk * (u - d) - k * (du - dd) - dc * v - c * dv


VALUE, JVP = ti.func(tether), ti.func(tether_jvp)


@dataclass(frozen=True)
class TetherForce(VertexwiseForce):
    """Of each vertex; its numbers k, c, d stand in the parameters from `first` on."""

    first: int
    name, reads_rates, adjoints = "tethered", True, dict(by_tether="vectors")

    @traced
    def sizes(self, plan):
        return dict(by_tether=2 * plan.num_vertices)

    @ti.func
    def numbers(self, p: ti.template()):
        n = ti.static(self.first)
        return p[n], p[n + 1], self.vector(p[n + 2], p[n + 3], p[n + 4], ti.cast(0, self.fp))

    @ti.func
    def force(self, i, u, v, now: ti.template(), scene: ti.template()):
        k, c, d = self.numbers(scene.parameters)
        return VALUE(u, v, k, c, d)

    @ti.func
    def force_jvp(self, i, u, v, du, dv, now: ti.template(), scene: ti.template(), tangent: ti.template()):
        k, c, d = self.numbers(scene.parameters)
        dk, dc, dd = self.numbers(tangent.parameters)
        return JVP(u, v, du, dv, k, c, d, dk, dc, dd)

    @ti.func
    def force_vjp(self, i, u, v, w, now: ti.template(), scene: ti.template(), adjoint: ti.template()):
        k, c, d = self.numbers(scene.parameters)
        zero = ti.cast(0, self.fp)
        adjoint.by_tether[2 * i] += self.vector(w.dot(d - u), -v.dot(w), zero, zero)
        adjoint.by_tether[2 * i + 1] += k * w
        return -k * w, -c * w


class TetherOnHost(HostForce):
    symmetric = reads_velocities = True

    def __init__(self, rows: slice):
        self.rows = rows

    def numbers(self, values):
        p = values.parameters[self.rows]
        return p[0], p[1], p[2:]

    def forces(self, u):
        return tether(u, self.velocities(u), *self.numbers(self.values))


class Tethers(Interaction):
    name = "tethered"

    @property
    def first(self):
        return self.scene.inputs.parameters.first(self.terms[0])

    def kernel(self, values, precision, shape):
        return TetherForce(precision, self.first)

    def host(self):
        return TetherOnHost(self.scene.inputs.parameters.of(self.terms[0]))

    def adjoints(self, values, shape):
        return dict(by_tether=(2 * self.mesh.num_vertices,))

    def collect(self, found, out, shape):
        by_each = found["by_tether"]
        out.parameters[..., self.first : self.first + 2] += by_each[..., ::2, :2].sum(-2)
        out.parameters[..., self.first + 2 : self.first + 5] += by_each[..., 1::2, :].sum(-2)


class Tether(ds.terms.Term):
    """Each vertex is drawn to where it is at rest, shifted by d [m], through a fluid; one in a scene."""

    interaction = Tethers

    def __init__(self, k, c, d):
        super().__init__(Input("tether_k", k, ((),), "N/m"), Input("tether_c", c, ((),)), Input("tether_d", d, ((3,),)))


@dataclass(frozen=True)
class SwingForce(VertexwiseForce):
    """f = b of the step that each kick lies in, alike on all vertices: rows of steps that scenes have for it alone."""

    name, asks_for_steps = "swing", True
    derived, adjoints = dict(swing="vectors2"), dict(by_swing="vectors2")

    @traced
    def sizes(self, plan):
        return super().sizes(plan) | dict(by_swing=plan.num_vertices)

    @ti.func
    def mean(self, now: ti.template(), rows: ti.template()):
        return now.share0 * rows[now.force0, 0] + now.share1 * rows[now.force1, 0]

    @ti.func
    def force(self, i, u, v, now: ti.template(), scene: ti.template()):
        return self.mean(now, scene.swing)

    @ti.func
    def force_jvp(self, i, u, v, du, dv, now: ti.template(), scene: ti.template(), tangent: ti.template()):
        return self.mean(now, tangent.swing)

    @ti.func
    def force_vjp(self, i, u, v, w, now: ti.template(), scene: ti.template(), adjoint: ti.template()):
        for row, share in ti.static(((now.force0, now.share0), (now.force1, now.share1))):
            adjoint.by_swing[row, i] = adjoint.by_swing[row, i] + share * w
        return self.vector(0), self.vector(0)


class SwingOnHost(HostForce):
    symmetric = True

    def place(self, rows):
        return min(self.instant.schedule.row(self.instant.j), len(rows) - 1)

    def forces(self, u):
        return self.instant.load * self.values.swing[self.place(self.values.swing)] + np.zeros_like(u)

    def jvp(self, u, du, dv, moved=None):
        none = np.zeros_like(u)
        return none if moved is None else self.instant.load * moved.swing[self.place(moved.swing)] + none

    def vjp(self, u, w, adj=None):
        if adj is not None:
            adj.swing[self.place(adj.swing)] += self.instant.load * w.sum(0)
        return np.zeros_like(w), 0.0


class Swings(Interaction):
    name, derived = "swing", SwingForce.derived

    def kernel(self, values, precision, shape):
        return SwingForce(precision)

    def host(self):
        return SwingOnHost()

    def adjoints(self, values, shape):
        return dict(by_swing=(len(values.swing), self.mesh.num_vertices))

    def collect(self, found, out, shape):
        out.swing[..., 0, :] += found["by_swing"].sum(-2)


class Swing(ds.terms.Term):
    interaction, num_numbers = Swings, 0

    def __init__(self, b):
        super().__init__(Input("swing_force", b, (("steps", 1, 3),), "N"))

    def links(self, names, own):
        return [PerStep(names["swing_force"], "swing", 3)]


@pytest.fixture(scope="module")
def tethered():
    cube, law = ds.TetrahedralMesh.create_cube(2, 0.2), ds.StableNeoHookean(1e4, 0.3)
    swing = np.tile([0.5, 0.0, -0.2], (100, 1, 1))
    swing[:3] += 0.01 * np.random.default_rng(4).normal(size=(3, 1, 3))  # a little, for steps of other lengths
    terms = [ds.Gravity(), Tether(20.0, 30.0, [0.01, 0.02, 0.0]), ds.ElasticFoundation(1e3, 1e3, "xmin"), Swing(swing)]
    velocities = dict(initial_velocities=(0.1, -0.5, 0.05))
    return ds.Scene(cube, law, 1000.0, terms, "ymin", precision="f64", **velocities)


@pytest.mark.parametrize("kind", [ds.VelocityVerletSolver, ds.BDF2Solver, ds.StaticSolver], ids=lambda s: s.__name__)
def test_a_force_of_ones_own_acts_in_every_solver(tethered, kind):
    options = dict(dt=2e-4) if kind.explicit else dict(dt=5e-3, tolerance=1e-12)
    rollout = ds.Rollout(kind(tethered, **options), 3, gradients="all")
    assert ds.dot_product_test(rollout) < 1e-9
    names = ["tether_k", "tether_d", "swing_force"] + ["tether_c"] * (kind is not ds.StaticSolver)
    assert ds.check_gradients(rollout, inputs=names).passed


def test_implicit_and_explicit_steps_have_the_same_force(tethered):
    explicit = ds.Rollout(ds.VelocityVerletSolver(tethered, dt=1e-4), 100).forward().positions[-1]
    implicit = ds.Rollout(ds.ImplicitMidpointSolver(tethered, dt=5e-4), 20).forward().positions[-1]
    way = np.abs(explicit - tethered.mesh.vertices).max()
    assert np.abs(explicit - implicit).max() < 1e-3 * way


def test_a_force_of_ones_own_acts_in_batches_and_step_by_step(tethered):
    """With numbers of its own, some of which are rows of steps."""
    solver = ds.VelocityVerletSolver(tethered, dt=2e-4)
    swing = tethered.inputs.values["swing_force"] * np.array([1.0, 40.0, -40.0])[:, None, None, None]
    swing[1:, 1] = 0.0  # steps differ
    found = ds.Batch(solver, 3, 3, lanes=True).forward(swing_force=swing).positions
    for b in range(3):
        alone = ds.Rollout(solver, 3).forward(swing_force=swing[b]).positions
        np.testing.assert_allclose(found[b], alone, rtol=0, atol=1e-15)
    one = dict(swing_force=swing[1], tether_c=0.0)  # steps that come one by one end with a kick, whose velocity c sees
    simulator = ds.Simulator(ds.VelocityVerletSolver(tethered.with_values(one), dt=2e-4))
    simulator.run(3)
    alone = ds.Rollout(solver, 3).forward(**one).positions
    np.testing.assert_allclose(simulator.positions, alone[-1], rtol=0, atol=1e-15)


class OnHostAlone(Tethers):
    kernel = Interaction.kernel


class TetherOnHostAlone(Tether):
    interaction = OnHostAlone


def test_what_lacks_a_kernel_is_refused_by_explicit_solvers(tethered, monkeypatch):
    scene = tethered.replace(terms=TetherOnHostAlone(20.0, 30.0, [0.01, 0.02, 0.0]))
    ds.ImplicitEulerSolver(scene)
    with pytest.raises(ValueError, match="OnHostAlone has no `kernel`"):
        ds.VelocityVerletSolver(scene, dt=1e-4)
    monkeypatch.setattr(OnHostAlone, "host", Interaction.host)
    with pytest.raises(ValueError, match="OnHostAlone has no `host`"):
        ds.Rollout(ds.ImplicitEulerSolver(scene), 1).forward()


class Well(HostForce):
    """E = 2 |u|^2 of each vertex."""

    has_energy = True

    def energies(self, u):
        return 2 * (u**2).sum(1)


def test_an_energy_of_ones_own_is_counted_unless_it_is_said_otherwise():
    assert Well().stored(np.ones((3, 3))) == {"Well": 18.0} and TetherOnHost(slice(0, 5)).stored(np.ones((3, 3))) == {}
