"""Parts of a release, made apart, give the manifest of the whole: the digests of one rollout of its recipe."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from PIL import Image

import dmcvb_gen
from dmcvb_gen.dataset.index import INDEX, read_index, root_digest, trusted_index
from dmcvb_gen.dataset.manifest import MANIFEST
from dmcvb_gen.dataset.reader import load_manifest
from dmcvb_gen.errors import StoreError
from dmcvb_gen.files import json_bytes
from dmcvb_gen.generate.join import join, join_folders
from dmcvb_gen.generate.recipe import load_recipe, make_recipe
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.generate.shipped import ENDING, manifest_source, pack, unpack
from dmcvb_gen.release.card import check_card, write_card
from dmcvb_gen.release.diff import diff
from tests.conftest import roll_out, small_recipe

CARDS = Path(__file__).parents[2] / "dataset_cards"
WALKER = {"tasks": "walker-walk", "levels": "random", "episodes": 3, "episodes_per_shard": 2, "max_steps": 20}
MAZE = {"tasks": "ant-maze-empty7x7", "levels": "random", "episodes": 2, "episodes_per_shard": 1, "max_steps": 20}
PATTERNS = {
    "walker": [WALKER | {"settings": ["none", "dynamic"]}],
    "maze": [MAZE | {"settings": ["visible", "hidden"]}],
}


def recipe(name, *families, **changes):
    return small_recipe(name=name, subsets=[pattern for family in families for pattern in PATTERNS[family]], **changes)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folders of the parts and of the whole, and the whole's recipe."""
    folder = tmp_path_factory.mktemp("join")
    for name in PATTERNS:
        roll_out(recipe(name, name), folder / name)
    roll_out(recipe("whole", *PATTERNS), folder / "whole")
    return folder


def test_joined_parts_have_the_root_digest_of_the_whole(made):
    manifest, index = join(recipe("whole", *PATTERNS), [made / "maze", made / "walker"])
    expected = load_manifest(made / "whole")[1]
    assert manifest.digest == expected.digest and manifest.digest is not None
    assert [record.digest for record in manifest.subsets] == [record.digest for record in expected.subsets]
    assert root_digest(index.files, manifest) == root_digest(read_index(made / "whole").files, expected)


@pytest.mark.parametrize("name", ["dmcvb-mini", "dmcvb-v1", "dmcvb-v1-locomotion", "quickstart"])
def test_a_shipped_release_joined_alone_is_itself(name):
    archive = CARDS / name / f"files{ENDING}"
    with manifest_source(archive) as folder:
        expected = load_manifest(folder)[1]
    if expected.additions:
        with pytest.raises(StoreError, match="grew"):
            join(load_recipe(name), [archive])
    else:
        assert join(load_recipe(name), [archive])[0] == expected
    with pytest.raises(StoreError, match="no digests of the files"):
        join(load_recipe(name), [name])


def test_the_whole_benchmark_is_its_shipped_parts():
    with manifest_source(CARDS / "dmcvb-v1" / f"files{ENDING}") as folder:
        expected = load_manifest(folder)[1]
    parts = sorted(CARDS.glob(f"dmcvb-v1-*/files{ENDING}"))
    assert len(parts) == 8
    assert join(load_recipe("dmcvb-v1"), parts)[0].digest == expected.digest


def test_the_folder_of_joined_parts_is_the_release_of_one_rollout(made, tmp_path):
    whole, parts, out = recipe("whole", *PATTERNS), [made / name for name in PATTERNS], tmp_path / "out"
    manifest = join_folders(whole, parts, out)
    assert manifest.digest == load_manifest(made / "whole")[1].digest
    checked = dmcvb_gen.verify(out, progress=False)
    assert checked.sound and checked.digest == manifest.digest
    assert not diff(made / "whole", out)
    action = "walker-walk/random/none.zarr/action/c/0/0/0"
    assert (out / action).samefile(made / "walker" / action), "a release of links needs no room"
    assert write_card(out) and not check_card(out)
    with pytest.raises(StoreError, match="is not empty"):
        join_folders(whole, parts, out)
    with pytest.raises(StoreError, match="manifest.json is a file; give another folder"):
        join_folders(whole, parts, out / MANIFEST)
    shutil.copytree(made / "walker", tmp_path / "walker")
    (tmp_path / "walker" / action).unlink()
    with pytest.raises(StoreError, match="action/c/0/0/0 is in none of the parts"):
        join_folders(whole, [tmp_path / "walker", made / "maze"], tmp_path / "lacking")


