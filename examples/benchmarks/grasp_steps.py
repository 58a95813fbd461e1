"""Steps per second of `diffsim_ti/Grasp-v0`, all environments together, by the number of environments.

As Newton's are measured (github.com/newton-physics/newton/issues/4141): number of environments over the mean wall time of
`step`, with random actions, after some that are not counted. Environments are those of `gymnasium.make_vec`, and restart
where an episode ends. A step is 10 ms in 40 substeps of a cube of 27 vertices between two pads.

    python examples/benchmarks/grasp_steps.py [--arch cuda|vulkan|cpu] [--seconds 20] [environments ...]
"""

import argparse
import time

import gymnasium
import numpy as np

import diffsim_ti as ds
import diffsim_ti.envs

SECONDS, WARM = 20.0, 10  # that are measured; steps before


def steps_per_second(num_envs: int, seconds: float = SECONDS) -> float:
    """Steps of one environment, of all environments, in a second."""
    envs = gymnasium.make_vec("diffsim_ti/Grasp-v0", num_envs=num_envs)
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(100)]
    for k in range(WARM):
        envs.step(actions[k])
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        rewards = envs.step(actions[count % len(actions)])[1]
        count += 1
    if not np.isfinite(rewards).all():
        raise FloatingPointError(f"{num_envs} environments: rewards are not finite")
    return num_envs * count / (time.perf_counter() - start)


def main(counts=(1, 64, 1024), seconds: float = SECONDS) -> dict[int, float]:
    """{environments: steps per second}"""
    print("| environments | steps per second |\n| ---: | ---: |")
    found = {}
    for count in counts:
        found[count] = steps_per_second(count, seconds)
        print(f"| {count} | {found[count]:.0f} |", flush=True)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("environments", nargs="*", type=int, default=[1, 64, 1024])
    parser.add_argument("--arch", choices=("cuda", "vulkan", "cpu"), default="cpu")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="that are measured")
    given = parser.parse_args()
    ds.init(given.arch)
    main(given.environments, given.seconds)
