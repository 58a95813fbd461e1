"""Kernels of many scenes on a GPU: a thread takes a tetrahedron, then a vertex, of one scene through one pass.

Neighbouring threads take neighbouring scenes, whose numbers are neighbours in memory (layouts.Innermost), so that each load
of a warp is one piece, and what scenes share is read once for all of them. Tetrahedra write forces at corners of their own,
which vertices sum in the order of a single scene; no thread adds to what another one may. The functions are those of a
single scene (explicit/kick_drift.py), by views of it.
"""

from dataclasses import dataclass
from functools import lru_cache

import taichi as ti

from diffsim_ti.batch.block_views import KickDriftOfScenes
from diffsim_ti.batch.views import Column, Item, Shared, Uniform
from diffsim_ti.runtime import Bundle, Kernel, at, let, traced
from diffsim_ti.solvers.explicit.kernels import ExplicitKernels
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import OF_STEPS
from diffsim_ti.state.pass_table import pass_at

SIZES = dict(num_rows="int", num_scenes="int")


@dataclass(frozen=True)
class InnermostKernels(ExplicitKernels):
    """own: names of what scenes may share (kernels.SHARED, and "table") of which each has its own.

    Thread t of a loop takes item or vertex t // B of scene t % B, of B scenes.
    """

    own: frozenset = frozenset()

    # ---- one scene of many: see ExplicitKernels ------------------------------------------------------------------------

    @traced
    def split(self, k, plan) -> tuple:
        return let(k // plan.num_scenes), let(k % plan.num_scenes)

    @traced
    def columns(self, record, names, b, plan) -> dict:
        return {name: Column(getattr(record, name), b, plan.num_scenes) for name in names}

    @traced
    def scene_of(self, b, scene, plan):
        own = {"inverse_mass", "surface", "rest"} & self.own | {"parameters", "corner", *OF_STEPS, *self.items.derived}
        own = [name for name in vars(scene) if name in own]
        return Bundle(**{**vars(scene), **self.columns(scene, own, b, plan)})

    @traced
    def record_of(self, b, record, plan):
        return Bundle(**self.columns(record, vars(record), b, plan))

    @traced
    def numbers_of(self, b, j, table, plan):
        floats = Column(table.floats, b, plan.num_scenes) if "table" in self.own else table.floats
        return pass_at(Bundle(ints=table.ints, floats=floats), let(j - plan.window))

    @traced
    def item(self, e, plan):
        e, b = self.split(e, plan)
        return Item(e=e, b=b, count=plan.num_scenes)

    @traced
    def tetrahedra_of(self, scene, now):
        shape = {
            n: getattr(scene, n) if n in self.own else Shared(array=getattr(scene, n)) for n in ("gradients", "volumes")
        }
        return Bundle(tets=scene.tets, **self.coefficients_of(scene, now), **shape)

    @traced
    def coefficients_of(self, record, now) -> dict:
        out = dict(
            coefficients=Uniform(array=record.coefficients) if self.vertex.features.uniform else record.coefficients
        )
        return out | (dict(growths=record.growths, now=now) if self.vertex.features.growing else {})

    @traced
    def changed(self, tangent, now):
        return Bundle(**{**vars(tangent), **self.coefficients_of(tangent, now)})

    @traced
    def rated(self, b, tangent, plan):
        drag = self.vertex.features.drag
        rate = at(tangent.parameters, drag * plan.num_scenes + b) if drag >= 0 else ti.cast(0, self.vertex.fp)
        return Bundle(**{**vars(plan), "rate_dot": let(rate)})

    @traced
    def after(self, plan):
        """Number of tetrahedra of all scenes, and of what else acts on their bodies."""
        one = let(self.items.after(Bundle(**{**vars(plan), "num_items": 0})))
        return let(plan.num_items + one * plan.num_scenes) if self.items.any else plan.num_items

    @traced
    def num_vertices(self, plan):
        return plan.num_rows

    @traced
    def num_parts(self, plan):
        return plan.num_scenes

    # ---- kernels -------------------------------------------------------------------------------------------------------

    def kernel(self, name: str, body, arrays: dict, numbers: dict, *options) -> Kernel:
        """As of a single scene; numbers of tetrahedra do not lie in blocks."""
        arrays = {
            bundle: {x: kind.replace("blocks", "scalars") for x, kind in own.items()} for bundle, own in arrays.items()
        }
        return super().kernel(f"batch_{name}", body, arrays, numbers | SIZES, *options)


@lru_cache(maxsize=None)
def innermost_kernels(law, features: Features, own: frozenset, repeated: bool) -> InnermostKernels:
    """Kernels for a law, a scene's features, and what each scene has of its own."""
    return InnermostKernels(KickDriftOfScenes(law, features, False), True, repeated, own)
