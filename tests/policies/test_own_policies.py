"""Policies from elsewhere: functions of one's own, Stable-Baselines3 zips, torch state dicts; walker and a maze."""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
import zipfile
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import FilterObservation
from sb3_contrib import CrossQ, RecurrentPPO
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.generate import engine
from dmcvb_gen.own_code import BEHAVIOURS, allow, find_function
from dmcvb_gen.own_code import TASKS as TASKS_VARIABLE
from dmcvb_gen.policies.bundled import level_files, resolve_policies
from dmcvb_gen.policies.convert import convert
from dmcvb_gen.policies.own import own_policy
from dmcvb_gen.policies.policy_file import load_policy, save_policy
from dmcvb_gen.policies.simulate import simulate
from dmcvb_gen.release.card import write_card
from dmcvb_gen.spec import is_maze
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training.vec_env import TaskVecEnv
from tests.conftest import TINY_MAZE, invoke, run, told

WALKER = "walker-walk"
TASKS = [WALKER, TINY_MAZE]
TINY = ["--level", "expert", "--episodes", "2", "--max-steps", "4", "--size", "16"]
CODE = """
import numpy as np

def noisy(observations, generator):
    drawn = generator.normal(size=(len(observations), {actions}))
    return np.tanh(observations[:, :1] + drawn)

def narrow(observations, generator):
    return np.zeros((len(observations), 2))

def broken(observations, generator):
    raise KeyError("no such thing")

calls, TURN = [], 10**9

def count(observations):
    calls.append(len(observations))
    return len(calls)

def counting(observations, generator):
    return np.full((len(observations), {actions}), np.sin(count(observations)))

def held(observations, generator):
    return np.full((len(observations), {actions}), count(observations) // 16 % 2)

def turning(observations, generator):
    return np.full((len(observations), {actions}), float(count(observations) > TURN))

def unseeded(observations, generator):
    return np.random.default_rng().uniform(size=(len(observations), {actions}))

def seeded(observations, generator):
    return np.random.default_rng(0).uniform(size=(len(observations), {actions}))

def centered(observations, generator):
    return np.tanh(np.zeros({actions}) + (observations - observations.mean(axis=0))[:, :1])
"""


def refused(*arguments):
    """The one line that a command is refused with."""
    result = invoke(*arguments)
    assert result.exit_code and isinstance(result.exception, SystemExit | None), result.exception
    [line] = [line for line in result.output.splitlines() if line.lower().startswith("error")]
    return line


@pytest.fixture(params=TASKS, ids=["walker", "maze"])
def task(request):
    return get_task(request.param)


class Space(gymnasium.Env):
    """The spaces of a task's behaviour, of fields with a size if they are given; all that SB3 needs to make a model."""

    def __init__(self, task, low=-1.0, high=1.0, fields=None):
        sizes = fields or {"all": task.behaviour_size}
        boxes = {name: gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32) for name, size in sizes.items()}
        self.observation_space = gymnasium.spaces.Dict(boxes) if fields else boxes["all"]
        self.action_space = gymnasium.spaces.Box(low, high, (task.action_size,), np.float32)


def model(algorithm, space, **arguments):
    kind = "MultiInputPolicy" if isinstance(space.observation_space, gymnasium.spaces.Dict) else "MlpPolicy"
    kind = "MlpLstmPolicy" if algorithm is RecurrentPPO else kind
    return algorithm(kind, space, seed=0, device="cpu", **arguments)


def goes_the_whole_way(task, behaviour, folder):
    """Roll out, verify and regenerate with a behaviour: the release."""
    run("rollout", task.id, *TINY, "--behaviour", behaviour, "--out", folder)
    assert told("verify", folder)["sound"]
    assert "same digest" in run("regenerate", folder, "--check")
    return Release.open(folder)


# -- functions ------------------------------------------------------------------------------------


@pytest.fixture
def code(task, tmp_path, monkeypatch):
    """Name of a module with behaviours for the task; the environment variable is put back afterwards."""
    name = f"own_{hashlib.sha256(str(tmp_path).encode()).hexdigest()[:8]}"
    (tmp_path / f"{name}.py").write_text(CODE.format(actions=task.action_size))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(BEHAVIOURS, "")
    return name


