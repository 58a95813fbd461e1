"""The kinds of interactions: a new one is a class in a folder of its own, and a name here."""

from diffsim_ti.mechanics.chambers.interaction import FilledChambers, Gases
from diffsim_ti.mechanics.constraints import Constraints
from diffsim_ti.mechanics.fluid import FluidDrag
from diffsim_ti.mechanics.host_force import HostForces
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.mechanics.lines.interaction import Foundations, SpringsAndCables
from diffsim_ti.mechanics.loads.interaction import DeadLoads
from diffsim_ti.mechanics.pressure.interaction import Pressures
from diffsim_ti.mechanics.robots import Robots
from diffsim_ti.mechanics.rotating_frame import InertialForces
from diffsim_ti.mechanics.stress.interaction import Growths

# in the order in which vertices gather their corners: what is no load comes first
KINDS: tuple[type[Interaction], ...] = (
    *(SpringsAndCables, Pressures, Gases, FilledChambers, FluidDrag, Foundations, InertialForces, Constraints, Robots),
    *(DeadLoads, Growths),  # which have parts of a step of their own
)
NUMBERS = {name: kind for each in KINDS for name, kind in each.derived.items()}  # arrays that some kind has of its own


def interactions_of(scene) -> tuple[Interaction, ...]:
    """Those of a scene's terms; terms of users bring their own (`Term.interaction`)."""
    found = {kind: scene.terms_of(kind.kinds) for kind in KINDS}
    for term in scene.ordered_terms:
        if term.interaction is not None:
            found[term.interaction] = (*found.get(term.interaction, ()), term)
    return tuple(kind(scene, terms) for kind, terms in found.items() if terms)


def host_forces(scene) -> HostForces:
    """The host forms of a scene's interactions. Raises ValueError where one has none."""
    return HostForces(x.host() for x in scene.interactions if x.on_host)
