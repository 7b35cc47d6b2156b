"""Check the structure of a release before any training, and whether scores are of distractors that were seen.

`release.verify` looks at bytes, shapes, values, physics and sampled pixels; here it is asked first, and what only a
benchmark cares about comes on top: returns as the policies and the paper promise, pictures that show something.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dmcvb_gen.benchmarks.evaluate import SPLIT
from dmcvb_gen.benchmarks.plan import Cell
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.distractors import load_backgrounds
from dmcvb_gen.errors import BackgroundError, StoreError
from dmcvb_gen.generate.inputs import background_source, video_source
from dmcvb_gen.generate.paint import render_differences, rendered_here
from dmcvb_gen.generate.references import normalized, reference_returns
from dmcvb_gen.loaders.painted import PaintedSubset
from dmcvb_gen.parallel import ProgressCallback, Workers, ignore, in_order, open_pool
from dmcvb_gen.policies.paper import paper_returns
from dmcvb_gen.release.issue import Issue
from dmcvb_gen.release.verify import verify_folder
from dmcvb_gen.spec import FIXED
from dmcvb_gen.tasks import ACTION_REPEAT, get_task

STANDARD_ERRORS = 4.0
"""How far the mean return of a subset may lie from its policies' (chance alone: one release in 10,000)."""
PAPER_SHARE = 0.15
"""How far it may lie from the paper's, as a share of the paper's expert, before a warning."""
PICTURE_EPISODES = 100
"""Episodes of a subset whose every frame is looked at."""
PAINTED_EPISODES = 8
"""The same, where its pictures are painted to be looked at."""


@dataclass(frozen=True)
class Structure:
    """Result of the checks.

    Attributes:
      checked: number of subsets, episodes and steps that were looked at.
      findings: faults of the data.
      warnings: oddities that may be meant: data unlike the paper's.
    """

    checked: dict[str, int]
    findings: tuple[Issue, ...]
    warnings: tuple[Issue, ...]

    @property
    def sound(self) -> bool:
        return not self.findings


def check_policy_returns(subset: Subset) -> Iterator[Issue]:
    """Each policy's episodes return what its file says it returned when it was evaluated.

    That was over random starts and goals, in the policy's own maze, with the task's own time limit: episodes of fixed
    ones, in other mazes, of other length or a larger action repeat return what those are worth.
    """
    if not comparable(subset):
        return
    behaviour = subset.read("behaviour")
    for index, policy in enumerate(subset.record.policies):
        said, returns = policy.header.get("evaluation"), subset.returns[behaviour == index]
        mode = "mean" if subset.record.deterministic else "sampled"
        if not said or not len(returns) or said["mode"] != mode or policy.header.get("task") != subset.task:
            continue
        spread = max(said["std"], float(returns.std()))
        tolerance = STANDARD_ERRORS * spread * math.sqrt(1 / len(returns) + 1 / said["episodes"])
        tolerance += 0.01 * abs(said["mean"])
        if not abs(returns.mean() - said["mean"]) <= tolerance:
            worst = int(np.abs(returns - said["mean"]).argmax())
            told = f"mean return of policy {policy.name} is {returns.mean():.1f}, its file says {said['mean']:.1f}"
            told += f" (more than {tolerance:.1f} apart)"
            yield Issue("returns", subset.name, told, int(subset.episodes[behaviour == index][worst]))


def comparable(subset: Subset) -> bool:
    """Return True if returns belong to episodes like those of the policies' evaluation and of the paper's tables."""
    repeat, whole = subset.record.action_repeat, get_task(subset.task).at(subset.record.action_repeat).max_steps
    # At a smaller repeat policies hold their actions as they did there; at a larger one they act more rarely.
    return subset.setting != FIXED and repeat <= ACTION_REPEAT and subset.record.max_steps == whole


def check_paper_returns(subset: Subset) -> Iterator[Issue]:
    """Warn if the mean return is not near the paper's table."""
    paper, expert = paper_returns(subset.task, subset.level), paper_returns(subset.task, "expert")
    if not paper or not len(subset.returns) or not comparable(subset):
        return
    if subset.record.goal_mode is not None:
        scale = abs(paper_returns(subset.task, "medium")["mean"] - expert["mean"])
    else:
        scale = PAPER_SHARE * expert["mean"]
    mean = float(subset.returns.mean())
    tolerance = scale + 2 * float(subset.returns.std()) / math.sqrt(len(subset.returns))
    if not abs(mean - paper["mean"]) <= tolerance:
        yield Issue("paper", subset.name, f"mean return is {mean:.1f}, the paper's is {paper['mean']:.1f}")


