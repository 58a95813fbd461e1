"""Equilibria that are hard for linear solves: slender, nearly incompressible, of unequal stiffness, grown, held by springs.

    python tests/battery_of_equilibria.py --cases 200 --seed 1
    python tests/battery_of_equilibria.py --pairs                # every pair of terms in every implicit and static solver

Each ends in a state of balance, judged by a sparse direct solve of the linear problem (loads are small) or, where the body
grows, by its own forces, or says why not. Time is that of the solve against assembly and factorisation once in each round.
"""

import argparse
import itertools
import sys
import time
import warnings
from collections.abc import Callable

import numpy as np
import scipy.sparse.linalg
from chamber_meshes import hollow_cube

import diffsim_ti as ds

IMPLICIT = (ds.ImplicitEulerSolver, ds.BDF2Solver, ds.ImplicitMidpointSolver, ds.StaticSolver)
LAWS = (ds.StableNeoHookean, ds.StVenantKirchhoff, ds.Corotated)
ASPECTS = (1, 3, 10, 30, 100, 200)
ELEMENTS = ("linear", "ten nodes", "patches")


def terms_by_name(mesh: ds.TetrahedralMesh) -> dict[str, Callable[[], object]]:
    """What acts on a hollow cube; the first ones need no kernels of their own in implicit steps."""
    top = int(mesh.vertices.sum(1).argmax())
    return {
        "filled chamber": lambda: ds.FilledChamber(1.05e-3, "cavity"),
        "gas chamber": lambda: ds.GasChamber(1e5, "cavity"),
        "spring": lambda: ds.Spring(top, ds.Anchor([0.5, 0.5, 0.5]), 10.0),
        "cable": lambda: ds.Cable([0, top], tension=1.0),
        "elastic cable": lambda: ds.Cable([0, top], length=0.4, stiffness=10.0),
        "muscle": lambda: ds.Muscle([1, 0, 0], 1e3, 0.5),
        "foundation": lambda: ds.ElasticFoundation(1e4),
        "pressure": lambda: ds.Pressure(10.0),
        "traction": lambda: ds.Traction((0, 10.0, 0)),
        "surface drag": lambda: ds.SurfaceDrag(10.0),
        "rotating frame": lambda: ds.RotatingFrame((0, 1.0, 0)),
        "gravity": lambda: ds.Gravity(),
        "drag": lambda: ds.Drag(1.0),
        "force": lambda: ds.ExternalForce([0.0, 1.0, 0.0], [top]),
        "floor": lambda: ds.Ground(height=-0.01, width=0.005, stiffness_per_area=1e7),
        "self-contact": lambda: ds.SelfContact(width=0.002),
    }


def run_pair(mesh: ds.TetrahedralMesh, names: tuple, solver: type) -> str:
    """What two terms together end in, "" if in a finite state."""
    known = terms_by_name(mesh)
    try:
        scene = ds.Scene(
            mesh,
            ds.StableNeoHookean(1e5, 0.3),
            1000.0,
            [known[name]() for name in names],
            fixed="bottom",
            precision="f64",
        )
        own = solver(scene) if solver is ds.StaticSolver else solver(scene, dt=2e-3)
        return "" if np.isfinite(ds.Rollout(own, 2).forward().displacements).all() else "not finite"
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def draw(number: int, seed: int, cells: int) -> dict:
    """What case `number` is; the order of kinds is that of digits, sizes are random."""
    rng = np.random.default_rng((seed, number))
    element = ELEMENTS[number % 3]
    return dict(
        rng=rng,
        element=element,
        aspect=int(rng.choice(ASPECTS)),
        flat=bool(rng.integers(2)),
        cells=cells,
        nu=float(rng.choice([0.0, 0.3, 0.45, 0.49, 0.4999])),
        contrast=10.0 ** float(rng.choice([0, 0, 2, 4, 6])),
        law=LAWS[rng.integers(3)],
        grown=float(rng.choice([0.0, 0.0, 1e-3, 3e-3])) * (element != "patches"),
        held=str(rng.choice(["clamp", "clamp", "foundation", "springs", "tied pieces"])),
        preconditioner=str(rng.choice(["auto", "auto", "block_jacobi", "multigrid"])),
        precision="f64",
    )


