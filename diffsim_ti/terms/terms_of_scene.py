"""What terms a scene has: which of them are obstacles, chambers, springs ..., and what they act on."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.paths import Paths
from diffsim_ti.terms import Chamber, Term


class TermsOfScene:
    """The part of `Scene` that looks terms up. `terms`: as listed, settled; `_given`: as they were given."""

    mesh: TetrahedralMesh
    terms: tuple[Term, ...]
    ordered_terms: tuple[Term, ...]
    _given: tuple[Term, ...]
    dead_loads: tuple
    pressures: tuple
    chambers: tuple[Chamber, ...]
    gases: tuple[Chamber, ...]
    ties: tuple
    foundations: tuple

    @property
    def obstacles(self) -> tuple[Term, ...]:
        """What the surface feels by distance, in the order of frames' contact forces."""
        return tuple(t for t in self.ordered_terms if t.acts_on_surface)

    def place_of(self, obstacle: Term | str) -> int:
        """Place in `obstacles` of one that is given by its name, or as the scene lists it."""
        return self._listed(obstacle, self.obstacles, "obstacle")

    def term(self, kind: type) -> Term | None:
        """The scene's first term of a kind, or None."""
        return next((t for t in self.terms if isinstance(t, kind)), None)

    @property
    def loaded_vertices(self) -> np.ndarray:
        """Sorted indices of the vertices that dead loads act on."""
        return np.unique(np.concatenate([np.zeros(0, np.int64), *(t.indices(self.mesh) for t in self.dead_loads)]))

    @property
    def pressed_faces(self) -> tuple[np.ndarray, np.ndarray]:
        """(faces that pressures act on, shape (k, 3) or (k, 6), which of `pressures` each belongs to)."""
        none = self.mesh.surface_faces[:0]
        faces = [none, *(term.faces(self.mesh) for term in self.pressures)]
        return np.concatenate(faces), np.repeat(np.arange(len(faces)) - 1, [len(rows) for rows in faces])

    @property
    def holds_volumes(self) -> bool:
        """Whether some chamber holds a given volume."""
        return len(self.gases) < len(self.chambers)

    def _listed(self, asked: Term | str, own: tuple, kind: str) -> int:
        """Place among some of its terms of one that is given by its name, or as the scene lists it."""
        for k, term in enumerate(own):
            if asked is term or asked is self._given[self.terms.index(term)] or asked == (term.name or term):
                return k
        known = ", ".join(repr(t.name or t) for t in own) or "none"
        raise ValueError(f"this scene has no {kind} {asked!r}; it has {known}: give them a name=")

    def places_of_tie(self, tie: Term | str) -> slice:
        """Places of a spring's or cable's own in `tie_paths`."""
        ends = np.cumsum([0, *(len(own.paths(self.mesh)) for own in self.ties)])
        return slice(*map(int, ends[self._listed(tie, self.ties, "spring or cable") :][:2]))

    def place_of_chamber(self, chamber: Term | str) -> int:
        """Place of one in `chambers`."""
        return self._listed(chamber, self.chambers, "chamber")

    def chamber_volume(self, chamber: Term | str, positions: ArrayLike | None = None) -> float:
        """Volume [m^3] of a chamber, given by its name or as the scene lists it, at positions [m], default at rest."""
        u = None if positions is None else np.asarray(positions, np.float64) - self.mesh.vertices
        own = self.chambers[self.place_of_chamber(chamber)]
        return own.enclosure.volume(self.mesh.vertices + self.checked_displacements(u))

    @property
    def tie_paths(self) -> Paths:
        """Where springs run and, after them, cables."""
        return Paths.joined([term.paths(self.mesh) for term in self.ties])

    @property
    def num_fibres(self) -> int:
        """Number of ties, the last ones, that are fibres of muscles."""
        return sum(len(term.paths(self.mesh)) for term in self.ties if term.of_fibres)

    @property
    def one_sided_ties(self) -> np.ndarray:
        """Of each tie whether it pulls only."""
        return np.concatenate([np.full(len(term.paths(self.mesh)), term.one_sided) for term in self.ties])

    @property
    def given_tensions(self) -> np.ndarray:
        """Of each tie whether it pulls with a tension that is given, however long it is."""
        return np.concatenate([np.full(len(term.paths(self.mesh)), term.by_tension) for term in self.ties])

    @property
    def founded_vertices(self) -> np.ndarray:
        """Sorted indices of the vertices that foundations hold."""
        return np.unique(np.concatenate([np.zeros(0, np.int64), *(t.indices(self.mesh) for t in self.foundations)]))

    def checked_displacements(self, displacements: ArrayLike | None) -> np.ndarray:
        """Displacements from the rest shape [m], shape (num_vertices, 3); None: zero."""
        shape = self.mesh.vertices.shape
        u = np.zeros(shape) if displacements is None else numbers("displacements [m]", displacements)
        if u.shape != shape or not np.all(np.isfinite(u)):
            raise ValueError(f"displacements: expected finite numbers [m] of shape {shape}, got shape {u.shape}")
        return u
