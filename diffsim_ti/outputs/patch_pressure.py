"""Pressures of patches on the host: what volume="patches" puts in the place of lam theta in each tetrahedron.

    pi_p = lam_p theta_p,   lam_p = sum V_e lam_e / W_p,   theta_p = sum V_e theta_e / W_p,   W_p = sum V_e

so that tetrahedra have the stress P(H; p') + pi dtheta/dF and, as their share of the patch's energy, pi theta / 2 per volume
(mechanics/stress/patched_tetrahedron.py, materials/patch_law.py). Arrays are by frames and the points of all tetrahedra.
"""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.materials.evaluate import LawOnArrays
from diffsim_ti.mesh.patches import volume_patches


@dataclass
class PatchPressure:
    """pi and theta at some displacement gradients, with G = dtheta/dF and its change `turned` for a change W of F."""

    patches: np.ndarray  # of each point
    factors: np.ndarray  # with lam = 0 the last coefficient is their product with the coefficients
    p: np.ndarray  # the law's coefficients, shape (points, K)
    V: np.ndarray
    theta: np.ndarray
    G: np.ndarray
    turned: np.ndarray

    @classmethod
    def of(cls, scene, derived, H: np.ndarray, W: np.ndarray | None = None) -> "PatchPressure":
        """H, W: shape (frames, points, 3, 3)."""
        law, (h, w) = scene.law.base, (x.reshape(-1, 3, 3) for x in (H, H if W is None else W))
        theta, G = LawOnArrays(law).dilatation(h)
        turned = LawOnArrays(law).dilatation_jvp(h, w)
        K = len(law.coefficient_names)
        factors = np.array([*law.last_without_lam, *[0.0] * K][:K])
        points = scene.mesh.reference.num_points
        p = np.repeat(np.broadcast_to(derived.coefficients, (scene.mesh.num_tetrahedra, K)), points, 0)
        patches = np.repeat(volume_patches(scene.mesh), points)
        shapes = H.shape[:2], H.shape, H.shape
        shaped = (x.reshape(s) for x, s in zip((theta, G, turned), shapes))
        return cls(patches, factors, p, derived.volumes.ravel(), *shaped)

    # ---- what tetrahedra keep, and what their patch takes --------------------------------------------------------------

    @property
    def kept(self) -> np.ndarray:
        """p', the coefficients with lam = 0."""
        return self.without_lam(self.p)

    def without_lam(self, p: np.ndarray) -> np.ndarray:
        """The same of others, or of their changes: it is linear."""
        return np.concatenate([p[:, :-1], (p @ self.factors)[:, None]], 1)

    def _lam(self, p: np.ndarray) -> np.ndarray:
        return p[:, -1] - p @ self.factors

    def split_vjp(self, by_kept: np.ndarray, by_lam: np.ndarray) -> np.ndarray:
        """Adjoint of p, shape (m, K), for those of p' and of lam."""
        out = np.concatenate([by_kept[:, :-1], by_lam[:, None]], 1)
        return out + (by_kept[:, -1] - by_lam)[:, None] * self.factors

    # ---- the pressure --------------------------------------------------------------------------------------------------

    def _sums(self, x: np.ndarray) -> np.ndarray:
        """Of each point's patch; the last axis counts points."""
        rows = x.reshape(-1, x.shape[-1])
        return np.stack([np.bincount(self.patches, row)[self.patches] for row in rows]).reshape(x.shape)

    def _parts(self) -> tuple:
        """(W, sum V lam, sum V theta) of each point's patch"""
        return self._sums(self.V), self._sums(self.V * self._lam(self.p)), self._sums(self.V * self.theta)

    @property
    def value(self) -> np.ndarray:
        """pi [Pa], positive in tension, shape (frames, m)."""
        W, stiff, swollen = self._parts()
        return stiff * swollen / W**2

    def jvp(self, dH: np.ndarray, dp: np.ndarray, dV: np.ndarray) -> np.ndarray:
        """Its change."""
        W, stiff, swollen = self._parts()
        dstiff = self._sums(dV * self._lam(self.p) + self.V * self._lam(dp))
        dswollen = self._sums(dV * self.theta + self.V * self.theta_jvp(dH))
        return (dstiff * swollen + stiff * dswollen) / W**2 - 2 * stiff * swollen * self._sums(dV) / W**3

    def theta_jvp(self, dH: np.ndarray) -> np.ndarray:
        """Change of theta."""
        return (self.G * dH).sum((-1, -2))

    def vjp(self, seed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(adjoints of theta, shape (frames, m), of lam and V, shape (m,)) for that of pi."""
        W, stiff, swollen = self._parts()
        by_pi, lam = self._sums(seed) / W**2, self._lam(self.p)
        by_theta = by_pi * stiff * self.V
        by_lam = (by_pi * swollen).sum(0) * self.V
        by_V = by_pi * (swollen * lam + stiff * self.theta - 2 * stiff * swollen / W)
        return by_theta, by_lam, by_V.sum(0)
