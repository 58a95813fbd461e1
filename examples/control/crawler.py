"""Soft bodies of two legs that crawl over a rough floor, as environments of Gymnasium: many at once, or one.

A bridge of 0.2 m stands on two legs. Four actions pull or push along slanted lines, two for each leg, between its foot and
the top of the body before and behind it: the pushes on both ends add up to zero. The reward is the way forward [m]. It is
observed, and starts, like the cubes of jumper.py.

    python examples/control/crawler.py
"""

import numpy as np
from jumper import SoftJumper, SoftJumpers

import diffsim_ti as ds

CELL = 0.05  # [m]
PULL = 6.0  # [N] of an action of 1


def bridge_scene() -> ds.Scene:
    """4 x 2 x 2 cells, of which the lower middle ones are not there, just above a rough floor."""
    box = ds.TetrahedralMesh.create_box((5, 3, 3), (4 * CELL, 2 * CELL, 2 * CELL), pattern="five")
    i, j, _ = np.floor(box.centroids / CELL).astype(int).T
    tetrahedra = box.tetrahedra[(j == 1) | (i == 0) | (i == 3)]
    used, renamed = np.unique(tetrahedra, return_inverse=True)
    mesh = ds.TetrahedralMesh(box.vertices[used] + [-2 * CELL, 0.021, -CELL], renamed.reshape(tetrahedra.shape))
    floor, forces = ds.Ground(width=0.02, friction=0.8), ds.ExternalForce(np.zeros((1, mesh.num_vertices, 3)))
    return ds.Scene(mesh, ds.StableNeoHookean(3e4, 0.3), 300.0, [ds.Gravity(), ds.Drag(0.5), floor, forces])


def pulls(mesh: ds.TetrahedralMesh) -> np.ndarray:
    """Forces [N] of the four actions, shape (4, n, 3): along the line between two ends at rest, they turn nothing."""
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    out, places = [], np.array([-2, -1, 1, 2]) * CELL
    for foot, tops in ((places[:2], (-2 * CELL, 0.0)), (places[2:], (0.0, 2 * CELL))):
        for top in tops:
            low = (np.abs(y - y.min()) < 1e-9) & (x > foot[0] - 1e-9) & (x < foot[1] + 1e-9)
            high = (np.abs(y - y.max()) < 1e-9) & (np.abs(x - top) < 1e-9)
            line = mesh.vertices[high].mean(0) - mesh.vertices[low].mean(0)
            one = np.zeros((mesh.num_vertices, 3))
            one[low] += PULL * line / np.linalg.norm(line) / low.sum()
            one[high] -= PULL * line / np.linalg.norm(line) / high.sum()
            out.append(one)
    return np.stack(out)


class SoftCrawlers(SoftJumpers):
    """`num_envs` bridges on two legs."""

    make_scene, forces = staticmethod(bridge_scene), staticmethod(pulls)

    @staticmethod
    def progress(positions):
        """Where the centre is along x [m]."""
        return positions[:, :, 0].mean(1)

    def reward(self, progress: np.ndarray, before: np.ndarray) -> np.ndarray:
        return progress - before

    @staticmethod
    def goal(progress):
        """Where it ends."""
        return progress[-1]


class SoftCrawler(SoftJumper):
    """One of them."""

    many = SoftCrawlers


def main(num_envs: int = 16, steps: int = 50) -> float:
    """The way [m] that a simple gait comes, by two waves of 5 Hz."""
    envs = SoftCrawlers(num_envs)
    envs.reset(seed=0)
    way = np.zeros(num_envs)
    for k in range(steps - 1):
        phase = 2 * np.pi * 5 * 0.01 * k + np.array([0.0, np.pi, 0.0, np.pi])
        way += envs.step(np.tile(np.sin(phase), (num_envs, 1)))[1]
    print(f"{num_envs} crawlers: a gait by waves comes {way.mean():+.3f} m in {steps * 0.01:.2f} s")
    return float(way.mean())


if __name__ == "__main__":
    main()
