"""Traction of obstacles on the surface: contact force per area, vertex by vertex."""

from copy import copy
from typing import Literal

import numpy as np

from diffsim_ti.mesh.geometry import triangle_normals, triangle_normals_jvp, triangle_normals_vjp
from diffsim_ti.outputs.contact_force import ContactForce
from diffsim_ti.outputs.output import Change, Frames, Output
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Term

# what each node of a face takes of its nodes' values, in stages: of three nodes the mean; of six the middles take over what
# corners have, and corners then the mean of the middles beside them
_LINEAR = (np.full((3, 3), 1 / 3),)
_TO_MIDDLES, _TO_CORNERS = np.diag([0.0, 0, 0, 1, 1, 1]), np.diag([0.0, 0, 0, 1, 1, 1])
_TO_MIDDLES[3:, :3] = 1 / 3
_TO_CORNERS[[0, 0, 1, 1, 2, 2], [3, 5, 3, 4, 4, 5]] = 0.5
_QUADRATIC = (_TO_MIDDLES, _TO_CORNERS)
_ASIDE, _FACING = 0.07, 0.25  # cos^2 at which a face begins to count, and counts in full: at 75 and at 60 degrees


class ContactTraction(Output):
    """Force per area [Pa] of an obstacle on each vertex, shape (frames, num_vertices, 3), zero away from the contact:

        r_i = f_i / sum over the faces around of B_f / 3,    t_i = mean over the faces around, by B_f, of r_f

    f_i: what `ContactForce(obstacle, part, per_vertex=True)` gives, so the mean since the frame before. B_f: a face's area
    at rest times cos^2 of the angle between its normal in the frame and the force on its vertices, so that at an edge of the
    body only the side that lies on the obstacle counts (a face at more than 75 degrees does not). r_f: the mean of r_i over
    the face's three vertices. Faces of ten-node elements share an even pressure among the middles of their edges alone:
    there t_i = r_i, with what the corners have handed on to them, and a corner has the mean of the middles beside it.

    So an even pressure comes out even at all vertices, whether the barrier is softer than the body or stiffer, and the
    integral of t over the faces is the force. At the rim of the contact t falls to zero within one face.
    obstacle, part ("total", "normal", "friction"), name: as there. The gradient is exact by all inputs.
    Raises ValueError as `ContactForce` does.
    Wriggers, Computational Contact Mechanics, 2nd ed., 2006, sec. 5, doi:10.1007/978-3-540-32609-0.
    """

    reads_contact_forces, unit = True, "Pa"

    def __init__(
        self,
        obstacle: Term | str,
        part: Literal["total", "normal", "friction"] = "total",
        name: str = "contact_traction",
    ):
        self._given, self.name = ContactForce(obstacle, part, name, per_vertex=True), name

    def __repr__(self) -> str:
        return f"ContactTraction({self._given.obstacle!r}, {self._given.part!r}, name={self.name!r})"

    def settled(self, scene: Scene) -> "ContactTraction":
        out, mesh = copy(self), scene.mesh
        out.scene, out.force = scene, self._given.settled(scene)
        out.push = ContactForce(self._given.obstacle, "normal", per_vertex=True).settled(scene)
        out.faces, out.triangles = mesh.surface_faces, mesh.surface_triangles
        out.stages = _QUADRATIC if mesh.order == 2 else _LINEAR
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return self.force.shape(num_frames)

    # ---- of one frame: sums over faces, and means over the faces around a vertex --------------------------------------

    def _vectors(self, of_triangles: np.ndarray) -> np.ndarray:
        """Area vectors of whole faces."""
        return of_triangles.reshape(len(self.faces), -1, 3).sum(1)

    def _sum(self, of_nodes: np.ndarray, n: int) -> np.ndarray:
        out = np.zeros((n, *of_nodes.shape[2:]))
        np.add.at(out, self.faces, of_nodes)
        return out

    def _slopes(self, X: np.ndarray, x: np.ndarray, push: np.ndarray) -> tuple[np.ndarray, ...]:
        """(B, its slopes by area vectors at rest, by those of the frame, by the force on the face)"""
        S0, S = (self._vectors(triangle_normals(at, self.triangles)) for at in (X, x))
        q = push[self.faces].sum(1)
        A, size = np.linalg.norm(S0, axis=1)[:, None], [(v**2).sum(1, keepdims=True) for v in (S, q)]
        S, q = (_per(v, np.sqrt(s)) for v, s in zip((S, q), size))
        c = (S * q).sum(1, keepdims=True)
        w = np.clip((c**2 - _ASIDE) / (_FACING - _ASIDE), 0, 1)
        share, slope = c**2 * w**2 * (3 - 2 * w), w**2 * (3 - 2 * w) + c**2 * 6 * w * (1 - w) / (_FACING - _ASIDE)
        by_S, by_q = (2 * A * slope * c * _per(b - c * a, np.sqrt(s)) for a, b, s in ((S, q, size[0]), (q, S, size[1])))
        return (A * share)[:, 0], share * _per(S0, A), by_S, by_q

    def _spread(self, B: np.ndarray, f: np.ndarray) -> list[np.ndarray]:
        """[sum of B around each vertex, then f over it, and what each stage makes of it]"""
        D = self._sum(np.repeat(B[:, None], self.faces.shape[1], 1), len(f))[:, None] / 3
        out = [D, _per(f, D)]
        for K in self.stages:
            out.append(_per(self._sum(B[:, None, None] / 3 * (K @ out[-1][self.faces]), len(f)), D))
        return out

    def value(self, frames: Frames) -> np.ndarray:
        X, f, push = frames.inputs["rest_positions"], self.force.value(frames), self.push.value(frames)
        x = frames.positions.astype(np.float64)
        return np.stack([self._spread(self._slopes(X, *at)[0], f[k])[-1] for k, at in enumerate(zip(x, push))])

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        X, f, push = frames.inputs["rest_positions"], self.force.value(frames), self.push.value(frames)
        df, dpush, out = self.force.jvp(frames, change), self.push.jvp(frames, change), np.zeros(f.shape)
        dX, x = change.inputs.get("rest_positions", np.zeros_like(X)), frames.positions.astype(np.float64)
        dx = np.zeros(x.shape) if change.positions is None else change.positions
        for k in range(len(x)):
            B, *by = self._slopes(X, x[k], push[k])
            changes = [self._vectors(triangle_normals_jvp(a, self.triangles, b)) for a, b in ((X, dX), (x[k], dx[k]))]
            dB = sum((a * b).sum(1) for a, b in zip(by, (*changes, dpush[k][self.faces].sum(1))))
            D, t, *means = self._spread(B, f[k])
            dD = self._sum(np.repeat(dB[:, None], self.faces.shape[1], 1), len(f[k]))[:, None] / 3
            dt = _per(df[k] - t * dD, D)
            for K, mean in zip(self.stages, means):
                grown = dB[:, None, None] * (K @ t[self.faces]) + B[:, None, None] * (K @ dt[self.faces])
                t, dt = mean, _per(self._sum(grown / 3, len(t)) - mean * dD, D)
            out[k] = dt
        return out

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        X, f, push = frames.inputs["rest_positions"], self.force.value(frames), self.push.value(frames)
        (by_f, by_push, by_x), by_X = np.zeros((3, *f.shape)), np.zeros_like(X)
        x, per_face = frames.positions.astype(np.float64), len(self.triangles) // max(len(self.faces), 1)
        for k in range(len(x)):
            B, *by = self._slopes(X, x[k], push[k])
            D, *means = self._spread(B, f[k])
            t_adj, B_adj, D_adj = seed[k], np.zeros(len(B)), np.zeros(len(D))
            for K, t, mean in zip(self.stages[::-1], means[-2::-1], means[::-1]):
                z = _per(t_adj, D)
                at = z[self.faces]
                B_adj += ((K @ t[self.faces]) * at).sum((1, 2)) / 3
                D_adj -= (mean * z).sum(1)
                t_adj = self._sum(B[:, None, None] / 3 * (K.T @ at), len(D))
            by_f[k] = _per(t_adj, D)
            D_adj -= (means[0] * by_f[k]).sum(1)
            B_adj += D_adj[self.faces].sum(1) / 3
            S0_adj, S_adj, q_adj = (B_adj[:, None] * slope for slope in by)
            by_X += triangle_normals_vjp(X, self.triangles, np.repeat(S0_adj, per_face, 0))
            by_x[k] = triangle_normals_vjp(x[k], self.triangles, np.repeat(S_adj, per_face, 0))
            by_push[k] = self._sum(np.repeat(q_adj[:, None], self.faces.shape[1], 1), len(D))
        out = Change(positions=by_x, inputs={"rest_positions": by_X})
        out.add(self.force.vjp(frames, by_f))
        out.add(self.push.vjp(frames, by_push))
        return out


def _per(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a / b, 0 where b is."""
    return np.divide(a, b, out=np.zeros(np.broadcast_shapes(a.shape, b.shape)), where=b > 0)