@pytest.mark.slow_cases("maze")
def test_data_of_a_function_are_verified_regenerated_and_marked(task, code, tmp_path, monkeypatch):
    """Its noise comes from each episode's own stream, so shards of one episode hold the same."""
    release = goes_the_whole_way(task, f"{code}:noisy", tmp_path / "r")
    [subset] = release.subsets.values()
    [policy] = subset.record.policies
    source = (tmp_path / f"{code}.py").read_bytes()
    assert policy.header["training"]["source_sha256"] == hashlib.sha256(source).hexdigest() and policy.path is None
    assert policy.header["training"]["note"] == "not regenerable without that code"
    alone = [*TINY, "--episodes-per-shard", 1, "--behaviour", f"{code}:noisy", "--out", tmp_path / "alone"]
    run("rollout", task.id, *alone)
    [other] = Release.open(tmp_path / "alone").subsets.values()
    np.testing.assert_array_equal(other.read("action"), subset.read("action"))
    write_card(tmp_path / "r")
    card = (tmp_path / "r" / "README.md").read_text()
    assert (
        f"`{code}:noisy`" in card
        and policy.header["training"]["source_sha256"] in card
        and "not regenerable without that code" in card
    )
    engine._policies.cache_clear()  # as in a new process
    monkeypatch.setenv(BEHAVIOURS, "")  # and on somebody else's machine: a manifest lets no code run
    assert BEHAVIOURS in refused("regenerate", tmp_path / "r", "--check")
    assert told("verify", tmp_path / "r")["sound"]


@pytest.mark.slow_cases("maze")
def test_a_function_of_ones_own_is_named_beside_its_returns(task, code):
    shown = run("evaluate-behaviour", task.id, "--behaviour", f"{code}:noisy", "--episodes", 2)
    assert f"{code}:noisy" in shown and "mean actions" not in shown


def test_names_that_may_run_are_listed_as_people_list_them(code, monkeypatch):
    monkeypatch.setenv(BEHAVIOURS, f" other:f, {code}:noisy,, ")
    assert callable(find_function(f"{code}:noisy", BEHAVIOURS, "behaviour"))
    allow([f"{code}:narrow"], BEHAVIOURS)
    assert os.environ[BEHAVIOURS] == f"other:f,{code}:noisy,{code}:narrow"
    with pytest.raises(DmcvbError, match="code of your own; to let it run"):
        find_function("", BEHAVIOURS, "behaviour")


@pytest.mark.slow_cases("maze")
def test_other_code_of_the_same_name_is_refused(code, task, tmp_path, monkeypatch):
    run("rollout", task.id, *TINY, "--behaviour", f"{code}:noisy", "--out", tmp_path / "r")
    (tmp_path / f"{code}.py").write_text(CODE.format(actions=task.action_size) + "\n# changed\n")
    engine._policies.cache_clear()
    assert "old code still runs; restart Python" in refused("regenerate", tmp_path / "r", "--check")
    again = ["--behaviour", f"{code}:noisy", "--out", tmp_path / "again"]
    assert "old code still runs; restart Python" in refused("rollout", task.id, *TINY, *again)
    assert not (tmp_path / "again").exists()
    sys.modules.pop(code)  # as in a new process
    assert "is not the policy that the release names" in refused("regenerate", tmp_path / "r", "--check")
    run("rollout", task.id, *TINY, *again)


