"""Tensors of kernels: what waits to be used is what it stands for, however often and in whatever order it is used."""

import numpy as np
import pytest
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.materials.calculus.tensor import Tensor, add_to_diagonal, inner, invariants
from diffsim_ti.runtime import LANES, assign, at, language, let, traced

USES = {  # of a sum S that waits
    "sum": (lambda S, H: S + H, lambda S, H: S + H),
    "difference": (lambda S, H: H - S, lambda S, H: H - S),
    "multiple": (lambda S, H: S * 3, lambda S, H: 3 * S),
    "itself": (lambda S, H: S + S, lambda S, H: S + S),
    "diagonal": (lambda S, H: add_to_diagonal(S, 2), lambda S, H: S + 2 * np.eye(3)),
    "product": (lambda S, H: S @ H, lambda S, H: S @ H),
    "square": (lambda S, H: S @ S, lambda S, H: S @ S),
    "inner": (lambda S, H: H * inner(S, S), lambda S, H: H * (S * S).sum()),
    "transpose": (lambda S, H: S.transpose(), lambda S, H: S.T),
    "invariant": (lambda S, H: H * invariants(S)[1], lambda S, H: H * (np.linalg.det(np.eye(3) + S) - 1)),
}


@pytest.mark.parametrize("lanes", [False, True], ids=["scalars", "lanes"])
def test_waiting_sums_are_used_in_any_order(lanes):
    """Each use stands first, second and third: a first use takes the expression itself, later ones its variables."""
    names = list(USES)
    orders = [(names[n], names[n - 1], names[n - 4]) for n in range(len(names))] + [(name,) * 3 for name in names]
    number = ti.types.vector(LANES, ti.f64) if lanes else ti.f64
    kind = ti.types.ndarray(number, 1)

    @traced
    def body(h, out):
        for n, order in enumerate(orders):
            H = Tensor(let(at(h, k)) for k in range(9))
            S = H * let(at(h, 0)) + H.transpose()
            for m, use in enumerate(order):
                for k, x in enumerate(USES[use][0](S, H).numbers):
                    assign(at(out, 9 * (3 * n + m) + k), x)

    @ti.kernel
    def kernel(h: kind, out: kind):
        for _ in range(1):
            body(h, out)

    width = LANES if lanes else 1
    values = np.random.default_rng(5).uniform(-0.5, 0.5, (9, width))
    h, out = ti.ndarray(number, 9), ti.ndarray(number, 27 * len(orders))
    h.from_numpy(values if lanes else values[:, 0])
    runtime.Launch(kernel, h, out, vectorized=lanes)()
    found = out.to_numpy().reshape(len(orders), 3, 3, 3, width)
    for n, order in enumerate(orders):
        for m, use in enumerate(order):
            for lane in range(width):
                H = values[:, lane].reshape(3, 3)
                expected = USES[use][1](H * H[0, 0] + H.T, H)
                assert np.allclose(found[n, m, ..., lane], expected, rtol=0, atol=1e-14), (order, use)


def test_sums_used_once_make_no_variables(monkeypatch):
    """H a + K b + L: nine variables, not four times as many."""
    made, found, kind = [], [], ti.types.ndarray(ti.f64, 1)
    initialise = language.impl.expr_init
    monkeypatch.setattr(language.impl, "expr_init", lambda value: made.append(value) or initialise(value))

    @traced
    def body(h):
        H, K, L = (Tensor(let(at(h, 9 * n + k)) for k in range(9)) for n in range(3))
        a, b, before = let(at(h, 0)), let(at(h, 1)), len(made)
        assert len((H * a + K * b + L).numbers) == 9
        found.append(len(made) - before)

    @ti.kernel
    def kernel(h: kind):
        for _ in range(1):
            body(h)

    runtime.Launch(kernel, ti.ndarray(ti.f64, 27))()
    assert found == [9]


@pytest.mark.parametrize("fp, own", [(ti.f32, np.float32), (ti.f64, np.float64)], ids=["f32", "f64"])
def test_cast_numbers_are_rounded_once(fp, own):
    kind = ti.types.ndarray(fp, 1)

    @ti.kernel
    def kernel(out: kind):
        for _ in range(1):
            out[0] = ti.cast(0.1, fp)
            out[1] = ti.cast(-3, fp)
            out[2] = ti.cast(1e-40, fp)

    out = ti.ndarray(fp, 3)
    kernel(out)
    assert out.to_numpy().tolist() == np.array([0.1, -3, 1e-40], own).tolist()
