"""Yeoh's rubber: three numbers that follow the curve of a tensile test to large stretches."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.materials.calculus.tensor import invariants, isochoric
from diffsim_ti.materials.energy_law import EnergyLaw
from diffsim_ti.materials.material import Material, PerTetrahedron


@dataclass(frozen=True)
class YeohLaw(EnergyLaw):
    """psi = c10 i + c20 i^2 + c30 i^3 + K/2 (J - 1)^2, i = J^(-2/3) I_C - 3"""

    coefficient_names = ("c10", "c20", "c30", "bulk_modulus")

    def psi(self, H, p):
        c10, c20, c30, bulk = p
        i, j, _ = isochoric(H)
        return i * (c10 + i * (c20 + i * c30)) + bulk / 2 * j * j

    def theta(self, H):
        return invariants(H)[1]


class Yeoh(Material):
    """psi = c10 i + c20 i^2 + c30 i^3 + K/2 (J - 1)^2 [J/m^3], i = J^(-2/3) I_C - 3.

    `Yeoh(c10, c20, c30, bulk_modulus)` [Pa]: small strains have the shear modulus 2 c10 and the bulk modulus K; c20, often
    negative, softens what follows, c30 > 0 stiffens large stretches. J must stay above 0.
    Yeoh 1993, Some forms of the strain energy function for rubber, doi:10.5254/1.3538343.

    >>> import diffsim_ti as ds
    >>> rubber = ds.Yeoh(c10=2e5, c20=-1e4, c30=500.0, bulk_modulus=1e8)
    >>> mu, lam = rubber.lame(rubber.values(ds.TetrahedralMesh.create_cube(resolution=2)))
    >>> print(f"{mu:.6g} {lam + 2 / 3 * mu:.6g}")
    400000 1e+08
    """

    spellings = (("c10", "c20", "c30", "bulk_modulus"),)
    to_lame = np.array([[2.0, 0, 0, 0], [-4 / 3, 0, 0, 1]])
    positive = dict.fromkeys(("c10", "bulk_modulus"), "a stiffness [Pa]")

    def __init__(self, c10: PerTetrahedron, c20: PerTetrahedron, c30: PerTetrahedron, bulk_modulus: PerTetrahedron):
        super().__init__(c10, c20, c30, bulk_modulus)

    def law(self, precision):
        return YeohLaw(precision)
