"""A small neural controller that makes a soft arm reach: trained through the simulator, step by step.

The arm stands on its base; four tendons run up its edges and pull (internal forces, which add up to zero). Every 0.02 s a
network of 180 weights sees the tip's place and velocity and the target, and sets the four tensions. The loss is the distance
of the tip from the target over the second half of half a second, and the effort. It is trained on four targets and judged on
three others.

    python examples/control/train_controller.py

A film of what it learnt goes to output/.
"""

from pathlib import Path

import numpy as np
import torch

import diffsim_ti as ds
from diffsim_ti.film import save_film
from diffsim_ti.obstacles import ball
from diffsim_ti.optimization import Optimization

STEPS, STRONGEST, HEIGHT, WIDTH = 25, 40.0, 0.5, 0.1
SEEN = [(0.12, 0.0), (-0.12, 0.0), (0.0, 0.12), (0.0, -0.12)]
UNSEEN = [(0.08, 0.08), (-0.1, 0.05), (0.06, -0.09)]


class Arm:
    """A block that stands on its fixed base, with a tendon along each upright edge."""

    def __init__(self):
        self.mesh = ds.TetrahedralMesh.create_box(
            [2, 7, 2], [WIDTH, HEIGHT, WIDTH], origin=(-WIDTH / 2, 0.0, -WIDTH / 2)
        )
        x = self.mesh.vertices
        edges = [(sx * WIDTH / 2, sz * WIDTH / 2) for sx in (1, -1) for sz in (1, -1)]
        along = [np.nonzero(np.all(np.abs(x[:, ::2] - edge) < 1e-9, axis=1))[0] for edge in edges]
        self.tendons = torch.from_numpy(np.stack([line[np.argsort(x[line, 1])] for line in along]))
        self.tip = torch.from_numpy(np.nonzero(x[:, 1] > HEIGHT - 1e-9)[0])
        terms = [ds.Gravity(-9.8), ds.Drag(8.0), ds.ExternalForce(np.zeros((self.mesh.num_vertices, 3)))]
        scene = ds.Scene(self.mesh, ds.StableNeoHookean(1e5, 0.3), 500.0, terms, fixed="ymin", precision="f32")
        self.step = ds.Rollout(ds.SemiImplicitSolver(scene, dt=0.02, substeps=20), 1)  # a step is a node of the graph

    def forces(self, x: torch.Tensor, tensions: torch.Tensor) -> torch.Tensor:
        """Pulls of the tendons on their vertices [N]: each piece draws its two ends together."""
        line = x[self.tendons]
        pull = tensions[:, None, None] * torch.nn.functional.normalize(line[:, 1:] - line[:, :-1], dim=2)
        out = torch.zeros_like(x)
        out = out.index_add(0, self.tendons[:, :-1].reshape(-1), pull.reshape(-1, 3))
        return out.index_add(0, self.tendons[:, 1:].reshape(-1), -pull.reshape(-1, 3))

    def reach(self, controller, target) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance of the tip from the target in the last half of the time, and the mean squared activation."""
        rest = torch.tensor(self.mesh.vertices, dtype=torch.float32)
        u, v = torch.zeros_like(rest), torch.zeros_like(rest)
        target, distances, effort, self.seen = torch.tensor(target), [], 0.0, []
        for step in range(STEPS):
            place, speed = (y[self.tip].mean(0)[::2] for y in (rest + u, v))
            activation = torch.sigmoid(controller(torch.cat([target / 0.1, place / 0.1, speed])))
            pull = self.forces(rest + u, STRONGEST * activation)
            frames = ds.rollout_frames(self.step, initial_displacements=u, initial_velocities=v, external_forces=pull)
            u, v = frames.displacements[-1], frames.velocities[-1]
            self.seen.append(((rest + u).detach().numpy(), activation.detach().numpy()))
            effort = effort + activation.square().mean() / STEPS
            if step >= STEPS // 2:
                distances.append(((rest + u)[self.tip].mean(0)[::2] - target).norm())
        return torch.stack(distances).mean(), effort


def save_reaches(path, arm: Arm, controller, targets) -> None:
    """A film of the arm reaching for one target after the other; colour is what its tendons pull."""
    places, pulls, marks = [], [], []
    for target in targets:
        with torch.no_grad():
            arm.reach(controller, target)
        for positions, activation in arm.seen[::2]:
            places.append(positions)
            pull = np.zeros(arm.mesh.num_vertices)
            pull[arm.tendons.numpy()] = STRONGEST * activation[:, None]
            pulls.append(pull)
            marks.append([ball((target[0], 1.06 * HEIGHT, target[1]), 0.012)])
    save_film(
        path,
        arm.mesh,
        places,
        pulls,
        8.0,
        (400, 300),
        obstacles=marks,
        ground=0.0,
        label="tension [N]",
        box=[[-0.13, 0.0, -0.13], [0.13, 0.56, 0.13]],
        elevation=25,
        wireframe=True,
        fixed="ymin",
        title=lambda k: f"targets it was not trained on, t = {0.04 * (k % (STEPS // 2 + 1)):.2f} s",
    )


def main(folder="output", iterations: int = 60, seed: int = 0) -> dict:
    torch.manual_seed(seed)
    arm = Arm()
    controller = torch.nn.Sequential(torch.nn.Linear(6, 16), torch.nn.Tanh(), torch.nn.Linear(16, 4))

    def miss(targets) -> float:
        with torch.no_grad():
            return float(np.mean([arm.reach(controller, target)[0].item() for target in targets]))

    before = miss(UNSEEN)
    optimizer = torch.optim.Adam(controller.parameters(), lr=0.03)
    state = folder and Path(folder) / "train_controller.state"
    optimization = Optimization(controller, optimizer, arm.mesh, state, save_every=5)

    def loss():
        distance, effort = arm.reach(controller, SEEN[optimization.iteration % len(SEEN)])
        return 10 * distance + 0.01 * effort

    optimization.run(loss, iterations)
    result = dict(
        miss_seen=miss(SEEN),
        miss_unseen=miss(UNSEEN),
        miss_before=before,
        iterations=iterations,
        seconds=optimization.seconds,
    )
    print("controller, distances of the tip [m]: " + ", ".join(f"{key} {value:.4g}" for key, value in result.items()))
    if folder:
        Path(folder).mkdir(exist_ok=True)
        save_reaches(Path(folder) / "train_controller.gif", arm, controller, UNSEEN)
    return result


if __name__ == "__main__":
    main()
