"""Conjugate gradients with multigrid at large strains: iterations per round of Newton's method beside those at rest.

    python tests/battery_of_strained_states.py [--cells 8] [--only NAME ...]

Each body goes in increments to a strained state: stretched, twisted, crushed, of unequal stiffness, in contact. The last two
increments are compared with a small one from rest on the same mesh: iterations per round, and per decade of the residual in
linear solves, which does not depend on how exactly a round is solved. Small bodies keep the matrices of the rest state, for
others cost more than iterations. Prints a table in Markdown; exit code 1 where iterations per round grow by more than a
factor of --most.
"""

import argparse
import sys
from collections.abc import Callable

import numpy as np

import diffsim_ti as ds
from diffsim_ti.solvers.implicit.multigrid import Multigrid

SMALL = 0.01  # share of the motion in the increment from rest
box = ds.TetrahedralMesh.create_box


def scene_of(mesh, path: Callable, E=1e5, fixed=None, **more) -> ds.Scene:
    """Held at both ends, of which one moves along a path of the share of the way, 0 to 1."""
    middle = np.append(np.mean(mesh.vertices, 0)[1:], 0.0)
    about = [mesh.vertices[:, 0].max(), *middle[:2]]
    fixed = fixed or {"xmin": "xyz", "xmax": "xyz"}
    motion = {"xmax": ds.Pose(path, about=about) if len(path(0.0)) == 6 else path}
    return ds.Scene(mesh, ds.StableNeoHookean(E, 0.3), 1000.0, fixed=fixed, motion=motion, precision="f64", **more)


def states(n: int) -> dict[str, tuple[Callable, int]]:
    """{name: (function of a factor of time -> scene, increments)}"""
    plate = lambda: box((5, 2 * n + 1, 2 * n + 1), (4 / (2 * n), 1, 1), pattern="five")  # noqa: E731
    cube = lambda: box((n + 1, n + 1, n + 1), (1.0, 1.0, 1.0))  # noqa: E731
    bar = lambda: box((10 * n + 1, n // 2 + 1, n // 2 + 1), (20.0, 1.0, 1.0))  # noqa: E731
    column = lambda: box((4 * n + 1, n + 1, n + 1), (4.0, 1.0, 1.0))  # noqa: E731
    rollers = {"xmin": "x", "xmax": "x", "ymin": "y", "zmin": "z"}

    def contrast(of, speed):
        mesh = of()
        stiff = (np.floor(4 * mesh.vertices[mesh.tetrahedra].mean(1)).sum(1) % 2).astype(bool)
        return scene_of(mesh, lambda t: [0.5 * speed * t, 0.0, 0.0], np.where(stiff, 1e7, 1e3))

    def pressed(speed):
        mesh, barrier = cube(), dict(width=2e-3, stiffness_per_area=1e8)
        lid = ds.Box(
            [0.5, 1.127, 0.5], [2.0, 0.25, 2.0], path=lambda t: [0.0, -0.3 * speed * t, 0.0], friction=0.5, **barrier
        )
        return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, [lid], fixed="ymin", precision="f64")

    return {
        "stretched ten times": (
            lambda s: scene_of(plate(), lambda t: [4 / (2 * n) * (10 ** (s * t) - 1), 0.0, 0.0], fixed=rollers), 10),
        "stretched, ends held": (lambda s: scene_of(cube(), lambda t: [2.0 * s * t, 0.0, 0.0]), 8),
        "crushed to four tenths": (lambda s: scene_of(cube(), lambda t: [-0.6 * s * t, 0.0, 0.0]), 8),
        "sheared by one": (lambda s: scene_of(cube(), lambda t: [0.0, s * t, 0.0]), 6),
        "slender, stretched": (lambda s: scene_of(bar(), lambda t: [20.0 * s * t, 0.0, 0.0]), 6),
        "twisted by half a turn": (
            lambda s: scene_of(column(), lambda t: [0, 0, 0, np.pi * s * t, 0, 0]), 10),
        "stiffness 1 to 10 000": (lambda s: contrast(cube, s), 6),
        "pressed by a plate": (pressed, 6),
    }  # fmt: skip


def watched(found: list) -> None:
    """Note (decades, iterations) of each solve from here on."""
    learn = Multigrid.learn

    def note(self, residual, iterations):
        if 0 < residual < 1:
            found.append((-np.log10(residual), iterations))
        learn(self, residual, iterations)

    Multigrid.learn = note


def measured(scene: ds.Scene, increments: int, last: int, found: list) -> tuple[float, float]:
    """Iterations (per round, per decade) in the last increments."""
    simulator = ds.Simulator(ds.StaticSolver(scene, dt=1 / increments))
    simulator.run(increments - last)
    found.clear()
    simulator.run(last)
    (decades, iterations), steps = np.sum(found, axis=0), list(simulator.report.steps)[-last:]
    return sum(x.products for x in steps) / sum(x.iterations + 1 for x in steps), iterations / decades


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=8, help="along an edge")
    parser.add_argument("--most", type=float, default=1.5)
    parser.add_argument("--only", nargs="+", default=[])
    options = parser.parse_args()
    ds.init("cpu", precision="f64")
    found, worst = [], 0.0
    watched(found)
    print("| state | per round | at rest | per decade | at rest | ratio |\n| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, (scene, increments) in states(options.cells).items():
        if options.only and name not in options.only:
            continue
        rest = measured(scene(SMALL), 1, 1, found)
        here = measured(scene(1.0), increments, 2, found)
        ratio = here[0] / rest[0]
        worst = max(worst, ratio)
        print(f"| {name} | {here[0]:.1f} | {rest[0]:.1f} | {here[1]:.2f} | {rest[1]:.2f} | {ratio:.2f} |", flush=True)
    return int(worst > options.most)


if __name__ == "__main__":
    sys.exit(main())
