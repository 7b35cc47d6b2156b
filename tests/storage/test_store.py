"""What every store does, whatever is behind it; a new implementation adds a class with a fixture."""

import functools
import gzip
import hashlib
import multiprocessing
import os
import pickle
import socket
import sys
import threading
import tracemalloc
import uuid
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import pytest
import zarr
from huggingface_hub.errors import RepositoryNotFoundError
from hypothesis import given
from hypothesis import strategies as st

from dmcvb_gen.dataset.manifest import ShardFile
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.storage.places import Place, local_path, shown
from dmcvb_gen.storage.store import NotThere, open_store
from dmcvb_gen.storage.zarr_files import ZarrFiles
from tests.conftest import python
from tests.fake_hub import fake_hub
from tests.web_server import serving, serving_s3

DEEP = "walker-walk/expert.zarr/pixels/c/0/0/0"
ODD = "a [b]*::c#d?e%20f~/ü.json"


def sha256(data):
    return hashlib.sha256(data).hexdigest()


def put_below(folder, path, data):
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    (folder / path).write_bytes(data)


class ReadTests:
    """Inherit, and give fixtures: `store`, and `put(path, data)`, which puts files there behind its back."""

    @pytest.mark.parametrize("path", ["manifest.json", DEEP, ODD])
    @pytest.mark.parametrize("data", [b"", b"0123456789"])
    def test_files_are_read_whole_and_in_parts(self, store, put, path, data):
        put(path, data)
        assert store.read(path, len(data)) == store.read(path, 10**9) == data
        assert store.size(path) == len(data)
        assert store.sha256(path, len(data)) == sha256(data)
        assert store.read_range(path, 0, len(data)) == data
        assert store.read_range(path, len(data) // 2, 0) == b""
        if data:
            assert store.read_range(path, 3, 4) == b"3456"

    def test_pieces_join(self, store, put, monkeypatch):
        monkeypatch.setattr("dmcvb_gen.storage.interface.PIECE", 300)
        put("a", data := bytes(range(256)) * 8)
        assert store.read("a", 2048) == data and store.sha256("a", 2048) == sha256(data)

    def test_more_bytes_than_allowed_are_an_error(self, store, put):
        put("a/b", b"0123456789")
        for read in (lambda: store.read("a/b", 9), lambda: store.sha256("a/b", 9)):
            with pytest.raises(StoreError, match="a/b is larger than the 9 bytes"):
                read()
        for start, length in ((0, 11), (5, 6), (10, 1), (20, 1)):
            with pytest.raises(StoreError, match="a/b"):
                store.read_range("a/b", start, length)

    def test_a_lost_file_is_an_error_and_never_zeros(self, store, put, tmp_path):
        put("there", b"1")
        assert store.size("a/b") is None
        for read in (
            lambda: store.read("a/b", 10),
            lambda: store.read("there/b", 10),
            lambda: store.read_range("a/b", 0, 10),
            lambda: store.sha256("a/b", 10),
            lambda: store.download("a/b", tmp_path / "x", 10, "0" * 64),
        ):
            with pytest.raises(NotThere, match="a/b is not there|there/b is not there"):
                read()
        assert not (tmp_path / "x").exists()

    def test_paths_stay_below_the_root(self, store):
        for path in ("", "../a", "a/../../b", "/etc/passwd", "a//b", "a/./b", "a\\b", "a\nb", "a\x1b[2J", "x" * 2000):
            with pytest.raises(StoreError, match="is no path below a release") as caught:
                store.read(path, 10)
            assert str(caught.value).isprintable()

    def test_a_download_is_kept_only_with_its_digest(self, store, put, tmp_path):
        put("a", b"0123456789")
        for size, digest in ((10, "0" * 64), (9, sha256(b"012345678")), (11, sha256(b"0123456789"))):
            with pytest.raises(StoreError, match="a does not have the size or SHA-256|a is larger than"):
                store.download("a", tmp_path / "new/a", size, digest)
        assert list((tmp_path / "new").iterdir()) == []
        for _ in range(2):
            store.download("a", tmp_path / "new/a", 10, sha256(b"0123456789"))
            assert [file.name for file in (tmp_path / "new").iterdir()] == ["a"]
        assert (tmp_path / "new/a").read_bytes() == b"0123456789"

    def test_zarr_reads_recorded_files_alone(self, store, put):
        array = zarr.create_array({}, shape=(4,), chunks=(2,), dtype="u1", fill_value=7, compressors=None)
        content = {"zarr.json": array.store._store_dict["zarr.json"].to_bytes(), "c/0": b"\x01\x02", "c/1": b"\x03\x04"}
        for path, data in content.items():
            put(f"g/x/{path}", data)
        put("h/zarr.json", content["zarr.json"])

        def read(prefix, **others):
            there = {path: data for path, data in (content | others).items() if data}
            files = {path: ShardFile(bytes=len(data), sha256=sha256(data)) for path, data in there.items()}
            return list(zarr.open_array(pickle.loads(pickle.dumps(ZarrFiles(store, prefix, files))), mode="r")[:])

        assert read("g/x") == [1, 2, 3, 4] and read("g/x", **{"c/1": None}) == [1, 2, 7, 7]
        for other in (b"\x03\x04\x05", b"\x03\x05"):
            with pytest.raises(StoreError, match="g/x/c/1"):
                read("g/x", **{"c/1": other})
        with pytest.raises(NotThere, match=r"h/c/\d is not there"):
            read("h")

    def test_it_pickles_equals_itself_and_reads_after_a_fork(self, store, put):
        put("a", b"1")
        other = pickle.loads(pickle.dumps(store))
        assert other == store and hash(other) == hash(store) and other.read("a", 1) == store.read("a", 1) == b"1"
        with multiprocessing.get_context("fork").Pool(1) as pool:
            assert pool.apply_async(store.read, ("a", 1)).get(timeout=30) == b"1"

    def test_nothing_private_is_shown(self, store):
        assert "secret" not in f"{store!r} {store.place}"


class StoreTests(ReadTests):
    """Of a store that can be written."""

    WRITERS = 6

    @pytest.fixture
    def put(self, store):
        return store.create

    def test_a_file_is_created_once(self, store, tmp_path):
        local = tmp_path / "local"
        local.write_bytes(b"from a file")
        assert store.create("a/b", b"mine") and not store.create("a/b", b"yours") and not store.create("a/b", local)
        assert store.read("a/b", 99) == b"mine"
        assert store.create("a/c", local) and store.read("a/c", 99) == b"from a file" and local.exists()
        assert store.list() == {"a/b": 4, "a/c": 11}

    @pytest.mark.parametrize("how", ["create", "replace", "replace a version"])
    def test_of_many_who_write_at_once_one_is_whole(self, store, how):
        if how == "replace a version":
            store.create("a", b"old")
        version, start, won = store.version("a"), threading.Barrier(self.WRITERS), []
        contents = [bytes([n]) * 5000 for n in range(self.WRITERS)]
        write = store.create if how == "create" else store.replace
        given = [version] if how == "replace a version" else []

        def take_part(data):
            start.wait()
            if write("a", data, *given):
                won.append(data)

        with ThreadPoolExecutor(self.WRITERS) as pool:
            list(pool.map(take_part, contents))
        there = store.read("a", 5000)
        assert there in contents and (len(won) == self.WRITERS if how == "replace" else won == [there])

    def test_a_file_is_replaced_if_it_is_the_expected_one(self, store):
        assert store.version("a") is None
        assert store.replace("a", b"1", None) and not store.replace("a", b"2", None)
        assert store.replace("a", b"1", None)  # the same bytes: as if by us, whose reply was lost
        first = store.version("a")
        assert store.replace("a", b"22", first) and not store.replace("a", b"333", first)
        assert store.read("a", 9) == b"22" and store.version("a") not in (first, None)
        assert store.replace("a", b"4444") and store.read("a", 9) == b"4444"
        assert not store.replace("b", b"1", first) and store.size("b") is None

    def test_lists_have_sizes_and_no_hidden_files(self, store):
        assert store.list() == store.list("a") == {}
        for path in (DEEP, "manifest.json", "walker-walk/b", "walker-walker/c", ".hidden", "a/.hidden/b", ODD):
            store.create(path, b"12")
        assert store.list() == dict.fromkeys([DEEP, "manifest.json", "walker-walk/b", "walker-walker/c", ODD], 2)
        assert store.list("walker-walk") == {DEEP: 2, "walker-walk/b": 2}
        assert store.list("walker-walk/") == store.list("walker-walk") and store.list("nothing") == {}

    def test_what_is_deleted_can_be_created(self, store):
        store.delete("a/b")
        for _ in range(2):
            assert store.create("a/b", b"1")
            store.delete("a/b")
            assert store.size("a/b") is None

    def test_a_folder_is_published(self, store, tmp_path):
        for number, path in enumerate(paths := ["b", DEEP, ODD, "c"]):
            put_below(tmp_path, path, bytes([number]) * 100)
        told = []
        store.begin()
        store.create("b", b"another")
        assert store.upload(tmp_path, paths, 2, told.append) == ["b"] and sum(told) == 4
        assert store.upload(tmp_path, paths) == paths and store.read(DEEP, 100) == b"\1" * 100
        assert store.finish({"README.md": b"1", "manifest.json": b"2"}, None)
        assert not store.finish({"README.md": b"1", "manifest.json": b"3"}, None)
        assert store.finish({"manifest.json": b"3"}, store.version("manifest.json"))
        store.tag("v1.0.0", "the first version")
        assert store.read("manifest.json", 9) == b"3" and store.read("README.md", 9) == b"1"


class TestFolder(StoreTests):
    @pytest.fixture
    def store(self, tmp_path):
        return open_store(tmp_path / "r [1] *::x#y?z ~")

    def test_a_killed_writer_leaves_nothing_that_counts(self, store):
        code = (
            "import os, sys\nfrom dmcvb_gen.storage.store import open_store\n"
            "os.fsync = lambda handle: os.kill(os.getpid(), 9)\n"
            "getattr(open_store(sys.argv[1]), sys.argv[2])('a/b', b'new')"
        )
        store.create("a/c", b"1")
        for how in ("create", "replace"):
            python(code, store.place, how, code=-9)
            assert store.size("a/b") is None and store.list() == {"a/c": 1}
        assert store.create("a/b", b"mine") and store.replace("a/b", b"2")
        assert sorted(path.name for path in (store.folder / "a").iterdir()) == ["b", "c"]

    @pytest.mark.parametrize("kind", ["fifo", "link", "device", "socket", "folder", "linked folder"])
    def test_what_is_no_regular_file_is_refused_at_once(self, store, tmp_path, kind, monkeypatch):
        store.create("there", b"1")
        outside, path = tmp_path / "outside", store.folder / "a"
        outside.mkdir()
        (outside / "b").write_bytes(b"secret")
        {
            "fifo": lambda: os.mkfifo(path),
            "link": lambda: path.symlink_to(outside / "b"),
            "device": lambda: path.symlink_to("/dev/zero"),
            "socket": lambda: (monkeypatch.chdir(store.folder), socket.socket(socket.AF_UNIX).bind("a")),
            "folder": lambda: path.mkdir(),
            "linked folder": lambda: path.symlink_to(outside),
        }[kind]()
        name = "a/b" if kind == "linked folder" else "a"
        for read in (lambda: store.read(name, 100), lambda: store.sha256(name, 100), lambda: store.size(name)):
            with pytest.raises(StoreError, match="not a regular file|is a link") as caught:
                read()
            assert not isinstance(caught.value, NotThere)
        assert store.list() == {"there": 1}
        if path.is_symlink():
            for write in (store.create, store.replace):
                with pytest.raises(StoreError, match="is a link"):
                    write(f"{name}/new" if name == "a/b" else name, b"1")
        assert [(file.name, file.read_bytes()) for file in outside.iterdir()] == [("b", b"secret")]

    def test_no_room_leaves_what_was_there(self, store, monkeypatch):
        store.create("a", b"1")
        with monkeypatch.context() as patch:
            patch.setattr("os.fsync", Mock(side_effect=OSError(28, "No space left on device")))
            for write in (lambda: store.replace("a", b"2"), lambda: store.create("b", b"2")):
                with pytest.raises(StoreError, match="no room to write to .*make room"):
                    write()
        assert store.read("a", 9) == b"1" and {path.name for path in store.folder.iterdir()} <= {"a", ".lock"}

    def test_the_root_may_be_a_link_and_begin_with_the_home_folder(self, store, monkeypatch, tmp_path):
        store.create("a", b"1")
        (tmp_path / "other").symlink_to(store.folder)
        assert open_store(tmp_path / "other").read("a", 1) == b"1"
        monkeypatch.setenv("HOME", str(tmp_path))
        assert open_store("~/r").folder == open_store("file:~/r").folder == tmp_path / "r"
        spaced = tmp_path / "a folder of 100%"
        assert open_store(spaced.as_uri()).folder == open_store(f"file:{spaced}").folder == spaced
        monkeypatch.delenv("HOME")
        monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
        with pytest.raises(StoreError, match="there is no home folder here"):
            open_store("~/r")


class TestFolderWithoutLinks(StoreTests):
    """A disk that knows neither hard links nor unnamed files."""

    @pytest.fixture
    def store(self, tmp_path, monkeypatch):
        monkeypatch.setattr("os.link", Mock(side_effect=PermissionError(1, "Operation not permitted")))
        store = open_store(f"file://{tmp_path}/r")
        yield store
        assert not store.list() or (store.folder / ".lock").exists()  # else links were made all the same


@pytest.fixture(scope="module")
def s3_options():
    with serving_s3("contract") as options:
        yield options


class TestS3(StoreTests):
    @pytest.fixture
    def store(self, s3_options):
        return open_store(f"s3://contract/{uuid.uuid4().hex}/r [1] *::x#y?z ~", s3_options)

    def test_the_folders_of_a_console_are_no_files(self, store):
        for folder in ("", "sub/"):
            store._system.call_s3("put_object", Bucket="contract", Key=f"{store.base}/{folder}".partition("/")[2])
        store.create("sub/a", b"1")
        assert store.list() == {"sub/a": 1}

    def test_a_bucket_that_is_not_there_is_said(self, store):
        with pytest.raises(StoreError, match="create the bucket first"):
            open_store("s3://no-such-bucket/x", store.options).create("a", b"1")
        with pytest.raises(NotThere, match="s3://no-such-bucket/x/a is not there"):
            open_store("s3://no-such-bucket/x", store.options).read("a", 1)

    @pytest.mark.parametrize("status, code", [(200, ""), (501, "NotImplemented")])
    def test_a_store_that_ignores_or_refuses_conditions_is_refused_in_a_line(self, s3_options, status, code):
        def answer(request):
            request.rfile.read(int(request.headers.get("Content-Length", 0)))
            body = f"<Error><Code>{code}</Code><Message>A header you provided</Message></Error>" if code else ""
            request.give(body.encode(), status, ETag='"1"')

        with serving(answer) as server:
            store = open_store("s3://bucket/x", s3_options | {"endpoint_url": server.url})
            with pytest.raises(StoreError, match="does not support conditional writes"):
                store.create("a", b"1")
            assert len(server.asked) <= 2


class TestWeb(ReadTests):
    @pytest.fixture
    def folder(self, tmp_path):
        (tmp_path / "served/r").mkdir(parents=True)
        return tmp_path / "served/r"

    @pytest.fixture
    def store(self, folder):
        with serving(folder.parent) as server:
            url = f"{server.url.replace('://', '://me:a%2Fsecret@')}/r?sig=secret"
            yield open_store(url, {"headers": {"X-Token": "secret"}})

    @pytest.fixture
    def put(self, folder):
        return functools.partial(put_below, folder)

    def test_login_query_and_headers_are_sent(self, folder):
        (folder / "a").write_bytes(b"1")
        with serving(folder.parent) as server:
            url = server.url.replace("://", "://me:a%2Fb@")
            open_store(f"{url}/r?sig=1", {"headers": {"X-Token": "2"}}).read("a", 1)
        [(_, path, headers)] = server.asked
        assert path == "/r/a?sig=1" and headers["X-Token"] == "2" and headers["Authorization"] == "Basic bWU6YS9i"

    def test_it_can_only_be_read(self, store):
        assert not store.writable
        for write in (store.create, store.replace):
            with pytest.raises(StoreError, match="can only be read"):
                write("a", b"1")
        with pytest.raises(StoreError, match="gives no list"):
            store.list()


def endless(request, status=200, **headers):
    request.send_response(status)
    for name, value in headers.items():
        request.send_header(name.replace("_", "-"), value)
    request.end_headers()
    while True:
        request.wfile.write(b"x" * 65536)


def cut(request):
    request.give(b"x" * 10, Content_Length="1000")
    request.close_connection = True


ATTACKS = {
    "endless body": endless,
    "endless body of a part": lambda request: endless(request, 206, Content_Range="bytes 5-1004/2000"),
    "another part": lambda request: request.give(b"x" * 1000, 206, Content_Range="bytes 7-1006/5000"),
    "false length": lambda request: endless(request, Content_Length=str(10**12)),
    "cut off": cut,
    "in a circle": lambda request: request.give(b"", 302, Location="/again"),
    "broken": lambda request: request.give(b"\x1b[2J", 418),
    "refused": lambda request: request.give(b"no", 403),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_hostile_server_gives_a_line_and_takes_no_memory(attack, tmp_path):
    with serving(ATTACKS[attack]) as server:
        store = open_store(f"{server.url}/r?sig=secret-sig")
        tracemalloc.start()
        for read in (
            lambda: store.read("a", 100),
            lambda: store.sha256("a", 100),
            lambda: store.download("a", tmp_path / "a", 100, sha256(b"x" * 100)),
            lambda: store.read_range("a", 5, 1000),
        ):
            with pytest.raises(StoreError) as caught:
                read()
            line = str(caught.value)
            assert line.isprintable() and "secret" not in line and server.url in line
        assert tracemalloc.get_traced_memory()[1] < 20e6
        tracemalloc.stop()


def test_a_body_is_not_decompressed():
    packed = gzip.compress(b"0" * 10**6)
    with serving(lambda request: request.give(packed, Content_Encoding="gzip")) as server:
        assert open_store(server.url).read("a", len(packed)) == packed


def test_a_server_without_ranges_is_not_taken_for_damage():
    with serving(lambda request: request.give(b"0123456789")) as server:
        store = open_store(server.url)
        assert store.read("a", 10) == b"0123456789" and store.read_range("a", 0, 10) == b"0123456789"
        with pytest.raises(StoreError, match=f"server of {server.url} does not serve parts of files; fetch the"):
            store.read_range("a", 5, 5)


class TestHub(ReadTests):
    @pytest.fixture
    def hub(self, tmp_path, monkeypatch):
        return fake_hub(tmp_path / "hub", monkeypatch)

    @pytest.fixture
    def store(self, hub):
        store = open_store("hf://datasets/me/tiny/data", {"token": "hf_secret"})
        store.begin()
        return store

    @pytest.fixture
    def put(self, store, tmp_path):
        def put(path, data):
            put_below(tmp_path / "put", path, data)
            store.upload(tmp_path / "put", [path])

        return put

    def test_a_release_is_a_few_commits_and_files_are_never_replaced(self, store, hub, tmp_path):
        paths = [f"f{number}" for number in range(100)]
        for path in paths:
            (tmp_path / path).write_bytes(path.encode())
        assert store.upload(tmp_path, paths) == [] and len(hub.commits) == 2
        (tmp_path / "f1").write_bytes(b"another")
        assert store.upload(tmp_path, paths) == paths and len(hub.commits) == 2
        assert store.finish({"README.md": b"1", "manifest.json": b"2"}, None)
        assert store.list() == {**{path: len(path) for path in paths}, "README.md": 1, "manifest.json": 1}
        store.tag("v1.0.0", "the first version")
        assert hub.tags == {"data-v1.0.0": "3"}

    def test_of_two_who_finish_one_does(self, store, hub, monkeypatch):
        other = open_store(store.place)
        version = store.version("manifest.json")
        assert other.finish({"manifest.json": b"of another"}, None)
        assert not store.finish({"manifest.json": b"mine"}, version)
        assert store.finish({"manifest.json": b"of another"}, version)  # the same bytes
        head = store._head
        monkeypatch.setattr(type(store), "_head", lambda self: str(int(head()) - 1))  # a commit comes between
        with pytest.raises(StoreError, match="a commit has happened since"):
            store.finish({"manifest.json": b"mine"})
        assert hub.files["data/manifest.json"] == b"of another"

    def test_what_is_read_is_of_one_commit(self, store, put):
        put("a", b"1")
        reader = open_store("hf://datasets/me/tiny/data")
        assert reader.read("a", 1) == b"1"
        assert store.finish({"a": b"2"})
        assert reader.read("a", 1) == pickle.loads(pickle.dumps(reader)).read("a", 1) == b"1"
        assert open_store("hf://datasets/me/tiny/data").read("a", 1) == b"2"
        assert open_store("hf://datasets/me/tiny@1/data").read("a", 1) == b"1"

    def test_single_files_are_not_committed(self, store):
        for write in (store.create, store.replace):
            with pytest.raises(StoreError, match="takes files in commits; write the release to a folder"):
                write("a", b"1")
        with pytest.raises(StoreError, match="remove @v1"):
            open_store("hf://datasets/me/tiny@v1").begin()


REFUSED = {
    "s3://": "names no bucket",
    "s3:bucket/x": "did you mean s3://bucket/x",
    "s3:/bucket/x": "did you mean s3://bucket/x",
    "nothing://x": "no place that releases can be at",
    "simplecache::http://me:secret@host/x": "no place that releases can be at",
    "s3://key:secret@bucket/x": "set them in the environment",
    "s3://key:se/secret@bucket/x": "set them in the environment",
    "http://": "names no server",
    "https://me:secret@host/x#part": "write it as %23",
    "hf://spaces/me/x": "is not hf://datasets/OWNER/NAME",
    "hf://datasets/me": "is not hf://datasets/OWNER/NAME",
    "": "is no place",
    "a\x1b[2Jb": "is no place",
}


@pytest.mark.parametrize("place", REFUSED)
def test_places_that_lead_nowhere_are_refused(place):
    with pytest.raises(StoreError, match=REFUSED[place]) as caught:
        open_store(place)
    assert str(caught.value).isprintable() and "secret" not in str(caught.value)


NO_OPTION = {
    "file:/tmp/x": "--option has no effect: /tmp/x is a folder",
    "http://x/y": "Known: headers",
    "hf://datasets/a/b": "Known: endpoint, token",
}


@pytest.mark.parametrize("place", NO_OPTION)
def test_options_without_an_effect_are_refused(place):
    with pytest.raises(DmcvbError, match=NO_OPTION[place]):
        open_store(place, {"key": 1})


def test_what_is_no_url_is_a_local_path():
    for given_path in ("x", "/x/y", "C:/x", "./s3:/x", "a:b/c"):
        assert local_path(given_path) == Path(given_path)
    for url in ("s3://user:secret@bucket/x", "file:/tmp/x", "simplecache::s3://b/x", Path("s3://bucket")):
        with pytest.raises(StoreError, match="is a URL") as caught:
            local_path(url)
        assert "secret" not in str(caught.value)


@given(st.text())
def test_no_text_makes_a_place_crash(text):
    try:
        assert open_store(text).place.isprintable()
    except DmcvbError as error:
        assert str(error).isprintable()


PLACES = {
    "http://me:pw@host:80/a/b?sig=1": "http://host:80/a/b",
    "https://me:p@ss@host/a@b": "https://host/a@b",
    "https://me:p/w@host/a": "https://host/a",
    "https://host/a@b": "https://host/a@b",
    "https://[::1]:80/a@b": "https://[::1]:80/a@b",
    "s3://bucket/a#b?c [d]*::e": "s3://bucket/a#b?c [d]*::e",
    "hf://datasets/a/b@v1/c": "hf://datasets/a/b@v1/c",
    "/tmp/a#b?c": "/tmp/a#b?c",
}


@pytest.mark.parametrize("place", PLACES)
def test_places_are_shown_without_secrets(place):
    assert str(Place.parse(place)) == shown(place) == open_store(place).place == PLACES[place]


def test_a_private_repository_asks_for_a_token_and_an_old_client_for_a_new_one():
    hidden = RepositoryNotFoundError("401 Client Error. Repository Not Found for url", response=Mock())
    with pytest.raises(StoreError, match="refuses access .*HF_TOKEN"), storage_errors("hf://datasets/me/none"):
        raise hidden
    with pytest.raises(StoreError, match="too old .*pip install -U zarr"), storage_errors("hf://x"):
        from zarr import what_a_later_version_has  # noqa: F401


def test_a_package_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(StoreError, match="pip install -U gcsfs"):
        open_store("gs://bucket/x").read("a", 1)


def test_a_network_that_is_away_is_no_damage():
    class ClientError(Exception):
        """Of a client that is not known by name."""

    with (
        pytest.raises(StoreError, match="check the URL and the network"),
        storage_errors("hf://datasets/a/b", decoding=True),
    ):
        raise ClientError("no address") from socket.gaierror(-2, "Name or service not known")
