"""Files are whole or not there."""

import os
import subprocess
import sys

import pytest

from dmcvb_gen import files
from tests.conftest import python
from tests.faults.inject import files_up_to


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    files.write_text(path, "old")
    with pytest.raises(RuntimeError), files.replacing(path) as temporary:
        temporary.write_text("half")
        assert temporary.name.endswith(files.PARTIAL) and temporary.parent == tmp_path
        raise RuntimeError
    with files_up_to(10), pytest.raises(OSError):
        files.write_bytes(path, b"x" * 100)
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_writers_of_one_file_have_names_of_their_own(tmp_path):
    with files.replacing(tmp_path / "a") as one, files.replacing(tmp_path / "a") as two:
        assert one != two
        one.write_text("one")
        two.write_text("two")
    assert (tmp_path / "a").read_text() == "one" and os.listdir(tmp_path) == ["a"]


def test_files_have_the_rights_of_any_new_file(tmp_path):
    code = "import os, sys; os.umask(0o027); from dmcvb_gen import files; files.write_text(sys.argv[1], '')"
    python(code, tmp_path / "a")
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


def test_what_killed_writers_left_is_removed_and_what_others_make_stays(tmp_path):
    code = (
        "import os, sys; from dmcvb_gen import files\n"
        "with files.replacing(sys.argv[1] + '/a'), files.folder_in_the_making(sys.argv[1], 'b') as made:\n"
        "    (made / 'c').write_text('half')\n"
        "    print(flush=True), sys.stdin.read(), os.kill(os.getpid(), 9)"
    )
    with subprocess.Popen([sys.executable, "-c", code, tmp_path], stdin=-1, stdout=-1) as other:
        other.stdout.readline()
        living = sorted(os.listdir(tmp_path))
        files.remove_partial(tmp_path)
        assert sorted(os.listdir(tmp_path)) == living and len(living) == 2
        other.communicate(b"")
    (tmp_path / ".link.partial").symlink_to(tmp_path)
    with files.replacing(tmp_path / "kept") as mine:
        files.remove_partial(tmp_path)
        assert sorted(os.listdir(tmp_path)) == sorted([mine.name, ".link.partial"])
