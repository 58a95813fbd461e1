"""What holds a body: force and moment of a support, and of a plane cut."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.differentiation.arrays import summed_at
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.outputs.deformation import displacement_gradients
from diffsim_ti.outputs.forces_at_frames import AppliedLoads, BodyForces
from diffsim_ti.outputs.output import Frames, Output, derived, force_or_moment
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

    unit, reads_chamber_pressures, reads_law_state, _shown = "N", True, True, ("support",)

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

    def settled(self, scene: Scene) -> "Reaction":
        out = copy(self)
        if isinstance(self.support, Tie):
            if self.support not in (*scene.terms, *scene.arguments["terms"]):
                raise ValueError(
                    f"Reaction: the scene does not list {self.support!r}; pass the tie that is among its terms"
                )
            out.vertices = self.support.glued_vertices(scene.mesh)
            onto = scene.supports.freedom(scene.mesh.num_vertices)[out.vertices]
        else:
            out.vertices = scene.held if self.support is None else scene.mesh.vertex_indices(self.support)
            of_robots = [vertices for robot in scene.terms_of(Robot) for _, vertices in robot.holds]
            loose = np.setdiff1d(out.vertices, np.concatenate([scene.held, *of_robots]))
            if len(out.vertices) == 0 or len(loose):
                raise ValueError(
                    f"Reaction: the support must be among the fixed vertices, but {len(loose) or 'all'} of its "
                    f"{len(out.vertices)} vertices are free: fix them (Scene(..., fixed=...)) or name others"
                )
            onto = np.tile(np.eye(3), (len(out.vertices), 1, 1))
            if np.isin(out.vertices, scene.held).all():
                onto = scene.supports.projectors(out.vertices, self.support)
        out.scene, out.onto = scene, onto
        out.body, out.loads = BodyForces(scene), AppliedLoads(scene, moving=True)
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames, len(self.vertices), 3) if self.per_vertex else (num_frames, 3)

    def value(self, frames: Frames) -> np.ndarray:
        of = derived(self.scene, frames)
        u, v = (x.astype(np.float64) for x in (frames.displacements, frames.velocities))
        f, held = self.body.at_frames(of, u, v, self.remembered(frames, self.scene)), []
        for k, step in enumerate(frames.steps):
            x, p = frames.positions[k].astype(np.float64), None
            if self.scene.holds_volumes:
                p = frames.chamber_pressures[k]
            both = f[k] + self.loads.forces(of, x, int(step), held=p, v=v[k])
            held.append(-np.einsum("kij,kj->ki", self.onto, both[self.vertices]))
        held = np.stack(held)
        return held if self.per_vertex else force_or_moment(held, frames.positions[:, self.vertices], self.about)


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
        out.scene, out.elements, out.num_vertices = scene, mesh.elements[out.stress.chosen], mesh.num_vertices
        out.mask = on_cut[out.stress.chosen].astype(float)
        points = mesh.reference.points
        out.by_xi = mesh.reference.derivatives(points)  # (points, nodes, 3)
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, 3

    def value(self, frames: Frames) -> np.ndarray:
        of, stress = derived(self.scene, frames), self.stress
        H = displacement_gradients(frames, of, self.scene.mesh, stress.read)
        P = stress.stresses.value(H, stress.remembered(frames, self.scene), of)
        V, B = (x[stress.chosen] for x in (of.volumes, of.gradients))
        V, B = V.reshape(len(V), -1), B.reshape(len(B), -1, 3, 3)
        G = np.einsum("qak,eqkj->eqaj", self.by_xi, B)
        f = -np.einsum("eq,feqij,eqaj->feai", V, P.reshape(len(P), *V.shape, 3, 3), G, optimize=True)
        cut = np.stack([summed_at(self.elements, own, self.num_vertices) for own in f * self.mask[..., None]])
        return force_or_moment(cut[:, self.vertices], frames.positions[:, self.vertices], self.about)
