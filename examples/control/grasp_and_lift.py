"""A gripper of a URDF file learns to lift a soft block with little more force than Coulomb's law asks for.

A slide carries two fingers, whose joints are unknowns of the same implicit steps as the block. What is learnt is the force
that closes both fingers and the speed of the slide, every 50 ms, by the gradient through joints, contact and friction. For
a block of mass m, accelerated upwards by a, each finger has to press with

    F_least = m (g + a) / (2 mu)

The loss asks for the height, for fingers that do not slip, and for 8 % more than F_least. PPO of Stable-Baselines3 (pip
install "diffsim-ti[learning]") has the same start, decisions and samples, and rewards that add up to minus the loss.

    python examples/control/grasp_and_lift.py [--ppo 5] [--folder output]
"""

import argparse
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
from scipy.optimize import minimize

import diffsim_ti as ds
from diffsim_ti.film import save_film
from diffsim_ti.obstacles import box

SIZE, GAP, LIFT = 0.06, 3e-3, 0.03  # of the block; before each finger; to be lifted by [m]
MU, DENSITY, G = 0.5, 500.0, 9.81
PALM, FINGER = 0.4, 0.05  # [kg]
PAD, BAR = (0.01, 0.08, 0.07), (0.12, 0.012, 0.03)  # of fingers and palm [m]
DT, EVERY = 1e-2, 1  # step [s], steps to a frame
DECISION, DECISIONS = 0.05, 12  # time between them [s]
GRIPPED = 2  # decisions after which the fingers have closed
SLIDE, LEFT = 0, 1  # places of joints
ENDS = DECISION * np.arange(1, DECISIONS + 1)
MOVES = np.sin(np.pi * np.clip((ENDS - 0.1) / 0.4, 0, 1)) ** 2  # how the slide may move at the ends of decisions
START = np.stack([0.8 + 0 * MOVES, 0.15 * MOVES])  # force [N] and speed [m/s] there
MOST = np.stack([3.0 + 0 * MOVES, 0.3 * MOVES])
SCALE = np.array([[1.0], [0.03]])  # of both
MARGIN, SLIP, SHORT = 0.08, 5e-4, 1e-3  # the force aimed at, beyond the least; what slip and height are measured by [m]


def urdf() -> str:
    """A slide along y with a palm, and two fingers that close along x."""
    inertia = '<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>'
    link = '<link name="{}"><inertial><mass value="{}"/>' + inertia + "</inertial>{}</link>"
    joint = (
        '<joint name="{}" type="prismatic"><parent link="{}"/><child link="{}"/><origin xyz="{} 0 0"/><axis xyz="{}"/>'
        '<limit lower="-1" upper="1" effort="20" velocity="5"/></joint>'
    )
    pad = "<collision><geometry><box size='{} {} {}'/></geometry></collision>".format(*PAD)
    away = 0.5 * (SIZE + PAD[0]) + GAP
    parts = [
        '<link name="base"/>',
        link.format("palm", PALM, ""),
        link.format("left", FINGER, pad),
        link.format("right", FINGER, pad),
        joint.format("a_slide", "base", "palm", 0, "0 1 0"),
        joint.format("b_left", "palm", "left", -away, "1 0 0"),
        joint.format("c_right", "palm", "right", away, "-1 0 0"),
    ]
    return f'<robot name="gripper">{"".join(parts)}</robot>'


def size(x: torch.Tensor) -> torch.Tensor:
    """Like x^2 / 2 where that is small, and like |x| elsewhere."""
    return (1 + x**2).sqrt() - 1


