"""What a loss may name besides a run's inputs: functions of its frames, one file each, and their interface for others."""

from diffsim_ti.outputs.contact_force import ContactForce
from diffsim_ti.outputs.material_points import MaterialPoints
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.outputs.reaction import Reaction
from diffsim_ti.outputs.states import Displacements, Positions, Velocities

__all__ = ["Change", "ContactForce", "Displacements", "MaterialPoints", "Output", "Positions", "Reaction", "Velocities"]
