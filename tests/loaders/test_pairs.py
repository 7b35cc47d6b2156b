"""Pairs of images of the same states, stored or rendered on reading; and what an encoder keeps of them."""

import pickle

import numpy as np
import pytest
from torch.utils.data import DataLoader

import dmcvb_gen
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.pictures import picture_arrays
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from tests.conftest import roll_out, short_recipe, stack_channels


@pytest.fixture
def made(painted_and_light):
    """(folder, names of two subsets) of a release that is "painted" in that folder, and "light" without images."""
    return painted_and_light, sorted(Release.open(painted_and_light / "light"), reverse=True)


def paired(folder, names, *settings, **options):
    return dmcvb_gen.open(folder, **options)[names[0]].paired(*(settings or settings_of(names)))


def settings_of(names):
    return [name.split("/")[-1] for name in names]


def by_step(batches):
    """(episode, step) -> pixels of a step."""
    each = [zip(batch["episode"], batch["step"], batch["pixels"], strict=True) for batch in batches]
    return {(int(episode), int(step)): np.asarray(pixels) for rows in each for episode, step, pixels in rows}


@pytest.mark.slow_cases("maze-light", "maze-painted")
@pytest.mark.parametrize("which", ["painted", "light"])
def test_a_pair_shows_each_state_under_both_settings_in_every_form(made, which):
    folder, names = made
    stored, images = [Release.open(folder / "painted")[name] for name in names], [("pixels",)] * 2
    if names[0].startswith("ant"):  # the states of both looks are those of the first subset
        stored[1], images = stored[0], [picture_arrays(stored[0].record.views, hidden) for hidden in (False, True)]
    episodes = [[subset.episode(e, arrays) for e in range(3)] for subset, arrays in zip(stored, images, strict=True)]
    pairs = paired(folder / which, names)
    again, source = pickle.loads(pickle.dumps(pairs)), pairs.source(in_memory=False)
    forms = [pairs.batches(8), again.torch("stream", batch_size=8), [pairs.source().gather(range(len(source)))]]
    forms += [DataLoader(pairs.torch("steps"), batch_size=8), [source.gather(range(pairs.steps))]]
    for form in forms:
        found = by_step(form)
        assert len(found) == pairs.steps
        for (episode, step), pixels in found.items():
            for look, arrays in enumerate(episodes):
                rows = [[each[max(step - back, 0)] for each in arrays[episode].values()] for back in (2, 1, 0)]
                np.testing.assert_array_equal(pixels[look], stack_channels(rows))
    whole = pairs.torch("episodes")[1]["pixels"].numpy()
    shape = (int(pairs.lengths[1]) + 1, 2, 3 * len(stored[0].record.views), 16, 16)
    assert whole.shape == shape and np.array_equal(whole[3], by_step(pairs.batches(9, stack=1))[1, 3])
    assert pairs.xarray()[pairs.pixel_arrays[0].replace("/", "_")].dims[2] == "setting"
    assert next(iter(pairs.batches(4, pictures="agents", next_step=True)))["next_pixels"].shape[:2] == (4, 2)


@pytest.mark.slow_cases("maze")
def test_settings_that_are_not_stored_or_named_twice_are_fresh_and_change_with_the_epoch(made):
    folder, names = made
    first, second = settings_of(names)
    fresh = [second, "dynamic_hard"] if first == "none" else [second]
    pairs = paired(folder / "painted", names, first, second, *fresh)
    data, seen = pairs.torch("steps", in_memory=False), []
    for epoch in (0, 1, 0):
        data.set_epoch(epoch)
        seen.append([each.numpy() for each in data[5]["pixels"]])
    assert all(np.array_equal(one, other) for one, other in zip(seen[0], seen[2], strict=True))
    changed = [not np.array_equal(one, other) for one, other in zip(*seen[:2], strict=True)]
    assert changed == [False, False, *(True for _ in fresh)]
    assert all(not np.array_equal(seen[0][1], look) for look in seen[0][2:])
    twice = paired(folder / "light", names, second, second, paint=True, distractors="resample")
    one, other = twice.source()[0]["pixels"]
    assert not np.array_equal(one, other)


