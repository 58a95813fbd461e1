"""How a body slides along an obstacle: its velocity there, and how much of the friction that Coulomb allows it takes."""

from copy import copy
from typing import Literal

import numpy as np

from diffsim_ti.differentiation.arrays import ratio
from diffsim_ti.inputs.poses import PoseColumns
from diffsim_ti.outputs.contact_force import ContactForce
from diffsim_ti.outputs.output import Frames, Output
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

    def value(self, frames: Frames) -> np.ndarray:
        normal, friction = (frames.contact_forces[:, self.place, side] for side in (0, 1))
        p = np.linalg.norm(normal, axis=-1, keepdims=True)
        if self.what == "share":
            return ratio(np.linalg.norm(friction, axis=-1), frames.inputs[self.friction] * p[..., 0])
        n, s = ratio(normal, p), self._sliding(frames)
        return np.where(p > 0, s - n * (n * s).sum(-1, keepdims=True), 0.0)

    def _sliding(self, frames: Frames) -> np.ndarray:
        """v - v_o of each vertex in each frame, v_o = u + w x (x - c) by the rows of the obstacle's path."""
        x, v = frames.positions.astype(np.float64), frames.velocities.astype(np.float64)
        if self.path is None:
            return v
        # a simulator's frames have rows of one step alone; at the start, where no contact is known, the length is 1
        k = np.clip(frames.steps, 1, len(frames.inputs[self.path]) - 1)
        mean = np.diff(frames.times, prepend=0.0) / np.maximum(np.diff(frames.steps, prepend=0), 1)
        dt = np.where(mean > 0, mean, 1.0)[:, None]
        (columns,) = PoseColumns([self.path], "path").value(frames.inputs[self.path])
        u = (columns[k, 0] - columns[k - 1, 0]) / dt
        if self.about is None:
            return v - u[:, None]
        c, w = columns[k, 0] + frames.inputs[self.about], columns[k - 1, 2] / dt
        return v - u[:, None] - np.cross(w[:, None], x - c[:, None])
