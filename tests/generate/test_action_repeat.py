"""Action repeats 1 and 4: whole releases and environments beside those at 2."""

from __future__ import annotations

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.generate.recipe import Recipe, expand, load_recipe, override
from dmcvb_gen.loaders.envs import DistractedEnv
from dmcvb_gen.policies.actor import Policy
from dmcvb_gen.policies.bundled import bundled_policies
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.policies.simulate import simulate
from dmcvb_gen.release.verify import verify
from dmcvb_gen.tasks import get_task
from tests.conftest import TINY_MAZE, invoke

NAME = "walker-walk/expert/dynamic"
STEPS = {1: 12, 2: 6, 4: 3}
"""Action repeat -> agent steps of an episode of 12 control steps."""


def rollout(out, repeat, *words, code=0):
    words = ["--action-repeat", repeat, "--max-steps", STEPS[repeat], "--episodes", 2, "--size", 16, *words]
    result = invoke("rollout", *words, "--out", out, "--workers", 1, code=code)
    return Release.open(out) if not code else result.output


@pytest.fixture(scope="module")
def walkers(tmp_path_factory):
    """Action repeat -> release of the same episodes of walker's expert, 12 control steps long."""
    folder = tmp_path_factory.mktemp("repeats")
    return {repeat: rollout(folder / str(repeat), repeat, "walker-walk", "--distractor", "dynamic") for repeat in STEPS}


def test_a_policy_that_was_trained_at_2_acts_at_2(walkers):
    """At repeat 1 it plays the very episodes of repeat 2: every second frame, its distractors too, is the same."""
    one, two, four = (walkers[repeat][NAME] for repeat in STEPS)
    for name in ("state", "physics", "pixels", "exogenous/camera_position", "exogenous/background_frame"):
        np.testing.assert_array_equal(one.read(name)[:, ::2], two.read(name))
    action = one.read("action")[:, :-1]
    np.testing.assert_array_equal(action[:, ::2], action[:, 1::2])
    np.testing.assert_allclose(one.read("return"), two.read("return"), rtol=1e-5)
    np.testing.assert_array_equal(four.read("action")[:, 0], two.read("action")[:, 0])
    assert (four.read("physics")[:, 1] != two.read("physics")[:, 2]).any()  # it held its first action for longer


@pytest.mark.parametrize("facts, held", [
    ({}, 2),
    ({"action_repeat": 1}, 1),
    ({"action_repeat": 4}, 4),
    ({"training": {"converted_from": "their.zip"}}, 1),  # the repeat of its training is unknown
])  # fmt: skip
def test_the_header_says_for_how_many_control_steps_a_policy_acts(facts, held):
    task, bundled = get_task("walker-walk").at(1), load_policy(bundled_policies("walker-walk", "expert")[0])
    policy = Policy(bundled.header.model_copy(update=facts), bundled.weights, "x")
    action = simulate(task, [policy], [0], 0, ("a",), max_steps=8).action[0, :-1]
    changes = [step for step in range(1, 8) if (action[step] != action[step - 1]).any()]
    assert changes == [step for step in range(1, 8) if step % held == 0]


@pytest.mark.parametrize("repeat", STEPS)
def test_the_manifest_and_job_keys_say_it_and_verify_repeats_it(walkers, repeat):
    release = walkers[repeat]
    [record] = release.manifest.subsets
    assert record.action_repeat == repeat and record.seconds_per_step == pytest.approx(0.025 * repeat)
    assert release[NAME].trajectories.makes["action_repeat"] == repeat
    assert not verify(release.path).findings
    refused = rollout(release.path, 3 - repeat if repeat < 4 else 2, "walker-walk", "--distractor", "dynamic", code=2)
    assert "action_repeat" in refused and "--out" in refused and refused.count("\n") == 1
    kept = Recipe.model_validate(release.recipes[0].recipe)
    assert kept.action_repeat == repeat and ("action_repeat" in release.recipes[0].recipe) == (repeat != 2)


@pytest.mark.parametrize("task, setting", [("walker-walk", "dynamic"), (TINY_MAZE, "visible")])
def test_environments_step_at_the_repeat_of_the_data(task, setting):
    """Two steps at 1 are one at 2: the same frames, and the same rewards in all."""
    one, two = (DistractedEnv(task, setting, size=16, action_repeat=repeat) for repeat in (1, 2))
    for env in (one, two):
        env.reset(seed=3)
    action = np.full(one.action_space.shape, 0.3, np.float32)
    for _ in range(3):
        (_, first, *_), (seen, second, *_) = one.step(action), one.step(action)
        wanted, reward, *_ = two.step(action)
        np.testing.assert_array_equal(seen["pixels"], wanted["pixels"])
        np.testing.assert_array_equal(seen["state"], wanted["state"])
        assert first + second == pytest.approx(reward, abs=1e-9)
    assert one.metadata["render_fps"] == 2 * two.metadata["render_fps"]
    assert one.task.evaluation_steps == 2 * two.task.evaluation_steps


def test_time_limits_last_as_long_at_every_repeat():
    limits = {"walker-walk": 1000, "humanoid-walk": 1000, "ant-maze-empty7x7": 1200}
    for repeat in STEPS:
        requests = expand(override(load_recipe("dmcvb-v1"), action_repeat=repeat))
        found = {request.task: request.max_steps for request in requests}
        assert {task: found[task] * repeat for task in limits} == limits
