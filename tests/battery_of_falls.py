"""Falls of bodies that nobody made for this: python tests/battery_of_falls.py [MESH ...] [--odd] [--order 2] [--cases 60].

Each draw takes a mesh, a size, a modulus, a height and a solver, all else as `diffsim-ti simulate` has it, and runs until
half a second after the first contact. A fall is good where it ends, nothing is ever below the floor, and the energy never
rises above that of the start by more than 1 % of weight times height. What is refused before the first frame falls with the
modulus that the error advises. A draw that takes longer than `--patience`
seconds of processors is named and replaced. Prints a line for each, and what all of them come to; exit code 1 if one is bad.
--odd: of the bodies in odd_bodies.py. --order 2: of ten-node tetrahedra.
"""

import argparse
import json
import multiprocessing
import re
import resource
import signal
import sys
import tempfile
import time
from pathlib import Path
from queue import Empty

import numpy as np
from odd_bodies import save_all

ASSETS = sorted((Path(__file__).resolve().parents[1] / "assets" / "tetmesh").glob("*.msh"))
SIZES, MODULI, HEIGHTS, SOLVERS = (0.05, 0.2, 1.0, 5.0), (1e4, 1e5, 1e7), (0.1, 1.0), ("verlet", "bdf2")
RHO, G = 1000.0, 9.81


def draw(rng, meshes, order: int = 1) -> dict:
    """One fall."""
    return dict(
        mesh=str(meshes[rng.integers(len(meshes))]),
        size=float(rng.choice(SIZES)),
        youngs_modulus=float(rng.choice(MODULI)),
        height=float(rng.choice(HEIGHTS)),
        solver=str(rng.choice(SOLVERS)),
        order=order,
    )


def fall(case: dict) -> dict:
    """Run one, and say how it went."""
    import diffsim_ti as ds
    from diffsim_ti.cli.options import fall_scene, load_body, make_material, solver_class
    from diffsim_ti.scene.strength import check_strength
    from diffsim_ti.writers.adaptive_run import ForwardRun

    ds.init()
    begin, height = time.perf_counter(), case["height"] * case["size"]
    body = load_body(Path(case["mesh"]), case["size"])
    body = body.quadratic() if case.get("order") == 2 else body
    law = make_material("StableNeoHookean", case["youngs_modulus"], 0.4)
    scene, _ = fall_scene(body, law, RHO, height=height)
    out = dict(case, tetrahedra=body.num_tetrahedra)
    try:
        check_strength(scene)
    except ValueError as error:
        advised = float(re.search(r"Young's modulus to (\S+) Pa", str(error))[1])
        if advised <= case["youngs_modulus"]:
            raise
        return fall(case | dict(youngs_modulus=advised)) | dict(advised=advised)
    try:
        frame = min(1 / 30, np.sqrt(2 * height / G) / 4)
        run = ForwardRun(scene, solver_class(case["solver"]), frame)
        start, highest, touched = float(run.simulator.compute_energy()), 0.0, None
        while touched is None or run.simulator.time < touched + 0.5:
            run.advance()
            highest = max(highest, float(run.energies[-1]) - start)
            if touched is None and run.seen.gap < float(run.obstacles[0].values["barrier_width"]):
                touched = run.simulator.time
    except FloatingPointError as error:
        return out | dict(ended=False, said=str(error), seconds=time.perf_counter() - begin)
    weight = scene.inputs.derive(scene.inputs.values).mass.sum() * G
    return out | dict(
        ended=True,
        gap=run.seen.gap,
        rise=highest / (weight * height),
        J=run.seen.J,
        retries=len(run.seen.retries),
        implicit_parts=run.seen.implicit_parts,
        seconds=time.perf_counter() - begin,
    )


def judge(result: dict) -> str:
    """Whether it is good, or what is wrong."""
    if not result["ended"]:
        return f"died: {result['said']}"
    if not result["gap"] > 0:
        return f"is {-result['gap']:.3g} m below the floor"
    return "good" if result["rise"] < 0.01 else f"gained {result['rise']:.2%} of weight times height"


def _work(case, patience, queue):
    resource.setrlimit(resource.RLIMIT_CPU, (int(patience), int(patience) + 9))
    queue.put(fall(case) | dict(cpu=time.process_time()))


def within(case: dict, patience: float) -> dict | None:
    """The fall, in a process of its own; None if it takes more than so many seconds of processors, whoever else runs."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=_work, args=(case, patience, queue))
    process.start()
    while True:
        running = process.is_alive()
        try:
            result = queue.get(timeout=1)
            process.join()
            return result
        except Empty:
            if running:
                continue
        if -process.exitcode in (signal.SIGXCPU, signal.SIGKILL):
            return None
        return dict(case, ended=False, said=f"exit code {process.exitcode}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("meshes", nargs="*", type=Path, default=ASSETS)
    parser.add_argument("--odd", action="store_true", help="the bodies of odd_bodies.py instead")
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--order", type=int, choices=(1, 2), default=1)
    parser.add_argument("--patience", type=float, default=120.0, help="seconds of processors for one")
    options = parser.parse_args()
    meshes = save_all(Path(tempfile.mkdtemp())) if options.odd else options.meshes
    rng, results, slow, draws = np.random.default_rng(options.seed), [], [], 0
    while len(results) < options.cases:
        case, draws = draw(rng, meshes, options.order), draws + 1
        result = within(case, options.patience)
        name = "{} of {size:g} m, E {youngs_modulus:g} Pa, from {height:g} sizes, {solver}".format(
            Path(case["mesh"]).stem, **case
        )
        if result is None:
            slow.append(name)
            print(f"slow  {name}", flush=True)
            continue
        results.append(result | dict(judged=judge(result)))
        numbers = {k: v for k, v in results[-1].items() if k not in case and k not in ("judged", "said")}
        print(f"{results[-1]['judged'][:90]}  {name}  {json.dumps(numbers)}", flush=True)
    explicit = [r for r in results if r["solver"] == "verlet" and r["ended"]]
    alone = sum(r["implicit_parts"] == 0 for r in explicit)
    bad = sum(r["judged"] != "good" for r in results)
    advised, rise = sum("advised" in r for r in results), max(r.get("rise", np.inf) for r in results)
    print(
        f"{len(results)} falls, {bad} bad, {advised} with the modulus advised, energy +{rise:.2%} at most; "
        f"{alone} of {len(explicit)} explicit ones by explicit steps alone; "
        f"{len(slow)} of {draws} draws took longer than {options.patience:g} s"
    )
    sys.exit(bad > 0)


if __name__ == "__main__":
    main()
