"""What kernels of a block of eight scenes hand to functions of tetrahedra, of vertices, and of what else acts on bodies."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.batch.free_vertices import FreeVertices
from diffsim_ti.batch.views import (
    AtVertices,
    Item,
    Scratch,
    Shared,
    TetrahedronOfEight,
    Uniform,
    Vectors,
    View,
    element_of,
)
from diffsim_ti.mechanics.stress.tetrahedron import Onwards
from diffsim_ti.runtime import Bundle, at, let, traced
from diffsim_ti.solvers.explicit.kick_drift import KickDrift
from diffsim_ti.solvers.explicit.vertex_parts import ItemForces
from diffsim_ti.state.features import Features
from diffsim_ti.state.pass_table import pass_at

TABLE = dict(ints="ints", floats="scalars")
# what all scenes may share, and how it lies then
SHARED = dict(gradients="scalars", volumes="scalars", inverse_mass="scalars", rest="vectors", surface="scalars")
OF_STEPS = dict(forces="blocks2", motion="blocks2", path="blocks2", anchor="blocks")


@dataclass(frozen=True)
class KickDriftOfScenes(KickDrift):
    """As KickDrift, whose tetrahedra are those of eight scenes in lanes or of one of many, and whose energy is not
    monitored."""

    counts_work = False

    @cached_property
    def element(self):
        return element_of(self.law, self.features, self.lanes)


@dataclass(frozen=True)
class BlockViews:
    """own: names of what may be shared (SHARED, and "table") of which each scene has its own."""

    law: object
    features: Features
    own: frozenset

    @cached_property
    def vertex(self) -> KickDriftOfScenes:
        return KickDriftOfScenes(self.law, self.features, True)

    @cached_property
    def free(self) -> FreeVertices:
        return FreeVertices(self.law, self.features, self.own)

    @property
    def element(self) -> TetrahedronOfEight:
        return self.vertex.element

    # ---- arrays ------------------------------------------------------------------------------------------------------

    def scene(self) -> dict:
        kinds = {name: "blocks" if name in self.own else kind for name, kind in SHARED.items()}
        lanes = dict.fromkeys(("coefficients", "parameters", "corner"), "blocks") | OF_STEPS
        topology = dict.fromkeys(("tets", "force_slot", "motion_slot", "special"), "ints")
        further = self.items.arrays | self.alone | (dict(vertex_of_corner="ints") if self.items.any else {})
        return topology | kinds | lanes | further | self.growing

    def table(self) -> dict:
        return TABLE | (dict(floats="blocks") if "table" in self.own else {})

    @property
    def growing(self) -> dict:
        return dict(growths="blocks2") if self.features.growing else {}

    def with_state(self, arrays: dict) -> dict:
        return arrays | dict(z="blocks2") if self.law.state_names else arrays

    @property
    def recorded(self) -> dict:
        return dict(impulse="blocks2") if self.features.recorded else {}

    def with_record(self, arrays: dict) -> dict:
        """The same, with the impulses of obstacles where they are recorded."""
        return self.with_state(arrays) | self.recorded

    # ---- what a kernel hands to functions ----------------------------------------------------------------------------

    @traced
    def item(self, e, b, plan):
        return Item(e=e, b=b, vertices=let(3 * b * plan.num_vertices), tetrahedra=let(b * plan.num_tetrahedra))

    @traced
    def tetrahedra_of(self, scene, corner, now):
        """The scene in a pass, for functions of tetrahedra."""
        coefficients = Uniform(array=scene.coefficients) if self.features.uniform else scene.coefficients
        shape = {
            n: getattr(scene, n) if n in self.own else Shared(array=getattr(scene, n)) for n in ("gradients", "volumes")
        }
        own = dict(coefficients=coefficients, corner=Bundle(array=corner, tets=scene.tets)) | self.growth_of(scene, now)
        return Bundle(tets=scene.tets, **own, **shape)

    @traced
    def growth_of(self, record, now) -> dict:
        """What tetrahedra that grow read."""
        return dict(growths=record.growths, now=now) if self.features.growing else {}

    @traced
    def of_tetrahedra(self, scene, adjoint):
        """Adjoints that functions of tetrahedra add to."""
        names = "coefficients", "gradients", "volumes", *self.with_state({}), *self.growing
        corner = Bundle(array=adjoint.rate_corner, tets=scene.tets)
        return Bundle(rate_corner=corner, **{name: getattr(adjoint, name) for name in names})

    @traced
    def onwards(self, now):
        """How the law's state goes on in a pass; one that only kicks leaves it as it is."""
        alpha = at(now.alpha, 0) if in_lanes(now.alpha) else now.alpha
        return Onwards(h=now.h, moves=let(alpha > 0))

    @traced
    def vectors(self, array, first, lane):
        return Vectors(array, let(3 * first), lane, self.vertex.vector, ti.cast(0, self.vertex.fp))

    @traced
    def scene_of(self, b, lane, scene, plan):
        """Scene `lane` of block b, for functions of vertices."""
        n = let(b * plan.num_vertices)
        topology = "force_slot", "motion_slot", *(name for name in self.items.arrays if name not in self.items.derived)
        out = {name: getattr(scene, name) for name in topology} | self.numbers_of(b, lane, scene, plan)
        for name in ("inverse_mass", "surface"):
            out[name] = View(getattr(scene, name), n, lane) if name in self.own else getattr(scene, name)
        out["rest"] = self.vectors(scene.rest, n, lane) if "rest" in self.own else scene.rest
        out["parameters"] = View(scene.parameters, let(b * plan.num_parameters), lane)
        return Bundle(corner=self.vectors(scene.corner, n, lane), **out, **self.of_steps(b, lane, scene, plan))

    @traced
    def of_steps(self, b, lane, record, plan):
        sizes = dict(
            forces=plan.num_loaded, motion=plan.num_held, anchor=plan.num_held, path=max(self.features.moving, 1)
        )
        return {name: self.vectors(getattr(record, name), let(b * size), lane) for name, size in sizes.items()}

    @traced
    def states_of(self, names, b, lane, record, plan):
        n = let(b * plan.num_vertices)
        return {name: self.vectors(getattr(record, name), n, lane) for name in names}

    @traced
    def state_of(self, b, lane, state, plan):
        out = self.states_of(("u", "v", "f", "frames_u", "frames_v", *self.recorded), b, lane, state, plan)
        seen = View(state.seen, let(b * plan.num_vertices), lane)
        return Bundle(seen=seen, stage=Scratch(state.stage, b), work=Scratch(state.work, b), **out)

    @traced
    def change_of(self, b, lane, tangent, plan):
        """The changes of scene `lane`."""
        n = let(b * plan.num_vertices)
        own = {name: View(getattr(tangent, name), n, lane) for name in ("mass", "surface")}
        own["parameters"] = View(tangent.parameters, let(b * plan.num_parameters), lane)
        own["rest"] = self.vectors(tangent.rest, n, lane)
        states = self.states_of(("u", "v", "frames_u", "frames_v", *self.recorded), b, lane, tangent, plan)
        own |= self.numbers_of(b, lane, tangent, plan)
        return Bundle(**own, **states, **self.of_steps(b, lane, tangent, plan))

    @traced
    def adjoint_of(self, b, lane, adjoint, plan):
        """The adjoints of scene `lane`."""
        names = ("u", "v", "w", "frames_u", "frames_v", "path_adjoint", "corner", *self.recorded)
        names += ("rate_corner",) if self.vertex.reads_rates else ()
        states = self.states_of(names, b, lane, adjoint, plan)
        own = self.numbers_of(b, lane, adjoint, plan)
        own["sums"] = View(adjoint.sums, let(b * plan.num_vertices), lane)
        return Bundle(**own, **states, **self.of_steps(b, lane, adjoint, plan))

    @traced
    def pass_of(self, b, j, table, plan):
        """Pass j of the scenes of block b."""
        k = let(j - plan.window)
        return pass_at(table, k, let(b * plan.num_passes_shown + k) if "table" in self.own else None)

    @traced
    def changed_of(self, tangent, now):
        """Changes of what functions of tetrahedra read."""
        own = dict(coefficients=Uniform(array=tangent.coefficients) if self.features.uniform else tangent.coefficients)
        own |= self.growth_of(tangent, now)
        return Bundle(gradients=tangent.gradients, volumes=tangent.volumes, **own)

    @traced
    def rated(self, b, lane, tangent, plan):
        """The numbers of a kernel with the change of a scene's drag rate."""
        drag = self.features.drag
        rate = (
            at(at(tangent.parameters, b * plan.num_parameters + drag), lane) if drag >= 0 else ti.cast(0, self.free.fp)
        )
        return Bundle(**vars(plan), rate_dot=let(rate))

    # ---- what else acts on bodies: springs, cables and muscles, pressures, fluids, foundations -------------------------

    @cached_property
    def items(self) -> ItemForces:
        return ItemForces(self.features)

    @property
    def alone(self) -> dict:
        """Their numbers, of which each scene has its own."""
        return in_blocks(self.items.derived)

    @property
    def lengths(self) -> dict:
        """What kernels take to find them: the length of a row of each."""
        return {f"len_{name}": "int" for name in self.items.derived}

    @traced
    def numbers_of(self, b, lane, record, plan) -> dict:
        """Vectors of which each scene has its own, from a record of the scenes' numbers, changes or adjoints."""
        sizes = {}
        for part in (*self.items.parts, *self.features.at_vertices):
            sizes |= part.sizes(plan)
        there = {name: let(b * size) for name, size in sizes.items() if hasattr(record, name)}
        return {name: self.vectors(getattr(record, name), first, lane) for name, first in there.items()}

    @traced
    def at_vertices(self, array, b, lane, scene, plan):
        first, zero = let(3 * b * plan.num_vertices), ti.cast(0, self.vertex.fp)
        return AtVertices(array, first, lane, self.vertex.vector, zero, scene.vertex_of_corner)

    @traced
    def acted_on(self, b, lane, scene, plan):
        """Scene `lane`, forces at whose corners go to its vertices."""
        corner = self.at_vertices(scene.corner, b, lane, scene, plan)
        return Bundle(**vars(self.scene_of(b, lane, scene, plan)) | dict(corner=corner))

    @traced
    def adjoint_of_acting(self, b, lane, scene, adjoint, plan):
        names = ("corner", "rate_corner") if self.vertex.reads_rates else ("corner",)
        corners = {name: self.at_vertices(getattr(adjoint, name), b, lane, scene, plan) for name in names}
        return Bundle(**vars(self.adjoint_of(b, lane, adjoint, plan)) | corners)


def in_blocks(arrays: dict) -> dict:
    """Kinds of arrays of vectors, of which each scene has its own."""
    return {name: {"vectors": "blocks", "vectors2": "blocks2"}[kind] for name, kind in arrays.items()}


def in_lanes(number) -> bool:
    return not isinstance(number, int) and number.is_tensor()
