"""From what users name (E, nu, density, rest shape ...) to what kernels read, with the chain rule both ways."""

from diffsim_ti.inputs.chain import Chain, Link
from diffsim_ti.inputs.consistent_mass import ConsistentMass, Mass, diagonal_of, kinetic_energy
from diffsim_ti.inputs.description import NOT_NEGATIVE, POSITIVE, Input, InputValue, Range, RunSize
from diffsim_ti.inputs.inputs import Derived, DerivedNode, Inputs
from diffsim_ti.inputs.rest_shape import StressPoints, ratios_at_corners

__all__ = ["Chain", "ConsistentMass", "Derived", "RunSize", "Input", "InputValue", "Inputs", "Link", "Mass"]
__all__ += ["NOT_NEGATIVE", "POSITIVE", "Range", "StressPoints", "diagonal_of", "kinetic_energy", "ratios_at_corners"]
__all__ += ["DerivedNode"]
