"""Robots of URDF files: joints against closed forms, both ways of contact, and every gradient."""

import sys

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.accuracy.finer import on_finer, rollout_on_finer
from diffsim_ti.common import rotations
from diffsim_ti.study import recommend

MASS = (
    '<inertial><origin xyz="{at} 0 0"/><mass value="{m}"/>'
    '<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>'
)
LIMIT = '<limit lower="-3" upper="3" effort="9" velocity="9"/>'


def joint(name, kind, parent, child, at, axis="0 0 1", more=LIMIT):
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/><axis xyz="{axis}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{more}</joint>'


def link(name, m=None, at=0.1, inertia=1e-3, shape=""):
    own = "" if m is None else MASS.format(m=m, at=at, i=inertia)
    geometry = f"<collision><geometry>{shape}</geometry></collision>" if shape else ""
    return f'<link name="{name}">{own}{geometry}</link>'


def urdf(*parts) -> str:
    return f'<robot name="r">{"".join(parts)}</robot>'


ARM = urdf(
    link("base"),
    link("upper", 1.0),
    link("fore", 0.5),
    link("tip", shape='<sphere radius="0.03"/>'),
    joint("shoulder", "revolute", "base", "upper", "0 0.3 0", more=LIMIT + '<dynamics damping="0.01"/>'),
    joint("elbow", "continuous", "upper", "fore", "0.3 0 0", more=""),
    joint("flange", "fixed", "fore", "tip", "0.2 0 0", more=""),
)
MESH = ds.TetrahedralMesh.create_box((3, 3, 3), 0.06).with_tetrahedron_set("all", np.arange(48))
SOFT = ds.StableNeoHookean(3e4, 0.35)


def scene_of(robot, mesh=MESH, terms=(), **options):
    return ds.Scene(mesh, SOFT, 500.0, [robot, *terms], precision="f64", **options)


def moved(shift):
    return ds.TetrahedralMesh(MESH.vertices + shift, MESH.tetrahedra, vertex_sets=MESH.vertex_sets)


WRONG = {
    "mimics": (
        urdf(link("a"), link("b", 1.0), joint("j", "revolute", "a", "b", "0 0 0", more='<mimic joint="k"/>')),
        {},
    ),
    "a closed loop": (
        urdf(
            link("a"),
            link("b", 1.0),
            joint("j", "revolute", "a", "b", "0 0 0"),
            joint("k", "revolute", "a", "b", "1 0 0"),
        ),
        {},
    ),
    "is 'floating'": (urdf(link("a"), link("b", 1.0), joint("j", "floating", "a", "b", "0 0 0")), {}),
    "has dry friction": (
        urdf(link("a"), link("b", 1.0), joint("j", "revolute", "a", "b", "0 0 0", more='<dynamics friction="1"/>')),
        {},
    ),
    "carries no mass": (urdf(link("a"), link("b"), joint("j", "revolute", "a", "b", "0 0 0")), {}),
    "has no joint that moves": (urdf(link("a")), {}),
    "no link 'hand'; the file has base": (ARM, dict(links=["hand"])),
    "no joint 'wrist' to prescribe": (ARM, dict(prescribed=["wrist"])),
    "there is no file 'none.urdf'": ("none.urdf", {}),
    "Pinocchio, which has written why": (
        urdf(link("a"), link("b", 1.0), joint("j", "revolute", "a", "b", "0 0 0", more="")),
        {},
    ),
    "is not XML": ("<robot>", {}),
    "expected an element <robot>, got <sdf>": ("<sdf/>", {}),
    "no mesh .*hand.stl": (
        urdf(link("a", shape='<mesh filename="hand.stl"/>'), link("b", 1.0), joint("j", "revolute", "a", "b", "0 0 0")),
        {},
    ),
    "must be one of sphere with radius, box": (
        urdf(link("a", shape="<cone/>"), link("b", 1.0), joint("j", "revolute", "a", "b", "0 0 0")),
        {},
    ),
    "link 'a': collision geometry must be one of": (
        urdf(link("a", shape="<sphere/>"), link("b", 1.0), joint("j", "revolute", "a", "b", "0 0 0")),
        {},
    ),
    "joint 'j' needs a <parent> and a <child>": (urdf(link("a"), '<joint name="j" type="revolute"/>'), {}),
    "base must be 3, 6 or 7 finite numbers": (ARM, dict(base=[0, 0, 0, 1, 0])),
    r"positions must be 2 numbers .*got shape \(3,\)": (ARM, dict(positions=[1, 2, 3])),
}


@pytest.mark.parametrize("message", WRONG)
def test_what_is_not_supported_is_refused(message):
    text, options = WRONG[message]
    with pytest.raises(ValueError, match=message):
        ds.Robot.from_urdf(text, **options)


def test_values_by_names_come_in_the_order_of_the_joints():
    robot = ds.Robot.from_urdf(
        ARM, links=(), positions={"elbow": 2.0, "shoulder": 1.0}, torques={"elbow": [3.0, 4.0], "shoulder": 0.5}
    )
    assert robot.joints == ("shoulder", "elbow") and robot.values["joint_positions"].tolist() == [1, 2]
    assert robot.values["joint_torques"].tolist() == [[0.5, 3], [0.5, 4]] and not robot.values["joint_velocities"].any()
    with pytest.raises(ValueError, match="velocities must name shoulder, elbow, got elbow"):
        ds.Robot.from_urdf(ARM, velocities={"elbow": 1.0})
    with pytest.raises(ValueError, match=r"torques must have as many steps .* shoulder \(3,\), elbow \(2,\)"):
        ds.Robot.from_urdf(ARM, torques={"elbow": [1.0, 2.0], "shoulder": [1.0, 2.0, 3.0]})
    for wrong in (dict(links="tip"), dict(prescribed="elbow")):
        with pytest.raises(ValueError, match="must be one or several (links|joints) by name"):
            ds.Robot.from_urdf(ARM, **wrong)
    for wrong, message in (
        (dict(limits=(-1, 1)), r"limits must be True or False, their numbers being the file's <limit>, got \(-1, 1\)"),
        (dict(attached="xmin"), "attached must be {link: vertices}, got 'xmin'"),
        (dict(attached=["b"]), r"attached must be {link: vertices}, got \['b'\]"),
        (dict(torques=lambda t: [0, 0]), "torques of joints are numbers, not functions: give a value for each step"),
        (dict(positions=dict(shoulder=np.sin, elbow=0)), "positions of joints are numbers, not functions"),
    ):
        with pytest.raises(ValueError, match=message):
            ds.Robot.from_urdf(ARM, **wrong)
    with pytest.raises(ValueError, match="there is no file 'xxx"):
        ds.Robot.from_urdf(300 * "x")


