"""c M + d2E/du2 of a body's stress as a sparse matrix."""

import numpy as np

from diffsim_ti.inputs import ConsistentMass, Mass
from diffsim_ti.mechanics.energy.potential import Potential
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.mechanics.stress.projection import between_nodes, summed
from diffsim_ti.mechanics.supports.free import Free, FreeDirections, mask_of, projectors_of
from diffsim_ti.state.arrays import SceneArrays

CHUNK = 2048  # elements whose matrices are made at once


def element_matrices(potential) -> np.ndarray:
    """Stiffness of each element where `potential.blocks` was last called, as (m, nodes, nodes, 3, 3) blocks [N/m]; a patch's
    pressure is held.
    """
    a, (_, N, V) = potential.arrays, potential.stress_points
    count, k = N.shape[:2]
    if a.points == 1:
        out = np.empty((count, k, k, 3, 3))
        for part, C in potential.tangent_chunks(CHUNK):
            out[part] = between_nodes(C, N[part], V[part])
        return out
    C = potential.tangents().reshape(count, 27, 3)
    right = np.matmul(C * V[:, None, None], np.swapaxes(N, 1, 2)).reshape(count, 3, 3, 3, k)
    m, q = a.num_tetrahedra, a.points
    N, right = N.reshape(m, q, k, 3), right.reshape(m, q, 3, 3, 3, k)
    left = np.moveaxis(N, 2, 1).reshape(m, k, 3 * q)
    right = np.moveaxis(right, 3, 2).reshape(m, 3 * q, 9 * k)  # j beside the points
    return np.moveaxis((left @ right).reshape(m, k, 3, 3, k), 4, 2)


def assemble(potential, mass: Mass, free: Free, more=()):
    """(c M + K of the stress where `potential.blocks` was last called, with SciPy matrices `more`, as a block matrix, places
    of its diagonal blocks); what is held keeps a diagonal."""
    from scipy.sparse import bsr_matrix

    n, nodes = potential.arrays.num_vertices, potential.arrays.mesh.elements.astype(np.int64)
    places = (nodes[:, :, None] * n + nodes[:, None, :]).ravel()
    parts = [element_matrices(potential).reshape(-1, 9)]
    if potential.arrays.patches is not None:
        rows, columns, blocks = potential.coupling.entries(potential.patch_gradients())
        places = np.concatenate([places, rows * n + columns])
        parts.append(blocks.reshape(-1, 9))
    if isinstance(mass, ConsistentMass):
        own = (mass.factor * mass.matrix).tocoo()
        places = np.concatenate([places, own.row.astype(np.int64) * n + own.col])
        parts.append((own.data[:, None, None] * np.eye(3)).reshape(-1, 9))
    for matrix in more:
        own = matrix.tobsr((3, 3))
        places = np.concatenate([places, np.repeat(np.arange(n), np.diff(own.indptr)) * n + own.indices])
        parts.append(own.data.reshape(-1, 9))
    each = np.arange(n, dtype=np.int64) * (n + 1)  # also of vertices in no tetrahedron
    places, data = summed(np.concatenate([places, each]), np.concatenate([*parts, np.zeros((n, 9))]))
    rows, columns = places // n, places % n
    is_free, P = mask_of(free)[:, 0] > 0, projectors_of(free)
    data[~(is_free[rows] & is_free[columns])] = 0
    if isinstance(free, FreeDirections):
        data = P[rows] @ data @ P[columns]
    diagonal = np.searchsorted(places, each)
    if not isinstance(mass, ConsistentMass):
        data[diagonal] += mass[:, :, None] * np.eye(3)
    data[diagonal[~is_free]] = np.eye(3) * (np.abs(data).max() or 1.0)
    if isinstance(free, FreeDirections):
        at = diagonal[free.partly_fixed]
        data[at] = P[free.partly_fixed] @ data[at] @ P[free.partly_fixed] + free.sliding_supports * np.abs(data).max()
    start = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])
    return bsr_matrix((data, columns, start), shape=(3 * n, 3 * n)), diagonal


def body_stiffness(scene, displacements: np.ndarray):
    """d2E/du2 [N/m] of stress, springs, cables and foundations at displacements [m], of all vertices alike, as a SciPy CSR
    matrix; what changes over time is that of time 0. Raises ValueError where another force has an energy, and no matrix."""
    arrays, hosts = SceneArrays(scene), host_forces(scene).with_energy
    derived = scene.inputs.derive(scene.inputs.at_times([0.0]))
    arrays.load(derived)
    potential = Potential(arrays, scene.mesh.tetrahedra, False)
    potential.place(displacements)
    potential.blocks()
    n = scene.mesh.num_vertices
    out = assemble(potential, np.zeros((n, 1)), np.ones((n, 1)))[0].tocsr()
    for force in hosts.take(derived):
        matrix = force.matrix(displacements)
        if matrix is None:
            raise ValueError(f"the matrix of {type(force).__name__} is not known: write its `matrix`")
        out = (out + matrix).tocsr()
    return out
