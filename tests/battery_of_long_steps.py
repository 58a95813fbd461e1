"""Implicit steps of stiff and light bodies: python tests/battery_of_long_steps.py --cases 200 --seed 0.

A block is loaded all at once. Moduli, densities, steps, laws, elements and loads are drawn over many decades. Judges: where
strains are small a first step is the solution of (c M + K) u = c M a + f, solved by SciPy with the stiffness matrix at
rest; after six long steps of backward Euler or BDF2 the body is where a static solver with load steps puts it. A run may
raise NotConverged, but not end elsewhere.
"""

import argparse
import sys
import warnings

import numpy as np
import scipy.sparse.linalg

import diffsim_ti as ds

LAWS = {
    "LinearElastic": lambda E: ds.LinearElastic(E, 0.3),
    "StVenantKirchhoff": lambda E: ds.StVenantKirchhoff(E, 0.3),
    "StableNeoHookean": lambda E: ds.StableNeoHookean(E, 0.3),
    "SmithNeoHookean": lambda E: ds.SmithNeoHookean(E, 0.3),
    "Corotated": lambda E: ds.Corotated(E, 0.3),
    "MooneyRivlin": lambda E: ds.MooneyRivlin(E, 0.3, c01_share=0.3),
    "Yeoh": lambda E: ds.Yeoh(0.2 * E, 0.02 * E, 0.0, E),
    "Gent": lambda E: ds.Gent(0.4 * E, 30.0, E),
    "Ogden": lambda E: ds.Ogden([0.4 * E], [2.0], E),
    "KelvinVoigt": lambda E: ds.KelvinVoigt(ds.StableNeoHookean(E, 0.3), time=1e-9),
}
SOLVERS = {s.__name__: s for s in (ds.ImplicitEulerSolver, ds.BDF2Solver, ds.ImplicitMidpointSolver)}
LOADS = ("traction", "pressure", "weight", "motion", "plate")
SIZE, SUPPORTS = 0.1, {"xmin": "x", "ymin": "y", "zmin": "z"}
LONG = 30.0  # times as long as waves take through the block: so many steps settle to less than 1 %


def draw(rng: np.random.Generator, laws=tuple(LAWS), orders=(1, 2), loads=LOADS) -> dict:
    """A case: numbers and names alone."""
    return dict(
        law=str(rng.choice(laws)),
        solver=str(rng.choice(list(SOLVERS))),
        load=str(rng.choice(loads)),
        order=int(rng.choice(orders)),
        E=10 ** rng.uniform(3, 12),
        density=10 ** rng.uniform(-3, 4.3),
        h=10 ** rng.uniform(-5, 1),
        strain=10 ** rng.uniform(-6, -1),
        sign=float(rng.choice([-1, 1])),
    )


def scene_of(case: dict) -> ds.Scene:
    """The block with its load, of about the strain that is asked for."""
    mesh = ds.TetrahedralMesh.create_box(2 + (case["order"] == 1), SIZE)
    mesh = mesh.quadratic() if case["order"] == 2 else mesh
    stress, terms, motion, fixed = case["sign"] * case["strain"] * case["E"], [], None, dict(SUPPORTS)
    if case["load"] == "traction":
        terms = [ds.Traction((stress, 0.3 * stress, 0), "xmax")]
    elif case["load"] == "pressure":
        terms = [ds.Pressure(stress, "xmax")]
    elif case["load"] == "weight":
        terms = [ds.Gravity((0, stress / (case["density"] * SIZE), 0))]
    elif case["load"] == "plate":  # which comes by the strain and its barrier's width in one step, and stays
        width, way = 0.1 * SIZE, case["strain"] * SIZE + 0.1 * SIZE
        options = dict(stiffness_per_area=30 * case["E"] / width, width=width)
        terms = [ds.HalfSpace((1.1 * SIZE, 0, 0), (-1, 0, 0), path=_reaching(-way, case["h"]), **options)]
    else:
        fixed["xmax"], motion = "x", {"xmax": _reaching(case["sign"] * case["strain"] * SIZE, case["h"])}
    return ds.Scene(mesh, LAWS[case["law"]](case["E"]), case["density"], terms, fixed, motion, precision="f64")


def _reaching(x: float, end: float):
    return lambda t: (x * min(t / end, 1.0), 0, 0)


def linear_step(scene: ds.Scene, load: np.ndarray, at: np.ndarray, c: float) -> np.ndarray:
    """u of (c M + K) u = load, with what is held as in `at`."""
    free = ~frozen_of(scene).ravel()
    A, u = (c * scene.mass_matrix() + scene.stiffness_matrix()).tocsr(), np.where(free, 0.0, at.ravel())
    u[free] = scipy.sparse.linalg.splu(A[free][:, free].tocsc()).solve((load.ravel() - A @ u)[free])
    return u.reshape(-1, 3)


def frozen_of(scene: ds.Scene) -> np.ndarray:
    held = np.zeros((scene.mesh.num_vertices, 3), bool)
    for name in SUPPORTS:
        held[scene.mesh.vertex_indices(name), "xyz".index(SUPPORTS[name])] = True
    if scene.motion is not None:
        held[scene.mesh.vertex_indices("xmax"), 0] = True
    return held


def judge(case: dict) -> str:
    """good, raised or wrong, and why."""
    scene, kind, h = scene_of(case), SOLVERS[case["solver"]], case["h"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            still = ds.Rollout(ds.StaticSolver(scene, load_steps=4, dt=h), 1).forward().displacements[-1]
        except ds.NotConverged as error:
            return f"raised in statics: {error}"
        long = h * np.sqrt(case["E"] / case["density"]) / SIZE > LONG and kind is not ds.ImplicitMidpointSolver
        try:
            frames = ds.Rollout(kind(scene, dt=h), 6 if long else 1, save_every=1).forward()
        except (ds.NotConverged, ds.Tunnelling) as error:
            return f"raised: {error}"
    u, said = frames.displacements, []
    if case["strain"] < 1e-3 and case["load"] != "plate" and case["law"] != "KelvinVoigt":
        gamma = 0.5 * h if kind is ds.ImplicitMidpointSolver else h
        dead = np.where(frozen_of(scene), 0.0, (scene.stiffness_matrix() @ still.ravel()).reshape(still.shape))
        at = still * (gamma / h)
        want = linear_step(scene, dead, at, 1 / gamma**2) * (h / gamma)
        off = np.linalg.norm(u[1] - want) / np.linalg.norm(want)
        if off > 1e-4 + 5 * case["strain"]:
            said.append(f"first step {off:.2g} from the linear one")
    if long:
        off = np.linalg.norm(u[-1] - still) / np.linalg.norm(still)
        if off > 0.01:
            said.append(f"settled {off:.2g} from statics")
    return f"wrong: {', '.join(said)}" if said else "good"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--laws", nargs="+", default=list(LAWS), choices=LAWS)
    parser.add_argument("--orders", nargs="+", type=int, default=(1, 2))
    options = parser.parse_args()
    ds.init(precision="f64")
    rng, counts = np.random.default_rng(options.seed), {}
    for number in range(options.cases):
        case = draw(rng, options.laws, options.orders)
        said = judge(case)
        verdict = said.split(":")[0]
        counts[verdict] = counts.get(verdict, 0) + 1
        if verdict != "good":
            print(f"{number} {said[:300]}  {case}", flush=True)
    print(", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items())))
    sys.exit(any(verdict == "wrong" for verdict in counts))


if __name__ == "__main__":
    main()