def test_wrong_calls_are_named():
    with pytest.raises(TypeError, match=r"made by Robot.from_urdf\(path\)"):
        ds.Robot("arm.urdf")
    with pytest.raises(TypeError, match="no option 'frction'; contact of links takes stiffness_per_area"):
        ds.Robot.from_urdf(ARM, links=(), frction=0.3)


def test_a_mirrored_mesh_keeps_its_outside(tmp_path):
    box = ds.TetrahedralMesh.create_box(2, 0.04)
    rows = [("v", *x) for x in box.vertices] + [("f", *x) for x in box.surface_triangles + 1]
    (tmp_path / "c.obj").write_text("\n".join(" ".join(map(str, row)) for row in rows))
    for side in (1, -1):
        shape = f'<mesh filename="c.obj" scale="1 {side} 1"/>'
        (tmp_path / "m.urdf").write_text(
            urdf(link("a"), link("b", 1.0, shape=shape), joint("j", "prismatic", "a", "b", "0 0 0"))
        )
        robot = ds.Robot.from_urdf(tmp_path / "m.urdf", width=1e-3, stiffness_per_area=1e7)
        x = np.array([[0.02, side * 0.05, 0.02], [0.02, side * 0.02, 0.02]])
        assert np.allclose(robot.companions[0].gap(x, np.eye(1, 7, 3)[0]), [0.01, -0.02])


@pytest.mark.parametrize("precision", ["f64", "f32"])
@pytest.mark.parametrize(
    ("kind", "force", "h", "inertia"), [("prismatic", 0.03, 1e-3, 0.05), ("revolute", 1e-3, 5e-3, 1e-6)]
)
def test_a_prescribed_joint_hides_no_light_one(precision, kind, force, h, inertia):
    """Two branches of one base: rounding of a heavy one that is prescribed is more than all forces on the light one."""
    heavy, light = (joint(name, kind, "a", name, "0 0 0") for name in "bc")
    text = urdf(link("a"), link("b", 20.0, 0.0, 20.0), link("c", 0.05, 0.0, 1e-6), heavy, light)
    targets = np.outer(0.5 + 1e-3 * np.arange(4), [1, 0])
    given = dict(positions=targets[0], targets=targets, prescribed=["b"], torques=[0, force], links=())
    scene = scene_of(ds.Robot.from_urdf(text, **given), fixed="ymin").replace(precision=precision)
    rollout = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=h), 3, outputs=[ds.JointVelocities()])
    found = rollout.forward()["joint_velocities"][-1]
    np.testing.assert_allclose(found, [1e-3 / h, 3 * h * force / inertia], rtol=1e-5)


@pytest.fixture(scope="module")
def wheel():
    """A link that turns far from the body."""
    text = urdf(link("a"), link("b", 1.0, shape='<sphere radius="0.01"/>'), joint("j", "revolute", "a", "b", "0 5 0"))
    robot = ds.Robot.from_urdf(text, width=1e-3, stiffness_per_area=1e7, limits=False)
    return ds.ImplicitEulerSolver(scene_of(robot, fixed="ymin"), dt=1e-2)


def test_a_run_that_stops_keeps_its_joints_and_has_no_gradient(wheel):
    rollout = ds.Rollout(wheel, 2, save_every=1, outputs=[ds.JointPositions()], raise_errors=False)
    frames = rollout.forward(**{"robot.velocities": [400.0]})
    assert "more than half a turn" in str(frames.error) and not frames["joint_positions"].any()
    with pytest.warns(UserWarning, match="a run that was stopped is zero"):
        assert rollout.vjp(frames, joint_positions=np.ones((3, 1)))["robot.velocities"] == 0
    batch = ds.Batch(wheel, 2, 2, outputs=[ds.JointPositions()])
    found = batch.forward(**{"robot.velocities": [[1.0], [400.0]]})
    assert found.alive.tolist() == [True, False]
    assert found["joint_positions"][0, -1, 0] == pytest.approx(0.02)
    with pytest.raises(ValueError, match="a run does not start from joints of robots that have moved"):
        _ = found.end


@pytest.mark.parametrize("kind", [ds.ImplicitEulerSolver, ds.VelocityVerletSolver])
def test_adjoints_of_joints_are_cut_clipped_and_reported(wheel, kind):
    wheel, run = kind(wheel.scene, dt=1e-2), dict(steps=2, save_every=1, outputs=[ds.JointPositions()])
    seed = dict(joint_positions=[[0], [0], [3.0]])
    for options in (dict(health=True), dict(clip=0.5), dict(truncate=1)):
        rollout = ds.Rollout(wheel, **run, **options)
        got = rollout.vjp(rollout.forward(), **seed)
        clipped, cut = "clip" in options, "truncate" in options
        start = 0.5 if clipped else 0.0 if cut else 3.0
        assert got["robot.torques"] > 0 and got["robot.positions"] == pytest.approx(start, rel=1e-3)
        norms, shares = ([row[key] for row in rollout.health] for key in ("norm_position", "scaled"))
        assert cut or max(norms) > 1 and (min(shares) < 1) == clipped


@pytest.mark.parametrize("kind", [ds.ImplicitEulerSolver, ds.BDF2Solver])
def test_links_stand_where_they_are_when_a_run_goes_on(kind):
    """A body falls to where a link, and a ball on a path, were when it began."""
    from diffsim_ti.writers import Frame
    from diffsim_ti.writers.adaptive_run import ForwardRun

    text = urdf(
        link("a"),
        link("b", 1.0, shape='<sphere radius="0.02"/>'),
        joint("j", "prismatic", "a", "b", "0.03 -0.04 0.03", "1 0 0"),
    )
    contact = dict(width=2e-3, stiffness_per_area=1e7)
    ball = ds.Sphere((0.03, -0.04, 0.03), 0.02, path=lambda t: np.array([3 * t, 0, 0]), **contact)
    scene = scene_of(
        ds.Robot.from_urdf(text, velocities=[3.0], **contact), terms=[ball], initial_velocities=[0, -1.0, 0]
    )
    solver = kind(scene, dt=1e-2)
    first, second = ds.Simulator(solver), ds.Simulator(solver)
    first.run(5)
    kept = first.state
    second.resume(kept)
    for one in (first, second):
        one.step()
    np.testing.assert_array_equal(first.positions, second.positions)
    drawn = Frame.of(first).obstacles[0]  # the link, as pictures and files have it
    assert np.ptp(drawn, 0).max() < 0.05 and drawn.mean(0)[0] == pytest.approx(
        0.03 + first.joint_states[0, 0], abs=1e-4
    )
    with pytest.raises(ValueError, match=r"joint_states: expected finite numbers, float64 of shape \(1, 5\)"):
        second.resume(kept | dict(joint_states=np.zeros((3, 3))))
    run = ForwardRun(scene, kind, 0.04, dt=1e-2)
    run.advance()
    assert run.seen.crossed == 0 and run.seen.gap > 0


