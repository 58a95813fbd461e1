"""Lagged friction of surfaces on the device (lagged_friction.py): energies, forces, and products with its Hessian."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import Parts, put
from diffsim_ti.mechanics.surfaces.listed_pair import three
from diffsim_ti.runtime import A, Kernel, as_kernel, kernels_of, number_type, vector_type
from diffsim_ti.terms.obstacles.friction import KERNELS, dissipated_in_kernels, slip_in_kernels

SUMS = dict(pairs="ints", weights="vectors", pull="vectors", row="ints", corner_of="ints")
OWN = SUMS | dict(pressing="vectors", speed="scalars", origin="vectors", turned="ints", stiffness="vectors")


@dataclass(frozen=True)
class FrictionProductKernels:
    """Each pair p writes its pull, of which corner k has the share w_k, and surface vertices add up those of theirs, in
    order. pressing: (n, mu N) of each pair; origin: x of vertices; turned: of which pairs the stiffness is bounded."""

    precision: str
    parallel: bool

    fp, vec4 = number_type, vector_type

    @ti.func
    def across(self, n, v):
        return v - n.dot(v) * n

    @ti.func
    def moved(self, p, w: A, of: A):
        """sum_k w_k dx_k of pair p."""
        out = 0 * three(of.weights[p])
        for k in ti.static(range(4)):
            out += of.weights[p][k] * three(w[0, of.pairs[4 * p + k]])
        return out

    @ti.func
    def sliding(self, p, u: A, of: A, plan: A):
        """t of pair p."""
        v = 0 * three(of.weights[p])
        for k in ti.static(range(4)):
            i = of.pairs[4 * p + k]
            v += of.weights[p][k] * (three(u[0, i]) - three(of.origin[i]))
        return self.across(three(of.pressing[p]), plan.per_gamma * v)

    @ti.func
    def add_pulls(self, of: A, at: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            total = self.vec4(0)
            for k in range(of.row[s], of.row[s + 1]):
                p, corner = of.corner_of[k] // 4, of.corner_of[k] % 4
                total += of.weights[p][corner] * of.pull[p]
            if of.row[s + 1] > of.row[s]:
                at.out[plan.first_out + s] = at.out[plan.first_out + s] + total

    def _kernel(self, name: str, body, of: dict, at: dict, **numbers) -> Kernel:
        numbers |= dict.fromkeys(("num_sliding", "num_surface", "first_out"), "int")
        return Kernel(name, body, self.precision, dict(of=of, at=at), numbers)

    @as_kernel(
        "measure_friction", OWN, dict(u="vectors2", out="vectors", energy="scalars"), num_pairs="int", per_gamma="float"
    )
    def measure(self, of: A, at: A, plan: A):
        """Energies, behind those of `num_pairs`; adds forces to the last corners of `out`; the stiffness there."""
        ti.loop_config(serialize=not self.parallel)
        for p in range(plan.num_sliding):
            n, load, t = three(of.pressing[p]), of.pressing[p][3], self.sliding(p, at.u, of, plan)
            speed, none = ti.sqrt(t.norm_sqr()), ti.cast(0, self.fp)
            kappa, _f, _y, slope = slip_in_kernels(speed, none, of.speed[p], KERNELS)
            at.energy[plan.num_pairs + p] = load / plan.per_gamma * dissipated_in_kernels(speed, of.speed[p], KERNELS)
            pull = (none - load * kappa) * t
            of.pull[p] = self.vec4(pull[0], pull[1], pull[2], none)
            e, along = t / ti.max(speed, ti.cast(1e-30, self.fp)), slope - kappa
            if of.turned[p] > 0:
                along = none
            for d in ti.static(range(3)):
                row = along * e[d] * e - kappa * n[d] * n
                row[d] += kappa
                row *= plan.per_gamma * load
                of.stiffness[3 * p + d] = self.vec4(row[0], row[1], row[2], none)
        self.add_pulls(of, at, plan)

    @as_kernel("turn_friction", OWN, dict(u="vectors2", w="vectors2"), per_gamma="float")
    def compare(self, of: A, at: A, plan: A):
        """Which pairs slide at u[0], and after a step w[0] the other way or so much slower that their stiffness at u, which
        is none along the motion, says little of the way."""
        ti.loop_config(serialize=not self.parallel)
        for p in range(plan.num_sliding):
            t, way = self.sliding(p, at.u, of, plan), plan.per_gamma * self.moved(p, at.w, of)
            square, half = t.norm_sqr(), ti.cast(0.5, self.fp) * of.speed[p]
            turns = t.dot(t + self.across(three(of.pressing[p]), way)) < ti.cast(0.3, self.fp) * square
            of.turned[p] = ti.cast(square > half * half and turns, ti.i32)

    @as_kernel("friction_products", SUMS | dict(stiffness="vectors"), dict(w="vectors2", out="vectors"))
    def products(self, of: A, at: A, plan: A):
        """Adds the change of the forces for changes w[0] of the positions to the last corners of `out`."""
        ti.loop_config(serialize=not self.parallel)
        for p in range(plan.num_sliding):
            moved, pull = self.moved(p, at.w, of), self.vec4(0)
            for d in ti.static(range(3)):
                pull[d] = 0 - three(of.stiffness[3 * p + d]).dot(moved)
            of.pull[p] = pull
        self.add_pulls(of, at, plan)

    @as_kernel("friction_blocks", SUMS | dict(stiffness="vectors"), dict(out="vectors2"))
    def blocks(self, of: A, at: A, plan: A):
        """Adds the diagonal blocks of the Hessian to rows 0..2 of `out`."""
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            for k in range(of.row[s], of.row[s + 1]):
                p, i = of.corner_of[k] // 4, of.pairs[of.corner_of[k]]
                w = of.weights[p][of.corner_of[k] % 4]
                for d in ti.static(range(3)):
                    at.out[d, i] = at.out[d, i] + w * w * of.stiffness[3 * p + d]


class FrictionProduct:
    """Of the pairs that press in a pass: where they lie, and their stiffness where `measure` has been."""

    def __init__(self, pairs):
        self.pairs, vector, n = pairs, pairs.kernels.vec4, len(pairs.mesh.surface_vertices)
        self.kernels = kernels_of(FrictionProductKernels, pairs.a.precision, pairs.parallel)
        self.of = SimpleNamespace(row=runtime.array(ti.i32, n + 1), origin=runtime.array(vector, pairs.a.num_vertices))
        pairs.sizes |= dict(num_sliding=0, per_gamma=1.0)
        self.begin(np.zeros((0, 4), int), np.zeros((0, 4)), np.zeros((0, 4)), np.zeros(0), 1.0)

    def begin(
        self, corners: np.ndarray, weights: np.ndarray, pressing: np.ndarray, speed: np.ndarray, per_gamma
    ) -> None:
        """Four corners and weights, (n, mu N) and the friction speed of each pair."""
        count, surface = len(corners), self.pairs.mesh.surface_vertices
        vector, fp = self.pairs.kernels.vec4, self.pairs.a.fp
        at = np.searchsorted(surface, corners.ravel())
        runtime.fill(self.of.row, np.concatenate([[0], np.bincount(at, minlength=len(surface)).cumsum()]))
        own = dict(pairs=(ti.i32, corners.ravel()), corner_of=(ti.i32, at.argsort(kind="stable")))
        own |= dict(weights=(vector, weights), pressing=(vector, pressing), speed=(fp, speed))
        own |= dict(turned=(ti.i32, np.zeros(count)), pull=(vector, np.zeros((count, 4))))
        own |= dict(stiffness=(vector, np.zeros((3 * count, 4))))
        for name, (dtype, data) in own.items():
            array = self.pairs.list.buffers.take(f"{name} of lagged friction", dtype, len(data))
            setattr(self.of, name, array)
            put(array, data)
        self.pairs.sizes |= dict(num_sliding=count, per_gamma=per_gamma)

    def part(self, kernel: Kernel, **at) -> Parts:
        """[(kernel, records, numbers)] on these pairs."""
        return [(kernel, dict(of=self.of, at=SimpleNamespace(**at)), self.pairs.sizes)]
