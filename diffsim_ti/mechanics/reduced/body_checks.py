"""What explicit solvers refuse of scenes with bodies of few numbers."""

from typing import TYPE_CHECKING

from diffsim_ti.terms import FilledChamber, MultiPointConstraint, SelfContact

if TYPE_CHECKING:
    from diffsim_ti.scene import Scene


def check_bodies(scene: "Scene", contact: str) -> None:
    """Raise ValueError for what these bodies do not have in explicit steps."""
    said = f"reduced sets ({scene.reduced.describe()})"
    if contact == "stage" and any(term.acts_on_surface for term in scene.terms):
        raise ValueError(
            f"{said} take obstacles as a force in explicit steps, for a stage moves every vertex by itself: pass "
            'contact="force"'
        )
    for kind in (FilledChamber, MultiPointConstraint):
        if scene.term(kind):
            raise ValueError(
                f"{said} and {kind.__name__} do not go together in explicit steps: take an implicit solver"
            )
    rough = [term for term in scene.terms if term.acts_on_surface and term.has_friction]
    if rough and scene.reduced.by_basis:
        raise ValueError(
            f"{said} have no friction in {type(rough[0]).__name__} in explicit steps, which slows every vertex by itself: "
            "leave it out, or take an implicit solver"
        )


def meets_between_vertices(scene: "Scene") -> list:
    """Terms of a scene whose surfaces act by pairs."""
    return [term for term in scene.terms if isinstance(term, SelfContact) or term.primitives is not None]