def test_other_solvers_refuse_and_say_which_takes_robots(monkeypatch):
    scene = scene_of(ds.Robot.from_urdf(ARM, links=()), fixed="ymin")
    with pytest.raises(ValueError, match="take BDF2Solver or ImplicitEulerSolver"):
        ds.ImplicitMidpointSolver(scene)
    with pytest.raises(ValueError, match="recommend takes no robots"):
        recommend(scene, 0.01)
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(ImportError, match=r'pip install "diffsim-ti\[robots\]"'):
        ds.Robot.from_urdf(ARM)


def test_advice_works_when_it_is_followed(pressing):
    text = WRONG["has dry friction"][0].replace('friction="1"/>', 'friction="0" damping="2"/>' + LIMIT)
    assert ds.Robot.from_urdf(text).damping == [2.0]
    with pytest.raises(ValueError, match="take what='share'"):
        ds.ContactSlip("arm_tip").settled(pressing)
    assert ds.ContactSlip("arm_tip", what="share").settled(pressing).what == "share"
    with pytest.raises(ValueError, match="leave it out"):
        ds.ImplicitEulerSolver(pressing.replace(terms=[*pressing.terms_of(ds.Robot), ds.RotatingFrame([0, 0, 3.0])]))
    with pytest.raises(ValueError, match='leave out contact="force"'):
        ds.SemiImplicitSolver(pressing, contact="force")
    with pytest.raises(ValueError, match="leave out viscous_stages"):
        ds.SemiImplicitSolver(pressing.replace(material=ds.KelvinVoigt(SOFT, 1e-3)), viscous_stages=2)
    ds.SemiImplicitSolver(pressing, dt=0.5 * ds.stable_dt(pressing))
    with pytest.raises(ValueError, match="the solver substeps="):
        ds.adaptive_steps(ds.ImplicitEulerSolver(pressing, dt=5e-3), 2, 1e-3)
    ds.Rollout(ds.ImplicitEulerSolver(pressing, dt=5e-3, substeps=2), 2)
    with pytest.raises(ValueError, match="leave out reduced= and Tie"):
        ds.ImplicitEulerSolver(scene_of(ds.Robot.from_urdf(ARM, links=()), reduced={"all": "affine"}))
    far = dict(mesh=moved([1e5, 0, 0]), terms=[ds.Robot.from_urdf(ARM, links=())], fixed="ymin")
    with pytest.raises(ValueError, match='pass precision="f64"'):
        ds.ImplicitEulerSolver(pressing.replace(**far, precision="f32"))
    ds.ImplicitEulerSolver(pressing.replace(**far, precision="f64"))


@pytest.mark.parametrize(
    ("kind", "ratio"), [(ds.ImplicitEulerSolver, 2), (ds.BDF2Solver, 4), (ds.VelocityVerletSolver, 2)]
)
def test_a_pendulum_swings_as_its_equation_says(kind, ratio):
    """Against scipy at 1e-10; where what is frozen in a step is that of its start the order is one, extrapolated, two."""
    from scipy.integrate import solve_ivp

    robot = ds.Robot.from_urdf(
        urdf(link("a"), link("b", 2.0, 0.3), joint("j", "revolute", "a", "b", "0 5 0")),
        positions=[-0.5],
        drive_damping=0.1,
    )
    inertia = 2.0 * 0.3**2 + 1e-3
    equation = lambda t, y: (y[1], -(2.0 * 9.81 * 0.3 * np.cos(y[0]) + 0.1 * y[1]) / inertia)  # noqa: E731
    exact = solve_ivp(equation, (0, 0.2), (-0.5, 0.0), rtol=1e-10, atol=1e-10).y[:, -1]
    scene, errors = scene_of(robot, terms=[ds.Gravity()], fixed="ymin"), []
    for steps in (10, 20):
        outputs = [ds.JointPositions("robot"), ds.JointVelocities("robot")]
        substeps = 20 if kind.explicit else 1
        rollout = ds.Rollout(kind(scene, dt=0.2 / steps, substeps=substeps), steps, outputs=outputs)
        frames = rollout.forward()
        errors.append(np.array([frames[name][-1, 0] for name in ("joint_positions", "joint_velocities")]) - exact)
    assert np.abs(errors[1]).max() < 0.04
    assert np.linalg.norm(errors[0]) / np.linalg.norm(errors[1]) == pytest.approx(ratio, rel=0.05)


@pytest.mark.parametrize("kind", [ds.ImplicitEulerSolver, ds.SemiImplicitSolver])
def test_a_link_hits_a_body_and_momentum_stays_whatever_the_masses(kind):
    """A sliding ball with a drive flies at a body that floats; p of both changes by its efforts alone, to the tolerance of
    the solves, or to round-off."""
    text = urdf(
        link("a"),
        link("b", 1.0, 0.0, shape='<sphere radius="0.02"/>'),
        joint("j", "prismatic", "a", "b", "-0.0313 0.03 0.03", "1 0 0"),
    )
    robot = ds.Robot.from_urdf(text, velocities=[1.0], width=2e-3, stiffness_per_area=3e7, friction=0.3)
    scene = scene_of(robot)
    solver = kind(scene, dt=5e-4, substeps=1) if kind.explicit else kind(scene, dt=4e-3, tolerance=1e-9)
    rollout = ds.Rollout(
        solver, round(0.024 / solver.dt), save_every=1, outputs=[ds.JointVelocities("robot"), ds.JointEfforts("robot")]
    )
    body, m = 500.0 * 0.06**3, scene.mass_matrix().diagonal()[::3]
    for ratio in (1e-3, 1.0, 1e3):
        drive = {"robot.drive_stiffness": [100 * ratio], "robot.drive_damping": [ratio]}
        frames = rollout.forward(**{"robot.masses": [ratio * body]}, **drive)
        gained = float(m @ frames.velocities[-1, :, 0])
        lost = ratio * body * (1.0 - frames["joint_velocities"][-1, 0]) + solver.dt * float(
            frames["joint_efforts"].sum()
        )
        exact = 1e-12 * max(ratio, 1.0) if kind.explicit else 1e-6
        assert lost > 0.1 * body * min(ratio, 1.0) and gained == pytest.approx(lost, rel=exact)


