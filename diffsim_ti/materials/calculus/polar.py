"""Polar decomposition F = R S with a proper rotation R, whatever the sign of det F, and the spin of R."""

import taichi as ti

from diffsim_ti.materials.calculus.tensor import add_to_diagonal, cofactor, inner, invariants, tensor


@ti.func
def polar(H, fp: ti.template()):
    """(R, eps) of F = I + H = R (I + eps), R a rotation (det +1) and eps symmetric; relative accuracy also near rest.

    f = tr S is the largest root of (f^2 - I_C)^2 = 4 II_C + 8 J f, and R = df/dF. Newton from above finds it, here in
    t = f - 3 so that nothing cancels near rest. For det F < 0 the sign sits on the smallest stretch.
    Where the smaller two stretches nearly sum to zero (strongly drawn out, crushed, or mirrored) that loses digits and a
    slower method takes over; where they do sum to zero, R is one of those that fit.
    Lin, Chitalu, Komura 2022, Isotropic ARAP energy using Cauchy-Green invariants, doi:10.1145/3550454.3555507.
    """
    half = ti.cast(0.5, fp)
    K, j, s = invariants(H)
    i1 = s + 2 * j
    G = H + H.transpose() + H.transpose().dot(H)
    i2 = 2 * i1 + half * (i1 * i1 - inner(G, G))
    t = 3 * i1 / (3 + ti.sqrt(9 + 3 * i1))
    step, rounds = 3 + t, 0
    while rounds < 12 and ti.abs(step) > ti.cast(1e-8 if fp == ti.f64 else 1e-4, fp) * (3 + t):
        y = half * (t * (6 + t) - i1)
        step = (y * (6 + y) - i2 - 2 * t - 6 * j - 2 * j * t) / (2 * ((3 + y) * (3 + t) - 1 - j))
        t -= step
        rounds += 1
    f, y = 3 + t, half * (t * (6 + t) - i1)
    D = (3 + y) * f - 1 - j  # (s1 + s2) (s2 + s3) (s3 + s1)
    direct = add_to_diagonal(H * (5 + y + i1) - G - H.dot(G) + K * f, i1 + j - 2 * y - 2 * t - y * t) * (
        ti.cast(1, fp) / D
    )
    chosen = direct.matrix()
    # rounding errors of R grow as (f^3 / D)^2, and as 1 / D because H = F - I; D is NaN where the root is double
    if not D * 8 > f * f * f + 2:
        chosen = dominant_rotation(H, fp)
    Q = tensor(chosen)
    E = H + Q.transpose() + Q.transpose().dot(H)
    return add_to_diagonal(Q, 1), (E + E.transpose()) * half


@ti.func
def dominant_rotation(H, fp: ti.template()):
    """R - I for the rotation that maximises R : F: the dominant eigenvector of Davenport's 4x4 matrix is its quaternion.

    Found by squaring the matrix, which copes with double eigenvalues (any of their vectors will do); 40 times
    tell apart what differs by 1e-11.
    Horn 1987, Closed-form solution of absolute orientation using unit quaternions, doi:10.1364/JOSAA.4.000629.
    """
    F = add_to_diagonal(H, 1)
    wx, wy, wz = F[2, 1] - F[1, 2], F[0, 2] - F[2, 0], F[1, 0] - F[0, 1]
    xy, xz, yz = F[0, 1] + F[1, 0], F[0, 2] + F[2, 0], F[1, 2] + F[2, 1]
    c = 2 * ti.sqrt(inner(F, F)) + ti.cast(1e-30, fp)  # makes all eigenvalues positive
    A = ti.Matrix(
        [
            [c + F[0, 0] + F[1, 1] + F[2, 2], wx, wy, wz],
            [wx, c + F[0, 0] - F[1, 1] - F[2, 2], xy, xz],
            [wy, xy, c - F[0, 0] + F[1, 1] - F[2, 2], yz],
            [wz, xz, yz, c - F[0, 0] - F[1, 1] + F[2, 2]],
        ]
    )
    A *= ti.cast(1, fp) / A.trace()
    rest, rounds = ti.cast(1, fp), 0  # rest: twice the share of the other eigenvalues
    while rounds < 40 and rest > ti.cast(1e-9 if fp == ti.f64 else 1e-4, fp):
        A = A @ A
        trace = A.trace()
        A *= ti.cast(1, fp) / trace
        rest = 1 - trace
        rounds += 1
    q, largest = ti.Vector([A[0, 0], A[1, 0], A[2, 0], A[3, 0]]), A[0, 0]
    for k in ti.static(range(1, 4)):
        if A[k, k] > largest:
            q, largest = ti.Vector([A[0, k], A[1, k], A[2, k], A[3, k]]), A[k, k]
    w, x, y, z = q[0], q[1], q[2], q[3]
    Q = ti.Matrix(
        [
            [-(y * y + z * z), x * y - w * z, x * z + w * y],
            [x * y + w * z, -(x * x + z * z), y * z - w * x],
            [x * z - w * y, y * z + w * x, -(x * x + y * y)],
        ]
    )
    return Q * (ti.cast(2, fp) / (w * w + x * x + y * y + z * z))


@ti.func
def spin(eps, B, fp: ti.template()):
    """W = R^T dR for B = R^T dF: the skew W with W S + S W = B - B^T, that is (tr(S) I - S) w = axial(B - B^T).

    No 1 / (difference of stretches) occurs. Where two stretches sum to zero (inverted or rank-one F only) R jumps and has
    no derivative; the matrix is shifted there, so that W is finite, though large.
    """
    shift = ti.cast(1e-12 if fp == ti.f64 else 1e-6, fp)
    M = add_to_diagonal(eps * ti.cast(-1, fp), 2 + eps.trace())
    d, extra = determinant(M, cofactor(M)), 0 * shift
    if d < shift:
        extra = shift
    shifted = add_to_diagonal(M, extra)
    C = cofactor(shifted)
    d = determinant(shifted, C)
    if extra > 0:
        d = ti.max(d, shift * shift * shift)
    w = C.matrix() @ ti.Vector([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]]) * (ti.cast(1, fp) / d)
    return tensor(ti.Matrix([[0 * d, -w[2], w[1]], [w[2], 0 * d, -w[0]], [-w[1], w[0], 0 * d]]))


@ti.func
def determinant(M, C):
    """det M from its cofactors."""
    return M[0, 0] * C[0, 0] + M[0, 1] * C[0, 1] + M[0, 2] * C[0, 2]
