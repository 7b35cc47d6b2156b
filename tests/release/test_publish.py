"""Publishing and fetching, against a real S3-protocol server on loopback, with faults in between."""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import re
import resource
import shutil
import signal
import threading

import numpy as np
import pytest
from click.testing import CliRunner

import dmcvb_gen
from dmcvb_gen.cli import main
from dmcvb_gen.dataset import open_release
from dmcvb_gen.dataset.index import CLAIM, INDEX, card_files, take_in_card
from dmcvb_gen.dataset.manifest import MANIFEST, commit_path
from dmcvb_gen.dataset.schema import EpisodeShape, array_specs
from dmcvb_gen.dataset.writer import finish_release
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.generate.recipe import expand, load_recipe, make_recipe
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.release.card import check_card, write_card
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.verify import verify
from dmcvb_gen.storage import base as storage
from dmcvb_gen.storage.hub import HubStorage
from dmcvb_gen.storage.local import LocalStorage
from dmcvb_gen.storage.remote import public, reason
from dmcvb_gen.tasks import get_task
from tests.conftest import roll_out, small_recipe
from tests.fake_hub import fake_hub
from tests.faults.proxy import Proxy

pytest.importorskip("s3fs")
ThreadedMotoServer = pytest.importorskip("moto.server").ThreadedMotoServer
SECRET = "shh-very-secret"
NAME = "walker-walk/random/dynamic"
CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "someone",
    "AWS_SECRET_ACCESS_KEY": SECRET,
    "AWS_DEFAULT_REGION": "us-east-1",
}


@pytest.fixture(scope="module")
def server():
    moto = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    moto.start()
    yield moto.get_host_and_port()
    moto.stop()


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A release of one subset in two shards."""
    pattern = {
        "tasks": "walker-walk",
        "levels": "random",
        "settings": "dynamic",
        "episodes": 2,
        "episodes_per_shard": 1,
    }
    folder = tmp_path_factory.mktemp("tiny") / "tiny"
    roll_out(small_recipe(name="tiny", subsets=[pattern]), folder)
    return folder


@pytest.fixture(scope="module")
def bucket(server, small_release):
    """The server's own file system, with the small release published in "bucket/small" for those who only read."""
    import s3fs

    with pytest.MonkeyPatch.context() as patch:
        for name, value in CREDENTIALS.items():
            patch.setenv(name, value)
        options = {"endpoint_url": "http://{}:{}".format(*server)}
        direct = s3fs.S3FileSystem(**options)
        direct.makedirs("bucket", exist_ok=True)  # all servers of one process share what is in them
        publish(small_release, "s3://bucket/small", options=options)
        yield direct


@pytest.fixture
def s3(server, bucket, monkeypatch):
    """A proxy before the server; credentials in the environment; nothing in "bucket/x"."""
    for name, value in CREDENTIALS.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(storage, "PAUSE", 0.01)
    bucket.invalidate_cache()
    if bucket.exists("bucket/x"):
        bucket.rm("bucket/x", recursive=True)
    proxy = Proxy(*server).start()
    proxy.direct, proxy.options = bucket, {"endpoint_url": proxy.url}
    yield proxy
    proxy.server.shutdown()


@pytest.fixture
def copy(tiny, tmp_path):
    shutil.copytree(tiny, tmp_path / "copy")
    return tmp_path / "copy"


def new_version(folder):
    finish_release(folder, open_release(folder).manifest.model_copy(update={"version": "1.0.1"}))


def test_a_round_trip_gives_the_same_release(s3, small_release, tmp_path):
    moved = fetch("s3://bucket/small", tmp_path / "back", options=s3.options)
    assert moved.files == moved.moved > 60
    back = open_release(tmp_path / "back")
    assert back.manifest == open_release(small_release).manifest and verify(tmp_path / "back").sound
    assert fetch("s3://bucket/small", tmp_path / "back", options=s3.options).moved == 0
    assert not s3.direct.exists(f"bucket/small/{CLAIM}")
    assert publish(small_release, "s3://bucket/small", options=s3.options).moved == 0