@pytest.fixture(scope="module")
def pressing():
    """An arm of two links presses with its tip on a block and slides."""
    q = np.array([0.3, -1.0])
    robot = ds.Robot.from_urdf(
        ARM,
        "arm",
        positions=q,
        velocities=[-1.0, 0.5],
        targets=lambda t: [0.3 - 10 * t, -1.0 + 5 * t],
        drive_stiffness=50.0,
        drive_damping=1.0,
        friction=0.4,
        friction_speed=0.05,
        width=4e-3,
        stiffness_per_area=3e7,
    )
    tip = robot.poses(q)["arm_tip"][:3]
    mesh = moved(tip - [0.02, 0.092, 0.03])
    return scene_of(robot, mesh, [ds.Gravity()], fixed="ymin")


KINDS = [ds.ImplicitEulerSolver, ds.BDF2Solver, ds.StaticSolver, ds.SemiImplicitSolver, ds.VelocityVerletSolver]


@pytest.mark.parametrize("kind", KINDS)
def test_every_gradient_goes_through_body_and_joints(pressing, kind):
    steps, rng = 3, np.random.default_rng(1)
    outputs = [ds.JointPositions("arm"), ds.JointVelocities("arm"), ds.JointEfforts("arm"), ds.ContactForce("arm_tip")]
    solver = kind(pressing, dt=5e-3, **({} if kind.explicit else dict(tolerance=1e-12)))
    rollout = ds.Rollout(solver, steps, save_every=1, gradients="all", outputs=outputs)
    given = {"arm.torques": rng.normal(size=(steps, 2))}
    frames = rollout.forward(**given)
    friction = np.abs(frames["contact_force"][-1, [0, 2]]).max()
    assert frames["contact_force"][-1, 1] < -1.0 and friction > 0.1
    seeds = {
        name: rng.normal(size=frames[name].shape) for name in ("positions", "velocities", *(x.name for x in outputs))
    }
    gradients = rollout.vjp(frames, **seeds)
    change = {}
    for name, value in frames.inputs.items():
        size = 1e-3 if name.endswith("_positions") else max(0.1 * float(np.abs(value).max()), 1e-3)
        change[name] = size * rng.normal(size=value.shape)
    own = [name for name in change if name.startswith("arm.")]
    for names in (*([name] for name in own), change.keys() - set(own)):
        tangents = rollout.tangents(frames, **{name: change[name] for name in names})
        pushed = sum(float((seeds[k] * tangents[k]).sum()) for k in seeds)
        pulled = sum(float((gradients[name] * change[name]).sum()) for name in names)
        assert pushed == pytest.approx(pulled, rel=1e-9), names
    sides, size = [], 2e-6 if kind.explicit else 1e-5
    for e in (size, -size):
        there = rollout.forward(**{name: value + e * change[name] for name, value in frames.inputs.items()})
        sides.append(sum(float((seeds[k] * there[k]).sum()) for k in seeds))
    whole = sum(float((gradients[name] * change[name]).sum()) for name in change)
    assert (sides[0] - sides[1]) / (2 * size) == pytest.approx(whole, rel=1e-5)


def test_what_links_do_to_vertices_acts_on_joints_in_the_same_step(pressing):
    """The joints' equation with forces that the body has, from Pinocchio alone: left over is the rounding of the solve."""
    import pinocchio as pin

    given = {"arm.torques": np.ones((3, 2))}
    h, outputs = (
        5e-3,
        [ds.JointPositions("arm"), ds.JointVelocities("arm"), ds.ContactForce("arm_tip", "normal", "n", True)],
    )
    outputs.append(ds.ContactForce("arm_tip", "friction", "f", True))
    solver = ds.ImplicitEulerSolver(pressing, dt=h, tolerance=1e-12)
    frames = ds.Rollout(solver, 3, save_every=1, outputs=outputs).forward(**given)
    (q0, q), (v0, v) = frames["joint_positions"][-2:], frames["joint_velocities"][-2:]
    model = pin.buildModelFromXML(ARM)
    data, at = model.createData(), lambda q: np.array([q[0], np.cos(q[1]), np.sin(q[1])])
    model.gravity.linear = np.array([0, -9.81, 0])
    own = pin.rnea(model, data, at(q0), v0, (v - v0) / h) + 50 * (q - [0.15, -0.925]) + [1.01, 1.0] * v - 1.0
    for force, where, x in ((frames["n"][-1], q, frames.positions[-1]), (frames["f"][-1], q0, frames.positions[-2])):
        J = pin.computeJointJacobians(model, data, at(where))
        own = own + J[:3].T @ force.sum(0) + J[3:].T @ np.cross(x, force).sum(0)
    assert frames["n"][-1].sum(0)[1] < -1 and np.abs(own).max() < 1e-9


@pytest.mark.parametrize("kind", [ds.BDF2Solver, ds.SemiImplicitSolver])
def test_steps_that_are_given_torques_are_those_of_a_run(pressing, kind):
    solver, torques = kind(pressing, dt=5e-3), np.random.default_rng(2).normal(size=(2, 2))
    simulator = ds.Simulator(solver)
    for row in torques:
        simulator.step(**{"arm.torques": row})
    frames = ds.Rollout(solver, 2, outputs=[ds.JointPositions("arm")]).forward(**{"arm.torques": torques})
    np.testing.assert_array_equal(simulator.output(ds.JointPositions("arm")), frames["joint_positions"][-1])
    kept = simulator.state
    simulator.step()
    there = simulator.output(ds.JointVelocities("arm"))
    simulator.reset()
    simulator.resume(kept)
    simulator.step()
    np.testing.assert_array_equal(simulator.output(ds.JointVelocities("arm")), there)


