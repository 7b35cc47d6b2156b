"""`dmcvb_gen.open`: read subsets at a folder or URL as episodes, xarray, torch or numpy."""

from __future__ import annotations

import copy
import importlib
import inspect
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, Self

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import SubsetRecord
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.errors import UnknownNameError
from dmcvb_gen.loaders.sampler import Steps, StepSource, stream

if TYPE_CHECKING:
    import xarray


class SubsetReader(Subset):
    """A subset with the forms that training code wants; see `Subset` for the rest.

    `len(subset)` counts the episodes that are here, `subset[0]` is the first of them.

    Attributes:
      parts: subsets that it is a union of, or that it sets side by side.
    """

    parts: tuple[SubsetReader, ...] = ()

    def __getitem__(self, index: int) -> dict[str, Any]:
        """The arrays of the `index`-th episode that is here, see `episode`; negative ones count from the end."""
        return self.episode(int(self._episodes[index]))

    def part(self, episodes: Iterable[int]) -> Self:
        """The same subset with these episodes alone, in this order: indices, or a mask (`subset.returns > 900`)."""
        chosen = copy.copy(self)
        chosen.parts = tuple(copy.copy(part) for part in self.parts)  # each with an epoch of its own
        for name in ("lengths", "returns"):
            chosen.__dict__.pop(name, None)
        chosen.__dict__["_episodes"] = self.choose(episodes)
        return chosen

    def paired(self, *settings: str) -> Any:
        """The same states under several settings: `subset.paired("none", "static")` is a `PairedReader`.

        It reads as a subset does; "pixels" of its batches are (batch, setting, stack * view * 3, height, width). Images
        that the release stores of these states are read. A setting of which it stores none, or that is named twice, is
        rendered on reading, with fresh distractors, others for each `set_epoch`.

        Raises:
          DmcvbError: no such setting of this task, or the data were imported and the release does not hold it.
        """
        return importlib.import_module("dmcvb_gen.loaders.paired").PairedReader(self, settings)  # it imports this one

    def xarray(self, episodes: Iterable[int] | None = None) -> xarray.Dataset:
        """All arrays as one lazy xarray data set.

        Args:
          episodes: indices of episodes that are here, all by default.

        Returns:
          Dimensions episode and step (and height, width, ...), coordinates `episode` and `step`, variables by the
          readers' names with "/" as "_" ("exogenous_camera_position"); read when used.

        Raises:
          StoreError: an episode is not here; also if values are used that are not here, damaged or cannot be read.
        """
        from dmcvb_gen.loaders.xarray_data import lazy_dataset

        return lazy_dataset(self, self.choose(episodes))

    def torch(self, kind: str = "steps", **options: Any) -> Any:
        """A torch data set.

        Args:
          kind: "steps" (`StepDataset`: frame stacks with their action), "transitions" (the same, with what comes
            next), "episodes" (`EpisodeDataset`), "stream" (`StreamDataset`, the quick way through a large subset).
          options: options of that class.

        Raises:
          UnknownNameError: no such kind, or it has no such option.
        """
        from dmcvb_gen.loaders import torch_data

        kinds: dict[str, tuple[Callable, Callable]] = {
            "steps": (torch_data.StepDataset, StepSource),
            "transitions": (torch_data.StepDataset, StepSource),
            "episodes": (torch_data.EpisodeDataset, torch_data.EpisodeDataset),
            "stream": (torch_data.StreamDataset, stream),
        }
        if kind not in kinds:
            raise UnknownNameError("kind of data set", kind, kinds)
        made, takes = kinds[kind]
        decided = {"next_step": True} if kind == "transitions" else {}
        ours = {"subset", "worker", "workers", *decided}
        known = [name for name in inspect.signature(takes).parameters if name not in ours]
        if unknown := options.keys() - {*known}:
            raise UnknownNameError(f"option of torch({kind!r})", min(unknown), known)
        return made(self, **options, **decided)

    def environment(self, **options: Any) -> Any:
        """The environment that matches the data: size, renderer, views, videos and time limit, with stacked frames.

        Args:
          options: stack (3) frames; split ("val"): "val" shows videos and styles that no data show, "train" the data's;
            num_envs: a vector environment; and those of `DistractedEnv`.
        """
        from dmcvb_gen.loaders.matching import matching_environment

        return matching_environment(self, **options)

    def evaluate(self, policy: Any, **options: Any) -> Any:
        """Score a policy on fresh episodes like the data's; see `dmcvb_gen.evaluate`, which takes a subset, too.

        Args:
          options: split ("val"), episodes (30), seed (0), stack (3), ...

        Returns:
          A `Score`; its `normalized` is 0 for random actions and 100 for the data's expert.
        """
        return importlib.import_module("dmcvb_gen").evaluate(policy, self, **options)  # of a floor above this one

    def source(self, **options: Any) -> StepSource:
        """Any step at random, numpy alone: for Grain, tf.data or torch; `options` as for `StepSource`."""
        return StepSource(self, **options)

    def batches(self, batch_size: int, **options: Any) -> Iterator[Steps]:
        """One pass over the steps in shuffled numpy batches; `options` as for `sampler.stream`."""
        if "epoch" in options:
            self.set_epoch(options["epoch"])  # of fresh distractors
        return stream(self, batch_size=batch_size, **options)


class ReleaseReader(Release):
    """A release whose subsets are `SubsetReader`s."""

    def _subset(self, record: SubsetRecord) -> SubsetReader:
        return SubsetReader(self, record)

    def __getitem__(self, name: str) -> SubsetReader:
        parts = self.parts_of(name := str(name))
        return self.union(*parts) if parts else super().__getitem__(name)

    def union(self, *names: str) -> SubsetReader:
        """Subsets that differ in level, read as one.

        `release.union("walker-walk/medium/none", "walker-walk/expert/none")` is medium-expert of D4RL and V-D4RL, and
        `release["walker-walk/medium-expert/none"]` is the same. Episodes are numbered through: those of the second
        subset come after all that the first one will have.

        Raises:
          DmcvbError: they differ in task, setting, size or time limit, or have no episodes here.
        """
        return importlib.import_module("dmcvb_gen.loaders.union").UnionReader(self, [self[name] for name in names])
