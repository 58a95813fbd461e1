"""Forces of surfaces that press and slide on each other: what a soft hand does to what it holds."""

from copy import copy
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.curved_pairs import pairs_of
from diffsim_ti.mechanics.surfaces.implicit_pairs import ImplicitPairs
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.outputs.moments import moments, moments_jvp, moments_vjp
from diffsim_ti.outputs.output import Change, Frames, Output
from diffsim_ti.scene import Scene
from diffsim_ti.state.arrays import SceneArrays
from diffsim_ti.state.numbers import Tangent
from diffsim_ti.terms import SelfContact

PARTS = ("normal", "friction", "total")


class SelfContactForce(Output):
    """Force [N] of the pairs of SelfContact on vertices, shape (frames, 3), or on each, (frames, num_vertices, 3), at each
    frame's state:

        f_i = sum over pairs of w_i (N n - mu N f(|t| / eps) t / |t|),    t = (I - n n^T) sum_i w_i v_i

    n: the pair's normal, w_i: the weights of its four corners (whose sum is 0), N: what its barrier presses with; f, mu,
    eps: of friction (terms/self_contact.py). So the sum over all vertices is zero, and that over one body is what all
    others do to it. It is of the state, but friction in implicit and static solvers is that of the substep that ends in the
    frame: it takes N, n and w from where the substep begins, and v_i = (u_i - x_i) / gamma, of a static solve the way of a
    load step over its share of dt. So it is what the solve balanced, also at rest. The first frame has that of its state.

    on: whose sum is taken, by a vertex set's name, indices, a mask or a list of names, as of `mesh.vertex_indices`; of a
        joined mesh "body_0", "body_1" and so on.
    part: "normal", "friction" or "total". per_vertex: of each vertex of the mesh instead. name: how a loss calls it.
    about: the moment [N m] about this point [m] instead, sum (x_i - about) x f_i.
    The gradient is exact by all inputs.

    Raises ValueError for a scene without SelfContact, another part, or on= or about= with per_vertex=True, and if neither
    on= nor per_vertex=True is given.
    Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425.
    """

    unit = "N"

    def __init__(
        self,
        on: SetOrIndices | None = None,
        part: Literal["total", "normal", "friction"] = "total",
        name: str = "self_contact_force",
        per_vertex: bool = False,
        about: ArrayLike | None = None,
    ):
        if part not in PARTS:
            raise ValueError(f"SelfContactForce: part must be {', '.join(PARTS[:-1])} or {PARTS[-1]}, got {part!r}")
        if per_vertex == (on is not None) or (about is not None and per_vertex):
            raise ValueError(
                "SelfContactForce: give on=, a set whose sum (or moment) is taken, or per_vertex=True, of all vertices; the "
                "sum over all is zero"
            )
        self.on, self.part, self.name, self.per_vertex = on, part, name, bool(per_vertex)
        self.about = None if about is None else np.array(about, np.float64)
        if self.about is not None and (self.about.shape != (3,) or not np.all(np.isfinite(self.about))):
            raise ValueError(f"SelfContactForce: about must be 3 finite numbers [m], got {about!r}")

    def __repr__(self) -> str:
        return f"SelfContactForce({self.on!r}, {self.part!r}, name={self.name!r})"

    def settled(self, scene: Scene) -> "SelfContactForce":
        if scene.term(SelfContact) is None:
            raise ValueError(f"{self!r}: the scene has no SelfContact; add it to the scene's terms")
        out = copy(self)
        out.scene, out.arrays, n = scene, SceneArrays(scene), scene.mesh.num_vertices
        out.num_obstacles = len(scene.obstacles)
        out.vertices = np.arange(n) if self.on is None else np.unique(scene.mesh.vertex_indices(self.on))
        out.pairs, out.surface = (
            pairs_of(ImplicitPairs, out.arrays, False, with_obstacles=False),
            scene.mesh.surface_vertices,
        )
        out.pair_friction = None if self.part == "normal" else out.pairs.friction
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames, len(self.vertices), 3) if self.per_vertex else (num_frames, 3)

    def needs_contact_forces(self, solver) -> bool:
        term = solver.scene.term(SelfContact)
        return not solver.explicit and self.part != "normal" and term is not None and term.has_friction

    # ---- on all vertices, shape (num_vertices, 3) --------------------------------------------------------------------

    def _place(self, frames, k: int) -> tuple[np.ndarray, bool]:
        """Go to frame k; its displacements [m], and whether friction is that of the state."""
        u, v = frames.displacements[k].astype(np.float64), frames.velocities[k].astype(np.float64)
        pair_friction = bool(self.pair_friction) and not self._is_noted(frames, k)
        self.pairs.begin(u)
        if pair_friction:
            self.pair_friction.begin(u, u - v, 1.0)
        self.pairs.place(self.pairs.next)
        return u, pair_friction

    def _is_noted(self, frames, k: int) -> bool:
        """Whether friction of frame k is what the run noted in the last row of its contact forces."""
        noted = frames.contact_forces
        return (
            bool(self.pair_friction)
            and frames.steps[k] > 0
            and noted is not None
            and noted.shape[1] > self.num_obstacles
        )

    def _at_corners(self) -> np.ndarray:
        """What the pairs have put into the last corners, of all vertices."""
        out, first = np.zeros((self.scene.mesh.num_vertices, 3)), self.arrays.first_contact_corner
        out[self.surface] = runtime.fetch(self.arrays.corner)[first : first + len(self.surface)]
        return out

    def _all(self, frames) -> np.ndarray:
        self.arrays.load(self.scene.inputs.derive(frames.inputs))
        out = []
        for k in range(len(frames.positions)):
            u, pair_friction = self._place(frames, k)
            f = self._at_corners() if self.part != "friction" else np.zeros(u.shape)
            f = f + frames.contact_forces[k, -1, 1] if self._is_noted(frames, k) else f
            out.append(f + self.pair_friction.forces(u) if pair_friction else f)
        return np.stack(out)

    def _of(self, frames, f: np.ndarray) -> np.ndarray:
        f = f[:, self.vertices]
        if self.about is not None:
            return moments(frames.positions[:, self.vertices], self.about, f)
        return f if self.per_vertex else f.sum(1)

    def value(self, frames: Frames) -> np.ndarray:
        return self._of(frames, self._all(frames))

    # ---- derivatives -------------------------------------------------------------------------------------------------

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        self.arrays.load(self.scene.inputs.derive(frames.inputs))
        moved = self.scene.inputs.derive_jvp(frames.inputs, change.inputs)
        numbers, zero, out = Tangent(self.arrays, moved), np.zeros(frames.positions.shape), []
        dx = zero if change.positions is None else change.positions
        dv = zero if change.velocities is None else change.velocities
        for k in range(len(zero)):
            (u, pair_friction), du, df = self._place(frames, k), dx[k] - moved.rest, np.zeros(zero.shape[1:])
            if self.part != "friction":
                runtime.fill(self.pairs.step, du[None])
                self.pairs.product(
                    self.pairs.next, 0, self.pairs.step, self.arrays.corner, numbers.rest, moved.parameters
                )
                df += self._at_corners()
            if self._is_noted(frames, k) and change.contact_forces is not None:
                df = df + change.contact_forces[k, -1, 1]
            out.append(df + self.pair_friction.jvp(u, du, du - dv[k], du, numbers) if pair_friction else df)
        if self.about is None:
            return self._of(frames, np.stack(out))
        own, x = np.stack(out)[:, self.vertices], frames.positions[:, self.vertices]
        return moments_jvp(x, self.about, self._all(frames)[:, self.vertices], dx[:, self.vertices], own)

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        positions, velocities, w = np.zeros((3, *frames.positions.shape))
        derived = self.scene.inputs.derive(frames.inputs)
        if self.about is not None:
            f, x = self._all(frames)[:, self.vertices], frames.positions[:, self.vertices]
            positions[:, self.vertices], w[:, self.vertices] = moments_vjp(x, self.about, f, seed)
        else:
            w[:, self.vertices] = seed if self.per_vertex else seed[:, None]
        self.arrays.load(derived)
        self.pairs.clear_sums()
        rest, noted = np.zeros(positions.shape[1:]), None
        for k in range(len(w)):
            (u, pair_friction), by_u = self._place(frames, k), np.zeros(rest.shape)
            if self.part != "friction":
                runtime.fill(self.pairs.step, w[k][None])
                self.pairs.vjp(self.pairs.next, 0, self.pairs.step, self.arrays.corner)
                by_u += self._at_corners()
            if self._is_noted(frames, k):
                noted = np.zeros(frames.contact_forces.shape) if noted is None else noted
                noted[k, -1, 1] = w[k]
            if pair_friction:
                by_v, _, by_begin = self.pair_friction.vjp(u, w[k])
                by_u, velocities[k] = by_u + by_begin, by_v
            positions[k] += by_u
            rest -= by_u
        adjoint = derived.zeros()
        by_numbers, by_rest = self.pairs.collect()
        adjoint.parameters += by_numbers
        adjoint.rest = rest + by_rest
        inputs = self.scene.inputs.derive_vjp(frames.inputs, adjoint, tuple(frames.inputs))
        return Change(positions, velocities, inputs, contact_forces=noted)
