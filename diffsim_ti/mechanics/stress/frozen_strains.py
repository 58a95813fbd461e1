"""Strains that a viscous law measures its rate from in an implicit pass: a0 E(u) + a1 E(u-), of the states before it.

With u* = a0 u + a1 u- + gamma v* the rate of strain is (E(u*) - a0 E(u) - a1 E(u-)) / gamma, that of the integrator. Green's
strains of two states do not differ by a rigid turn, so that there is no rate then, however far it goes in a step.
"""

import weakref
from dataclasses import dataclass

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.materials.calculus.tensor import (
    add_to_diagonal,
    green_strain,
    green_strain_differential,
    six,
    six_adjoint,
)
from diffsim_ti.mechanics.stress.patched_tetrahedron import ElementKernels
from diffsim_ti.runtime import A, Kernel, as_kernel, kernels_of, traced
from diffsim_ti.state.numbers import OF_TETRAHEDRA, SCENE, TANGENT
from diffsim_ti.state.stage import Stage

AT = dict(u="vectors2")  # u in slot 0, u- in slot 1
NUMBERS = dict(num_items="int", num_vertices="int", a0="float", a1="float")


@dataclass(frozen=True)
class FrozenStrainKernels(ElementKernels):
    """The frozen strains, their change, and their adjoint."""

    @traced
    def put(self, e, held, q, E):
        self.element.items.put_row(held, 0, 6 * q, 6 * len(self.element.points), e, six(E))

    @traced
    def weights(self, plan) -> list:
        return [self.element.items.broadcast(a) for a in (plan.a0, plan.a1)]

    @traced
    def hold(self, e, scene, at, held, plan):
        el, (a0, a1) = self.element, self.weights(plan)
        for q, (D, before) in enumerate(zip(el.edges(e, scene, at.u, 0), el.edges(e, scene, at.u, 1))):
            B, half = el.gradients_of(e, scene.gradients, q), self.law.real(0.5)
            self.put(e, held, q, green_strain(D @ B, half) * a0 + green_strain(before @ B, half) * a1)

    @as_kernel("frozen_strains", out=dict(held="blocks2"))
    def forward(self, scene: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            self.hold(e, scene, at, out.held, plan)

    @traced
    def hold_jvp(self, e, scene, at, tangent, plan):
        el, half, total = self.element, self.law.real(0.5), [None] * len(self.element.points)
        for s, a in enumerate(self.weights(plan)):
            moved = el.edges(e, scene, tangent.du, s)
            for q, D in enumerate(el.edges(e, scene, at.u, s)):
                B, dB = (el.gradients_of(e, of.gradients, q) for of in (scene, tangent))
                dE = green_strain_differential(D @ B, moved[q] @ B + D @ dB, half) * a
                total[q] = dE if s == 0 else total[q] + dE
        for q, dE in enumerate(total):
            self.put(e, tangent.held, q, dE)

    @as_kernel("frozen_strains_jvp", tangent=TANGENT | dict(du="vectors2", held="blocks2"))
    def jvp(self, scene: A, at: A, tangent: A, plan: A):
        """The change tangent.held, for changes tangent.du of the states and of the rest shape."""
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            self.hold_jvp(e, scene, at, tangent, plan)

    @traced
    def hold_vjp(self, e, scene, at, adjoint, plan):
        el = self.element
        for s, (a, corner) in enumerate(zip(self.weights(plan), (adjoint.corner, adjoint.corner_before))):
            pushes = []
            for q, D in enumerate(el.edges(e, scene, at.u, s)):
                B = el.gradients_of(e, scene.gradients, q)
                by_E = six_adjoint(el.frozen_of(e, adjoint.held, q), self.law.real(0.5))
                by_H = add_to_diagonal(D @ B, 1) @ by_E * a
                pushes.append((by_H * self.law.real(-1)) @ B.transpose())
                if self.features.shape:
                    el.add_shape(e, adjoint, q, D.transpose() @ by_H)
            el.store(e, corner, pushes)

    @as_kernel(
        "frozen_strains_vjp",
        adjoint=OF_TETRAHEDRA | dict(held="blocks2", corner="vectors", corner_before="vectors", y="vectors2"),
    )
    def vjp(self, scene: A, at: A, adjoint: A, plan: A):
        """adjoint.y of both states, from adjoint.held; adds that of the rest shape."""
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            self.hold_vjp(e, scene, at, adjoint, plan)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            adjoint.y[0, i] = self.element.gather(i, scene, adjoint.corner)
            adjoint.y[1, i] = self.element.gather(i, scene, adjoint.corner_before)

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        return Kernel(name, body, self.law.precision, dict(scene=SCENE, at=AT) | arrays, NUMBERS)


class FrozenStrains:
    """The strains that are frozen in the passes of a run, in `potential.held`, with the rate 1 / gamma, zero in static
    solves."""

    def __init__(self, workspace):
        self.ws, a = weakref.proxy(workspace), workspace.arrays  # which holds this: no circle
        self.u, self.du, self.y = (runtime.array(a.vector, 2, a.num_vertices) for _ in range(3))
        self.corner = self.corner_before = None  # of adjoints, made when first needed

    def _launch(self, name: str, features, stage: Stage, u: np.ndarray, before, **records) -> None:
        ws, a = self.ws, self.ws.arrays
        runtime.fill(self.u, np.stack([u, u if before is None else before[0]]))
        kernels = kernels_of(FrozenStrainKernels, a.law, features.of_elements(), ws.parallel, a.in_lanes)
        a0, a1 = (stage.a0, stage.a1) if before is not None else (1.0, 0.0)
        sizes = dict(num_items=a.num_items, num_vertices=a.num_vertices)
        ws.bound(getattr(kernels, name), at=self, **records)(**sizes, a0=a0, a1=a1)

    def hold(self, stage: Stage, u: np.ndarray, before) -> None:
        """Those of a pass from u, and from before = (u-, v-) or None."""
        potential = self.ws.potential
        runtime.fill(potential.rate, 0 if stage.static else 1 / stage.gamma)
        self._launch("forward", self.ws.arrays.features(), stage, u, before, out=potential)

    def jvp(self, stage: Stage, now: tuple, before: tuple, tangent) -> None:
        """Their change to tangent.held; now: (u, du); before: ((u-, v-) or None, (du-, dv-) or None)."""
        du = now[1] if before[0] is None else before[1][0]
        runtime.fill(self.du, np.stack([now[1], du]))
        record = dict(tangent=(self, tangent.numbers, tangent))
        self._launch("jvp", self.ws.arrays.features(), stage, now[0], before[0], **record)

    def vjp(self, stage: Stage, u: np.ndarray, before, adjoint) -> tuple[np.ndarray, np.ndarray]:
        """(adjoint of u, of u-) for adjoint.held; adds those of the rest shape."""
        a = self.ws.arrays
        if self.corner is None:
            self.corner, self.corner_before = (runtime.array(a.vector, *a.corner.shape) for _ in range(2))
            for corner in (self.corner, self.corner_before):
                runtime.fill(corner, 0)  # also where surfaces in contact have theirs
        self._launch("vjp", adjoint.features, stage, u, before, adjoint=(self, adjoint.numbers, adjoint))
        by_u, by_before = runtime.fetch(self.y).astype(np.float64)
        return by_u, by_before
