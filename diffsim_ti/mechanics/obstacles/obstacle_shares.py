"""What each obstacle does to each vertex in an implicit pass, by its barrier and by friction, with all derivatives.

Rows 2 o and 2 o + 1 of `force`, and of its adjoint `seed`, are those of obstacle o. What they depend on is what the
potential's forces do (obstacles.py).
"""

from dataclasses import dataclass
from functools import lru_cache

import taichi as ti

from diffsim_ti.mechanics.obstacles.obstacles import ObstaclePotential
from diffsim_ti.runtime import A, Kernel, as_kernel, traced
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import ADJOINT, SCENE, TANGENT, needed

PASS = dict(poses="vectors", lag="vectors2")
NUMBERS = dict(num_vertices="int", per_gamma="float")


@dataclass(frozen=True)
class ObstacleShares(ObstaclePotential):
    """parallel: loops run on all threads."""

    parallel: bool

    @traced
    def seen_at(self, i, scene, pass_):
        """What vertex i sees of them (batch/joined_potential.py)."""
        return scene, pass_

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        own = dict(scene=needed(SCENE, self.features), pass_=PASS) | arrays
        return Kernel(name, body, self.precision, own, NUMBERS)

    @as_kernel("obstacle_forces", at=dict(u="vectors2"), out=dict(force="vectors2"))
    def forces(self, scene: A, pass_: A, at: A, out: A, plan: A):
        """Forces at `at.u`."""
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            own, told = self.seen_at(i, scene, pass_)
            for g in ti.static(self.features.groups):
                for k in range(g.count):
                    row, f, drag = 2 * (g.number + k), self.vector(0), self.vector(0)
                    if scene.surface[i] > 0:
                        f = self.push(g, k, i, at.u[0, i], own, told)
                        if ti.static(g.force.friction):
                            if self.has_friction_at(g, k, i, own, told):
                                drag = self.drag(g, k, i, at.u[0, i], own, told, plan)
                                drag = self.on_area(g, i, drag, own)
                    out.force[row, i] = f
                    out.force[row + 1, i] = drag

    @as_kernel(
        "obstacle_forces_jvp", at=dict(u="vectors2", w="vectors2"), out=dict(force="vectors2"), tangent=TANGENT | PASS
    )
    def jvp(self, scene: A, pass_: A, at: A, out: A, tangent: A, plan: A):
        """Their change for changes `at.w` of the displacement and of everything else that they depend on."""
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

    @as_kernel(
        "obstacle_forces_vjp",
        at=dict(u="vectors2", seed="vectors2"),
        out=dict(y="vectors2"),
        adjoint=ADJOINT | dict(lag="vectors2", poses="vectors2"),
    )
    def vjp(self, scene: A, pass_: A, at: A, out: A, adjoint: A, plan: A):
        """Adjoint y of the displacement; adds those of all else."""
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            own, told = self.seen_at(i, scene, pass_)
            y = self.vector(0)
            for g in ti.static(self.features.groups):
                for k in range(g.count):
                    row = 2 * (g.number + k)
                    if scene.surface[i] > 0:
                        y += self.push_vjp(g, k, i, at.u[0, i], at.seed[row, i], own, told, adjoint)
                        if ti.static(g.force.friction):
                            if self.has_friction_at(g, k, i, own, told):
                                y += self.drag_vjp(g, k, i, at.u[0, i], at.seed[row + 1, i], own, told, adjoint, plan)
            out.y[0, i] = y


@lru_cache(maxsize=None)
def share_kernels(kind: type[ObstacleShares], features: Features, precision: str, parallel: bool) -> ObstacleShares:
    """Kernels for a scene's features."""
    return kind(features, precision, parallel)
