"""Check that a release is what its manifest says: bytes of every file, then values, physics and images.

The manifest names lists, lists name files; each is compared with its SHA-256 where it lies, in a folder or at a URL. In
a folder, values are checked everywhere, a sample of steps is simulated and a sample of frames rendered.
"""

import logging
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dmcvb_gen.dataset.gate import Release, check_videos_shown, read_recipes
from dmcvb_gen.dataset.manifest import (
    COPY,
    LAYERS,
    MANIFEST,
    MANIFEST_BYTES,
    MANIFESTS,
    RECIPES,
    ZARR_JSON,
    FileRecord,
    build_manifest,
    canonical_json,
    file_of,
    is_attachment,
    merged_layers,
)
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.dataset.writer import plain_metadata, wrong_bytes
from dmcvb_gen.errors import BackgroundError, DmcvbError, RenderingError, StoreError, UnknownNameError
from dmcvb_gen.options import Location, checked, progress_bar, refuse
from dmcvb_gen.parallel import Pool, ProgressCallback, Ray, Workers, expect, ignore, in_order
from dmcvb_gen.release.issue import NOT_PART, UNCHECKED, Issue
from dmcvb_gen.release.tree import BOOKS, described_files, list_files
from dmcvb_gen.storage.places import is_url

SAMPLE_FILES = 40
"""Files of a URL that are read if not all are asked for; spread evenly over the release."""
THREADS = 8
"""Files whose bytes are read at a time."""
PREVIEWS = "preview/"
"""Folder that `preview` and `view` write to; no part of a release."""
Listed = tuple[str, FileRecord]
"""A file that a release names, after the layer that it belongs to, or its own path."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Verification:
    """Result of a verification: what was checked, and the issues.

    Attributes:
      checked: number of subsets, episodes, steps and files, of those that the digest covers.
      covered: files here that the digest covers: inputs, recipes, shards, records and lists.
      findings: faults that were found.
      incomplete: subsets that are sound but not all here -> (episodes here, episodes that belong to them).
      digest: the release's digest; None while it is made.
      compared: whether the digest was compared with one from outside.
      unchecked: what could not be looked at on this machine, and why; nothing is known to be damaged there.
    """

    checked: dict[str, int]
    findings: tuple[Issue, ...]
    incomplete: dict[str, tuple[int, int]] = field(default_factory=dict)
    digest: str | None = None
    compared: bool = False
    unchecked: tuple[Issue, ...] = ()
    covered: int = 0

    @property
    def sound(self) -> bool:
        """True if everything that is here is as it was made."""
        return not self.findings

    @property
    def finished(self) -> bool:
        """True if the release has a manifest."""
        return self.digest is not None

    @property
    def complete(self) -> bool:
        """True if everything that belongs to the release is here, and was checked."""
        return self.finished and not self.incomplete and not self.unchecked


@checked
def verify(
    release: Location,
    *,
    everything: bool = False,
    backgrounds: Location | None = None,
    workers: Workers | None = None,
    storage_options: dict[str, Any] | None = None,
    progress: bool = True,
) -> Verification:
    """Check a release: all of a folder; at a URL the manifest, its lists and a sample of files.

    Args:
      release (RELEASE|URL): Folder or URL of the release.
      everything: At a URL: read every file instead of a sample.
      backgrounds (FOLDER): Folder of the background videos, if it has moved.
      workers: Worker processes; at a URL: parallel downloads. [default: 1, at a URL 8]
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.

    Raises:
      DmcvbError: there is no release, nothing is committed, or an option has no effect there.
    """
    if is_url(str(release)):
        threads = THREADS if workers is None else workers
        refuse("at a URL nothing is rendered or simulated", backgrounds=backgrounds, workers=isinstance(threads, Ray))
        opened = Release.open(str(release), storage_options)
        with progress_bar(progress, " files", scaled=False) as bar:
            return _verify_bytes(opened, everything, bar, threads)  # type: ignore[arg-type]
    refuse(f"{release} is a folder, which is always read whole", all=everything, option=storage_options)
    with progress_bar(progress, " checks", scaled=False) as bar:
        return verify_folder(release, None if backgrounds is None else str(backgrounds), bar, workers or 1)


def verify_folder(
    place: str | Path,
    backgrounds: str | None = None,
    tick: ProgressCallback = ignore,
    workers: Workers | Pool = 1,
    names: Collection[str] | None = None,
) -> Verification:
    """Check a release in a folder.

    Args:
      backgrounds: present folder of the release's videos, if they moved.
      names: subsets whose values are checked; all by default. Bytes are checked everywhere.
      tick: told the place of each file whose bytes, and each subset whose values are checked.
      workers: processes, a Ray cluster that sees the folder, or an open pool, for the values.

    Raises:
      DmcvbError: there is no release, or it has no shards yet.
    """
    release = Release.open(place)
    check_videos_shown(release.manifest.subsets, backgrounds)
    files, findings = _expected(release)
    expect(tick, len(files) + len(release.manifest.subsets))
    findings += _wrong(release, files, tick, THREADS)
    findings += [found for found in _strange(release, files) if found not in findings]
    if release.text and not release.copy and not findings:
        lists = {layer.name: tuple(release.records(layer.name).values()) for layer in release.manifest.layers}
        built = build_manifest(release.recipes, lists)
        if built is None or canonical_json(built[0]) != release.text:
            findings.append(Issue("files", MANIFEST, "does not follow from recipes and records; fetch it again"))
    sound = _sound(release, findings)
    chosen = [subset for subset in sound if len(subset) and (names is None or subset.name in names)]
    if not findings and not any(map(len, sound)):
        raise DmcvbError(f"{place} has no episodes yet; run the rollout first")
    for found in in_order(_check_subset, [(subset, backgrounds) for subset in chosen], workers, tick):
        findings += found
    result = _verification(release, chosen, findings, files, files)
    return replace(result, incomplete=release.unfinished | result.incomplete) if names is None else result


def _verify_bytes(release: Release, everything: bool, tick: ProgressCallback, workers: int) -> Verification:
    """Check the bytes of a release at a URL; nothing is stored on this machine.

    Args:
      everything: read all files. A sample is read otherwise, and of the other files the size is compared.
    """
    files, findings = _expected(release)
    sample = files
    if not everything:
        places = np.unique(np.linspace(0, len(files) - 1, min(SAMPLE_FILES, len(files))).round().astype(int))
        sample = [files[place] for place in places]
    expect(tick, len(sample))
    findings += _wrong(release, sample, tick, workers)
    if not everything:
        read = {file.path for _, file in sample}
        findings += _wrong_sizes(release, [(place, file) for place, file in files if file.path not in read])
    chosen = [subset for subset in _sound(release, findings) if len(subset)]
    return _verification(release, chosen, findings, sample, files)


def _sound(release: Release, findings: Sequence[Issue]) -> list[Subset]:
    """The subsets whose layers have no finding."""
    damaged = {finding.subset for finding in findings}
    return [Subset(release, record) for record in release.manifest.subsets if not damaged & {*record.layers}]


def _verification(
    release: Release, chosen: Sequence[Subset], findings: list[Issue], looked_at: list[Listed], files: list[Listed]
) -> Verification:
    """The result of a verification.

    Args:
      chosen: subsets that were checked.
      looked_at, files: files that were read, and all.
    """
    read, covered = (sum(not file.path.endswith(ZARR_JSON) for _, file in some) for some in (looked_at, files))
    counts = {"subsets": len(chosen), "episodes": 0, "steps": 0, "files": read}
    for subset in chosen:
        counts["episodes"] += len(subset)
        counts["steps"] += subset.steps
    lacking = [subset for subset in _sound(release, findings) if len(subset) < subset.record.episodes]
    incomplete = {subset.name: (len(subset), subset.record.episodes) for subset in lacking}
    unchecked = tuple(finding for finding in findings if finding.check == UNCHECKED)
    faults = tuple(finding for finding in findings if finding.check != UNCHECKED)
    return Verification(counts, faults, incomplete, release.digest, release.compared, unchecked, covered)


# -- bytes ----------------------------------------------------------------------------------------


def _expected(release: Release) -> tuple[list[Listed], list[Issue]]:
    """All files that must be here, and issues of what should name them."""
    files: list[Listed] = []
    findings: list[Issue] = []
    used: set[str] = set()  # layers of which shards are here
    for name in release.layers:
        try:
            here = [shard for shard in release.layer_shards(name) if shard.here]
            files += [(name, file) for shard in here for file in (*shard.files, shard.record_file)]
            used |= {name} if here else set()
        except StoreError as error:
            findings.append(Issue("files", name, str(error)))
    usable = {name for name, layer in release.layers.items() if name in used or layer.kind == "images"}
    names = [record.name for record in release.manifest.subsets if {*record.layers} <= usable]
    try:
        files += [(file.path, file) for file in described_files(release, names)]
    except StoreError as error:
        findings.append(Issue("files", RECIPES, str(error)))
    if not release.in_the_making and not findings:
        texts = plain_metadata(release) if release.manifest_path == MANIFEST else {}  # which is of the newest alone
        plain = (file_of(path, text) for path, text in texts.items())
        files += [(file.path, file) for file in (*list_files(release, used), *plain)]
    return files, findings


def _wrong(release: Release, files: Sequence[Listed], tick: ProgressCallback, workers: int) -> list[Issue]:
    """Issues of files that are not as recorded, in their order."""

    def look(listed: Listed) -> str | None:
        tick(listed[0])
        return wrong_bytes(release.store, listed[1])

    with ThreadPoolExecutor(max(1, workers)) as pool:
        return [_issue(one, wrong) for one, wrong in zip(files, pool.map(look, files), strict=True) if wrong]


def _issue(listed: Listed, wrong: str) -> Issue:
    place, file = listed
    return Issue("files", place, wrong if place == file.path else f"{file.path} {wrong}")


def _wrong_sizes(release: Release, files: Sequence[Listed]) -> list[Issue]:
    """Issues of files that are missing or have another size, as far as the place can be listed."""
    try:
        sizes = release.store.list()
    except StoreError:
        return []  # a sample was read
    text = "is missing or has another size"
    return [_issue(one, text) for one in files if sizes.get(one[1].path) != one[1].bytes]


def _strange(release: Release, files: Sequence[Listed]) -> Iterator[Issue]:
    """Files that belong to no release, and those of its history that were altered."""
    known = {file.path for _, file in files} | {MANIFEST, COPY}
    unplanned = not any(path.endswith(ZARR_JSON) for path in known)  # as something else is damaged
    making = dict(release.layers)
    try:
        recipes = read_recipes(release.store)
        making |= merged_layers(recipes)  # those that the manifest does not name, too
        known |= {file.path for recipe in recipes for file in recipe.inputs}
    except StoreError as error:
        yield Issue("files", RECIPES, str(error))
    arrays = tuple(f"{layer.group}/{spec.stored_name}/c/" for layer in making.values() for spec in layer.arrays)
    folders = (*BOOKS, RECIPES, PREVIEWS, *arrays)
    empty = set() if unplanned else _empty(release)
    for path in release.store.list() if release.manifest_path == MANIFEST else ():
        if path in known or is_attachment(path) or (path.endswith(ZARR_JSON) and unplanned):
            continue
        if not path.startswith(folders) or path in empty:
            yield Issue("files", path, f"{NOT_PART}; move it elsewhere")
        elif path.startswith((LAYERS, MANIFESTS)) and release.store.sha256(path, MANIFEST_BYTES) != Path(path).stem:
            yield Issue("files", path, "was altered, an older version needs it; fetch that again, or remove it")


def _empty(release: Release) -> set[str]:
    """Paths that shards which are here leave free, because an array holds nothing but its fill value."""
    here = [shard for name in release.layers for shard in release.layer_shards(name) if shard.here]
    empty = [(shard, spec) for shard in here for spec in shard.layer.arrays if spec.name not in shard.record.files]
    return {shard.layer.file_path(spec, shard.number) for shard, spec in empty}


# -- values ---------------------------------------------------------------------------------------


def _check_subset(work: tuple[Subset, str | None], tick: ProgressCallback) -> list[Issue]:
    subset, backgrounds = work
    tick(subset.name)
    try:
        from dmcvb_gen.distractors.registry import distractors_of
        from dmcvb_gen.generate.resolve import code_of_distractor, code_of_task
        from dmcvb_gen.release import contents
        from dmcvb_gen.tasks import get_task

        get_task(subset.task)
        distractors_of(subset.record.distractor)
        now = {"trajectories": code_of_task(subset.task), "labels": code_of_distractor(subset.record.distractor)}
        own = [(layer.makes.get("code"), now[layer.kind]) for layer in subset.layers if layer.kind in now]
        if any((made or None) != (here or None) for made, here in own):
            raise DmcvbError(f"the code of your own behind {subset.name} is not that which made these data")
    except ModuleNotFoundError as error:
        # Fetch-only installs have no simulator; bytes are checked all the same, and this says what was not.
        lacks = f"values, physics and images were not checked: {error.name} is not installed"
        return [Issue(UNCHECKED, subset.name, lacks)]
    except DmcvbError as error:  # a user's own code, which cannot be imported or does not run on this machine
        return [Issue(UNCHECKED, subset.name, f"values, physics and images cannot be checked here: {error}")]
    try:
        return list(contents.check_contents(subset, backgrounds))
    except (RenderingError, BackgroundError, UnknownNameError, ImportError) as error:  # what this machine lacks
        return [Issue(UNCHECKED, subset.name, f"values, physics or images cannot be checked here: {error}")]
    except DmcvbError as error:
        return [Issue("files", subset.name, str(error))]
