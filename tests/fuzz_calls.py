"""Random wrong calls of public constructors: python tests/fuzz_calls.py --count 20000

One argument to four of each call are wrong, or another call's. Only ValueError and TypeError may come out, raised by a line
of the package, in one message. Prints every other; exit code 1 if there is one.
"""

import argparse
import sys
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from test_calls import drawn  # noqa: E402

import diffsim_ti as ds  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="calls; default 2000")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    ds.init(precision="f64")
    warnings.simplefilter("ignore")
    bad = 0
    for said in drawn(arguments.count, arguments.seed):
        bad += 1
        print(said, flush=True)
    print(f"{bad} of {arguments.count} calls failed in words that are not ours")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
