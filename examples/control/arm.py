"""A robot arm presses with a soft finger: which joint angles bring its tip to a place on a table with a given force?

Pinocchio (pip install "diffsim-ti[robots]") knows where three joints bring the flange. There the finger is
clamped, and follows as `ds.Pose` says, here by a torch tensor of displacements and quaternions. Equilibria with friction
tell the force on the table and where the tip is. One backward pass for each goes through contact, finger, clamp and
kinematics down to the joints, so that Newton's method solves three equations for three angles. The wrench at the flange
comes with it.

    python examples/control/arm.py [folder for a picture]
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import torch

import diffsim_ti as ds
from diffsim_ti.picture import Arrows, Points, arrows, save_picture
from diffsim_ti.terms.obstacles.shapes import tube

FINGER = (0.12, 0.02, 0.02)  # [m]
TABLE = 0.22  # its height; the shoulder's is 0.3 [m]
HOME = (0.0, 1.0, -2.0)  # joint angles before it presses, the tip 2 cm above the table [rad]
STEPS = 6  # from there
PLACE, FORCE = np.array([0.36, 0.03]), 2.0  # where the tip is to be (x, z) [m], and with which force on the table [N]
TOLERANCE = 1e-6  # of the residuals: forces over FORCE, places over a centimetre


def arm() -> pin.Model:
    """A turning base, a shoulder and an elbow; y is up, links of 0.3, 0.25 and 0.2 m."""
    joints = [
        ("base", "turn", "0 0 0", "0 1 0"),
        ("turn", "upper", "0 0.3 0", "0 0 1"),
        ("upper", "fore", "0.25 0 0", "0 0 1"),
    ]
    text = "".join(
        f'<joint name="{child}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{place}"/>'
        f'<axis xyz="{axis}"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        for parent, child, place, axis in joints
    )
    text += '<joint name="end" type="fixed"><parent link="fore"/><child link="flange"/><origin xyz="0.2 0 0"/></joint>'
    links = "".join(f'<link name="{name}"/>' for name in ("base", "turn", "upper", "fore", "flange"))
    return pin.buildModelFromXML(f'<robot name="arm">{links}{text}</robot>')


class Flange(torch.autograd.Function):
    """(rotations, positions [m]) of the flange for joint angles, shape (n, 3), with Pinocchio's Jacobian."""

    @staticmethod
    def forward(ctx, angles, model):
        data, frame = model.createData(), model.getFrameId("flange")
        R, p, J = [], [], []
        for q in angles.detach().numpy():
            J.append(pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED))
            placed = pin.updateFramePlacement(model, data, frame)
            R.append(placed.rotation.copy())
            p.append(placed.translation.copy())
        R, p, J = (torch.tensor(np.array(x)) for x in (R, p, J))
        ctx.save_for_backward(R, J)
        return R, p

    @staticmethod
    def backward(ctx, by_R, by_p):
        R, J = ctx.saved_tensors
        M = by_R @ R.transpose(1, 2)
        turn = torch.stack([M[:, 2, 1] - M[:, 1, 2], M[:, 0, 2] - M[:, 2, 0], M[:, 1, 0] - M[:, 0, 1]], 1)
        return torch.einsum("nda,nd->na", J, torch.cat([by_p, turn], 1)), None


def quaternions(R: torch.Tensor) -> torch.Tensor:
    """Of rotations by less than half a turn, shape (n, 3, 3), and of any length, which a pose may have: without the root of
    a trace, whose slope is infinite where nothing is turned."""
    off = R - R.transpose(1, 2)
    trace = R.diagonal(dim1=1, dim2=2).sum(1)
    return torch.stack([1 + trace, off[:, 2, 1], off[:, 0, 2], off[:, 1, 0]], 1)


