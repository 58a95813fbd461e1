"""Friction where points within faces push, in implicit steps and equilibria: Coulomb's law, and gradients."""

import numpy as np
import pytest
from contact_scenes import SHAPES, tetrahedron

import diffsim_ti as ds

G = 9.81


def test_a_block_slides_on_rails_that_no_vertex_meets():
    """Rails lie between the rows of vertices: friction is mu N, and the block gathers speed as g (sin - mu cos)."""
    mu, tangent, dt = 0.3, 0.5, 5e-3
    rails = [
        ds.Cylinder((-1, -0.016, z), (1, -0.016, z), 0.01, width=5e-3, friction=mu, name=name)
        for name, z in (("left", 1 / 30), ("right", 2 / 30))
    ]
    down = G / np.hypot(1, tangent)
    mesh = ds.TetrahedralMesh.create_box(4, size=0.1)
    gravity = ds.Gravity([tangent * down, -down, 0])
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.3), terms=[gravity, *rails], precision="f64")
    parts = [ds.ContactForce(r, part, name=f"{r}_{part}") for r in ("left", "right") for part in ("normal", "friction")]
    rollout = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=dt), 25, save_every=1, outputs=parts)
    frames = rollout.forward()
    normal, friction = (frames[f"left_{part}"] + frames[f"right_{part}"] for part in ("normal", "friction"))
    assert normal[1, 1] < 1e-3 and np.all(friction[-12:, 0] < 0)  # it falls by a millimetre first
    # N is that where the step begins; normals of points on a rail tilt a little
    np.testing.assert_allclose(-friction[-12:, 0], mu * normal[-13:-1, 1], rtol=2e-3)
    speed = frames.velocities[:, :, 0].mean(1)
    expected = tangent * down - mu * normal[-13:-1, 1].mean() / 1.0  # [m/s^2]; it weighs a kilogram and still bounces
    assert (speed[-1] - speed[-13]) / (12 * dt) == pytest.approx(expected, rel=1e-2)


def dragged() -> ds.Rollout:
    """Equilibria of a ball that is pressed between the vertices of a held block and dragged."""

    def way(t):
        return 8e-3 * max(t - 1, 0), -6e-3 * min(t, 1), 2e-3 * t

    rough = dict(friction=0.35, friction_speed=1e-3, path=way, name="ball", width=2e-3, stiffness_per_area=5e6)
    ball = ds.Sphere((0.02, 0.0285, 0.02), 0.008, **rough)
    mesh = ds.TetrahedralMesh.create_box((4, 3, 4), size=(0.04, 0.02, 0.04))
    scene = ds.Scene(mesh, ds.StableNeoHookean(5e4, 0.3), terms=[ball], fixed="ymin", precision="f64")
    outputs = [ds.ContactForce("ball", name="force"), ds.ContactForce("ball", "friction", name="drag", per_vertex=True)]
    solver = ds.StaticSolver(scene, tolerance=1e-13)
    return ds.Rollout(solver, 2, save_every=1, outputs=outputs, gradients="all")


def test_gradients_of_forces_and_places():
    """Reverse, tangent, and differences, where the ball drags the block along; the fuzz has other solvers."""
    rollout = dragged()
    frames, rng = rollout.forward(), np.random.default_rng(0)
    assert np.abs(frames["drag"]).sum() > 0.5
    weights = {name: rng.standard_normal(frames[name].shape) for name in ("force", "drag")}
    weights["positions"] = 1e3 * rng.standard_normal(frames.positions.shape)
    gradients = rollout.vjp(frames, **weights)

    def along(of) -> float:
        return sum(float((w * of(name)).sum()) for name, w in weights.items())

    lengths = {"rest_positions": 1e-3, "ball.path": 1e-3}
    for name in ["ball.friction", "ball.friction_speed", "ball.radius", *lengths]:
        base = rollout.values[name]
        d = rng.standard_normal(base.shape) * lengths.get(name, np.abs(base).max())
        tangents = dict(rollout.tangents(frames, **{name: d}), positions=rollout.jvp(frames, **{name: d})[0])
        tangent, reverse = along(tangents.get), float((gradients[name] * d).sum())
        size = sum(float(np.linalg.norm(w * tangents[n])) for n, w in weights.items())
        assert abs(tangent - reverse) < 1e-8 * size, name
        found = []
        for h in (1e-4, 1e-3, 1e-2):  # friction has kinks of second order
            one, other = (rollout.forward(**{name: base + s * h * d}) for s in (1, -1))
            found.append(along(lambda n: (one[n] - other[n]) / (2 * h)) - reverse)
            if abs(found[-1]) < 1e-5 * size:
                break
        assert min(map(abs, found)) < 1e-4 * size, (name, found, size)


def test_friction_on_a_sampled_distance_is_across_its_normal(vertices_alone):
    """A coarse grid, whose gradients are not of length one: friction in explicit steps is mu N, and across N."""
    rough = dict(width=0.06, friction=0.3, friction_speed=1e-3, name="mesh")
    term = SHAPES["mesh"](stiffness=300.0, path=lambda t: [20.0 * t, 0, 3.0 * t], **rough)
    scene = ds.Scene(tetrahedron(0.02), ds.StableNeoHookean(2e4, 0.3), 100.0, [term], precision="f64")
    parts = [ds.ContactForce("mesh", part, name=part, per_vertex=True) for part in ("normal", "friction")]
    frames = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-4), 3, save_every=1, outputs=parts).forward()
    normal, friction = frames["normal"][1:], frames["friction"][1:]
    N, F = np.linalg.norm(normal, axis=2), np.linalg.norm(friction, axis=2)
    touching = N > 1e-6
    assert touching.sum() >= 9
    np.testing.assert_allclose(F[touching], 0.3 * N[touching], rtol=1e-9)
    assert np.abs((normal * friction).sum(2)[touching]).max() < 1e-12 * (N * F)[touching].max()
