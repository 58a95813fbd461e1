"""diffsim_ti: a soft-body simulator on tetrahedra whose gradients can be trusted. Public names, in reading order."""

import os
import sys
from typing import TYPE_CHECKING

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # read when taichi is imported
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # no network traffic from a simulator

from diffsim_ti.common import deprecated, interrupts

interrupts.guard_import()

import diffsim_ti.runtime  # noqa: F401  before anything imports taichi: it chooses which
from diffsim_ti import notebook  # noqa: F401  gives classes their form there
from diffsim_ti.accuracy.estimate import Accuracy
from diffsim_ti.accuracy.refine import Refined, refine
from diffsim_ti.batch import Batch, BatchFrames
from diffsim_ti.identification import Identification, Measurement, ModalTest, Normal, Smooth, Unknown, compare, expected
from diffsim_ti.identification import identifiability, identify
from diffsim_ti.materials import Corotated, EnergyLaw, FibreReinforced, Gent, Grown, InitialStress, J2Plasticity
from diffsim_ti.materials import KelvinVoigt, LinearElastic, Material, MooneyRivlin, Ogden, Orthotropic, Prony
from diffsim_ti.materials import SmithNeoHookean, StableNeoHookean, StVenantKirchhoff, Yeoh
from diffsim_ti.mechanics.surfaces.surface_pairs import Tunnelling
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.monitor.energy_balance import EnergyGained
from diffsim_ti.monitor.guard import Crossing, Divergence
from diffsim_ti.outputs import CenterOfMass, CenterOfPressure, ChamberPressure, ContactForce, ContactSlip
from diffsim_ti.outputs import ContactTraction, Dissipation, ElasticEnergy, EnclosedVolume, JointEfforts, JointPositions
from diffsim_ti.outputs import JointVelocities, KineticEnergy, Length, LinkEnergy, LinkMotion, MaterialPoints
from diffsim_ti.outputs import PixelTracks, PlasticStrain, Reaction, SectionForce, SelfContactForce, SmoothMaximum
from diffsim_ti.outputs import Strain, Stress, TactilePad, Tension, WorkOfLoads
from diffsim_ti.outputs.load_path import CriticalPoint, LoadPath, load_path
from diffsim_ti.outputs.modes import Modes, modes
from diffsim_ti.rollout import Frames, Rollout
from diffsim_ti.rollout.adaptive_steps import adaptive_steps
from diffsim_ti.rollout.simulator import Simulator
from diffsim_ti.runtime import init
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import BDF2Solver, ImplicitEulerSolver, ImplicitMidpointSolver, NotConverged, SemiImplicitSolver
from diffsim_ti.solvers import StaticSolver, VelocityVerletSolver, stable_dt
from diffsim_ti.state.schedule import UnequalSteps
from diffsim_ti.state.solve_report import Buckled, SolveReport
from diffsim_ti.terms import Anchor, BodyForce, Box, Cable, Capsule, Cylinder, Drag, ElasticFoundation, ExternalForce
from diffsim_ti.terms import FilledChamber, GasChamber, Gravity, Ground, Growth, HalfSpace, MeshObstacle
from diffsim_ti.terms import MultiPointConstraint, Muscle, Pose, Pressure, RemoteLoad, Robot, RotatingFrame, SelfContact
from diffsim_ti.terms import Sphere, Spring, SurfaceDrag, Tie, Traction
from diffsim_ti.torch_bridge.ensemble import Ensemble
from diffsim_ti.verify import check_gradients, dot_product_test, taylor_test

__version__ = "0.2.0"
__all__ = ["init", "TetrahedralMesh", "StableNeoHookean", "SmithNeoHookean", "LinearElastic", "Corotated"]
__all__ += ["StVenantKirchhoff", "MooneyRivlin", "Yeoh", "Gent", "Grown", "InitialStress"]
__all__ += ["Ogden", "Orthotropic", "FibreReinforced", "KelvinVoigt", "J2Plasticity"]
__all__ += ["Prony", "Gravity", "Drag", "ExternalForce", "Traction", "Pressure", "GasChamber", "FilledChamber"]
__all__ += ["BodyForce", "Spring", "Robot", "RotatingFrame", "SurfaceDrag", "Cable", "Anchor", "ElasticFoundation"]
__all__ += ["Growth", "Muscle", "Tie", "Dissipation", "PlasticStrain"]
__all__ += ["SelfContact", "Ground", "HalfSpace", "Sphere", "Box", "Capsule", "Cylinder", "MeshObstacle", "Pose"]
__all__ += ["Scene", "stable_dt", "SemiImplicitSolver", "VelocityVerletSolver", "ImplicitEulerSolver"]
__all__ += ["ImplicitMidpointSolver", "BDF2Solver", "StaticSolver", "Simulator", "Rollout", "Frames", "Batch"]
__all__ += ["BatchFrames", "Ensemble", "UnequalSteps", "adaptive_steps", "SolveReport", "Divergence", "Crossing"]
__all__ += ["Tunnelling", "NotConverged", "EnergyGained", "Buckled", "MaterialPoints", "ContactForce"]
__all__ += ["CenterOfMass", "EnergyLaw", "Material"]
__all__ += ["ContactSlip", "ContactTraction", "Reaction", "SelfContactForce", "Stress", "Strain", "Length", "Tension"]
__all__ += ["JointPositions", "JointVelocities", "JointEfforts", "LinkMotion", "LinkEnergy"]
__all__ += ["PixelTracks", "TactilePad", "CenterOfPressure"]
__all__ += ["EnclosedVolume", "ChamberPressure", "ElasticEnergy", "KineticEnergy", "WorkOfLoads", "modes", "Modes"]
__all__ += ["load_path", "LoadPath", "CriticalPoint", "SectionForce", "SmoothMaximum"]
__all__ += ["RemoteLoad", "MultiPointConstraint"]
__all__ += ["identify", "Unknown", "Measurement", "ModalTest", "Normal", "Smooth", "Identification", "expected"]
__all__ += ["Accuracy", "Refined", "refine", "compare", "identifiability", "taylor_test", "dot_product_test"]
__all__ += ["check_gradients"]

sys.meta_path.append(deprecated.MovedModules())
if TYPE_CHECKING:  # type checkers report old names
    from diffsim_ti.torch_bridge.rollout_node import rollout_frames as rollout_frames
    from diffsim_ti.torch_bridge.simulator import TorchSimulator as TorchSimulator
else:
    __getattr__ = deprecated.package_attribute
