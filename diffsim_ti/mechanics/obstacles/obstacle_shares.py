"""What each obstacle does to each vertex in an implicit pass, by its barrier and by friction, with all derivatives.

Rows 2 o and 2 o + 1 of `force`, and of its adjoint `seed`, are those of obstacle o. What they depend on is what the
potential's forces do (obstacles.py).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import taichi as ti

from diffsim_ti.mechanics.obstacles.face_kernels import PASS as FACES
from diffsim_ti.mechanics.obstacles.faces import FacePoints
from diffsim_ti.mechanics.obstacles.obstacles import ObstaclePotential
from diffsim_ti.runtime import Kernel
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import ADJOINT, SCENE, TANGENT, needed

A = ti.template()
PASS = dict(poses="vectors", lag="vectors2", pressed="vectors2")
NUMBERS = dict(num_vertices="int", per_gamma="float")


@dataclass(frozen=True)
class ObstacleShares(ObstaclePotential):
    """parallel: loops run on all threads."""

    parallel: bool

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        own = dict(scene=needed(SCENE, self.features), pass_=PASS) | arrays
        return Kernel(name, body, self.precision, own, NUMBERS)

    @ti.func
    def all_forces(self, scene: A, pass_: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            for g in ti.static(self.features.groups):
                for k in range(g.count):
                    row, f, drag = 2 * (g.number + k), self.vector(0), self.vector(0)
                    if scene.surface[i] > 0:
                        f = self.push(g, k, i, at.u[0, i], scene, pass_)
                        if ti.static(g.force.friction):
                            if self.has_friction_at(g, k, i, scene, pass_):
                                drag = self.drag(g, k, i, at.u[0, i], scene, pass_, plan)
                                drag = self.on_friction_area(g, i, drag, scene)
                    out.force[row, i] = f
                    out.force[row + 1, i] = drag

    @cached_property
    def forces(self) -> Kernel:
        """Forces at `at.u`."""
        return self._kernel("obstacle_forces", self.all_forces, at=dict(u="vectors2"), out=dict(force="vectors2"))

    @ti.func
    def all_jvp(self, scene: A, pass_: A, at: A, out: A, tangent: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            for g in ti.static(self.features.groups):
                for k in range(g.count):
                    row, f, drag, u, du = 2 * (g.number + k), self.vector(0), self.vector(0), at.u[0, i], at.w[0, i]
                    if scene.surface[i] > 0:
                        f = self.push_jvp(g, k, i, u, du, scene, pass_, tangent)
                        if ti.static(g.force.friction):
                            if self.has_friction_at(g, k, i, scene, pass_):
                                drag = self.drag_jvp(g, k, i, u, du, scene, pass_, tangent, plan)
                    out.force[row, i] = f
                    out.force[row + 1, i] = drag

    @cached_property
    def jvp(self) -> Kernel:
        """Their change for changes `at.w` of the displacement and of everything else that they depend on."""
        own = dict(at=dict(u="vectors2", w="vectors2"), out=dict(force="vectors2"), tangent=TANGENT | PASS)
        return self._kernel("obstacle_forces_jvp", self.all_jvp, **own)

    @ti.func
    def all_vjp(self, scene: A, pass_: A, at: A, out: A, adjoint: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            y = self.vector(0)
            for g in ti.static(self.features.groups):
                for k in range(g.count):
                    row = 2 * (g.number + k)
                    if scene.surface[i] > 0:
                        y += self.push_vjp(g, k, i, at.u[0, i], at.seed[row, i], scene, pass_, adjoint)
                        if ti.static(g.force.friction):
                            if self.has_friction_at(g, k, i, scene, pass_):
                                y += self.drag_vjp(
                                    g, k, i, at.u[0, i], at.seed[row + 1, i], scene, pass_, adjoint, plan
                                )
            out.y[0, i] = y

    @cached_property
    def vjp(self) -> Kernel:
        """Adjoint y of the displacement; adds those of all else."""
        own = dict(at=dict(u="vectors2", seed="vectors2"), out=dict(y="vectors2"))
        return self._kernel(
            "obstacle_forces_vjp",
            self.all_vjp,
            **own,
            adjoint=ADJOINT | dict(lag="vectors2", poses="vectors2", pressed="vectors2"),
        )


@dataclass(frozen=True)
class FaceShares(FacePoints):
    """What points within faces push with, of one obstacle at a time: number `which`."""

    parallel: bool

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        states = dict(at=dict(u="vectors2", w="vectors2"), out=dict(y="vectors2"))
        own = dict(scene=needed(SCENE, self.features), pass_=FACES) | states | arrays
        return Kernel(name, body, self.precision, own, dict(num_vertices="int", which="int"))

    @ti.func
    def around_which(self, what: A, i, scene: A, pass_: A, at: A, more: A, plan: A):
        """What `around_one` gives of that obstacle."""
        f = self.vector(0)
        for g in ti.static(self.features.groups):
            if ti.static(self.features.reaches(g)):
                k = plan.which - g.number
                if 0 <= k and k < g.count:
                    found = self.around_one(what, g, k, i, scene, pass_, at, more)
                    f = self.with_turn(what, g, k, i, found, scene, pass_, at, more)
        return f

    @ti.func
    def all_forces(self, scene: A, pass_: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.around_which("force", i, scene, pass_, at, at, plan)

    @cached_property
    def forces(self) -> Kernel:
        return self._kernel("face_share", self.all_forces)

    @ti.func
    def all_jvp(self, scene: A, pass_: A, at: A, out: A, tangent: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.around_which("jvp", i, scene, pass_, at, tangent, plan)

    @cached_property
    def jvp(self) -> Kernel:
        return self._kernel("face_share_jvp", self.all_jvp, tangent=TANGENT | dict(poses="vectors"))

    @ti.func
    def all_vjp(self, scene: A, pass_: A, at: A, out: A, adjoint: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            by_u = self.vector(0)
            for g in ti.static(self.features.groups):
                if ti.static(self.features.reaches(g)):
                    k = plan.which - g.number
                    if 0 <= k and k < g.count:
                        by_u = self.around_one("product", g, k, i, scene, pass_, at, at)
                        self.around_one("numbers", g, k, i, scene, pass_, at, adjoint)
                        self.spread(g, k, i, by_u, scene, pass_, at, adjoint)
            out.y[0, i] = by_u

    @cached_property
    def vjp(self) -> Kernel:
        return self._kernel(
            "face_share_vjp", self.all_vjp, adjoint=ADJOINT | dict(poses="vectors2", face_areas="scalars")
        )


@lru_cache(maxsize=None)
def share_kernels(features: Features, precision: str, parallel: bool) -> tuple[ObstacleShares, FaceShares]:
    """Kernels for a scene's features."""
    return ObstacleShares(features, precision, parallel), FaceShares(features, precision, parallel)
