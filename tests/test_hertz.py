"""Slow impact of an elastic ball on a floor against Hertz's theory."""

from functools import lru_cache

import battery_of_surfaces
import numpy as np
import pytest

import diffsim_ti as ds

R, E, DENSITY, DEPTH, WIDTH = 0.1, 1e5, 1000.0, 0.02, 5e-4  # nu = 0; DEPTH and WIDTH are shares of R
FINER_BELOW = 0.6


def ball(cells: int) -> ds.TetrahedralMesh:
    """A cube bent into a ball, then drawn to its lowest point by a conformal map, where tetrahedra are 4 times smaller."""
    box = ds.TetrahedralMesh.create_box(cells + 1, 2.0, pattern="five")
    x = box.vertices - 1
    p, q = np.roll(x * x, 1, 1), np.roll(x * x, 2, 1)
    y = x * np.sqrt(1 - p / 2 - q / 2 + p * q / 3)
    a = np.array([0, FINER_BELOW, 0])
    apart = ((y - a) ** 2).sum(1, keepdims=True)
    y = ((1 - a @ a) * (y - a) - apart * a) / (1 - 2 * (y @ a)[:, None] + (a @ a) * (y * y).sum(1, keepdims=True))
    return ds.TetrahedralMesh(R * y, box.tetrahedra).translated([0, R + WIDTH * R, 0])


@lru_cache
def over_hertz(cells: int) -> np.ndarray:
    """(largest force, contact time, depth), each over what Hertz's theory says for a rigid floor."""
    mesh = ball(cells)
    volume = mesh.volumes.sum()
    stiffness, mass, depth = (
        4 / 3 * E * np.sqrt(R),
        DENSITY * volume,
        DEPTH * R * (volume / (4 / 3 * np.pi * R**3)) ** 0.4,
    )
    speed = np.sqrt(0.8 * stiffness * depth**2.5 / mass)
    expected = stiffness * depth**1.5, 2.9432 * depth / speed, depth
    floor = ds.Ground(stiffness=4000.0, width=WIDTH * R)
    scene = ds.Scene(
        mesh, ds.LinearElastic(E, 0.0), DENSITY, [floor], initial_velocities=[0, -speed, 0], precision="f64"
    )
    dt = expected[1] / 50
    frames = ds.Rollout(ds.BDF2Solver(scene, dt=dt, tolerance=1e-6), 80, save_every=1).forward()
    weights = ds.Simulator(ds.BDF2Solver(scene, dt=dt))._start.mass[:, None] / mass
    height, velocity = ((weights * x).sum(1)[:, 1] for x in (frames.positions, frames.velocities))
    force = mass * np.gradient(velocity, dt)
    touching = np.nonzero(force > 0.01 * force.max())[0]
    found = force.max(), (touching[-1] - touching[0]) * dt, height[0] - height.min() - 0.7 * WIDTH * R
    return np.array(found) / expected


def test_slow_impact_of_a_ball_converges_to_hertz():
    """First order in the mesh width, as tetrahedra under the edge of the contact are: extrapolated within 5 %.

    Measured with 6, 9, 12 and 20 cells: force 1.097, 1.066, 1.053, 1.043; time 0.873, 0.905, 0.915, 0.925; depth 0.868,
    0.908, 0.927, 0.943.
    """
    coarse, fine = over_hertz(6), over_hertz(9)
    assert np.all(np.abs(fine - 1) < 0.75 * np.abs(coarse - 1) + 0.01)
    np.testing.assert_allclose(fine + 2 * (fine - coarse), 1, atol=0.05)


@pytest.mark.thorough
def test_a_meshed_ball_presses_a_block_as_the_ball_itself_does():
    """Force and radius of the contact within a percent on the same block, by a ball of 20 480 triangles with its volume,
    which is so large that both act at the vertices of the block alone.

    The radius a is that of Hertz's pressure, whose mean of r^2 is 2/5 a^2.
    """
    width, depth, size = 0.002, 0.004, 0.4
    block = ds.TetrahedralMesh.create_box((11, 4, 11), size=(0.12, 0.04, 0.12)).translated([-0.06, -0.04, -0.06])
    fixed = np.flatnonzero(block.vertices[:, 1] < -0.04 + 1e-9)
    x, triangles = battery_of_surfaces.ball(5, size)
    x *= size * (4 / 3 * np.pi / (np.linalg.det(x[triangles]).sum() / 6)) ** (1 / 3)
    options = dict(stiffness_per_area=2e9, width=width, path=lambda t: [0, -depth * t, 0])
    middle, found = [0.0, size + width, 0.0], []
    for ball in (ds.Sphere(middle, size, **options), ds.MeshObstacle(x, triangles, middle, **options)):
        scene = ds.Scene(block, ds.LinearElastic(E, 0.3), DENSITY, [ball], fixed=fixed, precision="f64")
        output = ds.ContactForce(ball, per_vertex=True)
        rollout = ds.Rollout(ds.StaticSolver(scene, load_steps=4, tolerance=1e-8), 1, save_every=1, outputs=output)
        frames = rollout.forward()
        force, place = -frames["contact_force"][-1][:, 1], frames.positions[-1]
        radius = np.sqrt(2.5 * (force * (place[:, 0] ** 2 + place[:, 2] ** 2)).sum() / force.sum())
        found.append([force.sum(), radius])
    by_ball, by_mesh = found
    np.testing.assert_allclose(by_mesh, by_ball, rtol=0.01)
    assert by_ball[0] > 10 and by_ball[1] > 0.02