def check_pictures(subset: Subset) -> tuple[list[Issue], list[Issue]]:
    """(findings, warnings): frames that are black or of one color; episodes that show the same frame throughout.

    A view of a goal that stays where it is, or a task in which nothing moves, shows one frame rightly.
    """
    most = PAINTED_EPISODES if isinstance(subset, PaintedSubset) else PICTURE_EPISODES
    chosen = subset.episodes[:: max(1, -(-len(subset.episodes) // most))]
    found, odd = [], []
    for episode in map(int, chosen):
        for name, frames in subset.episode(episode, subset.pixel_arrays).items():
            flat = frames.reshape(len(frames), -1)
            low, high = flat.min(axis=1), flat.max(axis=1)
            for bad, message in ((high == 0, "is black"), ((low == high) & (high > 0), "is of one color")):
                if bad.any():
                    found.append(Issue("pictures", subset.name, f"{name} {message}", episode, int(bad.argmax())))
            if len(frames) > 1 and (flat == flat[:1]).all() and high[0] > 0:
                odd.append(Issue("pictures", subset.name, f"{name} shows the same frame throughout", episode))
    return found, odd


def normalized_score(release: Release, cell: Cell, score: Mapping[str, Any]) -> dict[str, Any]:
    """A cell's score with its normalized return by what the release has now; None for returns of another length."""
    record, found = release[cell.policy[0].subset].record, None
    if score["limit"] == record.max_steps:
        found = normalized(score["mean"], reference_returns(release, record))
    return {**score, "normalized": found}


def known_returns(release: Release) -> dict[str, np.ndarray]:
    """Subset -> (episode,) returns that are numbers; without subsets that have none, or whose cannot be read.

    What is wrong with those is among the findings; a report is made all the same.
    """
    found = {}
    for name, subset in release.subsets.items():
        with contextlib.suppress(StoreError):
            found[name] = subset.returns[np.isfinite(subset.returns)]
    return {name: returns for name, returns in found.items() if len(returns)}


def check_structure(
    release: Release, backgrounds: str | None = None, tick: ProgressCallback = ignore, workers: Workers = 1
) -> Structure:
    """All checks of a local release, or of some of its subsets.

    Args:
      backgrounds: present place of the manifest's videos, if they moved.
      tick: told what `verify` looks at, and beforehand how often.
      workers: processes, or a Ray cluster that sees the folder; a subset each.

    Raises:
      DmcvbError: nothing is committed.
    """
    all_records = Release.open(release.path).manifest.subsets
    ours = {name for record in release.manifest.subsets for name in (record.name, *record.layers)}
    not_ours = {name for record in all_records for name in (record.name, *record.layers)} - ours
    with open_pool(workers, tick=tick) as pool:
        verified = verify_folder(release.path, backgrounds, tick, pool, names=release.subsets)
        findings, warnings = [f for f in verified.findings if f.subset not in not_ours], [*verified.unchecked]
        unreadable = {f.subset for f in findings if f.check in ("files", "shapes", "lengths", "finite")}
        subsets = release.subsets.values()
        readable = [subset for subset in subsets if not unreadable & {subset.name, *subset.record.layers}]
        for found, odd in in_order(_check_subset, readable, pool):
            findings += found
            warnings += odd
    # Versions may differ from those for which the pictures rendered on reading are promised.
    painted = [subset.record for subset in subsets if isinstance(subset, PaintedSubset)]
    here = [rendered_here(record, background_source(release.path, record, backgrounds)) for record in painted]
    warnings += [Issue("painter", "images painted on reading", text) for text in render_differences(release, here)]
    return Structure(verified.checked, tuple(findings), tuple(warnings))


def _check_subset(subset: Subset, tick: ProgressCallback) -> tuple[list[Issue], list[Issue]]:
    """Return what is wrong with a subset, and what is odd about it."""
    found, odd = check_pictures(subset)
    return [*check_policy_returns(subset), *found], [*odd, *check_paper_returns(subset)]


def seen_warnings(release: Release, cells: Sequence[Cell], backgrounds: str | None) -> Iterator[Issue]:
    """Evaluation shows what no data show (paper, section 5); data that were painted with it do not tell."""
    learned = dict.fromkeys(name for cell in cells if not cell.agent.sees_state for name in cell.subsets)
    for record in (release.subsets[name].record for name in learned):
        what, seen = "maze style", record.goal_mode is not None and record.split == SPLIT
        if record.backgrounds:
            with contextlib.suppress(BackgroundError):  # what is not there fails in the cells
                shown = load_backgrounds(video_source(release.path, record, backgrounds), SPLIT).digest
                what, seen = "videos", record.backgrounds.get("digest") == shown
        if seen:
            text = f"painted with the {what} that evaluation shows: its scores are of distractors that were seen"
            yield Issue("learning", record.name, text)
