"""Soft bodies of two legs crawl over a rough floor by a simple gait: `diffsim_ti.envs.crawler`, many at once.

python examples/control/crawler.py
"""

import numpy as np

from diffsim_ti.envs.crawler import SoftCrawlers


def main(num_envs: int = 16, steps: int = 50) -> float:
    """The way [m] that a simple gait comes, by two waves of 5 Hz."""
    envs = SoftCrawlers(num_envs)
    envs.reset(seed=0)
    way = np.zeros(num_envs)
    for k in range(steps - 1):
        phase = 2 * np.pi * 5 * 0.01 * k + np.array([0.0, np.pi, 0.0, np.pi])
        way += envs.step(np.tile(np.sin(phase), (num_envs, 1)))[1]
    print(f"{num_envs} crawlers: a gait by waves comes {way.mean():+.3f} m in {steps * 0.01:.2f} s")
    return float(way.mean())


if __name__ == "__main__":
    main()
