"""Mass added to the few vertices that limit the explicit step of all: how much, and where."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers, shown
from diffsim_ti.inputs.links import LumpedMass
from diffsim_ti.mesh.geometry import inverse_edges, shape_gradients
from diffsim_ti.mesh.patches import volume_patches

if TYPE_CHECKING:
    from scipy.sparse import bsr_matrix

    from diffsim_ti.scene import Scene


@dataclass(frozen=True, eq=False)
class MassScaling:
    """`factors` (num_vertices,) by which vertices are heavier; `share` of the mass that was added; `gain`: how many times
    longer the stable step is. `mass` [kg] (num_vertices,): without what is added; K: `stiffness_at_rest`.

    The body's omega^2 is at most the largest of the rows' |K_ab|, summed over b, by their masses (Gershgorin, in blocks of a
    vertex each). For a limit W the least mass with which no row is beyond it is that of

        f_a = max(1, sum_b |K_ab| / (W m_a)),

    and W is the least for which these add no more than they may. K is that of small strains at rest.
    Olovsson, Simonsson, Unosson 2005, Selective mass scaling for explicit finite element analyses, doi:10.1002/nme.1293.
    """

    factors: np.ndarray
    share: float
    mass: np.ndarray
    K: "bsr_matrix"

    @cached_property
    def gain(self) -> float:
        """By the largest frequencies of small strains at rest, to a thousandth."""
        fast, slow = (largest_eigenvalue(self.K, self.mass * f) for f in (1.0, self.factors))
        return float(np.sqrt(fast / slow)) if slow > 0 else 1.0

    @classmethod
    def of(cls, scene: "Scene", density: ArrayLike, share: float) -> "MassScaling":
        """At most a `share` of the mass, at the material's numbers as they are given. Raises ValueError for a share outside
        (0, 0.2], and for ten-node tetrahedra."""
        mesh, material = scene.mesh, scene.material
        if isinstance(share, str) or not 0 < share <= 0.2:
            raise ValueError(f"mass_scaling must lie in (0, 0.2], got {share}: 0.01 adds at most 1 % of the mass")
        if mesh.order > 1:
            raise ValueError("mass_scaling is for linear tetrahedra: take mesh.linear(), or an implicit solver")
        density = numbers("density", density)
        if density.shape not in ((), (mesh.num_tetrahedra,)) or not np.all(density > 0):
            raise ValueError(f"density must be > 0 [kg/m^3], one number or one per tetrahedron, got {shown(density)}")
        mu, lam = material.lame(material.values(mesh))
        K = stiffness_at_rest(scene, mu, lam, scene.volume == "patches")
        rows = sums_of_rows(K)
        (mass,) = LumpedMass(mesh).value(mesh.volumes, density)
        total, mass = mass.sum(), np.where(mass > 0, mass, 1.0)  # of vertices in no tetrahedron, whose rows are zero
        if not rows.any():  # all is held
            return cls(np.ones(len(mass)), 0.0, mass, K)
        low, high = np.log(rows.max() / total * 1e-6), np.log((rows / mass).max())
        for _ in range(100):
            middle = 0.5 * (low + high)
            beyond = np.maximum(rows / np.exp(middle) - mass, 0).sum() > share * total
            low, high = (middle, high) if beyond else (low, middle)
        factors = np.maximum(rows / np.exp(high) / mass, 1.0)
        factors.setflags(write=False)
        added = float((mass * (factors - 1)).sum() / total)
        return cls(factors, added, mass, K)

    def __str__(self) -> str:
        return (
            f"mass scaling: {self.share:.3%} of the mass added, at {int((self.factors > 1).sum())} vertices; weight and "
            f"reactions grow by it, the stable step by a factor of {self.gain:.3g}"
        )


def row_sums(scene: "Scene", mu, lam, patches: bool) -> np.ndarray:
    """`sums_of_rows` of `stiffness_at_rest`."""
    return sums_of_rows(stiffness_at_rest(scene, mu, lam, patches))


def sums_of_rows(K: "bsr_matrix") -> np.ndarray:
    """sum_b |K_ab| [N/m] of each vertex a, by the spectral norm of blocks."""
    own = np.repeat(np.arange(len(K.indptr) - 1), np.diff(K.indptr))
    return np.bincount(own, np.linalg.norm(K.data, ord=2, axis=(1, 2)), len(K.indptr) - 1)


def largest_eigenvalue(K: "bsr_matrix", mass: np.ndarray) -> float:
    """Of M^-1 K [1/s^2], by Lanczos' method."""
    from scipy.sparse.linalg import LinearOperator, eigsh

    if not K.data.any():  # all is held
        return 0.0
    scale = 1 / np.sqrt(np.repeat(mass, 3))
    A = LinearOperator(K.shape, lambda x: scale * (K @ (scale * x.ravel())), dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(len(scale))
    return float(eigsh(A, 1, which="LA", v0=start, tol=1e-3, return_eigenvectors=False)[0])


def stiffness_at_rest(scene: "Scene", mu, lam, patches: bool) -> "bsr_matrix":
    """The assembled stiffness [N/m] of small strains at rest, in 3 x 3 blocks,

        K_ab = sum_e V [lam N_a (x) N_b + mu N_b (x) N_a + mu (N_a . N_b) 1],  N_a = grad N_a.

    zero where a vertex is fixed wholly, which limits no step, and without elements that lie in a rigid set. A mean over
    patches takes stiffness away from volume changes, so that lam may be that of the stiffest of a patch.
    """
    from scipy.sparse import bsr_matrix

    mesh, tets = scene.mesh, scene.mesh.tetrahedra
    volumes = scene.reduced.with_stress(tets, scene.volume)(mesh.volumes)
    N = shape_gradients(inverse_edges(mesh.vertices, tets))
    if patches and np.ndim(lam):
        own = volume_patches(mesh)
        stiffest = np.full(own.max() + 1, -np.inf)
        np.maximum.at(stiffest, own, lam)
        lam = stiffest[own]
    lam, mu = (volumes * np.broadcast_to(x, volumes.shape) for x in (np.maximum(lam, 0), mu))
    n = mesh.num_vertices
    pairs, place = np.unique(tets[:, :, None] * n + tets[:, None, :], return_inverse=True)
    place, blocks = place.ravel(), np.empty((len(pairs), 3, 3))
    along = mu[:, None, None] * np.einsum("eak,ebk->eab", N, N)
    for i in range(3):
        for j in range(3):
            entry = lam[:, None, None] * N[:, :, None, i] * N[:, None, :, j]
            entry = entry + mu[:, None, None] * N[:, None, :, i] * N[:, :, None, j] + (along if i == j else 0)
            blocks[:, i, j] = np.bincount(place, entry.ravel(), len(pairs))
    free = np.ones(n)
    free[scene.fixed] = 0.0
    blocks *= (free[pairs // n] * free[pairs % n])[:, None, None]
    start = np.concatenate([[0], np.cumsum(np.bincount(pairs // n, minlength=n))])
    return bsr_matrix((blocks, pairs % n, start), shape=(3 * n, 3 * n))
