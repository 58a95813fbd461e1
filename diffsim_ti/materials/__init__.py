"""Materials, one law per file, over two bases that hold all tensor calculus: invariants and strains."""

from diffsim_ti.materials.calculus.invariants import InvariantLaw
from diffsim_ti.materials.calculus.strains import StrainLaw
from diffsim_ti.materials.calculus.tensor import invariants
from diffsim_ti.materials.corotated import Corotated
from diffsim_ti.materials.energy_law import EnergyLaw
from diffsim_ti.materials.fibre_reinforced import FibreReinforced
from diffsim_ti.materials.gent import Gent
from diffsim_ti.materials.grown import Grown
from diffsim_ti.materials.initial_stress import InitialStress
from diffsim_ti.materials.j2_plasticity import J2Plasticity
from diffsim_ti.materials.kelvin_voigt import KelvinVoigt
from diffsim_ti.materials.law import Law
from diffsim_ti.materials.linear_elastic import LinearElastic
from diffsim_ti.materials.material import Material
from diffsim_ti.materials.measured import Library, Measured, library
from diffsim_ti.materials.mooney_rivlin import MooneyRivlin
from diffsim_ti.materials.ogden import Ogden
from diffsim_ti.materials.orthotropic import Orthotropic
from diffsim_ti.materials.prony import Prony
from diffsim_ti.materials.rubber_fit import fit_rubber
from diffsim_ti.materials.smith_neo_hookean import SmithNeoHookean
from diffsim_ti.materials.st_venant_kirchhoff import StVenantKirchhoff
from diffsim_ti.materials.stable_neo_hookean import StableNeoHookean
from diffsim_ti.materials.tensile_test import TensileTest
from diffsim_ti.materials.yeoh import Yeoh

MATERIALS = (StableNeoHookean, SmithNeoHookean, LinearElastic, Corotated, StVenantKirchhoff, MooneyRivlin)

__all__ = ["MATERIALS", "Corotated", "EnergyLaw", "FibreReinforced", "Gent", "Grown", "InitialStress", "InvariantLaw"]
__all__ += ["J2Plasticity", "KelvinVoigt", "Law", "Library", "LinearElastic", "Material", "Measured", "MooneyRivlin"]
__all__ += ["Ogden", "Orthotropic", "Prony", "SmithNeoHookean", "StVenantKirchhoff", "StableNeoHookean", "StrainLaw"]
__all__ += ["TensileTest", "Yeoh", "fit_rubber", "invariants", "library"]
