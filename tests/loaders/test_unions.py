"""Unions of subsets, as D4RL names them: each form of reading gives the steps of both parts, and exports take them."""

import json
import pickle

import numpy as np
import pytest

import dmcvb_gen
from dmcvb_gen.benchmarks.report import plan_validation
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.release.export import export
from tests.conftest import roll_out, small_recipe
from tests.loaders.conftest import FAMILIES


def all_steps(folder, names, array):
    """All steps of an array, as the subsets themselves have them."""
    release = Release.open(folder)
    return np.concatenate([values[array] for name in names for _, values in release[name].each_episode([array])])


def in_order(batches):
    """The steps of batches by episode and step."""
    batches = list(batches)
    values = {name: np.concatenate([np.asarray(batch[name]) for batch in batches]) for name in batches[0]}
    order = np.lexsort((values["step"], values["episode"]))
    return {name: value[order] for name, value in values.items()}


@pytest.mark.slow_cases("ant-maze-empty7x7")
def test_every_form_gives_the_steps_of_both_parts(levels):
    folder, parts = levels
    union = dmcvb_gen.open(folder).union(*parts)
    assert len(union) == 5 and union.name == parts[0].replace("random", "random-expert")
    forms = [union, dmcvb_gen.open(folder)[union.name], pickle.loads(pickle.dumps(union))]
    forms += [dmcvb_gen.open(folder, paint=True)[union.name]]
    batches = [in_order(each.batches(4, pictures="agents")) for each in forms]
    batches += [in_order(union.torch("stream", batch_size=4, pictures="agents"))]
    sources = [union.source(pictures="agents", in_memory=held) for held in (True, False)]
    batches += [source.gather(range(len(source))) for source in sources]
    for batch in batches:
        assert batch["episode"].tolist() == np.repeat(range(5), union.lengths).tolist()
        for array in ("action", "reward", "discount"):
            np.testing.assert_array_equal(batch[array], all_steps(folder, parts, array))
        np.testing.assert_array_equal(batch["pixels"], batches[0]["pixels"])
    release = Release.open(folder)
    for episode, (name, own) in enumerate([*((parts[0], e) for e in range(3)), *((parts[1], e) for e in range(2))]):
        one, other = union.episode(episode), release[name].episode(own)
        assert (one.pop("behaviour"), other.pop("behaviour")) == (-1 if name == parts[0] else 0, 0)
        assert one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)
        np.testing.assert_array_equal(union.array("state")[episode, 2:4], other["state"][2:4])
        np.testing.assert_array_equal(union.xarray([episode, 0])["physics"][0, : len(one["physics"])], one["physics"])
    np.testing.assert_array_equal(union.array("state")[[4, 0]], union.read("state", [4, 0]))
    assert not union.unpainted.any() and [list(part.episodes) for part in union.part([4, 1]).parts] == [[1], [1]]
    assert union.bytes == sum(dmcvb_gen.open(folder)[name].bytes for name in parts)


@pytest.mark.slow_cases("ant-maze-empty7x7")
def test_fresh_distractors_of_a_union_come_with_the_epoch(levels):
    folder, parts = levels
    union = dmcvb_gen.open(folder, paint=True, distractors="resample").union(*parts)
    data, seen = union.torch("steps", pictures="agents", episodes=[4]), []
    for epoch in (0, 1, 0):
        data.set_epoch(epoch)
        seen.append(data[3]["pixels"].numpy())
    assert np.array_equal(seen[0], seen[2]) and not np.array_equal(seen[0], seen[1])


def test_an_export_of_a_union_holds_the_episodes_of_both_parts_and_is_not_made_twice(levels, tmp_path):
    folder, parts = levels
    name = parts[0].replace("random", "random-expert")
    [out] = dmcvb_gen.export(folder, "npz", tmp_path, only=name, progress=False)
    assert out == tmp_path / name
    actions = np.concatenate([np.load(path)["action"][1:] for path in sorted(out.glob("*.npz"))])
    np.testing.assert_array_equal(actions, all_steps(folder, parts, "action"))
    stamp = json.loads((out / ".dmcvb-gen.json").read_text())
    dmcvb_gen.export(folder, "npz", tmp_path, only=name, progress=False)
    assert json.loads((out / ".dmcvb-gen.json").read_text()) == stamp and stamp["subsets"][0][2] == [0, 1, 2, 3, 4]
    both = dict(only=[parts[0], name], episode_range=(2, 3), progress=False)
    assert len(dmcvb_gen.export(folder, "minari", tmp_path / "minari", **both)) == 2


def test_exports_of_equal_names_are_told_apart_by_datasets(levels, tmp_path):
    datasets = pytest.importorskip("datasets")
    folder, parts = levels
    release, union = dmcvb_gen.open(folder), parts[0].replace("random", "random-expert")
    made = export(str(folder), "lerobot", tmp_path / "out", [*parts, union])
    tables = [datasets.load_dataset(str(one), split="train", cache_dir=str(tmp_path / "cache")) for one in made]
    steps = [release["/".join(one.parts[-3:])].read("length").sum() for one in made]
    assert [len(table) for table in tables] == steps


@pytest.mark.parametrize(
    ("other", "field"), [({"fixed_goals": 1}, "fixed_goals"), ({"seed": 1}, "the seed of their goals")]
)
def test_fixed_goals_of_other_numbers_or_seeds_are_no_union(other, field, tmp_path):
    maze = {"tasks": "ant-maze-empty7x7", "settings": ["fixed"], "fixed_goals": 2, "episodes_per_goal": 1}
    for changes in ({"levels": "expert"}, {"levels": "medium"} | other):
        roll_out(small_recipe(**maze | {"max_steps": 3, "seed": 0} | changes), tmp_path / "r", pixels=False)
    with pytest.raises(DmcvbError, match=field):
        dmcvb_gen.open(tmp_path / "r")["ant-maze-empty7x7/expert-medium/fixed"]


def test_validate_takes_both_parts(levels):
    folder, parts = levels
    name = parts[0].replace("random", "random-expert")
    chosen, cells, _ = plan_validation(Release.open(folder), ["b1"], ["bc"], [name])
    assert sorted(chosen.subsets) == sorted(parts) and {p.subset for c in cells for p in c.policy} <= {*parts}


def test_subsets_of_other_settings_and_unknown_levels_are_no_union(levels):
    folder, parts = levels
    release, other = dmcvb_gen.open(folder), FAMILIES[parts[0].split("/")[0]]
    with pytest.raises(DmcvbError, match="differ in setting; unite subsets that are alike in it"):
        release.union(parts[0], parts[1].replace(other[1], other[0]))
    with pytest.raises(UnknownNameError, match="unknown subset"):
        release[parts[0].replace("random", "medium-expert")]
    with pytest.raises(DmcvbError, match="1 subsets are given; name two or more"):
        release.union(parts[0])
    with pytest.raises(DmcvbError, match="is a union; pair its parts"):
        release.union(*parts).paired(*other)
