"""Any algorithm of Stable-Baselines3: what is exported acts as the model does, and runs stop and go on."""

import numpy as np
import pytest
import torch

from dmcvb_gen.policies.header import origin_of
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training import run as runs
from dmcvb_gen.training import sb3
from dmcvb_gen.training.run import RunConfig, open_run
from dmcvb_gen.training.vec_env import TaskVecEnv

torch.set_num_threads(1)
NET = {"net_arch": [8, 16]}
TINY = {
    "sb3:SAC": dict(learning_starts=24, batch_size=16, simulations=4),
    "sb3:TQC": dict(learning_starts=24, batch_size=16, policy_kwargs=NET),
    "sb3:CrossQ": dict(learning_starts=24, batch_size=16),
    "sb3:TD3": dict(learning_starts=24, batch_size=16, action_noise=0.3),
    "sb3:PPO": dict(n_steps=5, batch_size=20, n_epochs=2),
    "sb3:TRPO": dict(n_steps=5, batch_size=20),
    "sb3:A2C": dict(policy_kwargs=NET, gamma=0.9),
}


@pytest.fixture
def models(monkeypatch):
    """Models, in the order of their making."""
    kept, make = [], sb3.make_model
    monkeypatch.setattr(runs, "EVALUATION_EPISODES", 1)
    monkeypatch.setattr(sb3, "make_model", lambda run: kept.append(make(run)) or kept[-1])
    return kept


def opened(folder, algorithm, resume=False, steps=80, every=80):
    return open_run(folder, RunConfig("cheetah-run", algorithm, steps, 0, TINY[algorithm], every), resume)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", TINY)
def test_an_exported_policy_acts_as_the_model_it_comes_from(tmp_path, models, monkeypatch, algorithm):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    run = opened(tmp_path / "run", algorithm)
    run.train()
    assert not [path for path in (tmp_path / "temporary").iterdir() if "torchinductor" not in path.name]
    policy, model = load_policy(run.folder / "checkpoints" / "0000000080.safetensors"), models[-1]
    observation = np.random.default_rng(0).normal(0, 3, (200, run.task.behaviour_size)).astype(np.float32)
    wanted, _ = model.predict(observation, deterministic=True)
    np.testing.assert_allclose(policy.act(observation, deterministic=True), wanted, atol=2e-5)
    header, kwargs = policy.header, TINY[algorithm].get("policy_kwargs", {})
    assert run.settings.policy_kwargs in (None, kwargs)
    assert header.algorithm == algorithm and header.evaluation.episodes >= 1 and f"--algo {algorithm}" in header.command
    assert algorithm.removeprefix("sb3:") in origin_of(header.algorithm)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["sb3:SAC", "sb3:PPO"])
def test_a_resumed_run_has_networks_and_buffer(tmp_path, models, algorithm):
    opened(tmp_path / "run", algorithm, steps=120, every=400).train()
    before, again = models[-1], opened(tmp_path / "run", algorithm, resume=True, steps=400, every=400)
    again.step = again.saved()["step"]
    model = sb3.make_model(again)
    sb3.restore(model, again.saved())
    assert model._n_updates == before._n_updates > 0
    for name, value in before.policy.state_dict().items():
        torch.testing.assert_close(model.policy.state_dict()[name], value, rtol=0, atol=0)
    if algorithm == "sb3:SAC":
        np.testing.assert_array_equal(model.replay_buffer.actions, before.replay_buffer.actions)
        assert (model.replay_buffer.pos, float(model.log_ent_coef)) == (29, float(before.log_ent_coef))
    assert (model.get_env().reset() != sb3.make_model(opened(tmp_path / "new", algorithm)).get_env().reset()).any()


# -- its episodes: actions in their bounds, correct ends -----------------------------------------------


def test_actions_are_taken_in_the_tasks_own_bounds():
    """Quadruped's are not -1 to 1; beside its simulations on their own."""
    task, rng = get_task("quadruped-walk"), np.random.default_rng(0)
    env, alone = TaskVecEnv(task, 2, seed=3), task.batch(2)
    env.reset()
    alone.set_physics(env.episodes._batch.physics())
    for _ in range(5):
        actions = rng.uniform(task.action_low, task.action_high, (2, task.action_size)).astype(np.float32)
        _, reward, _, _ = env.step(actions)
        np.testing.assert_allclose(reward, alone.step(actions).reward, atol=1e-5)
        np.testing.assert_allclose(env.episodes._batch.physics(), alone.physics(), rtol=1e-4, atol=1e-4)


def test_an_episode_that_ends_shows_its_last_observation_and_whether_only_time_ended_it(monkeypatch):
    task = get_task("walker-walk")
    env, twin = (TaskVecEnv(task, 2, seed=5) for _ in range(2))
    first = env.reset()
    np.testing.assert_array_equal(first, twin.reset())
    action = np.full((2, task.action_size), 0.3, np.float32)
    for step in range(1, task.max_steps + 1):
        observation, _, done, infos = env.step(action)
        if step < task.max_steps // 2:
            twin.step(action)
        if step == task.max_steps // 2:  # so that ends do not fall together, the second one's first episode is short
            twin.episodes._elapsed[:] = 0
            assert done.tolist() == [False, True] and infos[1]["TimeLimit.truncated"]
            np.testing.assert_array_equal(infos[1]["terminal_observation"], twin.step(action)[0][1])
            assert not np.allclose(observation[1], infos[1]["terminal_observation"])
            assert not np.allclose(observation[1], first[1])  # a new initial state, not the first again
    assert done.tolist() == [True, False]
    monkeypatch.setattr(env.episodes._batch, "_control_terminated", lambda: np.array([False, True]))
    _, _, done, infos = env.step(action)
    assert done.tolist() == [False, True] and not any(info["TimeLimit.truncated"] for info in infos)
    assert ["terminal_observation" in info for info in infos] == [False, True]
