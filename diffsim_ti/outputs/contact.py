"""What obstacles do to the body: forces and moments, tractions, and how it slides along them."""

from copy import copy
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.inputs.poses import PoseColumns
from diffsim_ti.mesh.geometry import triangle_normals, triangle_normals_jvp, triangle_normals_vjp
from diffsim_ti.outputs.moments import moments, moments_jvp, moments_vjp
from diffsim_ti.outputs.output import Change, Frames, Output
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Obstacle, Term

PARTS = ("total", "normal", "friction")


class ContactForce(Output):
    """Force [N] of an obstacle on the body, shape (frames, 3), or on each vertex, (frames, num_vertices, 3).

    obstacle: its name, or the term as the scene lists it. part: "normal" is what its barrier pushes with, "friction" what
        drags, "total" both. per_vertex: of each vertex instead of the sum. name: how a loss calls it.
    on: the vertices whose sum or moment is taken, by a vertex set's name, indices, a mask or a list of names, such as a body
        of a joined mesh; None: all.
    about: the moment [N m] about this point [m], 3 numbers, instead: sum (x_i - about) x f_i, x being the frame's positions.

    A frame holds the mean over the time T since the frame before it, zero in the first:

        f = 1/T sum over passes of the impulses,    in explicit passes h P n + m (v after - v before friction)

    so that with save_every=1 it is the force of each step, and T f is what the obstacle added to the body's momentum: to
    round-off in explicit steps, in backward Euler and the midpoint rule to the tolerance of their solves; of implicit steps
    the forces are those where they take them. In static solves it is the force of the last equilibrium.
    Obstacles act on fixed vertices in implicit steps and static solves alone, and what holds them takes that up.
    The gradient is exact by all inputs: moduli, density, rest shape, the obstacle's stiffness, friction, shape, path.

    Raises ValueError, when a Rollout is made, for an obstacle that the scene has not, another part, a name that is taken,
    and an explicit solver with contact="force".
    Wriggers, Computational Contact Mechanics, 2nd ed., 2006, sec. 5 and 8, doi:10.1007/978-3-540-32609-0.
    """

    reads_contact_forces, unit = True, "N"

    def __init__(
        self,
        obstacle: Term | str,
        part: Literal["total", "normal", "friction"] = "total",
        name: str = "contact_force",
        per_vertex: bool = False,
        about: ArrayLike | None = None,
        on: str | ArrayLike | None = None,
    ):
        if part not in PARTS:
            raise ValueError(f"ContactForce: part must be {', '.join(PARTS[:-1])} or {PARTS[-1]}, got {part!r}")
        if about is not None and per_vertex:
            raise ValueError("ContactForce: a moment is of all vertices: give about= or per_vertex=True, not both")
        if on is not None and per_vertex:
            raise ValueError("ContactForce: give on=, a set whose sum is taken, or per_vertex=True, of all vertices")
        self.obstacle, self.part, self.name, self.per_vertex = obstacle, part, name, bool(per_vertex)
        self.on = on
        self.about = None if about is None else np.array(about, np.float64)
        if self.about is not None and (self.about.shape != (3,) or not np.all(np.isfinite(self.about))):
            raise ValueError(f"ContactForce: about must be 3 finite numbers [m], got {about!r}")

    def __repr__(self) -> str:
        return f"ContactForce({self.obstacle!r}, {self.part!r}, name={self.name!r})"

    def settled(self, scene: Scene) -> "ContactForce":
        out = copy(self)
        out.place, out.num_vertices = scene.place_of(self.obstacle), scene.mesh.num_vertices
        n = out.num_vertices
        out.vertices = np.arange(n) if self.on is None else scene.mesh.vertex_indices(self.on)
        out.sides = {"total": slice(0, 2), "normal": slice(0, 1), "friction": slice(1, 2)}[self.part]
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames, self.num_vertices, 3) if self.per_vertex else (num_frames, 3)

    def _of(self, forces: np.ndarray) -> np.ndarray:
        """On each vertex that counts."""
        return forces[:, self.place, self.sides].sum(1)[:, self.vertices]

    def value(self, frames: Frames) -> np.ndarray:
        f = self._of(frames.contact_forces)
        if self.about is not None:
            return moments(frames.positions[:, self.vertices], self.about, f)
        return f if self.per_vertex else f.sum(1)

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        x, dx = frames.positions[:, self.vertices], change.positions
        df = np.zeros(x.shape) if change.contact_forces is None else self._of(change.contact_forces)
        if self.about is not None:
            dx = None if dx is None else dx[:, self.vertices]
            return moments_jvp(x, self.about, self._of(frames.contact_forces), dx, df)
        return df if self.per_vertex else df.sum(1)

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        by_forces, positions = np.zeros(frames.contact_forces.shape), None
        by_vertex = np.zeros(frames.positions.shape)
        by_vertex[:, self.vertices] = seed if self.per_vertex else seed[:, None]
        if self.about is not None:
            positions, x = np.zeros(by_vertex.shape), frames.positions[:, self.vertices]
            own = moments_vjp(x, self.about, self._of(frames.contact_forces), seed)
            positions[:, self.vertices], by_vertex[:, self.vertices] = own
        by_forces[:, self.place, self.sides] = by_vertex[:, None]
        return Change(positions=positions, contact_forces=by_forces)


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


