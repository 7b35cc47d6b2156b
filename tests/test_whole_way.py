"""One small release of each family through every command, from rollout to the environment that it came from."""

from __future__ import annotations

import json
import shutil

import gymnasium
import numpy as np
import pytest
import zarr
from click.testing import CliRunner

import dmcvb_gen
from dmcvb_gen.cli import main
from dmcvb_gen.dataset import Release
from dmcvb_gen.tasks import get_task

SIZE = 16
FAMILIES = {
    "locomotion": ("walker-walk", ["--distractor", "none", "--distractor", "dynamic"], ("none", "dynamic")),
    "mazes": (
        "ant-maze-easy7x7b",
        ["--goal", "visible", "--goal", "hidden", "--goal", "fixed2"],
        ("visible", "hidden", "fixed"),
    ),
}


def run(*command, code=0):
    result = CliRunner().invoke(main, [str(part) for part in command])
    assert result.exit_code == code, f"dmcvb-gen {' '.join(map(str, command))}\n{result.output}\n{result.exception}"
    return result.stdout


@pytest.fixture(scope="module", params=FAMILIES)
def made(request, tmp_path_factory):
    """(task, settings, folder) of a release of an expert's two short episodes a setting."""
    task, options, settings = FAMILIES[request.param]
    folder = tmp_path_factory.mktemp(request.param) / "r"
    short = ["--level", "expert", "--episodes", 2, "--max-steps", 6, "--size", SIZE]
    run("rollout", task, *options, *short, "--out", folder)
    return task, settings, folder


def shown(subset, episode):
    """(step, view, height, width, 3): the pictures that the subset's readers are to show, in the task's order."""
    task, values = get_task(subset.record.task), subset.episode(episode)
    hidden = "_hidden_goal" if subset.record.setting in ("hidden", "fixed") else ""
    names = [f"pixels{hidden}/{view}" for view in task.views] if len(task.views) > 1 else ["pixels"]
    return np.stack([values[name] for name in names], axis=1)


def test_it_is_described_sound_and_made_again(made, tmp_path):
    task, settings, folder = made
    facts = json.loads(run("info", folder, "--json"))
    assert facts["complete"] and len(facts["subsets"]) == len(settings)
    assert json.loads(run("verify", folder, "--json"))["sound"]
    assert "same digest" in run("regenerate", folder, "--check")
    run("preview", folder, "--out", tmp_path / "preview")
    assert any(path.stat().st_size > 1000 for path in (tmp_path / "preview").rglob("*.png"))
    shutil.copytree(folder, tmp_path / "carded")
    run("card", tmp_path / "carded")
    run("card", tmp_path / "carded", "--check")


@pytest.mark.slow_cases("mazes")
def test_it_travels_light_and_is_painted_on_arrival(made, tmp_path):
    folder = made[2]
    run("publish", folder, f"file://{tmp_path}/there", "--no-pixels")
    run("fetch", f"file://{tmp_path}/there", "--out", tmp_path / "here", "--paint")
    there, here = (Release.open(path) for path in (folder, tmp_path / "here"))
    assert here.digest == there.digest and not any(subset.unpainted.any() for subset in here.subsets.values())


def test_it_is_repainted_in_another_style_and_size(made, tmp_path):
    _, settings, folder = made
    run("repaint", folder, "--size", 24, "--split", "val", "--out", tmp_path / "val")
    assert json.loads(run("verify", tmp_path / "val", "--json"))["sound"]
    new, old = Release.open(tmp_path / "val"), Release.open(folder)
    for name, subset in new.subsets.items():
        pictures, before = shown(subset, 0), shown(old[name], 0)
        assert pictures.shape[2:] == (24, 24, 3) and pictures.shape[:2] == before.shape[:2]
        np.testing.assert_array_equal(subset.read("physics"), old[name].read("physics"))
        moved = np.abs(pictures.mean(axis=(0, 2, 3)) - before.mean(axis=(0, 2, 3))).max()
        # Other videos and styles, by at least 13 grey levels; none has neither, another size alone moves it by one.
        assert (moved > 4) == (not name.endswith("/none")), name


