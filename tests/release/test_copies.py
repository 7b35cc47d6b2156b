"""Fetch, publish and verify releases of made-up values: folder, bucket and Hub; no simulator is needed."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import COPY, MANIFEST, RECORDS
from dmcvb_gen.dataset.writer import begin, finish, put_shard
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_bytes
from dmcvb_gen.release import fetch as fetching
from dmcvb_gen.release import publish as publishing
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.verify import verify
from dmcvb_gen.storage.store import open_store
from tests.conftest import wrong_files
from tests.dataset.made_up import make, recipe, values
from tests.fake_hub import fake_hub
from tests.web_server import give_files, serving, serving_s3


def content(place, storage_options=None):
    """Path -> bytes of all files at a place."""
    store = open_store(place, storage_options)
    return {path: store.read(path, size) for path, size in store.list().items()}


@pytest.fixture
def made(tmp_path):
    """A release of two subsets that share their trajectories, in two shards each."""
    make(open_store(tmp_path / "made"), recipe(3))
    return tmp_path / "made"


@pytest.fixture(scope="module")
def server():
    """Options of an S3 server with a bucket."""
    with serving_s3("copies") as options:
        yield options


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
    assert content(back) == content(made) and not wrong_files(back)
    digest = Release.open(made).digest
    found = verify(f"{url}@sha256:{digest}", everything=True, **options)
    assert found.sound and found.complete and found.compared and found.digest == digest
    with pytest.raises(StoreError, match=f"is release {digest}, not 0000"):
        fetch(f"{url}@sha256:{'0' * 64}", tmp_path / "x", **options)


def test_of_two_who_publish_at_once_one_does(made, place, monkeypatch):
    (url, options), metadata = place, publishing.plain_metadata

    def overtaken(release):
        assert open_store(url, *options.values()).finish({MANIFEST: b"of another"})
        return metadata(release)

    monkeypatch.setattr(publishing, "plain_metadata", overtaken)
    with pytest.raises(StoreError, match="was published to by another process meanwhile; run the command again"):
        publish(made, url, **options)
    assert content(url, **options)[MANIFEST] == b"of another"


def test_what_an_interrupted_publish_of_an_older_version_left_is_adopted(made, tmp_path):
    there = tmp_path / "there"
    publish(made, f"file:{there}")
    for path in (there / MANIFEST, *there.rglob("zarr.json")):  # which are written last
        path.unlink()
    make(open_store(made), recipe(5))
    publish(made, f"file:{there}")
    assert Release.open(there).digest == Release.open(made).digest and not wrong_files(there)


def test_a_part_is_a_copy_that_can_be_completed(made, tmp_path):
    url, part, digest, name = f"file:{made}", tmp_path / "part", Release.open(made).digest, "hop/random/none"
    (made / "README.md").write_text("the card of the whole")
    fetch(url, part, ["*/none"], (2, 3))
    (part / "README.md").write_text("the card of a part")
    release = Release.open(part, digest=digest)
    assert release.compared and release.copy.promised[f"{name}/pixels"] == ((1, 2),)
    assert release.shortfalls == {"hop/random/dynamic": (0, 3), name: (1, 3)}
    assert release[name].episodes.tolist() == [2] and not wrong_files(part)
    np.testing.assert_array_equal(release[name].read("pixels"), Release.open(made)[name].read("pixels", [2]))
    with pytest.raises(StoreError, match="has 2..2 here"):
        release[name].array("state")[:]
    assert finish(open_store(part)).digest == digest
    with pytest.raises(StoreError, match="is a copy of a release and does not grow"):
        begin(open_store(part), recipe(3, ["static"]), {})
    with pytest.raises(StoreError, match="is not complete"):
        publish(part, f"file:{tmp_path / 'x'}")
    fetch(url, part)
    assert content(part) == content(made)


@pytest.mark.slow_cases("bucket")
def test_without_images_it_is_a_copy_of_the_same_digest(made, place, tmp_path):
    (url, options), back = place, tmp_path / "back"
    publish(made, url, pixels=False, **options)
    there = content(url, **options)
    assert COPY in there and not any("pixels/c/" in path for path in there)
    fetch(url, back, **options)
    light = Release.open(back)
    assert light.digest == Release.open(made).digest and light["hop/random/none"].unpainted.all()
    assert not wrong_files(back) and verify(url, **options).sound and not light.shortfalls
    assert publish(back, f"file:{tmp_path / 'x'}", pixels=False).moved


@pytest.mark.slow_cases("bucket")
def test_a_grown_release_takes_the_place_of_the_older(made, place, tmp_path):
    (url, options), back = place, tmp_path / "back"
    publish(made, url, **options)
    fetch(url, back, **options)
    fetch(url, tmp_path / "part", ["*/none"], (0, 1), **options)
    shutil.copytree(made, tmp_path / "old")
    old = Release.open(made).digest
    make(open_store(made), recipe(5))
    publish(made, url, **options)
    fetch(url, back, ["*/none"], **options)
    assert len(Release.open(back)["hop/random/none"]) == 5 and not wrong_files(back)
    assert len(Release.open(back)["hop/random/dynamic"].read("pixels")) == 4  # of the shards that came before
    fetch(url, tmp_path / "part", ["*/none"], **options)
    assert len(Release.open(tmp_path / "part")["hop/random/none"]) == 5
    assert sha256_bytes(content(url, **options)[f"manifests/{old}.json"]) == old
    for replaced in (Release.open(url, *options.values(), digest=old), Release.open(back, digest=old)):
        assert replaced.compared and len(replaced["hop/random/none"].read("state")) == 3
    assert verify(f"{url}@sha256:{old}", everything=True, **options).sound
    older = back / f"manifests/{old}.json"
    older.write_bytes(older.read_bytes().replace(b"1.0.0", b"1.0.9"))
    with pytest.raises(StoreError, match="was altered"):
        Release.open(back, digest=old)
    with pytest.raises(StoreError, match="already holds hop 1.0.0"):
        publish(tmp_path / "old", url, **options)
    with pytest.raises(StoreError, match="and not hop 1.0.0"):
        fetch(f"file:{tmp_path / 'old'}", back)


def test_a_release_that_grew_under_another_name_takes_the_place_of_the_older(made, tmp_path, caplog):
    publish(made, url := f"file:{tmp_path / 'there'}")
    begin(open_store(made), recipe(4, name="aaa"), {})
    assert verify(made).incomplete == {"hop/random/none": (3, 4), "hop/random/dynamic": (3, 4)}
    publish(made, url)
    assert "not finished: episodes or images of 2 subsets stay unpublished, e.g. hop/random/dynamic" in caplog.text
    make(open_store(made), recipe(4, name="aaa"))
    publish(made, url)
    assert len(Release.open(url)["hop/random/none"]) == 4


def test_a_publish_without_images_goes_on_and_leaves_images_that_are_there(made, tmp_path):
    light, whole = tmp_path / "light", tmp_path / "whole"
    publish(made, f"file:{light}", pixels=False)
    (light / MANIFEST).unlink()
    publish(made, f"file:{light}", pixels=False)
    assert Release.open(light).digest == Release.open(made).digest and not wrong_files(light)
    publish(made, f"file:{whole}")
    publish(made, f"file:{whole}", pixels=False)
    assert content(whole) == content(made)
    for place in (made, made / "below"):
        with pytest.raises(StoreError, match="is the release itself, or in its folder; choose another URL"):
            publish(made, f"file:{place}", pixels=False)


def test_images_that_no_manifest_names_are_not_copied(tmp_path):
    made, there, back = (tmp_path / name for name in ("made", "there", "back"))
    make(open_store(made), recipe(5, images=False))
    before, layer = content(made), recipe(5).layers[2]
    begin(open_store(made), recipe(5), {})
    put_shard(open_store(made), layer, 0, values(layer, 0))
    finish(open_store(made))
    publish(made, f"file:{there}")
    fetch(f"file:{made}", back)
    assert content(there) == content(back) == before


def test_a_server_that_refuses_what_is_not_there_is_read(made, tmp_path):
    def answer(request):
        known = (made / request.path.lstrip("/")).is_file()
        return give_files(lambda path: made / path)(request) if known else request.give(b"", 403)

    with serving(answer) as server:
        fetch(server.url, tmp_path / "back")
    assert content(tmp_path / "back") == content(made)


@pytest.mark.parametrize("name", ["notes.txt", "README.md"])
def test_a_folder_of_something_else_stays_as_it_is(name, made, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / name).write_text("mine")
    with pytest.raises(StoreError, match=f"holds {name}, and not this release"):
        fetch(f"file:{made}", tmp_path / "full")
    with pytest.raises(StoreError, match="choose an empty destination"):
        publish(made, f"file:{tmp_path / 'full'}")
    assert content(tmp_path / "full") == {name: b"mine"}


def test_a_folder_of_another_release_stays_as_it_is(made, tmp_path):
    with pytest.raises(StoreError, match="is the release itself"):
        fetch(f"file:{made}", made)
    make(open_store(tmp_path / "other"), recipe(2, name="other"))
    with pytest.raises(StoreError, match=r"holds other 1.0.0 \(.*\) and not hop 1.0.0"):
        fetch(f"file:{made}", tmp_path / "other")


def test_a_link_is_not_published(made, tmp_path):
    (tmp_path / "secret").write_text("mine")
    (made / "LICENSE").symlink_to(tmp_path / "secret")
    with pytest.raises(StoreError, match="LICENSE"):
        publish(made, f"file:{tmp_path / 'there'}")
    assert not any(b"mine" in data for data in content(tmp_path / "there").values())


def test_no_wrong_byte_is_taken(tmp_path):
    made = tmp_path / "made"
    make(open_store(made), recipe(2, ["none"]))
    for number, (name, data) in enumerate(content(made).items()):
        if name == MANIFEST:
            continue  # another manifest is another release
        path = made / name
        path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        found = [str(issue) for issue in wrong_files(made)]
        assert any(name in text for text in found), (name, found)
        if path.name != "zarr.json":  # which is written anew
            there, back = tmp_path / f"there{number}", tmp_path / f"back{number}"
            with pytest.raises(StoreError):
                publish(made, f"file:{there}")
            assert not (there / MANIFEST).exists()
            if name.startswith(RECORDS):  # the list says what is in it
                fetch(f"file:{made}", back)
                assert content(back)[name] == data
            else:
                with pytest.raises(StoreError):
                    fetch(f"file:{made}", back)
                assert not (back / MANIFEST).exists()
        path.write_bytes(data)
    assert not wrong_files(made)


def spoil(root, lost):
    """Change a byte of one file of a release, cut a second one and remove a third; the paths of the first two."""
    wrong, short = (f"hop/random.zarr/none/pixels/c/{number}/0/0/0/0" for number in range(2))
    (root / wrong).write_bytes((root / wrong).read_bytes()[:-1] + b"x")
    (root / short).write_bytes(b"half")
    (root / lost).unlink()
    return wrong, short


@pytest.mark.parametrize("hub", [False, True], ids=["folder", "hub"])
def test_what_was_damaged_or_lost_there_is_found_and_replaced(made, tmp_path, monkeypatch, hub):
    there = fake_hub(tmp_path / "hub", monkeypatch).folder if hub else tmp_path / "there"
    url, before = "hf://datasets/me/tiny" if hub else f"file:{there}", content(made)
    publish(made, url)
    lost = "hop/random.zarr/dynamic/pixels/c/0/0/0/0/0"
    wrong, short = spoil(there, lost)
    found = [str(issue) for issue in verify(url).findings]
    assert sum(short in text or lost in text for text in found) == 2
    assert any(wrong in str(issue) for issue in verify(url, everything=True).findings)
    with pytest.raises(StoreError, match="has 4 bytes instead of .*with repair"):
        publish(made, url)
    assert publish(made, url, repair=True).moved == 3 and content(there) == before
    assert verify(url, everything=True).sound


def test_a_fetch_finds_another_size_and_with_repair_another_digest(made, tmp_path):
    back, before = tmp_path / "back", content(made)
    fetch(f"file:{made}", back)
    wrong, _ = spoil(back, "records/hop/random/none/labels/00000.json")
    fetch(f"file:{made}", back)
    assert {path for path, data in content(back).items() if data != before[path]} == {wrong}
    fetch(f"file:{made}", back, repair=True)
    assert content(back) == before


def test_no_room_is_said_before_anything_comes(made, tmp_path, monkeypatch):
    monkeypatch.setattr(fetching, "free_bytes", lambda place: 10)
    with pytest.raises(StoreError, match="are needed and 10 B are free"):
        fetch(f"file:{made}", tmp_path / "back")
    assert content(tmp_path / "back") == {}
