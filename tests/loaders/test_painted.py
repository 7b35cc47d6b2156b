"""Releases whose images are rendered when they are read: those of the data to the bit, or fresh ones for each epoch."""

import pickle
import threading

import numpy as np
import pytest

import dmcvb_gen
from dmcvb_gen.dataset.pictures import picture_arrays
from dmcvb_gen.dataset.steps import StepTable
from dmcvb_gen.errors import DmcvbError, StoreError


def distracted(release):
    """The subset with dynamic distractors, or of mazes with the goal hidden."""
    return next(subset for name, subset in release.subsets.items() if name.endswith(("/dynamic", "/hidden")))


@pytest.mark.slow_cases("maze-light", "maze-painted")
@pytest.mark.parametrize("which", ["light", "painted"])
def test_pictures_painted_on_reading_are_the_stored_ones(painted_and_light, which):
    stored = dmcvb_gen.open(str(painted_and_light / "painted"))
    fresh = dmcvb_gen.open(str(painted_and_light / which), paint=True, cache_bytes=1)
    for name, subset in stored.subsets.items():
        for array in subset.pixel_arrays:
            assert np.array_equal(fresh[name].read(array), subset.read(array)), (name, array)
            for index in np.s_[..., 0], np.s_[..., 0:1], np.s_[0, ..., 1], np.s_[:1, 2], np.s_[...]:
                assert np.array_equal(fresh[name].array(array)[index], subset.array(array)[index]), (array, index)
        one, other = (next(iter(s.batches(4, seed=1))) for s in (subset, fresh[name]))
        assert all(np.array_equal(one[key], other[key]) for key in one)


def test_labels_of_fresh_distractors_are_those_of_their_pictures(painted_and_light):
    """The labels of an epoch are the ones that its pictures are painted from."""
    for name in dmcvb_gen.open(str(painted_and_light / "light")):
        subset = dmcvb_gen.open(str(painted_and_light / "light"), paint=True, distractors="resample")[name]
        stored, episode = dmcvb_gen.open(str(painted_and_light / "light"))[name], int(subset.episodes[-1])
        labels = [array for array in subset.arrays if array.startswith("exogenous/")]
        shapes = {array: stored.read(array, [episode]).shape for array in labels}
        rows, seen = int(stored.read("length", [episode])[0]) + 1, []
        for epoch in (0, 1):
            subset.set_epoch(epoch)
            alone = subset.episode(episode)
            for array in labels:
                read = subset.read(array, [episode])
                assert read.shape == shapes[array] and read.dtype == stored.array(array).dtype
                assert not read[:, rows:].any()
                np.testing.assert_array_equal(read[0, :rows], alone[array])
            renderer, _ = subset._painter
            shown, views = subset.labels([episode])[:, :rows], subset.record.views
            physics = stored.read("physics", [episode])[0, :rows]
            pictures = renderer.render(physics, shown[0], views, False)
            for place, array in enumerate(picture_arrays(views)):
                np.testing.assert_array_equal(pictures[:, place], alone[array])
            seen.append(np.concatenate([np.ravel(alone[array]) for array in labels] or [np.zeros(0)]))
        assert stored.record.distractor.kind == "none" or (seen[0] != seen[1]).any()


def test_stored_modalities_are_read_with_their_own_pictures_alone(painted_and_light, tmp_path):
    name = distracted(dmcvb_gen.open(painted_and_light / "light")).name
    dmcvb_gen.repaint(painted_and_light / "light", only=[name], labels=["depth"], out=tmp_path / "r", progress=False)
    [same] = dmcvb_gen.open(str(tmp_path / "r"), paint=True).subsets.values()
    depths = [array for array in same.arrays if array.startswith("depth")]
    assert depths and set(depths) < set(same.episode(0))
    for options in ({"size": 24}, {"distractors": "resample"}):
        [subset] = dmcvb_gen.open(str(tmp_path / "r"), paint=True, **options).subsets.values()
        assert set(same.arrays) - set(subset.arrays) == set(depths) and not set(depths) & set(subset.episode(0))
        with pytest.raises(StoreError, match="depth.* of .* belongs to the images as they were made"):
            subset.array(depths[0])


