"""Environments that match a subset, so that a policy trained on its data sees the same layout: stacks, size, videos."""

from __future__ import annotations

import logging
from typing import Any

from dmcvb_gen.dataset.manifest import SubsetRecord
from dmcvb_gen.dataset.pictures import shown
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.distractors.registry import typed_setting
from dmcvb_gen.generate.inputs import BUILTIN, shown_videos
from dmcvb_gen.loaders.envs import DistractedEnv, DistractedVectorEnv
from dmcvb_gen.spec import FIXED
from dmcvb_gen.tasks import ACTION_REPEAT

_log = logging.getLogger(__name__)

OF_THE_SETTING = ("backgrounds", "own_videos", "fixed_goals", "goal_seed")
"""Options that mean something under the data's own distractor or goal."""


def shown_by(record: SubsetRecord, setting: str) -> bool:
    """Return True if another distractor or goal shows the data's videos, or has its fixed goals."""
    other = record.model_copy(update={"setting": setting})
    return setting == FIXED or (other.goal_mode is None and other.distractor.shows_videos)


def matching_environment(
    subset: Subset, stack: int = 3, split: str = "val", num_envs: int | None = None, **options: Any
) -> DistractedEnv | DistractedVectorEnv:
    """See `SubsetReader.environment`."""
    given = environment_options(subset, split) | {"stack": stack}
    if subset.record.distractor.shows_videos and (videos := shown_videos(subset)) != BUILTIN:
        given["backgrounds"] = videos
    if repeat := options.get("action_repeat"):  # the data's time limit, in other steps
        given["max_steps"] = given["max_steps"] * subset.record.action_repeat // repeat
    if (setting := options.get("distractor")) and not shown_by(subset.record, typed_setting(setting)):
        given = {name: value for name, value in given.items() if name not in OF_THE_SETTING}
    given |= options
    return DistractedEnv(**given) if num_envs is None else DistractedVectorEnv(num_envs, **given)


def environment_options(subset: Subset, split: str) -> dict[str, Any]:
    """Options of `DistractedEnv` that match a subset: setting, size, renderer, views, time limit, pairs of goals.

    Episodes are cut where the data's are, and so compare with the reference scores.

    Args:
      split: videos and styles: the data's own ("train"), or those kept for evaluation ("val").
    """
    record, maze = subset.record, subset.record.goal_mode is not None
    options: dict[str, Any] = {
        "task": record.task,
        "distractor": record.setting if maze else record.distractor.name,
        "size": record.size,
        "samples": record.renderer.get("samples"),
        "split": split,
        "max_steps": record.max_steps,
    }
    if record.action_repeat != ACTION_REPEAT:
        options["action_repeat"] = record.action_repeat
    if record.renderer.get("name") and not record.imported:
        options["renderer"] = record.renderer["name"]
    if maze:
        options["views"] = list(shown(subset).views)
    if own_videos(subset) and record.distractor.shows_videos and not subset.other_videos:
        options["own_videos"] = (record.backgrounds or {}).get("digest")
    if record.setting == FIXED:
        if (seed := subset.goal_seed) is None:
            _log.warning("%s does not say by which seed its goals were drawn; those of seed 0 are shown", subset.name)
        options |= {"fixed_goals": record.fixed_goals, "goal_seed": seed or 0}
    return options


def own_videos(subset: Subset) -> str | None:
    """The folder of a release's own videos; None if a subset shows the built-in ones or none."""
    videos = (subset.record.backgrounds or {}).get("source", BUILTIN)
    return None if videos == BUILTIN else videos
