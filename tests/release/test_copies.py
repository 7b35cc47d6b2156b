"""Fetch, publish and verify releases of made-up values: folder, bucket and Hub; no simulator is needed."""

from __future__ import annotations

import shutil
from collections import namedtuple

import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import COPY, MANIFEST
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_bytes
from dmcvb_gen.release import fetch as fetching
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.verify import check_files, verify
from dmcvb_gen.storage.store import Store, open_store
from tests.dataset.made_up import make, recipe
from tests.fake_hub import fake_hub


def content(place, storage_options=None):
    """Path -> bytes of all files at a place."""
    store = open_store(place, storage_options)
    return {path: store.read(path, size) for path, size in store.list().items()}


@pytest.fixture
def made(tmp_path):
    """A release of two subsets that share their trajectories, in three shards each."""
    make(open_store(tmp_path / "made"), recipe(5))
    return tmp_path / "made"


@pytest.fixture(scope="module")
def server():
    """An S3 server with a bucket."""
    fsspec = pytest.importorskip("s3fs")
    moto = pytest.importorskip("moto.server").ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    moto.start()
    options = {"endpoint_url": "http://{}:{}".format(*moto.get_host_and_port()), "key": "k", "secret": "s"}
    fsspec.S3FileSystem(**options, skip_instance_cache=True).mkdir("copies")
    yield options
    moto.stop()


@pytest.fixture(params=["folder", "bucket", "hub"])
def place(request, tmp_path, monkeypatch):
    """A place to publish to, with its options."""
    if request.param == "bucket":
        return f"s3://copies/{tmp_path.name}", {"storage_options": request.getfixturevalue("server")}
    if request.param == "hub":
        fake_hub(tmp_path / "hub", monkeypatch)
        return "hf://datasets/me/tiny", {}
    return f"file:{tmp_path / 'there'}", {}


def test_a_release_comes_back_as_it_went(made, place, tmp_path):
    (url, options), back = place, tmp_path / "back"
    (made / "LICENSE").write_text("mine")
    assert publish(made, url, **options).moved and publish(made, url, **options).moved == 0
    assert content(url, **options) == content(made)
    fetch(url, back, **options)
    chunks = {path: path.stat().st_ino for path in back.rglob("c/*")}
    fetch(url, back, **options)
    assert chunks and chunks == {path: path.stat().st_ino for path in back.rglob("c/*")}
    assert content(back) == content(made) and not check_files(back)
    digest = Release.open(made).digest
    found = verify(f"{url}@sha256:{digest}", everything=True, **options)
    assert found.sound and found.complete and found.compared and found.digest == digest
    with pytest.raises(StoreError, match=f"is release {digest}, not 0000"):
        fetch(f"{url}@sha256:{'0' * 64}", tmp_path / "x", **options)


def test_a_part_is_a_copy_that_can_be_completed(made, tmp_path):
    url, part, digest = f"file:{made}", tmp_path / "part", Release.open(made).digest
    fetch(url, part, ["*/none"], (2, 3))
    release = Release.open(part, digest=digest)
    assert release.shortfalls == {"hop/random/dynamic": (0, 5), "hop/random/none": (2, 5)}
    assert release["hop/random/none"].episodes.tolist() == [2, 3] and not check_files(part)
    with pytest.raises(StoreError, match="is not complete"):
        publish(part, f"file:{tmp_path / 'x'}")
    fetch(url, part)
    assert content(part) == content(made)


def test_without_images_it_is_a_copy_of_the_same_digest(made, place, tmp_path):
    (url, options), back = place, tmp_path / "back"
    publish(made, url, pixels=False, **options)
    there = content(url, **options)
    assert COPY in there and not any("pixels/c/" in path for path in there)
    fetch(url, back, **options)
    light = Release.open(back)
    assert light.digest == Release.open(made).digest and light["hop/random/none"].unpainted.all()
    assert not check_files(back) and verify(url, **options).sound and not light.shortfalls
    assert publish(back, f"file:{tmp_path / 'x'}", pixels=False).moved


def test_a_grown_release_takes_the_place_of_the_older(made, place, tmp_path):
    (url, options), back = place, tmp_path / "back"
    publish(made, url, **options)
    fetch(url, back, **options)
    shutil.copytree(made, tmp_path / "old")
    old = Release.open(made).digest
    make(open_store(made), recipe(8))
    publish(made, url, **options)
    fetch(url, back, **options)
    assert Release.open(back)["hop/random/none"].record.episodes == 8 and not check_files(back)
    assert sha256_bytes(content(url, **options)[f"manifests/{old}.json"]) == old
    with pytest.raises(StoreError, match="already holds hop 1.0.0"):
        publish(tmp_path / "old", url, **options)
    with pytest.raises(StoreError, match="and not the hop 1.0.0"):
        fetch(f"file:{tmp_path / 'old'}", back)


