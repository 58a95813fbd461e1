"""Given forces on vertices, among a scene's interactions."""

from functools import cached_property

import numpy as np

from diffsim_ti.inputs.loads import SumOfForces
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.state.corners import slots
from diffsim_ti.terms import BodyForce, ExternalForce, RemoteLoad, Traction


class DeadLoads(Interaction):
    """Forces that do not change with the body, added up; kernels take them as a part of the kick (explicit.py)."""

    name, kinds, works = "dead_loads", (BodyForce, ExternalForce, RemoteLoad, Traction), "loads"
    in_kernels = on_host = False

    @cached_property
    def acts_at(self) -> np.ndarray:
        """Sorted vertices that they act on."""
        return np.unique(np.concatenate([term.indices(self.mesh) for term in self.terms]))

    @property
    def keyed(self) -> bool:
        """Whether some change within steps."""
        return any(term.keyed for term in self.terms)

    @property
    def makes_rows(self) -> bool:
        """Whether they are summed: of a single ExternalForce kernels read the forces as they are given."""
        return len(self.terms) > 1 or not isinstance(self.terms[0], ExternalForce)

    def links_of(self, term, names, own, consistent):
        return term.force_links(names, own, consistent) if self.makes_rows else term.links(names, own)

    def links(self, own):
        if not self.makes_rows:
            return []
        indices = [term.indices(self.mesh) for term in self.terms]
        return [SumOfForces([f"{own[t]} forces" for t in self.terms], indices, self.keyed, "forces")]

    @property
    def topology(self):
        return dict(force_slot=slots(self.acts_at, self.mesh.num_vertices))

    def features(self, values, in_steps):
        return dict(forces=True, forces_keyed=self.keyed, forces_per_step=len(values.forces) > 1)
