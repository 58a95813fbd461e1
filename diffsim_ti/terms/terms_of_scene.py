"""What terms a scene has, by kinds and by names."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms import Chamber, Term


class TermsOfScene:
    """The part of `Scene` that looks terms up. `terms`: as listed, settled; `_given`: as they were given."""

    mesh: TetrahedralMesh
    terms: tuple[Term, ...]
    ordered_terms: tuple[Term, ...]
    _given: tuple[Term, ...]

    @property
    def obstacles(self) -> tuple[Term, ...]:
        """What the surface feels by distance, in the order of frames' contact forces."""
        return tuple(t for t in self.ordered_terms if t.acts_on_surface)

    def place_of(self, obstacle: Term | str) -> int:
        """Place in `obstacles` of one that is given by its name, or as the scene lists it."""
        return self.place_among(self.obstacles, obstacle, "obstacle")

    def term(self, kind: type) -> Term | None:
        """The scene's first term of a kind, or None."""
        return next((t for t in self.terms if isinstance(t, kind)), None)

    def terms_of(self, *kinds: type) -> tuple[Term, ...]:
        """Its terms of each of some kinds, in the order in which kernels go through them."""
        return tuple(t for kind in kinds for t in self.ordered_terms if isinstance(t, kind))

    @property
    def holds_volumes(self) -> bool:
        """Whether some chamber holds a given volume."""
        return any(t.holds for t in self.terms_of(Chamber))

    def place_among(self, own: tuple[Term, ...], asked: Term | str, kind: str) -> int:
        """Place among some of its terms of one that is given by its name, or as the scene lists it."""
        for k, term in enumerate(own):
            if asked is term or asked is self._given[self.terms.index(term)] or asked == (term.name or term):
                return k
        known = ", ".join(repr(t.name or t) for t in own) or "none"
        raise ValueError(f"this scene has no {kind} {asked!r}; it has {known}: give them a name=")

    def chamber_volume(self, chamber: Term | str, positions: ArrayLike | None = None) -> float:
        """Volume [m^3] of a chamber, given by its name or as the scene lists it, at positions [m], default at rest."""
        u, own = (
            None if positions is None else np.asarray(positions, np.float64) - self.mesh.vertices,
            self.terms_of(Chamber),
        )
        enclosure = own[self.place_among(own, chamber, "chamber")].enclosure
        return enclosure.volume(self.mesh.vertices + self.checked_displacements(u))

    def checked_displacements(self, displacements: ArrayLike | None) -> np.ndarray:
        """Displacements from the rest shape [m], shape (num_vertices, 3); None: zero."""
        shape = self.mesh.vertices.shape
        u = np.zeros(shape) if displacements is None else numbers("displacements [m]", displacements)
        if u.shape != shape or not np.all(np.isfinite(u)):
            raise ValueError(f"displacements: expected finite numbers [m] of shape {shape}, got shape {u.shape}")
        return u
