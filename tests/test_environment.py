"""Environments of Gymnasium over a batch: the single one's contract, many as one by one, ends, training."""

import ast
import runpy
import subprocess
import sys

import numpy as np
import pytest
from example_files import EXAMPLES, example

import diffsim_ti as ds

gym = pytest.importorskip("gymnasium")
TASKS = ["Jumper", "Crawler", "Grasp"]


@pytest.fixture(scope="module")
def jumper():
    from diffsim_ti.envs import jumper

    return jumper


def test_registering_starts_nothing():
    code = (
        "import diffsim_ti.envs, gymnasium; from diffsim_ti.runtime.threads import current_program; "
        "assert current_program() is None; "
        "print(sorted(name for name in gymnasium.registry if name.startswith('diffsim_ti/')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ast.literal_eval(done.stdout.splitlines()[-1]) == sorted(f"diffsim_ti/{task}-v0" for task in TASKS), (
        done.stderr
    )


@pytest.mark.filterwarnings("ignore:.*A Box observation space")
@pytest.mark.parametrize("task", TASKS)
def test_tasks_pass_gymnasiums_checks(task):
    """One, and that one of many made by name is the same."""
    from gymnasium.utils.env_checker import check_env

    import diffsim_ti.envs  # noqa: F401

    one, many = gym.make(f"diffsim_ti/{task}-v0"), gym.make_vec(f"diffsim_ti/{task}-v0", num_envs=2)
    check_env(one.unwrapped, skip_render_check=True)
    assert many.num_envs == 2 and many.single_observation_space == one.observation_space
    seen, _ = many.reset(seed=3)
    again, _ = many.reset(seed=3)
    np.testing.assert_array_equal(seen, again)
    action = many.action_space.sample()
    first = many.step(action)
    many.reset(seed=3)
    np.testing.assert_array_equal(many.step(action)[0], first[0])


def test_a_law_that_remembers_is_refused_when_a_task_is_made(jumper):
    class Relaxing(jumper.SoftJumpers):
        @staticmethod
        def make_scene():
            scene = jumper.SoftJumpers.make_scene()
            return scene.replace(material=ds.Prony(scene.material, [0.3], [0.02]))

    with pytest.raises(ValueError, match="nor from what a law remembers: take a Simulator for each scene"):
        Relaxing(1)


def test_pads_lift_a_cube():
    """Closed, then raised: the cube comes along by friction, and the force that is observed is that of the pads."""
    from diffsim_ti.envs.grasp import HEIGHT, SoftGrasps

    envs = SoftGrasps(2)
    envs.reset(seed=0)
    height, total = envs.positions[..., 1].mean(1), np.zeros(2)
    for k in range(envs.horizon - 1):
        squeeze = 1.0 if k < 5 else 0.0
        actions = np.tile([squeeze, -1.0 if k < 8 else 0.5], (2, 1))  # pads on the floor go no lower
        observed, rewards, terminated, *_ = envs.step(actions)
        total += rewards
        assert k != 7 or (rewards > -0.1).all()  # nothing slips past pads that stand still
        assert not terminated.any()
    assert (envs.positions[..., 1].mean(1) - height > HEIGHT).all() and (total > 10).all(), total
    weight = 9.81 * 300.0 * envs.scene.mesh.volume
    assert (observed[:, -2:] > 0.5 * weight / 0.5).all()  # each holds half of it, at a coefficient of 0.5
    envs.reset(seed=0)
    for _ in range(10):
        idle = envs.step(np.tile([-1.0, 1.0], (2, 1)))[1]
    assert (idle < 0.2).all()  # pads alone lift nothing


def test_many_are_one_by_one(jumper):
    envs, one = jumper.SoftJumpers(3), jumper.SoftJumpers(1)
    observed, _ = envs.reset(seed=1)
    one.reset(seed=1)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(4)]
    starts, rows = envs.positions.copy(), []
    for a in actions:
        observed, rewards, *_ = envs.step(a)
        rows.append((observed, rewards))
    for b in range(3):
        one.reset(seed=1)
        one.positions[:], one.best[:] = starts[b], starts[b, :, 1].mean()
        for a, (together, reward) in zip(actions, rows):
            alone, own, *_ = one.step(a[b : b + 1])
            np.testing.assert_array_equal(alone[0], together[b])
            assert own[0] == reward[b]


def test_an_end_starts_anew_and_shows_its_last_observation(jumper):
    envs = jumper.SoftJumpers(2)
    first, _ = envs.reset(seed=0)
    envs.steps[:] = [envs.horizon - 1, 3]
    observed, _, terminated, truncated, info = envs.step(np.zeros((2, 2)))
    assert truncated.tolist() == [True, False] and not terminated.any()
    assert info["_final_obs"].tolist() == [True, False] and info["final_obs"][0, -1] == 0
    assert observed[0, -1] == 1 and observed[1, -1] < 1
    np.testing.assert_array_equal(info["final_obs"][1], observed[1])


@pytest.fixture
def against_ppo(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES / "control")
    return example("control/against_ppo")


def test_a_crawler_pushes_nothing_but_itself():
    from diffsim_ti.envs.crawler import SoftCrawlers

    envs = SoftCrawlers(1)
    pulls, X = envs.pressing, envs.scene.mesh.vertices
    np.testing.assert_allclose(pulls.sum(1), 0, atol=1e-12)
    np.testing.assert_allclose(np.cross(X, pulls).sum(1), 0, atol=1e-12)


@pytest.mark.parametrize("method, iterations", [("gradient", 2), ("PPO", 1)])
def test_a_crawler_learns_by_gradients_and_ppo_takes_as_many_samples(against_ppo, method, iterations):
    if method == "PPO":
        pytest.importorskip("stable_baselines3")
    curve = against_ppo.train("crawler", method, iterations, scenes=4)
    assert [row[0] for row in curve] == [0, 200, 400][: iterations + 1] and np.isfinite(curve).all()
    if method == "gradient":
        assert curve[-1][2] > curve[0][2] + 0.003


def test_steps_of_grasps_are_counted_on_the_processor_of_ones_choice(monkeypatch, capsys):
    started = []
    monkeypatch.setattr("diffsim_ti.init", started.append)
    monkeypatch.setattr(sys, "argv", ["grasp_steps.py", "--arch", "vulkan", "--seconds", "0.01", "1"])
    runpy.run_path(str(EXAMPLES / "benchmarks/grasp_steps.py"), run_name="__main__")
    *_, row = capsys.readouterr().out.splitlines()
    count, steps = map(float, row.split("|")[1:-1])
    assert started == ["vulkan"] and count == 1 and steps > 0
