"""Files are whole or not there."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys

import pytest

from dmcvb_gen import files


def test_bytes_text_and_json_are_put_in_place(tmp_path):
    files.write_bytes(tmp_path / "deep/er/a.bin", b"\0\1")
    files.write_text(tmp_path / "a.txt", "grüße\n")
    files.write_json(tmp_path / "a.json", {"b": [1, None]})
    assert (tmp_path / "deep/er/a.bin").read_bytes() == b"\0\1"
    assert (tmp_path / "a.txt").read_text("utf-8") == "grüße\n"
    assert json.loads((tmp_path / "a.json").read_text()) == {"b": [1, None]}
    assert files.sha256_file(tmp_path / "a.txt") == hashlib.sha256("grüße\n".encode()).hexdigest()


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    files.write_text(path, "old")
    with pytest.raises(RuntimeError), files.replacing(path) as temporary:
        temporary.write_text("half")
        assert temporary.name.endswith(files.PARTIAL) and temporary.parent == tmp_path
        raise RuntimeError
    limit, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10, limit[1]))  # a full disk
        with pytest.raises(OSError):
            files.write_bytes(path, b"x" * 100)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_writers_of_one_file_have_names_of_their_own(tmp_path):
    with files.replacing(tmp_path / "a") as one, files.replacing(tmp_path / "a") as two:
        assert one != two
        one.write_text("one")
        two.write_text("two")
    assert (tmp_path / "a").read_text() == "one" and os.listdir(tmp_path) == ["a"]


def test_files_have_the_rights_of_any_new_file(tmp_path):
    before = os.umask(0o027)
    try:
        files.write_text(tmp_path / "a", "")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


def test_the_inside_of_a_living_staging_folder_is_left_alone(tmp_path):
    with files.folder_in_the_making(tmp_path, "shards") as staging:
        (staging / "c").mkdir()
        (staging / "c" / "0.abc.partial").write_text("half")  # zarr's own name for a chunk that it writes
        files.remove_partial(tmp_path, foreign=True)
        assert (staging / "c" / "0.abc.partial").exists()


def test_what_killed_writers_left_is_removed(tmp_path):
    files.write_text(tmp_path / "sub/kept", "")
    owner = files._machine()
    killed = subprocess.Popen([sys.executable, "-c", ""])
    killed.wait()
    (tmp_path / "sub" / f".kept.{owner}@{killed.pid}.x8.partial").write_text("half")
    container = tmp_path / "sub" / f".kept.{socket.gethostname()}@{killed.pid}.x8.partial"  # a process elsewhere
    living = tmp_path / "sub" / f".kept.{owner}@{os.getpid()}.x8.partial"
    nobodys = tmp_path / "sub" / ".kept.x8.partial"
    for path in (living, nobodys, container):
        path.write_text("half")
    files.remove_partial(tmp_path)
    assert sorted(os.listdir(tmp_path / "sub")) == sorted([living.name, nobodys.name, container.name, "kept"])
    files.remove_partial(tmp_path, foreign=True)
    assert sorted(os.listdir(tmp_path / "sub")) == sorted([living.name, container.name, "kept"])


@pytest.mark.skipif(files._start_of(os.getpid()) is None, reason="this system does not tell when a process started")
def test_a_process_that_took_over_the_number_of_a_killed_one_keeps_nothing(tmp_path):
    with files.replacing(tmp_path / "kept") as mine:
        mine.write_text("half")
        started = files._start_of(os.getpid())
        of_killed = tmp_path / mine.name.replace(f"-{started}.", "-1.")
        of_killed.write_text("half")
        files.remove_partial(tmp_path)
        assert (mine.exists(), of_killed.exists()) == (True, False)
    assert os.listdir(tmp_path) == ["kept"]


def test_a_link_in_place_of_the_same_file_leaves_nothing_behind(tmp_path):
    (tmp_path / "one").write_text("data")
    os.link(tmp_path / "one", tmp_path / "two")
    with files.replacing(tmp_path / "two") as temporary:  # as two publishers do at once
        temporary.unlink()
        os.link(tmp_path / "one", temporary)
    assert sorted(os.listdir(tmp_path)) == ["one", "two"]
