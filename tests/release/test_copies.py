"""Fetch, publish and verify of releases of made-up values, on folders; no simulator is needed."""

from __future__ import annotations

import shutil

import pytest

from dmcvb_gen.dataset3.gate import Release
from dmcvb_gen.dataset3.manifest import COPY
from dmcvb_gen.errors import StoreError
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.verify import check_files, verify_url
from dmcvb_gen.storage.store import open_store
from tests.dataset3.made_up import make, recipe


def content(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def made(tmp_path):
    """A release of two subsets that share their trajectories, in three shards each."""
    make(open_store(tmp_path / "made"), recipe(5))
    return tmp_path / "made"


def test_a_release_comes_back_as_it_went(made, tmp_path):
    url, back = f"file:{tmp_path / 'there'}", tmp_path / "back"
    (made / "LICENSE").write_text("mine")
    assert publish(made, url).moved and publish(made, url).moved == 0
    assert content(tmp_path / "there") == content(made)
    assert fetch(url, back).moved and fetch(url, back).moved == 0
    assert content(back) == content(made) and not check_files(back)
    found = verify_url(url, everything=True)
    assert found.sound and found.complete and found.digest == Release.open(made).digest


def test_a_part_is_a_copy_that_can_be_completed(made, tmp_path):
    url, part, digest = f"file:{made}", tmp_path / "part", Release.open(made).digest
    fetch(url, part, ["*/none"], (2, 3))
    release = Release.open(part, digest=digest)
    assert release.shortfalls == {"hop/random/dynamic": (0, 5), "hop/random/none": (2, 5)}
    assert release["hop/random/none"].episodes.tolist() == [2, 3] and not check_files(part)
    fetch(url, part)
    assert content(part) == content(made)


def test_without_images_it_is_a_copy_of_the_same_digest(made, tmp_path):
    url, back = f"file:{tmp_path / 'there'}", tmp_path / "back"
    publish(made, url, pixels=False)
    assert (tmp_path / "there" / COPY).is_file() and not list((tmp_path / "there").rglob("pixels/c"))
    fetch(url, back)
    light = Release.open(back)
    assert light.digest == Release.open(made).digest and light["hop/random/none"].unpainted.all()
    assert not check_files(back) and verify_url(url).sound and not light.shortfalls
    with pytest.raises(StoreError, match="is not complete"):
        publish(back, f"file:{tmp_path / 'x'}")
    assert publish(back, f"file:{tmp_path / 'x'}", pixels=False).moved


def test_a_grown_release_takes_the_place_of_the_older(made, tmp_path):
    url, back = f"file:{tmp_path / 'there'}", tmp_path / "back"
    publish(made, url)
    fetch(url, back)
    shutil.copytree(made, tmp_path / "old")
    make(open_store(made), recipe(8))
    publish(made, url)
    fetch(url, back)
    assert Release.open(back)["hop/random/none"].record.episodes == 8 and not check_files(back)
    with pytest.raises(StoreError, match="already holds hop 1.0.0"):
        publish(tmp_path / "old", url)
    with pytest.raises(StoreError, match="and not the hop 1.0.0"):
        fetch(f"file:{tmp_path / 'old'}", back)


def test_what_is_no_part_of_it_stays_as_it_is(made, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/notes.txt").write_text("mine")
    with pytest.raises(StoreError, match="is not empty and holds no release"):
        fetch(f"file:{made}", tmp_path / "full")
    with pytest.raises(StoreError, match="holds notes.txt, and no release; choose an empty destination"):
        publish(made, f"file:{tmp_path / 'full'}")
    with pytest.raises(StoreError, match="is the release itself"):
        fetch(f"file:{made}", made)
    assert content(tmp_path / "full") == {"notes.txt": b"mine"}


def test_no_wrong_byte_is_taken(made, tmp_path):
    for number, (name, data) in enumerate(content(made).items()):
        if name == "manifest.json" or name.startswith("."):
            continue  # another manifest is another release
        path = made / name
        path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        found = [str(issue) for issue in check_files(made)]
        assert any(name in text for text in found), (name, found)
        if path.name != "zarr.json":  # which is written anew
            with pytest.raises(StoreError):
                publish(made, f"file:{tmp_path / str(number)}")
            assert not (tmp_path / str(number) / "manifest.json").exists()
        path.write_bytes(data)
    assert not check_files(made)
