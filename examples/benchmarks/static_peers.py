"""Equilibria of a beam by ours, by Newton's method with sparse factors (SciPy's LU, CHOLMOD), by torch-fem and by JAX-FEM.

    python examples/benchmarks/static_peers.py --torch-fem PYTHON --jax-fem PYTHON --sizes 5000 25000

The beam of implicit_steps.py, E = 5e6 Pa, in float64, hangs from one end under its weight, in one load step. All that a
solve sets up is timed, compiling is not (the best of some repetitions in one process). CHOLMOD is taken where scikit-sparse
is installed. PYTHON: an interpreter whose environment holds the peer, which runs in a process of its own (peers/). Each
chooses its linear solver by itself, JAX-FEM by PETSc. Peers may use all cores; of ours BLAS has one thread, as the factors
have. Prints a table in Markdown, with the largest difference from ours in shares of the largest displacement.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from implicit_steps import TOLERANCE, DirectEuler, beam, print_table, scene_of
from peers import work
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_limits

import diffsim_ti as ds

PEERS = Path(__file__).parent / "peers"
E = 5e6  # Pa; Newton's method with factors alone does not find what hangs farther


def best(solve, repeats: int) -> tuple:
    """(least time [s], the displacements)"""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        u = solve()
        times.append(time.perf_counter() - begin)
    return min(times), u


def ours(scene) -> np.ndarray:
    solver = ds.StaticSolver(scene, tolerance=TOLERANCE)
    workspace = solver.workspace(solver.start_values())
    workspace.advance(0, 1, 1)
    return workspace.u_star


class Direct(DirectEuler):
    """Without inertia."""

    def __init__(self, scene, factorised):
        super().__init__(scene)
        self.mass, self.factorised = 0 * self.mass, factorised

    def solve(self) -> np.ndarray:
        u, size = self.u, 0.0
        for _ in range(50):
            R, now = self.residual(u, self.u)
            size = max(size, now)
            if np.linalg.norm(R) <= TOLERANCE * size:
                break
            step, share = self.factorised(self.matrix(u))(R.ravel()).reshape(-1, 3), 1.0
            while np.linalg.det(np.swapaxes((u + share * step)[self.tets], 1, 2) @ self.N + np.eye(3)).min() <= 0:
                share *= 0.5
            u = u + share * step
        return u


def lu(A):
    return splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options=dict(SymmetricMode=True)).solve


def direct_solvers() -> dict:
    """{name: matrix -> solve}"""
    out = {"SciPy LU": lu}
    try:
        from sksparse.cholmod import cholesky

        out["CHOLMOD"] = lambda A: cholesky(A, mode="supernodal")
    except ImportError:
        pass
    return out


def job_of(scene, repeats: int) -> dict:
    mu, lam = (float(x) for x in scene.material.lame(scene.material.values(scene.mesh)))
    weight, mass = scene.term(ds.Gravity).values["gravity"], scene.inputs.derive(scene.inputs.values).mass
    return dict(
        vertices=scene.mesh.vertices,
        tetrahedra=scene.mesh.tetrahedra,
        fixed=scene.fixed,
        mu=mu,
        lam=lam,
        loads=mass[:, None] * weight,
        weight=1000.0 * np.asarray(weight),
        tolerance=TOLERANCE,
        repeats=repeats,
    )


def asked(script: str, python: str, job: dict) -> tuple | None:
    """(time [s], displacements) of a peer, None if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [str(Path(folder) / name) for name in ("job.npz", "answer.npz")]
        np.savez(paths[0], **job)
        _, why = work.ran([python, PEERS / script, *paths])
        if why:
            print(f"{script}: {why}")
            return None
        with np.load(paths[1]) as answer:
            return float(answer["seconds"]), answer["displacements"]


def main(sizes, peers: dict, repeats: int = 3, most_direct: int = 60_000) -> list:
    """Rows (tetrahedra, ours [s], times of the others [s] ...), printed as a table."""
    names, rows = [*direct_solvers(), *peers], []
    for size in sizes:
        scene = scene_of(beam(size), E)
        ours(scene)  # compiles
        seconds, u = best(lambda: ours(scene), repeats)
        found = {}
        for name, factorised in direct_solvers().items():
            if scene.mesh.num_tetrahedra <= most_direct:
                found[name] = best(lambda: Direct(scene, factorised).solve(), min(repeats, 2))
        for name, (script, python) in peers.items():
            found[name] = asked(script, python, job_of(scene, repeats))
        cells = [seconds]
        for name in names:
            if found.get(name) is None:
                cells.append("")
                continue
            other, u_other = found[name]
            off = np.abs(u_other - u).max() / np.abs(u).max()
            cells.append(f"{other:.3g} ({other / seconds:.1f}x, {off:.0e})")
        rows.append((scene.mesh.num_tetrahedra, *cells))
    print_table(["tetrahedra", "diffsim_ti [s]", *(f"{name} [s] (times ours, difference)" for name in names)], rows)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[5_000, 10_000, 25_000, 50_000])
    parser.add_argument("--torch-fem", help="an interpreter that has it")
    parser.add_argument("--jax-fem", help="an interpreter that has it")
    options = parser.parse_args()
    ds.init("cpu", precision="f64")
    with threadpool_limits(1):
        main(
            options.sizes,
            {
                name: (f"static_{name.lower().replace('-', '_')}.py", python)
                for name, python in (("torch-fem", options.torch_fem), ("JAX-FEM", options.jax_fem))
                if python
            },
        )
