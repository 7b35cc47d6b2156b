"""The same states under several settings: pairs that differ in nothing but what distracts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NoReturn

import numpy as np

from dmcvb_gen.dataset.pictures import picture_arrays, picture_of, shown
from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.loaders.arrays import PairedArray
from dmcvb_gen.loaders.invariance import evaluate_invariance
from dmcvb_gen.loaders.painted import RESAMPLED, PaintedSubset, Painting
from dmcvb_gen.loaders.release import SubsetReader
from dmcvb_gen.spec import SubsetSpec, subset_name


class PairedReader(SubsetReader):
    """A subset whose images stand side by side under several settings.

    Attributes:
      parts: a subset for each setting; its `labels` are those of its images.
    """

    def __init__(self, subset: SubsetReader, settings: Sequence[str]):
        if len(settings) < 2:
            raise DmcvbError(f"{len(settings)} settings are given; give two or more, e.g. paired('none', 'static')")
        specs = [SubsetSpec.parse(subset.task, "random", setting) for setting in settings]
        names = [subset_name(subset.task, subset.level, spec.setting) for spec in specs]
        name = subset_name(subset.task, subset.level, "+".join(spec.setting for spec in specs))
        super().__init__(subset.release, subset.record.model_copy(update={"name": name}))
        self.parts = tuple(
            _under(subset, spec, name, again=name in names[:place])
            for place, (spec, name) in enumerate(zip(specs, names, strict=True))
        )
        if len(sizes := {part.record.size for part in self.parts}) > 1:
            raise DmcvbError(f"{name} has images of {min(sizes)} and {max(sizes)} pixels; pair settings of one size")
        self.looks, self.fresh = len(self.parts), any(part.fresh for part in self.parts)
        everywhere = np.all([np.isin(subset.episodes, part.episodes) for part in self.parts], axis=0)
        self.__dict__["_episodes"] = subset.episodes[everywhere]
        self.set_epoch(0)

    def evaluate_invariance(self, encoder: Callable[[np.ndarray], Any], **options: Any) -> Any:
        """Measure what an encoder keeps of the state, and what of the distractors.

        Args:
          encoder: takes (image, stack * view * 3, height, width) uint8 and gives (image, feature), numpy or torch.
          options: states (512) that are drawn of so many episodes (16) by seed (0); stack, pictures as for `batches`.

        Returns:
          An `Invariance`: retrieval of the same state under another setting, and how well linear probes find the state
          and the distractors' labels.

        Raises:
          DmcvbError: there are fewer than two episodes.
        """
        return evaluate_invariance(self, encoder, **options)

    def set_epoch(self, epoch: int) -> None:
        super().set_epoch(epoch)
        for place, part in enumerate(self.parts):
            part.set_epoch(self.epoch * self.looks + place)

    @property
    def arrays(self) -> tuple[str, ...]:
        return tuple(sorted({*shown(self).arrays, *(spec.name for spec in self.trajectories.arrays)}))

    def array(self, name: str) -> Any:
        found = picture_of(name)
        if found is None:
            return super().array(name)
        return PairedArray(name, [part.array(*_image(part, found[0])) for part in self.parts])

    def labels(self, episodes: Any = None) -> NoReturn:
        raise DmcvbError(f"{self.name} has labels for each setting: [part.labels(...) for part in subset.parts]")

    def prepare(self, episodes: np.ndarray, pictures: Iterable[str]) -> None:
        for part in self.parts:
            part.prepare(episodes, _image(part, *_views(pictures)))

    def seen(self, pictures: Sequence[str], episodes: np.ndarray, rows: int) -> Iterator[list[np.ndarray]]:
        looks = (part.seen(_image(part, *_views(pictures)), episodes, rows) for part in self.parts)
        for episode in zip(*looks, strict=True):
            yield [picture for look in episode for picture in look]


def _views(pictures: Iterable[str]) -> list[str]:
    return [found[0] for name in pictures if (found := picture_of(name))]


def _image(part: SubsetReader, *views: str) -> tuple[str, ...]:
    """Names of the images of views that a part shows, the goal hidden if its setting hides it."""
    return picture_arrays(views, part.record.hidden_goal)


def _under(subset: SubsetReader, spec: SubsetSpec, name: str, again: bool) -> SubsetReader:
    """A subset's trajectories under a setting, of its own images if the release has them."""
    release, record, stored = subset.release, subset.record, subset.release.subsets.get(name)
    look = record.model_copy(update={"name": name, "setting": spec.setting, "hidden_goal": spec.hides_goal})
    shared = stored is not None and stored.record.layers[0] == record.layers[0]
    if again or not (shared or spec.goal):
        if record.imported:
            raise StoreError(f"{subset.name} was imported and cannot be rendered; name settings that the release holds")
        return PaintedSubset(release, look, Painting(RESAMPLED, backgrounds=subset.other_videos))
    if shared:  # else a maze, whose images have the goal and leave it out
        look = stored.record
    part: SubsetReader = release._subset(look)
    whole = not part.unpainted.any() and set(shown(part).arrays) <= set(part.arrays)
    return part if whole else PaintedSubset(release, look, Painting(backgrounds=subset.other_videos))
