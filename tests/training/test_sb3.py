"""Stable-Baselines3's algorithms: what is exported acts as the model does, and warm starts carry over."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import VecNormalize

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.policies.policy_file import load_policy, save_policy
from dmcvb_gen.training import runs, sb3
from dmcvb_gen.training.runs import RunConfig
from dmcvb_gen.training.training import open_run

torch.set_num_threads(1)
TINY = {
    "sb3-sac": dict(learning_starts=24, batch_size=16, hidden=[16], simulations=4, normalize_observation=True),
    "tqc": dict(learning_starts=24, batch_size=16, hidden=[8, 16], simulations=4, n_quantiles=5),
    "td3": dict(learning_starts=24, batch_size=16, hidden=[16, 8], simulations=4, action_noise=0.3),
    "ppo": dict(n_steps=10, batch_size=20, hidden=[16], simulations=4, n_epochs=2),
}


@pytest.fixture
def models(monkeypatch):
    """Trained models, in the order of their runs."""
    kept, make = [], sb3.Sb3Run._model
    monkeypatch.setattr(runs, "EVALUATION_EPISODES", 2)
    monkeypatch.setattr(sb3.Sb3Run, "_model", lambda run, env: kept.append(make(run, env)) or kept[-1])
    return kept


@pytest.mark.parametrize("algorithm", TINY)
def test_a_run_leaves_no_logs_in_the_temporary_folder(algorithm, tmp_path, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    train(tmp_path / "run", algorithm)
    assert not list((tmp_path / "temporary").glob("SB3*"))


def train(folder, algorithm, **changes):
    fields = dict(task="cheetah-run", algorithm=algorithm, steps=80, seed=0, settings=TINY[algorithm])
    run = open_run(folder, RunConfig(**fields | dict(evaluate_every=80, evaluate_sparse=80) | changes), False)
    run.train()
    return run


@pytest.mark.parametrize("algorithm", TINY)
def test_an_exported_policy_acts_as_the_model_it_comes_from(tmp_path, models, algorithm):
    run = train(tmp_path / "run", algorithm)
    policy, model = load_policy(run.folder / "checkpoints" / "0000000080.safetensors"), models[-1]
    observation = np.random.default_rng(0).normal(0, 3, (200, run.task.behaviour_size)).astype(np.float32)
    env = model.get_env()
    seen = env.normalize_obs(observation) if isinstance(env, VecNormalize) else observation
    wanted, _ = model.predict(seen, deterministic=True)
    np.testing.assert_allclose(policy.act(observation, deterministic=True), wanted, atol=2e-5)

    # Sampled actions: the spread of the model's own (TD3's is its exploration noise).
    generators = [np.random.default_rng(i) for i in range(4000)]
    ours = policy.act(np.repeat(observation[:1], 4000, axis=0), generators)
    torch.manual_seed(0)
    if algorithm == "td3":
        noise = np.random.default_rng(0).normal(0, 0.3, ours.shape)
        theirs = np.clip(model.predict(np.repeat(seen[:1], 4000, axis=0))[0] + noise, -1, 1)
    else:
        theirs, _ = model.predict(np.repeat(seen[:1], 4000, axis=0), deterministic=False)
    np.testing.assert_allclose(ours.mean(0), theirs.mean(0), atol=0.06)
    np.testing.assert_allclose(ours.std(0), theirs.std(0), atol=0.04)
    assert policy.header.algorithm == algorithm and policy.header.evaluation.episodes >= 1


def test_ppo_starts_from_a_network_that_acts_without_noise_with_a_noise_of_its_own(tmp_path, models):
    """Converted plain networks have a log standard deviation of -80, from which PPO would get NaN."""
    first = train(tmp_path / "first", "ppo")
    policy = load_policy(first.folder / "checkpoints" / "0000000080.safetensors")
    arrays = dict(policy.weights) | {"log_std_vector": np.full(6, -80, np.float32)}
    save_policy(tmp_path / "plain.safetensors", policy.header, arrays)
    train(tmp_path / "second", "ppo", init_from=str(tmp_path / "plain.safetensors"))
    assert (models[-1].policy.log_std.detach() > -5).all()
    other = policy.header.model_copy(update={"activation": "relu"})
    save_policy(tmp_path / "relu.safetensors", other, dict(policy.weights))
    with pytest.raises(DmcvbError, match="activation relu and that of ppo tanh"):
        train(tmp_path / "third", "ppo", init_from=str(tmp_path / "relu.safetensors"))


@pytest.mark.parametrize("algorithm", ["tqc", "ppo"])
def test_a_warm_start_takes_the_networks_of_a_run_or_a_policy(tmp_path, models, monkeypatch, algorithm):
    first = train(tmp_path / "first", algorithm)
    path, names = first.folder / "checkpoints" / "0000000080.safetensors", first._names()
    started, start = [], sb3.Sb3Run._start_from

    def watch(run, source, model, normalize):
        start(run, source, model, normalize)
        started.append({name: value.clone() for name, value in run._actor_weights(model, normalize).items()})

    monkeypatch.setattr(sb3.Sb3Run, "_start_from", watch)
    for number, source in enumerate((first.folder, path)):
        train(tmp_path / str(number), algorithm, init_from=str(source), steps=40)
    for weights in started:
        for name, value in load_policy(path).weights.items():
            np.testing.assert_allclose(weights[name].numpy(), value, rtol=1e-5, atol=1e-6)
        assert set(names) <= set(weights)
    with pytest.raises(DmcvbError, match="does not fit"):
        train(tmp_path / "wide", algorithm, init_from=str(path), settings=TINY[algorithm] | {"hidden": [32]})
    with pytest.raises(DmcvbError, match="no run of td3"):
        train(tmp_path / "td3", "td3", init_from=str(first.folder))
    with pytest.raises(DmcvbError, match="normalizes observations; give --set normalize_observation=true"):
        normal = load_policy(path)
        arrays = dict(normal.weights) | {"observation_mean": normal.weights["observation_mean"] + 1}
        save_policy(tmp_path / "normal.safetensors", normal.header, arrays)
        unnormal = TINY[algorithm] | {"normalize_observation": False}
        train(tmp_path / "unnormal", algorithm, init_from=str(tmp_path / "normal.safetensors"), settings=unnormal)
    if algorithm == "ppo":  # its runs normalize by default
        with pytest.raises(DmcvbError, match="normalizes observations; give --set normalize_observation=true"):
            train(tmp_path / "unnormal", algorithm, init_from=str(first.folder), settings=unnormal)
    with pytest.raises(DmcvbError, match="neither a run folder nor a policy file"):
        train(tmp_path / "none", "td3", init_from=str(tmp_path / "nowhere"))
    assert not any((tmp_path / name).exists() for name in ("wide", "td3", "unnormal", "none")), "refused in time"
