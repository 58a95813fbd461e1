"""How a body slides along an obstacle: its velocity there, and how much of the friction that Coulomb allows it takes."""

from copy import copy
from typing import Literal

import numpy as np

from diffsim_ti.inputs.poses import PoseColumns
from diffsim_ti.outputs.contact_force import ContactForce
from diffsim_ti.outputs.output import Change, Frames, Output
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Obstacle


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
        if self.what == "velocity" and term.led is not None:
            raise ValueError(
                f"{self!r}: a robot moves the obstacle, whose velocity frames do not have; take what='share'"
            )
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
