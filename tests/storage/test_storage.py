"""What every storage does, whatever is behind it; a new implementation adds a class with a fixture."""

from __future__ import annotations

import errno
import functools
import http.server
import pickle
import subprocess
import sys
import threading
import uuid

import pytest

import dmcvb_gen
from dmcvb_gen import files
from dmcvb_gen.dataset.manifest import FileRecord
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_bytes
from dmcvb_gen.storage import base, open_storage
from tests.fake_hub import fake_hub


def record(path, data):
    return FileRecord(path=path, bytes=len(data), sha256=sha256_bytes(data))


class StorageTests:
    """Inherit, and give a fixture `storage`: an empty one, somewhere."""

    PATHS = ["manifest.json", "a/b.zarr/pixels/c/0/0/0"]
    WRITERS = 4

    @pytest.fixture(autouse=True)
    def at_once(self, monkeypatch):
        monkeypatch.setattr(base, "PAUSE", 0.001)

    @pytest.fixture
    def local(self, tmp_path):
        """A folder with a file for each path, and the files' records."""
        records = []
        for number, path in enumerate(self.PATHS):
            data = bytes([number]) * (1000 + number)
            (tmp_path / "local" / path).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "local" / path).write_bytes(data)
            records.append(record(path, data))
        return tmp_path / "local", records

    def test_nothing_is_there_at_first(self, storage):
        assert storage.list() == {} and storage.read("a/b") is None and storage.size("a/b") is None
        storage.remove("a/b")

    @pytest.mark.parametrize("path", PATHS)
    def test_what_is_written_is_read_listed_replaced_and_removed(self, storage, path):
        for data in (b"one", b"three", b""):
            storage.write(path, data)
            assert storage.read(path) == data and storage.size(path) == len(data)
            assert {name: file.bytes for name, file in storage.list().items()} == {path: len(data)}
        storage.remove(path)
        assert storage.read(path) is None and storage.size(path) is None and storage.list() == {}

    def test_hidden_files_can_be_read_and_are_not_listed(self, storage):
        for path in (".lock", "a/.b/c"):
            storage.write(path, b"x")
            assert storage.read(path) == b"x"
        assert storage.list() == {}

    def test_a_file_is_created_once(self, storage):
        assert storage.create("a/claim", b"mine") and not storage.create("a/claim", b"yours")
        assert storage.read("a/claim") == b"mine"
        storage.remove("a/claim")
        assert storage.create("a/claim", b"yours") and storage.read("a/claim") == b"yours"

    def test_of_many_who_create_a_file_at_once_one_does(self, storage):
        start, won = threading.Barrier(self.WRITERS), []

        def create(name):
            start.wait()
            if storage.create("claim", name):
                won.append(name)

        threads = [threading.Thread(target=create, args=[bytes([number])]) for number in range(self.WRITERS)]
        [thread.start() for thread in threads]
        [thread.join() for thread in threads]
        assert len(won) == 1 and storage.read("claim") == won[0]

    def test_other_bytes_than_the_digest_says_are_not_given(self, storage):
        storage.write("a", b"true")
        assert storage.read("a", sha256_bytes(b"true")) == b"true"
        with pytest.raises(StoreError, match="cannot read a of .* does not have its digest"):
            storage.read("a", sha256_bytes(b"false"))

    def test_files_go_up_and_come_back_once(self, storage, local, tmp_path, monkeypatch):
        monkeypatch.setattr(base, "PIECE", 300)
        folder, records = local
        told = []
        storage.begin()
        assert storage.upload_all(folder, records, 2, told.append) == len(records) == sum(told)
        assert storage.upload_all(folder, records, 2) == 0
        assert [storage.upload(folder, file) for file in records] == [False] * len(records)
        assert {path: file.bytes for path, file in storage.list().items()} == {f.path: f.bytes for f in records}
        for file in records:
            assert storage.sha256(file) == file.sha256
            assert storage.download(file, tmp_path / "back") and not storage.download(file, tmp_path / "back")
            assert (tmp_path / "back" / file.path).read_bytes() == (folder / file.path).read_bytes()
        storage.tidy(tmp_path / "back")
        assert {path.name for path in (tmp_path / "back").rglob("*") if path.is_file()} == {"manifest.json", "0"}

    def test_other_bytes_of_the_same_size_are_replaced(self, storage, local):
        folder, [file, _] = local
        storage.write(file.path, b"x" * file.bytes)
        assert storage.upload(folder, file) and storage.sha256(file) == file.sha256

    def test_a_local_file_without_its_digest_stays_here(self, storage, local):
        folder, [file, _] = local
        (folder / file.path).write_bytes(b"x" * file.bytes)
        storage.begin()
        for upload in (lambda: storage.upload(folder, file), lambda: storage.upload_all(folder, [file], 1)):
            with pytest.raises(StoreError, match="does not have its digest; run `dmcvb-gen regenerate`"):
                upload()
        assert storage.list() == {}

    @pytest.mark.parametrize("data", [b"x" * 1000, b"short", b"x" * 2000])
    def test_what_arrives_with_other_bytes_is_not_kept(self, storage, tmp_path, data):
        storage.write("a/b", data)
        with pytest.raises(StoreError, match="cannot move a/b of .* rerun the same command"):
            storage.download(record("a/b", b"y" * 1000), tmp_path)
        assert not (tmp_path / "a/b").exists()

    def test_a_download_without_a_file_is_one_line(self, storage, tmp_path):
        for work in (storage.sha256, lambda file: storage.download(file, tmp_path)):
            with pytest.raises(StoreError) as caught:
                work(record("a/b", b"y" * 10))
            assert "a/b" in str(caught.value) and "\n" not in str(caught.value)

    def test_the_last_file_of_a_release_can_be_the_first_of_its_name(self, storage):
        storage.begin()
        assert storage.write_last({"files.json": b"1", "manifest.json": b"2"}, new=True)
        assert storage.write_last({"files.json": b"3", "manifest.json": b"4"})
        assert storage.read("manifest.json") == b"4"
        if storage.needs_claim:
            assert not storage.write_last({"files.json": b"5", "manifest.json": b"6"}, new=True)
            assert storage.read("manifest.json") == b"4" and storage.read("files.json") == b"3"
        storage.tag("v1.0.0", "the first version")

    def test_it_travels_to_workers_and_equals_itself(self, storage):
        storage.write("a", b"1")
        other = pickle.loads(pickle.dumps(storage))
        assert other == storage and hash(other) == hash(storage) and other.read("a") == b"1"
        assert "secret" not in repr(storage) and "secret" not in storage.place


