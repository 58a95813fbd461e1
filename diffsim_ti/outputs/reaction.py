"""What holds a body: force and moment of a support, and of a plane cut."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.outputs.deformation import Deformation
from diffsim_ti.outputs.forces_at_frames import AppliedLoads, BodyForces
from diffsim_ti.outputs.moments import moments, moments_jvp, moments_vjp
from diffsim_ti.outputs.output import Change, Frames, Output
from diffsim_ti.outputs.tensors import Stress
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Robot, Tie


class Reaction(Output):
    """Force [N] of the supports on fixed vertices, shape (frames, 3), or of each, (frames, k, 3), at each frame's state.

        R = -sum over the support of Q_i (f_i + m_i g + F_i)

    f: force of the body's stress on a vertex, m_i g its weight, F its loads (of the step that ends in the frame), drag and
    inertial forces at its velocity, Q_i: the projector onto the directions in which the support holds it, or, if `support`
    is no name in the scene's `fixed`, all do.
    So in equilibrium the reactions of all supports, the weight, the loads and the forces of obstacles add up to zero where
    supports share no vertices, or hold them in directions perpendicular to each other.
    What obstacles and self-contact do to fixed vertices themselves is not in it (ContactForce has the first,
    SelfContactForce the second), nor is the inertia of vertices that a prescribed motion accelerates. An incompressible
    fluid pushes with what `ChamberPressure` says of it.

    support: which of the fixed vertices, by a vertex set's name, indices, a mask or a list of names; None: all.
        Or a `Tie` of the scene: the force on its surface b, which acts on the vertices there where no support holds them,
        without their inertia. Or vertices that a link of a `Robot` holds: what the link does to them, without their inertia.
    about: the moment [N m] about this point [m] instead: sum (x_i - about) x R_i. per_vertex: of each vertex, ordered as
        `mesh.vertex_indices(support)`. name: how a loss calls it.
    The gradient is exact by all inputs. In single precision a reaction is the small sum of large forces of stress: it has an
    error of some 1e-6 of these.

    Raises ValueError for a support that is not fixed, or for about= and per_vertex=True together.
    Belytschko, Liu, Moran, Nonlinear Finite Elements for Continua and Structures, 2000, sec. 4.4.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], fixed="ymin", precision="f64")
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
            of_robots = [vertices for robot in scene.terms_of(Robot) for _, vertices in robot.holds]
            loose = np.setdiff1d(out.vertices, np.concatenate([scene.held, *of_robots]))
            if len(out.vertices) == 0 or len(loose):
                raise ValueError(
                    f"Reaction: the support must be among the fixed vertices, but {len(loose) or 'all'} of its "
                    f"{len(out.vertices)} vertices are free: fix them (Scene(..., fixed=...)) or name others"
                )
            out.onto = np.tile(np.eye(3), (len(out.vertices), 1, 1))
            if np.isin(out.vertices, scene.held).all():
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


