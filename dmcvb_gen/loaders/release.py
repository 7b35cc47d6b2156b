"""`dmcvb_gen.open`: read subsets at a folder or URL as episodes, xarray, torch or numpy."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, cast

from dmcvb_gen.dataset import Release, Subset, open_release
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.loaders.source import StepSource
from dmcvb_gen.loaders.stream import Steps, stream

if TYPE_CHECKING:
    import xarray


class SubsetReader(Subset):
    """A subset with the forms that training code wants; see `Subset` for the rest."""

    def xarray(self, episodes: Iterable[int] | None = None) -> xarray.Dataset:
        """All arrays as one lazy xarray data set.

        Args:
          episodes: indices of committed episodes, all by default.

        Returns:
          Dimensions episode and step (and height, width, ...), coordinates `episode` and `step`, variables by the
          store's names with "/" as "_" ("exogenous_camera_position"); read when used.

        Raises:
          StoreError: an episode is not there, or has not been painted although others have; also if values are used
            that are damaged or cannot be read.
        """
        from dmcvb_gen.loaders.lazy import lazy_dataset

        chosen = self.choose(episodes)
        if any(name in self.paths for name in self.pixel_arrays) and self.unpainted[chosen].any():
            raise StoreError(self._without_pictures)  # they would read as black
        return lazy_dataset(self, chosen)

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

        kinds: dict[str, Callable[..., Any]] = {
            "steps": torch_data.StepDataset,
            "transitions": functools.partial(torch_data.StepDataset, next_step=True),
            "episodes": torch_data.EpisodeDataset,
            "stream": torch_data.StreamDataset,
        }
        if kind not in kinds:
            raise UnknownNameError("kind of data set", kind, kinds)
        return kinds[kind](self, **options)

    def source(self, **options: Any) -> StepSource:
        """Any step at random, numpy alone: for Grain, tf.data or torch; `options` as for `StepSource`."""
        return StepSource(self, **options)

    def batches(self, batch_size: int, **options: Any) -> Iterator[Steps]:
        """One pass over the steps in shuffled numpy batches; `options` as for `StreamDataset`."""
        return stream(self, batch_size=batch_size, **options)


class ReleaseReader(Release):
    """A release whose subsets are `SubsetReader`s."""

    subsets: Mapping[str, SubsetReader]

    def __getitem__(self, name: str) -> SubsetReader:
        return cast(SubsetReader, super().__getitem__(name))


def open_for_reading(path: str, storage_options: dict | None = None) -> ReleaseReader:
    """See `dmcvb_gen.open`."""
    release = open_release(path, storage_options)
    subsets = {name: subset.read_as(SubsetReader) for name, subset in release.subsets.items()}
    return ReleaseReader(release.root, release.manifest, subsets)
