"""DMC-VB's published folders come in whole: imports of locomotion and mazes, read, checked, exported, refused."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

import dmcvb_gen
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.regenerate import Regeneration
from dmcvb_gen.generate.repaint import Repainting, repaint
from dmcvb_gen.release.card import check_card, write_card
from dmcvb_gen.release.export import export
from dmcvb_gen.release.export.episodes import png
from dmcvb_gen.release.import_tfds import import_tfds
from dmcvb_gen.release.tfrecord import encode_example, offsets, read_example, record
from dmcvb_gen.release.verify import verify
from tests.conftest import TINY_MAZE, invoke, roll_out, short_recipe, small_recipe

NAME = "walker-walk/random/static"


@pytest.fixture(scope="module")
def rlds(small_release, tmp_path_factory):
    """Episodes 0 and 1 of the static subset as TFDS has them."""
    [folder] = export(small_release, "rlds", tmp_path_factory.mktemp("rlds"), [NAME], (0, 2))
    return folder


@pytest.fixture(scope="module")
def imported(rlds, tmp_path_factory):
    """A release imported from a folder in DMC-VB's layout: locomotion/<task>/<level>/<setting>."""
    root = tmp_path_factory.mktemp("dmc_vb")
    target = root / "locomotion/walker_walk/random/static_medium"
    target.parent.mkdir(parents=True)
    shutil.copytree(rlds, target)
    done = invoke("import", root / "locomotion", "--out", root / "release", code=0)
    assert f"{NAME}: 2 episodes" in done.output
    return root / "release"


def test_dmc_vbs_folders_are_imported_whole(imported, small_release):
    release = dmcvb_gen.open(imported)
    assert list(release.subsets) == [NAME] and not release.shortfalls
    for index in range(2):
        found, made = release[NAME].episode(index), Release.open(small_release)[NAME].episode(index)
        for name in ("pixels", "state", "action", "reward", "discount", "length", "terminated", "return"):
            np.testing.assert_array_equal(found[name], made[name])
    assert verify(imported).sound
    assert next(release[NAME].batches(16))["pixels"].shape == (16, 9, 16, 16)
    with pytest.raises(StoreError, match="was imported"):
        Regeneration(imported).check()
    with pytest.raises(StoreError, match="was imported"):
        repaint(Repainting(imported, imported.parent / "x", size=8))


def test_an_imported_release_keeps_its_pictures(imported, tmp_path):
    """Nobody could paint them again."""
    refused = invoke("publish", imported, f"file:{tmp_path / 'there'}", "--no-pixels", code=2).output
    assert "publish it with them, without --no-pixels" in refused and not (tmp_path / "there").exists()
    with pytest.raises(StoreError, match="was imported.*without paint"):
        dmcvb_gen.open(str(imported), paint=True)


@pytest.mark.slow_cases("mazes")
@pytest.mark.parametrize("family", ["locomotion", "mazes"])
def test_the_card_of_imported_data_fits_and_claims_nothing_that_it_has_not(request, small_mazes, tmp_path, family):
    folder = tmp_path / "r"
    if family == "mazes":
        import_tfds(request.getfixturevalue("dmcvb_mazes"), folder)
    else:
        shutil.copytree(request.getfixturevalue("imported"), folder)
    write_card(folder)
    assert check_card(folder) == []
    text, metadata = (folder / "README.md").read_text(), (folder / "croissant.json").read_text()
    assert "Imported by dmcvb-gen" in text and "those of the imported data" in text
    for claim in ("regenerate", "full physics states", "`exogenous/`", "`physics`", "exogenous/style", "seed None"):
        assert claim not in text, claim
    assert "can be regenerated from them" not in metadata and "roll out" not in metadata
    if family == "mazes":
        share = Release.open(small_mazes)["ant-maze-tiny/random/fixed"].read("terminated").mean()
        assert f"| `ant-maze-empty7x7/expert/fixed` | {share:.0%} |" in text


def test_damaged_or_foreign_folders_are_not_imported(rlds, tmp_path):
    with pytest.raises(StoreError, match="no features.json"):
        import_tfds(tmp_path, tmp_path / "r")
    (tmp_path / "odd").mkdir()
    steps = {"featuresDict": {"features": {"reward": [1, 2]}}}
    tree = {"featuresDict": {"features": {"steps": {"sequence": {"feature": steps}}}}}
    (tmp_path / "odd/features.json").write_text(json.dumps(tree))
    with pytest.raises(StoreError, match="features.json does not describe RLDS steps"):
        import_tfds(tmp_path / "odd", tmp_path / "r", task="walker-walk", level="expert", setting="none")
    shutil.copytree(rlds, tmp_path / "somewhere")
    with pytest.raises(StoreError, match="task, level"):
        import_tfds(tmp_path / "somewhere", tmp_path / "r")
    [path] = (tmp_path / "somewhere").rglob("*.tfrecord-*")
    data = path.read_bytes()
    what = dict(task="walker-walk", level="random", setting="static")
    in_its_length = data[:8] + bytes([data[8] ^ 1]) + data[9:]  # the checksum of it
    for damaged in (data[:-100], data[:5000] + b"x" + data[5001:], b"not records at all", in_its_length):
        path.write_bytes(damaged)
        with pytest.raises(StoreError, match="damaged"):
            import_tfds(tmp_path / "somewhere", tmp_path / "r", **what)


