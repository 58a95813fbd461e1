"""The common work of benchmark.py on whatever of torch-diffsim, NVIDIA Warp and JAX is installed, next to ours, in one run.

    python examples/compare_peers.py [--peer-python PATH] [--rounds 3]

Each system runs in its own process, one after the other, for several rounds; the best of each counts. --peer-python names
an interpreter whose environment holds the peers (they need not share ours). Prints ns per tetrahedron and substep.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

CUBE = """
import json, time
import numpy as np
SUBSTEPS, H = 20, 2.5e-4


def cube(n):
    x = np.linspace(0, 1, n)
    V = np.stack(np.meshgrid(x, x, x, indexing="ij"), -1).reshape(-1, 3)
    i, j, k = (a.ravel() for a in np.meshgrid(*[np.arange(n - 1)] * 3, indexing="ij"))
    T = []
    for order in [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]:
        c = [0, 0, 0]
        corners = [(i * n + j) * n + k]
        for axis in order:
            c[axis] = 1
            corners.append(((i + c[0]) * n + j + c[1]) * n + k + c[2])
        T.append(np.stack(corners, -1))
    T = np.stack(T, 1).reshape(-1, 4)
    D = V[T[:, 1:]] - V[T[:, :1]]
    flip = np.linalg.det(D) < 0
    T[flip] = T[flip][:, [0, 2, 1, 3]]
    return V, T


def best(function, repeats):
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def report(who, M, forward, both):
    scale = 1e9 / (SUBSTEPS * M)
    row = {"who": who, "tets": M, "forward_ns": forward * scale, "forward_backward_ns": both * scale}
    print(json.dumps(row), flush=True)
"""

TORCH_DIFFSIM = """
import torch
from diffsim import (DifferentiableMaterial, DifferentiableSimulator, DifferentiableSolver, SemiImplicitSolver, Simulator,
                     StableNeoHookean, TetrahedralMesh)
for n in SIZES:
    V, T = cube(n)
    lift = torch.tensor([0.0, 5.0, 0.0])  # its ground plane cannot be switched off
    rest = TetrahedralMesh(V + lift.numpy(), T)
    stretched = torch.as_tensor(V, dtype=torch.float32) * 1.01 + lift
    plain = Simulator(rest, StableNeoHookean(1e5, 0.4), SemiImplicitSolver(dt=1e-3, damping=0.999, substeps=4))
    plain.positions = stretched.clone()
    plain.step()
    simulator = DifferentiableSimulator(rest, DifferentiableMaterial(1e5, 0.4),
                                        DifferentiableSolver(dt=1e-3, damping=0.999, substeps=4))

    def both():
        simulator.reset()
        simulator.positions = stretched.clone().requires_grad_(True)
        for _ in range(5):
            simulator.step()
        (simulator.positions ** 2).sum().backward()

    report("torch-diffsim", len(T), best(lambda: [plain.step() for _ in range(5)], 5), best(both, 4))
"""

WARP = """
import warp as wp
wp.config.quiet = True
wp.init()


@wp.func
def cofactor(F: wp.mat33):
    a = wp.vec3(F[0, 0], F[1, 0], F[2, 0])
    b = wp.vec3(F[0, 1], F[1, 1], F[2, 1])
    c = wp.vec3(F[0, 2], F[1, 2], F[2, 2])
    return wp.matrix_from_cols(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))


