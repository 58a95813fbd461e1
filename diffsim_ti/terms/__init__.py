"""Loads, contacts and damping: one per file."""

from diffsim_ti.terms.chambers import Chamber, FilledChamber, GasChamber
from diffsim_ti.terms.drag import Drag
from diffsim_ti.terms.external_force import ExternalForce
from diffsim_ti.terms.gravity import Gravity
from diffsim_ti.terms.loads import BodyForce, Load, Pressure, Traction
from diffsim_ti.terms.obstacles.ball import Capsule, Sphere
from diffsim_ti.terms.obstacles.box import Box, Cylinder
from diffsim_ti.terms.obstacles.ground import Ground
from diffsim_ti.terms.obstacles.half_space import HalfSpace
from diffsim_ti.terms.obstacles.mesh_obstacle import MeshObstacle
from diffsim_ti.terms.obstacles.obstacle import Obstacle
from diffsim_ti.terms.self_contact import SelfContact
from diffsim_ti.terms.term import Term, VertexForce

OBSTACLES = (Ground, HalfSpace, Sphere, Box, Capsule, Cylinder, MeshObstacle)
TERMS = (
    Gravity,
    Drag,
    ExternalForce,
    Traction,
    Pressure,
    BodyForce,
    GasChamber,
    FilledChamber,
    *OBSTACLES,
    SelfContact,
)
__all__ = [
    "BodyForce",
    "Box",
    "Capsule",
    "Chamber",
    "Cylinder",
    "Drag",
    "ExternalForce",
    "FilledChamber",
    "GasChamber",
    "Gravity",
    "Ground",
    "HalfSpace",
    "Load",
    "MeshObstacle",
    "OBSTACLES",
    "Obstacle",
    "Pressure",
    "SelfContact",
    "Sphere",
    "Term",
    "TERMS",
    "Traction",
    "VertexForce",
]
