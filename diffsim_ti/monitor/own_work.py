"""What steps add to the energy of a run by themselves, apart from all that is done to it: the drift of a scheme.

Kinetic energy T changes by the work W of the body's own forces, strains, weight and springs, and by that of
all else: loads, supports, friction, drag, contact stages. The own forces have an energy V, and dV + W, which vanishes as
steps become short, is the scheme's own. What is left of a change of the whole energy was done from outside, or taken.
"""

import weakref

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.workspace import Workspace
from diffsim_ti.monitor import quantities
from diffsim_ti.terms import Growth


class OwnWork:
    """Follows the drift of explicit steps; `drift` [J] is that since the last `begin`."""

    def __init__(self, workspace: Workspace):
        self.ws = weakref.proxy(workspace)  # which holds this: no circle
        self.begin()

    @staticmethod
    def serves(workspace: Workspace) -> bool:
        """Whether the forces of a scene are those of an energy that does not change with time, at each vertex by itself."""
        scene, law = workspace.scene, workspace.arrays.law
        energetic = law.reads == ("H",) and not law.state_names and not scene.term(Growth)
        return energetic and not (scene.reduced or workspace.arrays.features().pressing or workspace.has_unnoted_work)

    def begin(self) -> None:
        """From the present state on."""
        runtime.fill(self.ws.contact.own_work, 0)
        self._energy = self._own_energy()

    def take(self) -> float:
        """The drift [J] since the last call, or `begin`."""
        before, work = self._energy, float(runtime.fetch(self.ws.contact.own_work).astype(np.float64).sum())
        self.begin()
        return self._energy - before + work

    def _own_energy(self) -> float:
        """V [J]; the weight of fixed vertices is carried by what holds them."""
        ws, a = self.ws, self.ws.arrays
        out = quantities.elastic_energy(ws) + sum(quantities.stored_energies(ws).values())
        at = a.features().gravity
        if at >= 0:
            mass = a.values.mass * (runtime.fetch(a.inverse_mass) > 0)
            u = runtime.fetch_row(ws.state.u, 0).astype(np.float64)
            out -= float((mass[:, None] * a.values.parameters[at:][:3] * (a.values.rest + u)).sum())
        return out
