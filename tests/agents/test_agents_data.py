"""Training data and the trainer: the right frames, shifts and split, and the same bits after a stop."""

import dataclasses
import errno
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from dm_control import suite

from dmcvb_gen.agents import data as agents_data
from dmcvb_gen.agents import trainer
from dmcvb_gen.agents.data import PAD, Slice, TrainingData, batches, load_data, normalize_pixels
from dmcvb_gen.agents.networks import observation_encoder, state_encoder
from dmcvb_gen.agents.paper import BehaviorCloning
from dmcvb_gen.agents.trainer import Budget, draw, hold_out_losses, train
from dmcvb_gen.dataset import steps as steps_module
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.steps import StepTable
from dmcvb_gen.errors import DmcvbError
from tests.conftest import roll_out, short_recipe

LENGTHS = np.array([4, 7, 2])
SIZE = 16


def make_data(stack=3, held=(False, True, False), size=SIZE):
    """Three short episodes of random pictures; action (row, row), reward row."""
    generator = torch.Generator().manual_seed(0)
    rows = int((LENGTHS + 1).sum())
    count = np.arange(rows, dtype=np.float32)
    state = torch.rand((rows, 5), generator=generator).numpy()
    pictures = torch.randint(0, 256, (rows, 3, size, size), generator=generator, dtype=torch.uint8).numpy()
    frames = np.pad(pictures, ((0, 0), (0, 0), (0, 0), (PAD, PAD)), mode="symmetric")
    fields = {"state": state, "action": np.stack([count, count], 1) / rows, "reward": count, "discount": count * 0 + 1}
    return TrainingData(StepTable(fields, LENGTHS, frames), np.array(held)).but(stack=stack)


def by_hand(pictures, rows, down, right):
    """A stack padded by numpy and cut out."""
    stack = np.concatenate([pictures[row] for row in rows])
    size = stack.shape[-1]
    padded = np.pad(stack, ((0, 0), (PAD, PAD), (PAD, PAD)), mode="symmetric")
    return padded[:, down : down + size, right : right + size].astype(np.float32) / 255 - 0.5


def test_a_stack_is_the_last_frames_with_the_first_one_repeated_under_one_shift():
    data = make_data()
    pictures = data.frames.table[..., PAD:-PAD].numpy()  # without the border
    stacks = {0: (0, 0, 0), 1: (0, 0, 1), 2: (0, 1, 2), 5: (5, 5, 5), 6: (5, 5, 6), 12: (10, 11, 12), 14: (13, 13, 14)}
    rows = torch.tensor(list(stacks))
    generator = np.random.default_rng(0)
    down, right = generator.integers(2 * PAD + 1, size=(2, len(rows)))
    down[0], right[0], down[1], right[1] = 0, 8, 8, 0
    seen = data.observe(rows, torch.from_numpy(np.stack([down, right]))).numpy()
    for index, stack in enumerate(stacks.values()):
        np.testing.assert_allclose(seen[index], by_hand(pictures, stack, down[index], right[index]), atol=1e-6)


def test_transitions_are_those_of_training_episodes_and_never_leave_theirs():
    data = make_data()
    batch = data.batch(400, np.random.default_rng(0), next_observation=True, k=3, sample_k=True)
    row = batch.reward.long()
    assert set(row.tolist()) == {0, 1}  # rows 0..3 are transitions; three steps on must still be the episode
    assert set(batch.k.tolist()) == {1, 2, 3}
    alone = data.batch(400, np.random.default_rng(0))
    assert set(alone.reward.long().tolist()) == {0, 1, 2, 3, 13, 14} and alone.next_observation is None
    held = data.batch(100, np.random.default_rng(0), hold_out=True)
    assert set(held.reward.long().tolist()) == set(range(5, 12))


def test_the_next_observation_is_k_steps_on_under_the_same_shift():
    data, shifts = make_data(), torch.cartesian_prod(*[torch.arange(2 * PAD + 1)] * 2).T
    batch = data.batch(64, np.random.default_rng(1), next_observation=True, k=2)
    for index, row in enumerate(batch.reward.long()):
        seen, following = (data.observe(at.expand(shifts.shape[1]), shifts) for at in (row, row + 2))
        [shift] = [at for at, one in enumerate(seen) if torch.allclose(one, batch.observation[index], atol=1e-6)]
        torch.testing.assert_close(batch.next_observation[index], following[shift], atol=1e-6, rtol=0)


