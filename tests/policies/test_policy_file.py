"""Policy files: round trips, and everything that is refused."""

from __future__ import annotations

import json
import tracemalloc

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from dmcvb_gen import arithmetic
from dmcvb_gen.errors import PolicyFileError
from dmcvb_gen.generate.plan import make_plan
from dmcvb_gen.generate.recipe import make_recipe
from dmcvb_gen.policies.actor import Policy, RandomPolicy
from dmcvb_gen.policies.bundled import bundled_policies
from dmcvb_gen.policies.header import Evaluation, PolicyHeader, weight_shapes
from dmcvb_gen.policies.policy_file import load_policy, read_header, save_policy
from dmcvb_gen.policies.simulate import simulate
from dmcvb_gen.seeding import episode_stream
from dmcvb_gen.tasks import get_task
from dmcvb_gen.training.networks import Actor, as_arrays
from tests.conftest import python


def header_of(task_id="walker-walk", **changes):
    task = get_task(task_id)
    fields = dict(
        task=task_id,
        observation_size=task.behaviour_size,
        action_size=task.action_size,
        algorithm="sac",
        agent_step=1000,
        hidden=(16, 16),
        evaluation=Evaluation(mean=1.0, std=0.5, episodes=3, mode="sampled", seed=0),
    )
    return PolicyHeader(**fields | changes)


@pytest.fixture
def policy_path(tmp_path):
    torch.manual_seed(0)
    header = header_of()
    actor = Actor(header)
    actor.observation_mean += 0.5
    actor.observation_std *= 2.0
    save_policy(tmp_path / "policy.safetensors", header, as_arrays(actor.state_dict()))
    return tmp_path / "policy.safetensors"


def observations(count=5):
    return np.random.default_rng(0).normal(size=(count, 24)).astype(np.float32)


def test_a_policy_comes_back_as_it_was_saved(policy_path):
    first, second = load_policy(policy_path, get_task("walker-walk")), load_policy(policy_path)
    assert first.header == header_of() == read_header(policy_path) and first.digest == second.digest
    np.testing.assert_array_equal(*(policy.act(observations(), deterministic=True) for policy in (first, second)))


def test_actions_are_the_networks_by_hand(policy_path):
    weights = {name: value.numpy() for name, value in load_file(policy_path).items()}
    x = ((observations() - 0.5) / 2.0).clip(-10, 10)
    for layer in (0, 2):
        x = np.maximum(x @ weights[f"body.{layer}.weight"].T + weights[f"body.{layer}.bias"], 0)
    mean = x @ weights["mean.weight"].T + weights["mean.bias"]
    std = np.exp((x @ weights["log_std.weight"].T + weights["log_std.bias"]).clip(-20, 2))
    policy = load_policy(policy_path)
    np.testing.assert_allclose(policy.act(observations(), deterministic=True), np.tanh(mean), atol=1e-6)
    rngs = [np.random.default_rng(i) for i in range(5)]
    noise = np.stack([arithmetic.normal(np.random.default_rng(i), (6,)) for i in range(5)])
    np.testing.assert_allclose(policy.act(observations(), rngs), np.tanh(mean + std * noise), atol=1e-6)


@pytest.mark.parametrize("distribution", ["squashed_gaussian", "gaussian", "deterministic"])
@pytest.mark.parametrize("activation", ["relu", "tanh", "elu", "gelu"])
def test_every_kind_of_actor_acts_as_torchs_does(tmp_path, distribution, activation):
    header = header_of(distribution=distribution, noise=0.1, activation=activation, hidden=(17, 9))
    torch.manual_seed(1)
    actor = Actor(header)
    assert weight_shapes(header) == {name: tuple(value.shape) for name, value in actor.state_dict().items()}
    save_policy(tmp_path / "p", header, as_arrays(actor.state_dict()))
    policy, seen = load_policy(tmp_path / "p"), 3 * observations(7)
    with torch.no_grad():
        mean, std = actor(torch.from_numpy(seen))
    for ours, theirs in zip(policy.distribution(seen), (mean, std), strict=True):
        np.testing.assert_allclose(ours, theirs.numpy(), rtol=1e-5, atol=2e-6)
    squashed = mean.clamp(-1, 1) if distribution == "gaussian" else torch.tanh(mean)
    np.testing.assert_allclose(policy.act(seen, deterministic=True), squashed.numpy(), atol=2e-6)
    sampled = policy.act(100 * seen, [np.random.default_rng(i) for i in range(7)])
    assert sampled.dtype == np.float32 and np.abs(sampled).max() <= 1
    assert (sampled != policy.act(100 * seen, deterministic=True)).any()


def test_sums_are_added_up_from_the_first_input_to_the_last():
    """Oracle: the same sum, one addition at a time."""
    rng, header = np.random.default_rng(0), header_of(hidden=(), distribution="gaussian")
    weights = {name: rng.normal(size=shape).astype(np.float32) for name, shape in weight_shapes(header).items()}
    weights |= {"observation_mean": np.zeros(24, np.float32), "observation_std": np.ones(24, np.float32)}
    seen = observations(9)
    expected = np.tile(weights["mean.bias"], (9, 1))
    for i in range(24):
        expected = expected + seen[:, i : i + 1] * weights["mean.weight"][:, i]
    assert expected.dtype == np.float32
    np.testing.assert_array_equal(Policy(header, weights, "").distribution(seen)[0], expected)


