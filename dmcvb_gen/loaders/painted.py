"""Render the pictures of a subset when they are read, if it stores none or others are asked for.

Nothing is stored: an episode's pictures are painted from its physics states and labels when they are first asked for,
and kept while there is room. With fresh distractors every epoch sees the same episodes from other cameras, in other
colors, before other videos, all drawn from named streams: augmentation that keeps states, actions and rewards true.
"""

from __future__ import annotations

import functools
import re
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import ArraySpec, SubsetRecord
from dmcvb_gen.dataset.pictures import picture_of
from dmcvb_gen.dataset.schema import image_array
from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.generate.inputs import background_source, local_inputs, whose_videos
from dmcvb_gen.generate.modalities import stored_in
from dmcvb_gen.generate.render import distractor_state_of, paint, renderer_for
from dmcvb_gen.generate.resolve import all_pictures, check_task_code, drawn_labels
from dmcvb_gen.loaders.arrays import ComputedArray
from dmcvb_gen.loaders.release import ReleaseReader, SubsetReader
from dmcvb_gen.rendering.base import Renderer, check_size
from dmcvb_gen.tasks import get_task

STORED, RESAMPLED = DISTRACTORS = ("stored", "resample")
"""Labels to paint with: those of the data, or fresh ones for every epoch."""
DEFAULT_CACHE = 1_000_000_000
"""Bytes of painted episodes that a subset keeps."""
DRAWN_TOGETHER = 32
"""Episodes whose fresh distractors are drawn at once: one episode's walks take as long as those of dozens."""
DRAWN_KEPT = 4 * DRAWN_TOGETHER
"""Episodes of which a subset keeps what they are painted from."""


Drawn = tuple[np.ndarray, DistractorState]
"""(row, ...) physics states and labels that an episode's frames are painted from, to its end."""


@dataclass(frozen=True)
class Painting:
    """Settings by which pictures are rendered when they are read.

    Attributes:
      distractors: "stored" or "resample".
      size: pixels a side, None for the subset's own.
      backgrounds: "builtin" or a folder of videos, None for the release's own.
      cache_bytes: bytes of painted episodes that are kept.
    """

    distractors: str = STORED
    size: int | None = None
    backgrounds: str | None = None
    cache_bytes: int = DEFAULT_CACHE

    def __post_init__(self) -> None:
        if self.distractors not in DISTRACTORS:
            raise DmcvbError(f"distractors={self.distractors!r} is unknown; give one of {', '.join(DISTRACTORS)}")
        if self.size is not None:
            check_size(self.size)


