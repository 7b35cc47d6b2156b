"""Minari opens its data sets where it looks for them, and makes the environments that they came from."""

from __future__ import annotations

import minari
import numpy as np
import pytest
from minari.cli import app
from typer.testing import CliRunner

from dmcvb_gen.release.export import export


@pytest.fixture(scope="module")
def datasets(stored, tmp_path_factory):
    root = tmp_path_factory.mktemp("minari")
    for one in stored.values():
        export(str(one.folder), "minari", root, [one.name])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        yield {
            name: f"dmcvb_gen/{name.rsplit('/', 1)[0]}-{one.name.rsplit('/', 1)[1]}-v0" for name, one in stored.items()
        }


def test_minari_lists_what_was_exported(datasets):
    found = minari.list_local_datasets()
    assert set(found) == set(datasets.values())
    assert all(facts["dataset_size"] > 0 for facts in found.values())
    result = CliRunner().invoke(app, ["list", "local"])
    assert result.exit_code == 0 and "dmcvb_gen" in result.output, result.output
    assert minari.namespace.list_local_namespaces() >= ["dmcvb_gen"]


def test_episodes_have_the_pictures_that_the_subset_is_about(datasets, stored):
    for name, dataset_id in datasets.items():
        dataset = minari.load_dataset(dataset_id)
        for index, episode in enumerate(dataset.iterate_episodes()):
            length, values, terminated = stored[name].episode(index)
            pixels = np.moveaxis(values["pixels"], 1, 3)
            expected = pixels.reshape(*pixels.shape[:3], -1)
            np.testing.assert_array_equal(episode.observations["pixels"], expected)
            np.testing.assert_array_equal(episode.observations["state"], values["state"])
            np.testing.assert_array_equal(episode.actions, values["action"])
            np.testing.assert_array_equal(episode.rewards, values["reward"])
            assert len(episode.actions) == length and episode.terminations[-1] == terminated != episode.truncations[-1]


def test_environments_are_recovered_with_the_spaces_of_the_data(datasets):
    for name, dataset_id in datasets.items():
        dataset = minari.load_dataset(dataset_id)
        for evaluation, split in ((False, "train"), (True, "val")):
            env = dataset.recover_environment(eval_env=evaluation)
            assert env.observation_space == dataset.observation_space, name
            assert env.action_space == dataset.action_space
            assert env.unwrapped._stage.split == split
            assert env.unwrapped._stage.pictures.hide_goal == name.endswith(("hidden", "fixed"))
            env.close()


def test_scores_are_normalized_between_random_and_expert(datasets):
    dataset = minari.load_dataset(datasets["walker-walk/random/static"])
    low, high = (dataset.storage.metadata[name] for name in ("ref_min_score", "ref_max_score"))
    assert 10 < low < 100 < 850 < high < 1000
    assert minari.get_normalized_score(dataset, np.array([low, high])) == pytest.approx([0, 1])
    assert dataset.storage.metadata["algorithm_name"] == "random"