def test_every_export_shows_the_right_pictures_in_the_right_order(made, tmp_path):
    h5py = pytest.importorskip("h5py")
    _, _, folder = made
    release = Release.open(folder)
    for to in ("hdf5", "npz", "replay-buffer", "minari", "lerobot", "rlds"):
        run("export", folder, "--to", to, "--out", tmp_path / to)
    for name, subset in release.subsets.items():
        wanted = shown(subset, 0)  # (step, view, height, width, 3)
        steps = len(wanted)
        [path] = (tmp_path / "hdf5" / name).rglob("*.hdf5")
        with h5py.File(path) as file:
            first = wanted.transpose(0, 1, 4, 2, 3).reshape(steps, -1, SIZE, SIZE)
            np.testing.assert_array_equal(file["observation"][:steps], first)
        paths = sorted((tmp_path / "npz" / name).rglob("*.npz"))
        with np.load(paths[0]) as file:
            side = wanted.transpose(0, 2, 3, 1, 4).reshape(steps, SIZE, SIZE, -1)
            np.testing.assert_array_equal(file["image"], side)
        data = zarr.open_group(str(tmp_path / "replay-buffer" / name / "replay_buffer.zarr"), mode="r")["data"]
        views = get_task(subset.record.task).views
        for index, view in enumerate(views):
            kept = data[f"img_{view}" if len(views) > 1 else "img"][: steps - 1]
            np.testing.assert_array_equal(kept, wanted[: steps - 1, index])


def test_its_exported_folders_are_imported_again(made, tmp_path):
    task, settings, folder = made
    run("export", folder, "--to", "rlds", "--only", f"*/{settings[1]}", "--out", tmp_path / "rlds")
    source = tmp_path / "rlds" / task / "expert" / settings[1]
    what = ["--task", task, "--level", "expert", "--setting", settings[1]]
    run("import", source, *what, "--out", tmp_path / "back")
    [subset] = Release.open(tmp_path / "back").subsets.values()
    for episode in range(2):
        np.testing.assert_array_equal(
            shown(subset, episode), shown(Release.open(folder)[f"{task}/expert/{settings[1]}"], episode)
        )


@pytest.mark.slow_cases("locomotion", "mazes")
def test_agents_train_on_it_and_are_scored(made, tmp_path):
    task, settings, folder = made
    benchmarks = ["--benchmark", "b1", *(["--benchmark", "b3"] if "fixed" in settings else [])]
    command = ["validate", folder, *benchmarks, "--agents", "bc,state-bc", "--threads", 1, "--out", tmp_path / "report"]
    run(*command, "--only", f"{task}/expert/*")
    facts = json.loads((tmp_path / "report/report.json").read_text())
    assert not facts["failed"]
    assert {result["cell"]["benchmark"] for result in facts["results"]} == {
        "b1",
        *(["b3"] if len(benchmarks) > 2 else []),
    }


def test_its_environment_shows_what_its_readers_show(made):
    task, settings, folder = made
    setting = settings[1]
    subset = dmcvb_gen.open(str(folder))[f"{task}/expert/{setting}"]
    batch = next(subset.batches(2))
    env = gymnasium.make(f"dmcvb_gen/{task}-{setting}-v0", size=SIZE)
    observation, _ = env.reset(seed=0)
    views, pictures = get_task(task).views, observation["pixels"]
    if isinstance(pictures, dict):
        assert list(pictures) == list(views)
        pictures = np.concatenate(list(pictures.values()), axis=-1)
    assert pictures.shape[-1] * 3 == batch["pixels"].shape[1] or pictures.shape[-1] == batch["pixels"].shape[1]
    env.close()