def test_fresh_distractors_are_the_same_alone_and_drawn_together(painted_and_light, monkeypatch):
    opened = [dmcvb_gen.open(str(painted_and_light / "light"), paint=True, distractors="resample") for _ in range(2)]
    together, alone = map(distracted, opened)
    array, episodes = together.pixel_arrays[0], together.episodes[::-1]
    batch = together.rows([array], episodes)[array]
    monkeypatch.setattr("dmcvb_gen.loaders.painted.DRAWN_TOGETHER", 1)
    assert len(together._drawn) == len(episodes)
    np.testing.assert_array_equal(batch, np.concatenate([alone.rows([array], [e])[array] for e in episodes]))


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("kind", ["steps", "episodes", "stream"])
def test_fresh_distractors_come_with_the_epoch_through_every_torch_data_set(painted_and_light, kind, workers):
    import torch

    subset = distracted(dmcvb_gen.open(str(painted_and_light / "light"), paint=True, distractors="resample"))
    few = [int(subset.episodes[0])]
    data = subset.torch(kind, episodes=few, **({"batch_size": 4, "shuffle": False} if kind == "stream" else {}))
    given = {"num_workers": workers, "persistent_workers": workers > 0}
    loader = torch.utils.data.DataLoader(data, batch_size=None if kind == "stream" else 1, **given)
    seen = []
    for epoch in (0, 1, 0):
        data.set_epoch(epoch)
        seen.append([(batch["pixels"].numpy().copy(), batch["state"].numpy().copy()) for batch in loader])
    assert len(seen[0]) == len(seen[1]) == len(seen[2]) > 0
    first, second, third = ([np.concatenate([np.ravel(b[i]) for b in part]) for i in (0, 1)] for part in seen)
    if kind != "stream":  # which takes another order besides
        assert np.array_equal(first[1], second[1])
    assert not np.array_equal(first[0], second[0]) and np.array_equal(first[0], third[0])


@pytest.mark.slow_cases("maze")
def test_two_streams_of_one_subset_read_in_turns_keep_their_epochs(painted_and_light):
    subset = distracted(dmcvb_gen.open(str(painted_and_light / "light"), paint=True, distractors="resample"))
    streams = [subset.torch("stream", batch_size=4, shuffle=False, buffer=1, epoch=epoch) for epoch in (1, 2)]
    alone = [[batch["pixels"].numpy() for batch in stream] for stream in streams]
    turns = [[pair[index]["pixels"].numpy() for pair in zip(*streams, strict=True)] for index in (0, 1)]
    assert len(alone[0]) > 2 and not np.array_equal(alone[0][-1], alone[1][-1])
    for one, other in zip(alone, turns, strict=True):
        assert all(map(np.array_equal, one, other))


@pytest.mark.parametrize("way", [{}, {"paint": True, "distractors": "resample"}])
def test_of_several_threads_one_reads_a_source(painted_and_light, way, monkeypatch):
    subset = distracted(dmcvb_gen.open(str(painted_and_light / "painted"), **way))
    tables, real = [], StepTable.read
    monkeypatch.setattr(StepTable, "read", lambda *options: tables.append(1) or real(*options))
    source = pickle.loads(pickle.dumps(subset.source()))
    threads = [threading.Thread(target=lambda: source[0]) for _ in range(6)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert len(tables) == 1


def test_painted_episodes_are_kept_while_there_is_room(painted_and_light):
    subset = next(iter(dmcvb_gen.open(str(painted_and_light / "light"), paint=True).subsets.values()))
    name = subset.pixel_arrays[0]
    assert subset.painted(0, [name])[name] is subset.painted(0)[name]
    subset.array(name)[0][:] = subset.episode(0, [name])[name][:] = 0
    assert subset.painted(0)[name].any()  # what is read is the reader's, and may be changed
    subset.painting.__dict__["cache_bytes"] = 1
    first = subset.painted(1, [name])[name]
    assert subset.painted(2) and subset.painted(1, [name])[name] is not first


def test_a_way_of_painting_that_there_is_not_is_refused(painted_and_light):
    with pytest.raises(DmcvbError, match="resample"):
        dmcvb_gen.open(str(painted_and_light / "light"), paint=True, distractors="new")