class TestFolder(StorageTests):
    @pytest.fixture
    def storage(self, tmp_path):
        return open_storage(tmp_path / "r")

    def test_no_room_leaves_what_was_there(self, storage, monkeypatch):
        def full(handle):
            raise OSError(errno.ENOSPC, "No space left on device")

        storage.write("a", b"1")
        with monkeypatch.context() as patch, pytest.raises(StoreError, match="no room to write to .*make room"):
            patch.setattr("os.fsync", full)
            storage.write("a", b"2")
        assert storage.read("a") == b"1" and [path.name for path in storage.folder.iterdir()] == ["a"]

    @pytest.mark.parametrize("sent", [True, False])
    def test_what_a_killed_process_left_beside_a_file_goes_and_what_a_running_one_makes_stays(
        self, storage, tmp_path, sent
    ):
        code = "import os, sys; from dmcvb_gen import files\nwith files.replacing(sys.argv[1]): os.kill(os.getpid(), 9)"
        subprocess.run([sys.executable, "-c", code, str(storage.folder / "a/b")])
        (tmp_path / "a").mkdir()
        (tmp_path / "a/b").write_bytes(b"1")
        assert len(list((storage.folder / "a").iterdir())) == 1
        with files.replacing(storage.folder / "a/c") as temporary:
            storage.upload(tmp_path, record("a/b", b"1")) if sent else storage.write("a/b", b"1")
            assert set((storage.folder / "a").iterdir()) == {storage.folder / "a/b", temporary}


class TestFileUrl(StorageTests):
    @pytest.fixture
    def storage(self, tmp_path):
        return open_storage(f"file://{tmp_path}/r")


class TestMemory(StorageTests):
    @pytest.fixture
    def storage(self):
        return open_storage(f"memory://{uuid.uuid4().hex}/r")

    WRITERS = 1  # fsspec looks and writes in two steps


