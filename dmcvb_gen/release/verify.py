"""Is a release what it says? A folder in, findings out: bytes, shapes, values, physics, pixels, returns.

Every finding names subset, episode and step. Digests and values are checked everywhere; a sample of steps is
simulated again and a sample of frames painted again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dmcvb_gen.distractors.backgrounds import load_backgrounds
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.files import sha256_file
from dmcvb_gen.labels import EXOGENOUS_NAMES, Exogenous
from dmcvb_gen.release.import_tfds import imported_specs
from dmcvb_gen.rollout.jobs import video_source
from dmcvb_gen.rollout.painting import renderer_for
from dmcvb_gen.store import Subset, open_release
from dmcvb_gen.store.index import INDEX, Index, read_index, root_digest
from dmcvb_gen.store.manifest import (
    MANIFEST,
    FileRecord,
    Manifest,
    SubsetRecord,
    checked_commit,
    commit_path,
    parse_manifest,
    shard_count,
    subset_path,
)
from dmcvb_gen.store.pictures import picture_of
from dmcvb_gen.store.remote import storage_errors
from dmcvb_gen.store.schema import EpisodeShape, array_specs
from dmcvb_gen.store.writer import subset_digest
from dmcvb_gen.tasks import get_task

SAMPLE_EPISODES, SAMPLE_STEPS, SAMPLE_FRAMES = 8, 12, 6
"""How much of each subset is simulated and painted again."""
REWARD_TOLERANCE, STATE_TOLERANCE = 1e-4, 1e-3
"""Largest difference that another CPU or library version may cause in one step; on the same machine it is 0."""
PIXEL_TOLERANCE = 2.0
"""Mean absolute difference of a repainted frame, grey levels of 255; on the same machine it is 0."""


@dataclass(frozen=True)
class Finding:
    """Something wrong: which check, where, and what."""

    check: str
    subset: str
    message: str
    episode: int | None = None
    step: int | None = None

    def __str__(self) -> str:
        place = self.subset
        if self.episode is not None:
            place += f", episode {self.episode}"
        if self.step is not None:
            place += f", step {self.step}"
        return f"{self.check}: {place}: {self.message}"


@dataclass(frozen=True)
class Verification:
    """What was looked at, and what was found wrong.

    Attributes:
      checked: how many subsets, episodes and steps.
      findings: what is wrong.
      incomplete: subsets that are sound but not all here -> (episodes here, episodes that belong to them).
      digest: the release's root digest, None while it is made (and of version 1).
    """

    checked: dict[str, int]
    findings: tuple[Finding, ...]
    incomplete: dict[str, tuple[int, int]] = field(default_factory=dict)
    digest: str | None = None

    @property
    def sound(self) -> bool:
        """Whether everything that is here is as it was made."""
        return not self.findings

    @property
    def complete(self) -> bool:
        """Whether everything that belongs to the release is here."""
        return not self.incomplete


def _sample(count: int, wanted: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(int))


# -- bytes ----------------------------------------------------------------------------------------


def check_files(root: Path) -> Iterator[Finding]:
    """Every file of a local release has its digest and every shard of a complete one is there; see `store.index`."""
    try:
        manifest = parse_manifest((root / MANIFEST).read_bytes(), MANIFEST)
    except StoreError as error:
        yield Finding("files", MANIFEST, f"is damaged: {error}")
        return
    try:
        index = read_index(root)
    except StoreError as error:
        yield Finding("files", INDEX, f"is damaged: {error}")
        index = None
    else:
        if index is None and manifest.digest is not None:
            yield Finding("files", INDEX, "is missing; fetch it again")
    checked: set[str] = set()
    for record in manifest.subsets:
        yield from _check_shards(root, manifest, record, checked)
    if index is not None:
        yield from _check_index(root, manifest, index, checked)


def _check_index(root: Path, manifest: Manifest, index: Index, checked: set[str]) -> Iterator[Finding]:
    for file in index.files:
        if file.path not in checked:
            yield from _check_file(root, file, subset_of(manifest, file.path))
    if sha256_file(root / MANIFEST) != index.manifest_sha256:
        yield Finding("files", MANIFEST, f"does not have the digest that {INDEX} says")
    elif manifest.digest is not None and root_digest(index.files, manifest) != manifest.digest:
        yield Finding("files", MANIFEST, f"its root digest is not that of the files in {INDEX}")


def subset_of(manifest: Manifest, path: str) -> str:
    """The subset that a file belongs to; the file itself where it belongs to none."""
    for record in manifest.subsets:
        if path.startswith((f"{subset_path(record.name)}/", f"commits/{record.name}/")):
            return record.name
    return path


def _check_file(root: Path, file: FileRecord, where: str, what: str = "") -> Iterator[Finding]:
    path, name = root / file.path, file.path + what
    with storage_errors(path):
        if not path.is_file():
            yield Finding("files", where, f"{name} is missing")
        elif path.stat().st_size != file.bytes:
            yield Finding("files", where, f"{name} has {path.stat().st_size} bytes instead of {file.bytes}")
        elif sha256_file(path) != file.sha256:
            yield Finding("files", where, f"{name} does not have its digest")


def _check_shards(root: Path, manifest: Manifest, record: SubsetRecord, checked: set[str]) -> Iterator[Finding]:
    """Commit records and their files, which are put into `checked`."""
    commits = {}
    for shard in range(shard_count(record)):
        path = commit_path(record.name, shard)
        if not (root / path).is_file():
            if manifest.complete:
                yield Finding("files", record.name, f"shard {shard} is missing: no {path}")
            continue
        try:
            commit = commits[shard] = checked_commit((root / path).read_bytes(), path, record, shard)
        except StoreError as error:
            yield Finding("files", record.name, f"{path} is damaged: {error}")
            continue
        for file in commit.files:
            checked.add(file.path)
            yield from _check_file(root, file, record.name, f" of shard {shard}")
    if record.digest and len(commits) == shard_count(record) and subset_digest(commits) != record.digest:
        yield Finding("files", record.name, "its commit records do not give the digest of the manifest")


# -- values ---------------------------------------------------------------------------------------


def is_imported(subset: Subset) -> bool:
    """Whether a subset came from DMC-VB's published data, which have no physics states and no labels."""
    return subset.record.renderer.get("name") == "imported"


