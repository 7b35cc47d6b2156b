"""The painter of our own against OpenGL, and against its own golden pictures.

Golden pictures fail where a change of ours or of a dependency changes pixels. Look at the new ones before they
replace the old: `python -m tests.rendering.test_native` writes all of them again.
"""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dmcvb_gen.errors import RenderingError
from dmcvb_gen.rendering import renderer_class
from dmcvb_gen.rendering.native import textures
from dmcvb_gen.rendering.native.textures import background_texels, levels, packed
from dmcvb_gen.tasks import LOCOMOTION_TASKS, get_task
from dmcvb_gen.tasks.ant_maze.arena import look_numbers
from tests.conftest import python
from tests.rendering.test_rendering import FRAMES, frames_of, near, needs_opengl, renderer_of
from tests.tasks.test_tasks import SUITE

MAZE = "ant-maze-medium7x7a"
GOLDEN = Path(__file__).parents[1] / "golden"
CASES = [(task, setting) for task in LOCOMOTION_TASKS for setting in ("none", "dynamic")] + [(MAZE, "none")]
PAINTED = [task for task in SUITE if task not in (*LOCOMOTION_TASKS, "dog-walk", "lqr-lqr_2_1", "quadruped-escape")]
"""Tasks of dm_control's suite that this painter paints: no mesh with a skin, no transparent body, no height field."""
LARGEST_DIFFERENCE = {MAZE: 2.5} | dict.fromkeys(SUITE, 1.5)
"""Mean absolute difference to OpenGL, grey levels of 255 (OpenGL's own picture of 512 pixels, averaged, is 2.1 off)."""


CLOSE = [*CASES, *((task, "static") for task in LOCOMOTION_TASKS)]
CLOSE += [(task, setting) for task in PAINTED for setting in ("none", "dynamic")]
CLOSE += [(task, "dynamic_light0.5") for task in ("walker-walk", "humanoid-walk", "finger-spin")]  # finger's is a sun
CLOSE = [("walker-walk", "dynamic", 200), *((*case, 64) for case in CLOSE)]
FAST = [("walker-walk", "dynamic", 200), ("walker-walk", "none", 64), ("walker-walk", "static", 64)]
CLOSE = [pytest.param(*case, marks=() if case in FAST else pytest.mark.slow) for case in CLOSE]


@needs_opengl
@pytest.mark.parametrize("task_id, setting_name, size", CLOSE)
def test_every_view_is_as_close_to_opengl_as_eyes_see(task_id, setting_name, size):
    task, setting, physics, labels = frames_of(task_id, setting_name)
    pictures = []
    for name in ("opengl", "native"):
        renderer = renderer_of(name, task, setting, size)
        pictures.append(renderer.render(physics, labels).astype(int))
        renderer.close()
    reference, ours = pictures
    for view, name in enumerate(task.views):
        difference = ours[:, view] - reference[:, view]
        assert np.abs(difference).mean() < LARGEST_DIFFERENCE[task_id], name
        assert 10 * np.log10(255**2 / np.mean(difference**2.0)) > 35, name
        worst = np.abs(difference).mean(axis=(1, 2, 3)).max()
        assert worst < 2 * LARGEST_DIFFERENCE[task_id], name  # no frame lacks a shadow or a mirror image


@pytest.mark.slow_cases("ant-maze-medium7x7a-8")
@pytest.mark.parametrize("size", [8, 9, 65, 1024])
@pytest.mark.parametrize("task_id", ["walker-walk", MAZE])
def test_sizes(task_id, size):
    task, setting, physics, labels = frames_of(task_id, "none", 2)
    renderer = renderer_of("native", task, setting, size)
    picture = renderer.render(physics[:1], labels[:1], views=task.views[:1])
    assert picture.shape == (1, 1, size, size, 3) and 20 < picture.mean() < 235
    labels_of = renderer.render_labels(physics[:1], labels[:1], views=task.views[:1])
    assert labels_of["depth"].shape == labels_of["segmentation"].shape == (1, 1, size, size)
    small = renderer_of("native", task, setting, 64).render(physics[:1], labels[:1], views=task.views[:1])
    assert abs(float(picture.mean()) - float(small.mean())) < (12 if size < 10 else 3)


def test_a_hidden_goal_changes_only_its_own_pixels():
    task, setting, physics, labels = frames_of(MAZE, "none")
    renderer = renderer_of("native", task, setting)
    shown, hidden = renderer.render(physics, labels), renderer.render(physics, labels, hide_goal=True)
    goal = np.isin(renderer.render_labels(physics, labels)["segmentation"], task.goal_geoms)
    changed = (shown != hidden).any(axis=-1)
    assert goal[:, 0].any() and changed[goal].mean() > 0.95
    assert not changed[~near(goal)].any()