def scene_of(case: dict, weight: float = 1.0) -> ds.Scene:
    """Its scene; a bar along x, of h x h, or h x 4 h, in section, under its weight, or of bodies that grow under none."""
    rng, h = case["rng"], 0.01
    across = (2, 2) if case["aspect"] > 20 else (3, 3)
    along = int(np.clip(case["aspect"] * (across[0] - 1), 3, case["cells"]))
    size = (case["aspect"] * h, h, 4 * h if case["flat"] else h)
    mesh = ds.TetrahedralMesh.create_box((along + 1, *(a + 1 for a in across)), size)
    if case["held"] == "tied pieces":
        other = ds.TetrahedralMesh.create_box((along + 1, *(a + 1 for a in across)), size, origin=(size[0], 0, 0))
        n, ends = mesh.num_vertices, (mesh.vertex_indices("xmax"), other.vertex_indices("xmin"))
        mesh = ds.TetrahedralMesh.joined([mesh, other])
    up = mesh.vertices[mesh.tetrahedra].mean(1)[:, 1] > 0.5 * h
    mesh = mesh.with_tetrahedron_set("up", up).with_tetrahedron_set("low", ~up)
    mesh = mesh.with_vertex_set("left", np.flatnonzero(mesh.vertices[:, 0] < 1e-9))
    E = 10 ** rng.uniform(4, 9)
    law, moduli = case["law"], {"up": E, "low": E / case["contrast"]}
    patches = case["element"] == "patches"
    if case["element"] == "ten nodes":
        mesh = mesh.quadratic()
    material = law(moduli, case["nu"])
    if case["grown"]:
        material = ds.Grown(material, {"up": 0.0, "low": case["grown"]})
    soft = E / case["contrast"]
    terms = [] if case["grown"] else [ds.Gravity((0.0, -weight, 0.3 * weight))]
    fixed = "left"
    if case["held"] == "foundation":
        terms, fixed = [*terms, ds.ElasticFoundation(soft / h, 0.1 * soft / h)], None
    if case["held"] == "springs":
        own = rng.choice(mesh.num_vertices, 12, replace=False)
        anchors = mesh.vertices[own] + rng.normal(size=(12, 3)) * h
        terms, fixed = [*terms, ds.Spring(own, ds.Anchor(anchors), soft * h)], None
    if case["held"] == "tied pieces":
        terms = [*terms, ds.Spring(ends[0], ends[1] + n, soft * h)]
    volume = "patches" if patches else None
    options = dict(fixed=fixed, precision=case["precision"], **(dict(volume=volume) if volume else {}))
    return ds.Scene(mesh, material, 1000.0, terms, **options)


def direct(scene: ds.Scene) -> tuple[np.ndarray, float]:
    """(displacements of the linear problem, seconds of assembly and factorisation)."""
    scene.stiffness_matrix()  # compiles
    begin, n = time.perf_counter(), scene.mesh.num_vertices
    K = scene.stiffness_matrix()
    free = np.flatnonzero(np.repeat(~np.isin(np.arange(n), scene.supports.fixed), 3))
    factors = scipy.sparse.linalg.splu(
        K[free][:, free].tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=dict(SymmetricMode=True)
    )
    seconds = time.perf_counter() - begin
    solver = ds.StaticSolver(scene)
    workspace = solver.workspace(solver.start_values())
    loads = workspace.loads(0, solver.stage(0.0, True, 0))
    u = np.zeros(3 * n)
    u[free] = factors.solve(loads.ravel()[free])
    r = loads.ravel()[free] - K[free][:, free] @ u[free]
    u[free] += factors.solve(r)
    return u.reshape(-1, 3), seconds


def judged(number: int, seed: int, cells: int) -> dict:
    """What came of a case: error, or what was said; seconds, and what a factorisation in each round takes."""
    case = draw(number, seed, cells)
    warnings.simplefilter("ignore")
    scene = scene_of(case)
    expected, once = direct(scene)
    if expected.any():  # a load that bends it by little
        case = draw(number, seed, cells)
        scene = scene_of(case, 1e-7 / np.abs(expected).max())
        expected, once = direct(scene)
    tolerance = 1e-8 if case["precision"] == "f64" else 1e-4
    solver = ds.StaticSolver(scene, preconditioner=case["preconditioner"], tolerance=tolerance)
    out = dict(said="", once=once, rounds=1, error=0.0)
    for _ in range(2):  # the first compiles
        simulator, begin = ds.Simulator(solver), time.perf_counter()
        try:
            simulator.step()
        except ds.NotConverged as error:
            return out | dict(said=str(error), seconds=time.perf_counter() - begin)
        seconds = time.perf_counter() - begin
    if expected.any():
        u = simulator.positions - scene.mesh.vertices
        out["error"] = np.abs(u - expected).max() / np.abs(expected).max()
    return out | dict(seconds=seconds, rounds=int(simulator.report.iterations))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cells", type=int, default=100, help="cells along a bar, at most")
    parser.add_argument("--slow", type=float, default=3.0, help="times that of a factorisation in each round")
    parser.add_argument("--pairs", action="store_true")
    options = parser.parse_args()
    ds.init(precision="f64")
    bad = 0
    if options.pairs:
        mesh = hollow_cube()
        for names in itertools.combinations(terms_by_name(mesh), 2):
            for solver in IMPLICIT:
                said = run_pair(mesh, names, solver)
                bad += bool(said) and not said.startswith("ValueError")  # that is what is refused
                if said:
                    print(*names, solver.__name__, said[:200], flush=True)
        return int(bad > 0)
    for number in range(options.cases):
        case, found = draw(number, options.seed, options.cells), judged(number, options.seed, options.cells)
        ratio = (found["seconds"] - 0.5) / (found["once"] * (found["rounds"] + 2))  # one more looks for saddles
        wrong = found["error"] > 1e-3 or found["said"] or ratio > options.slow
        bad += bool(wrong)
        plain = {k: v if not hasattr(v, "__name__") else v.__name__ for k, v in case.items() if k != "rng"}
        numbers = f"{found['seconds']:.2f} s, {ratio:.1f} x, {found['rounds']} rounds, error {found['error']:.1e}"
        print("BAD" if wrong else "ok ", number, numbers, plain, found["said"][:150], flush=True)
    print(f"{bad} of {options.cases} are wrong, slow or not found")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
