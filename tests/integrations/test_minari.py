"""Minari opens its data sets where it looks for them, and makes the environments that they came from."""

import minari
import numpy as np
import pytest
from minari.cli import app
from typer.testing import CliRunner as TyperRunner

import dmcvb_gen
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.generate.references import reference_returns
from dmcvb_gen.release.export import export
from dmcvb_gen.tasks import get_task
from tests.conftest import roll_out, short_recipe
from tests.distractors.test_backgrounds import write_frames


@pytest.fixture(scope="module")
def datasets(stored, tmp_path_factory):
    root = tmp_path_factory.mktemp("minari")
    for one in stored.values():
        export(str(one.folder), "minari", root, [one.name])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        yield {name: "dmcvb_gen/{}-{}-v0".format(*name.rsplit("/", 1)) for name in stored}


def test_minari_lists_what_was_exported(datasets):
    found = minari.list_local_datasets()
    assert set(found) == set(datasets.values())
    assert all(facts["dataset_size"] > 0 for facts in found.values())
    result = TyperRunner().invoke(app, ["list", "local"])
    assert result.exit_code == 0 and "dmcvb_gen" in result.output, result.output
    spaces = {"dmcvb_gen", *(name.rpartition("/")[0] for name in datasets.values())}
    assert set(minari.namespace.list_local_namespaces()) == spaces
    about = {space: minari.namespace.get_namespace_metadata(space)["description"] for space in spaces}
    assert "dmcvb-gen" in about["dmcvb_gen"] and len(set(about.values())) == len(spaces)


def test_an_episode_is_terminated_or_truncated_as_it_was(datasets, stored):
    for name, dataset_id in datasets.items():
        for index, episode in enumerate(minari.load_dataset(dataset_id).iterate_episodes()):
            assert episode.terminations[-1] == stored[name].episode(index)[2] != episode.truncations[-1]


def test_environments_are_recovered_with_the_spaces_of_the_data(datasets):
    for name, dataset_id in datasets.items():
        dataset = minari.load_dataset(dataset_id)
        for evaluation, split in ((False, "train"), (True, "val")):
            env = dataset.recover_environment(eval_env=evaluation)
            assert env.observation_space == dataset.observation_space, name
            assert env.action_space == dataset.action_space
            assert env.spec.id.startswith(f"dmcvb_gen/{name.split('-')[0]}-") and env.spec.id.endswith("-v0")
            assert env.unwrapped._stage.split == split
            assert env.unwrapped._stage.max_steps == (500 if name.startswith("walker") else 100)
            assert env.unwrapped._stage.pictures.hide_goal == name.endswith(("hidden", "fixed"))
            env.close()


def test_the_environment_of_the_data_shows_its_split_and_the_videos_that_it_is_given(tmp_path, monkeypatch):
    for split, grey in (("train", 10), ("val", 250)):
        frames = np.full((3, 256, 256, 3), (grey, 0, 255 - grey), np.uint8)
        write_frames(tmp_path / "videos" / split / "one", frames, "png")
    shown = {"backgrounds": str(tmp_path / "videos"), "split": "val", "size": 32}
    recipe = short_recipe(settings="static", episodes=1, max_steps=3, action_repeat=1, **shown)
    videos = roll_out(recipe, tmp_path / "r").manifest.subsets[0].backgrounds["source"]
    export(str(tmp_path / "r"), "minari", tmp_path / "out")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "out"))
    dataset = minari.load_dataset("dmcvb_gen/walker-walk/random-static-v0")
    assert f"recover_environment(backgrounds=FOLDER), the release's {videos}" in dataset.storage.metadata["description"]
    assert str(tmp_path) not in str(dataset.storage.metadata)
    [episode] = dataset.iterate_episodes()
    with pytest.raises(DmcvbError, match="videos of their own .* give their folder with backgrounds=FOLDER"):
        dataset.recover_environment()
    env = dataset.recover_environment(backgrounds=str(tmp_path / "r" / videos))
    assert env.unwrapped.task.action_repeat == 1
    assert env.unwrapped._stage.split == "val"
    color = env.reset(seed=0)[0]["pixels"][0].mean(axis=0)  # the topmost line: sky
    env.close()
    assert np.abs(color - episode.observations["pixels"][0, 0].mean(axis=0)).max() < 5


def test_references_are_of_episodes_as_long_as_the_datas(maze_release, tmp_path):
    roll_out(short_recipe(settings="none", episodes=2, max_steps=10), tmp_path / "short")
    release = dmcvb_gen.open(str(tmp_path / "short"))
    record = release["walker-walk/random/none"].record
    assert reference_returns(release, record) is None  # the package's expert was measured over 500 steps
    expert = record.model_copy(update={"level": "expert"})
    release.subsets["x"] = type(release["walker-walk/random/none"])(release, expert)
    release.subsets["x"].__dict__["returns"] = np.array([15.0])
    low, high = reference_returns(release, record)
    assert high == 15 and 0 < low < 10
    assert reference_returns(release, record.model_copy(update={"return_range": (1.0, 3.0)})) == (1, 3)
    mazes = dmcvb_gen.open(str(maze_release))
    whole = mazes["ant-maze-tiny/random/visible"].record
    assert whole.max_steps == get_task(whole.task).max_steps and reference_returns(mazes, whole) is None  # no expert


def test_scores_are_normalized_between_random_and_expert(datasets):
    dataset = minari.load_dataset(datasets["walker-walk/random/static"])
    low, high = (dataset.storage.metadata[name] for name in ("ref_min_score", "ref_max_score"))
    assert 10 < low < 100 < 850 < high < 1000
    assert minari.get_normalized_score(dataset, np.array([low, high])) == pytest.approx([0, 1])
    assert dataset.storage.metadata["algorithm_name"] == "random"