class Lift:
    """The gripper and the block, for runs of some decisions."""

    def __init__(self, cells: int = 3, decisions: int = DECISIONS):
        self.decisions, self.steps = decisions, round(decisions * DECISION / DT)
        block = ds.TetrahedralMesh.create_box(cells + 1, SIZE, origin=(-SIZE / 2, 1.6e-3, -SIZE / 2), pattern="five")
        none = np.zeros((self.steps, 3))
        self.robot = ds.Robot.from_urdf(
            urdf(),
            "gripper",
            base=(0, 5e-3 + 0.5 * PAD[1], 0),
            torques=none,
            targets=none,
            drive_stiffness=[4000.0, 0, 0],
            drive_damping=[80.0, 5.0, 5.0],
            friction=MU,
            friction_speed=2.5e-4,
            width=1e-3,
            stiffness_per_area=5e6,
        )
        terms = [ds.Gravity(), ds.Ground(width=2e-3, stiffness_per_area=1e6), self.robot]
        self.scene = ds.Scene(block, ds.StableNeoHookean(3e4, 0.35), DENSITY, terms, precision="f64")
        outputs = [ds.JointPositions("gripper"), ds.JointVelocities("gripper")]
        outputs += [ds.ContactForce(f"gripper_{side}", "normal", name=side) for side in ("left", "right")]
        solver = ds.ImplicitEulerSolver(self.scene, dt=DT, tolerance=1e-6)
        wanted = ["gripper.torques", "gripper.targets"]
        self.rollout = ds.Rollout(solver, self.steps, EVERY, outputs=outputs, gradients=wanted)
        masses = self.scene.mass_matrix().diagonal()[::3]
        self.mass, self.share = masses.sum(), torch.tensor(masses / masses.sum())
        X = block.vertices
        touched = (np.abs(np.abs(X[:, 0]) - SIZE / 2) < 1e-9) & (X[:, 1] > 0.01)
        self.sides = np.flatnonzero(touched)
        self.height = self.rises(torch.tensor(X[None]))[0]
        ends = DECISION * np.arange(decisions + 1)
        hats = [np.interp(DT * np.arange(1, self.steps + 1), ends, row) for row in np.eye(decisions + 1)]
        self.hats = torch.tensor(np.stack(hats, 1))  # (steps, 1 + decisions), the first of where a run begins

    def rises(self, x: torch.Tensor) -> torch.Tensor:
        """Height of the centre of mass in each frame [m]."""
        return x[..., 1] @ self.share

    def run(self, forces: torch.Tensor, speeds: torch.Tensor, risen: float = 0.0, **start):
        """Frames for forces [N] and speeds [m/s] at the beginning and the end of each decision; risen: the slide's target at
        first [m]; start: inputs of where the run begins."""
        closing, zero = self.hats @ forces, torch.zeros(self.steps, dtype=torch.float64)
        target = risen + DT * torch.cumsum(self.hats @ speeds, 0)
        weight = torch.full_like(zero, G * (PALM + 2 * FINGER))
        torques, targets = torch.stack([weight, closing, closing], 1), torch.stack([target, zero, zero], 1)
        return ds.rollout_frames(self.rollout, **{"gripper.torques": torques, "gripper.targets": targets}, **start)

    def seen(self, frames) -> tuple[torch.Tensor, ...]:
        """(rise of the block [m], its height above the fingers [m], force of a finger [N], the least one [N]), of frames;
        forces are means since the frame before, the first has none."""
        above = frames.positions[:, self.sides, 1].mean(1) - frames["joint_positions"][:, SLIDE]
        press = 0.5 * (frames["left"][:, 0] - frames["right"][:, 0])
        gained = torch.diff(self.rises(frames.velocities), prepend=torch.zeros(1, dtype=torch.float64)) / (EVERY * DT)
        return self.rises(frames.positions) - self.height, above, press, self.mass * (G + gained) / (2 * MU)

    def costs(self, frames, above: torch.Tensor) -> torch.Tensor:
        """Of each frame but the first; above: height of the block above the fingers when these have closed."""
        _, now, press, least = (x[1:] for x in self.seen(frames))
        return size((now - above) / SLIP) + size((press / least - 1 - MARGIN) / MARGIN)

    def short(self, frames) -> torch.Tensor:
        """The cost of the height at the end."""
        return size((self.seen(frames)[0][-1] - LIFT) / SHORT)

    def loss(self, decisions: torch.Tensor) -> tuple[torch.Tensor, object]:
        """(loss, frames) for forces and speeds, shape (2, decisions)."""
        zero = torch.zeros(2, 1, dtype=torch.float64)
        frames = self.run(*torch.cat([zero, decisions], 1))
        first = round(GRIPPED * DECISION / DT) // EVERY
        costs = self.costs(frames, self.seen(frames)[1][first])[first:]
        return costs.mean() + self.short(frames), frames

    def found(self, frames) -> dict:
        """Height lifted [m]; how far the vertex of the sides that slips most does [m]; while the block is lifted and held, a
        finger's force over the least one, on average and where it is farthest off; both at the end [N]."""
        first = round(GRIPPED * DECISION / DT) // EVERY
        x, q = frames.positions[first:, self.sides].detach(), frames["joint_positions"][first:].detach()
        way = torch.stack([x[..., 1] - q[:, None, SLIDE], x[..., 2]], -1)
        rise, _, press, least = (part.detach() for part in self.seen(frames))
        ratio = (press / least)[first + 1 :]
        return dict(
            lifted=float(rise[-1]),
            slip=float((way - way[0]).norm(dim=-1).max()),
            force=float(press[-1]),
            least=float(least[-1]),
            ratio=float(ratio.mean()),
            farthest=float(ratio[(ratio - 1).abs().argmax()]),
        )


