"""Force and moment that a body carries through a plane cut."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.outputs.deformation import Deformation
from diffsim_ti.outputs.frames import Frames
from diffsim_ti.outputs.moments import moments, moments_jvp, moments_vjp
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.outputs.tensors import Stress
from diffsim_ti.scene import Scene


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
