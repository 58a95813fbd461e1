"""Outputs, which losses use like positions: functions of a run's frames, one file each, and their interface for others."""

from diffsim_ti.outputs.center_of_mass import CenterOfMass
from diffsim_ti.outputs.chamber_pressure import ChamberPressure
from diffsim_ti.outputs.contact_force import ContactForce
from diffsim_ti.outputs.contact_slip import ContactSlip
from diffsim_ti.outputs.contact_traction import ContactTraction
from diffsim_ti.outputs.enclosed_volume import EnclosedVolume
from diffsim_ti.outputs.energies import Dissipation, ElasticEnergy, KineticEnergy
from diffsim_ti.outputs.joint_motion import JointPositions, JointVelocities
from diffsim_ti.outputs.lines import Length, Tension
from diffsim_ti.outputs.material_points import MaterialPoints
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.outputs.pixel_tracks import PixelTracks
from diffsim_ti.outputs.plastic_strain import PlasticStrain
from diffsim_ti.outputs.reaction import Reaction
from diffsim_ti.outputs.section_force import SectionForce
from diffsim_ti.outputs.self_contact_force import SelfContactForce
from diffsim_ti.outputs.smooth_maximum import SmoothMaximum
from diffsim_ti.outputs.states import Displacements, Positions, Velocities
from diffsim_ti.outputs.tactile_pad import TactilePad
from diffsim_ti.outputs.tensors import Strain, Stress
from diffsim_ti.outputs.work import WorkOfLoads

__all__ = [
    "CenterOfMass",
    "ChamberPressure",
    "Change",
    "ContactForce",
    "ContactSlip",
    "ContactTraction",
    "Displacements",
]
__all__ += [
    "Dissipation",
    "JointPositions",
    "JointVelocities",
    "PixelTracks",
    "PlasticStrain",
    "SectionForce",
    "SmoothMaximum",
]
__all__ += [
    "ElasticEnergy",
    "EnclosedVolume",
    "KineticEnergy",
    "Length",
    "MaterialPoints",
    "Output",
    "Positions",
    "Reaction",
]
__all__ += ["SelfContactForce", "Strain", "Stress", "TactilePad", "Tension", "Velocities", "WorkOfLoads"]
