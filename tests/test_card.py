"""Cards say what the data say; Croissant's own validator accepts the metadata; a card that lies is found."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from PIL import Image

from dmcvb_gen.behaviours.policies.paper import paper_returns
from dmcvb_gen.cli import main
from dmcvb_gen.errors import StoreError
from dmcvb_gen.release.card import check_card, write_card
from dmcvb_gen.store import open_release
from dmcvb_gen.store.writer import sha256_file


@pytest.fixture(scope="module")
def carded(small_release, tmp_path_factory):
    folder = tmp_path_factory.mktemp("card") / "small"
    shutil.copytree(small_release, folder)
    write_card(folder)
    return folder


@pytest.fixture
def copy(carded, tmp_path):
    shutil.copytree(carded, tmp_path / "copy")
    return tmp_path / "copy"


def test_the_header_is_what_hugging_face_reads(carded):
    _, header, text = (carded / "README.md").read_text().split("---\n", 2)
    fields = yaml.safe_load(header)
    assert fields["license"] == "cc-by-4.0" and fields["size_categories"] == ["1K<n<10K"]
    assert "reinforcement-learning" in fields["task_categories"] and fields["pretty_name"] == "small 1.0.0"
    assert text.startswith("\n# small 1.0.0")


def test_the_numbers_are_the_datas_and_the_papers(carded):
    text = (carded / "README.md").read_text()
    for subset in open_release(carded).subsets.values():
        row = next(line for line in text.split("## Returns")[1].splitlines() if f"`{subset.name}`" in line)
        assert f"| {subset.returns.mean():.1f} | {subset.returns.std():.1f} |" in row
        assert subset.record.digest[:12] in text
    paper = paper_returns("walker-walk", "random")
    assert f"| DMC-VB paper | {paper['mean']:.1f} | {paper['std']:.1f} |" in text
    assert "s = 0.2" in text and "uniform random actions" in text and "Known limits" in text
    assert "regenerate small --check" in text and "@inproceedings{ortiz2024dmcvb" in text


def test_pictures_are_there_and_named(carded):
    text = (carded / "README.md").read_text()
    for name in ("card/returns.png", "card/contact_sheet.png"):
        assert f"]({name})" in text
        picture = np.asarray(Image.open(carded / name))
        assert picture.shape[0] > 50 and picture.std() > 5


def test_croissants_validator_accepts_the_metadata_and_reads_its_records(carded):
    mlc = pytest.importorskip("mlcroissant")
    dataset = mlc.Dataset(carded / "croissant.json")
    assert not dataset.metadata.issues.errors
    rows = list(dataset.records("subsets"))
    assert len(rows) == 3 and {row["subsets/steps"] for row in rows} == {1500}
    data = json.loads((carded / "croissant.json").read_text())
    for file in data["distribution"]:
        assert file["sha256"] == sha256_file(carded / file["contentUrl"])


def test_a_fitting_card_passes_and_a_lying_one_is_found(copy):
    assert check_card(copy) == []
    readme = copy / "README.md"
    readme.write_text(readme.read_text().replace("1,500", "9,999", 1))
    [finding] = check_card(copy)
    assert finding.startswith("README.md does not fit the release at line ")
    write_card(copy)
    data = json.loads((copy / "manifest.json").read_text()) | {"version": "1.0.1"}
    (copy / "manifest.json").write_text(json.dumps(data))
    assert len(check_card(copy)) == 3  # README, croissant.json, and a changelog that does not know the version
    (copy / "card/contact_sheet.png").unlink()
    result = CliRunner().invoke(main, ["card", str(copy), "--check"])
    assert result.exit_code == 1 and "CHANGELOG.md does not speak of version 1.0.1" in result.output
    assert "picture" in result.output


def test_a_changelog_of_the_authors_is_kept(copy):
    (copy / "CHANGELOG.md").write_text("# Ours\n\n## 1.0.0\n\n- Much better.\n")
    result = CliRunner().invoke(main, ["card", str(copy)])
    assert result.exit_code == 0 and "Much better" in (copy / "CHANGELOG.md").read_text() and check_card(copy) == []


def test_a_card_can_lie_elsewhere(carded, tmp_path):
    files = write_card(carded, tmp_path / "cards")
    assert all(file.is_file() and tmp_path in file.parents for file in files)


def test_no_release_no_card(tmp_path):
    with pytest.raises(StoreError, match="holds no release"):
        write_card(tmp_path)