@pytest.mark.parametrize("size", [33, 64])
@pytest.mark.parametrize("task_id", [MAZE, "walker-walk"])
def test_what_is_painted_once_or_in_part_is_what_the_whole_picture_shows(task_id, size):
    """Frames one by one have nothing to share; together, still cameras keep what does not move, pairs share a frame."""
    task, setting, physics, labels = frames_of(task_id, "none")
    renderer = renderer_of("native", task, setting, size)
    frames = [slice(frame, frame + 1) for frame in range(len(physics))]
    each = [[renderer.render(physics[at], labels[at], None, hide) for at in frames] for hide in (False, True)]
    alone = list(map(np.concatenate, each))
    assert (alone[0] != alone[1]).any() == (task_id == MAZE)
    for pictures in (
        renderer.render_pair(physics, labels),
        [renderer.render(physics, labels), renderer.render(physics, labels, hide_goal=True)],
    ):
        for found, expected in zip(pictures, alone, strict=True):
            np.testing.assert_array_equal(found, expected)


def test_what_does_not_move_is_kept_only_as_long_as_it_looks_the_same():
    task, setting, physics, labels = frames_of(MAZE, "none")
    labels.style[len(physics) // 2 :] = next(look for look in look_numbers(3) if look != labels.style[0])
    labels.camera_position[-2:, 0] += 0.25
    order = np.argsort(np.arange(len(physics)) % 3, kind="stable")
    renderer = renderer_of("native", task, setting)
    alone = np.concatenate([renderer.render(physics[i : i + 1], labels[i : i + 1]) for i in order])
    np.testing.assert_array_equal(renderer.render(physics[order], labels[order]), alone)


def test_more_backgrounds_than_there_is_room_for_are_drawn_one_after_the_other(monkeypatch):
    task, setting, physics, labels = frames_of("walker-walk", "dynamic")
    labels.background_frame[:] = np.arange(FRAMES)
    all_fit = renderer_of("native", task, setting, 16).render(physics, labels)
    monkeypatch.setattr(textures, "SKY_BYTES", 0)  # room for eight, the least there is
    np.testing.assert_array_equal(renderer_of("native", task, setting, 16).render(physics, labels), all_fit)


def test_a_picture_of_one_grey_is_that_grey_at_every_distance():
    for grey in range(256):
        nearest, *farther = levels(np.full((8, 8, 3), grey, np.uint8), srgb=True)
        assert all((level == nearest[0, 0]).all() for level in farther)


@pytest.mark.parametrize("shape", [(256, 256), (240, 426), (800, 799), (2, 3)])
def test_a_background_on_the_sky_is_what_pillow_makes_of_it(shape):
    picture = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    image = Image.fromarray(picture).resize((800, 800), Image.Resampling.BILINEAR)
    found = background_texels(picture, {}).copy()
    assert len(found) == sum(side * side for side in (800, 400, 200, 100, 50, 25, 12, 6, 3, 1))
    for side in (800, 400, 200, 100, 50, 25):
        level, found = found[: side * side], found[side * side :]
        texels = level.view(np.uint8).reshape(side, side, 4)
        np.testing.assert_array_equal(texels[..., :3], np.asarray(image))
        last, image = np.asarray(image), image.reduce(2)
    np.testing.assert_array_equal(found, np.concatenate([packed(level) for level in levels(last)[1:]]))


def test_it_takes_four_samples_a_pixel_alone():
    with pytest.raises(RenderingError, match="4 samples"):
        renderer_class("native")(get_task("walker-walk"), 64, samples=2)


@pytest.mark.slow
def test_another_process_reads_what_this_one_compiled():
    task, setting, physics, labels = frames_of("walker-walk", "none", 2)
    renderer_of("native", task, setting).render(physics, labels)
    code = (
        "from dmcvb_gen.rendering.native.renderer import paint_frames\n"
        "from tests.rendering.test_rendering import frames_of, renderer_of\n"
        "task, setting, physics, labels = frames_of('walker-walk', 'none', 2)\n"
        "renderer_of('native', task, setting).render(physics, labels)\n"
        "print(sum(paint_frames.stats.cache_hits.values()), sum(paint_frames.stats.cache_misses.values()))\n"
    )
    assert python(code, cwd=GOLDEN.parents[1]).stdout.split() == ["1", "0"]


# -- golden pictures -------------------------------------------------------------------------------


def golden(task_id: str, setting_name: str) -> dict[str, np.ndarray]:
    """File name -> picture: four moments of each view, side by side."""
    task, setting, physics, labels = frames_of(task_id, setting_name)
    pictures = renderer_of("native", task, setting).render(physics[::3], labels[::3])
    return {
        f"{task_id}_{setting_name}_{view}.png": np.concatenate(list(pictures[:, index]), axis=1)
        for index, view in enumerate(task.views)
    }


@pytest.mark.parametrize(("task_id", "setting_name"), [*CASES, *((task, "none") for task in PAINTED)])
def test_pictures_are_the_golden_ones(task_id, setting_name):
    for name, picture in golden(task_id, setting_name).items():
        expected = np.asarray(Image.open(GOLDEN / name))
        different = (picture != expected).any(axis=-1).mean()
        assert different == 0, f"{name}: {different:.2%} of the pixels changed; see the top of {Path(__file__).name}"


if __name__ == "__main__":
    GOLDEN.mkdir(exist_ok=True)
    for case in [*CASES, *((task, "none") for task in PAINTED)]:
        for name, picture in golden(*case).items():
            Image.fromarray(picture).save(GOLDEN / name, optimize=True)
