"""Energies of parts of the body."""

from collections.abc import Sequence
from copy import copy
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.inputs import ConsistentMass, Derived
from diffsim_ti.materials.evaluate import evaluate
from diffsim_ti.outputs.deformation import Deformation
from diffsim_ti.outputs.output import Change, Output

if TYPE_CHECKING:
    from diffsim_ti.rollout.frames import Frames
    from diffsim_ti.scene import Scene


class ElasticEnergy(Output):
    """Energy of strain [J], sum over tetrahedra of V psi(F), in each frame; shape (frames,).

    sets: tetrahedron sets, by name, indices or mask, for the energy of each; shape (frames, len(sets)). name: how a loss
    calls it. The gradient is exact by all inputs.
    Raises ValueError for volume="patches", whose pressure is the patch's, and laws with rates or a state.
    Holzapfel, Nonlinear Solid Mechanics, 2000, sec. 6.1.
    """

    def __init__(self, sets: Sequence[str | ArrayLike] | None = None, name: str = "elastic_energy"):
        self.sets, self.name = None if sets is None else list(sets), name

    def settled(self, scene: "Scene") -> "ElasticEnergy":
        law, mesh = scene.law, scene.mesh
        if scene.volume != "tetrahedra" or law.reads != ("H",) or law.state_names:
            raise ValueError(
                f"ElasticEnergy knows laws of the displacement gradient of each tetrahedron, not {type(law).__name__}: take "
                'volume="tetrahedra", or a law without rates and state'
            )
        out = copy(self)
        out.scene, out.law, out.all = scene, law, np.arange(mesh.num_tetrahedra)
        out.masks = np.ones((1, mesh.num_tetrahedra))
        if self.sets is not None:
            out.masks = np.zeros((len(self.sets), mesh.num_tetrahedra))
            for mask, chosen in zip(out.masks, self.sets):
                mask[mesh.tetrahedron_indices(chosen)] = 1
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,) if self.sets is None else (num_frames, len(self.sets))

    def _densities(self, frames):
        """(what kernels read, deformation, psi, P, dpsi/dp), the last three by frames and tetrahedra."""
        derived = self.scene.inputs.derive(frames.inputs)
        deformation = Deformation.of(frames, derived, self.scene.mesh.tetrahedra, self.all)
        F, K = deformation.F, len(self.law.coefficient_names)
        p = np.tile(np.broadcast_to(derived.coefficients, (len(self.all), K)), (len(F), 1))
        psi, P, by = (x.astype(np.float64) for x in evaluate(self.law, F.reshape(-1, 3, 3), p))
        return derived, deformation, psi.reshape(F.shape[:2]), P.reshape(F.shape), by.reshape(*F.shape[:2], K)

    def value(self, frames: "Frames") -> np.ndarray:
        derived, _, psi, *_ = self._densities(frames)
        return ((psi * derived.volumes) @ self.masks.T).reshape(self.shape(len(psi)))

    def jvp(self, frames: "Frames", change: Change) -> np.ndarray:
        derived, deformation, psi, P, by = self._densities(frames)
        moved = self.scene.inputs.derive_jvp(frames.inputs, change.inputs)
        du = (np.zeros(frames.positions.shape) if change.positions is None else change.positions) - moved.rest
        dpsi = (P * deformation.jvp(du, moved.gradients)).sum((2, 3))
        dpsi = dpsi + (by * np.broadcast_to(moved.coefficients, by.shape[1:])).sum(2)
        return ((dpsi * derived.volumes + psi * moved.volumes) @ self.masks.T).reshape(self.shape(len(psi)))

    def vjp(self, frames: "Frames", seed: np.ndarray) -> Change:
        derived, deformation, psi, P, by = self._densities(frames)
        adjoint, weight = derived.zeros(), seed.reshape(len(psi), -1) @ self.masks  # by frames and tetrahedra
        scaled = weight * derived.volumes
        positions, adjoint.gradients = deformation.vjp(scaled[..., None, None] * P, frames.positions.shape[1])
        by_p = (scaled[..., None] * by).sum(0)
        adjoint.coefficients = by_p if derived.coefficients.ndim == 2 else by_p.sum(0)
        adjoint.volumes, adjoint.rest = (weight * psi).sum(0), -positions.sum(0)
        inputs = self.scene.inputs.derive_vjp(frames.inputs, adjoint, tuple(frames.inputs))
        return Change(positions=positions, inputs=inputs)