def test_the_manifest_comes_last(s3, tiny):
    publish(tiny, "s3://bucket/x", options=s3.options, workers=4)
    written = [path.removeprefix("/bucket/x/") for method, path, _ in s3.requests if method == "PUT"]
    assert written[0] == CLAIM and written[-2:] == [INDEX, "manifest.json"] and len(written) > 50


def test_a_part_moves_only_its_shards_verifies_and_can_be_completed(s3, small_release, tmp_path):
    part = tmp_path / "part"
    fetch("s3://bucket/small", part, ["*/*/dynamic"], (2, 3), options=s3.options)
    moved = {path.removeprefix("/bucket/small/") for method, path, _ in s3.requests if method == "GET"}
    shards = {path for path in moved if "/c/" in path}
    wanted = {file.path for file in open_release(small_release)[NAME].commits[1].files}
    assert shards == wanted and not any("static" in path or "none" in path for path in moved)
    release = dmcvb_gen.open(part)
    assert list(release.subsets) == [NAME] and list(release[NAME].episodes) == [2]
    assert verify(part).sound and Regeneration(part, [NAME], (2, 3)).check().sound
    assert not release.manifest.complete and release.manifest.lineage[0]["from"] == "s3://bucket/small"
    batch = next(release[NAME].batches(32))
    assert batch["pixels"].shape == (32, 9, 16, 16)
    fetch("s3://bucket/small", part, options=s3.options)
    assert open_release(part).manifest == open_release(small_release).manifest and verify(part).sound


def test_a_part_of_a_local_folder_names_no_place_of_this_machine(tiny, tmp_path):
    publish(tiny, f"file://{tmp_path}/there")
    for number, url in enumerate([f"file://{tmp_path}/there", str(tmp_path / "there")]):
        part = tmp_path / str(number)
        fetch(url, part, episodes=(0, 1))
        text = (part / "manifest.json").read_text()
        assert str(tmp_path) not in text and json.loads(text)["lineage"][0]["from"] == "tiny 1.0.0"
        (part / "manifest.json").write_text(text.replace("tiny 1.0.0", str(tmp_path / "there")))  # as before
        fetch(str(tmp_path / "there"), part, episodes=(0, 1))
        assert (part / "manifest.json").read_text() == text


def test_behavior_cloning_trains_on_a_fetched_part(s3, tmp_path):
    import torch

    from dmcvb_gen.agents.data import Slice, load_data
    from dmcvb_gen.agents.networks import observation_encoder
    from dmcvb_gen.agents.paper import BehaviorCloning
    from dmcvb_gen.agents.trainer import Budget, train

    fetch("s3://bucket/small", tmp_path / "part", ["*/*/static"], options=s3.options)
    assert verify(tmp_path / "part").sound
    torch.manual_seed(0)
    data = load_data(dmcvb_gen.open(tmp_path / "part"), [Slice("walker-walk/random/static")])
    learner = BehaviorCloning(observation_encoder(9, 16), data.sizes)
    curve = train(learner, data, Budget("short", batch_size=16), 20)
    assert np.isfinite(curve[-1]["loss"]) and 0 < curve[-1]["loss"] < 1  # random actions cannot be foretold


def test_a_remote_release_is_read_in_place(s3, small_release):
    release = dmcvb_gen.open("s3://bucket/small", s3.options)
    here = open_release(small_release)[NAME].episode(1)
    np.testing.assert_array_equal(release[NAME].episode(1, ["pixels", "action"])["pixels"], here["pixels"])
    np.testing.assert_array_equal(release[NAME].torch("steps")[500]["action"], here["action"][0])
    np.testing.assert_array_equal(release[NAME].xarray()["reward"].sel(episode=1).values[:500], here["reward"])


def test_an_interrupted_publication_is_no_release_and_goes_on(s3, tiny, tmp_path):
    count = iter(range(1000))
    s3.fault = lambda method, path: "403" if method == "PUT" and next(count) > 30 else None
    with pytest.raises(StoreError, match="refuses access"):
        publish(tiny, "s3://bucket/x", options=s3.options, workers=2)
    with pytest.raises(StoreError, match="holds no release"):
        fetch("s3://bucket/x", tmp_path / "r", options=s3.options)
    with pytest.raises(StoreError, match="holds no release"):
        dmcvb_gen.open("s3://bucket/x", s3.options)
    s3.fault, s3.requests[:] = (lambda method, path: None), []
    moved = publish(tiny, "s3://bucket/x", options=s3.options)
    assert 0 < moved.moved < moved.files - 20
    fetch("s3://bucket/x", tmp_path / "r", options=s3.options)
    assert verify(tmp_path / "r").sound