class ContactSlip(Output):
    """Sliding of each vertex along an obstacle that presses on it, zero where none does; by `what`

    "velocity": v_i - v_o(x_i) less what of it is along n_i [m/s], shape (frames, num_vertices, 3), v_o being the velocity of
        the obstacle's own material there, which its path gives in the step that ends in the frame.
    "share": |t_i| / (mu |p_i|) [-], shape (frames, num_vertices): below 1 the vertex sticks (creeps at less than the
        obstacle's friction_speed), at 1 it slides.

    p_i and t_i: normal force and friction, n_i = p_i / |p_i|, all as of `ContactForce(obstacle, per_vertex=True)`, so means
    since the frame before: with save_every=1 those of the step that ends in the frame. Of steps of unequal lengths v_o is
    that of a step of their mean length since the frame before, exact with save_every=1. States of static solves have no
    velocity; their "share" is that of the last equilibrium.
    obstacle: its name, or the term as the scene lists it. The gradient is exact by all inputs; a "share" of 0 has none.

    Raises ValueError as `ContactForce` does, for another `what`, and for the "share" of an obstacle without friction.
    Wriggers, Computational Contact Mechanics, 2nd ed., 2006, sec. 5.2, doi:10.1007/978-3-540-32609-0.
    """

    reads_contact_forces = True

    def __init__(
        self, obstacle: Obstacle | str, what: Literal["velocity", "share"] = "velocity", name: str = "contact_slip"
    ):
        if what not in ("velocity", "share"):
            raise ValueError(f"ContactSlip: what must be 'velocity' or 'share', got {what!r}; choose one of these")
        self._force, self.what, self.name = ContactForce(obstacle, per_vertex=True), what, name
        self.unit, self.per_item = ("m/s", False) if what == "velocity" else ("-", True)

    def __repr__(self) -> str:
        return f"ContactSlip({self._force.obstacle!r}, {self.what!r}, name={self.name!r})"

    def settled(self, scene: Scene) -> "ContactSlip":
        out, force = copy(self), self._force.settled(scene)
        out.place, out.num_vertices, term = force.place, force.num_vertices, scene.obstacles[force.place]
        names = scene.input_names(term)
        if self.what == "share" and not term.has_friction:
            raise ValueError(f"{self!r}: the obstacle has no friction; pass friction= to it")
        out.friction = names.get("friction")
        out.path = names[term.path_name] if term.path is not None else None
        out.about = names[term.about_name] if term.turns else None
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames, self.num_vertices, 3) if self.what == "velocity" else (num_frames, self.num_vertices)

    def _forces(self, contact_forces: np.ndarray | None) -> tuple[np.ndarray, np.ndarray] | tuple[float, float]:
        """(normal forces, frictions), zeros for no change of them."""
        return (0.0, 0.0) if contact_forces is None else tuple(np.moveaxis(contact_forces[:, self.place], 1, 0))

    # ---- the obstacle's velocity: u + w x (x - c), of its path's rows ----------------------------------------------------

    def _at(self, frames: Frames) -> tuple[np.ndarray, np.ndarray]:
        """(row of the path at each frame, 1 at least; mean length of the steps since the frame before [s], as a column); a
        simulator's has rows of one step alone. At the start, where no contact is known, the length is 1."""
        dt = np.diff(frames.times, prepend=0.0) / np.maximum(np.diff(frames.steps, prepend=0), 1)
        return np.clip(frames.steps, 1, len(frames.inputs[self.path]) - 1), np.where(dt > 0, dt, 1.0)[:, None]

    def _of_rows(self, frames: Frames, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each frame (u, w, where the point that it turns about has gone), or their changes."""
        k, dt = self._at(frames)
        turned = columns[k - 1, 2] / dt if columns.shape[1] > 1 else np.zeros((len(k), 3))
        return (columns[k, 0] - columns[k - 1, 0]) / dt, turned, columns[k, 0]

    def _link(self) -> PoseColumns:
        return PoseColumns([self.path], "path")

    def _sliding(self, frames: Frames) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(v - v_o, lever x - c, w) of each vertex in each frame."""
        x, v = frames.positions.astype(np.float64), frames.velocities.astype(np.float64)
        if self.path is None:
            return v, x, np.zeros((len(x), 1, 3))
        u, w, c = self._of_rows(frames, self._link().value(frames.inputs[self.path])[0])
        lever = x - (c if self.about is None else c + frames.inputs[self.about])[:, None]
        return v - u[:, None] - np.cross(w[:, None], lever), lever, w[:, None]

    # ---- value, tangent, adjoint -----------------------------------------------------------------------------------------

    def value(self, frames: Frames) -> np.ndarray:
        normal, friction = self._forces(frames.contact_forces)
        p = np.linalg.norm(normal, axis=-1, keepdims=True)
        if self.what == "share":
            return _per(np.linalg.norm(friction, axis=-1), frames.inputs[self.friction] * p[..., 0])
        n, s = _per(normal, p), self._sliding(frames)[0]
        return np.where(p > 0, s - _along(n, s), 0.0)

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        normal, friction = self._forces(frames.contact_forces)
        dnormal, dfriction = self._forces(change.contact_forces)
        p = np.linalg.norm(normal, axis=-1, keepdims=True)
        n = _per(normal, p)
        if self.what == "share":
            y, mu = self.value(frames), frames.inputs[self.friction]
            t, dp = np.linalg.norm(friction, axis=-1, keepdims=True), (n * dnormal).sum(-1)
            dt, dmu = (_per(friction, t) * dfriction).sum(-1), change.inputs.get(self.friction, 0.0)
            return _per(dt, mu * p[..., 0]) - y * (_per(dp, p[..., 0]) + dmu / mu)
        (s, lever, w), zero = self._sliding(frames), np.zeros(normal.shape)
        dx = zero if change.positions is None else change.positions
        ds = (zero if change.velocities is None else change.velocities) - np.cross(w, dx)
        if self.path is not None:
            rows = frames.inputs[self.path]
            drows, dabout = (
                change.inputs.get(self.path, np.zeros_like(rows)),
                change.inputs.get(self.about, np.zeros(3)),
            )
            du, dw, dc = self._of_rows(frames, self._link().jvp([rows], [drows])[0])
            ds = ds - du[:, None] - np.cross(dw[:, None], lever) + np.cross(w, (dc + dabout)[:, None])
        dn = _per(dnormal - _along(n, dnormal + zero), p)
        return np.where(
            p > 0, ds - _along(n, ds) - dn * (n * s).sum(-1, keepdims=True) - n * (dn * s).sum(-1, keepdims=True), 0
        )

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        normal, friction = self._forces(frames.contact_forces)
        p, by_forces = np.linalg.norm(normal, axis=-1, keepdims=True), np.zeros(frames.contact_forces.shape)
        n = _per(normal, p)
        if self.what == "share":
            y, mu = self.value(frames), frames.inputs[self.friction]
            t = np.linalg.norm(friction, axis=-1, keepdims=True)
            by_forces[:, self.place, 0] = -n * _per(seed * y, p[..., 0])[..., None]
            by_forces[:, self.place, 1] = _per(friction, t) * _per(seed, mu * p[..., 0])[..., None]
            return Change(contact_forces=by_forces, inputs={self.friction: np.array(-(seed * y).sum() / mu)})
        s, lever, w = self._sliding(frames)
        seed = np.where(p > 0, seed, 0.0)
        by_s = seed - _along(n, seed)
        by_n = -seed * (n * s).sum(-1, keepdims=True) - s * (n * seed).sum(-1, keepdims=True)
        by_forces[:, self.place, 0] = _per(by_n - _along(n, by_n), p)
        inputs, by_lever = {}, np.cross(w, by_s)  # -s . (w x l) = l . (w x s)
        if self.path is not None:
            rows, (k, dt) = frames.inputs[self.path], self._at(frames)
            columns = np.zeros_like(self._link().value(rows)[0])
            np.add.at(columns[:, 0], k, -by_s.sum(1) / dt - by_lever.sum(1))
            np.add.at(columns[:, 0], k - 1, by_s.sum(1) / dt)
            if columns.shape[1] > 1:
                np.add.at(columns[:, 2], k - 1, -np.cross(lever, by_s).sum(1) / dt)
                inputs[self.about] = -by_lever.sum((0, 1))
            inputs[self.path] = self._link().vjp([rows], [columns])[0]
        return Change(positions=by_lever, velocities=by_s, contact_forces=by_forces, inputs=inputs)


def _along(n: np.ndarray, s: np.ndarray) -> np.ndarray:
    """What of s is along n."""
    return n * (n * s).sum(-1, keepdims=True)


def _per(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a / b, 0 where b is."""
    return np.divide(a, b, out=np.zeros(np.broadcast_shapes(np.shape(a), b.shape)), where=b > 0)
