"""Forces of obstacles on the body, as a loss names them: balances, and derivatives in every solver."""

from functools import lru_cache

import numpy as np
import pytest
import taichi as ti
from contact_scenes import points, tetrahedron

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.common import rotations
from diffsim_ti.terms.pose import brought_back, carried

G = 9.81
EXPLICIT = [ds.SemiImplicitSolver, ds.VelocityVerletSolver]


def cube(height=0.004):
    return ds.TetrahedralMesh.create_box(2, size=0.1, origin=(0, height, 0))


def pressed(precision="f64", round_one=False, path=lambda t: np.zeros(3), **options) -> ds.Scene:
    """A cube within the barriers of a floor, or of a ball that reaches into its lowest faces, and of a wall. A floor that
    stands still has a path, too, so that tests share their kernels."""
    rough = dict(stiffness_per_area=3e5, width=0.01, friction=0.4, friction_speed=0.3, name="floor")
    floor = ds.Sphere((0.05, -0.06, 0.05), 0.06, **rough) if round_one else ds.Ground(0, path=path, **rough)
    wall = ds.HalfSpace([-0.006, 0, 0], [1, 0.1, 0], stiffness_per_area=3e5, width=0.01, friction=0.2, name="wall")
    given = dict(
        initial_velocities=(0.1, -0.3, 0.2), precision=precision, terms=[ds.Gravity(), floor, wall, ds.Drag(0.5)]
    )
    return ds.Scene(cube(), ds.StableNeoHookean(youngs_modulus=2e5, poissons_ratio=0.3), **given | options)


def out_of_reach(drag=0.0) -> list:
    """A wall, and a drag, which a scene need not have but for the kernels of `pressed`."""
    wall = ds.HalfSpace([-9, 0, 0], [1, 0, 0], stiffness_per_area=3e5, width=0.01, friction=0.2, name="wall")
    return [wall, ds.Drag(drag)]


def between() -> list:
    """A ball below a cube and one above it, both smaller than its faces."""
    floor = pressed(round_one=True).terms[1]
    above = ds.Sphere((0.05, 0.17, 0.05), 0.06, stiffness_per_area=2e5, width=0.01, name="wall")
    return [ds.Gravity(), floor, above]


def outputs():
    return [
        ds.ContactForce("floor", name="held"),
        ds.ContactForce("floor", "friction", name="dragged"),
        ds.ContactForce("wall", "normal", name="turned", about=(0, 0.1, 0)),
        ds.ContactForce("wall", name="each", per_vertex=True),
        ds.ContactTraction("wall", name="traction"),
    ]


def belt(kind) -> ds.Rollout:
    """A vertex that a rough belt drives towards a wall, and that takes a share of all friction only."""
    rough = dict(stiffness=1e6, width=0.01)
    moving = ds.Ground(-0.011, friction=1.5, path=lambda t: [-20 * t, 0, 0], name="floor", **rough)
    wall = ds.HalfSpace([-0.011, 0, 0], [1, 0.2, 0.1], friction=0.3, name="wall", **rough)
    body = points(tetrahedron(), [moving, wall], fixed=[1, 2, 3], initial_velocities=[-1.0, -6.0, 0.3], precision="f64")
    named = [*outputs()[:2], outputs()[3], ds.ContactForce("wall", "friction", name="slowed")]
    return ds.Rollout(kind(body, dt=1e-3, contact_damping=0.02), 3, save_every=1, outputs=named, gradients="all")


