"""Friction where points within faces push, in explicit and implicit steps and equilibria: Coulomb's law, and gradients."""

import numpy as np
import pytest
from quadratic_meshes import ball
from test_every_adjoint import assert_transposed

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
    for names in (["ball.friction", "ball.friction_speed"], ["ball.radius", *lengths]):  # along all of them at once
        base = {name: rollout.values[name] for name in names}
        d = {n: rng.standard_normal(x.shape) * lengths.get(n, np.abs(x).max()) for n, x in base.items()}
        tangents = dict(rollout.tangents(frames, **d), positions=rollout.jvp(frames, **d)[0])
        tangent, reverse = along(tangents.get), sum(float((gradients[n] * x).sum()) for n, x in d.items())
        size = sum(float(np.linalg.norm(w * tangents[n])) for n, w in weights.items())
        assert abs(tangent - reverse) < 1e-8 * size, names
        found = []
        for h in (1e-4, 1e-3, 1e-2):  # friction has kinks of second order
            one, other = (rollout.forward(**{n: base[n] + s * h * d[n] for n in names}) for s in (1, -1))
            found.append(along(lambda n: (one[n] - other[n]) / (2 * h)) - reverse)
            if abs(found[-1]) < 1e-5 * size:
                break
        assert min(map(abs, found)) < 1e-4 * size, (names, found, size)


# ---- a stage of explicit passes --------------------------------------------------------------------------------------


def under_a_roller(way, precision="f64", mu=0.35, eps=0.1, **options) -> ds.Scene:
    """A block that slides below a ball, or a capsule that turns, between whose vertices it is pressed."""
    rough = dict(friction=mu, friction_speed=eps, path=way, name="roller", width=2e-3)
    rough |= options or dict(stiffness_per_area=5e6)
    if way is not None and len(way(0.0)) == 6:
        ends = (0.0, 0.0268, 0.018), (0.04, 0.0268, 0.022)
        roller = ds.Capsule(*ends, 0.006, about=(0.02, 0.03, 0.02), **rough)
    else:
        roller = ds.Sphere((0.02, 0.0285, 0.02), 0.008, **rough)
    mesh = ds.TetrahedralMesh.create_box((4, 3, 4), size=(0.04, 0.02, 0.04))
    terms, v = [roller, ds.Gravity(), ds.Drag(5.0)], np.tile([0.4, 0.3, -0.2], (mesh.num_vertices, 1))
    return ds.Scene(
        mesh, ds.StableNeoHookean(5e4, 0.3), 1000.0, terms, initial_velocities=v, precision=precision, fixed=[0]
    )


def moving(t):
    return np.array([0.4 * t, -0.1 * t, 0.2 * t])


def turning(t):
    return np.array([0.4 * t, -0.1 * t, 0.2 * t, 8 * t, 0.1, -5 * t])


def rubbed(scene, solver=ds.SemiImplicitSolver, steps=4, **options) -> ds.Rollout:
    dt, per_vertex = 0.3 * ds.stable_dt(scene).dt, dict(per_vertex=True)
    outputs = [
        ds.ContactForce("roller", name="force"),
        ds.ContactForce("roller", "friction", name="drag", **per_vertex),
    ]
    options = dict(save_every=1, outputs=outputs, gradients="all", checkpoint_every=2) | options
    return ds.Rollout(solver(scene, dt=3 * dt, substeps=3), steps, **options)


@pytest.mark.parametrize(
    "way, solver, precision, options",
    [
        (None, ds.VelocityVerletSolver, "f64", dict(stiffness=500.0)),
        pytest.param(moving, ds.SemiImplicitSolver, "f32", {}, marks=pytest.mark.backends),
        (turning, ds.VelocityVerletSolver, "f64", {}),
    ],
)
def test_the_adjoint_of_the_stage_is_the_transpose_of_its_tangent(way, solver, precision, options):
    """Of all numbers, with the forces of friction among the outputs."""
    rollout = rubbed(under_a_roller(way, precision, **options), solver)
    assert np.abs(rollout.forward()["drag"]).sum() > 1
    assert_transposed(rollout, {"f64": 1e-10, "f32": 2e-3}[precision])


def test_paths_are_felt_in_passes_that_open_no_step():
    """Kicks in stages come near in the last pass of a substep alone."""
    scene = under_a_roller(moving).replace(material=ds.KelvinVoigt(ds.StableNeoHookean(5e4, 0.3), time=1e-4))
    dt = 0.2 * ds.stable_dt(scene).dt
    solver = ds.SemiImplicitSolver(scene, dt=2 * dt, substeps=2, viscous_stages=3)
    assert_transposed(ds.Rollout(solver, 3, save_every=1, gradients="all"), 1e-10)


def test_gradients_of_the_stage_are_those_of_differences():
    names = "initial_velocities density roller.radius roller.friction roller.friction_speed roller.about rest_positions"
    names += " roller.path roller.width"
    assert ds.check_gradients(rubbed(under_a_roller(turning)), inputs=names.split(), verbose=False).passed