def test_two_robots_and_a_ball_in_any_order_have_the_same_run_and_exact_gradients():
    """Robots of other sizes, one on a turned base, whose base and link with two shapes press, too; steps of unequal length,
    two in a frame. No vertex is where two parts of an obstacle are equally near."""
    contact = dict(friction=0.4, friction_speed=0.05, width=4e-3, stiffness_per_area=3e7)
    ball = '<sphere radius="0.02"/>'
    both = "".join(f'<collision><origin xyz="{x} 0 0"/><geometry>{ball}</geometry></collision>' for x in (0.0, 0.2))
    text = urdf(
        link("foot", shape=ball),
        link("b", 0.3, 0.0).replace("</link>", both + "</link>"),
        joint("j", "prismatic", "foot", "b", "-0.0034 0.0513 -0.0222", "0 1 0"),
    )
    slide = ds.Robot.from_urdf(
        text,
        "slide",
        [0.0807, 0.0313, 0.0283, 0, np.pi / 2, 0],
        targets=lambda t: [-0.3 * t],
        prescribed=["j"],
        **contact,
    )
    tip = ds.Robot.from_urdf(ARM, positions=[0.3, -1.0]).poses([0.3, -1.0])["robot_tip"][:3]
    moves = dict(velocities=[-1.0, 0.5], drive_stiffness=50.0, drive_damping=1.0)
    arm = ds.Robot.from_urdf(ARM, "arm", [0.0153, 0.0925, 0.0311] - tip, positions=[0.3, -1.0], **moves, **contact)
    led = dict(name="ball", path=lambda t: [0.05 * t, 0.2 * t, 0], by_pairs=False)
    away = ds.Sphere((-0.0215, 0.0374, 0.0341), 0.02, **led, **contact)
    outputs = [ds.JointPositions("arm", "arm_at"), ds.JointVelocities("slide", "slide_speed")]
    pressed = ["arm_tip", "slide_foot", "slide_b_1", "ball"]
    outputs += [ds.ContactForce(name, name=f"on_{name}") for name in pressed]
    runs = []
    for terms, asked in (
        ([arm, away, ds.Gravity(), slide], outputs),
        ([slide, ds.Gravity(), arm, away], outputs[::-1]),
    ):
        scene = ds.Scene(MESH, SOFT, 500.0, terms, fixed="ymin", precision="f64")
        solver, checkpoint_every = ds.ImplicitEulerSolver(scene, dt=5e-3, tolerance=1e-12), 2 if runs else None
        options = dict(save_every=2, gradients="all", outputs=asked, checkpoint_every=checkpoint_every)
        rollout = ds.Rollout(solver, [5e-3, 3e-3, 6e-3, 4e-3], **options)
        frames, rng = rollout.forward(), np.random.default_rng(0)
        seeds = {x: rng.normal(size=frames[x].shape) for x in ("positions", "velocities", *(y.name for y in outputs))}
        runs.append((frames, rollout.vjp(frames, **seeds)))
    assert all(np.abs(frames[f"on_{name}"][-1]).max() > 0.1 for name in pressed)
    for name in seeds:
        np.testing.assert_allclose(runs[1][0][name], runs[0][0][name], rtol=1e-9, atol=1e-12)
    gradients = runs[0][1]
    for name in gradients:
        np.testing.assert_allclose(
            runs[1][1][name], gradients[name], rtol=1e-7, atol=1e-9 * np.abs(gradients[name]).max()
        )
    share = lambda name, x: 1e-3 if name.endswith("positions") else max(0.1 * np.abs(x).max(), 1e-3)  # noqa: E731
    sizes = {name: share(name, x) for name, x in frames.inputs.items()}
    change = {name: sizes[name] * rng.normal(size=x.shape) for name, x in frames.inputs.items()}
    sides = []
    for e in (1e-5, -1e-5):
        there = rollout.forward(**{name: x + e * change[name] for name, x in frames.inputs.items()})
        sides.append(sum(float((seeds[k] * there[k]).sum()) for k in seeds))
    whole = sum(float((gradients[name] * change[name]).sum()) for name in change)
    assert (sides[0] - sides[1]) / 2e-5 == pytest.approx(whole, rel=1e-5)


# ---- bodies that links hold ------------------------------------------------------------------------------------------

CONTACT = dict(friction=0.4, friction_speed=0.05, width=4e-3, stiffness_per_area=3e7)
Q = np.array([0.3, -1.0])


def held_by_arm(mesh, terms=(), limits=True, **options):
    """A block on the tip of the arm."""
    text = ARM.replace('upper="3"', 'upper="0.3005"', 1) if limits else ARM
    given = dict(positions=Q, velocities=[1.0, -0.5], drive_stiffness=2.0, torques=[5.0, 0.1], links=())
    arm = ds.Robot.from_urdf(text, "arm", attached=dict(tip="xmin"), **given | options)
    return ds.Scene(mesh, SOFT, 500.0, [arm, *terms], precision="f64")


def differs(rollout, frames, seeds, gradients, change):
    """Central difference of a loss along a change of all inputs, and what gradients say of it."""
    sides = []
    for e in (1e-5, -1e-5):
        there = rollout.forward(**{name: x + e * change[name] for name, x in frames.inputs.items()})
        sides.append(sum(float((seeds[k] * there[k]).sum()) for k in seeds))
    return (sides[0] - sides[1]) / 2e-5, sum(float((gradients[name] * change[name]).sum()) for name in change)


