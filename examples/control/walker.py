"""A soft quadruped learns to walk on a rough floor by its muscles: trained through the simulator from a torch network.

Each of its legs has two muscles, upright fibres in its front and in its back half, which bend and shorten it. Every 0.2 s a
network of 600 weights reads where the body is, its turn and its speed; from these and a clock of 6 Hz it gives
the eight activations of each 0.02 s to come. The loss is the way forward, what the body strays and turns, and the effort,
differentiated over 0.2 s at a time: through the contacts of a whole second gradients say nothing.

    python examples/control/walker.py

The network that went farthest is kept; a film of its walk goes to output/.
"""

import time
from copy import deepcopy
from pathlib import Path

import numpy as np
import torch

import diffsim_ti as ds
from diffsim_ti.film import save_film

CELL, CLEARANCE, STRENGTH = 0.04, 0.006, 6e4
DT, SPAN, SPANS, CLOCK, STABLE = 0.02, 10, 5, 6.0, 0.35
LEGS = [(front, left) for front in (0, 4) for left in (0, 2)]


def quadruped() -> ds.TetrahedralMesh:
    """6 x 3 x 3 cells, of which the lower two layers are there at the legs alone; a set for each muscle."""
    box = ds.TetrahedralMesh.create_box([7, 4, 4], [6 * CELL, 3 * CELL, 3 * CELL], pattern="five")
    i, j, k = np.floor(box.centroids / CELL).astype(int).T
    tetrahedra = box.tetrahedra[(j == 2) | (((i <= 1) | (i >= 4)) & (k != 1))]
    used, renamed = np.unique(tetrahedra, return_inverse=True)
    mesh = ds.TetrahedralMesh(box.vertices[used] + [0, CLEARANCE, 0], renamed.reshape(tetrahedra.shape))
    i, j, k = np.floor((mesh.centroids - [0, CLEARANCE, 0]) / CELL).astype(int).T
    for n, (leg, side) in enumerate(LEGS):
        for half in (0, 1):
            mesh = mesh.with_tetrahedron_set(f"muscle{2 * n + half}", (j < 2) & (i == leg + half) & (k == side))
    return mesh


class Walker:
    """The body, one rollout of ten steps, and how a network moves it."""

    def __init__(self):
        self.mesh = mesh = quadruped()
        sets = [f"muscle{k}" for k in range(2 * len(LEGS))]
        muscle = ds.Muscle([0, 1, 0], STRENGTH, np.zeros((SPAN, len(sets))), sets, per="set")
        floor = ds.Ground(stiffness=4000.0, width=CLEARANCE, friction=0.8, friction_speed=1e-2)
        scene = ds.Scene(
            mesh, ds.StableNeoHookean(1e5, 0.35), 500.0, [ds.Gravity(), ds.Drag(2.0), floor, muscle], precision="f32"
        )
        solver = ds.SemiImplicitSolver(scene, DT)
        solver.choose_substeps(share=STABLE)  # squeezed legs are stiffer
        self.rollout = ds.Rollout(solver, SPAN, save_every=1, gradients=["activation"])
        self.rest = torch.tensor(mesh.vertices.mean(0), dtype=torch.float32)
        self.start = torch.zeros(mesh.num_vertices, 3)
        x = mesh.vertices[:, 0] - mesh.vertices[:, 0].mean()
        self.ends = [torch.tensor(x > CELL), torch.tensor(x < -CELL)]  # its front and its back

    def walk(self, network, spans: int = SPANS, keep: list | None = None) -> tuple[torch.Tensor, np.ndarray]:
        """(loss, way of the body's middle [m]); keep: where frames are put, and activations."""
        u, v, loss, before = self.start, torch.zeros_like(self.start), 0.0, torch.zeros(2 * len(LEGS))
        turn = torch.zeros(())
        for span in range(spans):
            t = DT * (SPAN * span + torch.arange(SPAN))[:, None]
            clock = torch.sin(2 * np.pi * CLOCK * t + torch.arange(4) * np.pi / 2)
            state = torch.cat([u.mean(0)[1:] * 20, v.mean(0), turn[None] * 20])
            asked, activation = torch.sigmoid(4 * network(torch.cat([clock, state.expand(SPAN, 6)], 1))), []
            for one in asked:  # muscles take time
                before = 0.5 * before + 0.5 * one
                activation.append(before)
            activation, before = torch.stack(activation), before.detach()
            frames = ds.rollout_frames(
                self.rollout, initial_displacements=u, initial_velocities=v, activation=activation
            )
            way = frames.positions[-1].mean(0) - self.rest - u.mean(0)
            front, back = (frames.positions[-1][end].mean(0) for end in self.ends)
            turn = (front - back)[2]
            loss = loss - 10 * way[0] + 2 * way[2].abs() + 2 * turn.abs() + 0.02 * activation.square().mean()
            turn = turn.detach()
            u, v = (frames.positions[-1] - frames.positions[0]).detach() + u, frames.velocities[-1].detach()
            if keep is not None:
                keep += [(x.numpy(), a.numpy()) for x, a in zip(frames.positions[1:].detach(), activation.detach())]
        return loss, u.mean(0).numpy()