def test_the_later_observation_is_k_steps_on_and_the_next_one_a_step():
    data = make_data()
    batch = data.batch(64, np.random.default_rng(1), next_observation=True, k=3, sample_k=True, later=True, shift=False)
    rows = batch.reward.long()
    torch.testing.assert_close(batch.next_observation, data.observe(rows + 1))
    torch.testing.assert_close(batch.later_observation, data.observe(rows + batch.k))
    assert set(batch.k.tolist()) == {1, 2, 3}
    plain = data.batch(64, np.random.default_rng(1), next_observation=True, k=3, sample_k=True, shift=False)
    assert plain.later_observation is None and torch.equal(plain.next_observation, batch.later_observation)


def test_labeled_transitions_are_those_of_some_episodes_and_tests_are_of_others():
    data = make_data(held=(True, True, False)).with_labels(np.array([True, False, True]))
    labeled = data.but(train_rows=data.labeled_rows)
    drawn = labeled.batch(200, np.random.default_rng(0), next_observation=True, shift=False)
    rows = drawn.reward.long()
    assert set(rows.tolist()) == {0, 1, 2, 3, 13, 14}
    torch.testing.assert_close(drawn.next_observation, data.observe(rows + 1))
    assert set(data.hold_out_rows.tolist()) == set(range(5, 12)) and set(data.train_rows.tolist()) == {13, 14}


def test_shifts_are_drawn_for_training_unless_left_out_and_not_for_the_hold_out():
    data = make_data()
    held = data.batch(32, np.random.default_rng(0), hold_out=True)
    torch.testing.assert_close(held.observation, data.observe(held.reward.long()))
    shifted, plain = (data.batch(32, np.random.default_rng(0), shift=s) for s in (True, False))
    torch.testing.assert_close(plain.observation, data.observe(plain.reward.long()))
    assert (shifted.reward == plain.reward).all()
    assert (shifted.observation == plain.observation).flatten(1).all(dim=1).sum() < 8


SHORT = Budget("short", batch_size=8, state_batch_size=8, evaluations=3)


def test_states_are_normalized_by_the_training_episodes_with_a_floor():
    data = make_data()
    raw = torch.rand((16, 5), generator=torch.Generator().manual_seed(0))
    train_rows = np.r_[0:5, 13:16]
    expected = (raw - raw[train_rows].mean(0)) / raw[train_rows].std(0, correction=0)
    torch.testing.assert_close(data.state, expected, atol=1e-5, rtol=1e-5)
    zeros = np.zeros(4, np.float32)
    fields = {"state": np.full((4, 2), 7.0), "action": zeros[:, None], "reward": zeros, "discount": zeros}
    flat = TrainingData(StepTable(fields, np.array([3])), np.array([False]))
    assert flat.normalization.std.tolist() == pytest.approx([1e-3, 1e-3]) and flat.state.abs().max() == 0


def test_a_subset_is_held_as_it_is_stored(small_release):
    subset = Release.open(small_release)["walker-walk/random/dynamic"]
    data = load_data({subset.name: subset}, [Slice(subset.name)])
    assert not data.frames.mapped and data.sizes.channels == 9
    assert (data.held_out.sum(), len(data), len(data.hold_out_rows)) == (1, 1000, 500)
    episode = subset.episode(2)
    last = data.observe(torch.tensor([2 * 501 + 400]))[0, -3:]
    np.testing.assert_allclose(last, episode["pixels"][400].transpose(2, 0, 1) / 255 - 0.5, atol=1e-6)
    np.testing.assert_array_equal(data.action[2 * 501 : 2 * 501 + 500], episode["action"])
    raw = data.state * data.normalization.std + data.normalization.mean
    np.testing.assert_allclose(raw[2 * 501 + 7], episode["state"][7], atol=1e-4)


