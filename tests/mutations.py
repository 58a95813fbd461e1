"""Do the gradient tests notice a wrong adjoint? Change one thing in adjoint code, run them, and see.

    python tests/mutations.py --count 20 --seed 1

draws places at random (the seed is printed) in functions of the package that compute adjoints, found by what they are
called or given, wherever they stand; changes one thing in each: an index, a row, a sign, a factor, the operands of a
subtraction or the arguments of a call in another order, a range one shorter, a condition the other way round, a statement
left out; writes the changed file into a copy of the package; runs the gradient tests on that copy, those that notice most
first, until one fails. The working tree is never written to.

A mutation is CAUGHT if a test fails because numbers are wrong, and passes on the copy without it. It is REFUSED, and
another is drawn, if the program does not get so far as to compute a number: it does not compile, or raises by itself.
It SURVIVED if all tests pass: its change is printed, and whoever reads it adds the gradient test that is missing, or, if
the change has no effect on any gradient, says here how to recognise that. The exit status is the number of survivors.
"""

import argparse
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from mutation_places import PACKAGE, ROOT, Mutation, all_mutations, drawn

TESTS = """
    test_every_adjoint.py test_loads.py test_springs.py test_chambers.py test_held_volumes.py test_loads_together.py
    test_supports.py test_torch_physics.py test_contact_gradients.py test_checkpoints.py test_gradient_clip.py
    test_gradient_faults.py test_torch.py test_tape.py test_implicit_contact.py test_implicit_gradients.py
    test_self_contact_implicit.py test_gradients.py test_term_order.py test_self_contact.py test_locking.py
    test_scene.py test_contact_force.py test_reaction.py test_outputs.py test_tensor_outputs.py test_modes.py
    test_contact_stage.py test_poses.py test_self_contact_friction.py
    test_batch.py test_batch_tape.py test_muscles.py test_growth.py test_viscosity.py test_laws_with_state.py
    test_open_laws.py test_viscous_stages.py test_unequal_steps.py test_quadratic.py test_quadratic_loads.py
    test_quadratic_outputs.py test_curved_contact.py test_mass_scaling.py
    test_designs.py test_identify.py test_identify_experiments.py test_surface_drag.py test_reduced.py
    test_reduced_explicit.py test_reduced_rigid.py test_robots.py test_obstacle_pairs.py test_rotating_frame.py
    test_couplings.py test_tie.py test_plasticity.py test_contact_area.py test_mesh_obstacle.py test_growth_over_time.py
    test_quadratic_solvers.py test_work.py test_self_contact_near.py
""".split()

WRONG_NUMBERS = ("AssertionError", "assert ", "Failed: ", "FloatingPointError")


@dataclass
class Outcome:
    """What happened: CAUGHT, REFUSED, SURVIVED or TIMED OUT, by which test, with what error, after how long [s]."""

    verdict: str
    test: str = ""
    error: str = ""
    seconds: float = 0.0


def run_tests(copy: Path, tests, timeout: float) -> tuple[int | None, str]:
    """(pytest's status or None if time ran out, what it printed) of the tests on a copy of the package."""
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "400"}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "--tb=line",
        "-rfE",
        "-p",
        "no:cacheprovider",
        f"--rootdir={ROOT}",
        f"--confcutdir={ROOT}",
        *map(str, tests),
    ]
    with subprocess.Popen(
        command,
        cwd=copy,
        env=environment,
        text=True,
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    ) as process:
        try:
            said = process.communicate(timeout=timeout)[0]
            return process.returncode, said
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)
            return None, process.communicate()[0]


def judge(mutation: Mutation | None, tests, timeout: float) -> Outcome:
    """Run the tests on a copy of the package with one mutation (or none)."""
    begin, status, said = time.time(), 0, ""
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        copy = Path(folder)
        shutil.copytree(ROOT / PACKAGE, copy / PACKAGE, ignore=shutil.ignore_patterns("__pycache__"))
        if mutation:
            target = copy / mutation.path
            target.write_bytes(mutation.apply(target.read_bytes()))
        for some in (tests[:1], tests[1:]):  # most need no more than the first file
            if some and status == 0:
                status, said = run_tests(copy, some, timeout)
    seconds = time.time() - begin
    if status is None:
        return Outcome("TIMED OUT", seconds=seconds)
    if status == 0:
        return Outcome("SURVIVED", seconds=seconds)
    summary = re.findall(r"^(?:FAILED|ERROR) (\S+?)(?: - (.*))?$", said, re.MULTILINE)
    test, error = summary[0] if summary else ("", said.strip()[-300:])
    test = test.split("tests/")[-1]
    wrong = status == 1 and summary and any(word in error for word in WRONG_NUMBERS)
    return Outcome("CAUGHT" if wrong else "REFUSED", test, error, seconds)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--count", type=int, default=20, help="mutations that the tests must catch")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--skip", type=int, default=0, help="go on after so many mutations of this seed")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--timeout", type=float, default=1800, help="seconds for one mutation")
    parser.add_argument("--tests", nargs="+", default=[ROOT / "tests" / name for name in TESTS])
    parser.add_argument("--list", action="store_true", help="print the mutations that would be drawn, and stop")
    options = parser.parse_args()
    seed = random.randrange(10**6) if options.seed is None else options.seed
    tests = [str(Path(test).resolve()) if "::" not in str(test) else str(test) for test in options.tests]
    everything, queue = all_mutations(), drawn(seed)
    functions = {(m.path, m.function) for m in everything}
    kinds = dict(Counter(m.kind for m in everything))
    print(f"seed {seed}; {len(everything)} mutations of {len(functions)} functions: {kinds}")
    if options.list:
        for number, mutation in zip(range(options.count), queue):
            print_mutation(number + 1, mutation)
        return 0
    passes_without, verdicts, number = {}, Counter(), options.skip
    for _ in zip(range(options.skip), queue):
        pass
    with ThreadPoolExecutor(options.jobs) as pool:
        while (missing := options.count - sum(verdicts[v] for v in ("CAUGHT", "SURVIVED", "TIMED OUT"))) > 0:
            batch = [m for _, m in zip(range(min(missing, options.jobs)), queue)]
            if not batch:
                break
            for k, mutation in enumerate(batch, start=number + 1):
                print_mutation(k, mutation)
            for outcome in pool.map(lambda m: judge(m, tests, options.timeout), batch):
                number += 1
                if outcome.verdict == "CAUGHT" and outcome.test not in passes_without:
                    alone = judge(None, [ROOT / "tests" / outcome.test], options.timeout)
                    passes_without[outcome.test] = alone.verdict == "SURVIVED"
                if not passes_without.get(outcome.test, True):
                    raise SystemExit(f"{outcome.test} fails without any mutation: repair that first")
                verdicts[outcome.verdict] += 1
                said = f"{outcome.verdict} after {outcome.seconds:.0f} s {outcome.test} {outcome.error[:160]}"
                print(f"{number}. {said}\n", flush=True)
    print(", ".join(f"{count} {verdict.lower()}" for verdict, count in verdicts.items()))
    return verdicts["SURVIVED"] + verdicts["TIMED OUT"]


def print_mutation(number: int, mutation: Mutation) -> None:
    print(f"{number}. {mutation.path}:{mutation.line} {mutation.function} ({mutation.kind})")
    print(mutation.diff((ROOT / mutation.path).read_bytes()), flush=True)


if __name__ == "__main__":
    sys.exit(main())