@pytest.mark.parametrize("kind", [ds.ImplicitEulerSolver, ds.BDF2Solver, ds.StaticSolver, ds.SemiImplicitSolver])
def test_every_gradient_goes_through_vertices_that_links_hold(kind):
    """A block on an arm whose shoulder meets its limit; a link touches it where it is held, a ball elsewhere."""
    tip = ds.Robot.from_urdf(ARM).poses(Q)["robot_tip"][:3]
    mesh = moved(tip - [0.0, 0.03, 0.03])
    text = urdf(
        link("foot"),
        link("b", 0.3, 0.0, shape='<sphere radius="0.02"/>'),
        joint("j", "prismatic", "foot", "b", "0 0 0", "0 1 0"),
    )
    above = [*(tip + [0.004, 0.0526, 0.003]), 0, 0, 0]
    slide = ds.Robot.from_urdf(text, "slide", above, targets=lambda t: [-0.2 * t], prescribed=["j"], **CONTACT)
    ball = ds.Sphere(tip + [0.063, -0.0521, -0.004], 0.02, name="ball", by_pairs=False, **CONTACT)
    scene = held_by_arm(mesh, [slide, ball, ds.Gravity()])
    outputs = [
        f(robot) for f in (ds.JointPositions, ds.JointVelocities, ds.JointEfforts, ds.LinkEnergy) for robot in ("arm",)
    ]
    outputs += [ds.LinkMotion("tip", "arm"), ds.JointEfforts("slide", "pushed"), ds.ElasticEnergy()]
    outputs += [ds.Reaction("xmin"), ds.Reaction("xmin", "moment", about=tip)]
    outputs += [ds.ContactForce("ball"), ds.ContactForce("slide_b", name="on_slide", per_vertex=True)]
    steps, rng = 2, np.random.default_rng(1)
    solver = kind(scene, dt=5e-3, **({} if kind.explicit else dict(tolerance=1e-12)))
    rollout = ds.Rollout(solver, steps, save_every=1, gradients="all", outputs=outputs)
    frames = rollout.forward()
    held = mesh.vertex_indices("xmin")
    assert np.abs(frames["on_slide"][-1, held]).max() > 0.05 and np.abs(frames["contact_force"][-1]).max() > 0.05
    least = 0.3 if kind is ds.BDF2Solver else 0.3005  # where the limit begins, which it meets later
    assert least < frames["joint_positions"][-1, 0] < 0.3006
    x, (t, turn) = frames.positions[-1, held], np.split(frames["link_motion"][-1, :7], [3])
    x0, (t0, turn0) = mesh.vertices[held], np.split(frames["link_motion"][0, :7], [3])
    local = rotations.turned(rotations.conjugate(turn0), x0 - t0)
    np.testing.assert_allclose(t + rotations.turned(turn, local), x, atol=1e-14)
    seeds = {
        name: rng.normal(size=frames[name].shape) for name in ("positions", "velocities", *(y.name for y in outputs))
    }
    gradients, change = rollout.vjp(frames, **seeds), {}
    for name, value in frames.inputs.items():
        size = 1e-3 if name.endswith("positions") else max(0.1 * float(np.abs(value).max()), 1e-3)
        change[name] = size * rng.normal(size=value.shape)
    own = [name for name in change if name.startswith("arm.") or name.endswith("_positions")]
    for names in (*([name] for name in own), change.keys() - set(own)):
        tangents = rollout.tangents(frames, **{name: change[name] for name in names})
        pushed = sum(float((seeds[k] * tangents[k]).sum()) for k in seeds)
        pulled = sum(float((gradients[name] * change[name]).sum()) for name in names)
        # what is prescribed, or beyond a limit, is a million times as stiff as the rest, and costs digits of implicit solves
        exact = 1e-9 if kind.explicit else 1e-8
        assert pushed == pytest.approx(pulled, rel=exact), names
    difference, whole = differs(rollout, frames, seeds, gradients, change)
    assert difference == pytest.approx(whole, rel=1e-5)


def test_a_cart_and_the_body_that_it_holds_keep_their_momentum():
    """A body that flies is stopped by a link that holds it; explicit steps exchange impulses to round-off."""
    text = urdf(link("a"), link("b", 0.2, 0.0), joint("j", "prismatic", "a", "b", "0 0 0", "1 0 0"))
    cart = ds.Robot.from_urdf(text, attached=dict(b="xmin"), links=())
    scene = scene_of(cart, initial_velocities=[1.0, 0, 0])
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=2e-3), 4, save_every=1, outputs=[ds.JointVelocities()])
    frames, m = rollout.forward(), scene.mass_matrix().diagonal()[::3]
    momentum = frames.velocities[:, :, 0] @ m + 0.2 * frames["joint_velocities"][:, 0]
    assert frames["joint_velocities"][-1, 0] > 0.1
    np.testing.assert_allclose(momentum, 500 * 0.06**3, rtol=1e-13)


@pytest.mark.parametrize("kind", [ds.ImplicitEulerSolver, ds.SemiImplicitSolver])
def test_an_arm_at_rest_stays(kind):
    """Only rounding of the places of the vertices that it holds is left to balance."""
    arm = ds.Robot.from_urdf(ARM, attached=dict(tip="xmin"), links=())
    simulator = ds.Simulator(kind(scene_of(arm), dt=5e-3))
    simulator.run(3)
    assert np.abs(simulator.velocities).max() < 1e-12


def test_equilibria_of_joints_are_those_of_their_springs_weights_and_limits():
    from scipy.optimize import brentq

    def found(text, fixed="ymin", **options):
        scene = scene_of(ds.Robot.from_urdf(text, **options), terms=[ds.Gravity()], fixed=fixed)
        outputs = [ds.JointPositions(), ds.JointVelocities(), ds.JointEfforts()]
        return ds.Rollout(ds.StaticSolver(scene), 1, outputs=outputs).forward()

    arm = urdf(link("a"), link("b", 2.0, 0.3), joint("j", "revolute", "a", "b", "0 5 0"))
    sprung = found(arm, positions=[-0.5], drive_stiffness=20.0, velocities=[1.0])
    exact = brentq(lambda q: 20 * (q + 0.5) + 2 * 9.81 * 0.3 * np.cos(q), -2, 2, xtol=1e-14)
    assert sprung["joint_positions"][-1, 0] == pytest.approx(exact, rel=1e-12)
    assert sprung["joint_efforts"][-1, 0] == pytest.approx(2 * 9.81 * 0.3 * np.cos(exact), rel=1e-10)
    assert not sprung["joint_velocities"][-1].any()
    hanging = found(arm, positions=[-1.0])["joint_positions"]
    assert hanging[-1, 0] == pytest.approx(-np.pi / 2, rel=1e-12)
    slide = urdf(link("a"), link("b", 2.0), joint("j", "prismatic", "a", "b", "0 0 0", "0 1 0"))
    lying = found(slide.replace('lower="-3"', 'lower="-0.01"'))
    assert lying["joint_positions"][-1, 0] == pytest.approx(-0.01, abs=2e-6)
    assert lying["joint_efforts"][-1, 0] == pytest.approx(2 * 9.81)
    for more, message in (
        (dict(), "nothing holds joint 'j'"),
        (dict(positions=[np.pi / 2]), "unstable along joint 'j'"),
    ):
        text = slide if not more else arm
        with pytest.raises(FloatingPointError, match=f"{message} of a robot: hold the joint by drive_stiffness"):
            found(text, limits=False, **more)
        found(text, limits=False, **more, drive_stiffness=20.0)
        found(text, limits=False, **more, prescribed=["j"])