@wp.kernel
def forces(x: wp.array(dtype=wp.vec3), tet: wp.array2d(dtype=int), B: wp.array(dtype=wp.mat33), W: wp.array(dtype=float),
           mu: wp.array(dtype=float), lam: wp.array(dtype=float), f: wp.array(dtype=wp.vec3)):
    e = wp.tid()
    x0 = x[tet[e, 0]]
    F = wp.matrix_from_cols(x[tet[e, 1]] - x0, x[tet[e, 2]] - x0, x[tet[e, 3]] - x0) * B[e]
    m = 4.0 * mu[e] / 3.0
    l = lam[e] + 5.0 * mu[e] / 6.0
    P = m * (1.0 - 1.0 / (wp.ddot(F, F) + 1.0)) * F + (l * (wp.determinant(F) - 1.0) - 0.75 * m) * cofactor(F)
    Q = (P * wp.transpose(B[e])) * (-W[e])
    h1, h2, h3 = wp.vec3(Q[0, 0], Q[1, 0], Q[2, 0]), wp.vec3(Q[0, 1], Q[1, 1], Q[2, 1]), wp.vec3(Q[0, 2], Q[1, 2], Q[2, 2])
    wp.atomic_add(f, tet[e, 1], h1)
    wp.atomic_add(f, tet[e, 2], h2)
    wp.atomic_add(f, tet[e, 3], h3)
    wp.atomic_add(f, tet[e, 0], -(h1 + h2 + h3))


@wp.kernel
def advance(x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3), f: wp.array(dtype=wp.vec3), m: wp.array(dtype=float),
            h: float, x1: wp.array(dtype=wp.vec3), v1: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    w = 0.999 * (v[i] + h * (f[i] / m[i] + wp.vec3(0.0, -9.8, 0.0)))
    v1[i] = w
    x1[i] = x[i] + h * w


@wp.kernel
def squares(x: wp.array(dtype=wp.vec3), loss: wp.array(dtype=float)):
    i = wp.tid()
    wp.atomic_add(loss, 0, wp.dot(x[i], x[i]))


for n in SIZES:
    V, T = cube(n)
    N, M = len(V), len(T)
    D = np.moveaxis(V[T[:, 1:]] - V[T[:, :1]], 1, 2)
    volume = np.linalg.det(D) / 6
    mass = np.bincount(T.ravel(), np.repeat(250 * volume, 4))

    def array(a, dtype, **k):
        return wp.array(a, dtype=dtype, device="cpu", **k)

    def states(k):
        return [wp.zeros(N, dtype=wp.vec3, device="cpu", requires_grad=True) for _ in range(k)]

    tet, B = array(T.astype(np.int32), int), array(np.linalg.inv(D).astype(np.float32), wp.mat33)
    W, m = array(volume.astype(np.float32), float), array(mass.astype(np.float32), float)
    mu = array(np.full(M, 1e5 / 2.8, np.float32), float, requires_grad=True)
    lam = array(np.full(M, 1e5 * 0.4 / (1.4 * 0.2), np.float32), float, requires_grad=True)
    xs, vs, fs = states(SUBSTEPS + 1), states(SUBSTEPS + 1), states(SUBSTEPS)
    xs[0].assign((V * 1.01).astype(np.float32))
    loss = wp.zeros(1, dtype=float, device="cpu", requires_grad=True)

    def rollout():
        for f in fs:
            f.zero_()
        for s in range(SUBSTEPS):
            wp.launch(forces, M, inputs=[xs[s], tet, B, W, mu, lam], outputs=[fs[s]], device="cpu")
            wp.launch(advance, N, inputs=[xs[s], vs[s], fs[s], m, H], outputs=[xs[s + 1], vs[s + 1]], device="cpu")
        wp.launch(squares, N, inputs=[xs[SUBSTEPS]], outputs=[loss], device="cpu")

    def both():
        tape = wp.Tape()
        with tape:
            rollout()
        tape.backward(loss)
        tape.zero()

    rollout()
    both()
    report("warp (CPU)", M, best(rollout, 5), best(both, 4))
"""

JAX = """
import jax
import jax.numpy as jnp


def cofactor(F):
    a, b, c = F[..., 0], F[..., 1], F[..., 2]
    return jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], -1)


