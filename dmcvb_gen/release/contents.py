"""Check the contents of a subset: values, physics and pixels.

Every finding names subset, episode and step. Values are checked everywhere; a sample of steps is simulated again and a
sample of frames painted again.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping

import numpy as np

from dmcvb_gen.dataset.pictures import picture_of
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.dataset.schema import trajectory_arrays
from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.distractors.backgrounds import load_backgrounds
from dmcvb_gen.generate.inputs import local_inputs, video_source
from dmcvb_gen.generate.modalities import modality_of, stored_in
from dmcvb_gen.generate.render import modality_of_frames, renderer_for
from dmcvb_gen.own_code import PLUGINS
from dmcvb_gen.policies.simulate import replay
from dmcvb_gen.release.issue import UNCHECKED, Issue
from dmcvb_gen.rendering.base import Renderer
from dmcvb_gen.tasks import get_task

SAMPLE_EPISODES, SAMPLE_STEPS, SAMPLE_FRAMES = 8, 12, 6
"""How much of each subset is simulated and painted again."""
REWARD_TOLERANCE, STATE_TOLERANCE = 1e-4, 1e-3
"""Largest difference that another CPU or library version may cause in one step; on the same machine it is 0."""
SUDDEN = 1e3
"""Growth of a difference in one step from which on it is no rounding that has grown."""
PIXEL_TOLERANCE = 2.0
"""Mean absolute difference of a repainted frame, grey levels of 255; on the same machine it is 0."""
LABEL_TOLERANCE, LABEL_SHARE = 1e-3, 0.02
"""Difference from which on a value of a depth or another modality counts, and the share of such that is too much."""


def check_contents(subset: Subset, backgrounds: str | None = None) -> Iterator[Issue]:
    """All that can be checked of a subset.

    Args:
      backgrounds: present place of the manifest's videos, if they moved.

    Raises:
      StoreError: something cannot be read.
    """
    found = list(check_values(subset))
    yield from found
    if any(finding.check in ("shapes", "lengths") for finding in found) or subset.record.imported:
        return  # no values to go by, or nothing to simulate or paint from
    yield from check_replays(subset) if get_task(subset.task).replayed else check_physics(subset)
    if subset.pixel_arrays:
        yield from check_pixels(subset, backgrounds)
    images = [spec.name for layer in subset.layers if layer.kind == "images" for spec in layer.arrays]
    for name in {*images} - {*stored_in(images)}:
        if picture_of(name) is None and not re.match(r"at\d+/", name):
            message = f"{name} is of a modality that is not known here; set {PLUGINS} to the module that registers it"
            yield Issue(UNCHECKED, subset.name, message)


def _sample(count: int, wanted: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(int))


def _sampled(subset: Subset, places: np.ndarray) -> Iterator[tuple[int, int]]:
    """Some episodes and their lengths, out of those at some places among those that are here."""
    for place in places[_sample(len(places), SAMPLE_EPISODES)]:
        yield int(subset.episodes[place]), int(subset.lengths[place])


def check_values(subset: Subset) -> Iterator[Issue]:
    """Shapes, lengths, finite values, actions in range, returns, duplicated episodes."""
    task = get_task(subset.task).at(subset.record.action_repeat)
    for spec in trajectory_arrays(task):
        if spec.name == "physics" and subset.record.imported:
            continue
        if spec.name not in subset.arrays:
            yield Issue("shapes", subset.name, f"array {spec.name} is missing")
            return
        stored = subset.spec(spec.name)
        if (stored.dtype, stored.shape, stored.steps) != (spec.dtype, spec.shape, spec.steps):
            yield Issue("shapes", subset.name, f"{spec.name} is {stored.dtype} {stored.shape}, expected {spec.shape}")
            return
    seen: dict[bytes, int] = {}
    names = [name for name in ("state", "action", "reward", "physics", "discount") if name in subset.arrays]
    read = subset.each_episode([*names, "return", "terminated"])
    for (episode, values), length in zip(read, map(int, subset.lengths), strict=True):
        if not 0 < length <= subset.record.max_steps:
            yield Issue("lengths", subset.name, f"length {length} is not in 1..{subset.record.max_steps}", episode)
            continue
        for name in names:
            bad = ~np.isfinite(values[name].reshape(len(values[name]), -1)).all(axis=1)
            if bad.any():
                yield Issue("finite", subset.name, f"{name} is not finite", episode, int(bad.argmax()))
        outside = (values["action"] < task.action_low) | (values["action"] > task.action_high)
        if outside[:length].any():
            message = "an action is outside of the task's bounds"
            yield Issue("actions", subset.name, message, episode, int(outside.any(axis=1).argmax()))
        total = float(values["reward"].astype(np.float64).sum())
        if not abs(total - float(values["return"])) <= 1e-6 * max(1.0, abs(total)):
            message = f"rewards sum to {total:.4f}, return is {values['return']:.4f}"
            yield Issue("returns", subset.name, message, episode)
        longer = max(1, subset.record.max_steps / task.max_steps)
        low, high = (longer * bound for bound in task.return_range)
        if not low <= total <= high:
            yield Issue("returns", subset.name, f"return {total:.2f} is outside {low:g}..{high:g}", episode)
        early = length < subset.record.max_steps and not task.replayed
        if bool(values["terminated"]) != (values["discount"][-1] == 0) or early > values["terminated"]:
            yield Issue("lengths", subset.name, "length, discount and terminated do not agree", episode)
        key = values["state"].tobytes() + values["action"].tobytes()
        if key in seen:
            yield Issue("duplicates", subset.name, f"is episode {seen[key]} again", episode)
        seen[key] = episode


def check_physics(subset: Subset) -> Iterator[Issue]:
    """Sampled steps simulated again: state, reward and next physics state are the stored ones."""
    task = get_task(subset.task).at(subset.record.action_repeat)
    known = np.ones(task.state_size, bool)
    for name in task.unstored_fields:
        known[task.state_slices[name]] = False
    for episode, length in _sampled(subset, np.arange(len(subset.episodes))):
        values = subset.episode(episode, ["state", "action", "reward", "physics"])
        steps = _sample(length, SAMPLE_STEPS)
        batch = task.batch(len(steps))
        with np.errstate(invalid="ignore"):
            state = batch.set_physics(values["physics"][steps])
            result = batch.step(values["action"][steps])
            after = batch.set_physics(values["physics"][steps + 1])
            found = {
                "states": (np.abs(state - values["state"][steps])[:, known].max(axis=1), STATE_TOLERANCE),
                "rewards": (np.abs(result.reward - values["reward"][steps]), REWARD_TOLERANCE),
                "physics": (np.abs(result.state - after)[:, known].max(axis=1), STATE_TOLERANCE * 10),
            }
        for check, (gaps, tolerance) in found.items():
            for step, gap in zip(steps, gaps, strict=True):
                if not gap <= tolerance:
                    told = f"{gap:.3g} away from what the physics gives"
                    yield Issue(check, subset.name, told, episode, int(step))


def check_replays(subset: Subset) -> Iterator[Issue]:
    """Sampled episodes simulated again from their streams and stored actions: every row is the stored one.

    On another processor a last bit may differ, and grow from step to step: what follows is not compared. A difference
    that comes at once is a finding.
    """
    task, makes = get_task(subset.task).at(subset.record.action_repeat), subset.trajectories.makes
    for episode, length in _sampled(subset, np.arange(len(subset.episodes))):
        values = subset.episode(episode, ["state", "action", "reward", "physics"])
        made = replay(task, values["action"][:length], episode, makes["seed"], tuple(makes["streams"]))
        if made.length[0] != length:
            message = f"ends after {length} steps, the same actions end it after {made.length[0]}"
            yield Issue("lengths", subset.name, message, episode)
            continue
        until = length + 1
        for check, name in (("physics", "physics"), ("states", "state"), ("rewards", "reward")):
            stored = values[name][:until]
            gaps = np.abs(getattr(made, name)[0, : len(stored)] - stored) / (1 + np.abs(stored))
            gaps = gaps.reshape(len(stored), -1).max(axis=1)
            wrong = ~(gaps <= STATE_TOLERANCE)
            if not wrong.any():
                continue
            step = int(wrong.argmax())
            if step and gaps[step - 1] > STATE_TOLERANCE / SUDDEN:
                until = step
            else:
                yield Issue(check, subset.name, f"{name} is {gaps[step]:.3g} away from dm_control's", episode, step)


def check_pixels(subset: Subset, backgrounds: str | None = None) -> Iterator[Issue]:
    """Sampled frames painted again from physics and labels; frames that are black or never change."""
    recorded, release = subset.record.backgrounds, subset.release
    root = local_inputs(release.store, release.inputs_of([subset.name]))
    source = video_source(root, subset.record, backgrounds)
    if recorded and load_backgrounds(source, recorded["split"]).digest != recorded["digest"]:
        message = f"backgrounds {source!r} are not those of the manifest; give --backgrounds"
        yield Issue("pixels", subset.name, message)
        return
    with contextlib.closing(renderer_for(subset.record, source)[0]) as renderer:
        painted_here = np.flatnonzero(~subset.unpainted[subset.episodes])
        for episode, length in _sampled(subset, painted_here):
            values = subset.episode(episode, ["physics", *subset.pixel_arrays, *stored_in(subset.arrays)])
            steps = _sample(length + 1, SAMPLE_FRAMES)
            labels = subset.labels([episode])[0][: length + 1]
            yield from _check_modalities(subset, renderer, episode, values, labels, steps)
            for name in subset.pixel_arrays:
                stored = values[name][steps]
                view, hidden = picture_of(name) or (name, False)
                painted = renderer.render(values["physics"][steps], labels[steps], [view], hide_goal=hidden)[:, 0]
                gaps = np.abs(painted.astype(int) - stored).reshape(len(steps), -1).mean(axis=1)
                for step, gap in zip(steps, gaps, strict=True):
                    if gap > PIXEL_TOLERANCE:
                        yield Issue("pixels", subset.name, f"{name} is {gap:.1f} grey levels off", episode, int(step))


def _check_modalities(
    subset: Subset,
    renderer: Renderer,
    episode: int,
    values: Mapping[str, np.ndarray],
    labels: DistractorState,
    steps: np.ndarray,
) -> Iterator[Issue]:
    """Depth, segmentation and the like of sampled frames, computed again."""
    for name in stored_in(subset.arrays):
        modality, view = modality_of(name), name.partition("/")[2] or subset.record.views[0]
        at = steps[steps + modality.needs_next <= steps[-1]]  # the last one is the episode's last frame
        made = modality_of_frames(renderer, modality, values["physics"], labels, (at,), view, subset.record.hidden_goal)
        differ = ~np.isclose(values[name][at], made, rtol=LABEL_TOLERANCE, atol=LABEL_TOLERANCE)
        for step, share in zip(at, differ.reshape(len(at), -1).mean(axis=1), strict=True):
            if share > LABEL_SHARE:
                message = f"{name} differs from what the states show in {100 * share:.0f} % of its values"
                yield Issue("modalities", subset.name, message, episode, int(step))
