"""Kernels of many scenes on a GPU: a thread takes a tetrahedron, then a vertex, of one scene through one pass.

Neighbouring threads take neighbouring scenes, whose numbers are neighbours in memory (layouts.Innermost), so that each load
of a warp is one piece, and what scenes share is read once for all of them. Tetrahedra write forces at corners of their own,
which vertices sum in the order of a single scene; no thread adds to what another one may. The functions are those of a
single scene (explicit/kick_drift.py), by views of it.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import taichi as ti

from diffsim_ti.batch.tetrahedra import element_of_scenes
from diffsim_ti.batch.views import Column, ItemOfScene, Shared, Uniform
from diffsim_ti.runtime import Bundle, Kernel, at, let, traced
from diffsim_ti.solvers.explicit.kernels import PLAN, TURNS, ExplicitKernels
from diffsim_ti.solvers.explicit.kick_drift import KickDrift
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import ALONE
from diffsim_ti.state.pass_table import pass_at

STATE = dict.fromkeys(("u", "v", "f", "frames_u", "frames_v", "stage"), "vectors2") | dict(
    seen="scalars2", work="scalars"
)
CHANGE = dict.fromkeys(("u", "v", "frames_u", "frames_v"), "vectors2")
SCENE = dict.fromkeys(("tets", "start", "corner_of", "force_slot", "motion_slot"), "ints")
SCENE |= dict.fromkeys(("gradients", "volumes", "coefficients", "parameters", "inverse_mass", "surface"), "scalars")
SCENE |= dict(rest="vectors", corner="vectors")
OF_STEPS = dict(forces="vectors2", motion="vectors2", path="vectors2", anchor="vectors")
CHANGED = dict.fromkeys(("coefficients", "gradients", "volumes", "mass", "parameters", "surface"), "scalars")
ADJOINT = dict.fromkeys(("coefficients", "gradients", "volumes"), "scalars")
ADJOINT |= dict(corner="vectors", rate_corner="vectors", w="vectors2", sums="scalars2", felt="vectors2")
SIZES = ("num_items", "num_rows", "num_scenes", "num_vertices")
NUMBERS = dict.fromkeys((*SIZES, "window", "first", "count", "base"), "int") | dict(contact_damping="float")


@dataclass(frozen=True)
class KickDriftOfScene(KickDrift):
    """As KickDrift, whose tetrahedra are those of one scene of many, and whose energy nobody follows."""

    counts_work = False

    @cached_property
    def element(self):
        return element_of_scenes(self.law, self.features)


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
        own = [name for name in ("inverse_mass", "surface", "rest") if name in self.own]
        own += ["parameters", "corner", *OF_STEPS, *self.alone]
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
        return ItemOfScene(*self.split(e, plan), plan.num_scenes)

    @traced
    def tetrahedra_of(self, scene, now):
        shape = {n: getattr(scene, n) if n in self.own else Shared(getattr(scene, n)) for n in ("gradients", "volumes")}
        return Bundle(tets=scene.tets, **self.coefficients_of(scene, now), **shape)

    @traced
    def coefficients_of(self, record, now) -> dict:
        out = dict(coefficients=Uniform(record.coefficients) if self.vertex.features.uniform else record.coefficients)
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

    @property
    def growing(self) -> dict:
        return dict(growths="scalars2") if self.vertex.features.growing else {}

    @property
    def alone(self) -> dict:
        """Numbers of springs, cables, muscles and pressures, of which each scene has its own."""
        return {name: kind for name, kind in self.items.arrays.items() if name in ALONE}

    @cached_property
    def step(self) -> Kernel:
        """`count` passes from pass `first` on."""
        return self._kernel("step", self.passes, dict(state=self.with_state(STATE)), self.repeated, stride="int")

    @cached_property
    def step_jvp(self) -> Kernel:
        """The tangent of these passes along recorded slots; the change of the state is advanced in place."""
        tangent = self.with_state(CHANGE) | CHANGED | OF_STEPS | dict(rest="vectors") | self.alone | self.growing
        own = dict(state=self.with_state(STATE), tangent=tangent)
        return self._kernel("step_jvp", self.passes_jvp, own, self.repeated)

    @cached_property
    def step_vjp(self) -> Kernel:
        """The adjoint of passes first + count - 1 .. first; numbers as of a single scene (explicit/kernels.py)."""
        numbers = dict.fromkeys(("halt", "kick", "steps", "num_parts"), "int")
        adjoint = self.with_state(CHANGE) | ADJOINT | OF_STEPS | self.items.adjoint | self.growing
        arrays = dict(state=self.with_state(STATE), adjoint=adjoint)
        return self._kernel("step_vjp", self.passes_vjp, arrays, self.repeated, **numbers)

    @cached_property
    def finish_vjp(self) -> Kernel:
        """Add the gather that the first pass of the run has left."""
        own = dict(scene=dict(start="ints", corner_of="ints"))
        own |= dict(adjoint=dict(u="vectors2", v="vectors2", corner="vectors", rate_corner="vectors"))
        numbers = dict(num_rows="int", num_scenes="int")
        return Kernel("batch_finish_vjp", self.gather_rest, self.vertex.law.precision, own, numbers)

    def with_state(self, arrays: dict) -> dict:
        return arrays | dict(z="scalars2") if self.vertex.law.state_names else arrays

    def _kernel(self, name: str, body, arrays: dict, repeated: bool, **numbers) -> Kernel:
        arrays = dict(scene=SCENE | OF_STEPS | self.items.arrays | self.growing) | arrays | dict(table=PLAN)
        numbers = NUMBERS | numbers | self.items.counts
        if repeated:
            arrays["table"], numbers = PLAN | TURNS, numbers | dict(times="int")
        return Kernel(f"batch_{name}", body, self.vertex.law.precision, arrays, numbers, loops=2 * repeated)


@lru_cache(maxsize=None)
def innermost_kernels(law, features: Features, own: frozenset, repeated: bool) -> InnermostKernels:
    """Kernels for a law, a scene's features, and what each scene has of its own."""
    return InnermostKernels(KickDriftOfScene(law, features, False), True, repeated, own)
