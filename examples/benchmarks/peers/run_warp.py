"""Jobs on NVIDIA Warp: kernels of our own hand, every state kept, differentiated by its tape. On the CPU."""

import numpy as np
import warp as wp
from job import answer_all, timed

wp.config.quiet = True
wp.init()


@wp.func
def cofactor(F: wp.mat33):
    a = wp.vec3(F[0, 0], F[1, 0], F[2, 0])
    b = wp.vec3(F[0, 1], F[1, 1], F[2, 1])
    c = wp.vec3(F[0, 2], F[1, 2], F[2, 2])
    return wp.matrix_from_cols(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))


@wp.kernel
def elastic(
    x: wp.array(dtype=wp.vec3),
    tet: wp.array2d(dtype=int),
    B: wp.array(dtype=wp.mat33),
    W: wp.array(dtype=float),
    mu: wp.array(dtype=float),
    lam: wp.array(dtype=float),
    f: wp.array(dtype=wp.vec3),
):
    e = wp.tid()
    x0 = x[tet[e, 0]]
    F = wp.matrix_from_cols(x[tet[e, 1]] - x0, x[tet[e, 2]] - x0, x[tet[e, 3]] - x0) * B[e]
    m = 4.0 * mu[e] / 3.0
    bulk = lam[e] + 5.0 * mu[e] / 6.0
    P = m * (1.0 - 1.0 / (wp.ddot(F, F) + 1.0)) * F + (bulk * (wp.determinant(F) - 1.0) - 0.75 * m) * cofactor(F)
    Q = (P * wp.transpose(B[e])) * (-W[e])
    h1, h2, h3 = (
        wp.vec3(Q[0, 0], Q[1, 0], Q[2, 0]),
        wp.vec3(Q[0, 1], Q[1, 1], Q[2, 1]),
        wp.vec3(Q[0, 2], Q[1, 2], Q[2, 2]),
    )
    wp.atomic_add(f, tet[e, 1], h1)
    wp.atomic_add(f, tet[e, 2], h2)
    wp.atomic_add(f, tet[e, 3], h3)
    wp.atomic_add(f, tet[e, 0], -(h1 + h2 + h3))


@wp.kernel
def advance(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    f: wp.array(dtype=wp.vec3),
    m: wp.array(dtype=float),
    free: wp.array(dtype=float),
    h: float,
    keep: float,
    gravity: float,
    k: float,
    width: float,
    x1: wp.array(dtype=wp.vec3),
    v1: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    g = f[i]
    d = x[i][1]
    if d < width:
        s = d / width
        g = g + wp.vec3(0.0, k * width * (s - 1.0) * (2.0 * wp.log(s) + (s - 1.0) / s), 0.0)
    w = free[i] * keep * (v[i] + h * (g / m[i] + wp.vec3(0.0, gravity, 0.0)))
    v1[i] = w
    x1[i] = x[i] + h * w


def work(job):
    one, job = len(job.vertices), job.in_one()
    n, m, steps = len(job.vertices), len(job.tetrahedra), job.frames * job.substeps
    k, width = (float(a) for a in job.ground) if job.ground.size else (0.0, -1e30)
    free = np.ones(n)
    free[job.fixed] = 0

    def array(a, dtype, **options):
        host = np.ascontiguousarray(a, np.int32 if dtype is int else np.float32)
        return wp.array(host, dtype=dtype, device=job.device, **options)

    def states(count):
        return [wp.zeros(n, dtype=wp.vec3, device=job.device, requires_grad=job.differentiates) for _ in range(count)]

    tet, B = array(job.tetrahedra, int), array(np.linalg.inv(job.rest_edges), wp.mat33)
    W, masses, free = array(job.volumes, float), array(job.masses, float), array(free, float)
    mu, lam = (array(np.full(m, a), float, requires_grad=job.differentiates) for a in (job.mu, job.lam))
    # forward alone two states take turns; the tape needs them all
    kept = steps if job.differentiates else 1
    xs, vs, fs = states(kept + 1), states(kept + 1), states(kept)
    constants = [float(job.h), float(job.keep), float(job.gravity), k, width]

    def forward():
        xs[0].assign(job.start.astype(np.float32))
        vs[0].assign(job.velocities.astype(np.float32))
        for f in fs:
            f.zero_()
        seen = [xs[0].numpy().copy()]
        for s in range(steps):
            a, b = (s, s + 1) if job.differentiates else (s % 2, 1 - s % 2)
            f = fs[s if job.differentiates else 0]
            if s and not job.differentiates:
                f.zero_()
            wp.launch(elastic, m, inputs=[xs[a], tet, B, W, mu, lam], outputs=[f], device=job.device)
            wp.launch(
                advance,
                n,
                inputs=[xs[a], vs[a], f, masses, free, *constants],
                outputs=[xs[b], vs[b]],
                device=job.device,
            )
            if (s + 1) % job.substeps == 0:
                seen.append(xs[b].numpy().copy())
        return np.stack(seen)

    def both():
        tape = wp.Tape()
        with tape:
            positions = forward()
        adjoints = job.adjoints(positions).astype(np.float32)
        seeds = {
            xs[j * job.substeps]: wp.array(adjoints[j], dtype=wp.vec3, device=job.device)
            for j in range(1, job.frames + 1)
        }
        tape.backward(grads=seeds)
        by_mu, by_lam = (float(a.grad.numpy().astype(float).sum()) for a in (mu, lam))
        gradients = dict(
            youngs_modulus=job.by_youngs_modulus(by_mu, by_lam),
            initial_positions=xs[0].grad.numpy().astype(float)[:one],
        )
        tape.zero()
        return positions, gradients

    seconds, (positions, gradients) = timed(both if job.differentiates else lambda: (forward(), {}), job.repeats)
    return seconds, positions[:, :one], gradients


if __name__ == "__main__":
    answer_all(work)
