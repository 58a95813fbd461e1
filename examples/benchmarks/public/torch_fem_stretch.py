"""torch-fem's published stretch of a plate to ten times its thickness, with the gradient of the force by both moduli.

    python examples/benchmarks/public/torch_fem_stretch.py [--quick] [--vertices 35 65]

4 x (N-1) x (N-1) cubic cells, 4/(N-1) x 1 x 1 m, psi = mu/2 (I_C - 3) - mu ln J + lambda/2 ln^2 J, E = 1000 Pa, nu = 0.3.
Both ends are fixed along x, the two middle planes by symmetry; in ten increments, geometric in stretch, the body gets ten
times as long, in float64. The force is exactly 3839.48 N. Forward: the ten equilibria, with all that a solve sets up,
without compiling; gradient: the force's by Young's modulus and Poisson's ratio, after that. Cells are cut into five
tetrahedra, where torch-fem has hexahedra. Prints a table, and the exponent with which time grows with unknowns.
torch_fem_suite.py has the same beside torch-fem.
"""

import argparse
import time
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

import diffsim_ti as ds
from diffsim_ti.differentiation import x_minus_log1p
from diffsim_ti.materials import EnergyLaw, Material
from diffsim_ti.materials.calculus.tensor import invariants

E, NU, STRETCH, INCREMENTS, FORCE = 1000.0, 0.3, 10.0, 10, 3839.48


@dataclass(frozen=True)
class LogarithmicLaw(EnergyLaw):
    """mu/2 (I_C - 3) - mu ln J + lambda/2 ln^2 J, by j = J - 1 and s = I_C - 3 - 2 j"""

    coefficient_names = ("mu", "lam")

    def psi(self, H, p):
        (mu, lam), (_, j, s) = p, invariants(H)
        left = x_minus_log1p(j)  # j - ln J
        return 0.5 * mu * s + mu * left + 0.5 * lam * (j - left) ** 2


class Logarithmic(Material):
    """The material of torch-fem's benchmark: youngs_modulus [Pa], poissons_ratio."""

    def law(self, precision: str) -> LogarithmicLaw:
        return LogarithmicLaw(precision)


def plate(n: int) -> ds.TetrahedralMesh:
    """Of 5 x n x n vertices, with its two middle planes."""
    length = 4 / (n - 1)
    mesh = ds.TetrahedralMesh.create_box((5, n, n), (length, 1.0, 1.0), pattern="five")
    middle = np.abs(mesh.vertices - [0.5 * length, 0.5, 0.5]) < 1e-9
    return mesh.with_vertex_set("middle y", middle[:, 1]).with_vertex_set("middle z", middle[:, 2])


def stretched(n: int) -> ds.Rollout:
    """The ten increments."""
    mesh, length = plate(n), 4 / (n - 1)
    scene = ds.Scene(
        mesh,
        Logarithmic(E, NU),
        1.0,
        fixed={"xmin": "x", "xmax": "x", "middle y": "y", "middle z": "z"},
        motion={"xmax": lambda t: [length * (STRETCH ** (t / INCREMENTS) - 1), 0.0, 0.0]},
        precision="f64",
    )
    moduli = ["youngs_modulus", "poissons_ratio"]
    return ds.Rollout(ds.StaticSolver(scene, dt=1.0), INCREMENTS, gradients=moduli, outputs=[ds.Reaction("xmax")])


def measured(n: int, repeats: int) -> tuple[float, float, float, float, dict]:
    """(forward [s], gradient [s], products with the Hessian, force [N], its gradient by both moduli), the least of some."""
    best = (np.inf, np.inf)
    for run in range(repeats + 1):  # the first compiles
        rollout, begin = stretched(n), time.perf_counter()
        frames = rollout.forward()
        middle = time.perf_counter()
        force = frames["reaction"]
        seed = np.zeros_like(force)
        seed[-1, 0] = 1.0
        gradient = rollout.vjp(frames, reaction=seed)
        times = middle - begin, time.perf_counter() - middle
        best = tuple(min(pair) for pair in zip(best, times if run else (np.inf, np.inf)))
    return *best, rollout.report.products, float(force[-1, 0]), gradient


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small plate, once")
    parser.add_argument("--vertices", type=int, nargs="+", default=[35, 65], help="along the long edges, odd")
    parser.add_argument("--repeats", type=int, default=2)
    options = parser.parse_args()
    sizes, repeats = ([9, 13], 1) if options.quick else (options.vertices, options.repeats)
    rows = []
    print("| unknowns | forward [s] | gradient [s] | products | force [N] |\n" + 5 * "| ---: " + "|")
    for n in sizes:
        forward, gradient, products, force, _ = measured(n, repeats)
        rows.append((15 * n * n, forward))
        print(f"| {15 * n * n} | {forward:.2f} | {gradient:.2f} | {products} | {force:.2f} |", flush=True)
        assert abs(force - FORCE) < 0.01, f"the force is {FORCE} N"
    if len(rows) > 1:
        power = np.polyfit(*np.log(np.array(rows)).T, 1)[0]
        print(f"\nforward grows with the power {power:.2f} of the unknowns")


if __name__ == "__main__":
    ds.init("cpu", precision="f64")
    with threadpool_limits(1):
        main()
