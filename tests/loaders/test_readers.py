"""Readers: every form gives the stored values, whatever workers, ranks and seeds."""

import pickle

import numpy as np
import pytest
from torch.utils.data import DataLoader

import dmcvb_gen
from dmcvb_gen.errors import DmcvbError, StoreError, UnknownNameError
from dmcvb_gen.loaders import sampler
from tests.web_server import serving

NAME = "walker-walk/random/dynamic"


@pytest.fixture(scope="module")
def subset(small_release):
    return dmcvb_gen.open(small_release)[NAME]


def keys(items):
    """(episode, step) of every step, in the order they came."""
    columns = [(np.ravel(item["episode"]), np.ravel(item["step"])) for item in items]
    return [(int(e), int(s)) for episodes, steps in columns for e, s in zip(episodes, steps, strict=True)]


EVERY_STEP = {(episode, step) for episode in range(3) for step in range(500)}


def test_xarray_is_lazy_and_holds_every_array(subset):
    data, pixels = subset.xarray([0, 2]), subset.read("pixels", [0, 2])
    assert not data["pixels"].variable._in_memory and data["pixels"].encoding["shards"][0] == 2
    for given, wanted in (
        (dict(episode=1), pixels[1]),
        (dict(episode=[1, 0], step=slice(None, None, 2)), pixels[[1, 0]][:, ::2]),
        (dict(step=-1, channel=[2, 1]), pixels[:, -1][..., [2, 1]]),
    ):
        np.testing.assert_array_equal(data["pixels"].isel(given).values, wanted)
    assert dict(data.sizes).items() >= {"episode": 2, "step": 501, "height": 16, "state_dim": 24}.items()
    assert list(data.episode.values) == [0, 2] and data.attrs["task"] == "walker-walk"
    np.testing.assert_array_equal(data["action"].sel(episode=2), subset.read("action", [2])[0])
    position = data["exogenous_camera_position"].sel(episode=2, step=7).values
    np.testing.assert_array_equal(position, subset.read("exogenous/camera_position", [2])[0, 7])
    with pytest.raises(StoreError, match="no episode 9"):
        subset.xarray([9])


def test_every_mode_gives_the_same_shapes(subset):
    """Rewards of (64, 1) in one mode and (64,) in another broadcast silently in a loss."""
    kinds = {
        "held": DataLoader(subset.torch("steps", in_memory=True), batch_size=8),
        "read": DataLoader(subset.torch("steps", in_memory=False), batch_size=8),
        "singles": DataLoader(subset.torch("stream", buffer=1), batch_size=8),
        "batches": DataLoader(subset.torch("stream", batch_size=8, buffer=1), batch_size=None),
    }
    shapes = {kind: {k: (v.shape, v.dtype) for k, v in next(iter(loader)).items()} for kind, loader in kinds.items()}
    assert all(found == shapes["held"] for found in shapes.values()), shapes
    assert shapes["held"]["reward"][0] == shapes["held"]["episode"][0] == (8,)


def test_a_loader_takes_whole_batches_from_steps_that_are_held_by_default(subset, monkeypatch):
    data, asked = subset.torch("steps"), []
    gather = data.source.gather
    monkeypatch.setattr(data.source, "gather", lambda indices: asked.append(len(indices)) or gather(indices))
    assert data.source.in_memory and len(list(DataLoader(data, batch_size=64, shuffle=True))) == 24
    assert asked == [64] * 23 + [28]
    monkeypatch.setattr(sampler, "free_memory", lambda: 1000)
    assert not subset.torch("steps").source.in_memory and subset.torch("steps", pictures=()).source.in_memory


