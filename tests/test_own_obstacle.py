"""An obstacle's shape of one's own: a class with a distance, its kernel and what is drawn, in one place."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import diffsim_ti as ds
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

    twin = RingForce

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


@pytest.fixture(scope="module")
def scene():
    """A cube that falls onto a ring, half a barrier's width above it."""
    cube = ds.TetrahedralMesh.create_cube(2, 0.2).translated((-0.11, 0.0, -0.09))
    ring = Ring((0.0, -0.055, 0.0), 0.1, 0.05, stiffness=200.0, width=0.01, friction=0.3)
    return ds.Scene(
        cube,
        ds.StableNeoHookean(1e5, 0.3),
        1000.0,
        [ds.Gravity(), ring],
        initial_velocities=(0.1, -0.5, 0.05),
        precision="f64",
    )


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