@lru_cache(maxsize=None)
def rollout_of(case: str) -> ds.Rollout:
    kind, *more = case.split()
    if "belt" in more:
        return belt(dict(semi=ds.SemiImplicitSolver, verlet=ds.VelocityVerletSolver)[kind])
    tight = dict(tolerance=1e-12)
    moved = dict(path=lambda t: (0.0, 0.2 * t, 0.1 * t))
    held = dict(fixed="ymax", motion=lambda t: (0.001 * t, -0.001 * t, 0.0), initial_velocities=None)
    alone = dict(terms=pressed(round_one=True).terms[:2]) if "round" in more else {}
    alone |= dict(terms=between()) if "between" in more else {}
    options = (moved if "moved" in more else {}) | alone | (held if kind == "static" else {})
    scene = pressed("f32" if "f32" in more else "f64", **options)
    solver = {
        "euler": lambda: ds.ImplicitEulerSolver(scene, dt=2e-3, **tight),
        "middle": lambda: ds.ImplicitMidpointSolver(scene, dt=2e-3, **tight),
        "bdf": lambda: ds.BDF2Solver(scene, dt=2e-3, substeps=2, **tight),
        "static": lambda: ds.StaticSolver(scene, load_steps=2, tolerance=1e-12),
        "semi": lambda: ds.SemiImplicitSolver(scene, dt=2e-3, substeps=3),
        "verlet": lambda: ds.VelocityVerletSolver(scene, dt=2e-3, substeps=2),
    }[kind]()
    named = outputs() if len(scene.obstacles) > 1 else outputs()[:2]
    named += [ds.ContactSlip("floor"), ds.ContactSlip("floor", "share", name="share"), ds.CenterOfPressure("floor")]
    sole = scene.mesh.surface_where(lambda X, n: X[:, 1] < 0.01)
    named.append(ds.TactilePad("floor", sole, size=(2, 3)))
    if kind == "static":  # which depends on the floor, too
        named.append(ds.Reaction("ymax"))
    return ds.Rollout(solver, 4, save_every=2, outputs=named, gradients="all")


CASES = [
    "semi",
    "verlet",
    "euler",
    "middle moved",
    "bdf",
    "static",
    "semi moved",
    "semi belt",
    "verlet belt",
    "semi round",
    "euler round",
    "verlet between",
]


@pytest.mark.parametrize("case", CASES)
def test_seeds_are_the_transpose_of_tangents(case):
    """For every input by itself, and every output."""
    rollout, rng = rollout_of(case), np.random.default_rng(1)
    frames, gate = rollout.forward(), 1e-11 if rollout.solver.explicit else 1e-8
    assert np.abs(frames["held"]).max(0).min() > 1e-3  # all components
    seeds = {name: rng.normal(size=frames[name].shape) for name in rollout.computed}
    gradients = {name: rollout.vjp(frames, **{name: seed}) for name, seed in seeds.items()}
    for key in rollout.inputs:
        direction = rng.normal(size=rollout.values[key].shape) * verify.input_scale(rollout, key)
        if key == "initial_velocities":
            direction[rollout.scene.fixed] = 0
        tangents = rollout.tangents(frames, **{key: direction})
        for name, seed in seeds.items():
            terms = tangents[name] * seed
            pushed, pulled = terms.sum(), (gradients[name][key] * direction).sum()
            assert abs(pushed - pulled) <= gate * max(abs(pushed), np.linalg.norm(terms), 1e-12), (key, name)


def test_the_centre_of_pressure_has_the_moment_of_what_a_plane_pushes_with():
    rollout = rollout_of("semi")
    frames = rollout.forward()
    p, c = frames.contact_forces[:, rollout.scene.place_of("floor"), 0], frames["center_of_pressure"]
    assert not c[0].any() and p[-1, :, 1].sum() > 0
    moment = np.cross(frames.positions, p).sum(1)
    np.testing.assert_allclose(np.cross(c, p.sum(1)), moment, atol=1e-12 * np.abs(p).sum())


def test_a_pad_reads_the_same_however_it_is_turned():
    """An even pressure on a slope, from a block that leans on it: turned with slope and gravity, its readings stay."""
    turn, read = rotations.quaternion(np.array([0.4, 0.3, -0.8])), []
    for q in (np.array([1.0, 0, 0, 0]), turn):
        mesh = ds.TetrahedralMesh.create_box((4, 2, 3), (0.12, 0.03, 0.08))
        sole = mesh.surface_where(lambda X, n: X[:, 1] < 1e-9)
        X = rotations.turned(q, mesh.vertices + [0, 0.004, 0])
        mesh = ds.TetrahedralMesh(X, mesh.tetrahedra)
        up, aside = rotations.turned(q, np.eye(3)[1]), rotations.turned(q, np.eye(3)[0])
        slope = ds.HalfSpace(normal=up, stiffness_per_area=1e7, width=0.005, friction=0.6, name="slope")
        floor = ds.Ground(-9, stiffness_per_area=1e7, width=0.005, friction=0.6, path=lambda t: np.zeros(3))  # far off
        terms = [ds.Gravity(-9.81 * up + 2.0 * aside), floor, slope, ds.Drag(0.0)]  # the kernels of `pressed`
        scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.0), 1e3, terms, precision="f64")
        pad = ds.TactilePad("slope", sole, size=(3, 4))
        solver = ds.ImplicitEulerSolver(scene, dt=0.02, tolerance=1e-10)
        frames = ds.Rollout(solver, 40, save_every=40, outputs=[pad, ds.ContactForce("slope")]).forward()
        read.append(frames["tactile_pad"][-1])
        weight = 1e3 * mesh.volume
        assert frames["contact_force"][-1] @ up == pytest.approx(9.81 * weight, rel=1e-3)
    area = 0.12 * 0.08
    assert read[0].shape == (3, 4, 3) and read[0][..., 0].mean() == pytest.approx(9.81 * weight / area, rel=0.1)
    assert abs(read[0][..., 1].mean()) == pytest.approx(2.0 * weight / area, rel=0.1)  # shear along the longer side
    signs = np.sign(read[0][..., 1:].mean((0, 1))) * np.sign(read[1][..., 1:].mean((0, 1)))
    np.testing.assert_allclose(read[1][..., 0], read[0][..., 0], rtol=1e-5)
    np.testing.assert_allclose(np.abs(signs), 1)


