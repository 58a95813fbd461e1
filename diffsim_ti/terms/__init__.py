"""Loads, contacts, damping, robots: what a user declares."""

from diffsim_ti.terms.chambers import Chamber, FilledChamber, GasChamber
from diffsim_ti.terms.foundation import ElasticFoundation
from diffsim_ti.terms.growth import Growth
from diffsim_ti.terms.lines import Anchor, Cable, Spring
from diffsim_ti.terms.loads import BodyForce, ExternalForce, Load, Pressure, RemoteLoad, Traction
from diffsim_ti.terms.multi_point_constraint import MultiPointConstraint
from diffsim_ti.terms.muscle import Muscle
from diffsim_ti.terms.obstacles.ball import Capsule, Sphere
from diffsim_ti.terms.obstacles.box import Box, Cylinder
from diffsim_ti.terms.obstacles.ground import Ground
from diffsim_ti.terms.obstacles.half_space import HalfSpace
from diffsim_ti.terms.obstacles.mesh_obstacle import MeshObstacle
from diffsim_ti.terms.obstacles.obstacle import Obstacle
from diffsim_ti.terms.pose import Pose
from diffsim_ti.terms.robots.robot import Robot
from diffsim_ti.terms.self_contact import SelfContact
from diffsim_ti.terms.surface_drag import SurfaceDrag
from diffsim_ti.terms.term import Term, VertexForce
from diffsim_ti.terms.tie import Tie
from diffsim_ti.terms.whole_body import Drag, Gravity, RotatingFrame

OBSTACLES = (Ground, HalfSpace, Sphere, Box, Capsule, Cylinder, MeshObstacle)
LOADS = (ExternalForce, Traction, Pressure, BodyForce, GasChamber, FilledChamber, Spring, Cable, Muscle)
LOADS += (Growth, ElasticFoundation, RemoteLoad, MultiPointConstraint)
TERMS = (Gravity, Drag, RotatingFrame, Robot, SurfaceDrag, *LOADS, *OBSTACLES, SelfContact, Tie)
__all__ = ["Anchor", "BodyForce", "Box", "Cable", "Capsule", "Chamber", "Cylinder", "Drag", "ElasticFoundation"]
__all__ += ["ExternalForce", "FilledChamber", "GasChamber", "Gravity", "Ground", "Growth", "HalfSpace", "Load"]
__all__ += ["MeshObstacle", "Muscle", "OBSTACLES", "Obstacle", "Pose", "Pressure", "SelfContact", "Sphere", "Spring"]
__all__ += ["Robot", "RotatingFrame", "SurfaceDrag", "Term", "TERMS", "Tie", "Traction"]
__all__ += ["MultiPointConstraint", "RemoteLoad", "VertexForce"]
