"""Outputs, which losses use like positions: functions of a run's frames, and their interface for others."""

from diffsim_ti.outputs.chambers import ChamberPressure, EnclosedVolume
from diffsim_ti.outputs.contact_force import CenterOfPressure, ContactForce
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

__all__ = ["CenterOfMass", "CenterOfPressure", "ChamberPressure", "Change", "ContactForce", "ContactSlip"]
__all__ += ["ContactTraction", "Displacements", "Dissipation", "ElasticEnergy", "EnclosedVolume", "JointEfforts"]
__all__ += ["JointPositions", "JointVelocities", "KineticEnergy", "Length", "LinkEnergy", "LinkMotion"]
__all__ += ["MaterialPoints", "Output", "PixelTracks", "PlasticStrain", "Positions", "Reaction", "SectionForce"]
__all__ += ["SelfContactForce", "SmoothMaximum", "Strain", "Stress", "TactilePad", "Tension", "Velocities"]
__all__ += ["WorkOfLoads"]