@pytest.mark.parametrize("half", [False, True])
def test_a_pad_says_where_its_points_are(half):
    """In the middle of cells over the sole, also where a set of half the sole's triangles leaves points beside it."""
    mesh = ds.TetrahedralMesh.create_box((4, 2, 3), (0.12, 0.03, 0.08))
    sole = mesh.surface_where(lambda X, n: X[:, 1] < 1e-9)
    floor = ds.Ground(-0.004, 1e4, 0.005, name="floor")
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.0), terms=[floor], precision="f64")
    on = sole[::2] if half else sole
    pad = ds.TactilePad("floor", on, size=(4, 6)).settled(scene)
    assert pad.inside.all() != half and pad.inside.any()
    x, z = (np.unique(pad.places[..., k].round(12)) for k in (0, 2))
    np.testing.assert_allclose(x, 0.12 * (np.arange(6) + 0.5) / 6, atol=1e-12)
    np.testing.assert_allclose(z, 0.08 * (np.arange(4) + 0.5) / 4, atol=1e-12)
    np.testing.assert_allclose(pad.places[..., 1], 0, atol=1e-12)


def on_a_turntable(dt=1e-3, **options) -> ds.Scene:
    """A cube on a disc that turns about a point beside it, and goes up and sideways."""
    turn = lambda t: [0.3 * t, 0.05 * t, 0.1 * t, 0.2 * t, 5 * t, 0.1 * t]  # noqa: E731
    disc = ds.Box((0.05, -0.25, 0.05), (1, 0.5, 1), stiffness_per_area=3e5, width=0.01, name="disc", path=turn,
                  about=(0.2, 0, 0), by_pairs=False, **options)  # fmt: skip
    return ds.Scene(cube(), ds.StableNeoHookean(2e5, 0.3), terms=[ds.Gravity(), disc], precision="f64")


def test_slip_on_a_turntable():
    """v - u - w x (x - c), in frames and in a simulator; and its derivatives, by the path and the point, too."""
    solver = ds.VelocityVerletSolver(on_a_turntable(friction=0.3), dt=1e-3, substeps=4)
    named = [ds.ContactSlip("disc"), ds.ContactForce("disc", "normal", name="push", per_vertex=True)]
    rollout = ds.Rollout(
        solver, 8, save_every=1, outputs=[*named, ds.ContactSlip("disc", "share", name="share")], gradients="all"
    )
    frames, simulator = rollout.forward(), ds.Simulator(solver, contact_forces=True)
    simulator.run(8)
    h, row = 1e-6, lambda t: np.array([0.3 * t, 0.05 * t, 0.1 * t, 0.2 * t, 5 * t, 0.1 * t])
    about = solver.scene.obstacles[0].about

    def check(frames) -> np.ndarray:
        x, v, push, t = frames.positions[-1], frames.velocities[-1], frames["push"][-1], frames.times[-1]
        pressed_on = np.linalg.norm(push, axis=1) > 0
        assert pressed_on.sum() == 4 and not frames["contact_slip"][-1][~pressed_on].any()
        own = [carried(brought_back(x, row(t), about), row(t + s * h), about) for s in (-1, 1)]
        w = (v - (own[1] - own[0]) / (2 * h))[pressed_on]
        n = push[pressed_on] / np.linalg.norm(push[pressed_on], axis=1, keepdims=True)
        expected = w - n * (n * w).sum(1, keepdims=True)
        np.testing.assert_allclose(frames["contact_slip"][-1][pressed_on], expected, atol=1e-6)
        return pressed_on

    pressed_on = check(frames)
    check(ds.Rollout(solver, ds.UnequalSteps([1e-3] * 7 + [5e-4], 4), 1, outputs=named).forward())
    np.testing.assert_allclose(simulator.output(ds.ContactSlip("disc")), frames["contact_slip"][-1], atol=1e-9)
    np.testing.assert_allclose(
        frames["share"][-1][pressed_on], 1.0, atol=1e-4
    )  # it slides; directions turn within a step
    slip = ds.Rollout(solver, 3, outputs=named[:1], gradients="all")

    def loss(frames):
        out = frames["contact_slip"]
        seed = np.random.default_rng(5).normal(size=out.shape)
        return float((seed * out).sum()), np.zeros(frames.positions.shape), None, {"contact_slip": seed}

    inputs = [
        name for name in slip.inputs if name.startswith("disc.") or name in ("rest_positions", "initial_velocities")
    ]
    report = verify.check_gradients(slip, loss, inputs, verbose=False)
    assert report.passed, str(report)
    with pytest.raises(ValueError, match="has no friction; pass friction="):
        ds.ContactSlip("disc", "share").settled(on_a_turntable())


