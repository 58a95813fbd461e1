"""A pendulum of a URDF file with a soft bob that its link holds, beside one whose bob is rigid.

The rigid one is integrated by SciPy at 1e-10. The last angle is extrapolated from two steps; the stiffer the bob, the nearer
it is to the rigid one's. What steps of backward Euler lose of the energy halves with them.

    python examples/benchmarks/soft_pendulum.py
"""

import numpy as np
from scipy.integrate import solve_ivp

import diffsim_ti as ds

ROD = """<robot name="rod"><link name="base"/><link name="rod"><inertial><origin xyz="0.1 0 0"/><mass value="0.2"/>
<inertia ixx="1e-5" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="pivot" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/><dynamics damping="0.01"/></joint></robot>"""
TIME, OUTPUTS = 0.25, [ds.JointPositions(), ds.JointEfforts(), ds.LinkEnergy(), ds.KineticEnergy(), ds.ElasticEnergy()]


def swing(E: float, steps: int):
    """It falls from where it is level: (angles [rad], energy that steps have lost [J], masses, vertices of the bob)."""
    bob = ds.TetrahedralMesh.create_box((3, 3, 3), 0.06, origin=(0.2, -0.03, -0.03))
    robot = ds.Robot.from_urdf(ROD, attached={"rod": "xmin"})
    scene = ds.Scene(bob, ds.StableNeoHookean(E, 0.3), 500.0, [robot, ds.Gravity()], precision="f64")
    outputs = [*OUTPUTS, ds.WorkOfLoads(weight=True)]
    run = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=TIME / steps), steps, save_every=1, outputs=outputs).forward()
    angles = run["joint_positions"][:, 0]
    worked = run["work"][-1] + float(run["joint_efforts"][1:, 0] @ np.diff(angles))
    energy = run["link_energy"].sum(1) + run["kinetic_energy"] + run["elastic_energy"]
    return angles, worked - (energy[-1] - energy[0]), scene.mass_matrix().diagonal()[::3], bob.vertices


def rigid(masses: np.ndarray, x: np.ndarray) -> float:
    """Last angle of the one with a rigid bob of the same masses."""
    inertia, arm = 1e-3 + 0.2 * 0.1**2 + masses @ (x[:, :2] ** 2).sum(1), 0.2 * 0.1 + masses @ x[:, 0]
    rate = lambda t, y: (y[1], -(9.81 * arm * np.cos(y[0]) + 0.01 * y[1]) / inertia)  # noqa: E731
    return solve_ivp(rate, (0, TIME), (0, 0), rtol=1e-10, atol=1e-12).y[0, -1]


def main(steps: int = 50) -> dict:
    """Returns {E: (difference of the extrapolated angle from the rigid one's [rad], energy lost with two steps [J])}."""
    found = {}
    print("bob's E [Pa]  difference of the angle [rad]  energy lost [J], half the step")
    for E in (1e3, 1e4, 1e5, 1e6):
        (coarse, lost, masses, x), (fine, lost_less, *_) = swing(E, steps), swing(E, 2 * steps)
        found[E] = 2 * fine[-1] - coarse[-1] - rigid(masses, x), lost, lost_less
        print(f"{E:12.0e}  {found[E][0]:29.1e}  {lost:15.2e}, {lost_less:.2e}")
    return found


if __name__ == "__main__":
    ds.init(precision="f64")
    main()