def test_a_block_slides_on_rails_by_explicit_steps():
    """As in implicit ones, once it rests on them; and what it gains is what its weight and the rails give it."""
    mu, tangent = 0.3, 0.5
    down = G / np.hypot(1, tangent)
    rail = ds.Cylinder((-1, -0.016, 0.05), (1, -0.016, 0.05), 0.01, width=5e-3, friction=mu, name="rail")
    others = [ds.Cylinder((-1, -0.016, z), (1, -0.016, z), 0.01, width=5e-3, friction=mu) for z in (0.02, 0.08)]
    mesh = ds.TetrahedralMesh.create_box(4, size=0.1)
    terms = [ds.Gravity([tangent * down, -down, 0]), *others]
    scene = ds.Scene(mesh, ds.KelvinVoigt(ds.StableNeoHookean(4e5, 0.3), time=1e-3), terms=terms, precision="f64")
    substeps = int(np.ceil(5e-3 / (0.4 * ds.stable_dt(scene).dt)))
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, 5e-3, substeps), 80, save_every=1, gradients=[])
    frames = rollout.forward()
    speed = frames.velocities[:, :, 0].mean(1)
    assert np.polyfit(frames.times[30:], speed[30:], 1)[0] == pytest.approx((tangent - mu) * down, rel=0.02)
    scene = scene.replace(terms=[ds.Gravity(), rail])
    alone = ds.SemiImplicitSolver(scene.replace(initial_velocities=[0.3, 0, 0]), 5e-3, substeps)
    frames = ds.Rollout(alone, 6, save_every=1, outputs=ds.ContactForce("rail", name="rail"), gradients=[]).forward()
    mass = scene.inputs.derive(scene.inputs.values).mass[:, None]
    gained = (mass * (frames.velocities[-1] - frames.velocities[0])).sum(0)
    pushed = 5e-3 * (frames["rail"][1:] + mass.sum() * np.array([0, -9.81, 0])).sum(0)
    assert pushed[0] < -1e-2
    np.testing.assert_allclose(gained, pushed, rtol=0, atol=1e-9)


def test_a_curved_ball_rolls_down_a_slope():
    """With g sin / (1 + I / m R^2), its mesh's own inertia; a barrier of R / 25 lets it slip by some per cent."""
    mesh, radius, width, slope = ball(2), 0.1, 0.004, 0.2
    gravity = ds.Gravity([9.81 * np.sin(slope), -9.81 * np.cos(slope), 0])
    ground = ds.Ground(-radius - 0.3 * width, stiffness_per_area=2e7, width=width, friction=0.5)
    scene = ds.Scene(mesh, ds.StableNeoHookean(3e5, 0.3), 1000.0, [gravity, ground], precision="f64")
    substeps = int(np.ceil(5e-3 / (0.5 * ds.stable_dt(scene, tight=True).dt)))
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, 5e-3, substeps), 60, save_every=1, gradients=[])
    frames, mass = rollout.forward(), rollout.sweep.workspace.mass
    v = (mass * frames.velocities).sum(1)[:, 0] / mass.sum()
    inertia = (mass[:, 0] * (mesh.vertices[:, :2] ** 2).sum(1)).sum()
    expected = 9.81 * np.sin(slope) / (1 + inertia / (mass.sum() * radius**2))
    assert np.polyfit(frames.times[30:], v[30:], 1)[0] == pytest.approx(expected, rel=0.04)  # 0.67 of g sin


def test_the_stage_adds_no_energy():
    """Whatever the velocities, the pushes, the coefficient and the friction speed."""
    rng, lost = np.random.default_rng(3), []
    for mu, eps in ((1e-2, 1e-5), (0.5, 1.0), (1e3, 1e-3)):
        ws = rubbed(under_a_roller(None, mu=mu, eps=eps)).solver
        ws = ds.Simulator(ws).workspace
        faces, mass = ws.faces, ws.mass[ws.faces.rows.nodes]
        for size in (1e-7, 1e-3, 1.0):
            impulses = (
                size * rng.normal(size=(faces.num_faces, 1, 3, 3)) * (rng.random((faces.num_faces, 1, 1, 1)) < 0.3)
            )
            v = rng.normal(size=(faces.num_surface, 3)) * 10.0 ** rng.uniform(-3, 1)
            v[faces.rows.nodes == 0] = 0  # it is held
            rub = faces.friction.begin(impulses, v, 0 * v, faces.corners_of, 0, 10)
            faces.friction.slide(rub)
            before, now = (0.5 * float((mass * x**2).sum()) for x in (v, v + rub.gained))
            assert now <= before * (1 + 1e-14)
            lost.append(1 - now / before)
    assert max(lost) > 0.05 and min(lost) < 1e-3
