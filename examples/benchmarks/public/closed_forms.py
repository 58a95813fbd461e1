"""NAFEMS benchmarks and closed forms, gathered from the tests and examples that have them: target, value, error.

    python examples/benchmarks/public/closed_forms.py [--quick]

Ten-node tetrahedra, float64. Scenes are those of tests/test_nafems.py, tests/test_quadratic_answers.py and
examples/benchmarks/error_bars.py, so the tests' dependencies are needed (pip install ".[test]"); --quick takes coarser
meshes. Seconds are those of a run with all that it sets up, once kernels are compiled.

NAFEMS, The Standard NAFEMS Benchmarks, TNSB rev. 3, 1990: LE10, LE11, and FV52, whose plate is that of "thick plate";
its target there is the exact frequency of three-dimensional elasticity, 45.971 Hz. No hardware is part of these;
targets are numbers of theory and of NAFEMS's own converged models, given to three digits. Sources of the others stand
with the scenes.
"""

import sys
import time

import numpy as np
from table import HERE, ROOT, parser, report
from threadpoolctl import threadpool_limits

import diffsim_ti as ds

sys.path[:0] = [str(ROOT / "tests"), str(HERE.parent)]

import error_bars  # noqa: E402
import test_nafems as nafems  # noqa: E402
import test_quadratic_answers as answers  # noqa: E402

# of error_bars.py: (what is measured there, size of its mesh in the quick form and in full)
OF_ERROR_BARS = {
    "hanging bar": ("hanging bar: elastic energy [J]", 1, 3),
    "uniaxial": ("block drawn to 1.5 times its length: change of half its width [m]", 1, 3),
    "beam": ("beam under its own weight, small strains: deflection [m]", 1, 3),
    "cook": ("Cook's membrane, large strains: rise of its corner [mm]", 4, 12),
    "elastica": ("elastica, rho g A L^3 / (E I) = 1: deflection / L", 4, 20),
    "thick sphere": ("Lame's sphere under pressure: radial displacement [m]", 2, 5),
    "thick plate": ("thick plate under pressure: deflection [m]", 3, 6),
    "lame": ("Lame mode of a free cube, after a fifth of its period: change of its share", 2, 3),
}


def of_error_bars(name: str, size: int):
    """A function that gives (value, target, unknowns), of displacements."""

    def solve():
        rollout, _, weights, exact = error_bars.PROBLEMS[name][0](size, 2)
        frames = rollout.forward()
        y = frames[next(iter(rollout.computed))]
        y = y if weights is None else (y * weights).sum((1, 2))
        return float(y[-1] - y[0]), float(exact - y[0]), 3 * rollout.scene.mesh.num_vertices

    return solve


def of_scene(make, target: float, found, **cells):
    """The same of a scene."""

    def solve():
        scene = make(**cells)
        return float(found(scene)), target, 3 * scene.mesh.num_vertices

    return solve


def hoop(scene: ds.Scene) -> float:
    """At the middle of the inner surface [MPa]."""
    s = answers.stress_at(scene, (0.1 * np.cos(np.pi / 8), 0.1 * np.sin(np.pi / 8), 0.01))[0]
    around = np.array([-np.sin(np.pi / 8), np.cos(np.pi / 8), 0])
    return around @ s @ around


def problems(quick: bool) -> dict:
    """{name: a function that gives (value, target, unknowns)}"""
    at = nafems.stress_at
    mesh = (lambda coarse: dict(cells=coarse)) if quick else (lambda coarse: {})
    out = {
        "NAFEMS LE10, thick elliptic plate: stress [MPa]": of_scene(
            nafems.le10, -5.38, lambda s: at(s, (2, 0, 0.6), 1, "recovered") / 1e6, **mesh((4, 6, 2))
        ),
        "NAFEMS LE11, heated shell of revolution: stress [MPa]": of_scene(
            nafems.le11, -105.0, lambda s: at(s, (1, 0, 0), 2, "vertices") / 1e6, **mesh((2, 4, 8))
        ),
        "NAFEMS FV52, thick plate: first frequency of bending [Hz]": of_scene(
            answers.thick_plate, answers.THICK_PLATE[0], lambda s: ds.modes(s, 3).frequencies[0], **mesh((6, 6, 1))
        ),
        "Lame's cylinder under pressure: hoop stress [MPa]": of_scene(
            answers.thick_cylinder, 5 / 3, hoop, **mesh((4, 4, 2))
        ),
    }
    for number in (5.0,) if quick else (5.0, 50.0):
        out[f"elastica, rho g A L^3 / (E I) = {number:g}: deflection / L"] = of_scene(
            lambda number=number, **cells: answers.elastica(number, **cells),
            answers.ELASTICA[number][1],
            lambda s, number=number: -answers.tip_of(s, (1.0, 0.01, 0.01), 4 if number < 20 else 8)[1],
            **mesh((20, 1, 1)),
        )
    for name, (words, *sizes) in OF_ERROR_BARS.items():
        out[words] = of_error_bars(name, sizes[not quick])
    return out


def main(quick: bool) -> list:
    rows = []
    for name, solve in problems(quick).items():
        for _ in range(1 if quick else 2):  # the first compiles
            begin = time.perf_counter()
            value, target, unknowns = solve()
            seconds = time.perf_counter() - begin
        rows.append((name, f"{target:.5g}", f"{value:.5g}", 100 * abs(value / target - 1), unknowns, seconds))
    rows.sort(key=lambda row: -row[3])
    report("closed_forms", ("problem", "target", "value", "error [%]", "unknowns", "seconds"), rows, quick)
    return rows


if __name__ == "__main__":
    options = parser(__doc__, peers=False).parse_args()
    ds.init("cpu", precision="f64")
    with threadpool_limits(1):
        main(options.quick)
