"""Distances, energies and their derivatives of many pairs of surface primitives, outside any scene (proximity.py)."""

from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import whole
from diffsim_ti.mechanics.surfaces.contact_stage import PairContact
from diffsim_ti.mechanics.surfaces.listed_pair import between
from diffsim_ti.mechanics.surfaces.proximity import PARALLEL, Pair
from diffsim_ti.runtime import Kernel, kernels_of

A = ti.template()
OUT = ("square_gradient", "square_product", "gradient", "product")


@dataclass(frozen=True)
class EvaluateKernel(Pair):
    """Pairs of one kind whose corners lie in the rows of an array."""

    kind: int

    @ti.func
    def write(self, y: A, p, h1, h2, h3):
        for d in ti.static(range(3)):
            y[p, 0][d], y[p, 1][d], y[p, 2][d], y[p, 3][d] = 0 - (h1[d] + h2[d] + h3[d]), h1[d], h2[d], h3[d]

    @ti.func
    def evaluate_all(self, at: A, out: A, plan: A):
        for p in range(plan.count):
            y1, y2, y3 = between(at.x, 0, 1, p), between(at.x, 0, 2, p), between(at.x, 0, 3, p)
            dy1, dy2, dy3 = between(at.dx, 0, 1, p), between(at.dx, 0, 2, p), between(at.dx, 0, 3, p)
            w, r, g = self.nearest(self.kind, y1, y2, y3)
            dw, dr, _ = self.nearest_jvp(self.kind, y1, y2, y3, dy1, dy2, dy3, w, r, g)
            for k in ti.static(range(4)):
                for d in ti.static(range(3)):
                    out.square_gradient[p, k][d] = 2 * w[k] * r[d]
                    out.square_product[p, k][d] = 2 * (w[k] * dr[d] + dw[k] * r[d])
            scale, stiffness, width, zero = at.scale[p], plan.stiffness, plan.width, ti.cast(0, self.fp)
            energy, n, d, g1, g2, g3 = self.gradient(self.kind, w, r, y1, y2, y3, scale, stiffness, width, zero)
            h1, h2, h3, by_stiffness, by_width, _ = self.gradient_jvp(
                self.kind, w, r, g, (y1, y2, y3), (dy1, dy2, dy3), (scale, stiffness, width, zero), (zero, zero, zero)
            )
            out.numbers[p] = self.vec4(d, energy, by_stiffness, by_width)
            self.write(out.gradient, p, g1, g2, g3)
            self.write(out.product, p, h1, h2, h3)

    @cached_property
    def kernel(self) -> Kernel:
        """What `evaluate_pairs` returns; numbers: distance, energy, by_stiffness, by_width."""
        at, out = dict(x="vectors2", dx="vectors2", scale="scalars"), dict.fromkeys(OUT, "vectors2")
        numbers = dict(count="int", stiffness="float", width="float")
        return Kernel(
            "evaluate", self.evaluate_all, self.precision, dict(at=at, out=out | dict(numbers="vectors")), numbers
        )


def evaluate_pairs(
    kind: int,
    points,
    direction=None,
    stiffness: float = 1.0,
    width: float = 1.0,
    threshold=None,
    precision: str = "f64",
) -> SimpleNamespace:
    """Distances and barrier energies of pairs of given corners, with derivatives; arrays in, arrays out.

    kind: VERTEX_TRIANGLE or EDGE_EDGE. points, direction: shape (k, 4, 3) [m]; direction defaults to zero.
    threshold: of |a x b|^2 [m^4], below which edges are faded out, one number or shape (k,); default 10^-3 |a|^2 |b|^2.
    Returns distance (k,) [m], energy (k,) [J], gradient (k, 4, 3) [N], product: the energy's Hessian times direction,
    square_gradient and square_product: the same of the squared distance, by_stiffness and by_width: direction times
    the derivatives of the gradient.
    """
    x = np.ascontiguousarray(points, runtime.NUMPY[precision])
    if x.ndim != 3 or x.shape[1:] != (4, 3):
        raise ValueError(f"points must have shape (k, 4, 3), four corners for each pair, got {x.shape}")
    dx = np.zeros_like(x) if direction is None else np.ascontiguousarray(np.broadcast_to(direction, x.shape), x.dtype)
    if threshold is None:
        threshold = PARALLEL * ((x[:, 1] - x[:, 0]) ** 2).sum(1) * ((x[:, 3] - x[:, 2]) ** 2).sum(1)
    scale = np.broadcast_to(1 / np.sqrt(threshold), len(x))
    kernel = kernels_of(EvaluateKernel, precision, kind)
    fp, vector = kernel.fp, kernel.vec4
    at = SimpleNamespace(x=runtime.upload(x, vector), dx=runtime.upload(dx, vector), scale=runtime.upload(scale, fp))
    out = SimpleNamespace(
        **{name: runtime.array(vector, len(x), 4) for name in OUT}, numbers=runtime.array(vector, len(x))
    )
    kernel.kernel.bind(at=at, out=out)(count=len(x), stiffness=float(stiffness), width=float(width))
    numbers = dict(zip(("distance", "energy", "by_stiffness", "by_width"), whole(out.numbers)[: len(x)].T.copy()))
    return SimpleNamespace(**numbers, **{name: runtime.fetch(getattr(out, name))[: len(x)] for name in OUT})


def follow_parts(monkeypatch) -> list[tuple[bool, float]]:
    """Of each part that explicit runs take from now on, whether it pressed and how much of the kinetic energy friction took;
    it is what the formulas say that tangents and adjoints follow, it balances its pushes, and friction adds no energy."""
    act, seen = PairContact._act, []

    def spy(self, at, *given):
        act(self, at, *given)
        one = self.kept.get(at.end)
        for k, part in enumerate(one.parts if one else ()):
            of = self._numbers(one, at.now)
            found = one.solver.look(part, of)
            after = one.solver.take(part, of, found)
            np.testing.assert_allclose(part.P, found.P, rtol=0, atol=1e-9 * found.P.max(initial=1e-300))
            known = (one.parts[k + 1].e, one.parts[k + 1].b) if k + 1 < len(one.parts) else (None, one.b)
            for x, y in zip(after, known):
                assert y is None or np.abs(x - y).max() <= 1e-11 * max(np.abs(y).max(), 1e-300)
            lost = 0.0
            if of.rough:
                inverse = one.solver.near.lightened(of, np.eye(len(of.inverse)))
                mass = np.linalg.pinv(inverse)
                before, then = (float((mass @ v * v).sum()) for v in (found.V, found.V + found.friction))
                assert then <= before * (1 + 1e-14)
                lost = 1 - then / before
            seen.append((bool(found.P.max() > 0), lost))

    monkeypatch.setattr(PairContact, "_act", spy)
    return seen
