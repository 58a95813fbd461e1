"""How often error bars hold the error: random loads, starts, places and weights on small coarse meshes, linear elasticity.

Meshes are nested, so that one assembly of the finest serves all: matrices of coarser ones are P^T K P. Their numbers are
those of `Rollout.accuracy`: the estimate is the difference to ten nodes, or to halved edges of ten nodes, the truth that to
a mesh refined once more; the bar is `Accuracy.bar`. Motions are of some steps of backward Euler.

    python examples/benchmarks/random_error_bars.py [meshes of each kind]    # 20: about 4 minutes
"""

import sys

import numpy as np
from scipy.sparse import eye, kron
from scipy.sparse.linalg import eigsh, splu

import diffsim_ti as ds
from diffsim_ti.accuracy.estimate import CANCELS, COARSE, Accuracy
from diffsim_ti.accuracy.finer import interpolation

COUNT = 40  # loads, and as many numbers, for each mesh


def body(seed: int, order: int, rng) -> ds.TetrahedralMesh:
    """A bar, block, plate, bracket or tapered panel of few cells."""
    box, more, pattern = ds.TetrahedralMesh.create_box, 2 - order, ("five", "kuhn")[rng.integers(2)]
    if seed % 5 == 3:
        mesh = box((3 + 2 * more, 3 + 2 * more, 2), (2, 2, 0.5))
        used, corners = np.unique(mesh.tetrahedra[(mesh.centroids[:, :2] < 1).any(1)], return_inverse=True)
        return ds.TetrahedralMesh(mesh.vertices[used], corners.reshape(-1, 4))
    if seed % 5 == 4:
        mesh = box((3 + more, 2 + more, 2), (48, 1, 4), "five")
        s, r, z = mesh.vertices.T / [[48], [1], [1]]
        return ds.TetrahedralMesh(np.stack([48 * s, 44 * s + r * (44 - 28 * s), z], 1), mesh.tetrahedra)
    cells = [(rng.integers(2, 4) + more, 2, 2), (3, 2 + more, 2 + more), (3 + more, 3 + more, 2)]
    return box(cells[seed % 5], [(rng.uniform(1, 4), 0.5, 0.5), (1, 1, 1), (2, 2, 0.2)][seed % 5], pattern)


def numbers(seed: int, order: int, moves: bool) -> list:
    """(estimate, what would be there if nothing cancelled, true error, true value) of each."""
    rng = np.random.default_rng([seed, order, moves])
    mesh = body(seed, order, rng)
    coarse = mesh if order == 1 else mesh.quadratic()
    fine = coarse.quadratic() if order == 1 else coarse.refined()
    finest = fine.refined()
    law = ds.LinearElastic(1.0, float(rng.choice([0.0, 0.3, 0.4])))
    scene = ds.Scene(finest, law, 1.0, precision="f64").with_consistent_mass()
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    axis, n, size = int(seed % 5 == 3), coarse.num_vertices, (high - low).max()
    ends = [high[axis]] if axis else [low[0], high[0]][: 1 + int(rng.random() < 0.4)]
    x, loads = finest.vertices, []
    M = scene.mass_matrix()
    for kind in rng.integers(4, size=COUNT):
        way = rng.normal(size=3) * (rng.random(3) < 0.7) + 1e-3
        near = np.linalg.norm(x - x[rng.integers(n)], axis=1) < 0.35 * size
        beyond = (x[:, 0] - low[0]) / (high - low)[0] > rng.uniform(0, 0.8)
        wave = np.sin(x @ rng.normal(size=3) / size * rng.uniform(1, 5))
        amount = (0 * wave + 1, beyond, wave, near)[kind]
        loads.append(M @ (amount[:, None] * way).ravel())
    starts = [np.sin(coarse.vertices @ rng.normal(size=(3, 3)) / size * rng.uniform(0.5, 3)) for _ in loads]
    starts = np.stack(starts, -1).reshape(3 * n, COUNT) * (rng.random(COUNT) < 0.6)
    steps, length, runs, frames = int(rng.integers(4, 9)), rng.uniform(0.1, 1.5), [], None
    K, b = scene.stiffness_matrix(), np.stack(loads, 1)
    P, to = [kron(interpolation(m), eye(3)).tocsr() for m in (fine, finest)], []
    to = [P[1] @ P[0], P[1], eye(len(b)).tocsr()]
    for m, up, begin in zip((coarse, fine, finest), to, (eye(3 * n), P[0], to[0])):
        free = np.repeat(~np.isin(m.vertices[:, axis], ends), 3)
        A, mass, f = ((up.T @ X @ up).tocsr()[free][:, free].tocsc() for X in (K, M, 0 * K))
        f, v, u, frames = (up.T @ b)[free], (begin @ starts)[free], 0.0, [np.zeros((3 * n, COUNT))]
        if moves and m is coarse:
            step = length * 2 * np.pi / steps / np.sqrt(eigsh(A, 1, mass, sigma=0)[0][0])
        solve = splu(A + mass / step**2 if moves else A).solve
        for _ in range(steps if moves else 1):
            old, u = u, solve(f + mass @ (u / step**2 + v / step) if moves else f)
            v = (u - old) / step if moves else v
            whole = np.zeros((len(free), COUNT))
            whole[free] = u
            frames.append(whole[: 3 * n])
        runs.append(np.array(frames).reshape(len(frames), n, 3, COUNT))
    out = []
    for j in range(COUNT):
        places = rng.integers(n, size=(1, 1, 3)[j % 3])
        weights = np.eye(3)[rng.integers(3, size=1)] if j % 3 == 0 else rng.normal(size=(len(places), 3))
        y = np.array([run[..., j][:, places] for run in runs])
        J = (y[:, -1] * weights).sum((1, 2))
        apart = np.linalg.norm(y[0] - y[1], axis=2) @ np.linalg.norm(weights, axis=1)
        if abs(J[0] - J[1]) > 1e-7 * np.abs(runs[0][..., j]).max():
            out.append((J[0] - J[1], max(apart.max(), abs(J[0] - J[1])), J[0] - J[2], J[2]))
    return out


def main(meshes: int) -> None:
    print(
        "| | nodes | numbers | bars hold | bar over error: median | 9 of 10 | error over bar: 99 of 100 | no doubt | right |"
    )
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for moves in (False, True):
        for order in (1, 2):
            all_of = np.array([row for seed in range(meshes) for row in numbers(seed, order, moves)]).T
            error, uncancelled, true, value = all_of
            found = Accuracy("", value, value, error, 0.0, 0.0, 0.0, dict(mesh=uncancelled), np.zeros(0), {})
            bar = found.bar / abs(true)
            quiet = (uncancelled < CANCELS * abs(error)) & (abs(error) < COARSE * abs(value))
            good = np.mean((abs(error / true - 1.05) < 0.35)[quiet])
            cells = ["steps" if moves else "equilibria", (4, 10)[order - 1], len(true), f"{np.mean(bar >= 1):.3f}"]
            cells += [
                f"{np.median(bar):.2f}",
                f"{np.quantile(bar, 0.9):.1f}",
                f"{np.quantile(1 / bar, 0.99):.2f}",
                f"{quiet.mean():.2f}",
                f"{good:.2f}",
            ]
            print("|", " | ".join(map(str, cells)), "|", flush=True)


if __name__ == "__main__":
    ds.init(precision="f64")
    main(int(sys.argv[1]) if sys.argv[1:] else 20)
