"""An arm of two links presses on a soft block and slides over it: gradients through body and joints, over many steps.

The reverse sweep is held against the tangent along all inputs of the robot together (dot products), and against central
differences.

    python examples/benchmarks/robot_arm.py [steps of 5 ms, 200 by default] [explicit]
"""

import sys
import time

import numpy as np

import diffsim_ti as ds

JOINT = (
    '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><origin xyz="{3}"/><axis xyz="0 0 1"/>'
    '<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>'
)
LINK = '<link name="{0}"><inertial><origin xyz="0.1 0 0"/><mass value="{1}"/>{2}</inertial>{3}</link>'
ROUND = '<inertia ixx="1e-3" iyy="4e-3" izz="4e-3" ixy="0" ixz="0" iyz="0"/>'
TIP = '<collision><origin xyz="0.2 0 0"/><geometry><sphere radius="0.03"/></geometry></collision>'
ARM = (
    '<robot name="arm"><link name="base"/>'
    + LINK.format("upper", 1.0, ROUND, "")
    + LINK.format("fore", 0.5, ROUND, TIP)
    + JOINT.format("shoulder", "base", "upper", "0 0.3 0")
    + JOINT.format("elbow", "upper", "fore", "0.3 0 0")
    + "</robot>"
)
START, STIFFNESS = np.array([0.3, -1.0]), 60.0
SEEN = "joint_positions", "joint_velocities"


def rollout_of(steps: int, dt: float, explicit: bool = False) -> ds.Rollout:
    """Targets that press the tip 1 cm into the block and draw it over it by 3 cm and back once a second."""
    way = lambda t: START + [-0.05 + 0.04 * np.sin(2 * np.pi * t), -0.02 - 0.08 * np.sin(2 * np.pi * t)]  # noqa: E731
    robot = ds.Robot.from_urdf(
        ARM,
        "arm",
        positions=START,
        targets=lambda t: START + min(t / 0.05, 1.0) * (way(t) - START),
        drive_stiffness=STIFFNESS,
        drive_damping=2.0,
        friction=0.4,
        friction_speed=0.05,
        width=4e-3,
        stiffness_per_area=3e7,
    )
    tip = robot.poses(START)["arm_fore"][:3]
    mesh = ds.TetrahedralMesh.create_box((4, 3, 3), (0.12, 0.06, 0.06), origin=tip - [0.06, 0.095, 0.03])
    terms = [ds.Gravity(), robot]
    scene = ds.Scene(mesh, ds.StableNeoHookean(3e4, 0.35), 500.0, terms, fixed="ymin", precision="f64")
    outputs = [ds.JointPositions("arm"), ds.JointVelocities("arm"), ds.ContactForce("arm_fore")]
    implicit = ds.ImplicitEulerSolver(scene, dt=dt, tolerance=1e-12)
    return ds.Rollout(ds.SemiImplicitSolver(scene, dt=dt) if explicit else implicit, steps, outputs=outputs)


def main(steps: int = 200, dt: float = 5e-3, explicit: bool = False) -> dict:
    """Returns the relative differences of dot products and of central differences, the last contact force [N], seconds."""
    begin, rng, rollout = time.perf_counter(), np.random.default_rng(0), rollout_of(steps, dt, explicit)
    frames = rollout.forward()
    seeds = {name: rng.normal(size=frames[name].shape) for name in ("positions", "velocities", *SEEN)}
    gradients, out = rollout.vjp(frames, **seeds), dict(force=frames["contact_force"][-1])
    names = [name for name in frames.inputs if name.startswith("arm")]
    size = {name: max(float(np.abs(frames.inputs[name]).max()), 0.1) for name in names}
    change = {name: size[name] * rng.normal(size=frames.inputs[name].shape) for name in names}
    pulled = sum(float((gradients[name] * change[name]).sum()) for name in names)
    pushed = rollout.tangents(frames, **change)
    out["dot"] = abs(sum(float((seeds[k] * pushed[k]).sum()) for k in seeds) / pulled - 1)
    sides = []
    for e in (1e-6, -1e-6):
        there = rollout.forward(**{name: frames.inputs[name] + e * change[name] for name in names})
        sides.append(sum(float((seeds[k] * there[k]).sum()) for k in seeds))
    out["difference"] = abs((sides[0] - sides[1]) / 2e-6 / pulled - 1)
    out["seconds"] = time.perf_counter() - begin
    pressed = f"{steps} steps of {1e3 * dt:g} ms, the tip is pushed up by {-out['force'][1]:.1f} N at the end"
    print(f"{pressed}; dot products differ by {out['dot']:.1e}, differences by {out['difference']:.1e}")
    print(f"{out['seconds']:.0f} s for a run, its reverse sweep and tangent, and two more runs")
    return out


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*map(int, sys.argv[1:2]), explicit="explicit" in sys.argv[2:])
