"""Linear elasticity in the frame that rotates with the material."""

from dataclasses import dataclass

from diffsim_ti.materials.calculus.strains import StrainLaw
from diffsim_ti.materials.linear_elastic import LinearElasticLaw as Small
from diffsim_ti.materials.material import TwoModuli


@dataclass(frozen=True)
class CorotatedLaw(StrainLaw):
    """psi = mu q + lam/2 t^2 of eps = S - I."""

    rotates, coefficient_names = True, Small.coefficient_names
    psi, slopes, curvature = Small.psi, Small.slopes, Small.curvature


class Corotated(TwoModuli):
    """psi = mu |S - I|^2 + lam/2 tr(S - I)^2, F = R S [J/m^3]; P = 2 mu (F - R) + lam tr(S - I) R [Pa].

    R is a rotation (det +1) for every F, so that inverted states are pushed back. The stress is finite everywhere; where
    two stretches sum to zero (inverted or rank-one F only) R jumps and the differential, though finite, means nothing.

    Arguments: see `Material`.
    Mueller, Gross 2004, Interactive virtual materials; differential: McAdams et al. 2011, doi:10.1145/2010324.1964932.
    """

    def law(self, precision: str) -> CorotatedLaw:
        return CorotatedLaw(precision)
