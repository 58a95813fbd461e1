"""Soft bodies of two legs that crawl over a rough floor."""

import numpy as np

from diffsim_ti.envs.jumper import SoftJumpers
from diffsim_ti.envs.soft_bodies import SoftBody
from diffsim_ti.materials import StableNeoHookean
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Drag, ExternalForce, Gravity, Ground

CELL = 0.05  # [m]
PULL = 6.0  # [N] of an action of 1


class SoftCrawlers(SoftJumpers):
    """Bridges of 0.2 m on two legs.

    Four actions pull or push along slanted lines, two for each leg, between its foot and the top of the body before and
    behind it: the pushes on both ends add up to zero. The reward is the way forward, along x [m]. Starts differ in height.
    """

    num_actions = 4

    @staticmethod
    def make_scene() -> Scene:
        """4 x 2 x 2 cells, of which the lower middle ones are not there, just above a rough floor."""
        box = TetrahedralMesh.create_box((5, 3, 3), (4 * CELL, 2 * CELL, 2 * CELL), pattern="five")
        i, j, _ = np.floor(box.centroids / CELL).astype(int).T
        tetrahedra = box.tetrahedra[(j == 1) | (i == 0) | (i == 3)]
        used, renamed = np.unique(tetrahedra, return_inverse=True)
        mesh = TetrahedralMesh(box.vertices[used] + [-2 * CELL, 0.021, -CELL], renamed.reshape(tetrahedra.shape))
        floor, forces = Ground(width=0.02, friction=0.8), ExternalForce(np.zeros((1, mesh.num_vertices, 3)))
        return Scene(mesh, StableNeoHookean(3e4, 0.3), 300.0, [Gravity(), Drag(0.5), floor, forces])

    @staticmethod
    def forces(mesh: TetrahedralMesh) -> np.ndarray:
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

    @staticmethod
    def progress(positions):
        """Where the centre is along x [m]."""
        return positions[:, :, 0].mean(1)

    @staticmethod
    def goal(progress):
        """Where it ends."""
        return progress[-1]

    def rewards(self, actions):
        now = self.progress(self.positions)
        way, self.best = now - self.best, now
        return way


class SoftCrawler(SoftBody):
    """One bridge that crawls."""

    many = SoftCrawlers
