"""How far vertices of the surface may move before one of them meets an obstacle, and how far from one they are.

A distance d to a solid changes by no more than the way that is gone. So from a place where it is d a point may go on by d,
and again from there: conservative advancement (Mirtich 1996, Impulse-based Dynamic Simulation of Rigid Body Systems, 2.3).
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.obstacles.obstacle_functions import ObstacleFunctions
from diffsim_ti.runtime import A, Kernel, as_kernel, traced
from diffsim_ti.state.numbers import SCENE, needed
from diffsim_ti.state.obstacle_poses import MORE
from diffsim_ti.terms.obstacles import turning

MARCHES = 200  # halts on a way
TINY = 1e-3  # share of the distance, or of the width if that is less: what counts as met

WAY = dict(places="vectors", drifts="vectors", step="vectors2", vertices="ints")
FOUND = dict(found="scalars", blocker="ints")


@dataclass(frozen=True)
class SweptKernels(ObstacleFunctions):
    """Of each vertex: the free `shares` of a step, and `distances`; with the obstacle that they come from."""

    parallel: bool

    def _kernel(self, name: str, body) -> Kernel:
        own = dict(scene=needed(SCENE, self.features), way=WAY, at=dict(u="vectors2"), out=FOUND)
        return Kernel(name, body, self.precision, own, dict(count="int", most="float", kept="float"))

    @ti.func
    def length(self, v):
        return ti.sqrt(v.norm_sqr())

    @ti.func
    def gap(self, g: A, k, i, t, scene: A, way: A, at: A):
        """Distance [m] of vertex i to obstacle k of group g when the share t of the step is done."""
        n, first = g.number + k, g.first + k * g.size
        X, u = scene.rest[i] - way.places[n], at.u[0, i] + t * (way.step[0, i] - way.drifts[n])
        if ti.static(g.force.turns):
            c, q = self.turned.about(g, first, scene.parameters), self.rotation(g, k, t, way)
            X = self.turned.long(c + turning.turned(q, -1, self.turned.short(X) - c, self.fp))
            u = self.turned.long(turning.turned(q, -1, self.turned.short(u), self.fp))
        return g.force.contact_plane(scene.parameters, first, X, u)[3]

    @ti.func
    def rotation(self, g: A, k, t, way: A):
        """Unit quaternion of an obstacle that turns when the share t of the step is done."""
        n = self.place_of_turn(g, k)
        return turning.at_share(self.turned.short(way.places[n]), self.turned.short(way.drifts[n]), t, self.fp)

    @traced
    def place_of_turn(self, g, k):
        return self.num_obstacles + MORE // 3 * (g.turning + k)

    @ti.func
    def speed_of(self, g: A, k, i, most, scene: A, way: A, at: A):
        """What vertex i does not go farther than in the step, as the obstacle sees it [m].

        Of one that turns by psi, w = step - drift and r the arm: |w - psi x r| + most |psi| |w|, for r goes on by w.
        """
        n = g.number + k
        w = way.step[0, i] - way.drifts[n]
        speed = self.length(w)
        if ti.static(g.force.turns):
            c = self.turned.about(g, g.first + k * g.size, scene.parameters)
            r = self.turned.short(scene.rest[i] - way.places[n] + at.u[0, i]) - c
            psi, ahead = self.turned.short(way.drifts[self.place_of_turn(g, k)]), self.turned.short(w)
            speed = self.length(ahead - psi.cross(r)) + most * self.length(psi) * self.length(ahead)
        return speed

    @ti.func
    def share_of_one(self, g: A, k, i, scene: A, way: A, at: A, most, kept):
        """The free share of the step of vertex i before obstacle k of group g; all of it from within. Where the
        obstacle is met, the share `kept` of the distance, or of the width if that is less, is kept."""
        width, none = g.force.width(scene.parameters, g.first + k * g.size), ti.cast(0, self.fp)
        speed = self.speed_of(g, k, i, most, scene, way, at)
        t, free, near, halt, share = none, none, none, none, most
        for m in range(MARCHES):
            left = speed * (most - t)
            d = self.gap(g, k, i, t, scene, way, at)
            if m == 0:
                near = ti.min(d, width)
                halt = ti.cast(TINY, self.fp) * near
                if d <= 0:
                    break
            if d <= 0:  # by rounding
                share = free
                break
            if d > left:
                break
            free = t
            if d <= halt:
                if halt > ti.cast(0.5, self.fp) * kept * near:
                    share = t
                    break
                halt, t, d = kept * near, none, near  # met: go there again, and halt sooner
            t += (d - ti.cast(0.5, self.fp) * halt) / speed
            if t >= most:
                break
            if m == MARCHES - 1:
                share = t
        return share

    @as_kernel("shares")
    def shares(self, scene: A, way: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for j in range(plan.count):
            share, blocker = plan.most, -1
            for g in ti.static(self.features.groups):
                for k in range(g.count):
                    s = self.share_of_one(g, k, way.vertices[j], scene, way, at, plan.most, plan.kept)
                    if s < share:
                        share = s
                        blocker = g.number + k
            out.found[j] = share
            out.blocker[j] = blocker

    # ---- distances ---------------------------------------------------------------------------------------------------

    @as_kernel("distances")
    def distances(self, scene: A, way: A, at: A, out: A, plan: A):
        """Distances below `most`, at the places and displacements given."""
        ti.loop_config(serialize=not self.parallel)
        for j in range(plan.count):
            least, blocker, none = plan.most, -1, ti.cast(0, self.fp)
            for g in ti.static(self.features.groups):
                for k in range(g.count):
                    d = self.gap(g, k, way.vertices[j], none, scene, way, at)
                    if d < least:
                        least = d
                        blocker = g.number + k
            out.found[j] = least
            out.blocker[j] = blocker