class PaintedSubset(SubsetReader):
    """A subset whose pictures are rendered when they are read. With fresh distractors, each epoch shows others.

    Labels are those of the pictures. Stored depth, segmentation, parts and flow are of the stored distractors and size,
    so they are only read with these.
    """

    def __init__(self, release: Release, record: SubsetRecord, painting: Painting):
        # What is stored may be of another size, or without pictures; this subset says what can be read of it.
        super().__init__(release, record.model_copy(update={"size": painting.size or record.size}))
        self.painting, self.fresh = painting, painting.distractors == RESAMPLED
        self.other_videos = painting.backgrounds
        self._other_frames = self.fresh or self.record.size != record.size
        self._start()

    def _start(self) -> None:
        self._kept: OrderedDict[tuple[int, int, str], np.ndarray] = OrderedDict()
        self._drawn: OrderedDict[tuple[int, int], Drawn] = OrderedDict()
        self._bytes, self._lock = 0, threading.Lock()

    def __getstate__(self) -> dict[str, Any]:  # painters and what they painted stay where they are
        made = ("_kept", "_drawn", "_painter", "_bytes", "_lock")
        return {name: value for name, value in super().__getstate__().items() if name not in made}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._start()

    @property
    def unpainted(self) -> np.ndarray:
        """(episode of the whole subset,) bool: none is without images."""
        return np.zeros(self.record.episodes, bool)

    @property
    def arrays(self) -> tuple[str, ...]:
        stored = super().arrays
        unlike = set(stored_in(stored)) if self._other_frames else set()
        if self.fresh:
            unlike |= {name for name in stored if re.match(r"exogenous/|at\d+/", name)}
        return tuple(sorted({*stored, *all_pictures(self.record)} - unlike | set(self._fresh_specs)))

    def array(self, name: str) -> Any:
        """See `Subset.array`.

        Raises:
          StoreError: it was computed for other images than these.
        """
        if picture_of(name) is not None:
            spec = image_array(name, self.record.size, camera_moves=False, rows=self.record.max_steps + 1)
            return self._computed(spec, lambda e, rest: self.painted(e, [name])[name][rest])
        if self._other_frames and stored_in([name]):
            raise StoreError(
                f"the stored {name} of {self.name} belongs to the images as they were made, not to those with "
                "distractors='resample' or another size; open the release without these to read it"
            )
        if name not in self._fresh_specs:
            return super().array(name)
        spec = self._fresh_specs[name]
        return self._computed(spec, lambda e, rest: self._shown_label(e, spec)[rest])

    def _computed(self, spec: ArraySpec, compute: Callable[[int, tuple], np.ndarray]) -> ComputedArray:
        shape = (self.record.episodes, self.record.max_steps + 1, *spec.shape)
        return ComputedArray(spec.name, shape, np.dtype(spec.dtype), ("episode", "step", *spec.dims), compute)

    @functools.cached_property
    def _fresh_specs(self) -> dict[str, ArraySpec]:
        """The labels that are drawn afresh, by name; its setting may vary more or less than what is stored."""
        return {spec.name: spec for spec in drawn_labels(self.record)} if self.fresh else {}

    def _shown_label(self, episode: int, spec: ArraySpec) -> np.ndarray:
        """Values of a fresh label, rows past the episode's end zero."""
        self._check_episode(episode)
        values = np.zeros((self.record.max_steps + 1, *spec.shape), spec.dtype)
        with self._lock:
            _, labels = self._drawn_of(episode)
        values[: len(labels)] = getattr(labels, spec.name.removeprefix("exogenous/"))
        return values

    def prepare(self, episodes: np.ndarray, pictures: Iterable[str]) -> None:
        """Read and draw what episodes are painted from together, as far as their pictures are not kept."""
        with self._lock:
            names, epoch = tuple(pictures), self.epoch
            missing = [int(e) for e in episodes if any((int(e), epoch, name) not in self._kept for name in names)]
            if len(missing) <= DRAWN_KEPT:
                for first in range(0, len(missing), DRAWN_TOGETHER):
                    self._draw(missing[first : first + DRAWN_TOGETHER])

    def seen(self, pictures: Sequence[str], episodes: np.ndarray, rows: int) -> Iterator[list[np.ndarray]]:
        for episode in episodes:
            found = self.painted(int(episode), pictures, keep=not self.fresh)
            yield [found[name] for name in pictures]

    def painted(self, episode: int, arrays: Iterable[str] | None = None, keep: bool = True) -> dict[str, np.ndarray]:
        """Picture arrays of an episode by name, each (row, height, width, 3) uint8.

        Args:
          arrays: only these, all that can be painted by default.
          keep: keep them while there is room.

        Raises:
          StoreError: there is no such episode here.
        """
        self._check_episode(episode)
        epoch = self.epoch
        keys = {name: (episode, epoch, name) for name in (all_pictures(self.record) if arrays is None else arrays)}
        with self._lock:
            found = {name: self._kept[key] for name, key in keys.items() if key in self._kept}
            missing = [name for name in keys if name not in found]
            if missing:
                found |= self._paint(episode, missing)
            for name, key in keys.items() if keep else ():
                self._bytes += 0 if key in self._kept else found[name].nbytes
                self._kept[key] = found[name]
                self._kept.move_to_end(key)
            while self._bytes > self.painting.cache_bytes and len(self._kept) > 1:
                self._bytes -= self._kept.popitem(last=False)[1].nbytes
            return found

    def _check_episode(self, episode: int) -> None:
        if episode not in self.episodes:
            raise StoreError(f"{self.name} has no episode {episode}; it has {len(self.episodes)} episodes")

    def _paint(self, episode: int, arrays: list[str]) -> dict[str, np.ndarray]:
        renderer, _ = self._painter
        physics, labels = self._drawn_of(episode)
        length, rows = np.array([len(physics) - 1]), self.record.max_steps + 1
        pictures = paint(get_task(self.task), renderer, physics[None], labels[None], length, rows, arrays=arrays)
        return {name: value[0].copy() for name, value in pictures}

    @functools.cached_property
    def _painter(self) -> tuple[Renderer, Any]:
        check_task_code(self.task, self.trajectories)
        return renderer_for(self.record, self._videos())

    def _drawn_of(self, episode: int) -> Drawn:
        """What an episode's frames are painted from in this epoch; fresh labels are drawn with those of neighbors."""
        if (episode, self.epoch) not in self._drawn:
            together = [episode]
            if self.fresh:
                first = int(np.argmax(self.episodes == episode)) // DRAWN_TOGETHER * DRAWN_TOGETHER
                together = self.episodes[first : first + DRAWN_TOGETHER].tolist()
            self._draw(together)
        return self._drawn[episode, self.epoch]

    def _draw(self, episodes: list[int]) -> None:
        new = [episode for episode in episodes if (episode, self.epoch) not in self._drawn]
        if new:
            physics, length = self.read("physics", new), self.read("length", new)
            labels = self._fresh_labels(new, physics, length) if self.fresh else self.labels(new)
            self._drawn |= {
                (episode, self.epoch): (physics[place, :rows], labels[place, :rows])
                for place, (episode, rows) in enumerate(zip(new, length + 1, strict=True))
            }
        for episode in episodes:
            self._drawn.move_to_end((episode, self.epoch))
        while len(self._drawn) > DRAWN_KEPT:
            self._drawn.popitem(last=False)

    def _fresh_labels(self, episodes: list[int], physics: np.ndarray, length: np.ndarray) -> DistractorState:
        names, (_, videos) = (*self.trajectories.makes["streams"], f"epoch {self.epoch}"), self._painter
        streams = (self.record, int(self.trajectories.makes["seed"]), names, episodes)
        return distractor_state_of(*streams, physics, length, videos, self.read("action", episodes))

    def _videos(self) -> str:
        given = self.painting.backgrounds
        if given and self.fresh:
            return given  # fresh distractors may show other videos
        shown = whose_videos(self.release, self.record) if self.fresh else self.record
        root = given or local_inputs(self.release.store, self.release.inputs_of([shown.name]))
        return background_source(root, shown, given)


class PaintedRelease(ReleaseReader):
    """A release whose subsets are painted when they are read.

    Attributes:
      painting: how.
      missing: only subsets that lack some images are painted; the others are read as they are stored.
    """

    painting: Painting
    missing: bool = False

    def _subset(self, record: SubsetRecord) -> SubsetReader:
        stored = SubsetReader(self, record)
        whole = self.missing and not stored.unpainted.any()
        return stored if record.imported or whole else PaintedSubset(self, record, self.painting)


def painted_release(release: Release, painting: Painting, missing: bool = False) -> ReleaseReader:
    """An open release whose pictures are painted when they are read.

    Args:
      missing: only those of subsets that lack some of them; the others are read as they are stored.

    Raises:
      StoreError: the release was imported, and not only missing pictures are to be painted.
    """
    if all(record.imported for record in release.manifest.subsets) and not missing:
        raise StoreError(f"{release.place} was imported and has no physics states to paint from; open it without paint")
    painted = PaintedRelease(release.store, release.manifest, release.digest, release.compared, release.copy)
    painted.painting, painted.missing = painting, missing
    return painted
