"""From measurements to numbers of a scene, and how well they are known, before and after an experiment."""

from diffsim_ti.identification.expected import Identifiability, compare, expected, identifiability
from diffsim_ti.identification.fit import identify
from diffsim_ti.identification.measurements import Measurement
from diffsim_ti.identification.modal_test import ModalTest
from diffsim_ti.identification.result import Identification, Information, MeshCheck
from diffsim_ti.identification.unknowns import Normal, Smooth, Unknown

__all__ = ["identify", "Unknown", "Measurement", "ModalTest", "Normal", "Smooth", "Identification", "Information"]
__all__ += ["MeshCheck", "expected", "compare", "identifiability", "Identifiability"]
