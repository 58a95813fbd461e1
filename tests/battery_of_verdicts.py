"""Verdicts of check_gradients on random rollouts, half of them with a planted fault, which nothing but the plant knows of.

    python tests/battery_of_verdicts.py --cases 200 --seed 0

Scenes are those of the fuzz of gradients, eight to a compiled structure: all solvers, laws, terms, both precisions.
Implicit solvers keep their default tolerance, or take a looser or a tighter one. Losses are linear, quadratic or neither. A
fault multiplies a gradient, or one component of it, by 1 + d with 1e-4 <= |d| <= 1. Failures are a right gradient that is
called WRONG, and one called right whose fault, along the row's direction, is above the resolution that the row prints.
"""

import argparse
import sys
import time
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from gradient_fuzz.judge import CALMS, is_refusal  # noqa: E402
from gradient_fuzz.scenes import build  # noqa: E402
from gradient_fuzz.structures import PER_STRUCTURE  # noqa: E402

import diffsim_ti as ds  # noqa: E402
from diffsim_ti import verify  # noqa: E402

INPUTS = 3  # of each rollout that are checked


@dataclass
class Verdicts:
    """What one rollout showed: per row its verdict, the fault along its direction, and what it resolves."""

    seed: int
    what: str
    planted: str = ""
    rows: list[tuple[str, str, float, float]] = field(default_factory=list)  # input, verdict, fault, resolution
    seconds: float = 0.0
    refusal: str = ""
    table: str = ""

    @property
    def failures(self) -> list[str]:
        out = [
            f"{name}: a right gradient is called WRONG"
            for name, said, fault, _ in self.rows
            if said == "WRONG" and not fault
        ]
        return out + [
            f"{name}: a fault of {fault:.1e} is called right, at a resolution of {resolution:.1e}"
            for name, said, fault, resolution in self.rows
            if said == "right" and fault > resolution
        ]


def loss_of(rollout: ds.Rollout, kind: str, rng) -> verify.Loss:
    """A loss of frames with its gradient: w . x + z . v, |x - target|^2 / 2 + |v|^2 / 2, or sums of tanh and sine."""
    first = rollout.forward()
    x0, size = first.positions.astype(np.float64), np.ptp(first.positions, 1).max() * 0.1
    w, z = rng.standard_normal((2, *x0.shape))
    target = x0 + size * w

    def linear(x, v):
        return (w * (x - x0)).sum() + (z * v).sum(), w, z

    def quadratic(x, v):
        return 0.5 * ((x - target) ** 2).sum() + 0.5 * (v**2).sum(), x - target, v

    def other(x, v):
        a, b = np.tanh((x - target) / size), np.sin(v + z)
        return size * (w * a).sum() + b.sum(), w * (1 - a**2), np.cos(v + z)

    of = dict(linear=linear, quadratic=quadratic, other=other)[kind]
    return lambda frames: of(frames.positions.astype(np.float64), frames.velocities.astype(np.float64))


def rollout_of(seed: int, rng) -> ds.Rollout:
    """The fuzz's rollout of a seed, calmer where it is refused, at another tolerance of its solver."""
    for calm in CALMS:
        try:
            rollout = build(seed, calm=calm).rollout()
            if not rollout.solver.explicit:
                tolerance = (
                    rng.choice([1e-4, 1e-11]) if rng.random() < 0.5 else type(rollout.solver)(rollout.scene).tolerance
                )
                rollout = rollout.on(rollout.solver.for_scene(rollout.scene, tolerance=float(tolerance)))
            rollout.forward()
            return rollout
        except Exception as error:
            if calm == CALMS[-1] or not is_refusal(error):
                raise


def plant(rollout: ds.Rollout, name: str, rng) -> tuple[str, dict]:
    """Put a fault into the rollout's gradient by an input; what it is, and {input: factor of each component}."""
    delta = rng.choice([-1, 1]) * 10 ** rng.uniform(-4, 0)
    factor = np.ones(rollout.values[name].shape)
    if rng.random() < 0.5 or factor.ndim == 0:
        factor, what = factor + delta, f"{name} times {1 + delta:.4g}"
    else:
        at = tuple(int(rng.integers(n)) for n in factor.shape)
        factor[at], what = 1 + delta, f"{name}{list(at)} times {1 + delta:.4g}"
    right = rollout.vjp
    rollout.vjp = lambda *a, **k: (g := right(*a, **k)) | {name: g[name] * factor}
    return what, {name: factor}


def judge(seed: int) -> Verdicts:
    """The verdicts on the rollout of a seed; odd seeds have a fault."""
    rng, begun = np.random.default_rng([7, seed]), time.perf_counter()
    out = Verdicts(seed, "")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            rollout = rollout_of(seed, rng)
            kind = str(rng.choice(["linear", "quadratic", "other"]))
            solver, scene = rollout.solver, rollout.scene
            tolerance = f" to {solver.tolerance:g}" if hasattr(solver, "tolerance") else ""
            out.what = (
                f"{type(solver).__name__}{tolerance}, {type(scene.material).__name__}, {scene.precision}, {kind} loss"
            )
            names = [str(n) for n in rng.permutation(rollout.wanted)[:INPUTS]]
            loss, factors = loss_of(rollout, kind, rng), {}
            right = rollout.vjp
            if seed % 2:
                out.planted, factors = plant(rollout, names[0], rng)
            report = ds.check_gradients(rollout, loss, names, seed=seed, verbose=False)
        except Exception as error:
            if not is_refusal(error):
                raise
            out.refusal = f"{type(error).__name__}: {error}"
            return out
    out.table, again = str(report), np.random.default_rng(seed + 1)
    rollout.vjp = right
    gradients = verify.pull_back(rollout, rollout.forward(), loss) if factors else {}
    for row in report.rows:
        direction, fault = verify._random_direction(rollout, row.input, again), 0.0
        if row.input in factors:
            parts = gradients[row.input] * direction
            exact, wrong = float(parts.sum()), float((parts * factors[row.input]).sum())
            fault = abs(wrong - exact) / (max(abs(wrong), abs(exact)) or 1.0)
        out.rows.append((row.input, row.verdict, fault, row.resolution))
    out.seconds = time.perf_counter() - begun
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="the first; eight to a compiled structure")
    parser.add_argument("--each", type=int, default=PER_STRUCTURE, help="cases of each structure; default all eight")
    parser.add_argument("--show", action="store_true", help="print every table")
    arguments = parser.parse_args()
    ds.init(precision="f64")
    counts, failed, refused = Counter(), 0, 0
    seeds = (
        seed for k in range(arguments.cases) for seed in [k // arguments.each * PER_STRUCTURE + k % arguments.each]
    )
    for seed in seeds:
        found = judge(arguments.seed + seed)
        refused += bool(found.refusal)
        for _, said, fault, _ in found.rows:
            counts["planted" if fault else "right", said] += 1
        failed += bool(found.failures)
        said = ", ".join(f"{name} {verdict}" for name, verdict, *_ in found.rows) or found.refusal
        print(
            f"{found.seed}: {found.what}; planted: {found.planted or 'nothing'}; {said}; {found.seconds:.1f} s",
            flush=True,
        )
        if found.failures or "NOT RESOLVED" in said or arguments.show:
            print(found.table, *found.failures, sep="\n", flush=True)
    print(f"{arguments.cases} rollouts, {refused} refused, {failed} failed")
    for (of, said), count in sorted(counts.items()):
        print(f"  {of:8s} {said:12s} {count}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
