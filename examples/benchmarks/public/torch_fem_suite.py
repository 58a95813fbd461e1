"""torch-fem's benchmarks of statics: a linear cube that is drawn out, a cantilever of random densities, a large stretch.

    python examples/benchmarks/public/torch_fem_suite.py [--quick] [--peers FOLDER]
    python examples/benchmarks/public/torch_fem_suite.py --one CASE N        # one measurement, in this process

- cube N: N vertices along each edge of a unit cube, E = 1000 Pa, nu = 0.3, one face held, the opposite one moved along x
  by 0.1 and free across. The gradient of the sum of all displacements by the forces on all vertices. Value: the force.
- topology N: 2N x N x N cells, 2 x 1 x 1 m, E = 70000 Pa (1e-3 + (1 - 1e-3) rho^3), rho = clip(0.5 + 0.3 normal, 0.05,
  0.95) by NumPy's default_rng(0), nu = 0.3, one end held, 1 N evenly over the other. The gradient of compliance by all rho.
  Value: the compliance.
- stretch N: torch_fem_stretch.py. Value: the force, exactly 3839.48 N.

Equal: unknowns, constants, float64, one process for each row, whose peak memory is that of all of it (torch-fem's too).
Not equal: torch-fem has hexahedra where ours are five tetrahedra to a cell, which are stiffer; tolerances are 1e-8 of
the residual in both, and torch-fem's linear solver goes to 1e-10. Ours is timed when kernels are compiled, torch-fem
here after a small problem. Both may use all cores. Published rows are first calls on other machines, by a version
before 0.14.0; so they have no ratio to ours. Large problems are left to the published numbers.

"off" is the value against the exact force of the stretch, and for the cube against 103.037 N, the limit of ten-node
tetrahedra, graded towards the held edges, on 4 to 16 cells (103.154, 103.054, 103.043, 103.040 N).

Published: https://github.com/meyer-nils/torch-fem, benchmarks/results at 829ea00, 17 August 2026, MIT licence, float64,
torch-fem's hexahedra; the setup is not in its forward seconds.
"""

import json
import sys
import time

import numpy as np
from table import HERE, asked, environment, parser, peak_memory, ratio, report, work
from threadpoolctl import threadpool_limits
from torch_fem_stretch import FORCE, stretched

import diffsim_ti as ds

# (case, N): {hardware: (forward [s], gradient [s], peak memory [MB])}
PUBLISHED = {
    ("cube", 20): {"i7-13700K": (0.725, 0.716, 925), "Threadripper Pro 9975": (0.445, 0.552, 960)},
    ("cube", 40): {"i7-13700K": (6.34, 1.88, 3089), "Threadripper Pro 9975": (3.26, 1.10, 3369)},
    ("cube", 60): {"i7-13700K": (23.4, 5.55, 9081), "Threadripper Pro 9975": (11.8, 3.12, 9178)},
    ("topology", 20): {"i7-13700K": (2.04, 1.44, 1357), "Threadripper Pro 9975": (1.27, 0.934, 1393)},
    ("topology", 30): {"i7-13700K": (6.85, 3.50, 2850), "Threadripper Pro 9975": (3.90, 2.17, 2886)},
    ("topology", 40): {"i7-13700K": (17.7, 7.76, 7081), "Threadripper Pro 9975": (10.3, 5.53, 5958)},
    ("stretch", 35): {"i7-13700K": (24.8, 7.36, 2287), "Threadripper Pro 9975": (14.9, 3.97, 2569)},
    ("stretch", 65): {"i7-13700K": (77.9, 19.9, 6221), "Threadripper Pro 9975": (37.3, 9.06, 7024)},
}
# of what torch-fem itself is asked here
ALSO_HERE = {("cube", 20), ("cube", 40), ("topology", 20), ("topology", 30), ("stretch", 35)}
QUICK = (("cube", 8), ("topology", 5), ("stretch", 7))


def cube(n: int, ten_nodes: bool = False):
    mesh = ds.TetrahedralMesh.create_box(n, 1.0, pattern="five")
    mesh = mesh.quadratic() if ten_nodes else mesh
    zeros = np.zeros((mesh.num_vertices, 3))
    scene = ds.Scene(
        mesh,
        ds.LinearElastic(1000.0, 0.3),
        1.0,
        ds.ExternalForce(zeros),
        fixed={"xmin": "xyz", "xmax": "x"},
        motion={"xmax": lambda t: [0.1, 0.0, 0.0]},
        precision="f64",
    )
    force = ds.Reaction("xmax")

    def solve():
        rollout = ds.Rollout(ds.StaticSolver(scene), 1, gradients=["external_forces"], outputs=[force])
        frames = rollout.forward()
        seed = np.zeros_like(frames.displacements)
        seed[-1] = 1.0
        return float(frames["reaction"][-1, 0]), lambda: rollout.vjp(frames, displacements=seed)

    return scene, solve


def stiffness(n: int):
    """Young's moduli [Pa] and densities of cells, and cells along the axes."""
    cells = np.array([2 * n, n, n])
    rho = np.clip(0.5 + 0.3 * np.random.default_rng(0).standard_normal(cells.prod()), 0.05, 0.95)
    return 70000.0 * (1e-3 + (1 - 1e-3) * rho**3), rho, cells


