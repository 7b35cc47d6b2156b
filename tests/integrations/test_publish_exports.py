"""Exports go to a URL as they are, and to the Hub with the tag that LeRobot's loader looks for."""

from __future__ import annotations

import http.server
import shutil
import threading
from unittest import mock

import pytest
from click.testing import CliRunner
from dmcvb_gen.dataset.index import CLAIM

from dmcvb_gen.cli import main
from dmcvb_gen.errors import StoreError
from dmcvb_gen.release.export import export
from dmcvb_gen.release.export.publishing import export_format, publish_export
from dmcvb_gen.release.export.registry import all_formats
from dmcvb_gen.release.publish import publish_folder

SUBSETS = ("walker-walk/random/static", "ant-maze-tiny/random/hidden")


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


FORMATS = list(all_formats())


@pytest.mark.parametrize("to", FORMATS)
def test_an_export_arrives_whole_and_a_second_try_moves_nothing(to, stored, tmp_path):
    name = SUBSETS[FORMATS.index(to) % 2]
    [folder] = export(str(stored[name].folder), to, tmp_path / to, [name])
    assert export_format(folder) == export_format(tmp_path / to) == to
    done = CliRunner().invoke(main, ["publish", str(folder), f"file://{tmp_path / 'there'}"])
    assert done.exit_code == 0, done.output
    assert content(tmp_path / "there") == content(folder)
    (tmp_path / "there" / "LICENSE").write_text("mine")  # no data, whatever the format's files are called
    again = publish_export(folder, f"file://{tmp_path / 'there'}")
    assert again.moved == 0 and again.files == len(content(folder))
    refused = CliRunner().invoke(main, ["publish", str(folder), f"file://{tmp_path / 'x'}", "--no-pixels"])
    assert refused.exit_code == 2 and "are for releases" in refused.output


def test_the_hub_gets_one_commit_and_lerobots_tag(stored, tmp_path):
    from huggingface_hub import HfApi

    for name in SUBSETS:
        [folder] = export(str(stored[name].folder), "lerobot", tmp_path, [name])
        api = mock.create_autospec(HfApi, instance=True)  # refuses calls that the real one would
        api.list_repo_refs.return_value.tags = [mock.Mock()]
        api.list_repo_refs.return_value.tags[0].name = "v3.0"
        api.list_repo_files.return_value = [".gitattributes", "README.md", "meta/info.json"]
        publish_export(folder, "hf://datasets/me/demo", api=api)
        called = [call[0] for call in api.method_calls]
        assert called == [
            "create_repo",
            "list_repo_files",
            "upload_folder",
            "list_repo_refs",
            "delete_tag",
            "create_tag",
        ]
        assert api.upload_folder.call_args.kwargs["folder_path"] == folder
        assert api.create_tag.call_args.kwargs == {"repo_id": "me/demo", "repo_type": "dataset", "tag": "v3.0"}
    with pytest.raises(StoreError, match="--merge"):
        publish_export(tmp_path, "hf://datasets/me/demo", api=api)


@pytest.mark.parametrize("to", FORMATS)
def test_an_export_is_never_mixed_with_a_release_or_another_export(to, stored, tmp_path):
    for name, other in (SUBSETS, SUBSETS[::-1]):
        release, place = stored[name].folder, tmp_path / f"{to}-{name.partition('/')[0]}"
        [folder] = export(str(release), to, tmp_path / to, [name])
        shutil.copytree(folder, place / "export")
        data = next(path for path in content(folder) if path.suffix and not path.name.startswith("."))
        left = f"left-by-{other.partition('/')[0]}{data.suffix}"
        (place / "export" / left).write_bytes(b"of a larger export")
        shutil.copytree(release, place / "release")
        (place / "begun").mkdir()
        (place / "begun" / CLAIM).write_text("{}")
        for there, said in (("export", left), ("release", "holds a release"), ("begun", "holds a release")):
            before = content(place / there)
            done = CliRunner().invoke(main, ["publish", str(folder), f"file://{place / there}"])
            assert done.exit_code == 2 and said in done.output and "give another URL" in done.output
            assert content(place / there) == before


