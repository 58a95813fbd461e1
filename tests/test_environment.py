"""Environments of Gymnasium over a batch: the single one's contract, many as one by one, ends, training."""

import numpy as np
import pytest
from example_files import EXAMPLES, example

gym = pytest.importorskip("gymnasium")


@pytest.fixture(scope="module")
def jumper():
    return example("control/jumper")


@pytest.mark.filterwarnings("ignore:.*A Box observation space")
def test_one_passes_gymnasiums_checks(jumper):
    from gymnasium.utils.env_checker import check_env

    check_env(jumper.SoftJumper(), skip_render_check=True)


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
        one.positions[:], one.highest[:] = starts[b], starts[b, :, 1].mean()
        for a, (together, reward) in zip(actions, rows):
            alone, own, *_ = one.step(a[b : b + 1])
            np.testing.assert_array_equal(alone[0], together[b])
            assert own[0] == reward[b]


def test_an_end_starts_anew_and_shows_its_last_observation(jumper):
    envs = jumper.SoftJumpers(2)
    first, _ = envs.reset(seed=0)
    envs.steps[:] = [jumper.HORIZON - 1, 3]
    observed, _, terminated, truncated, info = envs.step(np.zeros((2, 2)))
    assert truncated.tolist() == [True, False] and not terminated.any()
    assert info["_final_obs"].tolist() == [True, False] and info["final_obs"][0, -1] == 0
    assert observed[0, -1] == 1 and observed[1, -1] < 1
    np.testing.assert_array_equal(info["final_obs"][1], observed[1])


@pytest.fixture
def against_ppo(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES / "control")
    return example("control/against_ppo")


@pytest.mark.filterwarnings("ignore:.*A Box observation space")
def test_a_crawler_passes_them_too_and_pushes_nothing_but_itself(against_ppo):
    import crawler
    from gymnasium.utils.env_checker import check_env

    one = crawler.SoftCrawler()
    check_env(one, skip_render_check=True)
    pulls, X = one.all.pressing, one.all.scene.mesh.vertices
    np.testing.assert_allclose(pulls.sum(1), 0, atol=1e-12)
    np.testing.assert_allclose(np.cross(X, pulls).sum(1), 0, atol=1e-12)


@pytest.mark.parametrize("method", ["gradient", "PPO"])
def test_a_crawler_learns_by_gradients_and_ppo_takes_as_many_samples(against_ppo, method):
    curve = against_ppo.train("crawler", method, 2, scenes=4)
    assert [row[0] for row in curve] == [0, 200, 400] and np.isfinite(curve).all()
    if method == "gradient":
        assert curve[-1][2] > curve[0][2] + 0.003


@pytest.mark.filterwarnings("error:scenes")
def test_cubes_learn_to_jump_by_gradients(jumper, capsys):
    found = jumper.main(8, 3, 12)
    assert found["jumped"] > found["rest"] + 0.01
    assert found["best"] > found["first"] + 0.03
    assert "at once" in capsys.readouterr().out
