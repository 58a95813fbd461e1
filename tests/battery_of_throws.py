"""Pairs of soft bodies that are thrown at each other in explicit steps; what an error advises is followed to the letter.

    python tests/battery_of_throws.py --cases 30 --seed 0

Speeds to 0.4 of that of pressure waves, random widths, stiffnesses, friction, elements and solvers.
"""

import argparse
import re

import numpy as np

import diffsim_ti as ds

SOLVERS = ds.VelocityVerletSolver, ds.SemiImplicitSolver
NUMBER = r"([-+.\de]*\d)"
ROUNDS = 4  # runs, at most


def draw(rng):
    """(mesh, Young's modulus, velocities, options of SelfContact, solver, duration)."""
    order, E = int(rng.integers(1, 3)), 10 ** rng.uniform(3.5, 6)
    block = ds.TetrahedralMesh.create_box(3 if order == 1 else 2, 0.1)
    block = block.quadratic() if order == 2 else block
    mesh = ds.TetrahedralMesh.joined([block, block.translated([0.103, *rng.uniform(-0.05, 0.05, 2)])])
    wave = np.sqrt(1.6 * E / 1000)  # of a ratio of 0.35
    speed, v = rng.uniform(0.05, 0.4) * wave, np.zeros_like(mesh.vertices)
    v[:, 0] = np.where(np.arange(len(v)) < block.num_vertices, 0.5, -0.5) * speed
    contact = dict(width=10 ** rng.uniform(-3.3, -2.6), stiffness=10 ** rng.uniform(1.5, 5))
    contact["friction"] = float(rng.choice([0, 0.5]))
    return mesh, E, v, contact, SOLVERS[rng.integers(2)], 0.3 / wave + 0.004 / speed


def throw(mesh, E, v, contact, solver, duration) -> list[str]:
    """What the runs said, the last one of all; nothing if it came to its end."""
    said, dt = [], None
    for _ in range(ROUNDS):
        scene = ds.Scene(mesh, ds.StableNeoHookean(E, 0.35), 1000.0, [ds.SelfContact(**contact)], initial_velocities=v)
        dt = dt or 0.7 * float(ds.stable_dt(scene).dt)
        try:
            simulator = ds.Simulator(solver(scene, dt=dt, substeps=1))
            simulator.run(int(np.ceil(duration / dt)))
            simulator.check_surfaces()
            return [*said, ""]
        except FloatingPointError as error:
            said.append(str(error))
        stiffness, step = (
            re.search(rf"{what} {NUMBER}", said[-1]) for what in ("stiffness to", "(?:substeps of|substep to)")
        )
        contact["stiffness"] = float(stiffness[1]) if stiffness else contact["stiffness"]
        dt = float(step[1]) if step else dt
        if not (stiffness or step):
            return said
    return said


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    ds.init(precision="f64")
    rng, failed = np.random.default_rng(options.seed), 0
    for k in range(options.cases):
        said = throw(*draw(rng))
        failed += bool(said[-1])
        print(f"{k:4d} {'FAILED' if said[-1] else 'well'} after {len(said)} runs", *said, sep="\n     ", flush=True)
    print(f"{failed} of {options.cases} failed")
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