@pytest.mark.parametrize("family", PATTERNS)
def test_a_part_of_what_was_joined_is_made_again_with_its_bytes(made, tmp_path, family):
    manifest, index = join(recipe("whole", *PATTERNS), [made / name for name in PATTERNS])
    pack({MANIFEST: json_bytes(manifest), INDEX: json_bytes(index)}, tmp_path / "whole.tar.xz")
    (tmp_path / "bare").mkdir()
    for name, content in unpack(tmp_path / "whole.tar.xz").items():
        (tmp_path / "bare" / name).write_bytes(content)
    assert trusted_index(tmp_path / "bare", load_manifest(tmp_path / "bare")[1]) is not None
    name = next(record.name for record in manifest.subsets if ("maze" in record.task) == (family == "maze"))
    outcome = Regeneration(tmp_path / "bare", [name], (0, 1)).remake(tmp_path / "out")
    assert [shard.equal for shard in outcome.shards] == [True]


def test_parts_may_show_videos_of_their_own(tmp_path):
    for split in ("train", "val"):
        (tmp_path / "videos" / split).mkdir(parents=True)
        Image.new("RGB", (64, 64), "teal").save(tmp_path / "videos" / split / "still.png")
    clips = {"backgrounds": str(tmp_path / "videos")}
    for name in PATTERNS:
        roll_out(recipe(name, name, **clips), tmp_path / name)
    whole = recipe("whole", *PATTERNS, **clips)
    expected = roll_out(whole, tmp_path / "whole")
    assert join(whole, [tmp_path / name for name in PATTERNS])[0].digest == expected.digest


def test_what_does_not_fit_is_refused(made, tmp_path):
    whole, parts = recipe("whole", *PATTERNS), [made / name for name in PATTERNS]
    with pytest.raises(StoreError, match="walker-walk/random/none of whole is in none of the parts"):
        join(whole, parts[1:])
    with pytest.raises(StoreError, match="was made with seed 3, and whole has 4"):
        join(recipe("whole", *PATTERNS, seed=4), parts)
    with pytest.raises(StoreError, match="was made with trajectories shared, and whole has independent"):
        join(recipe("whole", *PATTERNS, trajectories="independent"), parts)
    with pytest.raises(StoreError, match="holds ant-maze.*which whole does not have"):
        join(recipe("whole", "walker"), parts)
    with pytest.raises(StoreError, match="was made with size 16, and whole has 32"):
        join(recipe("whole", *PATTERNS, size=32), parts)
    longer = recipe("whole", *PATTERNS).model_dump()
    longer["subsets"][0]["max_steps"] = 30
    with pytest.raises(StoreError, match="walker-walk/random/none was not made as whole says"):
        join(make_recipe(longer), parts)
    shutil.copytree(made / "walker", tmp_path / "altered")
    altered = load_manifest(tmp_path / "altered")[1]
    first = altered.subsets[0].model_copy(update={"digest": "0" * 64})
    altered = altered.model_copy(update={"subsets": (first, *altered.subsets[1:])})
    altered = altered.model_copy(update={"digest": root_digest(read_index(made / "walker").files, altered)})
    (tmp_path / "altered" / MANIFEST).write_bytes(json_bytes(altered))
    with pytest.raises(StoreError, match="walker-walk/random/none of .*altered is not that of a part before it"):
        join(whole, [*parts, tmp_path / "altered"])
    with pytest.raises(StoreError, match="not complete"):
        shutil.copytree(made / "walker", tmp_path / "walker")
        (tmp_path / "walker" / INDEX).unlink()
        join(whole, [tmp_path / "walker", made / "maze"])
