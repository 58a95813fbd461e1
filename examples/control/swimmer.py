"""A soft fish learns to swim in still water: eight muscles, five seconds, one gradient through all of them.

Four pairs of muscles lie along its flanks. Each pulls as a number plus a wave of 2 Hz says, squeezed to between 0 and 1: 24
numbers in all, which start at random. Nothing pushes the fish but the water (`SurfaceDrag`: an element of its skin meets ten
times the drag when it moves broadside). The loss is the way ahead, and what it strays.

    python examples/control/swimmer.py

A film of what it learnt goes to output/.
"""

import time
from pathlib import Path

import numpy as np
import torch

import diffsim_ti as ds
from diffsim_ti.film import save_film

LENGTH, CELLS, PAIRS = 0.3, 12, 4
DT, STEPS, BEAT, SHOWN = 0.02, 250, 2.0, 5  # step [s], their number, wave [Hz], steps from frame to frame
SETS = [f"{side}{k}" for k in range(PAIRS) for side in ("left", "right")]
# from the tail's end to the nose: places along the fish, its width and its height there [m]
PLACES, WIDTH = [0, 0.12, 0.2, 0.6, 0.9, 1], [0.008, 0.01, 0.012, 0.03, 0.026, 0.016]
HEIGHT = [0.09, 0.05, 0.03, 0.05, 0.045, 0.03]


def fish() -> ds.TetrahedralMesh:
    """Along x, its head ahead; muscles in pairs from behind the tail fin to the gills."""
    box = ds.TetrahedralMesh.create_box([CELLS + 1, 3, 3], [LENGTH, 1.0, 1.0], pattern="five")
    x, y, z = box.vertices.T
    width, height = (np.interp(x / LENGTH, PLACES, of) for of in (WIDTH, HEIGHT))
    mesh = ds.TetrahedralMesh(np.stack([x, (y - 0.5) * height, (z - 0.5) * width], 1), box.tetrahedra)
    pair, z = np.floor(mesh.centroids[:, 0] / LENGTH * CELLS).astype(int) // 2 - 1, mesh.centroids[:, 2]
    for k in range(PAIRS):
        mesh = mesh.with_tetrahedron_set(f"left{k}", (pair == k) & (z < 0))
        mesh = mesh.with_tetrahedron_set(f"right{k}", (pair == k) & (z > 0))
    return mesh


def stroke(numbers: torch.Tensor) -> torch.Tensor:
    """Activations of the muscles, shape (STEPS, 8), from a number, a sine and a cosine for each; they start within half a
    second."""
    t = DT * torch.arange(STEPS)[:, None]
    beat = 2 * np.pi * BEAT * t
    wave = numbers[0] + numbers[1] * torch.sin(beat) + numbers[2] * torch.cos(beat)
    return torch.sigmoid(wave) * torch.clamp(2 * t, max=1.0)


def swim(rollout: ds.Rollout, numbers: torch.Tensor):
    """(frames, way of the fish's middle [m], activations)"""
    activation = stroke(numbers)
    frames = ds.rollout_frames(rollout, activation=activation)
    middle = frames.positions.mean(1)
    return frames, middle[-1] - middle[0], activation


def save_swim(path: Path, mesh: ds.TetrahedralMesh, frames, activation: np.ndarray) -> None:
    """A film, seen from above; colour is the activation."""
    places, shown = frames.positions.numpy()[1:], np.zeros((len(frames.positions) - 1, mesh.num_tetrahedra))
    for row, values in zip(shown, activation[SHOWN - 1 :: SHOWN]):
        for name, value in zip(SETS, values):
            row[mesh.tetrahedron_indices(name)] = value
    box = np.array([places.min((0, 1)) - 0.02, places.max((0, 1)) + 0.02])
    title = lambda k: f"t = {SHOWN * DT * (k + 1):.1f} s"  # noqa: E731
    colours = dict(label="activation", limits=(0, 1))
    save_film(path, mesh, places, shown, 10.0, (640, 240), title, box=box, elevation=60, azimuth=0, **colours)


def main(folder="output", iterations: int = 25, seed: int = 0) -> dict:
    torch.manual_seed(seed)
    mesh = fish()
    muscles = ds.Muscle([1, 0, 0], 2e4, np.zeros((STEPS, len(SETS))), SETS, per="set")
    scene = ds.Scene(mesh, ds.StableNeoHookean(5e4, 0.4), 1000.0, [ds.SurfaceDrag(), muscles], precision="f32")
    solver = ds.SemiImplicitSolver(scene, DT)
    solver.choose_substeps(share=0.5)  # muscles shorten the fish, and its stable step
    rollout = ds.Rollout(solver, STEPS, save_every=SHOWN, gradients=["activation"])
    numbers = (0.3 * torch.randn(3, len(SETS))).requires_grad_()
    optimizer, seconds = torch.optim.Adam([numbers], lr=0.1), []
    with torch.no_grad():
        before = swim(rollout, numbers)[1]
    for k in range(iterations):
        optimizer.zero_grad()
        begin = time.process_time()
        _, way, activation = swim(rollout, numbers)
        loss = -10 * way[0] + 2 * way[2].abs() + 0.02 * activation.square().mean()
        loss.backward()
        seconds.append(time.process_time() - begin)
        optimizer.step()
        if k % 5 == 0 or k == iterations - 1:
            print(f"iteration {k}: way {way[0]:.3f} m, aside {way[2]:+.3f} m, {seconds[-1]:.2f} s of processor time")
    with torch.no_grad():
        frames, way, activation = swim(rollout, numbers)
    result = dict(
        way=float(way[0]),
        aside=float(way[2]),
        way_before=float(before[0]),
        lengths=float(way[0]) / LENGTH,
        substeps=int(solver.substeps),
        tetrahedra=mesh.num_tetrahedra,
        seconds_per_iteration=float(np.median(seconds)) if seconds else 0.0,
    )
    print("swimmer, five seconds: " + ", ".join(f"{key} {value:.4g}" for key, value in result.items()))
    if folder:
        Path(folder).mkdir(exist_ok=True)
        save_swim(Path(folder) / "swimmer.gif", mesh, frames, activation.numpy())
    return result


if __name__ == "__main__":
    torch.set_num_threads(1)  # its sums are small
    main()
