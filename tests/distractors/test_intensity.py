"""The dial of distractors: names, what varies at which strength, and whole releases of it."""

from __future__ import annotations

import numpy as np
import pytest

import dmcvb_gen
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.loaders.envs import DistractedEnv
from dmcvb_gen.spec import ALL_PARTS, DistractorSetting
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.cameras import seen_materials
from tests.conftest import run, told
from tests.distractors.test_distractors import labels, physics_of


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ("dynamic_0.2", "dynamic"),
        ("static_0.1", "static_easy"),
        ("dynamic_0.30", "dynamic_hard"),
        ("dynamic_.35", "dynamic_0.35"),
        ("dynamic_camera0.2-color0.2-background8", "dynamic"),
        ("dynamic_color-camera0.1", "dynamic_camera0.1-color0.2"),
        ("dynamic_cue0.8-background3-camera0.5", "dynamic_camera0.5-background3-cue0.8"),
        ("dynamic_cue0.5-light", "dynamic_light0.2-cue0.5"),
    ],
)
def test_a_setting_has_one_spelling(given, name):
    assert DistractorSetting.parse(given).name == name == DistractorSetting.parse(name).name


def test_a_setting_says_what_varies_and_how_much():
    for word, scale in (("easy", 0.1), ("medium", 0.2), ("hard", 0.3)):
        assert DistractorSetting("static", word).scale_of("camera") == DistractorSetting("static", word).scale == scale
    setting = DistractorSetting.parse("dynamic_camera0.5-background3-cue0.8")
    scales = {part: setting.scale_of(part) for part in ALL_PARTS if part != "background"}
    assert scales == {"camera": 0.5, "color": 0, "light": 0, "cue": 0.8}
    assert {part for part in ALL_PARTS if setting.varies(part)} == {"camera", "background", "cue"}
    assert setting.videos == 3 and setting.scale == 0.5
    assert [DistractorSetting("dynamic", text).videos for text in ("0.05", "0.15", "0.25", "0.9")] == [4, 8, None, None]


@pytest.mark.parametrize(
    "name",
    [
        *("dynamic_0", "dynamic_1.01", "dynamic_nan", "dynamic_-0.1", "dynamic_camera2", "dynamic_camera0"),
        *("dynamic_background0", "dynamic_background1.5", "dynamic_0.0001", "static_cue0.5", "dynamic_cue0"),
        *("dynamic_cue1.5", "dynamic_cue", "dynamic_cue0.5-cue1", "dynamic_", "none_easy", "none_hard", "none_camera"),
        *("dynamic_background\u00b2", "dynamic_background" + "9" * 5000),
    ],
)
def test_numbers_out_of_range_and_cues_that_cannot_be_are_refused(name):
    with pytest.raises(DmcvbError, match="e.g. cue0.8" if name == "dynamic_cue" else None):
        DistractorSetting.parse(name)


@pytest.mark.parametrize("difficulty", ["harsh", "camera-camera", "sky0.1", "camera-", "0.1-color", ""])
def test_other_words_are_refused_with_those_there_are(difficulty):
    with pytest.raises(UnknownNameError, match="Known: .*easy"):
        DistractorSetting("dynamic", difficulty)
    with pytest.raises(UnknownNameError, match="Known: .*dynamic"):
        DistractorSetting.parse(f"dynamik_{difficulty}")


@pytest.mark.parametrize("task_id", ["walker-walk", "humanoid-walk", "cartpole-swingup"])
def test_only_the_parts_that_are_named_vary_and_by_their_own_scale(task_id):
    task = get_task(task_id)
    physics = physics_of(task)
    plain, whole = labels(task, "none", physics), labels(task, "dynamic_0.5", physics)
    half = labels(task, "dynamic_camera0.5-color0.05", physics)
    np.testing.assert_array_equal(half.camera_position, whole.camera_position)  # of the same streams
    np.testing.assert_array_equal(half.background_video, plain.background_video)
    own = task.material_colors
    assert np.abs(half.material_rgb - own).max() <= 0.05 + 1e-6 < np.abs(whole.material_rgb - own).max()
    sky = labels(task, "dynamic_background", physics)
    np.testing.assert_array_equal(sky.camera_quaternion, plain.camera_quaternion)
    np.testing.assert_array_equal(sky.material_rgb, plain.material_rgb)
    assert (sky.background_video >= 0).all()
    lit = labels(task, "dynamic_light0.5", physics)
    np.testing.assert_array_equal(lit.camera_position, plain.camera_position)
    np.testing.assert_array_equal(lit.material_rgb, plain.material_rgb)
    most = np.array([1, 1, 0.25]) * task.model.light_pos[:, 2].max()
    assert plain.light_shift is None and (np.abs(lit.light_shift) <= most + 1e-6).all()
    assert np.abs(np.diff(lit.light_shift, axis=1)).max() > 0.01 * most.max()


