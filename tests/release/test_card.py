"""Cards say what the data say; Croissant's own validator accepts the metadata; a card that lies is found."""

from __future__ import annotations

import json
import shutil

import click
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from PIL import Image

from dmcvb_gen.cli.common import answer, print_table
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.policies.paper import paper_returns
from dmcvb_gen.release.card import check_card, write_card
from dmcvb_gen.release.fetch import fetch
from dmcvb_gen.release.publish import publish
from dmcvb_gen.release.verify import verify
from tests.conftest import invoke, roll_out, short_recipe, small_recipe
from tests.fake_hub import content


@pytest.fixture(scope="module")
def carded(small_release, tmp_path_factory):
    folder = shutil.copytree(small_release, tmp_path_factory.mktemp("card") / "small")
    write_card(folder)
    return folder


@pytest.fixture
def copy(carded, tmp_path):
    return shutil.copytree(carded, tmp_path / "copy")


def test_the_header_is_what_hugging_face_reads(carded):
    _, header, text = (carded / "README.md").read_text().split("---\n", 2)
    fields = yaml.safe_load(header)
    assert fields["license"] == "cc-by-4.0" and fields["size_categories"] == ["1K<n<10K"]
    assert "reinforcement-learning" in fields["task_categories"] and fields["pretty_name"] == "small 1.0.0"
    assert text.startswith("\n# small 1.0.0") and "\n\n\n" not in text


def test_the_numbers_are_the_datas_and_the_papers(carded):
    text, paper = (carded / "README.md").read_text(), paper_returns("walker-walk", "random")
    for subset in Release.open(carded).subsets.values():
        row = next(line for line in text.split("## Returns")[1].splitlines() if f"`{subset.name}`" in line)
        assert f"| {subset.returns.mean():.1f} | {subset.returns.std():.1f} |" in row
        z = (subset.returns.mean() - paper["mean"]) / paper["std"]
        assert f"| DMC-VB paper (z = {z:+.2f}) | {paper['mean']:.1f} | {paper['std']:.1f} |" in text
    assert "s = 0.2" in text and "uniform random actions" in text and "regenerate small --check" in text
    assert "](card/contact_sheet.png)" in text
    picture = np.asarray(Image.open(carded / "card/contact_sheet.png"))
    assert picture.shape[0] > 50 and picture.std() > 5


def test_croissants_validator_accepts_the_metadata_and_reads_its_records(carded):
    mlc = pytest.importorskip("mlcroissant")
    dataset = mlc.Dataset(carded / "croissant.json")
    assert not dataset.metadata.issues.errors and not dataset.metadata.issues.warnings
    rows = list(dataset.records("subsets"))
    assert len(rows) == 3 and {row["subsets/steps"] for row in rows} == {1500}
    episodes = list(dataset.records("episodes"))
    lengths = [row["episodes/length"] for row in episodes]
    assert lengths == [500] * 9 and episodes[0]["episodes/first_frame"].size == (16, 16)
    data = json.loads((carded / "croissant.json").read_text())
    for file in data["distribution"]:
        if file["@type"] == "cr:FileObject":
            assert file["sha256"] == sha256_file(carded / file["contentUrl"])
    loaded = dataset.metadata
    assert loaded.data_limitations and loaded.data_biases and loaded.data_use_cases and loaded.data_collection
    assert loaded.date_published.isoformat()[:10] == data["datePublished"] and data["rai:hasSyntheticData"] is True


@pytest.mark.slow_cases("False", "True")
@pytest.mark.parametrize("light", [False, True])
def test_the_hubs_loader_reads_the_episodes_with_their_first_frames(small_release, small_mazes, tmp_path, light):
    datasets = pytest.importorskip("datasets")
    datasets.disable_progress_bars()
    for source in (small_release, small_mazes):
        folder = tmp_path / source.name
        publish(source, f"file:{folder}", pixels=not light)
        write_card(folder)
        fields = yaml.safe_load((folder / "README.md").read_text().split("---\n")[1])
        rows = datasets.load_dataset(str(folder), cache_dir=str(tmp_path / "cache"))["train"]
        release = Release.open(source)
        assert fields["configs"][0]["data_files"] == [{"split": "train", "path": "card/episodes.parquet"}]
        for row in rows:
            subset, episode = release[row["subset"]], row["episode"]
            name = shown(subset, "agents").arrays[0]
            assert np.array_equal(np.asarray(row["first_frame"]), subset.array(name)[episode, 0])
            assert row["return"] == subset.read("return", [episode])[0] and row["policy"] == "random"
            assert row["seed"] == subset.read("seed", [episode])[0]
        assert len(rows) == sum(len(subset.episodes) for subset in release.subsets.values())
        assert check_card(folder) == []


def test_the_place_and_day_of_publication_are_kept(copy):
    invoke("card", copy, "--url", "hf://datasets/me/small", code=0)
    path = copy / "croissant.json"
    data = json.loads(path.read_text())
    assert data["url"] == "https://huggingface.co/datasets/me/small"
    path.write_text(path.read_text().replace(data["datePublished"], "2001-02-03"))
    assert check_card(copy) == []
    write_card(copy)
    again = json.loads(path.read_text())
    assert (again["url"], again["datePublished"]) == (data["url"], "2001-02-03")


def test_a_fitting_card_passes_and_a_lying_one_is_found(copy):
    assert check_card(copy) == []
    readme = copy / "README.md"
    readme.write_text(readme.read_text().replace("1,500", "9,999", 1))
    assert check_card(copy) == ["README.md does not match the release"]
    roll_out(small_recipe(version="1.0.1"), copy)  # the same episodes, and another version
    (copy / "card/contact_sheet.png").unlink()
    (copy / "card/episodes.parquet").write_bytes(b"no table")
    lies = ("README.md", "croissant.json", "card/episodes.parquet")  # of this version they say nothing
    said = {*(f"{name} does not match the release" for name in lies), "card/contact_sheet.png is missing"}
    assert set(invoke("card", copy, "--check", code=1).output.splitlines()) == said


