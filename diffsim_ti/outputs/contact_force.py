"""Forces and moments of obstacles on the body, and where these press."""

from copy import copy
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.differentiation.arrays import ratio
from diffsim_ti.outputs.output import Frames, Output, force_or_moment
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Term

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
    Obstacles act on fixed vertices in implicit steps, static solves and where they act by pairs; what holds them takes that
    up.
    The gradient is exact by all inputs: moduli, density, rest shape, the obstacle's stiffness, friction, shape, path.

    Raises ValueError, when a Rollout is made, for an obstacle that the scene has not, another part, a name that is taken,
    and an explicit solver with contact="force".
    Wriggers, Computational Contact Mechanics, 2nd ed., 2006, sec. 5 and 8, doi:10.1007/978-3-540-32609-0.
    """

    reads_contact_forces, unit, _shown = True, "N", ("obstacle", "part")

    def __init__(
        self,
        obstacle: Term | str,
        part: Literal["total", "normal", "friction"] = "total",
        name: str = "contact_force",
        per_vertex: bool = False,
        about: ArrayLike | None = None,
        on: str | ArrayLike | None = None,
    ):
        said = type(self).__name__
        if part not in PARTS:
            raise ValueError(f"{said}: part must be {', '.join(PARTS[:-1])} or {PARTS[-1]}, got {part!r}")
        if about is not None and per_vertex:
            raise ValueError(f"{said}: a moment is of all vertices: give about= or per_vertex=True, not both")
        if on is not None and per_vertex:
            raise ValueError(f"{said}: give on=, a set whose sum is taken, or per_vertex=True, of all vertices")
        self.obstacle, self.part, self.name, self.per_vertex = obstacle, part, name, bool(per_vertex)
        self.on = on
        self.about = None if about is None else np.array(about, np.float64)
        if self.about is not None and (self.about.shape != (3,) or not np.all(np.isfinite(self.about))):
            raise ValueError(f"{said}: about must be 3 finite numbers [m], got {about!r}")

    def settled(self, scene: Scene) -> "ContactForce":
        out = copy(self)
        out.place, out.num_vertices = self._place(scene), scene.mesh.num_vertices
        n = out.num_vertices
        out.vertices = np.arange(n) if self.on is None else scene.mesh.vertex_indices(self.on)
        out.sides = {"total": slice(0, 2), "normal": slice(0, 1), "friction": slice(1, 2)}[self.part]
        return out

    def _place(self, scene: Scene) -> int:
        """Among the rows of frames.contact_forces."""
        return scene.place_of(self.obstacle)

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames, self.num_vertices, 3) if self.per_vertex else (num_frames, 3)

    def value(self, frames: Frames) -> np.ndarray:
        forces = frames.contact_forces[:, self.place, self.sides].sum(1)[:, self.vertices]
        return forces if self.per_vertex else force_or_moment(forces, frames.positions[:, self.vertices], self.about)


class CenterOfPressure(ContactForce):
    """Where an obstacle presses on the body [m], shape (frames, 3): sum |p_i| x_i / sum |p_i|, zero where it does not.

    p_i: what `ContactForce(obstacle, "normal", per_vertex=True)` gives, x_i: the frame's positions. On a plane the force
    there has the moment of all p_i. Where the obstacle acts by pairs on curved faces of ten nodes, some p_i point the other
    way, and the place is off. obstacle, name: as there. The gradient is exact by all inputs.
    Raises ValueError as `ContactForce` does.
    Sardain, Bessonnet 2004, Forces acting on a biped robot, doi:10.1109/TSMCA.2004.832811.
    """

    unit, _shown = "m", ("obstacle",)

    def __init__(self, obstacle: Term | str, name: str = "center_of_pressure"):
        super().__init__(obstacle, "normal", name)

    def value(self, frames: Frames) -> np.ndarray:
        p = np.linalg.norm(frames.contact_forces[:, self.place, 0], axis=-1, keepdims=True)
        return ratio((p * frames.positions.astype(np.float64)).sum(1), p.sum(1))
