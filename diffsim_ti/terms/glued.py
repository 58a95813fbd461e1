"""What all ties of a scene leave of the motions of their vertices."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms.reduced import Together
from diffsim_ti.terms.supports import Supports
from diffsim_ti.terms.tie import Tie


@dataclass(frozen=True)
class Glued(Together):
    """The vertices of ties, which move as those do that are free.

    With f the vertices of b that are free and h those that are fixed (at rest, u_h = 0), c the free ones of a:

        C D u_f = C M u_c,    u_f = W u_c,

    C being the identity on f, and of each h its multiplier in equal parts for the neighbours in f: so constants are among
    the multipliers, and constant stress goes through, up to the edge where both parts are fixed. With supports along axes
    this is so of each component.
    matrix: T, sparse, of all components of all vertices, which puts u_f in the place of what it eliminates.
    """

    matrix: object

    @classmethod
    def of(cls, mesh: TetrahedralMesh, ties: Sequence[Tie], supports: Supports, moved: np.ndarray) -> "Glued":
        """moved: vertices with a prescribed motion."""
        D, M, followers = _coupled(mesh, ties)
        own, fixed = (
            np.unique(np.concatenate([followers, np.unique(M.indices)])),
            np.zeros((mesh.num_vertices, 3), bool),
        )
        at = np.isin(supports.vertices, own)
        held = supports.held[at]
        axes = np.round(np.diagonal(held, axis1=1, axis2=2)).astype(bool)
        if held.size and np.abs(held - axes[:, :, None] * np.eye(3)).max() > 1e-9:
            raise ValueError(
                f"{ties[0]!r}: vertices of a tie may be fixed along x, y and z, and here some are fixed along other "
                "directions; fix them along axes, or leave their faces out of the tie"
            )
        driven = np.intersect1d(own, moved)
        if len(driven):
            raise ValueError(
                f"{ties[0]!r}: motion= moves vertex {driven[0]} of a tie, whose fixed vertices have to stay where they are; "
                "move vertices that lie in no glued face"
            )
        fixed[supports.vertices[at]] = axes
        if fixed[own].all():
            raise ValueError(
                f"{ties[0]!r}: all vertices of both surfaces are fixed, which leaves nothing to glue: omit it"
            )
        weights, known = [], {}
        for d in range(3):
            key = fixed[own, d].tobytes()
            if key not in known:
                known[key] = _weights(D, M, followers, fixed[:, d])
            weights.append(known[key])
        vertices = np.unique(np.concatenate([np.concatenate(w[:2]) for w in weights]))
        alike = len(known) == 1
        bases = [_basis(vertices, *w) for w in (weights[:1] if alike else weights)]
        if not alike:
            whole = np.zeros((len(vertices), 3, sum(B.shape[1] for B in bases)))
            first = np.cumsum([0, *(B.shape[1] for B in bases)])
            for d, B in enumerate(bases):
                whole[:, d, first[d] : first[d + 1]] = B
            bases = [whole.reshape(3 * len(vertices), -1)]
        name = ", ".join(t.name or repr(t) for t in ties)
        return cls(name, "tie", vertices, bases[0], _elimination(mesh.num_vertices, weights))


def _coupled(mesh: TetrahedralMesh, ties: Sequence[Tie]):
    """(D, M, vertices of all b)"""
    D, M, owner, leader = 0, 0, {}, {}
    for tie in ties:
        for i in tie.glued_vertices(mesh):
            if int(i) in owner:
                raise ValueError(
                    f"{tie!r}: vertex {i} of b is glued by {owner[int(i)]!r} already; leave the faces out that both have, "
                    "or exchange a and b of one"
                )
            owner[int(i)] = tie
        leader |= dict.fromkeys(np.unique(tie.faces(mesh, tie.a)).tolist(), tie)
        own = tie.mortar(mesh)
        D, M = D + own.D, M + own.M
    for i in owner.keys() & leader.keys():
        raise ValueError(
            f"{leader[i]!r}: vertex {i} of a is in b of {owner[i]!r}, and so follows another surface; exchange a and b of "
            "one, or leave the faces out"
        )
    return D, M, np.array(sorted(owner))


def _weights(D, M, followers: np.ndarray, fixed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(f, c, W) of one component."""
    from scipy.sparse import coo_matrix, identity
    from scipy.sparse.linalg import splu

    free = ~fixed[followers]
    f, h = followers[free], followers[~free]
    c = np.setdiff1d(np.unique(M.indices), np.flatnonzero(fixed))
    C = identity(len(f), format="csr")
    D, M = D[followers][:, f], M[followers][:, c]
    own_D, own_M = D[free], M[free]
    if len(h) and len(f):
        near = D[~free].tocoo()
        count = np.bincount(near.row, minlength=len(h))
        C = coo_matrix((1 / count[near.row], (near.col, near.row)), (len(f), len(h))).tocsr()
        own_D, own_M = own_D + C @ D[~free], own_M + C @ M[~free]
    W = splu(own_D.tocsc()).solve(own_M.toarray()) if len(f) and len(c) else np.zeros((len(f), len(c)))
    return f, c, W


def _basis(vertices: np.ndarray, f: np.ndarray, c: np.ndarray, W: np.ndarray) -> np.ndarray:
    """An orthonormal basis of (u_c, W u_c), rows of vertices."""
    from scipy.linalg import solve_triangular

    B = np.zeros((len(vertices), len(c)))
    B[np.searchsorted(vertices, c), np.arange(len(c))] = 1.0
    B[np.searchsorted(vertices, f)] = W
    L = np.linalg.cholesky(np.eye(len(c)) + W.T @ W)
    return np.ascontiguousarray(solve_triangular(L, B.T, lower=True).T)


def _elimination(n: int, weights: Sequence[tuple]):
    """T, shape (3 n, 3 n)."""
    from scipy.sparse import coo_matrix

    stays, rows, columns, values = np.ones((n, 3)), [], [], []
    for d, (f, c, W) in enumerate(weights):
        stays[f, d] = 0.0
        rows.append(np.repeat(3 * f + d, len(c)))
        columns.append(np.tile(3 * c + d, len(f)))
        values.append(W.ravel())
    at = np.flatnonzero(stays.ravel())
    places = np.concatenate([at, *rows]), np.concatenate([at, *columns])
    return coo_matrix((np.concatenate([np.ones(len(at)), *values]), places), (3 * n, 3 * n)).tocsr()
