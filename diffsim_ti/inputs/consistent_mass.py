"""Consistent masses of ten-node tetrahedra, M_ab = integral of rho N_a N_b: what static solves, implicit steps and
modes take.

Lumped masses, which explicit steps divide by, put an element's weight where its stresses cannot carry it evenly: strains of
a hanging bar would fall short by an order. Zienkiewicz, Taylor, Zhu, The Finite Element Method, 6th ed., 16.2.4.
"""

from functools import cached_property

import numpy as np

from diffsim_ti.differentiation.arrays import summed_at
from diffsim_ti.inputs.chain import Link, Recording
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.reference_element import QUADRATIC, quadrature


class ElementMasses(Recording, Link):
    """Of densities and rest positions the masses M_ab of each element [kg], shape (m, 10, 10), by a rule that is exact for
    curved edges too: N_a N_b is of degree four, det dX/dxi a cubic."""

    reads, writes = ("density", "rest_positions"), ("element_masses",)

    def __init__(self, elements: np.ndarray):
        self.elements = elements
        xi, weights = quadrature(7)
        N = QUADRATIC.functions(xi)
        self.by_xi = QUADRATIC.derivatives(xi)
        self.products = np.einsum("q,qa,qb->qab", weights / 6, N, N).reshape(len(xi), 100)

    def value(self, density, X):
        det = np.linalg.det(np.einsum("eai,qak->eqik", X[self.elements], self.by_xi, optimize=True))
        masses = (det @ self.products).reshape(-1, 10, 10)
        return (np.broadcast_to(density, len(masses))[:, None, None] * masses,)


class ConsistentMass:
    """The matrix M of all vertices, or a multiple: `mass * x` is M x for vectors x of the vertices, shape (n, 3), and M 1 g
    for one vector g of all of them. Where each vertex has a mass of its own, an array (n, 1) stands in its place.
    """

    __array_ufunc__ = None  # so that NumPy leaves x * mass to this class

    def __init__(self, matrix, factor: float = 1.0):
        self.matrix, self.factor = matrix, factor

    @classmethod
    def of(cls, mesh: TetrahedralMesh, element_masses: np.ndarray) -> "ConsistentMass":
        """Of all elements together."""
        from scipy.sparse import coo_matrix

        elements, n = mesh.elements, mesh.num_vertices
        rows, columns = np.repeat(elements, elements.shape[1], 1).ravel(), np.tile(elements, elements.shape[1]).ravel()
        return cls(coo_matrix((element_masses.ravel(), (rows, columns)), shape=(n, n)).tocsr())

    def __mul__(self, x):
        if np.ndim(x) == 0:
            return ConsistentMass(self.matrix, self.factor * x)
        return self.factor * (self.row_sums * x if np.ndim(x) == 1 else self.matrix @ x)

    __rmul__ = __mul__

    @cached_property
    def row_sums(self) -> np.ndarray:
        """M 1 of the matrix without its factor, shape (n, 1): the masses that weight acts on; negative at corners."""
        return np.asarray(self.matrix.sum(1)).reshape(-1, 1)

    def blocks(self):
        """The matrix of all unknowns, M times the identity, as a SciPy matrix of 3x3 blocks."""
        from scipy.sparse import bsr_matrix

        M = self.matrix
        data = (self.factor * M.data)[:, None, None] * np.eye(3)
        return bsr_matrix((data, M.indices, M.indptr), shape=(3 * M.shape[0], 3 * M.shape[1]))

    @property
    def diagonal(self) -> np.ndarray:
        """Its diagonal, shape (n, 1)."""
        return self.factor * self.matrix.diagonal()[:, None]


Mass = np.ndarray | ConsistentMass


def consistent(elements: np.ndarray, element_masses: np.ndarray, x: np.ndarray) -> np.ndarray:
    """M x of vectors x of the vertices, shape (n, 3); of arrays that record, too."""
    return summed_at(elements, element_masses @ x[elements], len(x))


def diagonal_of(mass: Mass) -> np.ndarray:
    """What a preconditioner may take in its place, shape (n, 1)."""
    return mass.diagonal if isinstance(mass, ConsistentMass) else mass


def kinetic_energy(mass: Mass, v: np.ndarray) -> float:
    """v . M v / 2 [J]"""
    return 0.5 * float((v * (mass * v)).sum())
