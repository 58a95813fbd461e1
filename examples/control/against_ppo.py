"""Jumping and crawling learnt by the simulator's gradient, and by PPO from as many samples: returns, and time.

One network of 64 x 64 neurons sees what the environments show (`diffsim_ti.envs`) and gives the actions. By gradients,
it is trained through the steps of all scenes at once, `span` of them before states are cut off; by PPO, from rewards alone.
Every iteration of either takes one episode of all scenes. Returns are those of the networks' mean actions.

    python examples/control/against_ppo.py [--iterations 30] [--more 4] [--folder output]

Schulman et al. 2017, Proximal Policy Optimization, arXiv:1707.06347, as in CleanRL's ppo_continuous_action.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from torch import nn

import diffsim_ti as ds
from diffsim_ti.envs.crawler import SoftCrawlers
from diffsim_ti.envs.jumper import SoftJumpers

HORIZON = SoftJumpers.horizon
TASKS = {"jumper": (SoftJumpers, HORIZON), "crawler": (SoftCrawlers, 10)}  # steps before states are cut off
SCENES, GAMMA, LAMBDA, CLIP, EPOCHS, BATCHES = 16, 0.99, 0.95, 0.2, 10, 4


class Policy(nn.Module):
    """Mean actions, and how much PPO tries around them; observations are scaled by those of the first episode."""

    def __init__(self, num_actions: int, seen: np.ndarray):
        super().__init__()
        self.register_buffer("centre", torch.tensor(seen.mean(0), dtype=torch.float32))
        self.register_buffer("scale", torch.tensor(seen.std(0) + 1e-3, dtype=torch.float32))
        self.mean, self.value = self._layers(seen, num_actions, 0.01), self._layers(seen, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((num_actions,), -0.5))

    @staticmethod
    def _layers(seen: np.ndarray, outputs: int, gain: float) -> nn.Sequential:
        out = nn.Sequential(
            nn.Linear(seen.shape[1], 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
        )
        nn.init.orthogonal_(out[-1].weight, gain)
        nn.init.zeros_(out[-1].bias)
        return out

    def scaled(self, observed) -> torch.Tensor:
        return ((torch.as_tensor(observed, dtype=torch.float32) - self.centre) / self.scale).clamp(-10, 10)

    def forward(self, observed) -> torch.Tensor:
        return self.mean(self.scaled(observed)).tanh()

    def tried(self, observed) -> torch.distributions.Normal:
        return torch.distributions.Normal(self(observed), self.log_std.exp())


def fresh(envs, seed: int) -> Policy:
    """A network for an environment, scaled by an episode of random actions."""
    observed, _ = envs.reset(seed=seed)
    envs.action_space.seed(seed)
    rows = [observed]
    for _ in range(HORIZON - 1):
        rows.append(envs.step(envs.action_space.sample())[0])
    torch.manual_seed(seed)
    return Policy(envs.single_action_space.shape[0], np.concatenate(rows))


def mean_return(envs, policy: Policy) -> float:
    """Of an episode by mean actions, from the same starts each time."""
    observed, _ = envs.reset(seed=999)
    total = np.zeros(envs.num_envs)
    for _ in range(HORIZON):
        with torch.no_grad():
            actions = policy(observed).numpy()
        observed, rewards, *_ = envs.step(actions)
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
    nn.utils.clip_grad_norm_(policy.mean.parameters(), 1.0)
    optimizer.step()


def episode(envs, policy: Policy, seed: int) -> tuple[torch.Tensor, ...]:
    """Observations, tried actions, their log likelihoods, rewards of an episode, (steps, scenes, ...)."""
    observed, _ = envs.reset(seed=seed)
    rows = []
    for _ in range(HORIZON):
        with torch.no_grad():
            tried = policy.tried(observed)
            actions = tried.sample()
            likelihood = tried.log_prob(actions).sum(1)
        after, rewards, *_ = envs.step(actions.numpy())
        rows.append((torch.tensor(observed, dtype=torch.float32), actions, likelihood, torch.tensor(rewards)))
        observed = after
    return tuple(torch.stack(column).float() for column in zip(*rows))


def ppo_iteration(envs, policy: Policy, optimizer, reward_scale: float, seed: int) -> None:
    """One episode of all scenes, and `EPOCHS` passes over it."""
    observed, actions, likelihoods, rewards = episode(envs, policy, seed)
    with torch.no_grad():
        values, advantage = policy.value(policy.scaled(observed))[..., 0], torch.zeros_like(rewards)
        running = torch.zeros(envs.num_envs)
        for t in reversed(range(HORIZON)):  # an episode ends in its last step
            after = values[t + 1] if t + 1 < HORIZON else torch.zeros(envs.num_envs)
            running = rewards[t] * reward_scale + GAMMA * after - values[t] + GAMMA * LAMBDA * running
            advantage[t] = running
        returns = (advantage + values).flatten()
    flat = observed.flatten(0, 1), actions.flatten(0, 1), likelihoods.flatten(), advantage.flatten()
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(returns)).chunk(BATCHES):
            seen, done, before, gain = (x[rows] for x in flat)
            ratio = (policy.tried(seen).log_prob(done).sum(1) - before).exp()
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            surrogate = torch.minimum(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
            missed = (policy.value(policy.scaled(seen))[:, 0] - returns[rows]).square().mean()
            optimizer.zero_grad()
            (0.5 * missed - surrogate).backward()
            nn.utils.clip_grad_norm_(policy.parameters(), 0.5)
            optimizer.step()


def train(task: str, method: str, iterations: int, seed: int = 0, scenes: int = SCENES) -> list[tuple]:
    """(samples, seconds of processor time, return [m]) after each iteration; the first is before them."""
    kind, span = TASKS[task]
    envs = kind(scenes)
    policy = fresh(envs, seed)
    rate = 3e-3 if method == "gradient" else 1e-3
    optimizer = torch.optim.Adam(policy.parameters(), lr=rate)
    curve, spent = [(0, 0.0, mean_return(envs, policy))], 0.0
    for k in range(1, iterations + 1):
        begin = time.process_time()
        if method == "gradient":
            gradient_iteration(envs, policy, optimizer, span, seed + k)
        else:
            ppo_iteration(envs, policy, optimizer, 30.0, seed + k)
        spent += time.process_time() - begin
        curve.append((k * scenes * HORIZON, spent, mean_return(envs, policy)))
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
