"""Outputs, which losses use like positions: functions of a run's frames, and their interface for others."""

from diffsim_ti.outputs.chambers import ChamberPressure, EnclosedVolume
from diffsim_ti.outputs.contact_force import ContactForce
from diffsim_ti.outputs.contact_slip import ContactSlip
from diffsim_ti.outputs.contact_traction import ContactTraction
from diffsim_ti.outputs.energies import Dissipation, ElasticEnergy, KineticEnergy, WorkOfLoads
from diffsim_ti.outputs.joint_motion import JointEfforts, JointPositions, JointVelocities, LinkEnergy, LinkMotion
from diffsim_ti.outputs.lines import Length, Tension
from diffsim_ti.outputs.output import Change, Displacements, Output, Positions, Velocities
from diffsim_ti.outputs.points import CenterOfMass, MaterialPoints, PixelTracks
from diffsim_ti.outputs.reaction import Reaction, SectionForce
from diffsim_ti.outputs.self_contact_force import SelfContactForce
from diffsim_ti.outputs.smooth_maximum import SmoothMaximum
from diffsim_ti.outputs.tactile_pad import TactilePad
from diffsim_ti.outputs.tensors import PlasticStrain, Strain, Stress

__all__ = ["CenterOfMass", "ChamberPressure", "Change", "ContactForce", "ContactSlip", "ContactTraction"]
__all__ += ["Displacements", "Dissipation", "ElasticEnergy", "EnclosedVolume", "JointEfforts", "JointPositions"]
__all__ += ["JointVelocities", "KineticEnergy", "Length", "LinkEnergy", "LinkMotion", "MaterialPoints", "Output"]
__all__ += ["PixelTracks", "PlasticStrain", "Positions", "Reaction", "SectionForce", "SelfContactForce"]
__all__ += ["SmoothMaximum", "Strain", "Stress", "TactilePad", "Tension", "Velocities", "WorkOfLoads"]
