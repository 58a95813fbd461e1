"""First Piola-Kirchhoff stresses at the points of tetrahedra on the host, with derivatives: by each one's law, or by
patches."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.materials.evaluate import LawOnArrays
from diffsim_ti.mesh.patches import volume_patches


def at_points(coefficients: np.ndarray, count: int, points: int) -> np.ndarray:
    """Coefficients at the points of all tetrahedra, shape (count, points, K)."""
    K = coefficients.shape[-1]
    each = coefficients if coefficients.ndim == 3 else np.broadcast_to(coefficients, (count, K))[:, None]
    return np.broadcast_to(each, (count, points, K))


class TetrahedronStress:
    """P at the points of the tetrahedra `chosen`, by frames; `read`: those whose displacement gradients H, shape (frames,
    points, 3, 3), it takes, here the same."""

    def __init__(self, scene, chosen: np.ndarray):
        self.scene, self.chosen, self.read, self.points = scene, chosen, chosen, scene.mesh.reference.num_points
        self.law = LawOnArrays(scene.law)

    def chosen_of(self, x: np.ndarray) -> np.ndarray:
        """Of arrays of the tetrahedra that are read, those that are chosen."""
        return x

    def chosen_vjp(self, x: np.ndarray) -> np.ndarray:
        """Its transpose."""
        return x

    def _coefficients(self, coefficients: np.ndarray) -> np.ndarray:
        """Of the points, (points, K)."""
        every = at_points(coefficients, self.scene.mesh.num_tetrahedra, self.points)
        return every[self.read].reshape(-1, coefficients.shape[-1])

    def _numbers(self, coefficients: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Coefficients and what the law remembers of the points of all frames, (frames points, K + S)."""
        return self._with_state(self._coefficients(coefficients), z[:, self.read])

    @staticmethod
    def _with_state(p: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Coefficients of the points beside their state in all frames."""
        out = np.tile(p, (len(z), 1))
        return np.concatenate([out, z.reshape(len(out), z.shape[-1])], 1)

    def value(self, H, z, derived) -> np.ndarray:
        """P [Pa]; z: what the law remembers, as `Output.remembered` has it."""
        p = self._numbers(derived.coefficients, z)
        return self.law.stress(H.reshape(-1, 3, 3), p).reshape(H.shape)

    def jvp(self, H, dH, z, dz, derived, change) -> np.ndarray:
        """Its change for those of H, of z and of the scene's numbers."""
        p, dp = self._numbers(derived.coefficients, z), self._numbers(change.coefficients, dz)
        return self.law.jvp(H.reshape(-1, 3, 3), dH.reshape(-1, 3, 3), p, dp).reshape(H.shape)

    def vjp(self, H, z, P_adj, derived, adjoint) -> tuple[np.ndarray, np.ndarray]:
        """Adjoints of H and z for that of P; adds those of the scene's numbers."""
        p, z_adj, S = self._numbers(derived.coefficients, z), np.zeros_like(z), z.shape[-1]
        by_H, by_p = self.law.vjp(H.reshape(-1, 3, 3), P_adj.reshape(-1, 3, 3), p)
        by_p, by_z = np.split(by_p, [self.law.K - S], 1)
        for into, rows in zip(z_adj, by_z.reshape(len(z), len(self.read), self.points, S)):
            np.add.at(into, self.read, rows)
        self._add_coefficients(by_p.reshape(len(H), -1, self.law.K - S).sum(0), derived, adjoint)
        return by_H.reshape(H.shape), z_adj

    def _add_coefficients(self, by_p, derived, adjoint) -> None:
        by_p = by_p.reshape(-1, self.points, by_p.shape[-1])
        by_p = by_p if derived.coefficients.ndim == 3 else by_p.sum(1)
        if derived.coefficients.ndim == 1:
            adjoint.coefficients = adjoint.coefficients + by_p.sum(0)
        else:
            np.add.at(adjoint.coefficients, self.read, by_p)


class PatchStress(TetrahedronStress):
    """The same with volume="patches": P(H; p') + pi dtheta/dF. It reads all tetrahedra, for a patch's pressure is of all of
    its own."""

    def __init__(self, scene, chosen: np.ndarray):
        self.scene, self.points = scene, scene.mesh.reference.num_points
        self.chosen, self.read = chosen, np.arange(scene.mesh.num_tetrahedra)
        self.at = (self.points * chosen[:, None] + np.arange(self.points)).ravel()  # points of those chosen
        self.law = LawOnArrays(scene.law.base)

    def chosen_of(self, x):
        return x[:, self.at]

    def chosen_vjp(self, x):
        out = np.zeros((len(x), self.points * len(self.read), *x.shape[2:]))
        for into, rows in zip(out, x):
            np.add.at(into, self.at, rows)
        return out

    def value(self, H, z, derived):
        at = PatchPressure.of(self.scene, derived, H)
        own = self.law.stress(H.reshape(-1, 3, 3), self._with_state(at.kept, z)).reshape(H.shape)
        return self.chosen_of(own + at.value[..., None, None] * at.G)

    def jvp(self, H, dH, z, dz, derived, change):
        at = PatchPressure.of(self.scene, derived, H, dH)
        dp = self._coefficients(change.coefficients)
        p, moved = self._with_state(at.kept, z), self._with_state(at.without_lam(dp), dz)
        own = self.law.jvp(H.reshape(-1, 3, 3), dH.reshape(-1, 3, 3), p, moved).reshape(H.shape)
        dpi = at.jvp(dH, dp, change.volumes.ravel())
        return self.chosen_of(own + dpi[..., None, None] * at.G + at.value[..., None, None] * at.turned)

    def vjp(self, H, z, P_adj, derived, adjoint):
        W = self.chosen_vjp(P_adj)
        at = PatchPressure.of(self.scene, derived, H, W)
        p, S = self._with_state(at.kept, z), z.shape[-1]
        by_H, by_p = self.law.vjp(H.reshape(-1, 3, 3), W.reshape(-1, 3, 3), p)
        by_kept, by_z = np.split(by_p, [self.law.K - S], 1)
        by_theta, by_lam, by_V = at.vjp(at.theta_jvp(W))  # the work of dtheta/dF on W is the adjoint of pi
        by_kept = by_kept.reshape(len(H), -1, self.law.K - S).sum(0)
        self._add_coefficients(at.split_vjp(by_kept, by_lam), derived, adjoint)
        adjoint.volumes = adjoint.volumes + by_V.reshape(adjoint.volumes.shape)
        H_adj = by_H.reshape(H.shape) + at.value[..., None, None] * at.turned + by_theta[..., None, None] * at.G
        return H_adj, by_z.reshape(z.shape)


@dataclass
class PatchPressure:
    """What volume="patches" puts in the place of lam theta in each tetrahedron, at some displacement gradients:

        pi_p = lam_p theta_p,   lam_p = sum V_e lam_e / W_p,   theta_p = sum V_e theta_e / W_p,   W_p = sum V_e

    with G = dtheta/dF and its change `turned` for a change W of F, so that tetrahedra have the stress P(H; p') + pi G and,
    as their share of the patch's energy, pi theta / 2 per volume (mechanics/stress/patched_tetrahedron.py,
    materials/patch_law.py). Arrays are by frames and the points of all tetrahedra.
    """

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