def test_the_source_is_numpy_alone_and_takes_any_index(subset):
    held, read = subset.source(in_memory=True, next_step=True), subset.source(in_memory=False, next_step=True)
    rows = [-1, 0, 499, 500, 1234]
    for index in rows:
        one, other = held[index], read[index]
        assert one.keys() == other.keys() == {*held.gather([0])} and "next_pixels" in one
        for name in one:
            assert isinstance(one[name], np.ndarray | np.generic) and np.shape(one[name]) == np.shape(other[name])
            np.testing.assert_array_equal(one[name], other[name])
            np.testing.assert_array_equal(held.gather(rows)[name][rows.index(index)], one[name])
    again = pickle.loads(pickle.dumps(held))
    assert again._held is None
    np.testing.assert_array_equal(again[7]["pixels"], held[7]["pixels"])
    for outside in (1500, -1501):
        with pytest.raises(IndexError):
            held[outside]
        with pytest.raises(IndexError):
            held.gather([0, outside])
    for wrong in (np.array([0.5]), [True]):
        with pytest.raises(IndexError, match="give whole numbers"):
            held.gather(wrong)


def test_batches_pass_over_every_step_once_in_an_order_that_the_seed_decides(subset):
    one = list(subset.batches(64, seed=1, buffer=2))
    assert [len(batch["step"]) for batch in one] == [64] * 23 + [28]
    assert set(keys(one)) == EVERY_STEP and len(keys(one)) == 1500
    assert keys(one) == keys(subset.batches(64, seed=1, buffer=2))
    other = keys(subset.batches(64, seed=2, buffer=2))
    assert keys(one) != other != keys(subset.batches(64, seed=2, epoch=1, buffer=2))
    assert [len(batch["step"]) for batch in subset.batches(64, drop_last=True)] == [64] * 23


def test_a_mask_chooses_episodes_and_other_values_are_refused(subset):
    best = subset.returns == subset.returns.max()
    assert list(subset.choose(best)) == list(np.flatnonzero(best)) and best.sum() == 1
    assert set(subset.source(episodes=best, pictures=()).episodes) == set(np.flatnonzero(best))
    for wrong in (best[:2], [0.5, 1.5], ["a"], 1, [[0, 1]]):
        with pytest.raises(DmcvbError, match="give indices, or a mask of all 3 episodes"):
            subset.choose(wrong)
    with pytest.raises(DmcvbError, match="no episodes are chosen"):
        list(subset.batches(4, episodes=[]))


def test_a_part_has_its_episodes_in_the_order_in_which_they_are_given(subset):
    part = subset.part([2, 0, 2])
    assert list(part.episodes) == [2, 0, 2] and list(part.returns) == list(subset.returns[[2, 0, 2]])
    np.testing.assert_array_equal(part[0]["action"], subset.episode(2)["action"])
    assert [index for index, _ in part.each_episode(["action"])] == [2, 0, 2]
    assert list(part.paired("none", "dynamic").episodes) == [2, 0, 2]
    assert [int(e) for e in part.xarray()["episode"]] == [2, 0, 2]
    [batch] = part.batches(10_000, pictures=(), shuffle=False)
    np.testing.assert_array_equal(batch["episode"], np.repeat([2, 0, 2], 500))
    painted = dmcvb_gen.open(subset.release.path, paint=True, distractors="resample")[NAME]
    labels = painted.part([2, 0]).read("exogenous/camera_position")
    np.testing.assert_array_equal(labels, painted.read("exogenous/camera_position", [2, 0]))


def test_loader_workers_share_the_episodes(subset):
    data = subset.torch("stream", batch_size=100, pictures=(), seed=3)
    loaded = keys(DataLoader(data, batch_size=None, num_workers=2))
    assert "pixels" not in next(iter(data))
    assert len(loaded) == 1500 and set(loaded) == EVERY_STEP


@pytest.mark.slow_cases("spawn")
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_persistent_workers_see_the_epoch(subset, context):
    data = subset.torch("stream", batch_size=100, pictures=(), seed=3, buffer=1)
    options = dict(num_workers=1, persistent_workers=True, multiprocessing_context=context)
    loader, orders = DataLoader(data, batch_size=None, **options), []
    for epoch in (0, 1, 0):
        data.set_epoch(epoch)
        orders.append(keys(loader))
    assert orders[0] == orders[2] != orders[1] and set(orders[0]) == set(orders[1])