def test_pictures_that_do_not_fit_are_mapped_from_a_file_and_are_the_same(small_release, tmp_path):
    release = Release.open(small_release)
    parts = [Slice(f"walker-walk/random/{name}") for name in ("none", "dynamic")]
    held, stored = load_data(release, parts), load_data(release, parts, memory=0, scratch=tmp_path)
    assert stored.frames.mapped and not held.frames.mapped and not list(tmp_path.iterdir())
    for hold_out in (False, True):
        ask = dict(next_observation=True, k=5, hold_out=hold_out)
        one, two = (data.batch(12, np.random.default_rng(3), **ask) for data in (held, stored))
        torch.testing.assert_close(one.observation, two.observation)
        torch.testing.assert_close(one.next_observation, two.next_observation)
    assert len(held) == 2000
    budget = Budget("short", batch_size=4, precision="bfloat16")
    losses = []
    for data in (held, stored):
        torch.manual_seed(0)
        losses.append(train(BehaviorCloning(observation_encoder(9, SIZE), data.sizes), data, budget, 2)[-1]["loss"])
    assert losses[0] == losses[1]


def test_the_disk_is_asked_for_every_frame_of_a_batch_and_for_little_more(small_release, tmp_path, monkeypatch):
    data = load_data(Release.open(small_release), [Slice("walker-walk/random/none")], memory=0, scratch=tmp_path)
    advise = Mock(wraps=agents_data._advise)
    monkeypatch.setattr(agents_data, "_advise", advise)
    rows, frame = torch.tensor([0, 1, 7, 501, 500, len(data.state) - 1]), data.frames.table[0].numel()
    data.observe(rows)
    first = [0, 0, 5, 501, 498, len(data.state) - 3]  # an episode's first frames have none before them
    asked = [call.args[2:] for call in advise.call_args_list]
    assert asked == [(one * frame, (int(row) + 1) * frame) for one, row in zip(first, rows, strict=True)]


