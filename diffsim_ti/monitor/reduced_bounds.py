"""A bound of the frequencies of sets that move by few numbers."""

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh


def affine_bound(mesh: TetrahedralMesh, volumes: np.ndarray, own: np.ndarray, mu, lam, density) -> float:
    """The largest omega^2 [1/s^2] of elements `own` that move by nine strains together, free of all else: that of

        sum V (lam (tr G)^2 + 2 mu |sym G|^2)    by    sum m |G y|^2

    over all gradients G, the m being the elements' own lumped masses, and y places from their centre.
    """
    volumes = np.asarray(volumes).reshape(len(mesh.elements), -1).sum(1)[own]
    mu, lam, density = (np.broadcast_to(x, len(mesh.elements))[own] for x in (mu, np.maximum(lam, 0), density))
    mass = ((density * volumes)[:, None] * mesh.reference.lumped).ravel()
    y = mesh.vertices[mesh.elements[own].ravel()]
    y = y - mass @ y / mass.sum()
    values, vectors = np.linalg.eigh(np.einsum("n,ni,nj->ij", mass, y, y))
    G = np.einsum("ai,jk->akij", np.eye(3), vectors / np.sqrt(values)).reshape(9, 3, 3)  # orthonormal by mass
    symmetric = 0.5 * (G + np.swapaxes(G, 1, 2))
    trace = np.trace(G, axis1=1, axis2=2)
    K = (volumes @ lam) * np.outer(trace, trace) + 2 * (volumes @ mu) * np.einsum("aij,bij->ab", symmetric, symmetric)
    return float(np.linalg.eigvalsh(K)[-1])
