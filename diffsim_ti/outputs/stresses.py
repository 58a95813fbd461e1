"""First Piola-Kirchhoff stresses at the points of tetrahedra on the host: by each one's law, or by patches."""

import numpy as np

from diffsim_ti.differentiation.arrays import made, summed_at, value_of, with_slopes
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

    def value(self, H, z, derived) -> np.ndarray:
        """P [Pa]; z: what the law remembers, as `Output.remembered` has it."""
        every = at_points(derived.coefficients, self.scene.mesh.num_tetrahedra, self.points)
        return self._stress(H, every[self.read].reshape(-1, every.shape[-1]), z[:, self.read])

    def _stress(self, H, p, z) -> np.ndarray:
        return stress_of(self.law, H.reshape(-1, 3, 3), with_state(p, z)).reshape(H.shape)


class PatchStress(TetrahedronStress):
    """The same with volume="patches": P(H; p') + pi dtheta/dF. It reads all tetrahedra, for a patch's pressure is of all of
    its own."""

    def __init__(self, scene, chosen: np.ndarray):
        super().__init__(scene, chosen)
        self.read = np.arange(scene.mesh.num_tetrahedra)
        self.at = (self.points * chosen[:, None] + np.arange(self.points)).ravel()  # points of those chosen
        self.law = LawOnArrays(scene.law.base)

    def chosen_of(self, x):
        return x[:, self.at]

    def value(self, H, z, derived):
        pressure, kept, _, G = patch_pressure(self.scene, derived, H)
        return self.chosen_of(self._stress(H, kept, z) + pressure[..., None, None] * G)


def with_state(p: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Coefficients of the points beside their state in all frames, (frames points, K + S)."""
    out = np.tile(p, (len(z), 1))
    return np.concatenate([out, z.reshape(len(out), z.shape[-1])], 1)


def stress_of(law: LawOnArrays, H: np.ndarray, p: np.ndarray) -> np.ndarray:
    """P [Pa], shape (m, 3, 3)."""
    h, q, both = value_of(H), value_of(p), np.concatenate([H.reshape(-1, 9), p], 1)

    def pull(seed):
        by_H, by_p = law.vjp(h, seed, q)
        return np.concatenate([by_H.reshape(-1, 9), by_p], 1)

    push = lambda change: law.jvp(h, change[:, :9].reshape(h.shape), q, change[:, 9:])  # noqa: E731
    return made(law.stress(h, q), (both, push, pull))


def patch_pressure(scene, derived, H: np.ndarray) -> tuple[np.ndarray, ...]:
    """What volume="patches" puts in the place of lam theta in each tetrahedron, at displacement gradients H, shape (frames,
    points, 3, 3):

        pi_p = lam_p theta_p,   lam_p = sum V_e lam_e / W_p,   theta_p = sum V_e theta_e / W_p,   W_p = sum V_e

    (pi [Pa], positive in tension, coefficients p' with lam = 0, theta, G = dtheta/dF), so that tetrahedra have the stress
    P(H; p') + pi G and, as their share of the patch's energy, pi theta / 2 per volume
    (mechanics/stress/patched_tetrahedron.py, materials/patch_law.py). Arrays are by frames and the points of all tetrahedra.
    """
    base, points = scene.law.base, scene.mesh.reference.num_points
    law, K, h = LawOnArrays(base), len(base.coefficient_names), value_of(H).reshape(-1, 3, 3)
    theta, G = (x.reshape(shape) for x, shape in zip(law.dilatation(h), (H.shape[:2], H.shape)))
    turned = lambda W: law.dilatation_jvp(h, W.reshape(-1, 3, 3)).reshape(G.shape)  # noqa: E731
    theta, G = with_slopes(theta, (H, lambda: G)), made(G, (H, turned, turned))
    factors = np.array([*base.last_without_lam, *[0.0] * K][:K])  # with lam = 0 the last one is their product with all
    p = np.repeat(np.broadcast_to(derived.coefficients, (scene.mesh.num_tetrahedra, K)), points, 0)
    last, V = p @ factors, derived.volumes.ravel()
    patches = np.repeat(volume_patches(scene.mesh), points)

    def sums(x):  # of each point's patch; the last axis counts points
        rows = x.reshape(-1, len(patches))
        return np.stack([summed_at(patches, row, patches.max() + 1)[patches] for row in rows]).reshape(x.shape)

    pressure = sums(V * (p[:, -1] - last)) * sums(V * theta) / sums(V) ** 2
    return pressure, np.concatenate([p[:, :-1], last[:, None]], 1), theta, G
