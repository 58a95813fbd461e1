"""Vertices that are fixed in some directions only, in explicit passes: what they may do, and what holds them.

`sliding_slot` says which of them a vertex is, -1 none; `sliding_supports` has three rows each of the projector Q onto
what is held.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import A, vector_type

SLIDING_SUPPORTS = dict(sliding_slot="ints", sliding_supports="vectors")


@dataclass(frozen=True)
class SlidingSupports:
    """Functions of one vertex i. Those that are fixed wholly have no mass (SceneArrays) and, if they move, a place k >= 0 in
    the prescribed motion."""

    precision: str
    motion: bool

    vector = vector_type

    @ti.func
    def held(self, i, x, scene: A):
        """What is held of a vector, none where a vertex is free, or fixed wholly."""
        out, g = self.vector(0), scene.sliding_slot[i]
        if g >= 0:
            for d in ti.static(range(3)):
                out[d] = scene.sliding_supports[3 * g + d].dot(x)
        return out

    @ti.func
    def free(self, i, x, scene: A):
        """The rest of it."""
        return x - self.held(i, x, scene)

    @ti.func
    def given(self, k, u, v, now: A, of: A):
        """Displacement and velocity of what is held at the end of a pass; of: the scene, or its tangent."""
        u_prescribed, v_prescribed = u, v
        if ti.static(self.motion):
            if k >= 0 and now.alpha > 0:
                change = of.motion[now.next, k] - of.motion[now.row, k]
                u_prescribed = of.anchor[k] + of.motion[now.row, k] + now.end * change
                v_prescribed = now.per_step * change
        return u_prescribed, v_prescribed

    @ti.func
    def end(self, i, k, x, x_prescribed, scene: A):
        """x in what vertex i may do, x_prescribed in the rest."""
        out = x + self.held(i, x_prescribed - x, scene)
        if k >= 0 and scene.sliding_slot[i] < 0:
            out = x_prescribed
        return out

    @ti.func
    def of_held(self, i, k, x, scene: A):
        """What of an adjoint of the end belongs to x_prescribed."""
        out = self.held(i, x, scene)
        if k >= 0 and scene.sliding_slot[i] < 0:
            out = x
        return out

    @ti.func
    def given_vjp(self, k, by_u, by_v, now: A, adjoint: A):
        """What of adjoints of what is given goes straight to the state before; adds those of the motion."""
        u_adj, v_adj = by_u, by_v
        if ti.static(self.motion):
            if k >= 0 and now.alpha > 0:
                before, after = adjoint.motion[now.row, k], adjoint.motion[now.next, k]
                adjoint.motion[now.row, k] = before + (1 - now.end) * by_u - now.per_step * by_v
                adjoint.motion[now.next, k] = after + now.end * by_u + now.per_step * by_v
                adjoint.anchor[k] = adjoint.anchor[k] + by_u
                u_adj, v_adj = self.vector(0), self.vector(0)
        return u_adj, v_adj

    @ti.func
    def end_vjp(self, i, k, p, q, now: A, scene: A, adjoint: A):
        """(p, q, adjoints of u and v) from adjoints p, q of the end: what is left for the free parts, and what goes straight
        to the state before, where the end is held there. Adds those of the motion."""
        by_u, by_v = self.of_held(i, k, p, scene), self.of_held(i, k, q, scene)
        u_adj, v_adj = self.given_vjp(k, by_u, by_v, now, adjoint)
        return p - by_u, q - by_v, u_adj, v_adj
