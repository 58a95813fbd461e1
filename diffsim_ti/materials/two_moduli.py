"""The constructor of materials whose numbers are two moduli of small strains, in either spelling."""

from diffsim_ti.materials.material import Material, PerTetrahedron


class TwoModuli(Material):
    """A material of (E, nu) or of (mu, lam): see `Material`."""

    def __init__(
        self,
        youngs_modulus: PerTetrahedron | None = None,
        poissons_ratio: PerTetrahedron | None = None,
        *,
        E: PerTetrahedron | None = None,
        nu: PerTetrahedron | None = None,
        mu: PerTetrahedron | None = None,
        lam: PerTetrahedron | None = None,
    ):
        super().__init__(youngs_modulus, poissons_ratio, E=E, nu=nu, mu=mu, lam=lam)