def train(lift: Lift, evaluations: int) -> list[dict]:
    """L-BFGS-B from START: what was found, by evaluations, with the decisions and their loss."""
    seen = []

    def evaluate(scaled):
        decisions = torch.tensor(scaled.reshape(2, -1) * SCALE, requires_grad=True)
        loss, frames = lift.loss(decisions)
        loss.backward()
        seen.append(lift.found(frames) | dict(loss=loss.item(), decisions=decisions.detach(), frames=frames))
        own = seen[-1]
        print(
            f"lift {len(seen)}: loss {loss.item():.4g}, lifted by {1e3 * own['lifted']:.1f} mm, slips by "
            f"{1e3 * own['slip']:.2f} mm, force over the least {own['ratio']:.3f}",
            flush=True,
        )
        return loss.item(), (decisions.grad.numpy() * SCALE).ravel()

    start, most = ((x[:, : lift.decisions] / SCALE).ravel() for x in (START, MOST))
    bounds, options = [(0, x) for x in most], dict(maxfun=evaluations)
    minimize(evaluate, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return seen


class Lifting(gymnasium.Env):
    """The same, a decision a step: actions are added to START by SCALE."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (7,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float64)

    def __init__(self):
        self.lift = Lift(decisions=1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.taken, self.risen, self.above, self.start = [np.zeros(2)], 0.0, None, {}
        return np.zeros(7), {}

    def step(self, action):
        k = len(self.taken) - 1
        self.taken.append(np.clip(START[:, k] + SCALE[:, 0] * action, 0, MOST[:, k]))
        forces, speeds = torch.tensor(np.stack(self.taken[-2:], 1))
        with torch.no_grad():
            frames = self.lift.run(forces, speeds, self.risen, **self.start)
            rise, above, press, least = (x[-1].item() for x in self.lift.seen(frames))
            counted = (DECISIONS - GRIPPED) * round(DECISION / DT) // EVERY
            reward = 0.0 if self.above is None else -self.lift.costs(frames, self.above).sum().item() / counted
            ended = len(self.taken) > DECISIONS
            reward -= self.lift.short(frames).item() if ended else 0.0
        self.risen += DT * float((self.lift.hats @ speeds).sum())
        q, v = (frames[name][-1] for name in ("joint_positions", "joint_velocities"))
        self.start = dict(initial_positions=frames.positions[-1], initial_velocities=frames.velocities[-1])
        self.start |= {"gripper.positions": q, "gripper.velocities": v}
        if k + 1 == GRIPPED:
            self.above = torch.tensor(above)
        slip = 0.0 if self.above is None else (above - self.above.item()) / SLIP
        shown = [k / DECISIONS, rise / LIFT, slip, press, least, 10 * v[SLIDE].item(), 100 * q[LEFT].item()]
        return np.clip(shown, -10, 10), reward, ended, False, {}


def by_ppo(lift: Lift, episodes: int, each: int = 10, seed: int = 0) -> list[dict]:
    """PPO for some episodes, `each` an update: what its mean actions do after each update."""
    from stable_baselines3 import PPO

    shown, found = Lifting(), []
    sizes = dict(n_steps=each * DECISIONS, batch_size=3 * each, n_epochs=10)
    network = dict(net_arch=[64, 64], log_std_init=-1.0)
    ppo = PPO("MlpPolicy", Lifting(), 1e-3, **sizes, policy_kwargs=network, seed=seed, device="cpu")
    for _ in range(max(1, episodes // each)):
        ppo.learn(each * DECISIONS, reset_num_timesteps=not found)
        observed, ended = shown.reset()[0], False
        while not ended:
            observed, _, ended, *_ = shown.step(ppo.predict(observed, deterministic=True)[0])
        with torch.no_grad():
            loss, frames = lift.loss(torch.tensor(np.stack(shown.taken[1:], 1)))
        found.append(lift.found(frames) | dict(loss=loss.item(), samples=each * (len(found) + 1)))
        print(f"PPO, {found[-1]['samples']} lifts: loss {loss.item():.4g}", flush=True)
    return found


def save(path: Path, lift: Lift, *shown: dict) -> None:
    """A film of lifts one after the other."""
    positions, obstacles, words = [], [], []
    for text, one in zip(("at first", "learnt by gradients"), shown):
        frames = one["frames"]
        x, q = frames.positions.detach().numpy(), frames["joint_positions"].detach().numpy()
        for k in [*range(0, len(x), 2), *[len(x) - 1] * 5]:
            poses = lift.robot.poses(q[k])
            parts = [box(pose[:3], PAD, pose[3:]) for pose in poses.values()]
            parts.append(box((0, 5e-3 + PAD[1] + q[k, SLIDE], 0), BAR, (1, 0, 0, 0)))
            positions.append(x[k])
            obstacles.append(parts)
            words.append(f"{text}: t = {k * EVERY * DT:.2f} s, slips by {1e3 * one['slip']:.2g} mm")
    look = dict(ground=0.0, wireframe=True, elevation=16, azimuth=25, box=[[-0.07, 0, -0.04], [0.07, 0.15, 0.04]])
    save_film(path, lift.scene.mesh, np.stack(positions), fps=10.0, size=(400, 300), obstacles=obstacles,
              title=lambda k: words[k], **look)  # fmt: skip


def main(folder: str | None = None, evaluations: int = 60, ppo: int = 1, quick: bool = False) -> dict:
    """What was found at first, by gradients, and by PPO with as many lifts and with `ppo` times as many; quick: on a coarse
    block, for the first decisions alone."""
    torch.set_num_threads(1)
    begin, lift = time.process_time(), Lift(2, 5) if quick else Lift()
    seen = train(lift, evaluations)
    rows = {"start": seen[0], f"gradients, {len(seen)} lifts": min(seen, key=lambda one: one["loss"])}
    seconds = time.process_time() - begin
    if folder:
        save(Path(folder) / "grasp_and_lift.gif", lift, *rows.values())
    if ppo:
        tries = by_ppo(lift, ppo * len(seen))
        for times in dict.fromkeys((1, ppo)):
            own = [one for one in tries if one["samples"] <= max(times * len(seen), 10)]
            rows[f"PPO, {own[-1]['samples']} lifts"] = min(own, key=lambda one: one["loss"])
    print("| | loss | lifted by [mm] | slips by [mm] | force over the least: mean | farthest off | at the end [N] |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, one in rows.items():
        numbers = f"{1e3 * one['lifted']:.1f} | {1e3 * one['slip']:.2f} | {one['ratio']:.3f} | {one['farthest']:.3f}"
        print(f"| {name} | {one['loss']:.3g} | {numbers} | {one['force']:.3f} of {one['least']:.3f} |")
    print(f"{seconds:.0f} s of processor time by gradients")
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--evaluations", type=int, default=60)
    parser.add_argument("--ppo", type=int, default=1, help="how many times as many lifts PPO may take; 0: none")
    parser.add_argument("--quick", action="store_true", help="a coarse block, the first decisions alone, no PPO")
    parser.add_argument("--folder", default="output")
    given = parser.parse_args()
    ds.init(precision="f64")
    main(given.folder, *((6, 0) if given.quick else (given.evaluations, given.ppo)), given.quick)
