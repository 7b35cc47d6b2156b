"""All renderers through one suite, and each against what it should look like."""

from __future__ import annotations

import numpy as np
import pytest

from dmcvb_gen.distractors import DistractorSetting, floor_alpha_for, load_backgrounds, sample_distractors
from dmcvb_gen.rendering import available_renderers, renderer_class
from dmcvb_gen.rendering.opengl import unavailable
from dmcvb_gen.seeding import STREAMS, episode_stream
from dmcvb_gen.tasks import get_task

needs_opengl = pytest.mark.skipif(unavailable() is not None, reason=f"OpenGL: {unavailable()}")
FRAMES = 12


def drawn_labels(task, setting, physics):
    """Labels of (episode, frame, physics) states, one after another."""
    streams = {name: [episode_stream(1, ("render",), i, name) for i in range(len(physics))] for name in STREAMS}
    return sample_distractors(task, setting, physics, streams, load_backgrounds()).flat()


def frames_of(task_id, setting_name, count=FRAMES):
    task, setting = get_task(task_id), DistractorSetting.parse(setting_name)
    batch = task.batch(2)
    batch.reset([np.random.default_rng(i) for i in range(2)])
    rng, rows = np.random.default_rng(3), []
    for _ in range(count // 2):
        for _ in range(3):
            batch.step(rng.uniform(-1, 1, (2, task.action_size)))
        rows.append(batch.physics())
    physics = np.stack(rows, axis=1)
    return task, setting, physics.reshape(-1, physics.shape[-1]), drawn_labels(task, setting, physics)


def renderer_of(name, task, setting, size=64, **options):
    floor = floor_alpha_for(task, setting)
    return renderer_class(name)(task, size, backgrounds=load_backgrounds(), floor_alpha=floor, **options)


class RendererTests:
    """What every renderer does."""

    name: str

    @pytest.mark.slow
    @pytest.mark.parametrize("setting_name", ["none", "dynamic"])
    def test_a_frame_does_not_depend_on_the_frames_beside_it(self, setting_name):
        task, setting, physics, labels = frames_of("humanoid-walk", setting_name)
        renderer = renderer_of(self.name, task, setting, 32)
        whole = renderer.render(physics, labels)
        assert whole.shape == (FRAMES, 1, 32, 32, 3) and whole.dtype == np.uint8
        order = np.random.default_rng(0).permutation(FRAMES)
        np.testing.assert_array_equal(renderer.render(physics[order], labels[order]), whole[order])
        np.testing.assert_array_equal(renderer.render(physics[5:6], labels[5:6]), whole[5:6])
        renderer.close()
        other = renderer_of(self.name, task, setting, 32)
        np.testing.assert_array_equal(other.render(physics[:3], labels[:3]), whole[:3])
        other.close()

    def test_a_material_color_changes_its_pixels(self):
        task, setting, physics, labels = frames_of("walker-walk", "none", 2)
        renderer = renderer_of(self.name, task, setting)
        before = renderer.render(physics, labels).astype(int)
        labels.material_rgb[:, task.model.material("self").id] = (0.0, 1.0, 0.0)
        after = renderer.render(physics, labels).astype(int)
        changed = np.abs(after - before).sum(-1) > 30
        greener = (after - before)[changed][:, 1] - (after - before)[changed][:, 0]
        assert 0.01 < changed.mean() < 0.4 and (greener > 0).mean() > 0.9
        renderer.close()

    @pytest.mark.parametrize(
        ("task_id", "setting_name"),
        [("walker-walk", "static"), ("humanoid-walk", "static"), ("reacher-easy", "static_background8")],
    )
    def test_a_background_changes_the_sky_alone_unless_the_floor_is_seen_through(self, task_id, setting_name):
        task, setting, physics, labels = frames_of(task_id, setting_name, 4)
        renderer = renderer_of(self.name, task, setting)
        segmentation = renderer.render_labels(physics, labels)["segmentation"]
        first = renderer.render(physics, labels).astype(int)
        labels.background_video[:] = (labels.background_video + 1) % 8
        changed = np.abs(renderer.render(physics, labels) - first).sum(-1) > 0
        renderer.close()
        assert changed[segmentation == -1].mean() > 0.9
        if task_id == "humanoid-walk":
            assert changed[segmentation == task.model.geom("floor").id].mean() > 0.8
        else:  # pixels away from the sky's edge, which samples may touch; OpenGL has reflections
            assert changed[~near(segmentation == -1)].mean() <= (0.02 if self.name == "opengl" else 0.0)

    def test_labels_leave_a_hidden_goal_out_as_its_pictures_do(self):
        task, setting, physics, labels = frames_of("ant-maze-empty7x7", "none", 2)
        renderer = renderer_of(self.name, task, setting)
        shown, hidden = (renderer.render_labels(physics, labels, hide_goal=hide) for hide in (False, True))
        renderer.close()
        goal = np.isin(shown["segmentation"], task.goal_geoms)
        assert goal.any() and not np.isin(hidden["segmentation"], task.goal_geoms).any()
        for label in ("segmentation", "depth"):  # but for OpenGL's edges
            assert (shown[label][~goal] == hidden[label][~goal]).mean() > 0.999
        assert (hidden["depth"][goal] > shown["depth"][goal] - 1e-3).mean() > 0.9  # what lies behind it

    def test_frames_of_another_task_are_refused(self):
        task, setting, physics, labels = frames_of("walker-walk", "none")
        renderer = renderer_of(self.name, task, setting, 16)
        for wrong in (physics[0], physics[:, 1:], physics[1:]):
            with pytest.raises(ValueError, match="are not frames of walker-walk"):
                renderer.render(wrong, labels)
        renderer.close()


class TestNative(RendererTests):
    name = "native"


@needs_opengl
class TestOpengl(RendererTests):
    name = "opengl"


def near(mask):
    """The mask grown by one pixel."""
    for axis in (-1, -2):
        mask = mask | np.roll(mask, 1, axis) | np.roll(mask, -1, axis)
    return mask


def test_every_renderer_has_its_contract_and_says_why_it_cannot_start():
    assert {tests.name for tests in RendererTests.__subclasses__()} == set(available_renderers())
    found = available_renderers()
    assert found["native"] is None and (found["opengl"] is None or "libegl1" in found["opengl"])