@pytest.mark.parametrize("kind", ["cut", "corrupt", "drop", "500"])
def test_a_fault_on_the_way_here_is_noticed_and_mended(s3, small_release, tmp_path, kind):
    pixels = next(file.path for file in open_release(small_release)[NAME].commits[0].files if "/pixels/" in file.path)
    seen = []

    def fault(method, path):
        if method == "GET" and path.endswith(pixels) and len(seen) < 2:
            seen.append(path)
            return kind
        return None

    s3.fault = fault
    fetch("s3://bucket/small", tmp_path / "r", [NAME], (0, 1), options=s3.options)
    assert len(seen) == 2 and verify(tmp_path / "r").sound


def test_wrong_bytes_at_the_source_are_refused(s3, tiny, tmp_path):
    publish(tiny, "s3://bucket/x", options=s3.options)
    pixels = next(file.path for file in open_release(tiny)[NAME].commits[0].files if "/pixels/" in file.path)
    data = s3.direct.cat_file(f"bucket/x/{pixels}")
    s3.direct.pipe_file(f"bucket/x/{pixels}", data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(StoreError, match="does not have its digest"):
        fetch("s3://bucket/x", tmp_path / "r", options=s3.options)
    assert not (tmp_path / "r" / pixels).exists() and not (tmp_path / "r" / commit_path(NAME, 0)).exists()
    s3.direct.pipe_file(f"bucket/x/{pixels}", data)
    fetch("s3://bucket/x", tmp_path / "r", options=s3.options)
    assert verify(tmp_path / "r").sound


def test_a_download_goes_on_after_its_last_whole_piece(s3, tmp_path, small_release, monkeypatch):
    monkeypatch.setattr(storage, "PIECE", 20_000)
    record = max(open_release(small_release)[NAME].commits[0].files, key=lambda file: file.bytes)
    assert record.bytes > 60_000
    asked = []

    def fault(method, path):
        if method == "GET" and path.endswith(record.path):
            asked.append(path)
            return "403" if len(asked) == 3 else None
        return None

    s3.fault = fault
    with pytest.raises(StoreError, match="refuses access"):
        fetch("s3://bucket/small", tmp_path / "r", [NAME], (0, 1), options=s3.options)
    s3.requests.clear()
    fetch("s3://bucket/small", tmp_path / "r", [NAME], (0, 1), options=s3.options)
    ranges = [r for method, path, r in s3.requests if method == "GET" and path.endswith(record.path)]
    assert ranges[0].startswith("bytes=40000-") and verify(tmp_path / "r").sound


def test_wrong_credentials_are_said_without_the_secret(s3, tiny, caplog):
    caplog.set_level(logging.DEBUG)
    s3.fault = lambda method, path: "403"
    arguments = ["publish", str(tiny), "s3://bucket/x", "--option", f"endpoint_url={s3.url}"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2 and "credentials" in result.output
    ours = [record.getMessage() for record in caplog.records if record.name.startswith("dmcvb_gen")]
    assert SECRET not in result.output and not any(SECRET in message for message in ours)


def test_no_secret_is_written_anywhere(s3, tmp_path):
    fetch("s3://bucket/small", tmp_path / "r", [NAME], options=s3.options)
    for path in ["manifest.json", INDEX]:
        assert SECRET.encode() not in s3.direct.cat_file(f"bucket/small/{path}")
    assert SECRET not in (tmp_path / "r/manifest.json").read_text()
    assert public(f"https://me:{SECRET}@host/x?sig={SECRET}") == "https://host/x"
    assert SECRET not in reason(ValueError(f"denied: secret_key={SECRET}, url s3://me:{SECRET}@bucket"))
    result = CliRunner().invoke(main, ["fetch", "s3://bucket/small", "--out", "x", "--option", f"secret={SECRET}"])
    assert result.exit_code == 2 and "environment" in result.output and SECRET not in result.output


def test_a_published_version_is_never_overwritten(s3, copy):
    new_version(copy)
    before = s3.direct.cat_file("bucket/small/manifest.json")
    with pytest.raises(StoreError, match=r"already holds small 1\.0\.0.*publish tiny 1\.0\.1 to another URL"):
        publish(copy, "s3://bucket/small", options=s3.options)
    assert s3.direct.cat_file("bucket/small/manifest.json") == before


def test_of_two_publishers_one_is_told(s3, tiny, copy):
    new_version(copy)
    s3.fault = lambda method, path: "403" if method == "PUT" and "/state/" in path else None
    with pytest.raises(StoreError, match="refuses access"):
        publish(tiny, "s3://bucket/x", options=s3.options)
    s3.fault = lambda method, path: None
    with pytest.raises(StoreError, match=r"tiny 1\.0\.0 is being published.*--take-over"):
        publish(copy, "s3://bucket/x", options=s3.options)
    publish(copy, "s3://bucket/x", options=s3.options, take_over=True)
    assert json.loads(s3.direct.cat_file("bucket/x/manifest.json"))["version"] == "1.0.1"


def test_two_publishers_at_once_leave_one_whole_release(s3, tiny, copy, tmp_path):
    new_version(copy)
    results = {}

    def run(name, folder):
        try:
            results[name] = publish(folder, "s3://bucket/x", options=s3.options, workers=2)
        except StoreError as error:
            results[name] = error

    threads = [threading.Thread(target=run, args=item) for item in (("a", tiny), ("b", copy))]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert sorted(type(result).__name__ for result in results.values()) == ["Moved", "StoreError"]
    fetch("s3://bucket/x", tmp_path / "r", options=s3.options)
    assert verify(tmp_path / "r").sound


def test_a_card_goes_up_with_its_release_and_one_of_another_version_does_not(copy, tmp_path):
    there = tmp_path / "there"
    publish(copy, f"file:{there}")
    assert not (there / "README.md").exists()
    write_card(copy)
    assert publish(copy, f"file:{there}").moved == len(card_files(copy)) > 3
    assert publish(copy, f"file:{there}").moved == 0
    assert (there / "README.md").read_bytes() == (copy / "README.md").read_bytes()
    fetch(f"file:{there}", tmp_path / "back")
    assert check_card(tmp_path / "back") == [] and verify(tmp_path / "back").sound
    text = (copy / "README.md").read_text()
    (copy / "README.md").write_text("a card of before")
    take_in_card(copy)
    with pytest.raises(StoreError, match="is of another version; run `dmcvb-gen card"):
        publish(copy, f"file:{tmp_path / 'elsewhere'}")
    (copy / "README.md").write_text(f"{text}more")
    with pytest.raises(StoreError, match="README.md does not have its digest; run `dmcvb-gen card "):
        publish(copy, f"file:{tmp_path / 'elsewhere'}")


def test_a_plain_folder_is_a_target_too(tiny, tmp_path):
    url = f"file://{tmp_path}/there"
    assert publish(tiny, url).moved > 50 and publish(tiny, url).moved == 0
    (tmp_path / "there/manifest.json").unlink()
    pixels = next(file.path for file in open_release(tiny)[NAME].commits[0].files if "/pixels/" in file.path)
    (tmp_path / "there" / pixels).write_bytes(b"half")
    assert publish(tiny, url).moved == 1
    assert verify(tmp_path / "there").sound
    fetch(url, tmp_path / "back", [NAME])
    assert verify(tmp_path / "back").sound


def test_files_of_something_else_are_not_replaced(s3, copy, tmp_path):
    write_card(copy)
    (tmp_path / "there").mkdir()
    (tmp_path / "there/README.md").write_text("mine")
    with pytest.raises(StoreError, match="holds README.md, and no release; give an empty or a new place"):
        publish(copy, f"file:{tmp_path / 'there'}")
    assert [path.name for path in (tmp_path / "there").iterdir()] == ["README.md"]
    s3.direct.pipe_file("bucket/x/data/notes.txt", b"mine")
    with pytest.raises(StoreError, match="holds data/notes.txt, and no release"):
        publish(copy, "s3://bucket/x", options=s3.options)
    s3.direct.invalidate_cache()
    assert s3.direct.find("bucket/x") == ["bucket/x/data/notes.txt"]


def test_a_leftover_claim_does_not_block_later_publications(tiny, tmp_path, monkeypatch):
    there, url = tmp_path / "there", f"file:{tmp_path / 'there'}"
    with monkeypatch.context() as patch:
        patch.setattr(LocalStorage, "_remove", lambda *_: (_ for _ in ()).throw(OSError(5, "broken")))
        with pytest.raises(StoreError):
            publish(tiny, url)
    assert (there / CLAIM).exists() and (there / "manifest.json").exists()
    shutil.copytree(there, tmp_path / "other")
    publish(tiny, url)
    assert not (there / CLAIM).exists() and verify(there).sound
    shutil.copytree(tiny, tmp_path / "grown")
    recipe = open_release(tiny).manifest.recipe
    roll_out(
        make_recipe(recipe | {"subsets": [one | {"episodes": 4} for one in recipe["subsets"]]}), tmp_path / "grown"
    )
    publish(tmp_path / "grown", f"file:{tmp_path / 'other'}")
    assert not (tmp_path / "other" / CLAIM).exists() and verify(tmp_path / "other").sound


def test_a_card_that_is_not_listed_does_not_stay_behind_silently(copy, tmp_path):
    (copy / "README.md").write_text("a card that was never finished")
    with pytest.raises(StoreError, match="README.md is not part of the release yet; run `dmcvb-gen card"):
        publish(copy, f"file:{tmp_path / 'there'}")


def test_files_that_were_damaged_where_they_are_are_replaced_with_repair(s3, tiny, tmp_path):
    there, invoke = tmp_path / "there", CliRunner().invoke
    url = f"file://{there}"
    publish(tiny, url)
    pixels = next(file.path for file in open_release(tiny)[NAME].commits[0].files if "/pixels/" in file.path)
    data = (there / pixels).read_bytes()
    (there / pixels).write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    result = invoke(main, ["verify", url, "--all"])
    assert result.exit_code == 1 and f"`dmcvb-gen publish FOLDER {url} --repair`" in result.output, result.output
    assert publish(tiny, url).moved == 0, "sizes are right"
    result = invoke(main, ["publish", str(tiny), url, "--repair", "--json"])
    assert result.exit_code == 0 and json.loads(result.output)["moved"] == 1, result.output
    assert invoke(main, ["verify", url, "--all"]).exit_code == 0 and (there / pixels).read_bytes() == data
    publish(tiny, "s3://bucket/x", options=s3.options)
    s3.direct.pipe_file(f"bucket/x/{pixels}", bytes(len(data)))
    assert publish(tiny, "s3://bucket/x", options=s3.options, repair=True).moved == 1
    s3.direct.invalidate_cache()
    assert s3.direct.cat_file(f"bucket/x/{pixels}") == data


def test_a_damaged_or_unfinished_release_is_not_s3(copy, tmp_path):
    url = f"file://{tmp_path}/there"
    pixels = next(file.path for file in open_release(copy)[NAME].commits[0].files if "/pixels/" in file.path)
    data = bytearray((copy / pixels).read_bytes())
    data[50] ^= 1
    (copy / pixels).write_bytes(data)
    with pytest.raises(StoreError, match="dmcvb-gen regenerate"):
        publish(copy, url)
    (copy / "commits" / NAME / "00000.json").unlink()
    with pytest.raises(StoreError, match="damaged or missing shards"):
        publish(copy, url)
    manifest = json.loads((copy / "manifest.json").read_text()) | {"complete": False}
    (copy / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(StoreError, match="not complete"):
        publish(copy, url)
    assert not (tmp_path / "there/manifest.json").exists()


def rewrite(folder, change):
    """Change a published folder as a hostile hand would: digests of the index and manifest fit again."""
    index = json.loads((folder / INDEX).read_text())
    change(index, folder)
    for file in index["files"]:
        path = folder / file["path"]
        if path.is_file():
            file |= {"bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    index["manifest_sha256"] = hashlib.sha256((folder / "manifest.json").read_bytes()).hexdigest()
    index["sha256"] = hashlib.sha256((json.dumps(index | {"sha256": None}, indent=1) + "\n").encode()).hexdigest()
    (folder / INDEX).write_text(json.dumps(index, indent=1) + "\n")


def leave_the_folder(index, folder):
    index["files"].append({"path": "../../evil", "bytes": 1, "sha256": "0" * 64})


def name_the_manifest(index, folder):
    path = folder / "commits" / NAME / "00000.json"
    commit = json.loads(path.read_text())
    commit["files"][0]["path"] = "manifest.json"
    path.write_text(json.dumps(commit))


def climb_in_the_manifest(index, folder):
    text = (folder / "manifest.json").read_text().replace(NAME, "../../../evil", 1)
    (folder / "manifest.json").write_text(text)


def climb_in_the_version(index, folder):
    data = json.loads((folder / "manifest.json").read_text()) | {"version": "../../evil"}
    (folder / "manifest.json").write_text(json.dumps(data))


def climb_in_a_view(index, folder):
    data = json.loads((folder / "manifest.json").read_text())
    data["subsets"][0]["views"] = ["top", "../../evil"]
    (folder / "manifest.json").write_text(json.dumps(data))


def be_from_the_future(index, folder):
    data = json.loads((folder / "manifest.json").read_text()) | {"schema_version": 99}
    (folder / "manifest.json").write_text(json.dumps(data))


@pytest.mark.parametrize(
    "change, words",
    [
        (leave_the_folder, "not a plain relative path"),
        (name_the_manifest, "names files outside"),
        (climb_in_the_manifest, "not a plain relative path"),
        (climb_in_the_version, "version"),
        (climb_in_a_view, "views"),
        (be_from_the_future, "install a newer dmcvb-gen"),
    ],
)
def test_hostile_or_newer_releases_are_refused_and_write_nothing_outside(tiny, tmp_path, change, words):
    publish(tiny, f"file://{tmp_path}/there")
    rewrite(tmp_path / "there", change)
    with pytest.raises(StoreError, match=words):
        fetch(f"file://{tmp_path}/there", tmp_path / "deep/down/r")
    outside = {p.name for p in tmp_path.rglob("*") if p.is_file() and "there" not in p.parts}
    assert not outside - {"manifest.json", ".lock"} and not list((tmp_path / "deep").rglob("commits/**/*.json"))


def test_bad_requests_say_what_to_do(s3, tmp_path, small_release):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/thesis.tex").write_text("years of work")
    with pytest.raises(StoreError, match="not empty"):
        fetch("s3://bucket/small", tmp_path / "thesis", options=s3.options)
    with pytest.raises(UnknownNameError, match="walker-walk/random/none"):
        fetch("s3://bucket/small", tmp_path / "r", ["walker-fly"], options=s3.options)
    with pytest.raises(StoreError, match="no subset has episodes"):
        fetch("s3://bucket/small", tmp_path / "r", episodes=(100, 150), options=s3.options)
    with pytest.raises(StoreError, match="create the bucket"):
        publish(small_release, "s3://no-such-bucket/x", options=s3.options)
    result = CliRunner().invoke(main, ["fetch", "s3://bucket/small", "--episodes", "5:2", "--out", "x"])
    assert result.exit_code == 2 and "--episodes" in result.output
    assert not (tmp_path / "r").exists() or not re.search("json", str(list((tmp_path / "r").iterdir())))


def test_a_full_disk_is_said_and_what_came_stays(s3, tmp_path, small_release):
    largest = max(file.bytes for file in open_release(small_release)[NAME].commits[0].files)
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest - 1000, limit[1]))
        with pytest.raises(StoreError, match="make room and rerun the command"):
            fetch("s3://bucket/small", tmp_path / "r", [NAME], options=s3.options, workers=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)
    fetch("s3://bucket/small", tmp_path / "r", [NAME], options=s3.options)
    assert verify(tmp_path / "r").sound


def test_the_hub_gets_the_manifest_in_the_last_commit_and_goes_on_after_a_cut(tiny, copy, monkeypatch, tmp_path):
    monkeypatch.setattr("dmcvb_gen.storage.hub.BATCH", 20)
    hub, url = fake_hub(tmp_path / "hub", monkeypatch), "hf://datasets/me/tiny"
    hub.fail = 1
    with pytest.raises(StoreError, match="rerun the same command") as caught:
        publish(tiny, url)
    assert "hf_secret123" not in str(caught.value) and MANIFEST not in hub.files
    hub.fail = None
    moved = publish(tiny, url)
    assert moved.moved == moved.files - 20
    assert hub.commits[-1] == [INDEX, MANIFEST] and max(map(len, hub.commits)) == 20
    assert verify(hub.folder).sound
    head = str(len(hub.commits))
    assert publish(tiny, url).moved == 0 and hub.tags == {"v1.0.0": head} and len(hub.commits) == int(head)
    finish_release(copy, open_release(copy).manifest.model_copy(update={"version": "0.9.0"}))
    with pytest.raises(StoreError, match="never changes"):
        publish(copy, url)
    with pytest.raises(StoreError, match="hf://datasets/OWNER/NAME"):
        publish(tiny, "hf://models/x")
    with pytest.raises(StoreError, match="newest"):
        publish(tiny, "hf://datasets/me/x@v1")


def test_of_two_publishers_to_the_hub_one_is_told(tiny, monkeypatch, tmp_path):
    hub, url = fake_hub(tmp_path / "hub", monkeypatch), "hf://datasets/me/tiny"
    upload_all = HubStorage.upload_all

    def another_between(self, *arguments, **options):
        moved = upload_all(self, *arguments, **options)
        hub.create_commit("me/tiny", [], "of another", "dataset", str(len(hub.commits)))
        return moved

    with (
        monkeypatch.context() as patch,
        pytest.raises(StoreError, match="a commit has happened since.* rerun the same"),
    ):
        patch.setattr(HubStorage, "upload_all", another_between)
        publish(tiny, url)
    assert MANIFEST not in hub.files
    publish(tiny, url)
    assert verify(hub.folder).sound


def test_a_card_that_is_new_goes_to_the_hub_too(copy, monkeypatch, tmp_path):
    hub, url = fake_hub(tmp_path / "hub", monkeypatch), "hf://datasets/me/tiny"
    publish(copy, url)
    write_card(copy)
    assert publish(copy, url).moved == len(card_files(copy))
    assert hub.files["README.md"] == (copy / "README.md").read_bytes() and hub.commits[-1] == [INDEX]
    assert json.loads(hub.files[INDEX]) == json.loads((copy / INDEX).read_text())
    assert publish(copy, url).moved == 0
    (copy / "README.md").write_text("by hand")
    with pytest.raises(StoreError, match="README.md does not have its digest; run `dmcvb-gen card"):
        publish(copy, url)


def test_a_damaged_index_is_put_there_again(copy, tmp_path):
    publish(copy, f"file:{tmp_path / 'there'}")
    (tmp_path / "there" / INDEX).write_text("{")
    publish(copy, f"file:{tmp_path / 'there'}")
    assert json.loads((tmp_path / "there" / INDEX).read_text()) == json.loads((copy / INDEX).read_text())


def test_shards_come_from_the_hub_through_its_own_client(tiny, tmp_path, monkeypatch):
    hub = fake_hub(tmp_path / "hub", monkeypatch)
    shutil.copytree(tiny, hub.folder / "data")
    url, files = "hf://datasets/me/tiny@v1.0.0/data", open_release(tiny)[NAME].commits

    def asked():
        assert {revision for _, revision in hub.asked} == {"v1.0.0"}
        paths = {path for path, _ in hub.asked if "/c/" in path}
        hub.asked.clear()
        return paths

    moved = fetch(url, tmp_path / "r", episodes=(1, 2))
    assert asked() == {f"data/{file.path}" for file in files[1].files}  # of that shard, all and no others
    assert moved.moved == moved.files and not list((tmp_path / "r").glob(".hub*"))
    fetch(url, tmp_path / "r")
    assert asked() == {f"data/{file.path}" for file in files[0].files}
    assert open_release(tmp_path / "r").manifest == open_release(tiny).manifest and verify(tmp_path / "r").sound


def test_a_grown_release_adds_to_its_repository(tmp_path, monkeypatch):
    pattern = {"tasks": "walker-walk", "levels": "random", "episodes": 1, "max_steps": 3}
    hub, versions, before = fake_hub(tmp_path / "hub", monkeypatch), [], 0
    for settings in (["none"], ["none", "static"]):
        roll_out(small_recipe(name="grows", subsets=[pattern | {"settings": settings}]), tmp_path / "r")
        before = len(hub.commits)
        publish(tmp_path / "r", "hf://datasets/me/tiny")
        versions.append(open_release(tmp_path / "r").manifest.version)
    assert versions == ["1.0.0", "1.1.0"] and list(hub.tags) == ["v1.0.0", "v1.1.0"]
    assert not any("none.zarr" in path for commit in hub.commits[before:] for path in commit)
    assert verify(hub.folder).sound


def test_the_whole_release_has_fewer_files_than_the_hub_takes(small_release, small_mazes):
    def files_of(name, shards, specs):
        groups, commits = 2, 1
        return len(specs) + groups + shards * (len(specs) + commits)

    for folder in (small_release, small_mazes):  # counted as they are there
        for name, subset in open_release(folder).subsets.items():
            specs = array_specs(EpisodeShape.of(get_task(subset.task)), 64)
            there = [*(folder / f"{name}.zarr").rglob("*"), *(folder / "commits" / name).rglob("*")]
            count = sum(path.is_file() and path.name != ".created" for path in there)
            assert count <= files_of(name, len(subset.commits), specs) <= count + 8 * len(subset.commits)
    total = 0
    for request in expand(load_recipe("dmcvb-v1")):
        specs = array_specs(EpisodeShape.of(get_task(request.task)), 64)
        total += files_of(request.name, -(-request.episodes // request.episodes_per_shard), specs)
    assert 50_000 < total < 70_000


def test_no_room_for_the_manifest_is_one_line_and_leaves_none(tiny, tmp_path, monkeypatch):
    link = os.link

    def full(made, path):
        if str(path).endswith("manifest.json"):
            raise OSError(errno.ENOSPC, "No space left on device")
        link(made, path)

    url = f"file://{tmp_path}/there"
    with monkeypatch.context() as patch, pytest.raises(StoreError, match="no room for manifest.json"):
        patch.setattr(os, "link", full)
        publish(tiny, url)
    assert not list((tmp_path / "there").glob("*manifest.json*"))
    publish(tiny, url)
    assert open_release(url).manifest.complete and not list((tmp_path / "there").rglob("*.partial"))


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_whoever_stops_while_files_move_stops_the_rest(error):
    begun = []

    def work(item):
        begun.append(item)
        threading.Event().wait(0.01)

    def tick(_):
        raise error

    with pytest.raises(error):
        storage.in_parallel(work, range(2000), 2, tick)
    assert len(begun) < 1000


@pytest.mark.parametrize("complete", [True, False])
def test_a_record_that_cannot_be_read_is_no_missing_shard(tiny, tmp_path, monkeypatch, complete):
    from fsspec.implementations.local import LocalFileSystem

    url = f"file://{tmp_path}/there"
    publish(tiny, url)
    if not complete:
        rewrite(tmp_path / "there", lambda index, folder: incomplete(folder))
    real, wanted = LocalFileSystem.cat_file, commit_path(NAME, 0)

    fault = {}

    def cat_file(self, path, **options):
        if path.endswith(wanted):
            raise fault["raised"]
        return real(self, path, **options)

    monkeypatch.setattr(LocalFileSystem, "cat_file", cat_file)
    for fault["raised"], found in ((TimeoutError("slow"), False), (PermissionError("403"), not complete)):
        if found:
            assert 0 not in open_release(url)[NAME].commits
        else:
            with pytest.raises(StoreError):
                open_release(url)
    fault["raised"] = FileNotFoundError("none")
    assert 0 not in open_release(url)[NAME].commits


def incomplete(folder):
    data = json.loads((folder / "manifest.json").read_text()) | {"complete": False}
    (folder / "manifest.json").write_text(json.dumps(data))