def test_a_task_without_lamps_has_no_light_to_vary():
    task = get_task("ant-maze-empty7x7")
    with pytest.raises(DmcvbError, match="no lamp"):
        labels(task, "dynamic_light0.5", physics_of(task, frames=2))


SENTENCES = {
    "static_0.35": "camera: s = 0.35, color: s = 0.35, background: all videos |",
    "dynamic_camera0.5-background3": "camera: s = 0.5, background: up to 3 videos |",
    "dynamic_camera0.2-color0.2-background8-cue0.8": "background: up to 8 videos, cue: correlation 0.8 |",
    "dynamic_color0.2-light0.5": "color: s = 0.2, light: s = 0.5 |",
}
"""Setting -> what the card says of it."""


@pytest.mark.slow
@pytest.mark.parametrize("task_id", ["walker-walk", "cartpole-swingup"])
def test_a_release_of_them_goes_the_whole_way(task_id, tmp_path):
    folder = tmp_path / "release"
    short = ["--level", "random", "--episodes", 2, "--max-steps", 6, "--size", 16, "--no-pixels", "--out", folder]
    for setting in SENTENCES:
        run("rollout", task_id, *short, "--distractor", setting)
    run("paint", folder)
    subsets = Release.open(folder).subsets
    assert {subset.setting for subset in subsets.values()} == SENTENCES.keys()
    assert told("verify", folder)["sound"]
    assert "same digest" in run("regenerate", folder, "--check")
    [lit] = [subset for subset in subsets.values() if "light" in subset.setting]
    assert lit.read("exogenous/light_shift").shape == (2, 7, 3) and lit.labels().light_shift.any()
    np.testing.assert_array_equal(lit.labels().material_rgb, lit.read("exogenous/material_rgb"))
    run("card", folder)
    assert all(sentence in (folder / "README.md").read_text() for sentence in SENTENCES.values())
    plain = ["repaint", folder, "--only", f"{task_id}/random/static_0.35", "--out", tmp_path / "again", "--distractor"]
    run(*plain, "dynamic_color0.9")
    [again] = Release.open(tmp_path / "again").subsets.values()
    assert (again.episode(0)["exogenous/background_video"] == -1).all()
    env = DistractedEnv(task_id, "dynamic_background2", size=16)
    env.reset(seed=0)
    env.close()
    actions = np.zeros((2, get_task(task_id).action_size))
    score = dmcvb_gen.evaluate(lambda seen: actions, f"{task_id}/static_0.35", episodes=2, max_steps=2, size=16)
    assert len(score.returns) == 2


# -- a spurious cue -------------------------------------------------------------------------------


def cue_and_action(subset):
    """Shade (+1 lighter) of each frame and the sign of the action before it, over all episodes."""
    own, found = get_task(subset.task).material_colors, []
    seen = seen_materials(get_task(subset.task).model)
    for index in map(int, subset.episodes):
        values = subset.episode(index, ["exogenous/material_rgb", "action"])
        shade = (values["exogenous/material_rgb"][1:] - own)[:, seen].mean(axis=(1, 2))
        found.append(np.stack([np.sign(shade), np.sign(values["action"][: len(shade), 0])]))
    return np.concatenate(found, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("task_id", ["walker-walk", "cartpole-swingup"])
@pytest.mark.parametrize("rho", [0.3, 0.9])
def test_the_cue_in_the_data_correlates_with_the_action_as_asked(task_id, rho, tmp_path):
    folder = tmp_path / "again"
    words = ["--level", "random", "--episodes", 20, "--max-steps", 100, "--no-pixels", "--out", tmp_path / "r"]
    run("rollout", task_id, *words, "--distractor", "none")
    run("repaint", tmp_path / "r", "--distractor", f"dynamic_cue{rho}", "--out", folder)
    [subset] = Release.open(folder).subsets.values()
    cue, action = cue_and_action(subset)
    assert len(cue) == 2000 and set(np.unique(cue)) == {-1.0, 1.0}
    assert abs(np.corrcoef(cue, action)[0, 1] - rho) < 4 / np.sqrt(2000)
    assert told("verify", folder)["sound"]
    assert "same digest" in run("regenerate", folder, "--check")


def test_environments_show_the_cue_of_the_actions_that_are_taken_there():
    env = DistractedEnv("walker-walk", "dynamic_cue1", size=32)
    first, _ = env.reset(seed=0)
    shades = []
    for sign in (1, -1, 1):
        seen, *_ = env.step(np.full(6, 0.01 * sign, np.float32))
        shades.append(float(seen["pixels"].mean()))
    env.close()
    assert shades[1] < shades[0] - 5 and shades[1] < shades[2] - 5
