"""The trainer: correct updates, runs that resume, folders that are not mixed up."""

from __future__ import annotations

import csv
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from dmcvb_gen.behaviours.policy_file import PolicyHeader, load_policy
from dmcvb_gen.behaviours.sac import CriticEnsemble, ReplayBuffer, RunningNorm, Sac, SacSettings
from dmcvb_gen.behaviours.training import Run, RunConfig, open_run, standing_states
from dmcvb_gen.cli import main
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.tasks import get_task

TINY = dict(warmup_steps=64, batch_size=16, actor_hidden=[16], critic_hidden=[16], compile=False, simulations=4)
TINY |= dict(train_episode_steps=20, bfloat16=False)


def config(**changes):
    fields = dict(task="cheetah-run", algorithm="sac", steps=160, seed=0, settings=TINY, evaluate_every=80)
    return RunConfig(**fields | {"evaluate_sparse": 80} | changes)


def learner(**changes):
    header = PolicyHeader(task="x", observation_size=3, action_size=2, algorithm="sac", agent_step=0, hidden=(8, 8))
    settings = SacSettings(**dict(compile=False, bfloat16=False, critic_hidden=(8, 8)) | changes)
    return Sac(header, settings, 0)


def batch_of(count=64):
    rng = np.random.default_rng(0)
    values = dict(
        observation=rng.normal(size=(count, 3)),
        next_observation=rng.normal(size=(count, 3)),
        action=rng.uniform(-1, 1, (count, 2)),
        reward=rng.random(count),
        terminated=rng.random(count) < 0.2,
    )
    return {name: torch.tensor(np.asarray(value), dtype=torch.float32) for name, value in values.items()}


def test_the_ensemble_is_two_separate_critics():
    torch.manual_seed(0)
    critic = CriticEnsemble(3, 2, (8, 8), bfloat16=False)
    observation, action = torch.randn(5, 3), torch.rand(5, 2)
    both = critic(observation, action)
    for k in range(2):  # each critic by hand
        x = torch.cat([observation, action], 1)
        for w, b, scale, shift in zip(critic.weights, critic.biases, critic.scales, critic.shifts, strict=True):
            x = torch.nn.functional.layer_norm(x @ w[k] + b[k], (8,)) * scale[k] + shift[k]
            x = x.relu()
        torch.testing.assert_close(both[k], (x @ critic.head[k] + critic.head_bias[k])[:, 0])


def test_log_probabilities_are_those_of_a_squashed_gaussian():
    sac = learner()
    torch.manual_seed(3)
    observation = torch.randn(6, 3)
    action, log_prob = sac.sample_action(observation)
    mean, std = sac.actor(observation)
    from torch.distributions import Normal, TransformedDistribution
    from torch.distributions.transforms import TanhTransform

    distribution = TransformedDistribution(Normal(mean, std), TanhTransform(cache_size=0))
    torch.testing.assert_close(
        log_prob, distribution.log_prob(action.clamp(-0.999999, 0.999999)).sum(1), rtol=1e-3, atol=1e-3
    )


def test_the_critic_update_moves_critics_alone_and_the_actor_update_the_actor_alone():
    sac = learner(actor_every=2)
    before = {name: value.clone() for name, value in sac.actor.state_dict().items()}
    critic = sac.critic.head.clone()
    sac.update(batch_of())
    assert all(torch.equal(value, before[name]) for name, value in sac.actor.state_dict().items())
    assert not torch.equal(sac.critic.head, critic)
    sac.update(batch_of())
    assert not torch.equal(sac.actor.mean.weight, before["mean.weight"])


def test_the_target_follows_by_its_decay():
    sac = learner(target_decay=0.9)
    before = sac.target.head.clone()
    sac.update(batch_of())
    torch.testing.assert_close(sac.target.head, 0.9 * before + 0.1 * sac.critic.head)


def test_a_terminal_transition_does_not_look_ahead():
    sac, batch = learner(), batch_of()
    batch["terminated"][:] = 1
    first = sac.critic_loss(*[batch[k] for k in ("observation", "action", "reward", "terminated", "next_observation")])
    batch["next_observation"] += 100
    second = sac.critic_loss(*[batch[k] for k in ("observation", "action", "reward", "terminated", "next_observation")])
    torch.testing.assert_close(first, second)


def test_the_critics_fit_a_known_value():
    sac, batch = learner(learning_rate=3e-3), batch_of()
    batch["terminated"][:] = 1  # so the value of an action is its scaled reward
    for _ in range(600):
        sac.update(batch)
    values = sac.critic(sac.actor.normalize(batch["observation"]), batch["action"]).mean(0)
    assert (values - 0.5 * batch["reward"]).abs().mean() < 0.05


def test_running_statistics_are_those_of_all_values():
    rng, norm, seen = np.random.default_rng(0), RunningNorm(3), []
    for count in (1, 7, 100, 30):
        seen.append(rng.normal(5, 2, (count, 3)))
        norm.update(seen[-1])
    values = np.concatenate(seen)
    np.testing.assert_allclose(norm.mean, values.mean(0), rtol=1e-4)
    np.testing.assert_allclose(norm.std, values.std(0), rtol=1e-3)