def test_what_cannot_be_paired_is_refused_in_a_line(made):
    folder, names = made
    with pytest.raises(DmcvbError, match="1 settings are given; give two or more"):
        paired(folder / "painted", names, settings_of(names)[0])
    with pytest.raises(UnknownNameError, match="stattic"):
        paired(folder / "painted", names, "stattic", "stattic")
    subset = dmcvb_gen.open(folder / "painted")[names[0]]
    subset.record = subset.record.model_copy(update={"renderer": {"name": "imported"}})
    with pytest.raises(DmcvbError, match="was imported and cannot be rendered; name settings that the release holds"):
        subset.paired(*settings_of(names)[:1] * 2)


def knowing(pairs, values):
    """An encoder that knows the answer: the row of each image's own bytes."""
    table = {}
    for batch in pairs.batches(64, shuffle=False, stack=1):
        for look in range(pairs.looks):
            rows = zip(batch["pixels"][:, look], values(batch, look), strict=True)
            table |= {pixels.tobytes(): row for pixels, row in rows}
    return lambda pixels: np.stack([table[each.tobytes()] for each in pixels])


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """Pairs of 8 short episodes of the walker without and with dynamic distractors."""
    folder = tmp_path_factory.mktemp("pairs") / "r"
    roll_out(short_recipe(settings=["none", "dynamic"], episodes=8, max_steps=12), folder)
    return dmcvb_gen.open(folder)["walker-walk/random/none"].paired("none", "dynamic")


def labels_of(pairs, batch, look):
    labels = pairs.parts[look].labels(range(8))[batch["episode"], batch["step"]]
    return np.concatenate([value.reshape(len(value), -1) for _, value in labels.items()], axis=1)


def test_invariance_of_encoders_that_know_the_answer(pairs):
    """One that sees the state alone, one that sees the distractors alone, and one that sees nothing."""
    noise = np.random.default_rng(0)
    state = pairs.evaluate_invariance(knowing(pairs, lambda batch, look: batch["state"]), stack=1)
    assert state.retrieval == 1 and state.state > 0.98 and state.distractors < 0.2
    distractors = pairs.evaluate_invariance(knowing(pairs, lambda *which: labels_of(pairs, *which)), stack=1)
    assert distractors.retrieval < 0.1 and distractors.distractors > 0.95 and distractors.state < 0.2
    nothing = pairs.evaluate_invariance(lambda pixels: noise.normal(size=(len(pixels), 8)), stack=1)
    twice = pairs.release["walker-walk/random/none"].paired("none", "none")  # the camera follows the agent
    assert np.isnan(twice.evaluate_invariance(lambda pixels: pixels, states=32).distractors)
    with pytest.raises(DmcvbError, match="2 states are of one half of the episodes alone"):
        pairs.evaluate_invariance(lambda pixels: pixels, states=2)
    assert nothing.chance == 1 / 96 and nothing.retrieval < 0.1 and max(nothing.state, nothing.distractors) < 0.1


def test_settings_may_have_other_labels_and_parts_have_their_own_epochs(pairs):
    looks = pairs.release["walker-walk/random/none"].paired("none", "dynamic_light0.5")
    assert looks.parts[1].labels([0]).light_shift.any() and looks.parts[0].labels([0]).light_shift is None
    assert looks.evaluate_invariance(lambda pixels: pixels.reshape(len(pixels), -1)[:, :64]).distractors < 1
    one, other = looks.part([0]), looks.part([1])
    before = other.array("pixels")[1]
    one.set_epoch(1)
    assert np.array_equal(other.array("pixels")[1], before)
    assert not np.array_equal(one.array("pixels")[0], looks.array("pixels")[0])


def test_a_probe_of_one_episode_and_labels_of_all_settings_are_refused(pairs):
    one = pairs.part([0])
    assert len(one) == 1 and one.steps == 12
    with pytest.raises(DmcvbError, match="has 1 episodes, .*; a probe needs 2"):
        one.evaluate_invariance(lambda pixels: pixels)
    with pytest.raises(DmcvbError, match="has labels for each setting"):
        one.labels()