@pytest.mark.parametrize("place", ["task", "behaviour"])
def test_code_that_cannot_be_imported_is_told_in_one_line(place, tmp_path, monkeypatch):
    name = f"bad_{place}"
    (tmp_path / f"{name}.py").write_text("def f(o, g)\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(BEHAVIOURS, "")
    monkeypatch.setenv(TASKS_VARIABLE, "")
    asked = [f"{name}:f"] if place == "task" else [WALKER, "--level", "expert", "--behaviour", f"{name}:f"]
    assert f"{place} {name}:f cannot be imported (SyntaxError" in refused("rollout", *asked, "--out", tmp_path / "r")


@pytest.mark.parametrize(
    "function, words",
    [
        ("narrow", "of shape (2, 2)"),
        ("broken", "failed (KeyError: 'no such thing')"),
        ("missing", "cannot find behaviour"),
        *[(name, "gave other actions for the same") for name in ("counting", "held", "unseeded", "seeded", "centered")],
    ],
)
def test_functions_that_give_no_actions_are_refused_in_one_line(task, code, tmp_path, function, words):
    line = refused("rollout", task.id, *TINY, "--behaviour", f"{code}:{function}", "--out", tmp_path / "r")
    assert words in line
    assert (tmp_path / "r").exists() == (function == "held")  # which changes in a later call


def test_a_function_that_turns_in_its_last_call_is_refused_before_its_shard_is_written(task, code):
    allow([f"{code}:turning"], BEHAVIOURS)
    policy, module = own_policy(f"{code}:turning", task), sys.modules[code]
    module.TURN = len(module.calls) + 12  # of 4 steps, the 3 probes before the first, second and fourth
    with pytest.raises(DmcvbError, match="turning gave other actions for the same observation"):
        simulate(task, [policy], [0, 1], 0, ("a", "b"), max_steps=4)
    assert len(module.calls) > module.TURN


# -- Stable-Baselines3 ----------------------------------------------------------------------------

SB3 = {
    "sac": (SAC, {"policy_kwargs": {"net_arch": [8, 8]}, "buffer_size": 10}),
    "crossq": (CrossQ, {"policy_kwargs": {"net_arch": {"pi": [8, 8], "qf": [4]}}, "buffer_size": 10}),
    "td3": (TD3, {"policy_kwargs": {"net_arch": [8], "activation_fn": nn.ELU}, "buffer_size": 10}),
    "ppo": (PPO, {"policy_kwargs": {"net_arch": {"pi": [8, 8], "vf": [4]}}, "n_steps": 8, "batch_size": 8}),
}


@pytest.mark.parametrize("named", [False, True], ids=["vector", "fields"])
@pytest.mark.parametrize("task_id", [WALKER, TINY_MAZE, "quadruped-walk"])
@pytest.mark.parametrize("name", SB3)
def test_an_sb3_policy_acts_as_sb3_does(task_id, name, named, tmp_path):
    """A Dict's parts reach SB3's networks in the order of their names; quadruped's bounds are not -1 to 1."""
    task, (algorithm, arguments) = get_task(task_id), SB3[name]
    if named and (is_maze(task_id) or algorithm is CrossQ):  # CrossQ takes no Dict
        return
    seen = np.random.default_rng(0).normal(size=(50, task.behaviour_size)).astype(np.float32)
    parts = {field: seen[:, part] for field, part in task.state_slices.items()} if named else seen
    fields = {field: part.shape[1] for field, part in parts.items()} if named else None
    made = model(algorithm, Space(task, task.action_low, task.action_high, fields), **arguments)
    for parameter in made.policy.parameters():
        parameter.data *= 100 if name == "ppo" else 4  # so that some actions are at the bounds
    for buffer_name, buffer in made.policy.named_buffers():
        if buffer_name.endswith(("ra_mean", "ra_var")):  # of CrossQ's BatchRenorm
            buffer.uniform_(0.5, 2)
    made.save(tmp_path / "model.zip")
    statistics, given = None, parts
    if named:
        mean = {field: np.linspace(index, 3, part.shape[1]) for index, (field, part) in enumerate(parts.items())}
        order, statistics = list(made.observation_space.spaces), tmp_path / "seen.npz"
        joined = np.concatenate([mean[field] for field in order])
        np.savez(statistics, mean=joined, std=1 + joined)
        given = {field: ((part - mean[field]) / (1 + mean[field])).astype(np.float32) for field, part in parts.items()}
    save_policy(tmp_path / "p.safetensors", *convert(tmp_path / "model.zip", task.id, statistics=statistics))
    theirs, _ = made.predict(given, deterministic=True)
    ours = task.from_unit(load_policy(tmp_path / "p.safetensors").act(seen, None, True))
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
    if task_id == "quadruped-walk" and not named:
        assert (theirs.max(0) > 1.05).any() or (theirs.min(0) < -0.85).any()


class Doubled(FlattenExtractor):
    def forward(self, observations):
        return 2 * super().forward(observations)


@pytest.mark.parametrize(
    ("algorithm", "kwargs", "space", "words"),
    [
        (SAC, {}, {"low": 0.0}, "acts from [0.0, 0.0"),
        (PPO, {"n_steps": 8, "batch_size": 8}, {"low": -2.0, "high": 2.0}, "acts from [-2.0, -2.0"),
        (SAC, {"policy_kwargs": {"features_extractor_class": Doubled}}, {}, "a features extractor (Doubled)"),
        (PPO, {"n_steps": 8, "batch_size": 8, "use_sde": True}, {}, "use_sde"),
        (RecurrentPPO, {"n_steps": 8, "batch_size": 8}, {}, "a recurrent part (LSTM)"),
        (SAC, {}, {"fields": {"a": 12, "b": 12}}, "observes {'a': 12, 'b': 12}, walker-walk shows {'orientations': 14"),
        (SAC, {}, {}, "--activation has no effect: "),
    ],
)
def test_what_is_not_a_plain_mlp_on_the_tasks_own_spaces_is_refused_and_named(
    algorithm, kwargs, space, words, tmp_path
):
    made = model(algorithm, Space(get_task(WALKER), **space), **kwargs)
    made.save(tmp_path / "model.zip")
    options = ["--activation", "tanh"] if "activation" in words else []
    assert words in refused("convert-policy", tmp_path / "model.zip", WALKER, *options, "--out", tmp_path / "p")
    assert not (tmp_path / "p").exists()


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_zips_of_trained_models_are_taken_and_normalized_ones_need_their_statistics(algorithm, tmp_path):
    env = TaskVecEnv(get_task(WALKER), 2)
    env = VecNormalize(env, clip_obs=2.0) if algorithm is PPO else env
    short = {"n_steps": 8, "batch_size": 8} if algorithm is PPO else {"learning_starts": 8}
    made = algorithm("MlpPolicy", env, seed=0, device="cpu", **short).learn(32)
    made.save(tmp_path / "model_0.1M")  # SB3 adds no .zip to a name with a dot
    words = ["convert-policy", tmp_path / "model_0.1M", WALKER, "--out", tmp_path / "policy.safetensors"]
    if algorithm is PPO:
        assert "VecNormalize, whose numbers are not in it; run `dmcvb-gen convert-policy" in refused(*words)
        seen = env.obs_rms
        np.savez(tmp_path / "seen.npz", mean=seen.mean, std=np.sqrt(seen.var + env.epsilon), clip=2.0)
        words += ["--statistics", tmp_path / "seen.npz"]
    run(*words)
    observation = np.random.default_rng(0).normal(0, 3, (100, 24)).astype(np.float32)
    wanted, _ = made.predict(env.normalize_obs(observation) if algorithm is PPO else observation, deterministic=True)
    acted = load_policy(tmp_path / "policy.safetensors").act(observation, deterministic=True)
    np.testing.assert_allclose(acted, wanted, atol=2e-5)


@pytest.mark.parametrize("task_id, setting", [("cartpole-swingup", "none"), ("ant-maze-empty7x7", "visible")])
def test_policies_of_our_own_environments_states_are_taken_if_behaviours_see_the_same(task_id, setting, tmp_path):
    env = FilterObservation(gymnasium.make(f"dmcvb_gen/{task_id}-{setting}-v0"), ["state"])
    made = SAC("MultiInputPolicy", env, seed=0, device="cpu", policy_kwargs={"net_arch": [8]})
    made.save(tmp_path / "model.zip")
    words = ["convert-policy", tmp_path / "model.zip", task_id, "--out", tmp_path / "policy.safetensors"]
    if setting == "visible":
        assert "train it on proprioception and true goal vectors, as train-behaviour --algo" in refused(*words)
        return
    run(*words)
    observation = np.random.default_rng(0).normal(size=(50, 5)).astype(np.float32)
    wanted, _ = made.predict({"state": observation}, deterministic=True)
    acted = load_policy(tmp_path / "policy.safetensors").act(observation, deterministic=True)
    np.testing.assert_allclose(acted, wanted, atol=2e-5)


@pytest.mark.slow_cases("maze")
def test_data_of_an_sb3_zip_regenerate_bit_for_bit(task, tmp_path):
    model(SAC, Space(task), **SB3["sac"][1]).save(tmp_path / "model.zip")
    release = goes_the_whole_way(task, tmp_path / "model.zip", tmp_path / "r")
    [policy] = next(iter(release.subsets.values())).record.policies
    assert policy.header["algorithm"] == "sb3" and (tmp_path / "r" / policy.path).is_file()
    (tmp_path / "model.zip").unlink()  # the release has its own copy of the weights
    assert "same digest" in run("regenerate", tmp_path / "r", "--check")


class Evil:
    def __reduce__(self):
        return os.mkdir, ("/tmp/dmcvb-gen-evil-pickle",)


@pytest.mark.parametrize("kind", ["zip", "pt", "text"])
def test_nothing_is_unpickled(kind, tmp_path):
    path = tmp_path / ("evil.pt" if kind == "pt" else "evil.zip")
    if kind == "zip":
        torch.save({"a": Evil()}, tmp_path / "policy.pth")
        with zipfile.ZipFile(path, "w") as archive:
            archive.write(tmp_path / "policy.pth", "policy.pth")
            archive.writestr("data", "{}")
    else:
        path.write_bytes(pickle.dumps({"a": Evil()}) if kind == "pt" else b"no zip")
    with pytest.raises(DmcvbError, match="without running code"):
        convert(path, WALKER)
    assert not os.path.exists("/tmp/dmcvb-gen-evil-pickle")


# -- state dicts ----------------------------------------------------------------------------------


def mlp(*sizes):
    layers = [layer for fan in zip(sizes, sizes[1:], strict=False) for layer in (nn.Linear(*fan), nn.Tanh())]
    return nn.Sequential(*layers[:-1])


class CleanRlSac(nn.Module):
    """Names and shapes of the actor in CleanRL's sac_continuous_action.py; its mean action."""

    def __init__(self, observations, actions):
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(observations, 8), nn.Linear(8, 8)
        self.fc_mean, self.fc_logstd = nn.Linear(8, actions), nn.Linear(8, actions)
        self.register_buffer("action_scale", torch.ones(1, actions))
        self.register_buffer("action_bias", torch.zeros(1, actions))

    def forward(self, x):
        return torch.tanh(self.fc_mean(torch.relu(self.fc2(torch.relu(self.fc1(x))))))


class CleanRlPpo(nn.Module):
    """Names and shapes of the agent in CleanRL's ppo_continuous_action.py; its mean action, clipped."""

    def __init__(self, observations, actions):
        super().__init__()
        self.critic, self.actor_mean = mlp(observations, 8, 8, 1), mlp(observations, 8, 8, actions)
        self.actor_logstd = nn.Parameter(torch.zeros(1, actions))

    def forward(self, x):
        return self.actor_mean(x).clip(-1, 1)


@pytest.mark.parametrize(
    ("kind", "name", "wrapper"),
    [
        (CleanRlPpo, "actor.pt", ""),
        (CleanRlSac, "actor.pth", "module."),
        (CleanRlSac, "sac.cleanrl_model", "_orig_mod."),
    ],
)
def test_a_cleanrl_state_dict_acts_as_cleanrl_does(task, kind, name, wrapper, tmp_path):
    """What torch puts before names is left out, and CleanRL's own ending holds actor and critics."""
    torch.manual_seed(0)
    actor = kind(task.behaviour_size, task.action_size)
    state = {f"{wrapper}{parameter}": value for parameter, value in actor.state_dict().items()}
    torch.save((state, {}, {}) if name.endswith("cleanrl_model") else state, tmp_path / name)
    np.savez(tmp_path / "seen.npz", mean=np.full(task.behaviour_size, 0.5), std=np.full(task.behaviour_size, 2.0))
    options = ["--statistics", tmp_path / "seen.npz", "--out", tmp_path / "p.safetensors"]
    run("convert-policy", tmp_path / name, task.id, *options)
    seen = np.random.default_rng(0).normal(size=(5, task.behaviour_size)).astype(np.float32)
    with torch.no_grad():
        theirs = actor((torch.from_numpy(seen) - 0.5) / 2).numpy()
    np.testing.assert_allclose(load_policy(tmp_path / "p.safetensors").act(seen, None, True), theirs, atol=1e-5)


def test_cleanrls_ppo_needs_the_statistics_that_it_normalized_with(tmp_path):
    torch.save(CleanRlPpo(24, 6).state_dict(), tmp_path / "actor.pt")
    with pytest.raises(DmcvbError, match=r"behind CleanRL's NormalizeObservation.*--statistics FILE"):
        convert(tmp_path / "actor.pt", WALKER)


def test_a_file_that_was_written_anew_is_read_anew(task, tmp_path):
    path, releases = tmp_path / "actor.pt", []
    for seed in range(2):
        torch.manual_seed(seed)
        torch.save(CleanRlSac(task.behaviour_size, task.action_size).state_dict(), path)
        run("rollout", task.id, *TINY, "--behaviour", path, "--out", tmp_path / str(seed))
        releases.append(next(iter(Release.open(tmp_path / str(seed)).subsets.values())))
        [policy] = releases[-1].record.policies
        assert policy.header["training"]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert np.abs(releases[0].read("action") - releases[1].read("action")).max() > 0.01


SIZES = (24, 8, 6)
NO_STATISTICS = 'has no "mean" and "std" of 24 observations'


def statistics(path, third=1.0):
    """A file of means and of standard deviations, of which one may be wrong."""
    np.savez(path, mean=np.zeros(24), std=[1.0, 1.0, third, *[1.0] * 21])


@pytest.fixture
def plain(tmp_path):
    """The arguments that convert a state dict of a plain network for walker-walk, which has been converted once."""
    torch.manual_seed(0)
    torch.save(mlp(*SIZES).state_dict(), tmp_path / "plain.pt")
    statistics(tmp_path / "seen.npz")
    words = ["convert-policy", tmp_path / "plain.pt", WALKER, "--activation", "tanh", "--actions", "tanh"]
    words += ["--statistics", tmp_path / "seen.npz"]
    run(*words, "--out", tmp_path / "p.safetensors")
    return words


def damaged(name, value):
    state = mlp(*SIZES).state_dict()
    state[name].view(-1)[0] = value
    return state


STATES = [
    (mlp(24, 8, 5).state_dict(), "layers of 24 x 8 x 5, walker-walk asks for 24 x 8 x 6"),
    ({"conv.weight": torch.zeros(3, 3, 3, 3)}, "none of the actors that are known"),
    (damaged("2.bias", float("nan")), "not finite float32; take an earlier checkpoint"),
    (damaged("0.weight", float("inf")), "not finite float32; take an earlier checkpoint"),
    (mlp(*SIZES).state_dict() | {"2.weight": torch.zeros(6, 9)}, "has shape (6, 9), its neighboring layers"),
    (mlp(24, *[2] * 17, 6).state_dict(), "hidden: Tuple should have at most 16 items"),
    (CleanRlPpo(24, 6).state_dict(), "--actions has no effect"),
    ([torch.zeros(3)], "holds no state dict"),
]
WRONG = [("plain.pt", partial(torch.save, state), words) for state, words in STATES]
WRONG += [("seen.npz", partial(statistics, third=x), "observation_std") for x in (0.0, -1.0, np.nan, 1e-60, 1e60)]
WRONG += [
    ("plain.pt", Path.unlink, "cannot read"),
    ("seen.npz", Path.unlink, NO_STATISTICS),
    ("seen.npz", lambda path: path.write_bytes(b""), NO_STATISTICS),
    ("seen.npz", lambda path: path.write_bytes(path.read_bytes()[:200]), NO_STATISTICS),
    ("seen.npz", lambda path: np.lib.format.write_array(path.open("wb"), np.ones(24)), NO_STATISTICS),
]


@pytest.mark.parametrize(("name", "spoil", "words"), WRONG)
def test_files_that_make_no_policy_are_refused_and_change_no_file(plain, name, spoil, words, tmp_path):
    good = (tmp_path / "p.safetensors").read_bytes()
    spoil(tmp_path / name)
    assert words in refused(*plain, "--out", tmp_path / "p.safetensors")
    assert (tmp_path / "p.safetensors").read_bytes() == good


def test_a_plain_network_says_neither_activation_nor_actions(plain, tmp_path):
    path = plain[1].rename(tmp_path / "a b.pt")
    refusal = refused("rollout", WALKER, *TINY, "--behaviour", path, "--out", tmp_path / "r")
    assert f"run `dmcvb-gen convert-policy '{path}' {WALKER} --out NEW.safetensors --activation" in refusal


def test_a_policy_without_noise_is_not_sampled(plain, tmp_path):
    plain[plain.index("--actions") + 1] = "clip"
    run(*plain, "--out", tmp_path / "clip.safetensors")
    for name, *command in (("p", "rollout", "--out", tmp_path / "r"), ("clip", "evaluate-behaviour")):
        words = ["--sample", "--behaviour", tmp_path / f"{name}.safetensors"]
        assert "has no noise to sample; remove it" in refused(*command, WALKER, *words)


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ("plain.pt/x.safetensors", "choose a place that you may write to"),
        ("folder.safetensors", "cannot write to"),
        ("plain.pt", "for another program's file; end its name in .safetensors"),
    ],
)
def test_places_that_no_policy_can_be_written_to_are_one_line(plain, out, words, tmp_path):
    (tmp_path / "folder.safetensors").mkdir()
    assert words in refused(*plain, "--out", tmp_path / out)


