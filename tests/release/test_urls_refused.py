"""What writes to folders takes no URL: one line that says what to do instead, and no folder named "s3:"."""

from __future__ import annotations

from pathlib import Path

import pytest

from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.places import local_path
from tests.conftest import invoke

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
    words = [small_release if word == "RELEASE" else word for word in COMMANDS[name]]
    said = invoke(*words, code=2).output.splitlines()[-1]
    assert "s3://bucket/x" in said and "give a local one" in said
    assert not list(elsewhere.iterdir())


def test_a_url_with_a_slash_too_few_is_no_folder(small_release, elsewhere):
    for words in (["publish", small_release, "s3:/bucket/demo"], ["fetch", "s3:/bucket/demo", "--out", "here"]):
        said = invoke(*words, code=2).output
        assert "did you mean s3://bucket/demo?" in said and said.count("\n") == 1 and not list(elsewhere.iterdir())


def test_what_is_no_url_is_a_path():
    for given in ("x", "/x/y", "C:/x", "./s3:/x", "a:b/c"):
        assert local_path(given) == Path(given)
    for given in ("s3://user:secret@bucket/x", "file:/tmp/x", "simplecache::s3://b/x", Path("s3://bucket")):
        with pytest.raises(StoreError, match="is a URL") as caught:
            local_path(given)
        assert "secret" not in str(caught.value)