class SectionForce(Output):
    """Force [N] that the body on the side of the normal exerts on the rest of it through a cut, shape (frames, 3).

        F = sum over the cut's vertices a of f_a,    f_a = -sum over the tetrahedra behind it of V P grad N_a

    P: first Piola-Kirchhoff stress. The cut follows faces of tetrahedra: those whose centroid lies beyond the plane at rest
    are behind it, and the vertices that they share with others carry F. So a stretched bar has F along the normal, and in
    equilibrium F is, to rounding, the sum of all other forces on the vertices behind the cut.

    point [m], normal: of the plane in the rest shape. about: the moment [N m] about this point [m] instead, sum of
    (x_a - about) x f_a. name: how a loss calls it. The gradient is exact by all inputs.
    Raises ValueError for a plane that does not cut the body, and for laws that `Stress` does not take.
    Felippa, Park 1997, A direct flexibility method, doi:10.1016/S0045-7825(96)01216-9, on forces of free bodies.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_box((5, 3, 3), size=(0.4, 0.1, 0.1))
    >>> pull = ds.Traction((1e3, 0.0, 0.0), surface="xmax")
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[pull], fixed="xmin", precision="f64")
    >>> cut = ds.SectionForce((0.2, 0.0, 0.0), normal=(1, 0, 0))
    >>> frames = ds.Rollout(ds.StaticSolver(scene), steps=1, outputs=[cut]).forward()
    >>> print(f"{frames['section_force'][-1, 0]:.4f} N")
    10.0000 N
    """

    unit, reads_law_state = "N", True

    def __init__(
        self, point: ArrayLike, normal: ArrayLike, name: str = "section_force", about: ArrayLike | None = None
    ):
        self.name, self.about = name, about
        for key, x in (("point", point), ("normal", normal), ("about", about)):
            if x is not None:
                x = numbers(f"SectionForce: {key}", x)
                if x.shape != (3,) or not np.all(np.isfinite(x)) or (key == "normal" and not x.any()):
                    raise ValueError(f"SectionForce: {key} must be 3 finite numbers, of a normal not all zero, got {x}")
            setattr(self, key, x)

    def settled(self, scene: Scene) -> "SectionForce":
        out, mesh = copy(self), scene.mesh
        behind = (mesh.centroids - self.point) @ self.normal > 0
        here, there = (np.unique(mesh.elements[side]) for side in (behind, ~behind))
        out.vertices = np.intersect1d(here, there)
        if not len(out.vertices):
            raise ValueError(
                f"SectionForce: the plane at {self.point} with normal {self.normal} does not cut the body: no tetrahedra on "
                "both of its sides share a vertex; take a point within the body"
            )
        on_cut = np.isin(mesh.elements, out.vertices)
        out.stress = Stress(kind="first_piola", of=np.flatnonzero(behind & on_cut.any(1))).settled(scene)
        out.law, out.scene = out.stress.stresses, scene
        out.elements, out.num_vertices = mesh.elements[out.stress.chosen], mesh.num_vertices
        out.mask = on_cut[out.stress.chosen].astype(float)
        points = mesh.reference.points
        out.by_xi = mesh.reference.derivatives(points)  # (points, nodes, 3)
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, 3

    def _by_points(self, x: np.ndarray, width: int) -> np.ndarray:
        """Rows of the tetrahedra at the cut, (tetrahedra, points, ...), of arrays of all tetrahedra's."""
        chosen = x[self.stress.chosen]
        return chosen.reshape(len(chosen), -1, *chosen.shape[len(chosen.shape) - width :])

    def _gather(self, f: np.ndarray) -> np.ndarray:
        """Of forces by tetrahedra and nodes, (frames, tetrahedra, nodes, 3), those on the cut's vertices."""
        out = np.zeros((len(f), self.num_vertices, 3))
        np.add.at(out, (slice(None), self.elements), f * self.mask[..., None])
        return out[:, self.vertices]

    def _start(self, frames):
        derived = self.scene.inputs.derive(frames.inputs)
        deformation = Deformation.of(frames, derived, self.scene.mesh, self.stress.read)
        z = self.stress.remembered(frames, self.scene)
        P = self.law.value(deformation.H, z, derived)
        V, B = self._by_points(derived.volumes, 0), self._by_points(derived.gradients, 2)
        P = P.reshape(len(P), *V.shape, 3, 3)
        G = np.einsum("qak,eqkj->eqaj", self.by_xi, B)
        f = self._gather(-np.einsum("eq,feqij,eqaj->feai", V, P, G, optimize=True))
        return derived, deformation, z, P, V, G, f

    def _of(self, frames, f: np.ndarray) -> np.ndarray:
        return f.sum(1) if self.about is None else moments(frames.positions[:, self.vertices], self.about, f)

    def value(self, frames: Frames) -> np.ndarray:
        return self._of(frames, self._start(frames)[-1])

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        derived, deformation, z, P, V, G, f = self._start(frames)
        moved = self.scene.inputs.derive_jvp(frames.inputs, change.inputs)
        dx = np.zeros(frames.positions.shape) if change.positions is None else change.positions
        dH = deformation.jvp(dx - moved.rest, moved.gradients[self.stress.read])
        dz = self.stress.remembered_jvp(change, z)
        dP = self.law.jvp(deformation.H, dH, z, dz, derived, moved).reshape(P.shape)
        dV = self._by_points(moved.volumes, 0)
        dG = np.einsum("qak,eqkj->eqaj", self.by_xi, self._by_points(moved.gradients, 2))
        df = -np.einsum("eq,feqij,eqaj->feai", dV, P, G, optimize=True)
        df -= np.einsum("eq,feqij,eqaj->feai", V, dP, G, optimize=True)
        df = self._gather(df - np.einsum("eq,feqij,eqaj->feai", V, P, dG, optimize=True))
        if self.about is None:
            return df.sum(1)
        at = frames.positions[:, self.vertices]
        return moments_jvp(at, self.about, f, dx[:, self.vertices], df)

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        derived, deformation, z, P, V, G, f = self._start(frames)
        positions, w = np.zeros(frames.positions.shape), np.zeros(frames.positions.shape)
        if self.about is None:
            w[:, self.vertices] = seed[:, None]
        else:
            at = frames.positions[:, self.vertices]
            positions[:, self.vertices], w[:, self.vertices] = moments_vjp(at, self.about, f, seed)
        W = -w[:, self.elements] * self.mask[..., None]
        adjoint = derived.zeros()
        by_V = np.einsum("feqij,eqaj,feai->eq", P, G, W, optimize=True)
        by_P = np.einsum("eq,eqaj,feai->feqij", V, G, W, optimize=True)
        by_G = np.einsum("eq,feqij,feai->eqaj", V, P, W, optimize=True)
        by_B = np.einsum("qak,eqaj->eqkj", self.by_xi, by_G)
        chosen = self.stress.chosen
        np.add.at(adjoint.volumes, chosen, by_V.reshape(-1, *adjoint.volumes.shape[1:]))
        np.add.at(adjoint.gradients, chosen, by_B.reshape(-1, *adjoint.gradients.shape[1:]))
        by_P = by_P.reshape(len(P), -1, 3, 3)
        by_H, by_z = self.law.vjp(deformation.H, z, by_P, derived, adjoint)
        by_u, by_B = deformation.vjp(by_H, self.num_vertices)
        np.add.at(adjoint.gradients, self.stress.read, by_B)
        adjoint.rest = -by_u.sum(0)
        inputs = self.scene.inputs.derive_vjp(frames.inputs, adjoint, tuple(frames.inputs))
        state = self.stress.remembered_vjp(frames, by_z)
        return Change(positions=positions + by_u, inputs=inputs, law_state=state)
