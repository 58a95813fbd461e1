"""Damaged mesh files: python tests/fuzz_files.py --count 20000

Files of every format that is read by a reader of our own, and of some that meshio or trimesh reads, are damaged at random:
bits, bytes, lines, numbers, ends. Reading one must end in a mesh or in one ValueError of ours, within ten seconds and a few
times the memory of the file; a mesh with less than 0.7 of the tetrahedra of the undamaged file must have been warned of
(single lines that are cut out of an Abaqus deck leave no trace).
Prints what did not; exit code 1 if there is any.
"""

import argparse
import random
import re
import resource
import signal
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import mesh_files  # noqa: E402

import diffsim_ti as ds  # noqa: E402
from diffsim_ti.mesh import filling  # noqa: E402

SECONDS, MEMORY = 10, 6 * 2**30
ALLOWED = (ValueError, ImportError, FileNotFoundError)


def damaged(data: bytes, rng: random.Random) -> bytes:
    """One to three damages."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        kind, lines = rng.randrange(9), data.split(b"\n")
        at = rng.randrange(max(len(data), 1))
        line = rng.randrange(len(lines))
        if kind == 0:
            data = data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :] if data else data
        elif kind == 1:
            data = data[:at] + bytes(rng.randrange(256) for _ in range(rng.randrange(1, 9))) + data[at:]
        elif kind == 2:
            data = data[:at]
        elif kind == 3:
            data = b"\n".join(lines[:line] + lines[line + 1 :])
        elif kind == 4:
            data = b"\n".join(lines[: line + 1] + lines[line:])
        elif kind == 5:
            other = rng.randrange(len(lines))
            lines[line], lines[other] = lines[other], lines[line]
            data = b"\n".join(lines)
        elif kind == 6:
            data = data[:at] + data[at + rng.randrange(1, 60) :]
        else:  # a number that is another
            found = [*re.finditer(rb"-?\d+\.?\d*", data[:100_000])]
            if found:
                one = rng.choice(found)
                new = rng.choice(
                    (b"0", b"-1", b"1e300", b"nan", b"99999999999", b"2147483648", b"7", b"x", b"1e-300", b"3")
                )
                data = data[: one.start()] + new + data[one.end() :]
    return data


class TooLong(Exception):
    """Reading took longer than SECONDS."""


def stop(*_):
    raise TooLong


def outcome(path: Path, whole: int) -> str:
    """ "read", "refused", "warned", or what is wrong."""
    signal.alarm(SECONDS)
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            mesh = ds.TetrahedralMesh.from_file(path)
        if mesh.num_tetrahedra < 0.7 * whole and not said:
            return f"WRONG: {mesh.num_tetrahedra} of {whole} tetrahedra without a word"
        return "warned" if said else "read"
    except ALLOWED as error:
        if not str(error).startswith(str(path)) and "exist" not in str(error):
            return f"WRONG: the message does not begin with the file: {error}"
        return "refused"
    except TooLong:
        return f"WRONG: longer than {SECONDS} s"
    except BaseException as error:  # whatever comes out is what is looked for
        return f"WRONG: {type(error).__name__}: {str(error)[:120]}"
    finally:
        signal.alarm(0)


def run(count: int, seed: int, names: list[str] | None = None, verbose: bool = True) -> tuple[Counter, list[str]]:
    """(how often each outcome, descriptions of the wrong ones) of `count` damaged files."""
    rng, counts, wrong = random.Random(seed), Counter(), []
    filling.LONGEST = 0.5 * SECONDS
    signal.signal(signal.SIGALRM, stop)
    with tempfile.TemporaryDirectory() as folder:
        files = mesh_files.written(Path(folder) / "whole")
        files = {name: path for name, path in files.items() if not names or path.suffix in names}
        sizes = {}
        for name, path in files.items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                sizes[name] = ds.TetrahedralMesh.from_file(path).num_tetrahedra
        for k in range(count):
            name = rng.choice(sorted(files))
            path = Path(folder) / f"damaged{files[name].suffix}"
            path.write_bytes(damaged(files[name].read_bytes(), rng))
            beside = files[name].with_suffix(".node")
            if files[name].suffix == ".ele":
                path.with_suffix(".node").write_bytes(beside.read_bytes())
            said = outcome(path, sizes[name])
            counts[said.split(":")[0]] += 1
            if said.startswith("WRONG"):
                wrong.append(f"{name}, seed {seed}, case {k}: {said}")
                if verbose:
                    print(wrong[-1], flush=True)
    return counts, wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--suffixes", nargs="*")
    options = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    np.seterr(all="ignore")
    counts, wrong = run(options.count, options.seed, options.suffixes)
    print(", ".join(f"{count} {name}" for name, count in counts.most_common()))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
