"""Random scenes in float32 far from the origin against the same near it: python tests/battery_of_places.py --minutes 30

The scenes are those of `fuzz_gradients.py`, which have every term, solver and element. Each runs where it was drawn, a
little beside it, which tells what rounding does to it, and at 1e7 m: states, gradients by all inputs and tangents must agree
to ten times that rounding. Prints each scene, and its seed; exit code 1 if one is off.
"""

import argparse
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from far_places import FAR, found, moved, worst  # noqa: E402
from gradient_fuzz.scenes import build  # noqa: E402

import diffsim_ti as ds  # noqa: E402

BESIDE = (0.37, -0.21, 0.71)  # [m]


def off(seed: int) -> tuple[float, str]:
    """How far what a scene does at 1e7 m is from what it does where it was drawn, and in what; see `worst`."""
    drawn = build(seed, "f32")

    def at(place):
        return found(replace(drawn, solver=drawn.solver.for_scene(moved(drawn.scene, place))).rollout())

    near = at((0, 0, 0))
    return worst(at(FAR), near, at(BESIDE))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0, help="how long; default 30")
    parser.add_argument("--seed", type=int, default=0, help="the first seed; default 0")
    parser.add_argument("--step", type=int, default=8, help="between seeds; default 8, a new structure each")
    arguments = parser.parse_args()
    ds.init("cpu", "f32")
    warnings.simplefilter("ignore")
    end, seed, bad = time.monotonic() + 60 * arguments.minutes, arguments.seed, 0
    while time.monotonic() < end:
        try:
            share, what = off(seed)
            bad += not share < 1e-3
            said = f"{'off' if not share < 1e-3 else 'agrees'}: {share:.2g} in {what}"
        except (FloatingPointError, ValueError) as error:  # some that are drawn in float64 do not run in float32
            said = f"{type(error).__name__}: {str(error)[:120]}"
        print(f"{seed}: {said}; {build(seed, 'f32').structure}", flush=True)
        seed += arguments.step
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
