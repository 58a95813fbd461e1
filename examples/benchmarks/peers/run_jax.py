"""Jobs on JAX: `jit` of a `lax.scan` over substeps, each of them checkpointed, differentiated by `vjp`."""

import jax
import jax.numpy as jnp
import numpy as np
from job import answer_all, timed


def cofactor(F):
    a, b, c = F[..., 0], F[..., 1], F[..., 2]
    return jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], -1)


def make_rollout(job):
    """start, velocities, (mu, lam) -> positions of the frames."""
    tet, B = jnp.asarray(job.tetrahedra), jnp.asarray(np.linalg.inv(job.rest_edges), jnp.float32)
    W, m = jnp.asarray(job.volumes, jnp.float32), jnp.asarray(job.masses, jnp.float32)[:, None]
    free = np.ones((len(job.vertices), 1), np.float32)
    free[job.fixed] = 0
    gravity = jnp.array([0, float(job.gravity), 0], jnp.float32)

    def floor(d):
        if not job.ground.size:
            return 0 * d
        k, width = (float(a) for a in job.ground)
        s = jnp.minimum(d / width, 1.0)
        return k * width * (s - 1) * (2 * jnp.log(s) + (s - 1) / s)

    def force(x, mu, lam):
        X = x[tet]
        F = jnp.moveaxis(X[:, 1:] - X[:, :1], 1, 2) @ B
        C = cofactor(F)
        J, Ic = (F[..., 0] * C[..., 0]).sum(-1), (F * F).sum((1, 2))
        a, b = 4 * mu / 3 * (1 - 1 / (Ic + 1)), (lam + 5 * mu / 6) * (J - 1) - mu
        P = a[:, None, None] * F + b[:, None, None] * C
        f = jnp.moveaxis(-W[:, None, None] * (P @ jnp.swapaxes(B, 1, 2)), 2, 1)
        f = jnp.concatenate([-f.sum(1, keepdims=True), f], 1)
        return jnp.zeros_like(x).at[tet.ravel()].add(f.reshape(-1, 3)).at[:, 1].add(floor(x[:, 1]))

    def rollout(start, velocities, moduli):
        def substep(state, _):
            x, v = state
            v = float(job.keep) * free * (v + float(job.h) * (force(x, *moduli) / m + gravity))
            return (x + float(job.h) * v, v), None

        def frame(state, _):
            state, _ = jax.lax.scan(jax.checkpoint(substep), state, None, length=job.substeps)
            return state, state[0]

        _, seen = jax.lax.scan(frame, (start, velocities), None, length=job.frames)
        return jnp.concatenate([start[None], seen])

    return rollout


def work(job):
    rollout, worlds = make_rollout(job), job.worlds
    start, velocities = (jnp.asarray(np.tile(x, (worlds, 1, 1)), jnp.float32) for x in (job.start, job.velocities))
    moduli = tuple(jnp.full((worlds, len(job.tetrahedra)), a, jnp.float32) for a in (job.mu, job.lam))
    if not job.differentiates:
        compiled = jax.jit(jax.vmap(rollout))
        seconds, positions = timed(lambda: np.asarray(compiled(start, velocities, moduli)), job.repeats)
        return seconds, positions[0], {}
    weights, linear, square, target, rest = (
        jnp.asarray(a, jnp.float32) for a in (job.weights, job.linear, job.square, job.target, job.vertices)
    )

    @jax.jit
    @jax.vmap
    def both(start, velocities, moduli):
        positions, back = jax.vjp(lambda x, m: rollout(x, velocities, m), start, moduli)
        q = jnp.tensordot(positions - rest, weights, 2)
        slope = (linear + square * (q - target)).at[0].set(0)
        return positions, back(slope[:, None, None] * weights)

    seconds, (positions, (by_start, by_moduli)) = timed(
        lambda: jax.block_until_ready(both(start, velocities, moduli)), job.repeats
    )
    by_mu, by_lam = (float(np.asarray(a[0], float).sum()) for a in by_moduli)
    return (
        seconds,
        positions[0],
        dict(youngs_modulus=job.by_youngs_modulus(by_mu, by_lam), initial_positions=np.asarray(by_start[0], float)),
    )


if __name__ == "__main__":
    answer_all(work)
