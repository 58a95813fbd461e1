"""What holds a body: force and moment of a support."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.outputs.forces_at_frames import AppliedLoads, BodyForces
from diffsim_ti.outputs.frames import Frames
from diffsim_ti.outputs.moments import moments, moments_jvp, moments_vjp
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Tie


class Reaction(Output):
    """Force [N] of the supports on fixed vertices, shape (frames, 3), or of each, (frames, k, 3), at each frame's state.

        R = -sum over the support of Q_i (f_i + m_i g + F_i)

    f: force of the body's stress on a vertex, m_i g its weight, F its loads (of the step that ends in the frame), drag and
    inertial forces at its velocity, Q_i: the projector onto the directions in which the support holds it, or, if `support`
    is no name in the scene's `fixed`, all do.
    So in equilibrium the reactions of all supports, the weight, the loads and the forces of obstacles add up to zero where
    supports share no vertices, or hold them in directions perpendicular to each other.
    What obstacles and self-contact do to fixed vertices themselves is not in it (ContactForce has the first), nor is the
    inertia of vertices that a prescribed motion accelerates. An incompressible fluid pushes with what `ChamberPressure`
    says of it.

    support: which of the fixed vertices, by a vertex set's name, indices, a mask or a list of names; None: all.
        Or a `Tie` of the scene: the force on its surface b, which acts on the vertices there where no support holds them,
        without their inertia.
    about: the moment [N m] about this point [m] instead: sum (x_i - about) x R_i. per_vertex: of each vertex, ordered as
        `mesh.vertex_indices(support)`. name: how a loss calls it.
    The gradient is exact by all inputs. In single precision a reaction is the small sum of large forces of stress: it has an
    error of some 1e-6 of these.

    Raises ValueError for a support that is not fixed, or for about= and per_vertex=True together.
    Belytschko, Liu, Moran, Nonlinear Finite Elements for Continua and Structures, 2000, sec. 4.4.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity()], fixed="ymin", precision="f64")
    >>> frames = ds.Rollout(ds.StaticSolver(scene), steps=1, outputs=[ds.Reaction("ymin")]).forward()
    >>> print(f"{frames['reaction'][-1, 1]:.3f} N")  # the weight
    9810.000 N
    """

    unit, reads_chamber_pressures, reads_law_state = "N", True, True

    def __init__(
        self,
        support: SetOrIndices | Tie | None = None,
        name: str = "reaction",
        about: ArrayLike | None = None,
        per_vertex: bool = False,
    ):
        if about is not None and per_vertex:
            raise ValueError("Reaction: a moment is of all vertices: give about= or per_vertex=True, not both")
        self.support, self.name, self.per_vertex = support, name, bool(per_vertex)
        self.about = None if about is None else numbers("Reaction: about [m]", about)
        if self.about is not None and (self.about.shape != (3,) or not np.all(np.isfinite(self.about))):
            raise ValueError(f"Reaction: about must be 3 finite numbers [m], got {about!r}")

    def __repr__(self) -> str:
        return f"Reaction({self.support!r}, name={self.name!r})"

    def settled(self, scene: Scene) -> "Reaction":
        out = copy(self)
        if isinstance(self.support, Tie):
            if self.support not in (*scene.terms, *scene.arguments["terms"]):
                raise ValueError(
                    f"Reaction: the scene does not list {self.support!r}; pass the tie that is among its terms"
                )
            out.vertices = self.support.glued_vertices(scene.mesh)
            out.onto = scene.supports.freedom(scene.mesh.num_vertices)[out.vertices]
        else:
            out.vertices = scene.held if self.support is None else scene.mesh.vertex_indices(self.support)
            loose = np.setdiff1d(out.vertices, scene.held)
            if len(out.vertices) == 0 or len(loose):
                raise ValueError(
                    f"Reaction: the support must be among the fixed vertices, but {len(loose) or 'all'} of its "
                    f"{len(out.vertices)} vertices are free: fix them (Scene(..., fixed=...)) or name others"
                )
            out.onto = scene.supports.projectors(out.vertices, self.support)
        out.scene, out.body, out.loads = scene, BodyForces(scene), AppliedLoads(scene, moving=True)
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames, len(self.vertices), 3) if self.per_vertex else (num_frames, 3)

    # ---- forces on all vertices, shape (frames, num_vertices, 3) -----------------------------------------------------

    def _place(self, frames, k: int) -> np.ndarray:
        """Go to the state of frame k; its positions."""
        u, v = (x[k].astype(np.float64) for x in (frames.displacements, frames.velocities))
        self.body.place(u, v, self.remembered(frames, self.scene)[k])
        return frames.positions[k].astype(np.float64)

    def _pressures(self, frames, k: int) -> np.ndarray | None:
        """Of chambers that hold a volume in frame k."""
        return frames.chamber_pressures[k] if self.scene.holds_volumes else None

    def _held(self, frames) -> np.ndarray:
        """What holds the vertices, shape (frames, k, 3)."""
        derived, out = self.body.load(frames.inputs), []
        for k, v in enumerate(frames.velocities.astype(np.float64)):
            x = self._place(frames, k)
            f = self.loads.forces(derived, x, int(frames.steps[k]), held=self._pressures(frames, k), v=v)
            f = f + self.body.forces()
            out.append(-self._onto(f[self.vertices]))
        return np.stack(out)

    def _onto(self, f: np.ndarray) -> np.ndarray:
        """Of forces on the support's vertices, shape (..., k, 3), what it can hold."""
        return np.einsum("kij,...kj->...ki", self.onto, f)

    def value(self, frames: Frames) -> np.ndarray:
        return self._of(frames, self._held(frames))

    def _of(self, frames, held: np.ndarray) -> np.ndarray:
        if self.about is not None:
            return moments(frames.positions[:, self.vertices], self.about, held)
        return held if self.per_vertex else held.sum(1)

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        derived = self.body.load(frames.inputs)
        moved = self.scene.inputs.derive_jvp(frames.inputs, change.inputs)
        tangent, zero, out = self.body.tangent(moved), np.zeros(frames.positions.shape), []
        dx = zero if change.positions is None else change.positions
        dv = zero if change.velocities is None else change.velocities
        dz = self.remembered_jvp(change, self.remembered(frames, self.scene))
        for k in range(len(zero)):
            x, v = self._place(frames, k), frames.velocities[k].astype(np.float64)
            df = self.body.jvp(dx[k] - moved.rest, dv[k], tangent, dz[k])
            shown = dict(held=self._pressures(frames, k), v=v, dv=dv[k])
            df = df + self.loads.jvp(derived, moved, x, dx[k], int(frames.steps[k]), **shown)
            if change.chamber_pressures is not None and self.scene.holds_volumes:
                df = df + self.loads.held_jvp(x, change.chamber_pressures[k])
            out.append(-self._onto(df[self.vertices]))
        if self.about is None:
            return self._of(frames, np.stack(out))
        held, x = self._held(frames), frames.positions[:, self.vertices]
        return moments_jvp(x, self.about, held, dx[:, self.vertices], np.stack(out))

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        positions, velocities, w = np.zeros((3, *frames.positions.shape))
        if self.about is not None:
            held, x = self._held(frames), frames.positions[:, self.vertices]
            positions[:, self.vertices], w[:, self.vertices] = moments_vjp(x, self.about, held, seed)
        else:
            w[:, self.vertices] = seed if self.per_vertex else seed[:, None]
        w[:, self.vertices] = -self._onto(w[:, self.vertices])
        derived, adjoint = self.body.load(frames.inputs), self.body.adjoint()
        rest, by_loads, by_held, by_states = np.zeros(positions.shape[1:]), derived.zeros(), [], []
        for k in range(len(w)):
            x, v = self._place(frames, k), frames.velocities[k].astype(np.float64)
            by_u, by_v, by_z = self.body.vjp(w[k], adjoint)
            by_states.append(by_z)
            held, step = self._pressures(frames, k), int(frames.steps[k])
            by_x, by_speed = self.loads.vjp(derived, x, w[k], step, by_loads, held=held, v=v)
            positions[k] += by_u + by_x
            velocities[k] += by_speed
            if held is not None:
                by_held.append(self.loads.held_vjp(x, w[k]))
            velocities[k] += by_v
            rest -= by_u
        adj = adjoint.collect()
        adj.element_masses = None
        adj.add(by_loads)
        adj.rest = adj.rest + rest
        inputs = self.scene.inputs.derive_vjp(frames.inputs, adj, tuple(frames.inputs))
        held, state = (np.stack(x) if x and x[0] is not None else None for x in (by_held, by_states))
        return Change(positions, velocities, inputs, chamber_pressures=held, law_state=state)
