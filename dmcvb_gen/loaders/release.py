"""`dmcvb_gen.open`: a folder or URL in; subsets that give episodes, xarray, torch and numpy out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from dmcvb_gen.dataset import Release, Subset, open_release
from dmcvb_gen.errors import StoreError, UnknownNameError
from dmcvb_gen.loaders.blocks import choose, stream
from dmcvb_gen.loaders.source import StepSource
from dmcvb_gen.storage.remote import storage_errors

if TYPE_CHECKING:
    import xarray

KINDS = ("steps", "transitions", "episodes", "stream")


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
          StoreError: an episode is not there, or has not been painted where others have; also where values are used
            that are damaged or cannot be read.
        """
        import xarray

        from dmcvb_gen.loaders.lazy import guarded

        chosen = choose(self, episodes)
        if any(name in self.paths for name in self.pixel_arrays) and self.unpainted[chosen].any():
            raise StoreError(self._without_pictures)  # they would read as black
        options = self._storage_options if "://" in self.root else None
        path = f"{self.root}/{self.name}.zarr"
        parts = []
        for folder in sorted({path.rpartition("/")[0] for path in self.paths.values()}):
            with storage_errors(path, decoding=True):
                part = xarray.open_zarr(
                    path, group=folder or None, consolidated=None, chunks=None, storage_options=options
                )
            # In releases of version 1 a dimension had its array's name, which xarray takes for a coordinate.
            part = part.reset_coords().rename_dims({name: f"{name}_dim" for name in part.dims if name in part})
            part = guarded(part, f"{path}/{folder}".rstrip("/"))
            parts.append(part.rename({name: f"{folder}_{name}".replace("/", "_") for name in part} if folder else {}))
        merged = xarray.merge(parts, combine_attrs="override")
        merged = merged.isel(episode=chosen).assign_coords(episode=chosen, step=np.arange(merged.sizes["step"]))
        return merged.assign_attrs(self.attrs)

    def torch(self, kind: str = "steps", **options: Any) -> Any:
        """A torch data set.

        Args:
          kind: "steps" (`StepDataset`: frame stacks with their action), "transitions" (the same, with what comes
            next), "episodes" (`EpisodeDataset`), "stream" (`StreamDataset`, the quick way through a large subset).
          options: of that class.

        Raises:
          UnknownNameError: no such kind.
        """
        from dmcvb_gen.loaders import torch_data

        if kind == "steps":
            return torch_data.StepDataset(self, **options)
        if kind == "transitions":
            return torch_data.StepDataset(self, next_step=True, **options)
        if kind == "episodes":
            return torch_data.EpisodeDataset(self, **options)
        if kind == "stream":
            return torch_data.StreamDataset(self, **options)
        raise UnknownNameError("kind of data set", kind, KINDS)

    def source(self, **options: Any) -> StepSource:
        """Any step at random, numpy alone: for Grain, tf.data or torch; `options` as for `StepSource`."""
        return StepSource(self, **options)

    def batches(self, batch_size: int, **options: Any) -> Iterator[dict[str, np.ndarray]]:
        """One pass over the steps in shuffled numpy batches; `options` as for `StreamDataset`."""
        yield from stream(self, batch_size=batch_size, **options)


class ReleaseReader(Release):
    """A release whose subsets are `SubsetReader`s."""

    subsets: Mapping[str, SubsetReader]

    def __getitem__(self, name: str) -> SubsetReader:
        return cast(SubsetReader, super().__getitem__(name))


def open_for_reading(path: str, storage_options: dict | None = None) -> ReleaseReader:
    """See `dmcvb_gen.open`."""
    release = open_release(path, storage_options)
    subsets = {
        name: SubsetReader(subset.root, subset.record, subset.commits, subset._storage_options)
        for name, subset in release.subsets.items()
    }
    return ReleaseReader(release.root, release.manifest, subsets)