@pytest.mark.parametrize("deterministic", [True, False])
def test_an_action_depends_on_nothing_but_its_own_row(policy_path, deterministic):
    policy, seen = load_policy(policy_path), observations(41)

    def act(rows):
        return policy.act(seen[rows], [np.random.default_rng(row) for row in rows], deterministic)

    whole = act(list(range(41)))
    for rows in ([3], [40, 17], list(range(5, 23)), [9, 8, 7, 6, 5, 4, 3]):
        np.testing.assert_array_equal(act(rows), whole[rows])


def test_random_actions_are_uniform_from_each_stream():
    policy = RandomPolicy(get_task("humanoid-walk"))
    streams = [[np.random.default_rng(seed) for seed in (i, 99)] for i in range(400)]
    draws = np.concatenate([policy.act(np.zeros((2, 67)), pair, True) for pair in streams])
    assert np.abs(draws).max() <= 1 and draws[::2].std() == pytest.approx(1 / np.sqrt(3), rel=0.02)
    np.testing.assert_array_equal(draws[1], draws[3])


def tamper(path, out, change):
    """Write a policy file again with something changed."""
    weights = load_file(path)
    header = json.loads(header_of().model_dump_json())
    change(weights, header)
    save_file(weights, out, metadata={"header": json.dumps(header)})
    return out


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda w, h: w["mean.weight"].__setitem__((0, 0), float("nan")), "not finite"),
        (lambda w, h: w["observation_std"].zero_(), "observation_std"),
        (lambda w, h: w.pop("mean.bias"), "mean.bias"),
        (lambda w, h: w.update(extra=torch.zeros(2)), "extra"),
        (lambda w, h: w.update({"mean.bias": torch.zeros(7)}), "mean.bias"),
        (lambda w, h: w.update({"mean.bias": torch.zeros(6, dtype=torch.float64)}), "mean.bias"),
        (lambda w, h: h.update(hidden=[8, 8]), "shape"),
        (lambda w, h: h.update(hidden=[65_536] * 16) or w.pop("body.0.bias"), "has shape None"),
        (lambda w, h: h.update(hidden=[2**40]), "hidden"),
        (lambda w, h: h.update(hidden=[1] * 100_000), "hidden"),
        (lambda w, h: h.update(observation_size=2**50), "observation_size"),
        (lambda w, h: h.update(action_size=7), "train it again"),
        (lambda w, h: h.update(task="cheetah-run"), "not for walker-walk"),
        (lambda w, h: h.update(format_version=99), "newer dmcvb-gen"),
        (lambda w, h: h.update(code="import os"), "not a whole policy file"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(policy_path, tmp_path, change, words):
    """At once, without the memory of what it asks for."""
    path, task = tamper(policy_path, tmp_path / "changed.safetensors", change), get_task("walker-walk")
    tracemalloc.start()
    with pytest.raises(PolicyFileError, match=words):
        load_policy(path, task)
    assert tracemalloc.get_traced_memory()[1] < 4 * 2**20
    tracemalloc.stop()


def test_policies_act_without_torch():
    code = "import sys; sys.modules['torch'] = sys.modules['stable_baselines3'] = None\n"
    code += "from dmcvb_gen.policies import actor, bundled, evaluation, paper, policy_file, simulate\n"
    code += "from dmcvb_gen.tasks import get_task; task = get_task('walker-walk')\n"
    code += "policy = policy_file.load_policy(bundled.bundled_policies(task.id, 'expert')[0], task)\n"
    code += "print(simulate.simulate(task, [policy], [0], 0, ('t',), max_steps=2).action[0, 0])"
    assert python(code).stdout.startswith("[")


@pytest.mark.parametrize("keep", [0, 4, 40, 0.5, 0.999])
def test_a_truncated_file_is_refused(policy_path, keep):
    data = policy_path.read_bytes()
    policy_path.write_bytes(data[: int(keep * len(data)) if isinstance(keep, float) else keep])
    with pytest.raises(PolicyFileError, match="not a whole policy file"):
        load_policy(policy_path)


# -- mean actions by default, drawn ones on request -------------------------------------------------


def test_recipes_take_mean_actions_unless_told_to_draw_and_manifests_say_so(tmp_path):
    def planned(**fields):
        subset = dict(tasks="walker-walk", levels=["expert", "random"], settings="none", episodes=1) | fields
        recipe = make_recipe({"name": "actions", "subsets": [subset]})
        return [record.deterministic for record in make_plan(recipe, tmp_path / "r").release.manifest.subsets]

    assert planned() == [True, False]
    assert planned(deterministic=False) == [False, False]


@pytest.mark.parametrize("task_id", ["walker-walk", "ant-maze-empty7x7"])
def test_mean_actions_are_taken_by_default_and_drawn_ones_scatter_around_them(task_id):
    task = get_task(task_id)
    policy = load_policy(bundled_policies(task_id, "expert")[0], task)
    mean, drawn, again = (
        simulate(task, [policy], range(3), 0, (task_id,), max_steps=3, deterministic=deterministic)
        for deterministic in (True, False, False)
    )
    default = simulate(task, [policy], range(3), 0, (task_id,), max_steps=3)
    assert (default.action == mean.action).all() and (drawn.action == again.action).all()
    first = mean.action[:, 0]
    batch = task.batch(3)
    batch.reset([episode_stream(0, (task_id,), i, "initial_state") for i in range(3)])
    assert (policy.act(batch.behaviour_observation(), deterministic=True) == first).all()
    assert 0.01 < abs(drawn.action[:, 0] - first).mean() < 1
