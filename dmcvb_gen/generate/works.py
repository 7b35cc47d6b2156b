"""Plan pieces of work: which shards of which layers a release lacks, grouped so that nothing is simulated twice.

A work is one shard of a set of trajectories and everything above it: the episodes are simulated (or read) once, then
each setting's labels are drawn (or read) and its images rendered.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import FileRecord, Layer, Manifest, Resolved, ShardRecord, SubsetRecord
from dmcvb_gen.errors import StoreError
from dmcvb_gen.storage.store import Store


@dataclass(frozen=True)
class Setting:
    """A subset whose layers a work makes: labels (none if it was imported) and images."""

    record: SubsetRecord
    labels: Layer | None
    images: tuple[Layer, ...]


@dataclass(frozen=True)
class Work:
    """One shard of a set of trajectories and of the layers above it; travels to workers by pickle.

    Attributes:
      store: where the shards are read and put.
      trajectories, shard: the layer and the number of its shard.
      settings: the subsets that show these episodes.
      make: names of the layers to make; layers below them that are not named are read.
      known: layer -> record of this shard, of all that exist.
      inputs: policies and videos that the release keeps copies of.
      backgrounds: folder of the videos, if not the release's own copies.
      purpose: "make" puts shards; "check" only compares them with their records; "repair" puts files back.
    """

    store: Store
    trajectories: Layer
    shard: int
    settings: tuple[Setting, ...]
    make: frozenset[str]
    known: Mapping[str, ShardRecord] = field(default_factory=dict)
    inputs: tuple[FileRecord, ...] = ()
    backgrounds: str | None = None
    purpose: Literal["make", "check", "repair"] = "make"

    @property
    def episodes(self) -> range:
        """The episodes of the shard, which is always full."""
        return self.trajectories.episodes_of(self.shard)

    @property
    def steps(self) -> int:
        """Steps of its episodes, if none ends early."""
        return len(self.episodes) * (self.trajectories.rows - 1)

    @property
    def layers(self) -> tuple[Layer, ...]:
        """The trajectories, and the labels and images of all settings."""
        above = [(setting.labels, *setting.images) for setting in self.settings]
        return (self.trajectories, *(layer for layers in above for layer in layers if layer is not None))

    @property
    def images(self) -> tuple[Layer, ...]:
        """The image layers to make."""
        return tuple(layer for setting in self.settings for layer in setting.images if layer.name in self.make)

    @property
    def frames(self) -> int:
        """What the progress callback counts if no episode ends early: a view's frames, or rows without images."""
        names = [layer.name for layer in self.images if "modality" not in layer.makes]
        views = {name.replace("pixels_hidden_goal", "pixels") for name in names}
        return (self.steps + len(self.episodes)) * max(len(views), 1)


def works_of(
    release: Release,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    wanted: Callable[[Layer, int], bool] | None = None,
    part: tuple[int, int] = (1, 1),
    **facts: object,
) -> tuple[Work, ...]:
    """The work that a release lacks.

    Args:
      release: what is asked for, by its manifest or its recipes, and where it lies.
      only: subset patterns such as "walker-walk/*/static", all by default.
      episodes: (first, last + 1) of each subset; the shards that hold any of them.
      wanted: whether a layer's shard is to be made; by default, if it is not here.
      part: (K, N): of all works, done or not, every N-th from the K-th on; together, the parts are all works.
      facts: fields of each `Work`.

    Raises:
      UnknownNameError: a pattern fits nothing. StoreError: no subset has such episodes.
    """
    records = chosen_subsets(release, only)
    lacking = wanted or (lambda layer, shard: shard not in release.here(layer.name))
    found = []
    groups = list(_groups(release, records, episodes).items())
    for (name, shard), members in groups[part[0] - 1 :: part[1]]:
        settings = tuple(_setting(release, record) for record in members)
        layers = [release.layers[name], *(release.layers[each] for record in members for each in record.layers[1:])]
        make = frozenset(layer.name for layer in layers if lacking(layer, shard))
        if make:
            known = {layer.name: made for layer in layers if (made := release.records(layer.name).get(shard))}
            inputs = release.inputs_of([record.name for record in members])
            work = Work(release.store, release.layers[name], shard, settings, make, known, inputs, **facts)  # type: ignore[arg-type]
            found.append(work)
    return tuple(found)


def check_makeable(described: Resolved | Manifest, names: Iterable[str]) -> None:
    """Raises StoreError for subsets whose shards cannot be made from the manifest."""
    chosen = set(names)
    for record in described.subsets:
        if record.name in chosen and record.imported:
            raise StoreError(
                f"{record.name} was imported, so there is nothing to make it from; import it again, or choose other "
                "subsets with --only"
            )


def chosen_subsets(release: Release, only: Sequence[str] = ()) -> list[SubsetRecord]:
    """The subsets that patterns choose, without those of which a copy has nothing and was to have nothing.

    Raises:
      UnknownNameError: a pattern fits nothing. StoreError: the copy has nothing of what is chosen.
    """
    names = set(release.select(only))
    chosen = [record for record in release.manifest.subsets if record.name in names and _is_part(release, record)]
    if not chosen:
        raise StoreError(f"{release.place} is a copy without {min(names)}; fetch it first")
    return chosen


def _is_part(release: Release, record: SubsetRecord) -> bool:
    if release.copy is None:
        return True
    own = record.layers[1:]  # its trajectories may be here for another setting
    return any(release.here(name) or release.copy.promised.get(name) for name in own)


def can_be_rendered(release: Release, layer: Layer, shard: int) -> bool:
    """Return True if a shard above trajectories is not here, and its trajectories are."""
    trajectories = f"{layer.group.partition('.zarr/')[0]}/trajectories"
    return shard in release.here(trajectories) and shard not in release.here(layer.name)


def _groups(
    release: Release, records: Sequence[SubsetRecord], episodes: tuple[int, int] | None
) -> dict[tuple[str, int], list[SubsetRecord]]:
    """(trajectories, shard) -> the subsets that show it."""
    groups: dict[tuple[str, int], list[SubsetRecord]] = {}
    for record in records:
        layer = release.layers[record.layers[0]]
        for shard in range(layer.shards_for(record.episodes)):
            span = layer.episodes_of(shard)
            if episodes is None or (span.start < min(episodes[1], record.episodes) and episodes[0] < span.stop):
                groups.setdefault((layer.name, shard), []).append(record)
    if not groups:
        most = max((record.episodes for record in records), default=0)
        first, last = episodes or (0, most)
        raise StoreError(f"no subset has episodes {first}:{last}; the longest has 0:{most}")
    return groups


def _setting(release: Release, record: SubsetRecord) -> Setting:
    layers = [release.layers[name] for name in record.layers[1:]]
    labels = next((layer for layer in layers if layer.kind == "labels"), None)
    return Setting(record, labels, tuple(layer for layer in layers if layer.kind == "images"))


def episodes_left(works: Sequence[Work]) -> Counter[str]:
    """Subset -> episodes of its shards that lack a layer."""
    left: Counter[str] = Counter()
    for work in works:
        for setting in work.settings:
            own = {work.trajectories.name, *setting.record.layers}
            if own & work.make:
                last = min(work.episodes.stop, setting.record.episodes)
                left[setting.record.name] += last - work.episodes.start
    return left
