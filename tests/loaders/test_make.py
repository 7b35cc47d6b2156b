"""One call for data and the environment that matches them; scores between random actions and the data's expert."""

import numpy as np
import pytest

import dmcvb_gen
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.generate.info import describe_release
from tests.conftest import TINY_MAZE

NAMES = ["walker-walk/expert/dynamic_medium", f"{TINY_MAZE}/random/visible", "walker-walk/random-expert/none"]
SHORT = dict(size=16, max_steps=6, progress=False)


@pytest.mark.slow_cases(f"{TINY_MAZE}/random/visible")
@pytest.mark.parametrize("name", NAMES)
def test_one_call_gives_data_and_their_environment_and_makes_them_once(name, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    env, train, val = dmcvb_gen.make(name, episodes=5, environment={"stack": 2}, **SHORT)
    levels = 2 if "-expert/" in name else 1
    assert (len(train), len(val)) == (4 * levels, levels) and not {*train.episodes} & {*val.episodes}
    batch = next(iter(train.batches(4, stack=2)))
    observation, _ = env.reset(seed=0)
    for key in ("pixels", "state"):
        assert (observation[key].shape, observation[key].dtype) == (batch[key].shape[1:], batch[key].dtype)
    assert env.unwrapped._stage.split == "val" and env.unwrapped._stage.max_steps == 6
    [folder] = (tmp_path / "dmcvb-gen/made").iterdir()
    digest = Release.open(folder).digest
    again = dmcvb_gen.make(name, episodes=5, **SHORT)
    most = dmcvb_gen.make(name.removesuffix("_medium"), episodes=5, release=folder, held_out=0.95)
    assert (len(most.train), len(most.val)) == (levels, 4 * levels)
    assert [*again.train.episodes] == [*train.episodes] and Release.open(folder).digest == digest
    for asked, count in ((22, 22), (None, 20)):
        grown = dmcvb_gen.make(name, episodes=asked, **SHORT)
        assert len(grown.train) + len(grown.val) == count * levels and len(list(folder.parent.iterdir())) == 1
    same = dmcvb_gen.make(name.removesuffix("_medium"), episodes=5, release=folder)
    assert np.array_equal(same.val.read("state"), val.read("state")) and len(same.train) == len(train)


def test_a_policy_is_scored_as_its_data_are_and_normalized_by_them(levels):
    folder, (random, expert) = levels
    release, task = dmcvb_gen.open(folder), expert.split("/")[0]

    def still(observation):
        assert observation.get("pixels", np.zeros((1, 1, 16, 16))).shape[2:] == (16, 16)
        return np.zeros((len(observation["state"]), release[expert].array("action").shape[-1]))

    score = release[expert].evaluate(still, split="train", episodes=2)
    given = dict(split="train", episodes=2, size=16, renderer="native", max_steps=6)
    by_name = dmcvb_gen.evaluate(still, f"{task}/{expert.split('/')[2]}", **given)
    assert score.returns == by_name.returns and by_name.normalized is None
    low, high = (Release.open(folder)[name].read("return").mean() for name in (random, expert))
    assert score.normalized == pytest.approx(100 * (score.mean - low) / (high - low))
    for other in ({"max_steps": 3}, {"action_repeat": 4}):
        assert release[expert].evaluate(still, episodes=1, pixels=False, **other).normalized is None
    assert release[expert].evaluate(still, episodes=1, pixels=False, action_repeat=4).limit == 3  # the data's time
    assert release[expert].environment(action_repeat=1).unwrapped._stage.max_steps == 12
    told = {subset["name"]: subset["normalized"] for subset in describe_release(folder)["subsets"]}
    assert (told[random], told[expert]) == pytest.approx((0, 100))


def test_what_cannot_be_made_or_scored_is_refused_in_a_line(levels, small_mazes):
    folder, (random, _) = levels
    fixed = dmcvb_gen.open(small_mazes)["ant-maze-tiny/random/fixed"]
    assert fixed.environment(distractor="visible").unwrapped._stage.pairs is None
    for call, words in (
        (lambda: dmcvb_gen.make("walker-walk"), "'walker-walk' names no subset; give TASK/LEVEL/SETTING"),
        (lambda: dmcvb_gen.make(random, levels="expert"), "make\\(\\) decides levels by the name"),
        (lambda: dmcvb_gen.make(random, release=folder, episodes=100), "has . of 100 episodes; give fewer"),
        (lambda: dmcvb_gen.make(random, release=folder, size=32), "size has no effect: with a release"),
        (lambda: dmcvb_gen.make(random, release=folder, episodes=1), "episodes is 1: input should be greater"),
        (lambda: dmcvb_gen.make(random, release=folder, held_out=1.5), "held_out is 1.5"),
        (lambda: fixed.evaluate(print), "has fixed goals here; score policies on them by `validate --benchmark b3`"),
    ):
        with pytest.raises(DmcvbError, match=words):
            call()
