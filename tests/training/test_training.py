"""The trainer: correct updates, runs that resume, folders that are not mixed up."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from dmcvb_gen.cli import main
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.policies.bundled import bundled_policies
from dmcvb_gen.policies.header import PolicyHeader
from dmcvb_gen.policies.policy_file import save_policy
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training import run as runs
from dmcvb_gen.training.behaviour import run_config
from dmcvb_gen.training.episodes import standing_states
from dmcvb_gen.training.mpo import Mpo
from dmcvb_gen.training.networks import WaypointNetwork, as_arrays
from dmcvb_gen.training.run import Run, RunConfig, check_same, open_run
from dmcvb_gen.training.sac import SUPPORT, CriticEnsemble, ReplayBuffer, ReturnScale, RunningNorm, Sac, Settings
from dmcvb_gen.training.settings import default_run, parse_settings

torch.set_num_threads(1)
TINY = dict(warmup_steps=64, batch_size=16, actor_hidden=[16], critic_hidden=[16], compile=False, simulations=4)
TINY |= dict(train_episode_steps=20, bfloat16=False)


def config(**changes):
    fields = dict(task="cheetah-run", algorithm="sac", steps=160, seed=0, settings=TINY, evaluate_every=80)
    return RunConfig(**fields | changes)


def learner(**changes):
    header = PolicyHeader(task="x", observation_size=3, action_size=2, algorithm="sac", agent_step=0, hidden=(8, 8))
    plain = dict(bins=0, reward_scale=0.5, soft_values=True, clipped=True, rate_half_life=0, n_step=1)
    settings = Settings(**plain | dict(compile=False, critic_hidden=(8, 8), initial_temperature=0.1) | changes)
    return Sac(header, settings, 0)


def learner_of(folder, asked):
    run = Run(folder, asked)
    return Sac(run.header, run.settings, asked.seed)


def batch_of(count=64):
    rng = np.random.default_rng(0)
    values = dict(
        observation=rng.normal(size=(count, 3)),
        next_observation=rng.normal(size=(count, 3)),
        action=rng.uniform(-1, 1, (count, 2)),
        reward=rng.random(count),
        discount=0.99 * (rng.random(count) > 0.2),
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


@pytest.mark.parametrize("bins", [0, 51])
def test_a_terminal_transition_does_not_look_ahead(bins):
    sac, batch = learner(bins=bins), batch_of()
    batch["discount"][:] = 0
    names = ("observation", "action", "reward", "discount", "next_observation")
    first = sac.critic_loss(*[batch[name] for name in names])
    batch["next_observation"] += 100
    second = sac.critic_loss(*[batch[name] for name in names])
    torch.testing.assert_close(first, second)


@pytest.mark.slow_cases("51")
@pytest.mark.parametrize("bins", [0, 51])
def test_the_critics_fit_a_known_value(bins):
    sac, batch = learner(learning_rate=3e-3, bins=bins), batch_of()
    batch["discount"][:] = 0  # so the value of an action is its scaled reward
    for _ in range(600):
        sac.update(batch)
    values = sac.critic(sac.actor.normalize(batch["observation"]), batch["action"]).mean(0)
    assert (values - 0.5 * batch["reward"]).abs().mean() < 0.05


@given(target=st.floats(-20, 20), bins=st.integers(11, 201))
def test_a_distribution_over_bins_that_fits_a_target_has_its_mean(target, bins):
    critic = CriticEnsemble(3, 2, (8,), False, bins=bins)
    logits = torch.zeros(2, 1, bins, requires_grad=True)
    critic.outputs = lambda observation, action: logits
    wanted = torch.tensor([target])
    (gradient,) = torch.autograd.grad(critic.loss(None, None, wanted), logits)
    # The gradient of a cross-entropy is (softmax - wanted); softmax of zeros is uniform.
    distribution = 1 / bins - gradient
    width = 2 * SUPPORT / bins
    within = float(np.clip(target, -SUPPORT + width, SUPPORT - width))
    assert distribution.min() >= -1e-6 and distribution.sum(-1).numpy() == pytest.approx(1, abs=1e-4)
    assert (distribution * critic.centers).sum(-1)[0].item() == pytest.approx(within, abs=0.5 * width)


def test_learning_rates_fall_with_the_root_of_the_steps():
    sac = learner(rate_half_life=1000, learning_rate=1e-3)
    for step, rate in ((0, 1e-3), (1000, 1e-3 / 2**0.5), (8000, 1e-3 / 3)):
        sac.schedule(step)
        groups = [optimizer.param_groups[0]["lr"] for optimizer in (sac.actor_optimizer, sac.critic_optimizer)]
        assert groups == pytest.approx([rate, rate])


def test_rewards_are_scaled_by_the_spread_of_discounted_returns():
    rng, scale = np.random.default_rng(0), ReturnScale(2, 0.9)
    seen, running = [], np.zeros(2)
    for step in range(300):
        reward, ended = rng.gamma(0.1, 3, 2), np.array([step % 50 == 49, step % 70 == 69])
        running = 0.9 * running + reward
        seen.append(running.copy())
        running[ended] = 0
        scale.update(reward, ended)
    seen = np.concatenate(seen)
    assert 1 / float(scale) == pytest.approx(max(seen.std(), seen.max() / 5), rel=1e-3)
    again = ReturnScale(2, 0.9)
    again.load_state(scale.state())
    for each in (scale, again):
        each.update(np.array([90.0, 0.0]), np.array([False, False]))
    assert float(again) == float(scale) and 1 / float(scale) >= 18


@given(st.data())
def test_steps_that_follow_are_summed_as_far_as_an_episode_goes_on(data):
    """Against a loop over what each simulation lived through, in a ring that may have wrapped."""
    simulations, steps = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 4))
    rounds, size = data.draw(st.integers(1, 12)), data.draw(st.integers(6, 20))
    rng, buffer = np.random.default_rng(0), ReplayBuffer(size, 1, 1, simulations)
    lived = [[] for _ in range(simulations)]
    for moment in range(rounds):
        number = (moment * simulations + np.arange(simulations, dtype=float))[:, None]
        reward, terminated = rng.random(simulations), rng.random(simulations) < 0.2
        ended = terminated | (rng.random(simulations) < 0.2)
        rows = dict(observation=number, next_observation=number + 0.5, action=number)
        buffer.add(**rows, reward=reward, terminated=terminated, ended=ended)
        for k in range(simulations):
            lived[k].append((reward[k], terminated[k], ended[k]))
    batch = {name: value.numpy() for name, value in buffer.sample_steps(rng, 30, steps, 0.9).items()}
    for i in range(30):
        moment, k = divmod(int(batch["observation"][i, 0]), simulations)
        total, factor = 0.0, 1.0
        for at in range(moment, min(moment + steps, rounds)):
            reward, terminated, ended = lived[k][at]
            total, factor = total + factor * reward, factor * 0.9
            if ended:
                break
        assert batch["reward"][i] == pytest.approx(total, rel=1e-5)
        assert batch["discount"][i] == pytest.approx(factor * (1 - terminated), rel=1e-5)
        assert batch["next_observation"][i, 0] == at * simulations + k + 0.5


@pytest.mark.slow
def test_an_annealed_policy_is_paid_less_for_its_entropy():
    entropies, temperatures = [], []
    for anneal_after in (0, 10):
        settings = dict(target_entropy_scale=-0.5, final_entropy_scale=4.0, learning_rate=3e-3)
        sac, batch = learner(anneal_after=anneal_after, **settings), batch_of()
        for step in range(600):
            sac.schedule(step)
            assert sac.target_entropy == (-8.0 if anneal_after and step >= anneal_after else 1.0)  # two actions
            sac.update(batch)
        entropies.append(sac.metrics()["entropy"])
        temperatures.append(sac.metrics()["temperature"])
    assert temperatures[1] < 0.7 * temperatures[0] and entropies[1] < entropies[0]


def test_an_annealed_learner_takes_smaller_steps():
    sac = learner(anneal_after=10, final_learning_rate=1e-5)
    sac.schedule(9)
    assert sac.critic_optimizer.param_groups[0]["lr"] > 1e-4
    sac.schedule(10)
    optimizers = (sac.actor_optimizer, sac.critic_optimizer, sac.alpha_optimizer)
    assert [optimizer.param_groups[0]["lr"] for optimizer in optimizers] == [1e-5] * 3
    before = sac.critic.head.clone()
    sac.update(batch_of())
    assert 0 < (sac.critic.head - before).abs().max() < 1.1e-5  # Adam's first step is the learning rate


def test_the_final_rate_stands_in_for_the_falling_one():
    sac = learner(anneal_after=10, final_learning_rate=1e-5, rate_half_life=1000)
    sac.schedule(9)
    assert 9e-4 < sac.actor_optimizer.param_groups[0]["lr"] < sac.settings.learning_rate
    sac.schedule(100)
    optimizers = (sac.actor_optimizer, sac.critic_optimizer, sac.alpha_optimizer)
    assert [optimizer.param_groups[0]["lr"] for optimizer in optimizers] == [1e-5] * 3


def test_running_statistics_are_those_of_all_values():
    rng, norm, seen = np.random.default_rng(0), RunningNorm(3), []
    for count in (1, 7, 100, 30):
        seen.append(rng.normal(5, 2, (count, 3)))
        norm.update(seen[-1])
    values = np.concatenate(seen)
    np.testing.assert_allclose(norm.mean, values.mean(0), rtol=1e-4)
    np.testing.assert_allclose(norm.std, values.std(0), rtol=1e-3)


def test_the_buffer_keeps_the_latest():
    buffer = ReplayBuffer(10, 1, 1, 4)
    for start in range(0, 16, 4):
        value = np.arange(start, start + 4, dtype=float)
        buffer.add(
            observation=value[:, None],
            next_observation=value[:, None] + 1,
            action=value[:, None],
            reward=value,
            terminated=value,
            ended=value,
        )
    assert len(buffer) == 10 and set(buffer.arrays["reward"]) == set(range(6, 16))
    sample = buffer.sample(np.random.default_rng(0), 50)
    torch.testing.assert_close(sample["next_observation"], sample["observation"] + 1)


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


def test_multipliers_of_any_size_begin_as_they_were_set(tmp_path):
    starts = dict(initial_temperature=1e-3, initial_multiplier_mean=1.0, initial_multiplier_std=1000.0)
    run = RunConfig(task="cheetah-run", algorithm="mpo", steps=96, seed=0, settings=starts | dict(compile=False))
    made = Run(tmp_path, run)
    duals = Mpo(made.header, made.settings, 0).duals
    np.testing.assert_allclose(torch.nn.functional.softplus(duals).detach().numpy(), list(starts.values()), rtol=1e-3)


def test_standing_states_stand():
    task = get_task("humanoid-walk")
    batch = task.batch(3)
    state = batch.set_physics(standing_states(task, np.random.default_rng(0), 3))
    assert (state[:, task.state_slices["head_height"]] > 1.4).all()


POLICY = str(bundled_policies("walker-walk", "expert")[0])


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["walker-fly"], "walker-walk"),
        (["walker-walk", "--algo", "dreamer"], "Known: guided, mpo, sac, sb3:PPO, sb3:SAC, sb3:TD3."),
        (["walker-walk", "--set", "learning_rat=3"], "Did you mean 'learning_rate'?"),
        (["walker-walk", "--algo", "sb3:PPO", "--set", "buffer_size=3"], "clip_range"),
        (["walker-walk", "--algo", "sb3:PPPO"], "Did you mean 'PPO'?"),
        (["walker-walk", "--set", "foo=1"], "clipped and 25 more; --list-settings lists them all."),
        (["walker-walk", "--set", "speed"], "key=value"),
        (["walker-walk", "--set", "discount=1.5"], "setting discount of sac is 1.5: input should be less than 1"),
        (["walker-walk", "--set", "actor_hidden=wide"], "the default is (256, 256)"),
        (
            ["walker-walk", "--algo", "sb3:DQN", "--steps", "80"],
            "sb3:DQN does not accept this: The algorithm only supports",
        ),
        (["walker-walk", "--algo", "sb3:RecurrentPPO", "--steps", "80"], "does not accept this"),
        (["walker-walk", "--algo", "sb3:CrossQ", "--steps", "80"], "which is no part of a plain MLP"),
        (["walker-walk", "--algo", "sb3:SAC", "--init-from", POLICY], "--init-from has no effect"),
        (
            ["walker-walk", "--set", "critic_hidden=[]"],
            "setting critic_hidden of sac is []: tuple should have",
        ),
        (["walker-walk", "--set", "actor_hidden=[100000]"], "less than or equal to 65536"),
        (["ant-maze-easy7x7a", "--algo", "guided", "--set", "layers=17"], "setting layers of guided is 17"),
        (["walker-walk", "--steps", "0"], "x>=1"),
        (["walker-walk", "--steps", "100"], "all warm-up (5000 steps)"),
        (["walker-walk", "--steps", "4000", "--init-from", POLICY], "or less warm-up: --set warmup_steps=N"),
        (["walker-walk", "--steps", "5080", "--set", "updates_per_step=0.01"], "come to 0.88 updates"),
        (["walker-walk", "--steps", "5001", "--set", "simulations=1", "--set", "actor_every=9"], "changes after 9"),
        (["ant-maze-easy7x7a", "--algo", "guided", "--steps", "9", "--set", "simulations=3"], "come to 0.54 updates"),
        (["walker-walk", "--config", "/nowhere.yaml"], "nowhere"),
        (["walker-walk", "--set", "buffer_size=4000"], "buffer_size 4000 holds fewer steps than warmup_steps 5000"),
    ],
)
def test_bad_commands_say_what_is_wrong(tmp_path, arguments, words):
    result = CliRunner().invoke(main, ["train-behaviour", *arguments, "--out", str(tmp_path / "run")])
    assert result.exit_code == 2 and words in result.output and not (tmp_path / "run").exists()
    assert len(result.output.strip().splitlines()) == 1 or "Usage" in result.output


def test_settings_come_from_a_file_and_the_command_wins(tmp_path):
    (tmp_path / "s.yaml").write_text("learning_rate: 1e-4\nbatch_size: 32\nactor_hidden: [8, 8]\n")
    settings = parse_settings(("batch_size=64",), tmp_path / "s.yaml", "sac")
    assert settings == {"learning_rate": 1e-4, "batch_size": 64, "actor_hidden": [8, 8]}
    (tmp_path / "s.yaml").write_text("- 3\n")
    with pytest.raises(DmcvbError, match="learning_rate: 0.0003"):
        parse_settings((), tmp_path / "s.yaml", "sac")


def test_a_resumed_run_keeps_what_is_not_given_and_refuses_what_differs():
    found = config(seed=4, settings={"batch_size": 16})
    assert run_config("cheetah-run", "sac", {}, found) == found
    longer = run_config("cheetah-run", "sac", {"discount": 0.99}, found, steps=500, seed=None)
    check_same("runs/x", found, longer)  # naming a default is no difference
    assert longer.steps == 500
    for changed in (
        run_config("cheetah-run", "sac", {}, found, seed=5),
        run_config("cheetah-run", "sac", {"discount": 0.9}, found),
        run_config("walker-walk", "sac", {}, found),
        run_config("cheetah-run", "mpo", {}, found),
    ):
        with pytest.raises(DmcvbError, match="holds a run with"):
            check_same("runs/x", found, changed)


def test_the_class_and_the_config_name_the_same_run(tmp_path):
    assert Run(tmp_path, config()).header.command.startswith(
        "dmcvb-gen train-behaviour cheetah-run --algo sac --steps 160"
    )


def test_a_policy_says_what_it_started_from_but_not_where_that_lay(tmp_path):
    source = tmp_path / "home of somebody" / "own.safetensors"
    source.parent.mkdir()
    actor = learner_of(tmp_path, config()).actor
    save_policy(source, actor.header, as_arrays(actor.state_dict()))
    first = sha256_file(source)
    run = open_run(tmp_path / "run", config(init_from=str(source)), resume=False)
    assert run.header.training["init_from"] == "own.safetensors" and "--init-from own.safetensors" in run.header.command
    assert run.header.training["init_sha256"] == first
    assert str(tmp_path) not in run.header.model_dump_json() and "home of somebody" not in run.header.model_dump_json()
    other = {name: value + 1 for name, value in as_arrays(actor.state_dict()).items()}
    save_policy(source, actor.header, other)
    with pytest.raises(DmcvbError, match="own.safetensors is no longer the file that .*run began with"):
        open_run(tmp_path / "run", config(init_from=str(source)), resume=True)
    save_policy(source, actor.header, as_arrays(actor.state_dict()))
    again = open_run(tmp_path / "run", config(init_from=str(source)), resume=True)
    assert again.header == run.header
    again.train()
    folder = open_run(tmp_path / "second", config(init_from=f"{tmp_path / 'run'}/"), resume=False).header
    assert folder.training["init_from"] == "run" and "init_sha256" not in folder.training
    assert "--init-from run " in folder.command


def test_a_policy_that_does_not_fit_begins_no_run(tmp_path):
    actor = learner_of(tmp_path, config(settings=TINY | {"actor_hidden": [24]})).actor
    save_policy(tmp_path / "wide.safetensors", actor.header, as_arrays(actor.state_dict()))
    with pytest.raises(DmcvbError, match="do not fit"):
        open_run(tmp_path / "run", config(init_from=str(tmp_path / "wide.safetensors")), resume=False)
    for change, words in (({"activation": "tanh"}, "activation tanh and that of sac relu"), ({"way": (8,)}, "has way")):
        header = actor.header.model_copy(update=change)
        arrays = as_arrays(actor.state_dict())
        if "way" in change:
            arrays |= as_arrays(WaypointNetwork((8,)).weights())
        save_policy(tmp_path / "other.safetensors", header, arrays)
        with pytest.raises(DmcvbError, match=f"{words}.*so it would act otherwise"):
            open_run(tmp_path / "run", config(init_from=str(tmp_path / "other.safetensors")), resume=False)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow_cases("ant-maze-empty7x7", "walker-walk")
@pytest.mark.parametrize("task_id", ["walker-walk", "ant-maze-empty7x7"])
def test_evaluations_keep_to_their_share_of_the_steps_however_often_they_are(tmp_path, monkeypatch, task_id):
    """Counted from outside: agent steps that evaluations were asked to simulate, for those that were trained."""
    asked, evaluate = [], runs.evaluate

    def counted(policy, task, episodes=100, **given):
        asked.append(episodes * task.max_steps)
        return evaluate(policy, task, 2, **given)

    monkeypatch.setattr(runs, "evaluate", counted)
    run = open_run(tmp_path / "run", config(task=task_id, steps=1600, evaluate_every=400), False)
    run.train()
    share = runs.EVALUATION_STEPS[run.task.family]
    assert len(asked) == 4 and all(run.task.max_steps <= steps <= share * 400 for steps in asked)
    assert sum(asked) > 0.5 * share * 1600
    defaults = default_run("walker-walk")["evaluate_every"]
    assert share * defaults / 500 > 4  # enough episodes for a curve that medium is picked from


@pytest.mark.parametrize(
    ("task", "setting", "words"),
    [
        ("walker-walk", "low_spawn_fraction", "only for ant mazes"),
        ("cheetah-run", "path_reward_scale", "only for ant mazes"),
        ("cheetah-run", "shaping", "only for humanoid-walk and ant mazes"),
        ("ant-maze-easy7x7b", "standing_starts", "only for bodies that move freely"),
        ("cartpole-swingup", "standing_starts", "only for bodies that move freely"),
        ("fish-swim", "standing_starts", "only for bodies that move freely"),
    ],
)
@pytest.mark.parametrize("algorithm", ["sac", "mpo"])
def test_a_setting_that_the_task_has_no_use_for_begins_no_run(tmp_path, task, setting, words, algorithm):
    asked = config(task=task, algorithm=algorithm, settings={setting: 0.01})
    with pytest.raises(DmcvbError, match=f"setting {setting} is {words}.* remove it"):
        open_run(tmp_path / "run", asked, False)
    assert not (tmp_path / "run").exists()


def test_what_only_mazes_have(tmp_path):
    """Ants may start sunken in the floor, walkers may not; a share of the simulations acts by the mean."""
    settings = TINY | dict(greedy_fraction=0.5, low_spawn_fraction=1.0, shaping=1.0, train_episode_steps=6)
    asked = config(task="ant-maze-easy7x7a", steps=96, evaluate_every=96, settings=settings)
    open_run(tmp_path / "run", asked, False).train()
    assert len(list((tmp_path / "run" / "checkpoints").iterdir())) == 1
    sac = learner(greedy_fraction=0.5)
    observation = np.zeros((8, 3), np.float32)
    first, second = sac.act(observation), sac.act(observation)
    np.testing.assert_array_equal(first[:4], second[:4])
    assert (first[4:] != second[4:]).all()