ODD = {
    r"RLDS episodes at byte \d+: no tf.train.Example \(": lambda example: b"\xff",
    r"RLDS episodes at byte \d+: no tf.train.Example with features": lambda example: b"",
    "an image of .* instead of 16": lambda example: encode_example(
        example | {"steps/observation/pixels": [png(np.zeros((17, 16, 3), np.uint8))] * 501}
    ),
    "is not one of walker-walk: .steps/action": lambda example: encode_example(
        {name: value for name, value in example.items() if name != "steps/action"}
    ),
}
"""Refusal -> the bytes of a record, whose checksums are right, made of a whole one."""


@pytest.mark.parametrize("said", ODD)
def test_records_that_are_no_episodes_are_refused(said, rlds, tmp_path):
    shutil.copytree(rlds, tmp_path / "odd")
    [path] = (tmp_path / "odd").rglob("*.tfrecord-*")
    path.write_bytes(record(ODD[said](read_example(path, *next(iter(offsets(path)))))))
    with pytest.raises(StoreError, match=said):
        import_tfds(tmp_path / "odd", tmp_path / "r", task="walker-walk", level="random", setting="static")


@pytest.fixture(scope="module")
def dmcvb_mazes(small_mazes, tmp_path_factory):
    """Maze folders as DMC-VB has them: 165 numbers (no height, no activation), fixed goals a folder a seed."""
    root = tmp_path_factory.mktemp("dmc_vb_mazes")
    left_out = ("steps/observation/walker/body_height", "steps/observation/target_activated")
    for setting in ("visible", "hidden", "fixed"):
        for episodes in ((0, 1), (1, 2)) if setting == "fixed" else ((0, 2),):
            out = root / f"made_{setting}_{episodes[0]}"
            [made] = export(str(small_mazes), "rlds", out, [f"*/{setting}"], episodes)
            for file in made.rglob("*.tfrecord*"):
                examples = [read_example(file, *place) for place in offsets(file)]
                thinned = [{k: v for k, v in example.items() if k not in left_out} for example in examples]
                assert all(len(t) == len(e) - 2 for t, e in zip(thinned, examples, strict=True))
                file.write_bytes(b"".join(record(encode_example(example)) for example in thinned))
            place = f"antmaze_random_{setting}_goal/empty7x7/expert"
            place = f"antmaze_fixed_hidden_goal/empty7x7/{episodes[0]}" if setting == "fixed" else place
            (root / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.move(made, root / place)
            shutil.rmtree(out)
    return root


def test_dmc_vbs_mazes_are_imported_by_the_names_of_their_fields(dmcvb_mazes, small_mazes, tmp_path):
    import_tfds(dmcvb_mazes, tmp_path / "r")
    release, ours = dmcvb_gen.open(str(tmp_path / "r")), Release.open(small_mazes)
    assert len(release.subsets) == 3 and not release.shortfalls
    for setting in ("visible", "hidden", "fixed"):
        subset, made = release[f"ant-maze-empty7x7/expert/{setting}"], ours[f"ant-maze-tiny/random/{setting}"]
        assert subset.record.hidden_goal == (setting != "visible") and subset.record.views == made.record.views
        assert subset.record.fixed_goals == (2 if setting == "fixed" else None)
        root = "pixels" if setting == "visible" else "pixels_hidden_goal"
        assert set(subset.pixel_arrays) == {f"{root}/{view}" for view in made.record.views}
        for index in range(2):
            found, expected = subset.episode(index), made.episode(index)
            for name in (*subset.pixel_arrays, "state", "action", "reward", "discount", "terminated", "goal_pair"):
                np.testing.assert_array_equal(found[name], expected[name])
        batch = next(subset.batches(8, pictures=["top"]))
        assert batch["pixels"].shape == (8, 9, 16, 16) and batch["state"].shape == (8, 167)
    result = verify(tmp_path / "r")
    assert result.sound, result.findings


def test_folders_that_lack_files_are_imported_only_when_asked(rlds, tmp_path):
    place = "locomotion/walker_walk/random/static_medium"
    shutil.copytree(rlds, tmp_path / place)
    [whole] = (tmp_path / place).rglob("*.tfrecord-*")
    data = [record(encode_example(read_example(whole, *episode))) for episode in offsets(whole)]
    whole.unlink()
    for number, content in enumerate((*data, b"")):  # three files, an episode or none each
        whole.with_name(f"{whole.name.rsplit('-', 3)[0]}-{number:05d}-of-00003").write_bytes(content)
    [first] = (tmp_path / place).rglob("*-00000-of-*")
    hidden = first.rename(tmp_path / "away")
    command = ["import", tmp_path / "locomotion", "--out", tmp_path / "r"]
    assert "2 of 3 files (number 0 is missing)" in invoke(*command, code=2).output and not (tmp_path / "r").exists()
    for _ in range(2):
        assert "1 episode" in invoke(*command, "--partial", code=0).output
    hidden.rename(first)
    before = (tmp_path / "r/manifest.json").read_bytes()
    assert "choose another --out" in invoke(*command, code=2).output
    assert (tmp_path / "r/manifest.json").read_bytes() == before


def test_pairs_of_fixed_goals_are_those_of_the_folders_or_of_our_exports(dmcvb_mazes, small_mazes, tmp_path):
    place = "antmaze_fixed_hidden_goal"
    shutil.copytree(dmcvb_mazes / place, tmp_path / place)
    first, _ = sorted((tmp_path / place).rglob("*.tfrecord-*"))
    first.write_bytes(first.read_bytes() * 3)
    import_tfds(tmp_path / place, tmp_path / "r")
    [subset] = dmcvb_gen.open(tmp_path / "r").subsets.values()
    assert subset.read("goal_pair").tolist() == [0, 0, 0, 1]
    [made] = export(str(small_mazes), "rlds", tmp_path / "out", ["*/fixed"])
    import_tfds(made, tmp_path / "ours", task="ant-maze-empty7x7", level="random", setting="fixed")
    [subset] = dmcvb_gen.open(tmp_path / "ours").subsets.values()
    assert subset.read("goal_pair").tolist() == [0, 1]
    assert (subset.record.fixed_goals, subset.record.episodes_per_goal) == (2, 1)
    assert subset.goal_seed == dmcvb_gen.open(small_mazes)[f"{TINY_MAZE.split(':')[0]}/random/fixed"].goal_seed
    with pytest.raises(StoreError, match="unites levels; export each of them"):
        import_tfds(made, tmp_path / "u", task="walker-walk", level="medium-expert", setting="none")


@pytest.mark.parametrize("repeat", [1, 4])
def test_our_own_exports_come_back_with_their_action_repeat(repeat, tmp_path):
    roll_out(short_recipe(settings="none", episodes=1, action_repeat=repeat), tmp_path / "r")
    roll_out(small_recipe(tasks="ant-maze-empty7x7", settings=["hidden"], episodes=1, max_steps=3), tmp_path / "m")
    for made in ("r", "m"):
        export(str(tmp_path / made), "rlds", tmp_path / "out" / made)
        import_tfds(tmp_path / "out" / made, tmp_path / "back" / made)
        [before], [after] = (dmcvb_gen.open(tmp_path / at / made).subsets.values() for at in ("", "back"))
        for field in ("name", "action_repeat", "seconds_per_step", "setting"):
            assert getattr(after.record, field) == getattr(before.record, field)
    assert verify(tmp_path / "back/r").sound


def test_folders_that_do_not_say_what_they_are_are_refused(dmcvb_mazes, tmp_path):
    shutil.copytree(dmcvb_mazes / "antmaze_random_hidden_goal/empty7x7/expert", tmp_path / "x")
    with pytest.raises(StoreError, match="antmaze_fixed_hidden_goal/empty7x7/<seed>"):
        import_tfds(tmp_path / "x", tmp_path / "r")
    what = dict(task="ant-maze-empty7x7", level="expert")
    with pytest.raises(StoreError, match="no image observation/lowres_top_camera;"):
        import_tfds(tmp_path / "x", tmp_path / "r", **what, setting="visible")
    import_tfds(tmp_path / "x", tmp_path / "r", **what, setting="hidden")


def test_the_time_limit_is_that_of_a_late_episode_if_the_first_ones_reach_the_goal(dmcvb_mazes, tmp_path):
    place = "antmaze_random_visible_goal/empty7x7/expert"
    shutil.copytree(dmcvb_mazes / place, tmp_path / place)
    [file] = (tmp_path / place).rglob("*.tfrecord-*")
    example = read_example(file, *next(iter(offsets(file))))
    steps = {name: value for name, value in example.items() if name.startswith("steps/")}
    count = len(steps["steps/reward"])
    short = {name: value[: len(value) * 3 // count] for name, value in steps.items()}  # two transitions
    short |= {"steps/is_terminal": np.array([0, 0, 1])}
    cut = {name: value[: len(value) * 5 // count] for name, value in steps.items()}
    cut |= {"steps/is_terminal": np.zeros(5, int)}
    few = record(encode_example(short)), record(encode_example(cut))
    file.write_bytes(few[0] * 25 + few[1])
    import_tfds(tmp_path / place.split("/")[0], tmp_path / "r")
    [subset] = Release.open(tmp_path / "r").subsets.values()
    assert subset.record.max_steps == 4 and subset.read("length").tolist() == [2] * 25 + [4]
