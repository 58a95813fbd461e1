"""Distances, energies and their derivatives of many pairs at once, outside any scene (proximity.py)."""

from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.contact.proximity import PARALLEL, pair_functions


@lru_cache(maxsize=None)
def _evaluate_kernel(precision: str, kind: int):
    f = pair_functions(precision)
    array1, array2, array3 = (ti.types.ndarray(f.fp, k) for k in (1, 2, 3))

    @ti.func
    def row(a: ti.template(), p, k):
        return f.vec3(a[p, k, 0] - a[p, 0, 0], a[p, k, 1] - a[p, 0, 1], a[p, k, 2] - a[p, 0, 2])

    @ti.func
    def write(out: ti.template(), p, h1, h2, h3):
        h0 = f.vec3(0) - (h1 + h2 + h3)
        for d in ti.static(range(3)):
            out[p, 0, d], out[p, 1, d], out[p, 2, d], out[p, 3, d] = h0[d], h1[d], h2[d], h3[d]

    @ti.kernel
    def evaluate(
        x: array3,
        dx: array3,
        scale: array1,
        numbers: array2,
        square_gradient: array3,
        square_product: array3,
        gradient: array3,
        product: array3,
        stiffness: f.fp,
        width: f.fp,
    ):
        for p in range(x.shape[0]):
            y1, y2, y3, dy1, dy2, dy3 = (
                row(x, p, 1),
                row(x, p, 2),
                row(x, p, 3),
                row(dx, p, 1),
                row(dx, p, 2),
                row(dx, p, 3),
            )
            w, r, g = f.nearest(kind, y1, y2, y3)
            dw, dr, _ = f.nearest_jvp(kind, y1, y2, y3, dy1, dy2, dy3, w, r, g)
            for k in ti.static(range(4)):
                for d in ti.static(range(3)):
                    square_gradient[p, k, d] = 2 * w[k] * r[d]
                    square_product[p, k, d] = 2 * (w[k] * dr[d] + dw[k] * r[d])
            energy, n, d, g1, g2, g3 = f.gradient(kind, y1, y2, y3, scale[p], stiffness, width)
            h1, h2, h3, by_stiffness, by_width = f.gradient_jvp(
                kind, y1, y2, y3, dy1, dy2, dy3, scale[p], stiffness, width, ti.cast(0, f.fp), ti.cast(0, f.fp)
            )
            numbers[p, 0], numbers[p, 1], numbers[p, 2], numbers[p, 3] = d, energy, by_stiffness, by_width
            write(gradient, p, g1, g2, g3)
            write(product, p, h1, h2, h3)

    return evaluate


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
    scale = np.ascontiguousarray(np.broadcast_to(1 / np.sqrt(threshold), len(x)), x.dtype)
    runtime.program()
    numbers = np.zeros((len(x), 4), x.dtype)
    square_gradient, square_product, gradient, product = (np.zeros_like(x) for _ in range(4))
    _evaluate_kernel(precision, kind)(
        x, dx, scale, numbers, square_gradient, square_product, gradient, product, float(stiffness), float(width)
    )
    return SimpleNamespace(
        distance=numbers[:, 0],
        energy=numbers[:, 1],
        by_stiffness=numbers[:, 2],
        by_width=numbers[:, 3],
        square_gradient=square_gradient,
        square_product=square_product,
        gradient=gradient,
        product=product,
    )
