"""Kills ranks of an ensemble at random moments; the run must end with the bits of one process that nobody kills.

python tests/kill_ranks.py --kills 50
"""

import argparse
import io
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from contextlib import redirect_stdout, suppress
from pathlib import Path

from diffsim_ti import TetrahedralMesh
from diffsim_ti.optimization import load_state

ROOT = Path(__file__).parent.parent
SCRIPT = ROOT / "examples" / "identify" / "train_distributed.py"
MESH = TetrahedralMesh.create_cube(3, 0.4)


def workers(agent: int) -> list[int]:
    """The ranks that an agent of ours has started."""
    try:
        return [int(pid) for pid in Path(f"/proc/{agent}/task/{agent}/children").read_text().split()]
    except OSError:
        return []


def iteration(path: Path) -> int:
    """The last one in a state file."""
    state = None
    with warnings.catch_warnings(), suppress(FileNotFoundError):  # looked at between two renames
        warnings.simplefilter("ignore")
        state = load_state(path, MESH)
    return 0 if state is None else state["iteration"]


def run(folder: Path, kills: int, iterations: int, seed: int = 0, say=lambda line: None) -> tuple[dict, list[tuple]]:
    """The result of two ranks, one of which is killed again and again, and for each kill (iteration of the state that was
    left, the one after which the next ranks said that they go on)."""
    rng, left, state = random.Random(seed), [], folder / "train_distributed.state"
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc_per_node=2",
        "--monitor-interval=.1",
    ]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), "OMP_NUM_THREADS": "1"}
    script = [f"--max-restarts={kills}", str(SCRIPT), f"--folder={folder}", f"--iterations={iterations}"]
    printed, killed, before = folder.with_suffix(".txt"), 0, set()
    with open(printed, "w") as out:
        process = subprocess.Popen([*command, *script], stdout=out, stderr=subprocess.STDOUT, env=environment)
        try:
            while process.poll() is None:
                time.sleep(0.02)
                ranks, now = workers(process.pid), iteration(state)
                if not before.isdisjoint(ranks):
                    continue  # those that are killed, or end since their neighbour is
                if before:
                    left.append(now)  # nobody writes before the next ones have started
                    before = set()
                if killed < kills and (left[-1] if left else 0) < now < iterations and len(ranks) == 2:
                    time.sleep(rng.uniform(0, 0.1))
                    os.kill(ranks[rng.randrange(2)], signal.SIGKILL)
                    killed, before = killed + 1, set(ranks)
                    say(f"{killed}: killed after iteration {now}")
        finally:
            process.terminate()
            process.wait()
    said = printed.read_text()
    assert process.returncode == 0, said
    gone_on = [int(n) for n in re.findall(r"goes on after iteration (\d+)", said)]
    return json.loads(next(line for line in said.splitlines() if line.startswith("{"))), list(zip(left, gone_on))


def alone(iterations: int) -> dict:
    """The result of one process."""
    sys.path.insert(0, str(SCRIPT.parent))
    import train_distributed

    with redirect_stdout(io.StringIO()):
        return train_distributed.main(None, iterations)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    length = 40 + 4 * options.kills
    one = alone(length)
    with tempfile.TemporaryDirectory() as place:
        many, starts = run(Path(place) / "run", options.kills, length, options.seed, print)
    same = all(one[name] == many[name] for name in ("E", "nu", "loss"))
    from_last = sum(begin == left for left, begin in starts)
    print(f"{many['restarts']} restarts, {from_last} went on from the state that was left; same bits: {same}")
    sys.exit(not same or not many["restarts"] == len(starts) == from_last == options.kills)
