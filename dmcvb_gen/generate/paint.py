"""Render images that a release lacks: all of one that was stored without, another size, some views, a modality.

An image is a function of the stored physics state, the labels, the renderer, the size and the view. So a release can
travel without its images, and be painted where it is used. Images that its manifest lists must come out with their
digests; others become layers of the release's own.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.environment import environment
from dmcvb_gen.dataset.gate import Release, check_videos_shown
from dmcvb_gen.dataset.manifest import SAID, Layer, Resolved, SubsetRecord, describable, layer_facts, layer_order
from dmcvb_gen.dataset.pictures import Pictures
from dmcvb_gen.dataset.writer import begin, finish, read_provenance, write_provenance
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.generate.executors import run_works
from dmcvb_gen.generate.inputs import background_source, local_inputs
from dmcvb_gen.generate.resolve import all_pictures, check_task_code, image_layers, rendering_facts
from dmcvb_gen.generate.works import can_be_rendered, chosen_subsets, works_of
from dmcvb_gen.parallel import ProgressCallback, Workers, ignore
from dmcvb_gen.rendering.base import check_size
from dmcvb_gen.storage.store import Store, open_store
from dmcvb_gen.text import printable

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Wanted:
    """Ask for images; None is what the subset has.

    Attributes:
      size: pixels a side.
      views: of mazes, only these.

    Raises:
      DmcvbError: a size that no renderer takes, or no view at all.
    """

    size: int | None = None
    views: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.size is not None:
            check_size(self.size)
        if self.views is not None and not self.views:
            raise DmcvbError("views names no view; leave it out to have them all")

    def pictures(self, record: SubsetRecord) -> tuple[str, ...]:
        """Names of the RGB images of a subset that are asked for.

        Raises:
          UnknownNameError: it has no such view.
        """
        views = Pictures(record.views).select(self.views).views
        names = {*Pictures(views).arrays, *Pictures(views, hide_goal=True).arrays}
        return tuple(name for name in all_pictures(record) if name in names)


@dataclass(frozen=True)
class RenderResult:
    """The result of painting.

    Attributes:
      release: the release as it is now.
      shards: number of shards of images that were rendered.
      known: number of these whose digests were known.
      differing: "<layer> shard <n>" of those whose images do not have the known digests; they were not stored.
      drift: differences between this machine and the one that made the release, in words.
    """

    release: Release
    shards: int
    known: int
    differing: tuple[str, ...]
    drift: tuple[str, ...]


def paint_release(
    place: str | Path | Store,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    wanted: Wanted | None = None,
    *,
    workers: Workers | None = None,
    backgrounds: str | None = None,
    progress: ProgressCallback = ignore,
) -> RenderResult:
    """Render the missing images of a release. What differs here from where it was made is logged before.

    Args:
      place: the release's folder.
      only: subset patterns, all by default.
      episodes: (first, last + 1) of each subset; the shards that hold any of them are rendered.
      wanted: which images.
      backgrounds: folder of the videos, if the release has no copies.

    Raises:
      DmcvbError: nothing matches, a shard is damaged, the videos are not those of the manifest, or no room.
    """
    store, wanted = place if isinstance(place, Store) else open_store(place), wanted or Wanted()
    release = Release.open(store)
    records = not_imported(release, chosen_subsets(release, only))
    check_videos_shown(records, backgrounds)
    root = local_inputs(store, release.inputs_of([record.name for record in records]))
    here = [rendered_here(record, background_source(root, record, backgrounds)) for record in records]
    layers = {record.name: _layers_of(release, record, wanted) for record in here}
    below = {layer.name: _labels(release, record).name for record in records for layer in layers[record.name]}
    if below.keys() - release.layers.keys():
        begin(store, _recipe_with(release, records, layers), {})
        release = Release.open(store)

    def is_missing(layer: Layer, shard: int) -> bool:
        labels = below.get(layer.name)
        return labels is not None and shard in release.here(labels) and can_be_rendered(release, layer, shard)

    works = works_of(release, [record.name for record in records], episodes, is_missing, backgrounds=backgrounds)
    drift = render_differences(release, here) if works else ()
    for text in drift:
        _log.warning(printable(text, " "))
    if works:
        write_provenance(store, "paint")
    done = list(run_works(works, workers, progress))
    outcomes = [outcome for result in done for outcome in result.outcomes]
    differing = sorted(f"{each.layer} shard {each.shard}" for each in outcomes if each.equal is False)
    known = sum(each.equal is not None for each in outcomes)
    return RenderResult(finish(store), len(outcomes), known, tuple(differing), drift)


def not_imported(release: Release, records: Iterable[SubsetRecord]) -> list[SubsetRecord]:
    """Those of a release's subsets that can be painted.

    Raises:
      StoreError: all were imported, or the code of a task of one's own has changed.
    """
    own = [record for record in records if not record.imported]
    for record in own:
        check_task_code(record.task, release.layers[record.layers[0]])
    if not own:
        raise StoreError(f"{release.place} was imported and has no physics states to paint from")
    return own


def _layers_of(release: Release, record: SubsetRecord, wanted: Wanted) -> list[Layer]:
    """The image layers that are asked for of a subset: the release's own, or new ones of the renderer here."""
    asked = image_layers(record, _labels(release, record), wanted.pictures(record), wanted.size)
    return [release.layers.get(layer.name, layer) for layer in asked]