def test_the_hub_keeps_an_export_from_a_release_and_from_other_exports(stored, tmp_path):
    from huggingface_hub import HfApi

    for name in SUBSETS:
        [folder] = export(str(stored[name].folder), "hdf5", tmp_path, [name])
        api = mock.create_autospec(HfApi, instance=True)
        for there, said in (
            ("in/manifest.json", "holds a release"),
            ("in/old.hdf5", "old.hdf5"),
            ("in/a/b.hdf5", "b.hdf5"),
        ):
            api.list_repo_files.return_value = [".gitattributes", "other/manifest.json", "other/old.hdf5", there]
            with pytest.raises(StoreError, match=said):
                publish_export(folder, "hf://datasets/me/demo/in", api=api)
        api.upload_folder.assert_not_called()
        api.list_repo_files.return_value = [".gitattributes", "other/manifest.json", "other/old.hdf5", "in/README.md"]
        publish_export(folder, "hf://datasets/me/demo/in", api=api)
        api.upload_folder.assert_called_once()


def test_what_a_killed_export_left_is_not_published(stored, tmp_path):
    from huggingface_hub import HfApi
    from huggingface_hub.utils import filter_repo_objects

    for name in SUBSETS:
        out, place = tmp_path / name.partition("/")[0], tmp_path / "there" / name.partition("/")[0]
        [folder] = export(str(stored[name].folder), "hdf5", out, [name])
        whole, killed = content(out), folder.parent / ".dynamic.m@1-2.x.partial"
        shutil.copytree(folder, killed / "dynamic")
        (folder / ".data.hdf5.m@1-2.x.partial").write_bytes(b"half")
        sent = publish_export(out, f"file://{place}")
        assert content(place) == whole and sent.files == len(whole)
        api = mock.create_autospec(HfApi, instance=True)
        api.list_repo_files.return_value = []
        publish_export(out, "hf://datasets/me/demo", api=api)
        ignored = api.upload_folder.call_args.kwargs["ignore_patterns"]
        assert set(filter_repo_objects(map(str, content(out)), ignore_patterns=ignored)) == set(map(str, whole))
        shutil.rmtree(folder)
        assert export_format(out) is None and export_format(killed) == "hdf5"


def test_an_export_goes_to_an_empty_folder(stored, tmp_path):
    for name in SUBSETS:
        for to, merge in (("lerobot", True), ("hdf5", False)):
            out = tmp_path / to / name.partition("/")[0]
            place = out if merge else out / name
            place.mkdir(parents=True)
            assert export(str(stored[name].folder), to, out, [name], merge=merge) == [place]
            assert export_format(place) == to
    (place / ".dmcvb-gen.json").write_text("{}")
    with pytest.raises(StoreError, match="is there already"):
        export(str(stored[name].folder), to, out, [name])


class Refusing(http.server.BaseHTTPRequestHandler):
    """A Hub that refuses everybody and keeps who asked for what."""

    def do_POST(self):
        self.server.asked.append((self.path, self.headers["Authorization"]))
        self.send_error(403)

    def log_message(self, *_):
        pass


def test_a_hub_of_ones_own_is_asked_with_the_token_of_the_options(small_release, small_mazes, stored, tmp_path):
    pytest.importorskip("huggingface_hub")
    with http.server.HTTPServer(("127.0.0.1", 0), Refusing) as server:
        server.asked = []
        threading.Thread(target=server.serve_forever, daemon=True).start()
        options = {"endpoint": f"http://127.0.0.1:{server.server_port}", "token": "hf_mine"}
        [folder] = export(str(stored[SUBSETS[0]].folder), "hdf5", tmp_path, [SUBSETS[0]])
        for sent in (small_release, small_mazes, folder):
            with pytest.raises(StoreError, match="refuses access"):
                publish_folder(sent, "hf://datasets/me/demo", options=options)
        server.shutdown()
    assert server.asked == [("/api/repos/create", "Bearer hf_mine")] * 3


def test_what_is_no_export_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    done = CliRunner().invoke(main, ["publish", str(tmp_path), f"file://{tmp_path / 'there'}"])
    assert done.exit_code == 2 and "holds no release" in done.output
    with pytest.raises(StoreError, match="neither a release nor an export"):
        publish_export(tmp_path, f"file://{tmp_path / 'there'}")
