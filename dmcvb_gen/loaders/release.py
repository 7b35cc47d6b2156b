"""`dmcvb_gen.open`: read subsets at a folder or URL as episodes, xarray, torch or numpy."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    """

    def __getitem__(self, index: int) -> dict[str, Any]:
        """The arrays of the `index`-th episode that is here, see `episode`; negative ones count from the end."""
        return self.episode(int(self._episodes[index]))

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
          UnknownNameError: no such kind.
        """
        from dmcvb_gen.loaders import torch_data

        kinds = {
            "steps": torch_data.StepDataset,
            "transitions": torch_data.StepDataset,
            "episodes": torch_data.EpisodeDataset,
            "stream": torch_data.StreamDataset,
        }
        if kind not in kinds:
            raise UnknownNameError("kind of data set", kind, kinds)
        if kind == "transitions":
            options["next_step"] = True
        return kinds[kind](self, **options)

    def source(self, **options: Any) -> StepSource:
        """Any step at random, numpy alone: for Grain, tf.data or torch; `options` as for `StepSource`."""
        return StepSource(self, **options)

    def batches(self, batch_size: int, **options: Any) -> Iterator[Steps]:
        """One pass over the steps in shuffled numpy batches; `options` as for `sampler.stream`."""
        return stream(self, batch_size=batch_size, **options)


class ReleaseReader(Release):
    """A release whose subsets are `SubsetReader`s."""

    def _subset(self, record: SubsetRecord) -> SubsetReader:
        return SubsetReader(self, record)

    def __getitem__(self, name: str) -> SubsetReader:
        return super().__getitem__(name)


def open_for_reading(path: str | Path, storage_options: dict | None = None, digest: str | None = None) -> ReleaseReader:
    """See `dmcvb_gen.open`."""
    return ReleaseReader.open(path, storage_options, digest)
