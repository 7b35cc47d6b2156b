"""Reading a release in a bucket and at a web server: forked loader workers, lost and altered objects, few requests."""

from __future__ import annotations

import numpy as np
import pytest
from torch.utils.data import DataLoader

import dmcvb_gen
from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.store import open_store
from tests.web_server import serving

NAME = "walker-walk/random/dynamic"


@pytest.fixture(scope="module")
def bucket(small_release):
    """A store of a bucket that holds the small release, and the options that readers need for it."""
    s3fs = pytest.importorskip("s3fs")
    moto = pytest.importorskip("moto.server").ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    moto.start()
    options = {
        "endpoint_url": "http://{}:{}".format(*moto.get_host_and_port()),
        "key": "someone",
        "secret": "a/secret",
        "client_kwargs": {"use_ssl": False},
    }
    s3fs.S3FileSystem(**options).makedirs("readers", exist_ok=True)
    store = open_store("s3://readers/small [1]#?", options)
    store.upload(small_release, [*open_store(small_release).list()])
    yield store, options
    moto.stop()


@pytest.fixture
def subset(bucket):
    store, options = bucket
    return dmcvb_gen.open(store.place, options)[NAME]


@pytest.mark.slow
def test_loader_workers_read_a_bucket_after_their_parent_has(subset, small_release):
    stored = dmcvb_gen.open(small_release)[NAME]
    np.testing.assert_array_equal(subset.read("pixels", [0]), stored.read("pixels", [0]))
    for data, options in (
        (subset.torch("episodes"), {"batch_size": 1}),
        (subset.torch("stream", batch_size=500, shuffle=False, pictures=()), {"batch_size": None}),
    ):
        loader = DataLoader(data, num_workers=2, multiprocessing_context="fork", timeout=60, **options)
        states = [np.asarray(batch["state"]).reshape(-1, 24) for batch in loader]
        assert len(states) == 3
        for batch, values in zip(loader, states, strict=True):
            episode = int(np.ravel(batch["episode"])[0])
            np.testing.assert_array_equal(values[:500], stored.episode(episode)["state"][:500])


@pytest.mark.slow
def test_a_lost_object_is_an_error_and_an_altered_one_too(bucket, subset, tmp_path):
    store, options = bucket
    [path] = [
        file.path for shard in subset.release.shards([NAME]) for file in shard.files if "pixels/c/1/" in file.path
    ]
    data = store.read(path, 10**7)
    for change, words in (
        (lambda: None, "is not there"),
        (lambda: store.create(path, data[:-1]), "is damaged"),
        (lambda: store.create(path, bytes(len(data))), "is damaged|SHA-256"),
    ):
        store.delete(path)
        change()
        fresh = dmcvb_gen.open(store.place, options)[NAME]
        for read in (
            lambda fresh=fresh: fresh.read("pixels", [2]),
            lambda fresh=fresh: fresh.xarray()["pixels"].values,
            lambda fresh=fresh: list(fresh.batches(64)),
            lambda fresh=fresh: fresh.torch("episodes")[2],
            lambda: dmcvb_gen.export(store.place, "npz", tmp_path / "out", storage_options=options, progress=False),
        ):
            with pytest.raises(StoreError, match=words) as caught:
                read()
            assert "secret" not in str(caught.value) and str(caught.value).isprintable()
        assert fresh.read("pixels", [0]).any()  # of another shard
    store.delete(path)
    store.create(path, data)


def test_a_shard_costs_a_handful_of_requests(small_release):
    with serving(small_release) as server:
        subset = dmcvb_gen.open(server.url)[NAME]
        assert subset.read("pixels", [0, 1]).any()
        paths = [path for _, path, _ in server.asked]
    assert len(paths) <= 10, paths
    assert len(set(paths)) == len(paths)  # nothing is read twice