def test_a_link_presses_in_equilibrium_with_the_force_of_its_joint_and_turns_by_less_than_half_a_turn():
    text = urdf(
        link("a"),
        link("b", 1.0, 0.0, shape='<sphere radius="0.02"/>'),
        joint("j", "prismatic", "a", "b", "-0.0313 0.03 0.03", "1 0 0"),
    )
    robot = ds.Robot.from_urdf(text, width=2e-3, stiffness_per_area=3e7, torques=[2.0])
    outputs = [ds.ContactForce("robot_b"), ds.Reaction("xmax")]
    frames = ds.Rollout(ds.StaticSolver(scene_of(robot, fixed="xmax")), 1, outputs=outputs).forward()
    assert frames["contact_force"][-1, 0] == pytest.approx(2.0, rel=1e-7)
    assert frames["reaction"][-1, 0] == pytest.approx(-2.0, rel=1e-7)
    text = urdf(link("a"), link("b", 1.0, shape='<sphere radius="0.02"/>'), joint("j", "revolute", "a", "b", "0 5 0"))
    given = dict(width=2e-3, stiffness_per_area=3e7, torques=[4.0], targets=[0.0], drive_stiffness=1.0, limits=False)

    def turned(start):
        scene = scene_of(ds.Robot.from_urdf(text, positions=[start], **given), fixed="xmax")
        return ds.Rollout(ds.StaticSolver(scene), 1, outputs=[ds.JointPositions()]).forward()["joint_positions"][-1, 0]

    with pytest.raises(FloatingPointError, match="half a turn: give positions of joints nearer to the equilibrium"):
        turned(0.0)
    assert turned(3.0) == pytest.approx(4.0)


BOB = ds.TetrahedralMesh.create_box((3, 3, 3), 0.06, origin=(0.2, -0.03, -0.03))
ROD = urdf(
    link("a"),
    link("rod", 0.2, 0.1),
    joint(
        "j",
        "revolute",
        "a",
        "rod",
        "0 0 0",
        more='<limit lower="-3" upper="3" effort="9" velocity="9"/><dynamics damping="0.02"/>',
    ),
)


def swing(E: float, steps: int):
    """A rod with a block at its end falls from where it is level, for 0.2 s, with a torque: (angle, energy that is lost)."""
    robot = ds.Robot.from_urdf(ROD, attached=dict(rod="xmin"), torques=[0.1], links=())
    scene = ds.Scene(BOB, ds.StableNeoHookean(E, 0.3), 500.0, [robot, ds.Gravity()], precision="f64")
    outputs = [ds.JointPositions(), ds.JointEfforts(), ds.LinkEnergy(), ds.KineticEnergy(), ds.ElasticEnergy()]
    rollout = ds.Rollout(
        ds.ImplicitEulerSolver(scene, dt=0.2 / steps),
        steps,
        save_every=1,
        outputs=[*outputs, ds.WorkOfLoads(weight=True)],
    )
    f = rollout.forward()
    worked = f["work"][-1] + float((f["joint_efforts"][1:] * np.diff(f["joint_positions"], axis=0)).sum())
    stored = f["link_energy"].sum(1) + f["kinetic_energy"] + f["elastic_energy"]
    return f["joint_positions"][-1, 0], worked - (stored[-1] - stored[0]), scene


def test_a_pendulum_with_a_stiff_bob_is_a_rigid_one_and_its_energy_is_balanced():
    """Against scipy at 1e-10: both errors halve with the step, and what is left of them by extrapolation is small."""
    from scipy.integrate import solve_ivp

    (coarse, lost, scene), (fine, lost_less, _) = swing(1e7, 20), swing(1e7, 40)
    m, x = scene.mass_matrix().diagonal()[::3], BOB.vertices
    inertia, arm = 0.2 * 0.1**2 + 1e-3 + m @ (x[:, :2] ** 2).sum(1), 0.2 * 0.1 + m @ x[:, 0]
    equation = lambda t, y: (y[1], (0.1 - 9.81 * arm * np.cos(y[0]) - 0.02 * y[1]) / inertia)  # noqa: E731
    exact = solve_ivp(equation, (0, 0.2), (0.0, 0.0), rtol=1e-10, atol=1e-10).y[0, -1]
    assert (coarse - exact) / (fine - exact) == pytest.approx(2, abs=0.1)
    assert 2 * fine - coarse == pytest.approx(exact, abs=1e-3)
    assert lost > 0 and lost / lost_less == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("kind", [ds.ImplicitEulerSolver, ds.SemiImplicitSolver])
def test_a_joint_stops_at_its_limit_and_says_what_that_takes(kind):
    h, steps = (1e-3, 150) if kind.explicit else (5e-3, 30)
    text = urdf(link("a"), link("b", 2.0), joint("j", "prismatic", "a", "b", "0 0 0", "0 1 0"))
    robot = ds.Robot.from_urdf(text.replace('lower="-3"', 'lower="-0.01"'), links=())
    outputs = [ds.JointPositions(), ds.JointVelocities(), ds.JointEfforts()]
    solver = kind(scene_of(robot, terms=[ds.Gravity()], fixed="ymin"), dt=h)
    rollout = ds.Rollout(solver, steps, save_every=steps, outputs=outputs)
    frames = rollout.forward()
    assert frames["joint_positions"][-1, 0] == pytest.approx(-0.01, abs=1e-6)
    assert abs(frames["joint_velocities"][-1, 0]) < 1e-9 and frames["joint_efforts"][-1, 0] == pytest.approx(2 * 9.81)
    free = ds.Robot.from_urdf(text.replace('lower="-3"', 'lower="-0.01"'), links=(), limits=False)
    solver = kind(solver.scene.replace(terms=[free, ds.Gravity()]), dt=h)
    rollout = ds.Rollout(solver, steps, outputs=outputs)
    frames = rollout.forward()
    assert frames["joint_positions"][-1, 0] < -0.1 and not frames["joint_efforts"].any()
    moves = rollout.tangents(frames, **{"robot.torques": [1.0]})
    assert moves["joint_positions"][-1, 0] == pytest.approx(h**2 * steps * (steps + 1) / 2 / 2.0)
    assert moves["joint_efforts"][-1, 0] == pytest.approx(1.0)


@pytest.mark.parametrize("kind", [ds.ImplicitEulerSolver, ds.SemiImplicitSolver])
def test_a_prescribed_joint_follows_its_target_beyond_its_limits(kind):
    text = urdf(link("a"), link("b", 2.0), joint("j", "prismatic", "a", "b", "0 5 0", "0 1 0"))
    text = text.replace('lower="-3"', 'lower="-0.01"')
    robot = ds.Robot.from_urdf(text, links=(), targets=lambda t: [-10 * t], prescribed=["j"])
    rollout = ds.Rollout(kind(scene_of(robot, fixed="ymin"), dt=1e-3), 3, outputs=[ds.JointPositions()])
    assert rollout.forward()["joint_positions"][-1, 0] == pytest.approx(-0.03, rel=1e-5)


