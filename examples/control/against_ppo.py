"""Jumping and crawling learnt by the simulator's gradient, and by PPO from as many samples: returns, and time.

One network of 64 x 64 neurons sees what the environments show (`diffsim_ti.envs`) and gives the actions. By gradients,
it is trained through the steps of all scenes at once, `span` of them before states are cut off; by PPO, from rewards alone.
Every iteration of either takes one episode of all scenes. Returns are those of the networks' mean actions.

    python examples/control/against_ppo.py [--iterations 30] [--more 4] [--folder output]

PPO is that of Stable-Baselines3 (pip install "diffsim-ti[learning]"). Schulman et al. 2017, Proximal Policy Optimization,
arXiv:1707.06347; Raffin et al. 2021, Stable-Baselines3, jmlr.org/papers/v22/20-1364.html.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import torch
from torch import nn

import diffsim_ti as ds
from diffsim_ti.envs.crawler import SoftCrawlers
from diffsim_ti.envs.jumper import SoftJumpers

HORIZON = SoftJumpers.horizon
TASKS = {"jumper": (SoftJumpers, HORIZON), "crawler": (SoftCrawlers, 10)}  # steps before states are cut off
SCENES = 16


class Policy(nn.Module):
    """Actions; observations are scaled by those of the first episode."""

    def __init__(self, num_actions: int, seen: np.ndarray):
        super().__init__()
        self.register_buffer("centre", torch.tensor(seen.mean(0), dtype=torch.float32))
        self.register_buffer("scale", torch.tensor(seen.std(0) + 1e-3, dtype=torch.float32))
        sizes = (seen.shape[1], 64), (64, 64)
        hidden = [layer for size in sizes for layer in (nn.Linear(*size), nn.Tanh())]
        self.layers = nn.Sequential(*hidden, nn.Linear(64, num_actions))
        nn.init.orthogonal_(self.layers[-1].weight, 0.01)
        nn.init.zeros_(self.layers[-1].bias)

    def scaled(self, observed) -> torch.Tensor:
        return ((torch.as_tensor(observed, dtype=torch.float32) - self.centre) / self.scale).clamp(-10, 10)

    def forward(self, observed) -> torch.Tensor:
        return self.layers(self.scaled(observed)).tanh()


def fresh(envs, seed: int) -> Policy:
    """A network for an environment, scaled by an episode of random actions."""
    observed, _ = envs.reset(seed=seed)
    envs.action_space.seed(seed)
    rows = [observed]
    for _ in range(HORIZON - 1):
        rows.append(envs.step(envs.action_space.sample())[0])
    torch.manual_seed(seed)
    return Policy(envs.single_action_space.shape[0], np.concatenate(rows))


def mean_return(envs, actions_of: Callable[[np.ndarray], np.ndarray]) -> float:
    """Of an episode by mean actions for what is observed, from the same starts each time."""
    observed, _ = envs.reset(seed=999)
    total = np.zeros(envs.num_envs)
    for _ in range(HORIZON):
        observed, rewards, *_ = envs.step(actions_of(observed))
        total += rewards
    return float(total.mean())


def gradient_iteration(envs, policy: Policy, optimizer, span: int, seed: int) -> None:
    """Ascent by the gradient of what an episode is worth, through `span` steps at a time."""
    envs.reset(seed=seed)
    x, v = (torch.tensor(state, dtype=torch.float32) for state in (envs.positions, envs.velocities))
    press, total, shown = torch.tensor(envs.pressing, dtype=torch.float32), 0.0, []
    for t in range(HORIZON):
        if t % span == 0:
            x, v = x.detach(), v.detach()
        left = torch.full((envs.num_envs,), 1 - t / HORIZON)
        actions = policy(torch.cat(envs.seen(x, v, left), 1))
        forces = torch.einsum("bk,kni->bni", actions, press)[:, None]
        frames = ds.rollout_frames(envs.batch, initial_positions=x, initial_velocities=v, external_forces=forces)
        x, v = frames.positions[:, -1], frames.velocities[:, -1]
        shown.append(envs.progress(x))
        if span < HORIZON and (t + 1) % span == 0:
            total, shown = total + envs.goal(torch.stack(shown)).mean(), []
    total = total if span < HORIZON else envs.goal(torch.stack(shown)).mean()
    optimizer.zero_grad()
    (-total).backward()
    nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
    optimizer.step()


def ppo_of(envs, scaled: Callable, seed: int):
    """Stable-Baselines3's PPO on the scenes: an iteration is an episode of all, in four parts, gone through ten times."""
    try:
        from stable_baselines3 import PPO
        from stable_baselines3.common.vec_env import VecEnv
    except ImportError:
        raise ImportError('PPO of Stable-Baselines3 is missing: pip install "diffsim-ti[learning]"') from None

    class Scenes(VecEnv):
        """Which show scaled observations and rewards, and start anew in the step in which they end, as `SoftBodies` do."""

        def __init__(self):
            space = gymnasium.spaces.Box(-10, 10, envs.single_observation_space.shape, np.float32)
            super().__init__(envs.num_envs, space, envs.single_action_space)

        def reset(self):
            return scaled(envs.reset(seed=seed)[0]).numpy()

        def step_async(self, actions):
            self.actions = actions

        def step_wait(self):
            observed, rewards, terminated, truncated, info = envs.step(self.actions)
            ended = terminated | truncated
            last = scaled(info["final_obs"]).numpy() if info else None
            infos = [dict(terminal_observation=last[k]) if end else {} for k, end in enumerate(ended)]
            return scaled(observed).numpy(), 30.0 * rewards, ended, infos

        def close(self):
            """Nothing is open."""

        def get_attr(self, attr_name, indices=None):
            return [getattr(envs, attr_name, None)] * self.num_envs

        def set_attr(self, attr_name, value, indices=None):
            setattr(envs, attr_name, value)

        def env_method(self, method_name, *args, indices=None, **options):
            return [getattr(envs, method_name)(*args, **options)] * self.num_envs

        def env_is_wrapped(self, wrapper_class, indices=None):
            return [False] * self.num_envs

    samples = HORIZON * envs.num_envs
    network = dict(net_arch=[64, 64], log_std_init=-0.5)
    sizes = dict(n_steps=HORIZON, batch_size=samples // 4, n_epochs=10)
    return PPO("MlpPolicy", Scenes(), 1e-3, **sizes, policy_kwargs=network, seed=seed, device="cpu")


def train(task: str, method: str, iterations: int, seed: int = 0, scenes: int = SCENES) -> list[tuple]:
    """(samples, seconds of processor time, return [m]) after each iteration; the first is before them."""
    kind, span = TASKS[task]
    envs, tested = kind(scenes), kind(scenes)
    policy = fresh(envs, seed)
    if method == "gradient":
        optimizer = torch.optim.Adam(policy.parameters(), lr=3e-3)
        actions_of = lambda observed: policy(observed).detach().numpy()  # noqa: E731
    else:
        ppo = ppo_of(envs, policy.scaled, seed)
        actions_of = lambda observed: ppo.predict(policy.scaled(observed).numpy(), deterministic=True)[0]  # noqa: E731
    curve, spent = [(0, 0.0, mean_return(tested, actions_of))], 0.0
    for k in range(1, iterations + 1):
        begin = time.process_time()
        if method == "gradient":
            gradient_iteration(envs, policy, optimizer, span, seed + k)
        else:
            ppo.learn(scenes * HORIZON, reset_num_timesteps=k == 1)
        spent += time.process_time() - begin
        curve.append((k * scenes * HORIZON, spent, mean_return(tested, actions_of)))
    return curve


def save_picture(path: Path, curves: dict) -> None:
    """Returns over samples, and over time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(TASKS), figsize=(9, 6), constrained_layout=True)
    for column, task in zip(axes.T, TASKS):
        for method, colour in (("gradient", "C0"), ("PPO", "C1")):
            samples, seconds, returns = np.array(curves[task, method]).T
            column[0].plot(samples / 1000, returns, colour, label=method)
            column[1].plot(seconds, returns, colour, label=method)
        column[0].set(title=task, xlabel="thousand steps of the environment", ylabel="return [m]", xscale="symlog")
        column[1].set(xlabel="processor time [s]", ylabel="return [m]")
    axes[0, 0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(folder: str | None = "output", iterations: int = 30, more: int = 4, scenes: int = SCENES) -> dict:
    """more: how many times as many samples PPO takes after the comparison."""
    torch.set_num_threads(1)  # its sums are small
    curves, out = {}, {}
    print("| task | samples | by gradients | by PPO | PPO with more samples |\n| --- | ---: | ---: | ---: | ---: |")
    for task in TASKS:
        for method, count in (("gradient", iterations), ("PPO", more * iterations)):
            curves[task, method] = train(task, method, count, scenes=scenes)
        own, other = curves[task, "gradient"], curves[task, "PPO"]
        equal, last = other[: len(own)], other[-1]
        out[task] = [max(curve, key=lambda row: row[2]) for curve in (own, equal, other)]
        texts = [f"{best[2]:.3f} m in {curve[-1][1]:.0f} s" for best, curve in zip(out[task], (own, equal, other))]
        print(f"| {task} | {own[-1][0]} | {texts[0]} | {texts[1]} | {texts[2]}, {last[0]} samples |")
    if folder:
        Path(folder).mkdir(exist_ok=True)
        save_picture(Path(folder) / "against_ppo.png", curves)
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--iterations", type=int, default=30)
    parser.add_argument("--more", type=int, default=4)
    parser.add_argument("--folder", default="output")
    given = parser.parse_args()
    main(given.folder, given.iterations, given.more)
