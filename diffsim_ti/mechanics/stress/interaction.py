"""Growth over time, among a scene's interactions."""

from diffsim_ti.inputs.loads import GrowthRows
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.terms import Growth


class Growths(Interaction):
    """They change what tetrahedra take for their rest shape, and act by their stress alone (tetrahedron.py)."""

    name, kinds, works, is_load, makes_rows = "growth", (Growth,), "growth", False, True
    in_kernels = on_host = False

    def links(self, own):
        groups = [(None, None) if t.everywhere else t.groups(self.mesh) for t in self.terms]
        return [GrowthRows([f"{own[t]} in time" for t in self.terms], *zip(*groups), self.mesh.num_tetrahedra)]

    def features(self, values, in_steps):
        rows = values.growths
        return dict(growing=True, growth_per_step=len(rows) > 1 and not in_steps, growth_uniform=rows.shape[2] == 1)
