from dataclasses import dataclass

import numpy as np
import diffsim_ti as ds
from diffsim_ti.materials import invariants

ds.init(precision="f64")

@dataclass(frozen=True)
class PowerLaw(ds.EnergyLaw):
    coefficient_names = ("mu", "lam", "b", "n")

    def psi(self, H, p):  # energy density [J/m^3] by H, the displacement gradient: F = I + H
        mu, lam, b, n = p
        _, j, s = invariants(H)  # J - 1, and I_C - 3 - 2 (J - 1), accurate near rest
        return mu / (2 * b) * ((1 + b / n * s) ** n - 1) + lam / 2 * j * j

class Knowles(ds.Material):
    spellings = (("youngs_modulus", "poissons_ratio", "b", "n"),)  # how users may give its numbers
    units = {"b": "-", "n": "-"}

    def law(self, precision):
        return PowerLaw(precision)


mesh = ds.TetrahedralMesh.create_box((4, 2, 2), (0.3, 0.1, 0.1))
law = Knowles(youngs_modulus=1e5, poissons_ratio=0.3, b=1.0, n=0.8)
scene = ds.Scene(mesh, law, terms=[ds.Gravity()], fixed="xmin")

print(chr(0))
from diffsim_ti.outputs import Change, Output

class Spread(Output):
    """Variance of the vertices' x [m^2], shape (frames,)."""

    name, unit = "spread", "m^2"

    def shape(self, num_frames):
        return (num_frames,)

    def _off(self, frames):
        x = frames.positions[:, :, 0].astype(np.float64)
        return x - x.mean(1, keepdims=True)

    def value(self, frames):
        return (self._off(frames) ** 2).mean(1)

    def jvp(self, frames, change):
        if change.positions is None:
            return np.zeros(len(frames.positions))
        return 2 * (self._off(frames) * change.positions[:, :, 0]).mean(1)

    def vjp(self, frames, seed):
        by_positions = np.zeros(frames.positions.shape)
        by_positions[:, :, 0] = 2 * self._off(frames) * seed[:, None] / frames.positions.shape[1]
        return Change(positions=by_positions)


rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-2), steps=20, outputs=[Spread()])
frames = rollout.forward()
by = rollout.vjp(frames, spread=np.array([0.0, 1.0]))
print(f"spread {1e4 * frames['spread'][-1]:.4f} cm^2, by the exponent {1e4 * by['n']:.5f} cm^2")
assert ds.dot_product_test(rollout) < 1e-10

print(chr(0))
assert ds.check_gradients(rollout, inputs=["youngs_modulus", "b", "n"]).passed

print(chr(0))
from diffsim_ti.runtime import traced
from diffsim_ti.terms import Obstacle
from diffsim_ti.terms.obstacles.obstacle import ObstacleForce

@dataclass(frozen=True)
class RingForce(ObstacleForce):
    count = 5  # numbers: centre, radius, thickness

    @traced
    def distance_and_normal(self, g, p, X, u):  # of the point X + u; g has sqrt and others
        x, y, z = ((a - c) + b for a, c, b in zip(X, p[:3], u))
        across = g.sqrt(x * x + z * z)
        out = across - p[3]
        length = g.sqrt(out * out + y * y)
        return length - p[4], [out / length * (x / across), y / length, out / length * (z / across)]

class Ring(Obstacle):
    counterpart = RingForce

    def __init__(self, center, radius, thickness, **options):
        super().__init__(dict(ring_center=center, ring_radius=radius, ring_thickness=thickness), **options)

    def distance(self, positions):
        x, y, z = (positions - self.values["ring_center"]).T
        return np.hypot(np.hypot(x, z) - self.values["ring_radius"], y) - self.values["ring_thickness"]


cube = ds.TetrahedralMesh.create_cube(resolution=2, size=0.2).translated((-0.11, 0.0, -0.09))
ring = Ring((0.0, -0.055, 0.0), 0.1, 0.05, stiffness=200.0, width=0.01)
falls = ds.Scene(cube, ds.StableNeoHookean(1e5, 0.3), 1000.0, [ds.Gravity(), ring])
touching = ds.Rollout(ds.SemiImplicitSolver(falls, dt=2e-3), 10, gradients=["ring_radius"])
assert touching.forward().contact_resolution.obstacle is not None and ds.dot_product_test(touching) < 1e-10

print(chr(0))
from diffsim_ti.picture import save_picture

size = 1e3 * np.linalg.norm(frames.displacements[-1], axis=1)
save_picture("extend.png", mesh, frames.positions[-1], size, "displacement [mm]", size=(600, 400))