def test_what_is_no_part_of_it_stays_as_it_is(made, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/notes.txt").write_text("mine")
    with pytest.raises(StoreError, match="is not empty and holds no release"):
        fetch(f"file:{made}", tmp_path / "full")
    with pytest.raises(StoreError, match="holds notes.txt, and no release; choose an empty destination"):
        publish(made, f"file:{tmp_path / 'full'}")
    assert content(tmp_path / "full") == {"notes.txt": b"mine"}
    with pytest.raises(StoreError, match="is the release itself"):
        fetch(f"file:{made}", made)
    make(open_store(tmp_path / "other"), recipe(2, name="other"))
    with pytest.raises(StoreError, match=r"holds other 1.0.0 \(.*\) and not the hop 1.0.0"):
        fetch(f"file:{made}", tmp_path / "other")


def test_a_link_is_not_published(made, tmp_path):
    (tmp_path / "secret").write_text("mine")
    (made / "LICENSE").symlink_to(tmp_path / "secret")
    with pytest.raises(StoreError, match="LICENSE"):
        publish(made, f"file:{tmp_path / 'there'}")
    assert not any(b"mine" in data for data in content(tmp_path / "there").values())


def test_no_wrong_byte_is_taken(made, tmp_path):
    for number, (name, data) in enumerate(content(made).items()):
        if name == MANIFEST:
            continue  # another manifest is another release
        path = made / name
        path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        found = [str(issue) for issue in check_files(made)]
        assert any(name in text for text in found), (name, found)
        if path.name != "zarr.json":  # which is written anew
            with pytest.raises(StoreError):
                publish(made, f"file:{tmp_path / str(number)}")
            assert not (tmp_path / str(number) / MANIFEST).exists()
            with pytest.raises(StoreError):
                fetch(f"file:{made}", tmp_path / f"back{number}")
            assert not (tmp_path / f"back{number}" / MANIFEST).exists()
        path.write_bytes(data)
    assert not check_files(made)


@pytest.mark.parametrize("hub", [False, True], ids=["folder", "hub"])
def test_what_was_damaged_or_lost_there_is_found_and_replaced(made, tmp_path, monkeypatch, hub):
    there = fake_hub(tmp_path / "hub", monkeypatch).folder if hub else tmp_path / "there"
    url, before = "hf://datasets/me/tiny" if hub else f"file:{there}", content(made)
    publish(made, url)
    wrong, short, lost = (f"hop/random.zarr/none/pixels/c/{number}/0/0/0/0" for number in range(3))
    (there / wrong).write_bytes(before[wrong][:-1] + b"x")
    (there / short).write_bytes(b"half")
    (there / lost).unlink()
    found = [str(issue) for issue in verify(url).findings]
    assert sum(short in text or lost in text for text in found) == 2
    assert any(wrong in str(issue) for issue in verify(url, everything=True).findings)
    with pytest.raises(StoreError, match="has 4 bytes instead of .*with repair"):
        publish(made, url)
    assert publish(made, url, repair=True).moved == 3 and content(there) == before
    assert verify(url, everything=True).sound


def test_no_room_is_said_before_anything_comes(made, tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(fetching.shutil, "disk_usage", lambda place: usage(10, 0, 10))
    with pytest.raises(StoreError, match="are needed and 10 B are free"):
        fetch(f"file:{made}", tmp_path / "back")
    assert content(tmp_path / "back") == {}


class Killed(BaseException):
    """The process is dead."""


def die(monkeypatch, at, after):
    """Let the process die before or after its n-th write; gives the list of writes so far."""
    writes = []

    def dying(real):
        def write(*given, **more):
            number = len(writes)
            writes.append(given)
            if number > at or (number == at and not after):
                raise Killed
            result = real(*given, **more)
            if number == at:
                raise Killed
            return result

        return write

    for name in ("create", "replace", "delete", "download"):
        monkeypatch.setattr(Store, name, dying(getattr(Store, name)))
    return writes


@pytest.mark.slow
@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("act", ["fetch", "publish", "grow"])
def test_whoever_dies_leaves_no_half_and_goes_on(act, after, tmp_path, monkeypatch):
    """At every write: what a reader sees is nothing, the older release or the new one; the same call ends it."""
    make(open_store(tmp_path / "old"), recipe(2, settings=("none",)))
    shutil.copytree(tmp_path / "old", tmp_path / "new")
    make(open_store(tmp_path / "new"), recipe(3, settings=("none",)))
    digests = [Release.open(tmp_path / name).digest for name in ("old", "new")]
    for at in range(200):
        place = tmp_path / f"at{at}"
        if act == "grow":
            shutil.copytree(tmp_path / "old", place)

        def move(place=place):
            new = tmp_path / "new"
            fetch(f"file:{new}", place, workers=1) if act == "fetch" else publish(new, f"file:{place}", workers=1)

        with monkeypatch.context() as patch:
            writes = die(patch, at, after)
            try:
                move()
            except Killed:
                pass
        if len(writes) <= at:
            return
        if act == "grow" or (place / MANIFEST).exists():
            seen = Release.open(place)
            assert seen.digest in digests and not [i for i in check_files(place) if "zarr.json" not in str(i)], at
        move()
        named = {recipe.sha256 for recipe in Release.open(tmp_path / "new").recipes}
        older = [f"recipes/{path.name}" for path in (tmp_path / "new/recipes").iterdir() if path.stem not in named]
        history = ("manifests/", "layers/", *older)
        wanted = {path: data for path, data in content(tmp_path / "new").items() if not path.startswith(history)}
        there = content(place)
        assert {path: there.get(path) for path in wanted} == wanted and not check_files(place), at
    raise AssertionError("more writes than expected")