class TestS3(StorageTests):
    @pytest.fixture(scope="class")
    def server(self):
        pytest.importorskip("s3fs")
        moto = pytest.importorskip("moto.server").ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        moto.start()
        yield "http://{}:{}".format(*moto.get_host_and_port())
        moto.stop()

    @pytest.fixture
    def storage(self, server):
        import s3fs

        options = {"endpoint_url": server, "key": "someone", "secret": "very-secret"}
        s3fs.S3FileSystem(**options).makedirs("contract", exist_ok=True)
        return open_storage(f"s3://contract/{uuid.uuid4().hex}", options)

    def test_a_bucket_that_is_not_there_is_said(self, storage):
        with pytest.raises(StoreError, match="create the bucket first"):
            open_storage("s3://no-such-bucket/x", dict(storage.options)).create("a", b"1")


class TestHub(StorageTests):
    WRITERS = 1  # the loser of two gets the Hub's refusal, see below

    @pytest.fixture
    def hub(self, tmp_path, monkeypatch):
        return fake_hub(tmp_path / "hub", monkeypatch)

    @pytest.fixture
    def storage(self, hub):
        storage = open_storage("hf://datasets/me/tiny/data")
        storage.begin()
        return storage

    def test_a_commit_between_is_refused(self, storage, hub):
        storage.begin()
        open_storage("hf://datasets/me/tiny/data").write("manifest.json", b"of another")
        with pytest.raises(StoreError, match="a commit has happened since.*rerun the same command"):
            storage.write_last({"manifest.json": b"mine"})
        assert storage.read("manifest.json") == b"of another"

    def test_a_tag_names_the_folder_in_the_repository(self, storage, hub):
        storage.write_last({"manifest.json": b"1"})
        storage.tag("v1.0.0", "the first version")
        assert hub.tags == {"data-v1.0.0": "1"}


@pytest.mark.parametrize("url, words", [("s3://", "names no bucket"), ("nothing://x", "another fsspec URL")])
def test_urls_that_lead_nowhere_are_refused(url, words):
    with pytest.raises(StoreError, match=words):
        open_storage(url)


def test_options_have_no_effect_on_a_folder_however_it_is_named(tmp_path):
    for place in (tmp_path, f"file:{tmp_path}", f"file://{tmp_path}", f"local://{tmp_path}"):
        with pytest.raises(StoreError, match=f"--option has no effect: {tmp_path} is a folder, not a URL; remove it"):
            open_storage(place, {"nonsense": 1})


# -- web servers without byte ranges --------------------------------------------------------------


@pytest.fixture
def served(tmp_path):
    """A folder, and its URL at a server that gives whole files for any part of them."""
    pytest.importorskip("aiohttp")
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path / "served")
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield tmp_path / "served", f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def test_a_server_without_ranges_is_not_taken_for_damage(served, tmp_path, monkeypatch):
    folder, url = served
    monkeypatch.setattr(base, "PIECE", 300)
    monkeypatch.setattr(base, "PAUSE", 0.001)
    (folder / "a").mkdir(parents=True)
    (folder / "a/b").write_bytes(data := bytes(range(256)) * 4)
    storage, file = open_storage(url), record("a/b", data)
    with pytest.raises(StoreError, match=f"server of {url} does not serve parts of files; fetch the release first"):
        storage.sha256(file)
    partial = base.unfinished(tmp_path / "back/a/b")
    partial.parent.mkdir(parents=True)
    partial.write_bytes(data[:500])  # of an interrupted download
    assert storage.download(file, tmp_path / "back") and (tmp_path / "back/a/b").read_bytes() == data


def test_a_release_at_a_server_without_ranges_says_to_fetch_it(served, small_release):
    folder, url = served
    dmcvb_gen.publish(small_release, f"file:{folder}", progress=False)
    subset = dmcvb_gen.open(url)["walker-walk/random/dynamic"]
    with pytest.raises(StoreError, match="does not serve parts of files; fetch the release first") as caught:
        for episode in subset.episodes:
            subset.episode(int(episode))
    assert "damaged" not in str(caught.value)
    fetched = dmcvb_gen.fetch(url, folder.parent / "fetched", progress=False)
    assert fetched["walker-walk/random/dynamic"].episode(0)