def test_values_that_make_no_sense_are_refused_by_name(subset):
    for make, words in (
        (lambda: next(subset.batches(8, stack=0)), "stack is 0; give a whole number of at least 1"),
        (lambda: next(subset.batches(8, stack="3")), "stack is '3'; give a whole number"),
        (lambda: next(subset.batches(0)), "batch_size is 0; give a whole number"),
        (lambda: next(subset.batches(2.5)), "batch_size is 2.5; give a whole number"),
        (lambda: next(subset.batches(8, buffer=0)), "buffer is 0; give a whole number"),
        (lambda: next(subset.batches(8, seed=-1)), "seed is -1; give a whole number of at least 0"),
        (lambda: subset.source(stack=-1), "stack is -1; give a whole number"),
    ):
        with pytest.raises(DmcvbError, match=words):
            make()


def test_wrong_names_are_answered_with_the_right_ones(subset, tmp_path):
    with pytest.raises(UnknownNameError, match="walker-walk/random/none"):
        subset.release["walker-walk/expert/none"]
    for other in (0, None):
        with pytest.raises(UnknownNameError, match=f"unknown subset '{other}'"):
            subset.release[other]
    with pytest.raises(UnknownNameError, match="transitions"):
        subset.torch("rows")
    for kind, option in (("steps", "batch_size"), ("stream", "in_memory"), ("stream", "workers")):
        with pytest.raises(UnknownNameError, match=f"unknown option of torch\\('{kind}'\\) '{option}'"):
            subset.torch(kind, **{option: 4})
    with pytest.raises(UnknownNameError, match="pixels"):
        subset.torch("steps", pictures=["depth"])
    assert subset.source(pictures="pixels")[0]["pixels"].shape == (9, 16, 16)  # one may be named alone
    with pytest.raises(StoreError, match="holds no release"):
        dmcvb_gen.open(tmp_path)


def test_a_subset_counts_its_episodes_and_gives_them_in_their_order(subset):
    assert len(subset) == 3
    for place, episode in ((0, 0), (-1, 2), (np.int64(1), 1)):
        one, other = subset[place], subset.episode(episode)
        assert one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)
    with pytest.raises(IndexError):
        subset[3]


def test_a_shard_costs_a_web_server_a_handful_of_requests(small_release):
    with serving(small_release) as server:
        assert dmcvb_gen.open(server.url)[NAME].read("pixels", [0, 1]).any()
        paths = [path for _, path, _ in server.asked]
    assert len(paths) <= 10 and len(set(paths)) == len(paths), paths  # nothing is read twice


def test_a_digest_from_outside_is_compared(small_release):
    digest = dmcvb_gen.open(small_release).digest
    for spelling in (f"@sha256:{digest}", f"@sha256:{digest.upper()}", f"@{digest}"):
        assert dmcvb_gen.open(f"{small_release}{spelling}").compared
    assert dmcvb_gen.open(small_release, digest=f"sha256:{digest}").compared
    with pytest.raises(StoreError, match="'sha256:12' is no digest; give 64 hexadecimal digits"):
        dmcvb_gen.open(f"{small_release}@sha256:12")
    with pytest.raises(StoreError, match="another digest is given"):
        dmcvb_gen.open(f"{small_release}@sha256:{digest}", digest="0" * 64)
    for paint in (False, True):
        with pytest.raises(StoreError, match=f"is release {digest}"):
            dmcvb_gen.open(small_release, digest="0" * 64, paint=paint)


@pytest.mark.slow_cases("small_mazes-True")
@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("release", ["small_release", "small_mazes"])
def test_a_batch_of_no_steps_is_an_empty_batch(release, in_memory, request):
    subset = next(iter(dmcvb_gen.open(request.getfixturevalue(release)).subsets.values()))
    source = subset.source(in_memory=in_memory)
    batch, one = source.gather([]), source.gather([0])
    kinds = [{name: (value.shape[1:], value.dtype) for name, value in each.items()} for each in (batch, one)]
    assert kinds[0] == kinds[1]
    assert all(len(value) == 0 for value in batch.values())
