"""The triangle in a fluid (terms/surface_drag.py): corner forces, their differential and adjoint.

drag.py has the formula. Corner a of triangle t writes corner `first + 3 t + a`, and vertices gather it with those of
tetrahedra.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.fluid import drag
from diffsim_ti.mechanics.interaction import ItemForce, edges, store_alike
from diffsim_ti.runtime import traced
from diffsim_ti.terms.surface_drag import SurfaceDrag

A = ti.template()  # an array or Bundle handed to a Taichi function
pull, pull_jvp, pull_vjp = (ti.func(f) for f in (drag.pull, drag.pull_jvp, drag.pull_vjp))


@dataclass(frozen=True)
class DraggedTriangle(ItemForce):
    """Functions of one triangle in a pass; shape: of adjoints."""

    shape: bool
    name, reads_rates, reads_rest = "dragged", True, True
    arrays = dict(dragged="ints", dragged_numbers="ints")  # corners of each, where its numbers stand in the parameters
    adjoints = dict(fluid_adjoint="vectors", dragged_rest="vectors")

    @traced
    def sizes(self, plan) -> dict:
        return dict(fluid_adjoint=2 * plan.num_dragged, dragged_rest=3 * plan.num_dragged)

    @ti.func
    def number(self, x: ti.template()):
        return ti.cast(x, self.fp)

    @ti.func
    def speed(self, t, v: A, s, parameters: A, scene: A):
        """Mean velocity of the corners in slot s, less the stream."""
        first = scene.dragged_numbers[t] + SurfaceDrag.index.stream
        stream = self.vector(parameters[first], parameters[first + 1], parameters[first + 2], ti.cast(0, self.fp))
        total = v[s, scene.dragged[3 * t]] + v[s, scene.dragged[3 * t + 1]] + v[s, scene.dragged[3 * t + 2]]
        return total * self.number(1.0 / 3.0) - stream

    @ti.func
    def numbers(self, t, parameters: A, scene: A):
        """(rho / 12, c_t, c_n - c_t)"""
        k = scene.dragged_numbers[t]
        rho, c_t = parameters[k + SurfaceDrag.index.density], parameters[k + SurfaceDrag.index.tangential]
        return rho * self.number(1.0 / 12.0), c_t, parameters[k + SurfaceDrag.index.normal] - c_t

    @ti.func
    def inverse(self, x):
        out = ti.cast(0, self.fp)
        if x > 0:
            out = ti.cast(1, self.fp) / x
        return out

    @ti.func
    def known(self, t, scene: A, state: A, s):
        """(e, f, v, |v|, N, L, s, B)"""
        e, f = edges(scene.dragged, t, state.u, scene.rest, s)
        v = self.speed(t, state.v, s, scene.parameters, scene)
        rho, c, k = self.numbers(t, scene.parameters, scene)
        N = self.cross(e, f)
        L, along = ti.sqrt(N.dot(N)), v.dot(N)
        return e, f, v, ti.sqrt(v.dot(v)), N, L, along, pull(c, k, v, N, L, along, self.inverse(L))

    @ti.func
    def forces(self, t, now: A, scene: A, state: A, s, plan: A):
        rho, c, k = self.numbers(t, scene.parameters, scene)
        e, f, v, size, N, L, along, B = self.known(t, scene, state, s)
        store_alike(-rho * size * B, scene.corner, self.first(plan), t)

    @ti.func
    def forces_jvp(self, t, now: A, scene: A, state: A, s, tangent: A, plan: A):
        rho, c, k = self.numbers(t, scene.parameters, scene)
        drho, dc, dk = self.numbers(t, tangent.parameters, scene)
        e, f, v, size, N, L, along, B = self.known(t, scene, state, s)
        de, df = edges(scene.dragged, t, tangent.u, tangent.rest, 0)
        dv = self.speed(t, tangent.v, 0, tangent.parameters, scene)
        dN, over = self.cross(de, f) + self.cross(e, df), self.inverse(L)
        dL, dalong, dsize = N.dot(dN) * over, dv.dot(N) + v.dot(dN), v.dot(dv) * self.inverse(size)
        dB = pull_jvp(c, k, v, N, L, along, over, dc, dk, dv, dN, dL, dalong)
        change = rho * (dsize * B + size * dB) + drho * size * B
        store_alike(self.number(-1) * change, scene.corner, self.first(plan), t)

    @ti.func
    def forces_vjp(self, t, now: A, scene: A, state: A, s, adjoint: A, plan: A):
        """Products of the transposed derivatives with adjoint.w, to corners; adds the adjoints of numbers to
        adjoint.fluid_adjoint and, if `shape`, those of places to adjoint.dragged_rest."""
        rho, c, k = self.numbers(t, scene.parameters, scene)
        e, f, v, size, N, L, along, B = self.known(t, scene, state, s)
        w = adjoint.w[0, scene.dragged[3 * t]]
        for a in ti.static((1, 2)):
            w += adjoint.w[0, scene.dragged[3 * t + a]]
        over, a_B, b = self.inverse(L), -rho * w, -rho * size * w
        across, straight = b.dot(N), b.dot(v)
        by_v, by_N = pull_vjp(c, k, v, N, L, along, over, b, across, straight)
        by_v += a_B.dot(B) * self.inverse(size) * v
        by_e, by_f = self.cross(f, by_N), self.cross(by_N, e)
        balance = self.number(-1) * (by_e + by_f)
        for a, by in ti.static(enumerate((balance, by_e, by_f))):
            adjoint.corner[self.first(plan) + 3 * t + a] = by
            adjoint.rate_corner[self.first(plan) + 3 * t + a] = by_v * self.number(1.0 / 3.0)
            if ti.static(self.shape):
                adjoint.dragged_rest[3 * t + a] = adjoint.dragged_rest[3 * t + a] + by
        by_k, by_c = along * over * across, L * straight
        by_rho = -size * w.dot(B) * self.number(1.0 / 12.0)
        by_numbers = self.vector(by_rho, by_k, by_c - by_k, self.number(0))
        adjoint.fluid_adjoint[2 * t] = adjoint.fluid_adjoint[2 * t] + by_numbers
        adjoint.fluid_adjoint[2 * t + 1] = adjoint.fluid_adjoint[2 * t + 1] - by_v