def test_the_buffer_keeps_the_latest():
    buffer = ReplayBuffer(10, 1, 1)
    for start in range(0, 16, 4):
        value = np.arange(start, start + 4, dtype=float)
        buffer.add(
            observation=value[:, None],
            next_observation=value[:, None] + 1,
            action=value[:, None],
            reward=value,
            terminated=value,
        )
    assert len(buffer) == 10 and set(buffer.arrays["reward"]) == set(range(6, 16))
    sample = buffer.sample(np.random.default_rng(0), 50)
    torch.testing.assert_close(sample["next_observation"], sample["observation"] + 1)


def test_a_resumed_run_ends_where_an_uninterrupted_one_does_in_steps_and_files(tmp_path):
    open_run(tmp_path / "whole", config(), False).train()
    open_run(tmp_path / "parts", config(steps=80), False).train()
    run = open_run(tmp_path / "parts", config(), True)
    run.train()
    assert run.step == 160
    names = [sorted(path.name for path in (tmp_path / f / "checkpoints").iterdir()) for f in ("whole", "parts")]
    assert names[0] == names[1] == ["0000000080.safetensors", "0000000160.safetensors"]
    first, second = (load_policy(tmp_path / f / "checkpoints" / names[0][0]) for f in ("whole", "parts"))
    for name, value in first.weights.items():  # the part before the interruption is the same to the bit
        torch.testing.assert_close(value, second.weights[name], rtol=0, atol=0)


def test_a_learner_continues_from_its_state_with_the_same_bits():
    first, batch = learner(), batch_of()
    for _ in range(5):
        first.update(batch)
    state = {k: (dict(v) if isinstance(v, dict) else v) for k, v in first.state().items()}
    import copy

    second = learner()
    second.load_state(copy.deepcopy(state))
    first.update(batch)
    torch.set_rng_state(state["torch_rng"])
    second.update(batch)
    torch.testing.assert_close(first.critic.head, second.critic.head, rtol=0, atol=0)


@pytest.mark.slow
def test_a_killed_run_resumes(tmp_path):
    settings = [
        f"--set={name}={value}".replace("True", "true").replace("False", "false") for name, value in TINY.items()
    ]
    command = [sys.executable, "-m", "dmcvb_gen", "train-behaviour", "cheetah-run", "--out", str(tmp_path / "run")]
    command += ["--steps", "4000", "--evaluate-every", "80", *settings]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.time() + 120
    while len(list((tmp_path / "run").glob("checkpoints/*"))) < 3 and time.time() < deadline:
        time.sleep(0.05)
    process.kill()
    process.wait()
    reached = len(list((tmp_path / "run").glob("checkpoints/*")))
    assert reached >= 3
    run = open_run(tmp_path / "run", Run_config(tmp_path / "run", steps=400), True)
    run.train()
    assert run.step == 400
    with (tmp_path / "run" / "progress.csv").open() as file:
        assert int(list(csv.DictReader(file))[-1]["step"]) == 400


def Run_config(folder, **changes):
    import json

    return RunConfig(**json.loads((folder / "run.json").read_text()) | changes)


def test_a_run_folder_is_not_mixed_up(tmp_path):
    open_run(tmp_path / "run", config(), False)
    with pytest.raises(DmcvbError, match="--resume"):
        open_run(tmp_path / "run", config(), False)
    with pytest.raises(DmcvbError, match="with seed 0, asked for 1"):
        open_run(tmp_path / "run", config(seed=1), True)
    with pytest.raises(DmcvbError, match="with task 'cheetah-run', asked for 'walker-walk'"):
        open_run(tmp_path / "run", config(task="walker-walk"), True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "x").touch()
    with pytest.raises(DmcvbError, match="holds no run"):
        open_run(tmp_path / "other", config(), True)


def test_a_failed_save_leaves_the_previous_one_whole(tmp_path, monkeypatch):
    open_run(tmp_path / "run", config(steps=80), False).train()
    state = (tmp_path / "run" / "resume" / "state.pt").read_bytes()

    def full(value, path):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(DmcvbError, match="previous checkpoint is whole"):
        open_run(tmp_path / "run", config(), True).train()
    assert (tmp_path / "run" / "resume" / "state.pt").read_bytes() == state
    assert not list((tmp_path / "run" / "resume").glob("*.partial"))


def test_standing_states_stand():
    task = get_task("humanoid-walk")
    batch = task.batch(3)
    state = batch.set_physics(standing_states(task, np.random.default_rng(0), 3))
    assert (state[:, task.state_slices["head_height"]] > 1.4).all()


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["walker-fly"], "walker-walk"),
        (["walker-walk", "--algo", "dreamer"], "sac"),
        (["walker-walk", "--set", "speed=3"], "learning_rate"),
        (["walker-walk", "--set", "speed"], "key=value"),
        (["walker-walk", "--steps", "0"], "x>=1"),
        (["walker-walk", "--config", "/nowhere.yaml"], "nowhere"),
    ],
)
def test_bad_commands_say_what_is_wrong(tmp_path, arguments, words):
    result = CliRunner().invoke(main, ["train-behaviour", *arguments, "--out", str(tmp_path / "run")])
    assert result.exit_code == 2 and words in result.output and not (tmp_path / "run").exists()


def test_the_class_and_the_config_name_the_same_run(tmp_path):
    assert Run(tmp_path, config()).header.command.startswith(
        "dmcvb-gen train-behaviour cheetah-run --algo sac --steps 160"
    )