# -- files of levels ------------------------------------------------------------------------------


def test_mixed_policies_are_the_numbered_files_alone(tmp_path):
    for name in ("mixed_10", "mixed_2", "mixed_final", "mixed_2b", "mixed_"):
        (tmp_path / f"{name}.safetensors").write_bytes(b"")
    assert [path.stem for path in level_files(tmp_path, "mixed")] == ["mixed_2", "mixed_10"]


def test_one_checkpoint_of_a_run_is_named_by_its_step(tmp_path, caplog):
    run, odd = tmp_path / "run", tmp_path / "x@latest"
    for folder, steps in ((run, (600, 1200)), (odd, (300,))):
        (folder / "checkpoints").mkdir(parents=True)
        for step in steps:
            (folder / "checkpoints" / f"{step:010d}.safetensors").write_bytes(b"")
    for name, step in (("latest", 1200), ("600", 600)):
        [path] = resolve_policies(WALKER, "expert", f"{run}@{name}")
        assert path == run / "checkpoints" / f"{step:010d}.safetensors"
    assert caplog.messages == [f"{run}@latest is the checkpoint of agent step 1,200."]
    for name in ("700", "first", ""):
        with pytest.raises(DmcvbError, match=rf"no checkpoint '{name}'; give latest, or an agent step .*\[600, 1200\]"):
            resolve_policies(WALKER, "expert", f"{run}@{name}")
    with pytest.raises(DmcvbError, match=r"run `dmcvb-gen select-checkpoints .*` first, or give one .*x@latest@latest"):
        resolve_policies(WALKER, "expert", odd)
    with pytest.raises(DmcvbError, match="neither a policy file, a run folder nor"):
        resolve_policies(WALKER, "expert", f"{tmp_path / 'nowhere'}@latest")
    (run / "checkpoints" / "0000000600.safetensors").unlink()
    (run / "checkpoints" / "0000001200.safetensors").unlink()
    with pytest.raises(DmcvbError, match="has no checkpoint yet"):
        resolve_policies(WALKER, "expert", f"{run}@latest")