def check_values(subset: Subset) -> Iterator[Finding]:
    """Shapes, lengths, finite values, actions in range, returns, duplicated episodes."""
    task = get_task(subset.task)
    episodes = subset.episodes
    specs = array_specs(EpisodeShape.of(task), subset.record.size, pixels=subset.record.pixels)
    for spec in imported_specs(subset.record) if is_imported(subset) else specs:
        if spec.name not in subset.arrays:
            yield Finding("shapes", subset.name, f"array {spec.name} is missing")
            return
        array = subset.array(spec.name)
        rows = (subset.record.max_steps + 1,) if spec.steps else ()
        wanted = (subset.record.episodes, *rows, *spec.shape)
        if array.shape != wanted or array.dtype != np.dtype(spec.dtype):
            yield Finding("shapes", subset.name, f"{spec.name} is {array.dtype} {array.shape}, expected {wanted}")
            return
    seen: dict[bytes, int] = {}
    for episode, length in zip(map(int, episodes), map(int, subset.lengths), strict=True):
        if not 0 < length <= subset.record.max_steps:
            yield Finding("lengths", subset.name, f"length {length} is not in 1..{subset.record.max_steps}", episode)
            continue
        names = [name for name in ("state", "action", "reward", "physics", "discount") if name in subset.arrays]
        values = subset.episode(episode, [*names, "return", "terminated"])
        for name in names:
            bad = ~np.isfinite(values[name].reshape(len(values[name]), -1)).all(axis=1)
            if bad.any():
                yield Finding("finite", subset.name, f"{name} is not finite", episode, int(bad.argmax()))
        if np.abs(values["action"]).max() > 1:
            step = int(np.abs(values["action"]).max(axis=1).argmax())
            yield Finding("actions", subset.name, "an action is outside [-1, 1]", episode, step)
        total = float(values["reward"].astype(np.float64).sum())
        if not abs(total - float(values["return"])) <= 1e-6 * max(1.0, abs(total)):
            yield Finding(
                "returns", subset.name, f"rewards sum to {total:.4f}, return is {values['return']:.4f}", episode
            )
        low, high = task.return_range
        if not low <= total <= high:
            yield Finding("returns", subset.name, f"return {total:.2f} is outside {low:g}..{high:g}", episode)
        if (
            bool(values["terminated"]) != (values["discount"][-1] == 0)
            or (length < subset.record.max_steps) > values["terminated"]
        ):
            yield Finding("lengths", subset.name, "length, discount and terminated do not agree", episode)
        key = values["action"].tobytes()
        if key in seen:
            yield Finding("duplicates", subset.name, f"has the actions of episode {seen[key]}", episode)
        seen[key] = episode