for n in SIZES:
    V, T = cube(n)
    M = len(T)
    D = np.moveaxis(V[T[:, 1:]] - V[T[:, :1]], 1, 2)
    volume = np.linalg.det(D) / 6
    mass = np.bincount(T.ravel(), np.repeat(250 * volume, 4))
    B, W, tet = jnp.asarray(np.linalg.inv(D), jnp.float32), jnp.asarray(volume, jnp.float32), jnp.asarray(T)
    m, gravity = jnp.asarray(mass, jnp.float32)[:, None], jnp.array([0, -9.8, 0.0])

    def force(x, mu, lam):
        X = x[tet]
        F = jnp.moveaxis(X[:, 1:] - X[:, :1], 1, 2) @ B
        C = cofactor(F)
        J, Ic = (F[..., 0] * C[..., 0]).sum(-1), (F * F).sum((1, 2))
        a, b = 4 * mu / 3 * (1 - 1 / (Ic + 1)), (lam + 5 * mu / 6) * (J - 1) - mu
        P = a[:, None, None] * F + b[:, None, None] * C
        h = jnp.moveaxis(-W[:, None, None] * (P @ jnp.swapaxes(B, 1, 2)), 2, 1)
        h = jnp.concatenate([-h.sum(1, keepdims=True), h], 1)
        return jnp.zeros_like(x).at[tet.ravel()].add(h.reshape(-1, 3))

    def loss(x, mu, lam):
        def step(state, _):
            x, v = state
            v = 0.999 * (v + H * (force(x, mu, lam) / m + gravity))
            return (x + H * v, v), None

        (x, _), _ = jax.lax.scan(step, (x, jnp.zeros_like(x)), None, length=SUBSTEPS)
        return (x ** 2).sum()

    arguments = (jnp.asarray(V * 1.01, jnp.float32), jnp.full(M, 1e5 / 2.8), jnp.full(M, 1e5 * 0.4 / (1.4 * 0.2)))
    plain, both = jax.jit(loss), jax.jit(jax.value_and_grad(loss, (0, 1, 2)))
    for f in (plain, both):
        jax.block_until_ready(f(*arguments))
    report("jax", M, *(best(lambda: jax.block_until_ready(f(*arguments)), 4) for f in (plain, both)))
"""

PEERS = {"torch-diffsim": TORCH_DIFFSIM, "warp": WARP, "jax": JAX}


def run_peer(python: str, code: str, sizes: list[int]) -> list[dict]:
    """Rows of one peer in a process of its own; none if it is not installed there."""
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder) / "peer.py"  # a file: Warp reads its kernels' source
        script.write_text(CUBE + f"SIZES = {sizes}\n" + code)
        done = subprocess.run([python, str(script)], capture_output=True, text=True)
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def run_ours(sizes: list[int]) -> list[dict]:
    command = [sys.executable, str(Path(__file__).with_name("benchmark.py")), "--json", "--sizes", *map(str, sizes)]
    return [json.loads(line) for line in subprocess.run(command, capture_output=True, text=True).stdout.splitlines()]


def compare(peer_python: str, sizes: list[int], rounds: int) -> dict:
    """{(who, tets): [best forward_ns, best forward_backward_ns]} over several rounds."""
    best: dict = {}
    for _ in range(rounds):
        for rows in (run_ours(sizes), *(run_peer(peer_python, code, sizes) for code in PEERS.values())):
            for row in rows:
                now = [row["forward_ns"], row["forward_backward_ns"]]
                known = best.setdefault((row["who"], row["tets"]), now)
                best[row["who"], row["tets"]] = [min(a, b) for a, b in zip(known, now)]
    return best


def table(best: dict) -> str:
    """Markdown: forward and forward + backward by size, and how many times longer than ours."""
    sizes = sorted({tets for _, tets in best})
    head = " | ".join(f"forward, {s:,} | + gradient" for s in sizes)
    lines = [f"| | {head} |", "| --- |" + " --- | --- |" * len(sizes)]
    for who in dict.fromkeys(w for w, _ in best):
        cells = []
        for s in sizes:
            ours = best["diffsim_ti", s]
            for value, own in zip(best.get((who, s), [float("nan")] * 2), ours):
                cells.append(f"{value:.0f}" + ("" if who == "diffsim_ti" else f" ({value / own:.1f}x)"))
        lines.append(f"| {who} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer-python", default=sys.executable, help="interpreter with the peers")
    parser.add_argument("--sizes", type=int, nargs="+", default=[6, 11, 21], help="vertices a side")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    print(table(compare(options.peer_python, options.sizes, options.rounds)))


if __name__ == "__main__":
    main()