KEYS = ("youngs_modulus", "poissons_ratio", "floor.friction", "floor.stiffness_per_area", "rest_positions", "density")


@pytest.mark.parametrize("case", CASES)
def test_gradients_agree_with_differences(case):
    """All outputs at once: what they are seeded with is random."""
    rollout, rng = rollout_of(case), np.random.default_rng(2)
    frames = rollout.forward()
    seeds = {name: rng.normal(size=frames[name].shape) for name in rollout.computed}
    gradients = rollout.vjp(frames, **seeds)

    def loss(**values):
        got = rollout.forward(**values)
        return sum((got[name] * seed).sum() for name, seed in seeds.items())

    keys = [key for key in (*KEYS, "floor.path", "wall.normal") if key in rollout.inputs]
    for key in keys:
        base = rollout.values[key]
        direction = rng.normal(size=base.shape) * verify.input_scale(rollout, key)
        slope = (gradients[key] * direction).sum()
        step = 1e-4
        coarse, fine = (
            (loss(**{key: base + s * direction}) - loss(**{key: base - s * direction})) / (2 * s)
            for s in (step, step / 2)
        )
        assert slope == pytest.approx((4 * fine - coarse) / 3, rel=1e-6, abs=1e-7 * abs(loss())), key


def momentum(scene, frames) -> np.ndarray:
    return np.einsum("i,fid->fd", scene.inputs.derive(scene.inputs.values).mass, frames.velocities.astype(np.float64))


@pytest.mark.parametrize(
    "kind, gate",
    [*((kind, 1e-12) for kind in EXPLICIT), (ds.ImplicitEulerSolver, 1e-7), (ds.ImplicitMidpointSolver, 1e-7)],
)
def test_the_impulse_of_a_bounce_is_the_change_of_momentum(kind, gate):
    """With weight and friction, frame by frame."""
    scene = pressed(initial_velocities=(0.4, -1.0, 0.2), terms=[*pressed().terms[:3], ds.Drag(0.0)])
    tight = {} if kind in EXPLICIT else dict(tolerance=1e-10)
    rollout = ds.Rollout(kind(scene, dt=1e-3, **tight), 24, save_every=2, outputs=outputs()[:1] + [outputs()[3]])
    frames = rollout.forward()
    mass, p = scene.inputs.derive(scene.inputs.values).mass.sum(), momentum(scene, frames)
    forces = frames["held"] + frames["each"].sum(1)
    gained = 2e-3 * (forces[1:] + mass * np.array([0, -G, 0]))
    assert np.abs(p[-1] - p[0]).max() > 0.5 * np.abs(p).max()
    assert np.diff(p, axis=0) == pytest.approx(gained, abs=gate * np.abs(p).max())
    assert not frames["held"][0].any()


