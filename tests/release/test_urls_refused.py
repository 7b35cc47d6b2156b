"""What writes to folders takes no URL: one line that says what to do instead, and no folder named "s3:"."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from dmcvb_gen.cli import main
from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.places import local_path

URL = "s3://bucket/x"
COMMANDS = {
    "train-behaviour": ["train-behaviour", "walker-walk", "--out", URL],
    "validate": ["validate", "RELEASE", "--out", URL],
    "preview": ["preview", "RELEASE", "--out", URL],
    "card": ["card", "RELEASE", "--out", URL],
    "export": ["export", "RELEASE", "--to", "hdf5", "--out", URL],
    "import": ["import", ".", "--out", URL],
    "fetch": ["fetch", "memory://x", "--out", URL],
    "repaint": ["repaint", "RELEASE", "--out", URL],
    "regenerate": ["regenerate", "RELEASE", "--out", URL],
    "paint": ["paint", URL],
}


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_makes_a_folder_of_a_url(small_release, elsewhere, name):
    words = [str(small_release) if word == "RELEASE" else word for word in COMMANDS[name]]
    result = CliRunner().invoke(main, words)
    said = result.output.splitlines()[-1]
    assert result.exit_code == 2 and "s3://bucket/x" in said and "give a local one" in said, result.output
    assert not list(elsewhere.iterdir())


@pytest.mark.parametrize("command", ["publish", "fetch"])
def test_a_url_with_a_slash_too_few_is_no_folder(small_release, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    words = {"publish": [str(small_release), "s3:/bucket/demo"], "fetch": ["s3:/bucket/demo", "--out", "here"]}[command]
    done = CliRunner().invoke(main, [command, *words])
    assert done.exit_code == 2 and "did you mean s3://bucket/demo?" in done.output and done.output.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_what_is_no_url_is_a_path():
    for given in ("x", "/x/y", "C:/x", "./s3:/x", "a:b/c"):
        assert local_path(given) == Path(given)
    for given in ("s3://user:secret@bucket/x", "file:/tmp/x", "simplecache::s3://b/x", Path("s3://bucket")):
        with pytest.raises(StoreError, match="is a URL") as caught:
            local_path(given)
        assert "secret" not in str(caught.value)