def topology(n: int):
    moduli, rho, cells = stiffness(n)
    mesh = ds.TetrahedralMesh.create_box(cells + 1, (2.0, 1.0, 1.0), pattern="five")
    cell = np.ravel_multi_index((mesh.centroids * n).astype(int).T, cells)
    end = mesh.vertex_sets["xmax"]
    inner = ((mesh.vertices[end, 1:] > 1e-9) & (mesh.vertices[end, 1:] < 1 - 1e-9)).sum(1)
    load = np.outer(2.0**inner / (4 * n**2), [0.0, 0.0, -1.0])
    scene = ds.Scene(
        mesh, ds.LinearElastic(moduli[cell], 0.3), 1.0, ds.ExternalForce(load, end), fixed="xmin", precision="f64"
    )

    def solve():
        rollout = ds.Rollout(ds.StaticSolver(scene), 1, gradients=["youngs_modulus"])
        frames = rollout.forward()
        seed = np.zeros_like(frames.displacements)
        seed[-1, end] = load

        def gradient():
            by_modulus = rollout.vjp(frames, displacements=seed)["youngs_modulus"]
            return np.bincount(cell, by_modulus) * 70000.0 * (1 - 1e-3) * 3 * rho**2

        return float((load * frames.displacements[-1][end]).sum()), gradient

    return scene, solve


def stretch(n: int):
    rollout = stretched(n)

    def solve():
        frames = rollout.forward()
        seed = np.zeros_like(frames["reaction"])
        seed[-1, 0] = 1.0
        return float(frames["reaction"][-1, 0]), lambda: rollout.vjp(frames, reaction=seed)

    return rollout.solver.scene, solve


CASES = {"cube": cube, "topology": topology, "stretch": stretch, "cube of ten nodes": lambda n: cube(n, ten_nodes=True)}
EXACT = {"cube": 103.037, "stretch": FORCE}


def measured(case: str, n: int) -> dict:
    """Seconds and memory of a case; the first of two runs compiles."""
    for _ in range(2):
        begin = time.perf_counter()
        scene, solve = CASES[case](n)
        made = time.perf_counter()
        value, gradient = solve()
        solved = time.perf_counter()
        gradient()
        end = time.perf_counter()
    return dict(
        unknowns=3 * scene.mesh.num_vertices,
        setup=made - begin,
        forward=solved - made,
        gradient=end - solved,
        memory=peak_memory(),
        value=value,
    )


def main(quick: bool, peers) -> list:
    python, reason = (
        environment(peers, "torch-fem", *work.PINNED["torch-fem"]) if peers else ("", "no --peers FOLDER was given")
    )
    rows = []

    def row(case, n, what, found, ours=None):
        if "error" in found:
            rows.append((f"{case} {n}", what, "", "", "", "", "", found["error"], ""))
            return
        shown = [ratio(found[key], ours[key]) if ours else found[key] for key in ("forward", "gradient", "memory")]
        value, right = found.get("value"), EXACT.get(case)
        seen = ("", "") if value is None else (f"{value:.6g}", f"{100 * abs(value / right - 1):.2g}" if right else "")
        rows.append((f"{case} {n}", what, str(found.get("unknowns", "")), found.get("setup"), *shown, *seen))

    for case, n in QUICK if quick else PUBLISHED:
        ours = asked(sys.executable, HERE / "torch_fem_suite.py", "--one", case, n)
        row(case, n, "diffsim_ti", ours)
        if "error" in ours:
            continue
        if python and (quick or (case, n) in ALSO_HERE):
            row(case, n, "torch-fem here", asked(python, HERE / "torch_fem_peer.py", case, n, "hexahedra"), ours)
        for hardware, numbers in PUBLISHED.get((case, n), {}).items():
            found = dict(zip(("forward", "gradient", "memory"), numbers))
            row(case, n, f"torch-fem published, {hardware}", found)
        if (case, n) == ("cube", 20):
            ten = asked(sys.executable, HERE / "torch_fem_suite.py", "--one", "cube of ten nodes", 9)
            row(case, n, "diffsim_ti, ten nodes", ten)
    head = (
        "problem",
        "by",
        "unknowns",
        "setting up [s]",
        "forward [s]",
        "gradient [s]",
        "memory [MB]",
        "value",
        "off [%]",
    )
    notes = "" if python else f"torch-fem is left out: {reason.rstrip('.')}."
    report("torch_fem_suite", head, rows, quick or not peers, notes, **(work.versions("torch-fem") if python else {}))
    return rows


if __name__ == "__main__":
    arguments = parser(__doc__)
    arguments.add_argument("--one", nargs=2, metavar=("CASE", "N"), help="one measurement, as JSON")
    options = arguments.parse_args()
    with threadpool_limits(1):
        if options.one:
            ds.init("cpu", precision="f64")
            print(json.dumps(measured(options.one[0], int(options.one[1]))))
        else:
            main(options.quick, options.peers)
