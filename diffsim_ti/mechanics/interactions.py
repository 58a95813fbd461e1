"""The kinds of interactions: a new one is a class in a folder of its own, and a name here."""

from diffsim_ti.mechanics.chambers.interaction import Gases
from diffsim_ti.mechanics.fluid.interaction import FluidDrag
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.mechanics.pressure.interaction import Pressures
from diffsim_ti.mechanics.ties.interaction import Foundations, SpringsAndCables

# in the order in which vertices gather their corners: what is no load comes first
KINDS: tuple[type[Interaction], ...] = SpringsAndCables, Pressures, Gases, FluidDrag, Foundations


def interactions_of(scene) -> tuple[Interaction, ...]:
    """Those of a scene's terms."""
    of_kinds = [(kind, tuple(t for t in scene.ordered_terms if isinstance(t, kind.kinds))) for kind in KINDS]
    return tuple(kind(scene, terms) for kind, terms in of_kinds if terms)