def _labels(release: Release, record: SubsetRecord) -> Layer:
    return next(release.layers[name] for name in record.layers if release.layers[name].kind == "labels")


def _recipe_with(release: Release, records: Iterable[SubsetRecord], layers: Mapping[str, Sequence[Layer]]) -> Resolved:
    """The recipe of subsets with more image layers than the release has."""
    subsets: list[SubsetRecord] = []
    described: dict[str, Layer] = {}
    for record in records:
        own = {name: bare(release.layers[name]) for name in record.layers}
        own |= {layer.name: bare(layer) for layer in layers[record.name]}
        described |= own
        subsets.append(record.model_copy(update={"layers": tuple(sorted(own, key=layer_order))}))
    return recipe_after(release, described.values(), subsets)


@describable()
def recipe_after(release: Release, layers: Iterable[Layer], subsets: Iterable[SubsetRecord], **facts: Any) -> Resolved:
    """The recipe of other layers and subsets with a release's name, license and so on; `facts`: what else it says."""
    kept = {name: getattr(release.manifest, name) for name in SAID}
    return Resolved(**(kept | facts), layers=tuple(layers), subsets=tuple(subsets))


def bare(layer: Layer) -> Layer:
    """A layer without what a finished release says of it."""
    return Layer(**layer_facts(layer))


def rendered_here(record: SubsetRecord, source: str) -> SubsetRecord:
    """The record of a subset that is painted here, from videos at `source`."""
    return record.model_copy(update=rendering_facts(record, source))


def render_differences(release: Release, records: Iterable[SubsetRecord]) -> tuple[str, ...]:
    """List what may change pixels here compared with the release's origin: versions, processor, renderer.

    Args:
      records: of the subsets to paint, see `rendered_here`.
    """
    found: dict[str, None] = {}
    made = {record.name: record.renderer for record in release.manifest.subsets}
    for record in records:
        there, here = made[record.name], record.renderer
        for name in sorted(set(here) | set(there)):
            was, now = there.get(name, "nothing"), here.get(name, "nothing")
            if was != now:
                found[f"{here['name']}'s {name} is {now} here, {was} in the manifest"] = None
    for name, (old, now) in environment_diff(release.store).items():
        found[f"{name} is {now} on this machine and was {old} on the machine of the release"] = None
    return tuple(found)


def environment_diff(store: Store) -> dict[str, tuple[str, str]]:
    """Compare this machine with all environments that made a release: name -> (there, here)."""
    here, made = environment(), [note["environment"] for note in read_provenance(store)]
    return {
        name: (" or ".join(sorted({old.get(name, "unknown") for old in made})), value)
        for name, value in here.items()
        if any(name in old for old in made) and value not in {old.get(name) for old in made}
    }