class Pressing:
    """The finger in equilibria on its way from HOME to other angles."""

    def __init__(self, cells: int = 8):
        self.chain, self.home = arm(), torch.tensor(HOME, dtype=torch.float64)
        self.rotation, self.flange = self.places(self.home[None])
        R, p = self.rotation[0].numpy(), self.flange[0].numpy()
        box = ds.TetrahedralMesh.create_box((cells + 1, 3, 3), FINGER, origin=(0, -0.01, -0.01), pattern="five")
        self.mesh = ds.TetrahedralMesh(box.vertices @ R.T + p, box.tetrahedra, vertex_sets=box.vertex_sets)
        self.tip = R @ [FINGER[0], 0, 0] + p
        table = ds.Ground(TABLE, stiffness=2e4, width=2e-3, friction=0.5, name="table")
        still = ([0.0, 1.0], np.tile([0, 0, 0, 1, 0, 0, 0.0], (2, 1)))  # how it moves is an input
        scene = ds.Scene(
            self.mesh,
            ds.StableNeoHookean(5e5, 0.4),
            1100.0,
            [ds.Gravity(), table],
            fixed={"xmin": "xyz"},
            motion={"xmin": ds.Pose(still, p)},
            precision="f64",
        )
        self.weight = 9.81 * float(scene.mass_matrix().diagonal().sum()) / 3  # [N]
        outputs = [
            ds.ContactForce("table", name="pressed"),
            ds.ContactForce("table", name="table", per_vertex=True),
            ds.MaterialPoints(self.tip[None], name="tip"),
            ds.Reaction("xmin", per_vertex=True, name="held"),
        ]
        solver = ds.StaticSolver(scene, load_steps=1, tolerance=1e-11)
        self.rollout = ds.Rollout(solver, STEPS, 1, gradients=["prescribed_pose.xmin"], outputs=outputs)

    def places(self, angles: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(rotations, positions [m]) of the flange for joint angles, shape (n, 3)."""
        return Flange.apply(angles, self.chain)

    def frames(self, angles: torch.Tensor):
        """Equilibria as the joints go straight from HOME to these angles."""
        way = self.home + torch.linspace(0, 1, STEPS + 1, dtype=torch.float64)[:, None] * (angles - self.home)
        rotation, position = self.places(way)
        poses = torch.cat([position - self.flange[0], quaternions(rotation @ self.rotation[0].T)], 1)
        return ds.rollout_frames(self.rollout, **{"prescribed_pose.xmin": poses})

    def carried(self, angles: torch.Tensor) -> np.ndarray:
        """Where the finger would be if it were rigid [m]."""
        R, p = (part[0].numpy() for part in self.places(angles[None]))
        return (self.mesh.vertices - self.flange[0].numpy()) @ (R @ self.rotation[0].numpy().T).T + p

    def residual(self, frames) -> torch.Tensor:
        """How far tip and force are from what they are to be."""
        aside = (frames["tip"][-1, 0, [0, 2]] - torch.tensor(PLACE)) / 0.01
        return torch.cat([aside, frames["pressed"][-1, 1:2] / FORCE - 1])

    def rigid(self, depth: float = 3e-3) -> torch.Tensor:
        """Joint angles that would bring the tip of a rigid finger to PLACE, `depth` [m] below the table."""
        angles, goal = self.home.clone(), torch.tensor([PLACE[0], TABLE - depth, PLACE[1]])

        def tip(angles):
            R, p = self.places(angles[None])
            return p[0] + R[0] @ torch.tensor([FINGER[0], 0.0, 0.0], dtype=torch.float64)

        for _ in range(20):
            angles = angles - torch.linalg.solve(torch.autograd.functional.jacobian(tip, angles), tip(angles) - goal)
        return angles

    def wrench(self, frames, k: int = -1) -> tuple[np.ndarray, np.ndarray]:
        """(force [N], moment about the flange [N m]) with which the arm holds the finger in frame k."""
        held, x = (part[k].detach().numpy() for part in (frames["held"], frames.positions))
        own = self.mesh.vertex_indices("xmin")
        return held[own].sum(0), np.cross(x[own] - x[own].mean(0), held[own]).sum(0)


def find(pressing: Pressing, angles: torch.Tensor, most: int = 12) -> tuple:
    """(angles, frames, largest residual by iterations) of Newton's method."""
    history = []
    while True:
        angles = angles.detach().requires_grad_()
        frames = pressing.frames(angles)
        residual = pressing.residual(frames)
        history.append(residual.abs().max().item())
        if history[-1] < TOLERANCE or len(history) == most:
            return angles.detach(), frames, history
        rows = [torch.autograd.grad(r, angles, retain_graph=True)[0] for r in residual]
        step = torch.linalg.solve(torch.stack(rows), -residual.detach())
        angles = angles + step * min(1.0, 0.1 / step.abs().max().item())


def main(folder: str | None = None, quick: bool = False) -> dict:
    """Returns angles [rad], force of the arm on the finger and of that on the table [N], moment about the flange [N m],
    where the tip is [m], weight [N], the largest residual by iterations, seconds."""
    start, pressing = time.perf_counter(), Pressing(4 if quick else 8)
    angles, frames, history = find(pressing, pressing.rigid())
    force, moment = pressing.wrench(frames)
    pressed, tip = -frames["pressed"][-1].detach().numpy(), frames["tip"][-1, 0].detach().numpy()
    out = dict(angles=angles.numpy(), force=force, moment=moment, pressed=pressed, tip=tip, history=history)
    out |= dict(weight=pressing.weight, seconds=time.perf_counter() - start)
    words = ", ".join(f"{a:.4f}" for a in out["angles"])
    print(
        f"joints at {words} rad press with {-pressed[1]:.4f} N (and {np.hypot(pressed[0], pressed[2]):.4f} N aside) at "
        f"({tip[0]:.4f}, {tip[2]:.4f}) m, off by {history[0]:.2g} as if rigid and {history[-1]:.1g} after "
        f"{len(history) - 1} steps of Newton's method"
    )
    print(
        f"wrench at the flange: force {np.round(force, 4).tolist()} N, moment {np.round(1e3 * moment, 3).tolist()} N mm; "
        f"{out['seconds']:.1f} s"
    )
    if folder:
        draw(pressing, angles, frames, Path(folder) / "arm.png")
    return out


def draw(pressing: Pressing, angles: torch.Tensor, frames, path: Path) -> None:
    """Arm and finger, what the table does to the finger, and what the arm does to it."""
    x, mesh = frames.positions[-1].detach().numpy(), pressing.mesh
    model, data = pressing.chain, pressing.chain.createData()
    pin.framesForwardKinematics(model, data, angles.numpy())
    ends = [
        data.oMf[model.getFrameId(name, pin.BODY)].translation.copy() for name in ("base", "upper", "fore", "flange")
    ]
    force, forces = pressing.wrench(frames)[0], frames["table"][-1].detach().numpy()
    table = arrows("table on the finger, at each vertex [N]", mesh, x, np.arange(mesh.num_vertices), forces)
    hand = Arrows("arm on the finger, at the flange [N]", ends[-1][None], force[None], np.array([False]))
    moved = 1e3 * np.linalg.norm(x - pressing.carried(angles), axis=1)
    save_picture(
        path,
        mesh,
        x,
        moved,
        "bent by [mm]",
        title="the joint angles with which a soft finger presses with 2 N where it is to",
        ground=TABLE,
        obstacles=[tube(a, b, 0.009, False) for a, b in zip(ends[1:], ends[2:])],
        marks=[
            replace(table, through=True),
            replace(hand, through=True),
            Points("above here its tip is to be", np.array([[PLACE[0], TABLE, PLACE[1]]])),
        ],
        box=[[0.26, TABLE - 0.03, -0.02], [0.37, 0.34, 0.05]],
        size=(600, 450),
        azimuth=30,
        elevation=14,
    )


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
