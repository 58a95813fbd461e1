"""A body with self-contact of 1 mm falls and comes to rest: python tests/rest_with_self_contact.py MESH [--solver bdf2].

The mesh is scaled to 0.2 m and let go 2 cm above the floor, with drag: laws of materials damp nothing. Prints a line
for each frame; exit code 1 if it has not come to rest within the time given, a gap is not positive, or the energy rises
by more than 1 % of weight times height.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.cli.options import fall_scene, load_body, make_material, solver_class
from diffsim_ti.writers.adaptive_run import ForwardRun

SIZE, HEIGHT, G = 0.2, 0.02, 9.81


def fall(mesh: Path, solver: str, drag: float, E: float, width: float = 1e-3) -> ForwardRun:
    """The run of a fall, at its start."""
    body, law, extra = load_body(mesh, SIZE), make_material("StableNeoHookean", E, 0.4), [ds.SelfContact(width=width)]
    scene, _ = fall_scene(body, law, 1000.0, height=HEIGHT, drag=drag, extra=extra)
    return ForwardRun(scene, solver_class(solver), 1 / 30)


def speed(run: ForwardRun) -> float:
    """Root mean square of vertical velocities [m/s]: a body slides for ever on a floor without friction."""
    return float(np.sqrt((run.simulator.velocities[:, 1].astype(np.float64) ** 2).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--solver", default="bdf2")
    parser.add_argument(
        "--drag", type=float, default=4.0, help="[1/s]; with 0 a body sways as long as its steps let it"
    )
    parser.add_argument("-E", type=float, default=1e5, help="Young's modulus [Pa]")
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--slow", type=float, default=0.01, help="what counts as rest [m/s]")
    options = parser.parse_args()
    ds.init()
    run, begin = fall(options.mesh, options.solver, options.drag, options.E), time.perf_counter()
    weight = run.scene.inputs.derive(run.scene.inputs.values).mass.sum() * G
    start, rested, rise, gap, between = run.energies[0], 0, 0.0, np.inf, np.inf
    while run.simulator.time < options.seconds and rested < 3:
        run.advance()
        touched = run.seen.gap < np.inf
        rested = rested + 1 if touched and speed(run) < options.slow else 0
        rise = max(rise, float(run.energies[-1] - start) / (weight * HEIGHT))
        gap, between = run.seen.gap, min(between, run.simulator.smallest_gap())
        print(
            f"t = {run.simulator.time:.3f} s: {speed(run):.3g} m/s, gap {gap:.3g} m, between surfaces {between:.3g} m, "
            f"energy +{rise:.2g}, {len(run.seen.retries)} parts again, {run.seen.implicit_parts} by implicit Euler, "
            f"{time.perf_counter() - begin:.0f} s",
            flush=True,
        )
    sys.exit(not (rested and gap > 0 and between > 0 and rise < 0.01))


if __name__ == "__main__":
    main()
