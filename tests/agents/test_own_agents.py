"""Policies of one's own, scored by `dmcvb_gen.evaluate`; wrong actions are one line."""

import numpy as np
import pytest
import torch
from dm_control import suite

import dmcvb_gen
from dmcvb_gen.agents.learners import Learner
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.tasks import get_task


@pytest.mark.parametrize("where, channels", [("walker-walk/dynamic", 9), ("ant-maze-empty7x7/hidden", 27)])
def test_a_policy_sees_stacks_and_states_of_all_episodes_at_once(where, channels):
    task, seen = get_task(where.split("/")[0]), []

    def policy(observation):
        seen.append(observation)
        return np.full((2, task.action_size), 0.1)

    score = dmcvb_gen.evaluate(policy, where, episodes=2, max_steps=3, size=16, seed=4)
    assert len(seen) == 3 and score.limit == 3 and len(score.returns) == 2
    assert seen[0]["pixels"].shape == (2, channels, 16, 16) and seen[0]["pixels"].dtype == np.uint8
    assert seen[0]["state"].shape == (2, task.state_size) and seen[0]["state"].dtype == np.float32
    (first, second, third), frame = (each["pixels"] for each in seen), channels // 3
    np.testing.assert_array_equal(first, np.tile(first[:, :frame], (1, 3, 1, 1)))  # an episode's first one is repeated
    np.testing.assert_array_equal(third[:, : 2 * frame], second[:, frame:])
    assert (third[:, 2 * frame :] != second[:, 2 * frame :]).any()  # the newest one is the last
    assert score.pictures.shape == (3, 16, 16, 3) and score.pictures.std() > 5
    assert score.mean == pytest.approx(np.mean(score.returns))
    again = dmcvb_gen.evaluate(policy, where, episodes=2, max_steps=3, seed=4, pixels=False)
    assert again.returns == score.returns and set(seen[-1]) == {"state"}


@pytest.mark.parametrize("where", ["walker-walk/dynamic", "ant-maze-empty7x7/visible"])
def test_the_split_changes_what_is_seen_and_nothing_else(where):
    seen = []

    def policy(observation):
        seen.append(observation)
        return np.zeros((2, get_task(where.split("/")[0]).action_size))

    for split in ({"split": "val"}, {"split": "train"}, {}):
        dmcvb_gen.evaluate(policy, where, episodes=2, max_steps=1, size=16, **split)
    unseen, known, usual = seen
    np.testing.assert_array_equal(known["state"], unseen["state"])
    assert (known["pixels"] != unseen["pixels"]).any()
    np.testing.assert_array_equal(usual["pixels"], unseen["pixels"])


@pytest.mark.parametrize("actions, told", [
    (np.zeros((2, 5)), r"step 0: .*shape \(2, 5\); expected \(2, 6\)"),
    (np.full((2, 6), np.nan), r"step 0: .*is nan; expected numbers"),
    (np.full((2, 6), 1.5), r"step 0: .*is 1\.5; expected \[-1, 1\]"),
    ("none", r"step 0: .*no array of actions"),
])  # fmt: skip
def test_wrong_actions_are_one_line_with_the_step_and_what_was_expected(actions, told):
    with pytest.raises(DmcvbError, match=told) as error:
        dmcvb_gen.evaluate(lambda observation: actions, "walker-walk/none", episodes=2, max_steps=2, pixels=False)
    assert len(str(error.value).splitlines()) == 1


def test_actions_lie_in_a_tasks_own_bounds():
    """dm_control's quadruped takes -1, -1, -0.8 to 1, 1.1, 0.8 at each leg."""
    spec, options = suite.load("quadruped", "walk").action_spec(), dict(episodes=2, max_steps=2, pixels=False)
    for action in (spec.minimum, spec.maximum):
        dmcvb_gen.evaluate(lambda _, action=action: np.stack([action] * 2), "quadruped-walk/none", **options)
    with pytest.raises(DmcvbError, match=r"is 1.01; expected \[-1, 1\], clip it"):
        dmcvb_gen.evaluate(lambda _: np.stack([spec.maximum + 0.01] * 2), "quadruped-walk/none", **options)


def test_losses_that_cannot_be_minimized_are_told_of_the_agent():
    class Own(Learner):
        def losses(self, batch):
            return {"error": self.weight.sum()}

    own = Own()
    own.weight = torch.nn.Parameter(torch.ones(1))
    with pytest.raises(DmcvbError, match="^Own.losses gives .'error'.; call the one to minimize 'loss'"):
        own.update(None)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_torch_policy_need_not_detach_its_actions(dtype):
    weights = torch.full((2, 6), 0.5, dtype=dtype, requires_grad=True)
    options = dict(episodes=2, max_steps=2, pixels=False)
    score = dmcvb_gen.evaluate(lambda observation: weights * 1, "walker-walk/none", **options)
    same = dmcvb_gen.evaluate(lambda observation: np.full((2, 6), 0.5), "walker-walk/none", **options)
    assert score.returns == same.returns


@pytest.mark.parametrize("where, told", [
    ("walker-walk", "TASK/SETTING"), ("walker-wlk/none", "walker-walk"), ("walker-walk/dynamc", "dynamic"),
    ("ant-maze-empty7x7/fixed", "b3"),
])  # fmt: skip
def test_a_place_that_cannot_be_evaluated_is_refused_with_what_can(where, told):
    with pytest.raises(DmcvbError, match=told):
        dmcvb_gen.evaluate(lambda observation: None, where, pixels=False)


@pytest.mark.parametrize("option", [dict(max_steps=0), dict(episodes=2.5), dict(seed=-1), dict(split="trian")])
def test_options_that_mean_nothing_are_refused(option):
    with pytest.raises(DmcvbError, match=f"{next(iter(option))} is .*: input should be"):
        dmcvb_gen.evaluate(lambda observation: None, "walker-walk/none", pixels=False, **option)


@pytest.mark.parametrize("option", [dict(stack=2), dict(size=32), dict(renderer="native"), dict(backgrounds="clips")])
def test_image_options_are_refused_without_images(option):
    with pytest.raises(DmcvbError, match=f"{next(iter(option))} has no effect: the policy sees no pictures; remove it"):
        dmcvb_gen.evaluate(lambda observation: None, "walker-walk/dynamic", pixels=False, **option)
    with pytest.raises(DmcvbError, match="walker-walk/dynamic_camera0.2 shows no videos, so backgrounds"):
        dmcvb_gen.evaluate(lambda observation: None, "walker-walk/dynamic_camera0.2", backgrounds="builtin")