def save_walk(path, walker: Walker, network, spans: int) -> None:
    """A film of the walk; colour is the activation."""
    keep, mesh = [], walker.mesh
    with torch.no_grad():
        walker.walk(network, spans, keep)
    shown = np.zeros((len(keep), mesh.num_tetrahedra))
    for row, (_, activation) in zip(shown, keep):
        for k, value in enumerate(activation):
            row[mesh.tetrahedron_indices(f"muscle{k}")] = value
    places = np.array([x for x, _ in keep])
    box = np.array([places.min((0, 1)) - [0.03, 0, 0.03], places.max((0, 1)) + 0.03])
    save_film(
        path,
        mesh,
        places[::2],
        shown[::2],
        12.0,
        (480, 270),
        ground=0.0,
        box=box,
        label="activation",
        limits=(0, 1),
        title=lambda k: f"t = {2 * DT * (k + 1):.2f} s",
    )


def main(folder="output", iterations: int = 25, seed: int = 0) -> dict:
    torch.manual_seed(seed)
    walker = Walker()
    network = torch.nn.Sequential(torch.nn.Linear(10, 32), torch.nn.Tanh(), torch.nn.Linear(32, 2 * len(LEGS)))
    with torch.no_grad():
        best = before = float(walker.walk(network)[1][0])
    optimizer, seconds, kept = torch.optim.Adam(network.parameters(), lr=0.015), [], deepcopy(network)
    for k in range(iterations):
        optimizer.zero_grad()
        begin = time.process_time()
        loss, way = walker.walk(network)
        if way[0] > best:
            best, kept = way[0], deepcopy(network)
        loss.backward()
        seconds.append(time.process_time() - begin)
        optimizer.step()
        if k % 5 == 0 or k == iterations - 1:
            print(f"iteration {k}: way {way[0]:.3f} m, aside {way[2]:+.3f} m, {seconds[-1]:.2f} s of processor time")
    with torch.no_grad():
        after, last = walker.walk(kept)[1], walker.walk(network)[1]
    result = dict(
        way=float(after[0]),
        way_of_the_last=float(last[0]),
        aside=float(after[2]),
        way_before=before,
        substeps=int(walker.rollout.solver.substeps),
        tetrahedra=walker.mesh.num_tetrahedra,
        seconds_per_iteration=float(np.median(seconds)) if seconds else 0.0,
    )
    print("walker, a second: " + ", ".join(f"{key} {value:.4g}" for key, value in result.items()))
    if folder:
        Path(folder).mkdir(exist_ok=True)
        save_walk(Path(folder) / "walker.gif", walker, kept, 2 * SPANS)
    return result


if __name__ == "__main__":
    torch.set_num_threads(1)  # its sums are small
    main()