def test_friction_that_a_vertex_takes_a_share_of_counts():
    """Of a free vertex on which no other force acts."""
    rollout = belt(ds.SemiImplicitSolver)
    frames, mass = rollout.forward(), rollout.scene.inputs.derive(rollout.scene.inputs.values).mass[0]
    forces = frames["held"] + frames["each"].sum(1)
    gained = mass * np.diff(frames.velocities[:, 0], axis=0)
    assert gained == pytest.approx(1e-3 * forces[1:], abs=1e-9 * np.abs(gained).max())  # the law's modulus is 1e-6 Pa
    assert np.abs(frames["slowed"]).max() > 0 and np.abs(frames["dragged"]).max() > 0


def test_what_acts_on_faces_counts():
    """Of a ball that is smaller than a face, which acts between corners."""
    scene = pressed(terms=pressed(round_one=True).terms[:2])
    rollout = ds.Rollout(
        ds.VelocityVerletSolver(scene, dt=1e-3),
        4,
        outputs=outputs()[:1] + [ds.ContactForce("floor", name="each", per_vertex=True)],
    )
    frames = rollout.forward()
    p, mass = momentum(scene, frames), scene.inputs.derive(scene.inputs.values).mass.sum()
    gained = 4e-3 * (frames["held"][1] + mass * np.array([0, -G, 0]))
    assert p[1] - p[0] == pytest.approx(gained, abs=1e-12 * np.abs(p).max()) and frames["held"][1, 1] > 1
    assert frames["each"].sum(1) == pytest.approx(frames["held"])


def test_each_of_two_that_act_on_faces_has_its_own_force():
    scene = pressed(terms=between(), initial_velocities=(0, 0, 0))
    solver = ds.VelocityVerletSolver(scene, dt=1e-3)
    rollout = ds.Rollout(
        solver, 4, outputs=[ds.ContactForce("floor", name="held"), ds.ContactForce("wall", name="top")]
    )
    frames = rollout.forward()
    p, mass = momentum(scene, frames), scene.inputs.derive(scene.inputs.values).mass.sum()
    below, above = frames["held"][1], frames["top"][1]
    gained = 4e-3 * (below + above + mass * np.array([0, -G, 0]))
    assert p[1] - p[0] == pytest.approx(gained, abs=1e-12 * mass) and below[1] > 1 and above[1] < -1