@pytest.mark.parametrize("free", [1000, 10**12])  # more, and then another process takes it
def test_pictures_that_fit_nowhere_are_refused_with_what_to_do(small_release, tmp_path, monkeypatch, free):
    full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    monkeypatch.setattr(steps_module.shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    monkeypatch.setattr(steps_module.os, "posix_fallocate", full)
    with pytest.raises(DmcvbError, match="fit neither into memory nor into .* another --out, or more --memory"):
        load_data(Release.open(small_release), [Slice("walker-walk/random/none")], memory=0, scratch=tmp_path)


def test_shares_and_counts_of_episodes_are_taken_once_and_split_by_episode(small_release):
    release, name = Release.open(small_release), "walker-walk/random/none"
    few = Slice(name, episodes=2)
    half, two, again = (load_data(release, [part]) for part in (Slice(name, share=0.5), few, few))
    assert (len(half.lengths), len(half), len(half.hold_out_rows)) == (2, 500, 500)
    assert len(load_data(release, [Slice(name, share=0.01)]).lengths) == 1
    assert (len(two.lengths), len(two), len(two.hold_out_rows)) == (2, 1000, 0)  # a counted few are all learned from
    torch.testing.assert_close(again.action, two.action)
    assert not torch.equal(load_data(release, [few], seed=5).action, two.action)


def test_batches_drawn_ahead_come_in_order_and_are_the_same():
    data, learner = make_data(), BehaviorCloning(observation_encoder(9, SIZE), make_data().sizes)
    plain, ahead = (list(batches(lambda step: draw(learner, data, 4, 0, step), 9, workers)) for workers in (0, 2))
    assert [step for step, _ in ahead] == list(range(9))
    for (_, one), (_, two) in zip(plain, ahead, strict=True):
        torch.testing.assert_close(one.observation, two.observation)


def test_bfloat16_pictures_are_the_float32_ones_rounded_once():
    data = make_data()
    one = data.batch(16, np.random.default_rng(0)).observation
    two = data.batch(16, np.random.default_rng(0), dtype=torch.bfloat16).observation
    assert two.dtype == torch.bfloat16
    assert (two.float() - one).abs().max() <= 2**-9 * 0.5 + 1e-6
    levels = torch.arange(256, dtype=torch.uint8).view(1, 1, 16, 16)
    assert len(normalize_pixels(levels, torch.bfloat16).unique()) == 256


# -- the trainer ----------------------------------------------------------------------------------


def state_learner(data):
    torch.manual_seed(0)
    return BehaviorCloning(state_encoder(data.state.shape[1]), data.sizes)


def test_the_curve_has_losses_hold_out_and_scores(monkeypatch):
    monkeypatch.setattr(trainer, "POINTS", 3)
    data = make_data().but(frames=None)
    curve = train(state_learner(data), data, SHORT, 12, evaluate=lambda learner: {"score": 1.0})
    assert [point["step"] for point in curve] == [4, 8, 12]
    assert all({"loss", "test_loss", "score", "seconds"} <= set(point) for point in curve)
    assert curve[-1]["loss"] < curve[0]["loss"]


def test_random_numbers_of_a_step_hang_on_the_seed_and_on_the_step(monkeypatch):
    data, drawn = make_data().but(frames=None), []
    for seed in (0, 0, 1):
        learner = state_learner(data)
        monkeypatch.setattr(
            learner, "update", lambda _: {"loss": drawn.append(torch.rand(1).item()) or torch.zeros(())}
        )
        train(learner, data, dataclasses.replace(SHORT, seed=seed), 3)
    assert drawn[:3] == drawn[3:6] and len(set(drawn)) == 6


def test_the_learning_rate_falls_linearly_to_zero_where_it_is_asked_to(monkeypatch):
    monkeypatch.setattr(trainer, "TICK_SECONDS", -1.0)
    data, rates = make_data().but(frames=None), {True: [], False: []}
    for decay, seen in rates.items():
        learner = state_learner(data)
        [group] = learner.optimizers["main"].param_groups
        budget = dataclasses.replace(SHORT, decay=decay)
        train(learner, data, budget, 4, tick=lambda steps, group=group, seen=seen: seen.append(group["lr"]))
    assert rates == {True: pytest.approx([1e-3, 0.75e-3, 0.5e-3, 0.25e-3]), False: [1e-3] * 4}


def test_a_loss_that_is_no_longer_finite_stops_the_run():
    data = make_data().but(frames=None)
    data.action[data.train_rows] = float("nan")
    with pytest.raises(DmcvbError, match="no longer finite at step 1; look at the agent's losses, and at the data"):
        train(state_learner(data), data, SHORT, 12)


@pytest.mark.parametrize("most, batches", [(2, 2), (1000, 64)])
def test_a_test_loss_takes_no_more_batches_than_were_trained_on(monkeypatch, most, batches):
    learner, asked = state_learner(make_data().but(frames=None)), []
    whole = learner.metrics
    monkeypatch.setattr(learner, "metrics", lambda batch: asked.append(batch) or whole(batch))
    losses = hold_out_losses(learner, make_data().but(frames=None), 4, most)
    assert len(asked) == batches
    assert losses["test_loss"] == pytest.approx(np.mean([float(whole(batch)["loss"].detach()) for batch in asked]))


def test_without_held_out_episodes_there_is_no_test_loss():
    data = make_data(held=(False, False, False)).but(frames=None)
    assert hold_out_losses(state_learner(data), data, 4, 1) == {}
    with pytest.raises(DmcvbError, match="held-out"):
        data.batch(4, np.random.default_rng(0), hold_out=True)


def test_agents_learn_actions_in_unit_bounds_from_data_with_the_tasks_own(tmp_path):
    roll_out(short_recipe(tasks="quadruped-walk", settings="none", episodes=2, max_steps=4), tmp_path / "r")
    release = Release.open(tmp_path / "r")
    [subset] = release.subsets.values()
    spec = suite.load("quadruped", "walk").action_spec()
    attributes, action = subset.array("action").attributes, subset.read("action")[:, :-1]
    np.testing.assert_allclose([attributes["low"], attributes["high"]], [spec.minimum, spec.maximum], rtol=1e-6)
    assert (action >= spec.minimum).all() and (action <= spec.maximum).all()
    data = load_data(release, [Slice(subset.name)], pixels=False)
    learned = data.action.reshape(2, 5, -1)[:, :-1].numpy()
    np.testing.assert_allclose(learned, (action - spec.minimum) / (spec.maximum - spec.minimum) * 2 - 1, atol=1e-5)
