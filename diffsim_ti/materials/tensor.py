"""3x3 tensor algebra that the laws share. Cyclic indices spare every sign."""

import taichi as ti


@ti.func
def inner(A, B):
    """A : B"""
    return (A * B).sum()


@ti.func
def cofactor(A):
    """cof A, so that A (cof A)^T = det(A) I; its trace is the sum of the principal 2x2 minors."""
    C = A
    for i, j in ti.static(ti.ndrange(3, 3)):
        k, m, n, o = ti.static((i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3)
        C[i, j] = A[k, n] * A[m, o] - A[k, o] * A[m, n]
    return C


@ti.func
def cofactor_differential(A, dA):
    """d cof A for a change dA."""
    C = A
    for i, j in ti.static(ti.ndrange(3, 3)):
        k, m, n, o = ti.static((i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3)
        C[i, j] = dA[k, n] * A[m, o] + A[k, n] * dA[m, o] - dA[k, o] * A[m, n] - A[k, o] * dA[m, n]
    return C


@ti.func
def add_to_diagonal(A, x):
    """A + x I"""
    B = A
    for i in ti.static(range(3)):
        B[i, i] += x
    return B


@ti.func
def invariants(H):
    """(K, j, s) of F = I + H without cancellation: K = cof F - I, j = det F - 1, s = |F|^2 - 3 - 2 j."""
    C, trace = cofactor(H), H.trace()
    minors = C.trace() + H[0, 0] * C[0, 0] + H[0, 1] * C[0, 1] + H[0, 2] * C[0, 2]
    K = add_to_diagonal(C - H.transpose(), trace)
    return K, trace + minors, inner(H, H) - 2 * minors
