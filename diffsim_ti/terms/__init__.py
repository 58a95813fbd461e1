"""Loads, contacts and damping: one per file."""

from diffsim_ti.terms.drag import Drag
from diffsim_ti.terms.external_force import ExternalForce
from diffsim_ti.terms.gravity import Gravity
from diffsim_ti.terms.ground import Ground
from diffsim_ti.terms.term import Term, VertexForce

TERMS = (Gravity, Drag, Ground, ExternalForce)
__all__ = ["Drag", "ExternalForce", "Gravity", "Ground", "Term", "TERMS", "VertexForce"]