@pytest.mark.executed_ptx
@pytest.mark.parametrize("kind", [ds.SemiImplicitSolver, ds.ImplicitEulerSolver])
def test_a_block_at_rest_on_a_slope(kind):
    """It presses with m g cos and is held with m g sin, but for what the explicit one's drag takes of its creep."""
    slope, creep = np.radians(15), 1e-5 if kind is ds.SemiImplicitSolver else 1e-3
    g = G * np.array([np.sin(slope), -np.cos(slope), 0])
    rough = dict(friction=0.5, friction_speed=creep, path=lambda t: np.zeros(3))
    floor = ds.Ground(0, stiffness_per_area=1e6, width=0.01, name="floor", **rough)
    explicit = kind is ds.SemiImplicitSolver
    terms = [ds.Gravity(g), floor, *out_of_reach(drag=20.0 if explicit else 0.0)]
    scene = ds.Scene(cube(0.006), ds.StableNeoHookean(2e5, 0.3), 1000.0, terms, precision="f64")
    options = dict(dt=5e-4, contact_damping=1.0) if explicit else dict(dt=0.02, tolerance=1e-8)
    steps = 2000 if explicit else 60
    named = [ds.ContactForce("floor", part, name=part) for part in ("normal", "friction")]
    frames = ds.Rollout(kind(scene, **options), steps, save_every=steps // 2, outputs=named).forward()
    frames = ds.Rollout(
        kind(
            scene.replace(initial_positions=frames.positions[-1], initial_velocities=frames.velocities[-1]), **options
        ),
        4,
        outputs=named,
    ).forward()
    mass = scene.inputs.derive(scene.inputs.values).mass.sum()
    assert frames["normal"][1] == pytest.approx([0, mass * G * np.cos(slope), 0], rel=1e-4, abs=1e-9)
    assert frames["friction"][1] == pytest.approx([-mass * G * np.sin(slope), 0, 0], rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("case", ["semi f32", "euler f32"])
def test_single_precision(case):
    """Of the barrier's force single precision sees gaps of 4 mm to 1e-7 of the body's size, 0.1 m: some 1e-5 of the force,
    and Newton's method stops there. Gradients agree with those of double precision to 1e-3."""
    single, double = (rollout_of(name) for name in (case, case.split()[0]))
    rng, found = np.random.default_rng(4), []
    for rollout in (single, double):
        frames = rollout.forward()
        found.append(frames)
    assert found[0]["held"] == pytest.approx(found[1]["held"], abs=1e-3 * np.abs(found[1]["held"]).max())
    seed = rng.normal(size=found[0]["held"].shape)
    one, two = (rollout.vjp(frames, held=seed) for rollout, frames in zip((single, double), found))
    for key in KEYS:
        size = np.abs(two[key]).max()
        assert np.abs(one[key] - two[key]).max() <= 2e-3 * size, key


@lru_cache(maxsize=None)
def scalar_field():
    return ti.field(ti.f64, (), needs_grad=True)


def test_segments_and_a_second_run_change_nothing():
    """Replayed passes are not counted twice."""
    scene = pressed()
    whole, parts = (
        ds.Rollout(
            ds.VelocityVerletSolver(scene, dt=1e-3), 6, save_every=2, checkpoint_every=every, outputs=outputs()[:1]
        )
        for every in (None, 1)
    )
    seed = np.random.default_rng(6).normal(size=(4, 3))
    first, second = whole.forward(), parts.forward()
    gradients = [r.vjp(f, held=seed) for r, f in ((whole, first), (parts, second), (parts, second))]
    again = parts.forward()
    assert np.array_equal(first["held"], second["held"]) and np.array_equal(again["held"], second["held"])
    for name in gradients[0]:
        assert np.array_equal(gradients[0][name], gradients[1][name]), name
        assert np.array_equal(gradients[1][name], gradients[2][name]), name


def test_a_scene_whose_loss_does_not_name_it_pays_nothing():
    """Its kernels are those of before: none of their arguments is an impulse."""
    plain, asked = (ds.Rollout(ds.SemiImplicitSolver(pressed(), dt=1e-3), 1, outputs=o) for o in ((), outputs()[0]))
    for rollout, there in ((plain, False), (asked, True)):
        rollout.forward()
        ws = rollout.sweep.workspace
        kernels = ws.kernels(ws.arrays.features())
        assert [("impulse" in k.arrays["state"]) for k in (kernels.step, kernels.step_vjp, kernels.step_jvp)] == [
            there
        ] * 3
        assert ws.arrays.features().recorded == there and hasattr(ws.contact, "impulse") == there


def test_traction_is_force_per_area():
    """Of each part, on the bottom of a cube that lies in the floor's barrier; its integral over the bottom is the force."""
    scene = pressed()
    named = [ds.ContactForce("floor", part, f"f_{part}", per_vertex=True) for part in ("normal", "friction")]
    named += [ds.ContactTraction("floor", part, f"t_{part}") for part in ("normal", "friction")]
    frames = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-3), 3, outputs=named).forward()
    bottom = scene.mesh.vertex_indices("ymin")
    faces = scene.mesh.surface_triangles[np.isin(scene.mesh.surface_triangles, bottom).all(1)]
    for part in ("normal", "friction"):
        f, t = frames[f"f_{part}"], frames[f"t_{part}"]
        integral = 0.1**2 / len(faces) * t[:, faces].mean(2).sum(1)
        assert integral == pytest.approx(f.sum(1), rel=1e-4)  # but for tilts, squared
        assert np.abs(f[-1, bottom]).max() > 0
        assert not t[-1][np.setdiff1d(np.arange(len(t[-1])), bottom)].any()
    assert frames["t_normal"][-1, bottom, 1].min() > 0 and not frames["t_normal"][-1][:, [0, 2]].any()
    assert not frames["t_friction"][-1][:, 1].any()


