"""Kernels of the scenes of a batch as one body: what obstacles have of each, and tetrahedra of scenes that are done."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.batch.free_vertices import Numbers
from diffsim_ti.mechanics.energy.kernels import PotentialKernels
from diffsim_ti.mechanics.obstacles.obstacles import ObstaclePotential
from diffsim_ti.mechanics.obstacles.swept import SweptKernels
from diffsim_ti.runtime import Bundle, Kernel, at, let, traced

A = ti.template()


class SeesOneScene:
    """Functions of obstacles at vertex i, which see the numbers of its scene."""

    @traced
    def seen_at(self, i, scene, *more):
        """The scene of vertex i, and of other records the numbers of that."""
        vertices = scene.scene_of.shape[0] - 1
        b, count = let(at(scene.scene_of, i)), let(at(scene.scene_of, vertices))
        return [self._own(record, b, count) for record in (scene, *more)]

    @traced
    def _own(self, record, b, count):
        there = {name: x for name, x in vars(record).items() if name in ("parameters", "poses", "places", "drifts")}
        own = {name: Numbers(x, let(b * (x.shape[0] // count))) for name, x in there.items()}
        return Bundle(**vars(record) | own)


@dataclass(frozen=True)
class ObstaclesOfScenes(SeesOneScene, ObstaclePotential):
    @cached_property
    def one(self) -> ObstaclePotential:
        return ObstaclePotential(self.features, self.precision)

    @traced
    def total_energy(self, i, u, scene, pass_, plan, rough):
        scene, pass_ = self.seen_at(i, scene, pass_)
        return self.one.total_energy(i, u, scene, pass_, plan, rough)

    @traced
    def total_force(self, i, u, scene, pass_, plan):
        scene, pass_ = self.seen_at(i, scene, pass_)
        return self.one.total_force(i, u, scene, pass_, plan)

    @traced
    def total_product(self, i, u, w, scene, pass_, plan, rough):
        scene, pass_ = self.seen_at(i, scene, pass_)
        return self.one.total_product(i, u, w, scene, pass_, plan, rough)

    @traced
    def add_vjp(self, i, f, u, w, scene, pass_, adjoint, plan):
        scene, pass_ = self.seen_at(i, scene, pass_)
        return self.one.add_vjp(i, f, u, w, scene, pass_, adjoint, plan)


@dataclass(frozen=True)
class JoinedKernels(PotentialKernels):
    """skip: 1 of a scene whose products are not wanted."""

    @cached_property
    def obstacles(self) -> ObstaclesOfScenes:
        return ObstaclesOfScenes(self.features, self.law.precision)

    def _kernel(self, name, body, reads_law=True, **arrays):
        kernel = super()._kernel(name, body, reads_law, **arrays)
        own = kernel.arrays | dict(scene=kernel.arrays["scene"] | dict(scene_of="ints"))
        return Kernel(name, body, self.law.precision, own, {n: kernel.kinds[n] for n in kernel.numbers})

    @ti.func
    def is_wanted(self, at: A, plan: A):
        return at.skip[0] == 0

    @cached_property
    def wanted(self) -> Kernel:
        """Whether a scene is, for `Piecewise`."""
        return Kernel("wanted", self.is_wanted, self.law.precision, dict(at=dict(skip="ints")), {})

    @ti.func
    def products(self, scene: A, pass_: A, at: A, out: A, plan: A):
        items = plan.num_items // at.skip.shape[0]
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            if at.skip[e // items] == 0:
                self.element.stiffness(e, scene, at, 0, scene.corner)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            if at.skip[scene.scene_of[i]] == 0:
                f = self.element.gather(i, scene, scene.corner)
                if self.meets_obstacles(i, scene):
                    f += self.obstacles.total_product(i, at.u[0, i], at.w[0, i], scene, pass_, plan, True)
                out.y[0, i] = f

    @cached_property
    def product(self) -> Kernel:
        own = dict(at=dict(u="vectors2", w="vectors2", skip="ints"), out=dict(y="vectors2"))
        return self._kernel("product", self.products, **own)


@dataclass(frozen=True)
class SweptOfScenes(SeesOneScene, SweptKernels):
    @cached_property
    def one(self) -> SweptKernels:
        return SweptKernels(self.features, self.precision, self.parallel)

    def _kernel(self, name, body):
        kernel = super()._kernel(name, body)
        own = kernel.arrays | dict(scene=kernel.arrays["scene"] | dict(scene_of="ints"))
        return Kernel(name, body, self.precision, own, {n: kernel.kinds[n] for n in kernel.numbers})

    @traced
    def share_of_one(self, g, k, i, scene, way, at, most, kept):
        scene, way = self.seen_at(i, scene, way)
        return self.one.share_of_one(g, k, i, scene, way, at, most, kept)

    @traced
    def gap(self, g, k, i, t, scene, way, at):
        scene, way = self.seen_at(i, scene, way)
        return self.one.gap(g, k, i, t, scene, way, at)
