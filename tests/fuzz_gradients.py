"""Fuzz of gradients over the public surface: python tests/fuzz_gradients.py --minutes 30

Random scenes, one to a seed, eight to a compiled structure. Every derivative is taken by the reverse sweep, by the
tangent and by extrapolated differences; gradients are compared over repeats, schedules and faces, and with clip and
truncate by definition. Prints every failure with the command that repeats it, then tables. Exit code 1 if anything failed.
"""

import argparse
import itertools
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from gradient_fuzz.judge import judge  # noqa: E402
from gradient_fuzz.report import Report, as_json, failure_text  # noqa: E402
from gradient_fuzz.structures import PER_STRUCTURE  # noqa: E402

import diffsim_ti as ds  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0, help="how long; default 30")
    parser.add_argument("--configurations", type=int, help="how many; default as many as time allows")
    each = dict(type=int, choices=range(1, PER_STRUCTURE + 1), default=PER_STRUCTURE)
    parser.add_argument("--each", **each, help="how many of a structure; default all, 8")
    parser.add_argument("--seed", type=int, default=0, help="the first seed; default 0")
    parser.add_argument("--only", action="store_true", help="only this seed, with every derivative")
    parser.add_argument("--arch", default="cpu", help="where kernels run; default cpu")
    parser.add_argument("--json", type=Path, help="write the tables here too")
    arguments = parser.parse_args()
    ds.init(arguments.arch, "f64")
    end, report = time.monotonic() + 60 * arguments.minutes, Report()
    count = 1 if arguments.only else arguments.configurations
    seeds = (s for s in itertools.count(arguments.seed) if arguments.only or s % PER_STRUCTURE < arguments.each)
    for seed in itertools.islice(seeds, count):
        if time.monotonic() > end:
            break
        result = judge(seed)
        report.add(result)
        if arguments.only:
            print(result.structure, *result.rows, result.checks, result.seen, result.refusal, sep="\n")
        if result.failed:
            print(failure_text(result), flush=True)
        if arguments.json:  # also of a run that is stopped
            arguments.json.write_text(json.dumps(as_json(report), indent=1))
    print(report)
    return 1 if report.failures else 0


if __name__ == "__main__":
    sys.exit(main())