def test_a_link_that_starts_in_the_body_or_meets_fixed_vertices_gets_advice_that_works():
    text = urdf(
        link("a"),
        link("b", 1.0, 0.0, shape='<sphere radius="0.02"/>'),
        joint("j", "prismatic", "a", "b", "-0.0225 0.03 0.03", "1 0 0"),
    )
    given = dict(velocities=[1.0], width=2e-3, stiffness_per_area=3e7)
    scene = scene_of(ds.Robot.from_urdf(text, **given), fixed="xmin")
    with pytest.raises(FloatingPointError, match="let links through vertices that are fixed: take Impl") as error:
        ds.Simulator(ds.SemiImplicitSolver(scene, dt=4e-3)).run(4)
    assert error.value.enough is None and error.value.stiffness is None
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene, dt=4e-3))
    simulator.run(4)
    assert simulator.joint_states[0, 0] < 2.5e-3
    inside = dict(given, positions=[0.01])
    with pytest.raises(
        ValueError, match="starts on or in .*: vertex .*move the body or the robot, or leave the link out"
    ):
        ds.Simulator(ds.ImplicitEulerSolver(scene_of(ds.Robot.from_urdf(text, **inside)), dt=1e-3))
    ds.Simulator(ds.ImplicitEulerSolver(scene_of(ds.Robot.from_urdf(text, links=[], **inside)), dt=1e-3))
    ds.Simulator(ds.ImplicitEulerSolver(scene_of(ds.Robot.from_urdf(text, base=[-0.02, 0, 0], **inside)), dt=1e-3))


def test_vertices_that_links_hold_are_set_where_links_have_them():
    arm = ds.Robot.from_urdf(ARM, attached=dict(tip="xmin"), velocities=1.0, links=())
    simulator, held = ds.Simulator(ds.ImplicitEulerSolver(scene_of(arm), dt=1e-3)), MESH.vertex_indices("xmin")
    simulator.step()
    x = simulator.positions
    with pytest.raises(
        ValueError, match="hold some vertices 0.01 m elsewhere: leave those of attached= where they are"
    ):
        simulator.set_state(positions=x + [0.01, 0.0, 0.0])
    np.testing.assert_array_equal(simulator.positions, x)
    there = x + [1e-4, 0.0, 0.0]
    there[held] = x[held]
    simulator.set_state(positions=there)
    simulator.step()
    assert np.abs(simulator.positions[held] - x[held]).max() < 2e-3


def test_links_hold_new_vertices_of_a_finer_mesh():
    held = ds.Robot.from_urdf(ARM, attached=dict(tip=MESH.vertex_indices("xmin")), links=())
    fine = on_finer(scene_of(held), ds.TetrahedralMesh.refined)
    ((_, vertices),) = fine.terms_of(ds.Robot)[0].holds
    np.testing.assert_array_equal(np.sort(vertices), np.flatnonzero(fine.mesh.vertices[:, 0] == 0))


def test_the_error_of_the_mesh_has_shares_by_volume(pressing):
    rollout = ds.Rollout(ds.ImplicitEulerSolver(pressing, dt=2e-3, tolerance=1e-9), 2, outputs=ds.JointPositions("arm"))
    finer = ds.TetrahedralMesh.refined
    found, fine = rollout.accuracy("joint_positions", (1.0, 0.0), finer), rollout_on_finer(rollout, finer)
    difference = found.value - fine.forward()["joint_positions"][-1, 0]
    assert found.mesh + found.solver == pytest.approx(difference, rel=1e-4) and "unplaced" in found.doubts
    np.testing.assert_allclose(found.shares / found.mesh, pressing.mesh.volumes / pressing.mesh.volume, rtol=1e-9)


def test_what_does_not_go_with_limits_and_held_vertices_is_refused_and_the_advice_works():
    for change in (('lower="-3"', 'lower="3"'), ('upper="3"', 'upper="0.2"')):
        text, given = ARM.replace(*change, 1), dict(positions=Q, links=())
        with pytest.raises(ValueError, match="limits=False"):
            ds.Robot.from_urdf(text, **given)
        assert not np.isfinite(ds.Robot.from_urdf(text, limits=False, **given).limits).any()
    narrow = ds.Robot.from_urdf(ARM.replace('upper="3"', 'upper="0.4"', 1), links=())
    with pytest.raises(ValueError, match="starts at 0.5, beyond its limits -3 and 0.4"):
        ds.Rollout(ds.ImplicitEulerSolver(scene_of(narrow), dt=1e-3), 1).forward(**{"robot.positions": [0.5, 0.0]})
    with pytest.raises(ValueError, match="attached: no link 'hand'; the file has base"):
        ds.Robot.from_urdf(ARM, attached=dict(hand="xmin"))
    arm, held = ds.Robot.from_urdf(ARM, attached=dict(tip="xmin"), links=()), MESH.vertex_indices("xmin")[:1]
    for options, message, less in (
        (dict(fixed="ymin"), "name sets that share no vertices", dict(fixed="xmax")),
        (dict(terms=[ds.SelfContact()]), "leave these out", dict()),
        (
            dict(terms=[ds.Sphere((0, 1, 0), 0.1, by_pairs=True, **CONTACT)]),
            "by_pairs=False",
            dict(terms=[ds.Sphere((0, 1, 0), 0.1, by_pairs=False, **CONTACT)]),
        ),
        (dict(terms=[ds.Pressure(10.0, "ymax")]), "which .* has not: leave out", dict()),
        (
            dict(terms=[ds.MultiPointConstraint(held, [[1.0, 0, 0]])]),
            "names no vertices that links of robots hold",
            dict(terms=[ds.MultiPointConstraint(held, [[1.0, 0, 0]], stiffness=1.0)]),
        ),
    ):
        with pytest.raises(ValueError, match=message):
            ds.Simulator(ds.ImplicitEulerSolver(scene_of(arm, **options), dt=1e-3))
        ds.Simulator(ds.ImplicitEulerSolver(scene_of(arm, **less), dt=1e-3))
    with pytest.raises(
        ValueError, match="attached= of a robot is not for VelocityVerletSolver.* take SemiImplicitSolver"
    ):
        ds.VelocityVerletSolver(scene_of(arm), dt=1e-5)
    with pytest.raises(ValueError, match="LinkMotion: no link 'hand'; there are base"):
        ds.LinkMotion("hand").settled(scene_of(arm))