HOSTILE = "<img src=x>[a](javascript:alert(1))|b`\"'"


def test_names_become_no_markup(tmp_path):
    facts = {"authors": [HOSTILE], "license": HOSTILE, "description": HOSTILE, "size": 8}
    roll_out(short_recipe(settings="none", episodes=1, max_steps=3, **facts), tmp_path / "r")
    written = write_card(tmp_path / "r", tmp_path / "card")
    assert all(file.is_file() and tmp_path / "card" in file.parents for file in written)
    _, header, text = (tmp_path / "card/README.md").read_text().split("---\n", 2)
    assert yaml.safe_load(header)["license"] == HOSTILE.lower()
    for part in text.split("```")[::2]:
        assert "<" not in part and "](javascript:" not in part
    assert text.count("&#60;img src=x&#62;&#91;a&#93;(javascript:alert(1))&#124;b") == 3
    assert json.loads((tmp_path / "card/croissant.json").read_text())["creator"][0]["name"] == HOSTILE


def test_a_terminal_gets_no_commands_of_its_own(capsys):
    hostile = "\x1b]0;title\x07\u202ex"
    with click.Context(click.Command("x")):
        answer(False, None, hostile)
        print_table([hostile], [[hostile]], title=hostile)
    said = capsys.readouterr().out
    assert not set("\x1b\x07\u202e") & set(said) and said.count("?]0;title??x") == 4


def test_the_card_of_a_part_is_compared_by_its_rows(carded, tmp_path):
    part = tmp_path / "part"
    fetch(f"file:{carded}", part, ["*/none"], (0, 1))
    assert "the card matches the data" in invoke("card", part, "--check", code=0).output
    written = tmp_path / "written"
    write_card(part, written)
    text = (written / "README.md").read_text()
    assert "This is a part of small 1.0.0, which has 3 subsets and 9 episodes." in text
    distractors = text.split("## Distractors")[1].split("## Load it")[0]
    assert "| none |" in distractors and "dynamic" not in distractors and "videos" not in distractors
    used = json.loads((written / "croissant.json").read_text())["prov:wasGeneratedBy"]["prov:used"]
    assert [one["prov:label"] for one in used] == ["the recipe in recipes/"]
    table = pq.read_table(carded / "card/episodes.parquet")
    pq.write_table(table.slice(0, 0), part / "card/episodes.parquet")
    said = invoke("card", part, "--check", code=1).output
    assert "episodes.parquet does not match the local episodes" in said


def test_longer_episodes_are_not_compared_with_the_papers(tmp_path):
    roll_out(short_recipe(settings="none", episodes=1, max_steps=501, size=8), tmp_path / "r")
    write_card(tmp_path / "r")
    text = " ".join((tmp_path / "r/README.md").read_text().split())
    assert "| DMC-VB paper |" in text and "(z = " not in text


@pytest.mark.parametrize("repeat, held", [(1, "one control step"), (2, "two control steps"), (4, "four control steps")])
def test_the_control_steps_of_a_step_are_the_recipes(repeat, held, tmp_path):
    roll_out(short_recipe(settings="none", episodes=1, max_steps=2, size=8, action_repeat=repeat), tmp_path / "r")
    write_card(tmp_path / "r")
    text = (tmp_path / "r/README.md").read_text()
    assert f"A step is {held} with the same action." in text
    assert (f"An action is held for {held}, in DMC-VB for two control steps." in text) == (repeat != 2)


def test_a_card_replaces_no_other_readme_and_needs_a_release(carded, tmp_path):
    with pytest.raises(StoreError, match="holds no release"):
        write_card(tmp_path)
    begun = shutil.copytree(carded, tmp_path / "begun", ignore=lambda *_: ["manifest.json"])
    with pytest.raises(StoreError, match="is not complete; finish it with the same rollout"):
        write_card(begun)
    shutil.rmtree(begun)
    (tmp_path / "README.md").write_text("mine")
    with pytest.raises(StoreError, match="README.md is not a card, and it would be replaced"):
        write_card(carded, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]


def test_a_card_that_fails_leaves_the_release_as_it_was_and_none_goes_through_a_link(copy, tmp_path, monkeypatch):
    before = content(copy)
    with monkeypatch.context() as patch, pytest.raises(TypeError):
        patch.setattr("dmcvb_gen.release.card._sheet", None)
        write_card(copy)
    assert content(copy) == before and verify(copy).sound
    shutil.move(copy / "card", tmp_path / "elsewhere")
    (copy / "card").symlink_to(tmp_path / "elsewhere")
    before = content(tmp_path / "elsewhere")
    with pytest.raises(StoreError, match="is a link"):
        write_card(copy)
    assert content(tmp_path / "elsewhere") == before


@pytest.mark.slow
def test_a_card_of_the_overhead_view_alone_shows_it(small_mazes, tmp_path):
    publish(small_mazes, f"file:{tmp_path / 'there'}", pixels=False)
    fetch(f"file:{tmp_path / 'there'}", tmp_path / "r")
    invoke("paint", tmp_path / "r", "--views", "overhead", code=0)
    write_card(tmp_path / "r")
    assert check_card(tmp_path / "r") == []
    frames = pq.read_table(tmp_path / "r/card/episodes.parquet")["first_frame"].to_pylist()
    assert all(frame is not None for frame in frames)