@pytest.mark.parametrize("stiffness", [1e7, 1e11])
@pytest.mark.parametrize(
    "order, pattern, cells", [(1, "five", (5, 4, 5)), (2, "five", (5, 4, 5)), (2, "kuhn", (3, 7, 5))]
)
def test_an_even_pressure_has_an_even_traction(order, pattern, cells, stiffness):
    """A block with nu = 0 is pressed on a floor that is much softer or stiffer than it: at corners of faces, at middles and
    at the block's edges, between cells of unequal sides too, the traction is force per area; elsewhere there is none."""
    mesh = ds.TetrahedralMesh.create_box(cells, (0.1, 0.06, 0.1), pattern=pattern)
    mesh = mesh if order == 1 else mesh.quadratic()
    rough = dict(friction=1e-9, path=lambda t: np.zeros(3))  # as where derivatives are judged: the same kernels
    floor = ds.Ground(-0.002, stiffness_per_area=stiffness, width=0.004, name="floor", **rough)
    down = dict(fixed="ymax", motion=lambda t: [0, -0.002 * t, 0], precision="f64")
    if order == 1:  # the kernels of `pressed`
        scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.0), terms=[ds.Gravity(0.0), floor, *out_of_reach()], **down)
    else:
        scene = ds.Scene(mesh, ds.LinearElastic(1e6, 0.0), terms=[floor], **down)
    named = [ds.ContactTraction("floor"), ds.ContactForce("floor")]
    frames = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-10), 1, outputs=named).forward()
    pressure, bottom = frames["contact_force"][-1, 1] / 0.1**2, np.isclose(mesh.vertices[:, 1], 0)
    t = frames["contact_traction"][-1]
    # the barrier deals out its stiffness in shares that an even pressure does not quite have
    assert t[bottom, 1] == pytest.approx(
        pressure, rel=0.01 if stiffness == 1e11 else 0.05 if pattern == "five" else 0.08
    )
    assert not t[~bottom].any() and np.abs(t[:, [0, 2]]).max() < 1e-6 * pressure


def test_traction_on_faces_of_ten_nodes_has_derivatives():
    mesh = ds.TetrahedralMesh.create_box((3, 2, 3), (0.1, 0.05, 0.1), origin=(0, 0.004, 0)).quadratic()
    held = dict(fixed="ymax", motion=lambda t: (0.001 * t, -0.001 * t, 0.0), precision="f64")
    scene = ds.Scene(mesh, ds.LinearElastic(2e5, 0.3), terms=[pressed().terms[1]], **held)
    named = [ds.ContactTraction("floor", part, name=part) for part in ("total", "friction")]
    solver = ds.StaticSolver(scene, load_steps=2, tolerance=1e-12)
    rollout, rng = ds.Rollout(solver, 2, save_every=1, outputs=named, gradients="all"), np.random.default_rng(0)
    assert verify.dot_product_test(rollout) < 1e-9
    frames, value = rollout.forward(), rollout.values["rest_positions"]
    way = rng.normal(size=value.shape) * verify.input_scale(rollout, "rest_positions")
    tangents = rollout.tangents(frames, rest_positions=way)
    ends = [rollout.forward(rest_positions=value + s * 1e-4 * way) for s in (1, -1)]
    for name in ("total", "friction"):
        difference = (ends[0][name] - ends[1][name]) / 2e-4
        np.testing.assert_allclose(tangents[name], difference, atol=1e-7 * np.abs(difference).max())


def test_what_does_not_fit_is_refused():
    scene = pressed()
    with pytest.raises(ValueError, match="no obstacle 'roof'; it has 'floor', 'wall'"):
        ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-3), 1, outputs=ds.ContactForce("roof"))
    with pytest.raises(ValueError, match="part must be total, normal or friction, got 'shear'"):
        ds.ContactForce("floor", "shear")
    with pytest.raises(ValueError, match="about= or per_vertex=True"):
        ds.ContactForce("floor", about=(0, 0, 0), per_vertex=True)
    as_force = ds.SemiImplicitSolver(scene, dt=1e-4, contact="force")
    for make in (
        lambda: ds.Rollout(as_force, 1, outputs=ds.ContactForce("floor")),
        lambda: ds.Simulator(as_force, contact_forces=True),
    ):
        with pytest.raises(ValueError, match='pass it contact="stage"'):
            make()


@pytest.mark.parametrize("kind", EXPLICIT)
def test_all_threads_give_what_one_gives(kind):
    serial, parallel = (
        ds.Rollout(kind(pressed(), dt=1e-3, parallel=p), 4, save_every=2, outputs=outputs()) for p in (False, True)
    )
    one, many, rng = serial.forward(), parallel.forward(), np.random.default_rng(7)
    seeds = {name: rng.normal(size=one[name].shape) for name in serial.computed}
    for name in seeds:
        assert many[name] == pytest.approx(one[name], rel=1e-12, abs=1e-12 * np.abs(one[name]).max())
    first, second = serial.vjp(one, **seeds), parallel.vjp(many, **seeds)
    for name in first:
        assert second[name] == pytest.approx(first[name], rel=1e-9, abs=1e-11 * np.abs(first[name]).max()), name
