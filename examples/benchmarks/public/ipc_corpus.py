"""The scenes that contact codes are judged by (tests/contact_corpus.py), and a table of what becomes of them.

    python examples/benchmarks/public/ipc_corpus.py [--quick] [--meshes FOLDER ...] [--scene NAME ...] [--minutes 9]

FOLDERs hold the meshes of the paper's repository, as tests/contact_corpus.py says; of a clone named IPC they are
IPC/input/tetMeshes/erleben IPC/input/tetMeshes IPC/input/triMeshes/erleben IPC/input/triMeshes. Without them coarser
meshes of our own take their place. The tests' dependencies are needed: pip install ".[test]". Scenes share the minutes
of processor time: each stops at its share of what is left, and its verdict is "stopped". Scenes are those of the paper by
Li et al. (doi:10.1145/3386569.3392425) and of Erleben (doi:10.1145/3096239); the paper's repository,
https://github.com/ipc-sim/IPC, has the MIT licence. Equal: shapes, materials, steps and motions as published, as far as
the paper says them. Not equal: without FOLDERs the meshes, and the paper's columns are microseconds of a step and
tetrahedron of its own meshes on its authors' machine, of which we found no name. Seconds are those of the processor,
without the step that compiles and without the exact judge.
"""

import sys
import time
import warnings

from table import ROOT, parser, report
from threadpoolctl import threadpool_limits

import diffsim_ti as ds

sys.path.insert(0, str(ROOT / "tests"))

import contact_corpus as corpus  # noqa: E402

QUICK = {"spike on soft spike": 3, "arch, friction 0.5": 3, "slope 0.5, friction 0.49": 3}


class TimeIsUp(Exception):
    """Of a scene."""


def result(name: str, meshes: corpus.Meshes, steps: int | None, seconds: float) -> corpus.Run | str:
    """What became of a scene within so many seconds of processor time, or why it was not posed."""
    last, end = [], time.process_time() + seconds

    def say(run: corpus.Run) -> None:
        last[:] = [run]
        if time.process_time() > end:
            raise TimeIsUp

    try:
        return corpus.run(name, corpus.SCENES[name](meshes), steps, say=say)
    except TimeIsUp:
        return last[0]
    except AttributeError:
        if meshes.folders or not name.endswith(".obj"):
            raise
        return "needs a surface of the paper's repository"
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        return f"not posed: {error}"


def main(quick: bool, folders=(), names=None, minutes: float = 9.0) -> tuple[list, list]:
    """(rows, runs)"""
    meshes, rows, runs = corpus.Meshes(*folders), [], []
    chosen = [n for n in corpus.SCENES if names is None or any(n.startswith(s) for s in names)]
    chosen = list(QUICK) if quick else chosen
    end = time.process_time() + 60 * minutes
    for k, name in enumerate(chosen):
        share = (end - time.process_time()) / (len(chosen) - k)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = result(name, meshes, QUICK.get(name) if quick else None, share)
        runs.append(found)
        shown = [name, *[""] * (len(corpus.HEAD) - 2), found] if isinstance(found, str) else corpus.row(found)
        rows.append(["" if cell == "nan" else cell for cell in shown])
        print(f"{name}: {rows[-1][-1]}", file=sys.stderr, flush=True)
    where = "the meshes of the paper's repository" if folders else "coarser meshes of our own"
    notes = f"On {where}, all scenes within {minutes:g} minutes of processor time."
    report("ipc_corpus", corpus.HEAD, rows, quick or names is not None, notes)
    return rows, runs


if __name__ == "__main__":
    arguments = parser(__doc__, peers=False)
    arguments.add_argument("--meshes", nargs="+", default=(), help="folders of meshes, searched in this order")
    arguments.add_argument("--scene", nargs="+", help="names, or what they begin with; the page stays as it is")
    arguments.add_argument("--minutes", type=float, default=9.0, help="of processor time, for all scenes")
    options = arguments.parse_args()
    ds.init("cpu", precision="f64")
    with threadpool_limits(1):
        main(options.quick, options.meshes, options.scene, options.minutes)