class KineticEnergy(Output):
    """Energy of motion [J], sum over vertices of m v^2 / 2, in each frame; shape (frames,). Implicit steps of ten-node
    tetrahedra have consistent masses: v . M v / 2, a set having the rows of its vertices.

    sets: vertex sets, by name, indices or mask, for the energy of each; shape (frames, len(sets)). name: how a loss
    calls it.
    The gradient is exact by all inputs. Goldstein, Classical Mechanics, 3rd ed., 2002, sec. 1.2.
    """

    def __init__(self, sets: Sequence[str | ArrayLike] | None = None, name: str = "kinetic_energy"):
        self.sets, self.name = None if sets is None else list(sets), name

    def settled(self, scene: "Scene") -> "KineticEnergy":
        out, mesh = copy(self), scene.mesh
        out.scene, out.masks = scene, np.ones((1, mesh.num_vertices))
        if self.sets is not None:
            out.masks = np.zeros((len(self.sets), mesh.num_vertices))
            for mask, chosen in zip(out.masks, self.sets):
                mask[mesh.vertex_indices(chosen)] = 1
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,) if self.sets is None else (num_frames, len(self.sets))

    def _read(self, frames):
        return frames.velocities.astype(np.float64), self.scene.inputs.derive(frames.inputs)

    def value(self, frames: "Frames") -> np.ndarray:
        v, derived = self._read(frames)
        return self._products(v, v, derived, 0.5).reshape(self.shape(len(v)))

    def _products(self, v: np.ndarray, w: np.ndarray, of: Derived, factor: float) -> np.ndarray:
        """factor v . M w of each frame, of the rows of each set: shape (frames, sets)."""
        if of.element_masses is None:
            return factor * (v * w).sum(2) @ (self.masks * of.mass).T
        M = ConsistentMass.of(self.scene.mesh, of.element_masses)
        return factor * np.stack([(a * (M * b)).sum(1) for a, b in zip(v, w)]) @ self.masks.T

    def jvp(self, frames: "Frames", change: Change) -> np.ndarray:
        v, derived = self._read(frames)
        moved = self.scene.inputs.derive_jvp(frames.inputs, change.inputs)
        dv = np.zeros(v.shape) if change.velocities is None else change.velocities
        half = 0.5 if derived.element_masses is not None else 1.0
        grown = self._products(v, dv, derived, half) + self._products(v, v, moved, 0.5)
        if derived.element_masses is not None:  # neighbours of a set move with it
            grown = grown + self._products(dv, v, derived, half)
        return grown.reshape(self.shape(len(v)))

    def vjp(self, frames: "Frames", seed: np.ndarray) -> Change:
        v, derived = self._read(frames)
        adjoint, weight = derived.zeros(), seed.reshape(len(v), -1) @ self.masks
        if derived.element_masses is None:
            adjoint.mass = 0.5 * (weight * (v**2).sum(2)).sum(0)
            by_v = (weight * derived.mass)[..., None] * v
        else:
            M, by_v = ConsistentMass.of(self.scene.mesh, derived.element_masses), np.zeros(v.shape)
            for k, (a, b) in enumerate(zip(weight[..., None] * v, v)):
                by_v[k] = 0.5 * (weight[k][:, None] * (M * b) + M * a)
                nodes = self.scene.mesh.elements
                adjoint.element_masses += 0.5 * a[nodes] @ np.swapaxes(b[nodes], 1, 2)
        inputs = self.scene.inputs.derive_vjp(frames.inputs, adjoint, tuple(frames.inputs))
        return Change(velocities=by_v, inputs=inputs)