def check_physics(subset: Subset) -> Iterator[Finding]:
    """Sampled steps simulated again: state, reward and next physics state are the stored ones."""
    task = get_task(subset.task)
    known = np.ones(task.state_size, bool)
    for name in task.unstored_fields:
        known[task.state_slices[name]] = False
    for index in _sample(len(subset.episodes), SAMPLE_EPISODES):
        episode, length = int(subset.episodes[index]), int(subset.lengths[index])
        values = subset.episode(episode, ["state", "action", "reward", "physics"])
        steps = _sample(length, SAMPLE_STEPS)
        batch = task.batch(len(steps))
        with np.errstate(invalid="ignore"):
            state = batch.set_physics(values["physics"][steps])
            for row, step in enumerate(steps):
                gap = np.abs(state[row] - values["state"][step])[known].max()
                if not gap <= STATE_TOLERANCE:
                    yield Finding("states", subset.name, f"physics gives a state {gap:.3g} away", episode, int(step))
            result = batch.step(values["action"][steps])
            after = batch.set_physics(values["physics"][steps + 1])
            for row, step in enumerate(steps):
                gap = abs(result.reward[row] - values["reward"][step])
                if not gap <= REWARD_TOLERANCE:
                    yield Finding(
                        "rewards",
                        subset.name,
                        f"reward is {values['reward'][step]:.5f}, the physics gives {result.reward[row]:.5f}",
                        episode,
                        int(step),
                    )
                gap = np.abs(result.state[row] - after[row])[known].max()
                if not gap <= STATE_TOLERANCE * 10:
                    yield Finding("physics", subset.name, f"the action leads {gap:.3g} away", episode, int(step))


def check_pixels(subset: Subset, backgrounds: str | None = None) -> Iterator[Finding]:
    """Sampled frames painted again from physics and labels; frames that are black or never change."""
    recorded = subset.record.backgrounds
    source = video_source(subset.root, subset.record, backgrounds)
    split = recorded["split"] if recorded else "train"
    if recorded:
        digest = load_backgrounds(source, split).digest
        if digest != recorded["digest"]:
            yield Finding(
                "pixels", subset.name, f"backgrounds {source!r} are not those of the manifest; give --backgrounds"
            )
            return
    renderer, _ = renderer_for(subset.record, source, split)
    try:
        painted_here = np.flatnonzero(~subset.unpainted[subset.episodes])
        for index in painted_here[_sample(len(painted_here), SAMPLE_EPISODES)]:
            episode, length = int(subset.episodes[index]), int(subset.lengths[index])
            values = subset.episode(episode)
            steps = _sample(length + 1, SAMPLE_FRAMES)
            labels = Exogenous(**{name: values[f"exogenous/{name}"] for name in EXOGENOUS_NAMES})
            for name in subset.pixel_arrays:
                stored = values[name][steps]
                view, hidden = picture_of(name)
                painted = renderer.render(values["physics"][steps], labels[steps], [view], hide_goal=hidden)[:, 0]
                gaps = np.abs(painted.astype(int) - stored).reshape(len(steps), -1).mean(axis=1)
                for step, gap in zip(steps, gaps, strict=True):
                    if gap > PIXEL_TOLERANCE:
                        yield Finding("pixels", subset.name, f"{name} is {gap:.1f} grey levels off", episode, int(step))
                if stored.max() == 0:
                    yield Finding("pixels", subset.name, f"{name} is black", episode)
                elif (stored == stored[:1]).all() and len(steps) > 1:
                    yield Finding("pixels", subset.name, f"{name} never changes", episode)
    finally:
        renderer.close()


def verify(
    path: str | Path, backgrounds: str | None = None, tick: Callable[[str], None] = lambda subset: None
) -> Verification:
    """Check a release.

    Args:
      backgrounds: where the manifest's videos are now, if they moved.

    Raises:
      DmcvbError: there is no release, or nothing is committed.
    """
    root = Path(path)
    if not (root / MANIFEST).is_file():
        open_release(path)  # says what is the matter
    findings = list(check_files(root))
    damaged = {finding.subset for finding in findings}
    counts = {"subsets": 0, "episodes": 0, "steps": 0}
    if damaged & {MANIFEST, INDEX}:
        return Verification(counts, tuple(findings))  # nothing says what the rest should be
    release = open_release(path, skip=damaged)
    if not release.subsets and not findings:
        raise DmcvbError(f"{path} has no committed episodes yet; run the rollout first")
    for name, subset in release.subsets.items():
        tick(name)
        counts["subsets"] += 1
        counts["episodes"] += len(subset.episodes)
        counts["steps"] += subset.steps
        findings += _check_subset(subset, backgrounds)
    incomplete = {name: count for name, count in release.shortfalls.items() if name not in damaged}
    return Verification(counts, tuple(findings), incomplete, release.manifest.digest)


def _check_subset(subset: Subset, backgrounds: str | None) -> list[Finding]:
    try:
        found = list(check_values(subset))
        if any(finding.check in ("shapes", "lengths") for finding in found) or is_imported(subset):
            return found  # no values to go by, or nothing to simulate or paint from
        found += check_physics(subset)
        if subset.pixel_arrays:
            found += check_pixels(subset, backgrounds)
        return found
    except StoreError as error:
        return [Finding("files", subset.name, str(error))]
