"""Runs pytest on executed PTX: `python tests/cuda_on_cpu/run.py [arguments of pytest]`.

`--marked` stands for the tests that CI runs here; `python tests/cuda_on_cpu/run.py tests` runs the whole suite.

New memory is poisoned, and every third launch runs its threads in reverse. Environment, which other values replace:
CUDA_ON_CPU_POISON, _REVERSE (every n-th launch, 0 for none), _MEMORY_MB and _DEVICES of the device, _CACHE (a folder).
"""

import os
import subprocess
import sys

from build import CannotBuild, environment

MARKED = ["tests", "-m", "backends or executed_ptx"]


def main(arguments: list[str]) -> int:
    try:
        variables = environment(poison=1, reverse=3)
    except CannotBuild as error:
        print(f"the stand-in for the CUDA driver cannot be built: {error}")
        return 1
    variables |= {name: value for name, value in os.environ.items() if name.startswith("CUDA_ON_CPU_")}
    arguments = [*MARKED, *(a for a in arguments if a != "--marked")] if "--marked" in arguments else arguments
    return subprocess.call([sys.executable, "-m", "pytest", *arguments], env=variables)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
