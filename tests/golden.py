"""Golden values: frames and gradients of random scenes, kept as hashes of their bits and as sizes that a person can compare.

    python tests/golden.py --write golden.json             # of this code, on this machine
    python tests/golden.py --compare golden.json           # which scenes differ, and by how much
    python tests/golden.py --compare golden.json --seeds 3 11

The scenes are those of the fuzz (gradient_fuzz/), one of each structure: explicit, implicit and static solvers, both
precisions, contact, self-contact, chambers, sets of few numbers; every fourth one in a batch too. Bits hold on one machine
with one version of Taichi; elsewhere sizes agree to the digits that the solver's tolerance and rounding leave.
"""

import argparse
import hashlib
import json
import sys
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np  # noqa: E402
from gradient_fuzz.at_once import solver_of  # noqa: E402
from gradient_fuzz.scenes import build  # noqa: E402
from gradient_fuzz.structures import PER_STRUCTURE  # noqa: E402

import diffsim_ti as ds  # noqa: E402

COUNT = 60


def summary(arrays: dict[str, np.ndarray]) -> dict:
    """{name: [hash of the bits, root mean square]}"""
    out = {}
    for name, x in sorted(arrays.items()):
        x = np.ascontiguousarray(x)
        out[name] = [hashlib.sha256(x.tobytes()).hexdigest()[:16], float(np.sqrt(np.mean(np.square(x, dtype=float))))]
    return out


def weights(shape, rng, like):
    return rng.standard_normal(shape).astype(like.dtype).astype(float)


def values_of(seed: int) -> dict:
    """Of one scene; the class of the error where it raises one."""
    try:
        configuration = build(seed)
        rng, rollout = configuration.rng(77), configuration.rollout()
        frames = rollout.forward()
        w, z = (weights(x.shape, rng, x) for x in (frames.displacements, frames.velocities))
        found = dict(displacements=frames.displacements, velocities=frames.velocities)
        found |= {f"by {name}": g for name, g in rollout.vjp(frames, w, z).items()}
        out = dict(structure=str(configuration.structure), alone=summary(found))
        if seed // PER_STRUCTURE % 4 == 0:
            out["batch"] = summary(of_batch(configuration, rng))
        return out
    except Exception as error:
        return dict(error=f"{type(error).__name__}")


def of_batch(configuration, rng) -> dict:
    """Three scenes of a batch, whose moduli differ where they are one number."""
    solver, save = solver_of(configuration), configuration.options["save_every"]
    batch = ds.Batch(solver, configuration.schedule or configuration.steps, 3, save)
    E = batch.one.values.get("youngs_modulus", np.zeros(1))
    frames = batch.forward(**(dict(youngs_modulus=E * np.array([1.0, 1.1, 0.9])) if E.ndim == 0 else {}))
    w = weights(frames.displacements.shape, rng, frames.displacements)
    return dict(displacements=frames.displacements) | {f"by {name}": g for name, g in batch.vjp(frames, w).items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="write the values here")
    parser.add_argument("--compare", type=Path, help="compare with these")
    parser.add_argument("--seeds", type=int, nargs="*", help=f"of the fuzz; default the first of {COUNT} structures")
    arguments = parser.parse_args()
    ds.init(precision="f64")
    warnings.simplefilter("ignore")
    seeds = arguments.seeds or [PER_STRUCTURE * k for k in range(COUNT)]
    found, differing = {}, 0
    known = json.loads(arguments.compare.read_text()) if arguments.compare else {}
    for seed in seeds:
        found[str(seed)] = own = values_of(seed)
        if arguments.write:
            arguments.write.write_text(json.dumps(found, indent=1))
        if arguments.compare:
            differing += not alike(seed, known.get(str(seed)), own)
    if arguments.compare:
        print(f"{len(seeds)} scenes, {differing} differ")
    return int(differing > 0)


def alike(seed: int, before: dict | None, now: dict) -> bool:
    """Prints what differs."""
    if before is None or before.get("error") != now.get("error"):
        print(f"seed {seed}: {before and before.get('error', 'ran')} before, {now.get('error', 'ran')} now", flush=True)
        return False
    same = True
    for kind in ("alone", "batch"):
        for name, (bits, size) in now.get(kind, {}).items():
            old_bits, old_size = before[kind].get(name, ["", np.nan])
            if bits != old_bits:
                same = False
                ratio = abs(size - old_size) / max(abs(old_size), 1e-300)
                print(f"seed {seed}, {kind}, {name}: sizes differ by {ratio:.1e}", flush=True)
    return same


if __name__ == "__main__":
    sys.exit(main())
