"""Read the chosen episodes of a subset, one at a time, for exporters."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from dmcvb_gen.dataset.manifest import Manifest, Resolved
from dmcvb_gen.dataset.pictures import Pictures, shown
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.generate.modalities import stored_in
from dmcvb_gen.loaders.release import ReleaseReader, SubsetReader

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class ExportEpisode:
    """An episode of L transitions.

    Attributes:
      index: index in the subset. seed: label of its random streams.
      pixels: view -> (L + 1, height, width, 3) uint8.
      state: (L + 1, state) float32.
      action, reward, discount: (L, action), (L,), (L,) float32.
      terminated: the task ended it; else the time limit did.
      modalities: "depth", "segmentation", "flow" that the subset stores, "depth/top" if it has several views ->
        (L + 1, height, width, ...), see `generate.modalities`.
    """

    index: int
    seed: int
    pixels: dict[str, np.ndarray]
    state: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    discount: np.ndarray
    terminated: bool
    modalities: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def length(self) -> int:
        return len(self.action)

    def stacked(self) -> np.ndarray:
        """(L + 1, height, width, 3 * view) uint8: the views side by side in the channels."""
        return np.concatenate(list(self.pixels.values()), axis=-1)

    def named_modalities(self) -> dict[str, np.ndarray]:
        """The modalities by names without a slash: "depth", "depth_top"."""
        return {name.replace("/", "_"): values for name, values in self.modalities.items()}

    def arrived(self) -> dict[str, np.ndarray]:
        """Actions, rewards, discounts in the alignment of dm_env: row t holds the action that led to observation t.

        (L + 1, ...) float32; the first row has no action (zeros), reward 0 and discount 1.
        """
        zero = np.zeros((1, self.action.shape[1]), np.float32)
        return {
            "action": np.concatenate([zero, self.action]),
            "reward": np.concatenate([np.zeros(1, np.float32), self.reward]),
            "discount": np.concatenate([np.ones(1, np.float32), self.discount]),
        }


@dataclass(frozen=True)
class Source:
    """The chosen episodes of a subset, with its facts."""

    release: ReleaseReader
    subset: SubsetReader
    episodes: list[int]
    tick: Callable[[int], None]
    digest: str
    """SHA-256 of the export's stamp, which names the shards that it reads."""

    @property
    def manifest(self) -> Manifest | Resolved:
        return self.release.manifest

    @property
    def steps_per_second(self) -> float:
        return 1 / self.subset.record.seconds_per_step

    @property
    def pictures(self) -> Pictures:
        """The views that the subset shows, in the task's order; without the goal if its setting hides it."""
        return shown(self.subset)

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views: "pixels", or "top", ..."""
        return self.pictures.views

    @property
    def modalities(self) -> tuple[str, ...]:
        """Stored arrays of depth, segmentation and flow: "depth", or "depth/top", ..."""
        return stored_in(self.subset.arrays)

    @property
    def names(self) -> dict[str, list[str]]:
        """Array ("state", "action") -> a name for each of its entries."""
        return entry_names(self.subset)

    @property
    def joints(self) -> list[str]:
        """Names of the model's joints, in MuJoCo's order."""
        return list(self.subset.record.joints)

    @property
    def description(self) -> str:
        manifest = self.manifest
        return f"{self.subset.name} of {manifest.name} {manifest.version} ({manifest.license}), by dmcvb-gen"

    def __iter__(self) -> Iterator[ExportEpisode]:
        pictures = self.pictures
        arrays = ["state", "action", "reward", "discount", "terminated", "seed", *pictures.arrays, *self.modalities]
        for index in self.episodes:
            values = self.subset.episode(index, arrays)
            yield ExportEpisode(
                index=index,
                seed=int(values["seed"]),
                pixels={view: values[name] for view, name in zip(pictures.views, pictures.arrays, strict=True)},
                terminated=bool(values["terminated"]),
                modalities={name: values[name] for name in self.modalities},
                **{name: values[name] for name in ("state", "action", "reward", "discount")},
            )
            self.tick(1)


def entry_names(subset: Subset) -> dict[str, list[str]]:
    """Array ("state", "action") -> a name for each of its entries."""
    places = range(subset.array("state").shape[-1])  # a field that says it has more has no more
    fields = sorted(subset.spec("state").attributes["fields"].items(), key=lambda field: field[1])
    state = [f"{name}.{i}" for name, (first, last) in fields for i, _ in enumerate(places[first:last])]
    actuators = subset.record.actuators or [""] * subset.array("action").shape[-1]
    return {"state": state, "action": [name or f"actuator.{i}" for i, name in enumerate(actuators)]}


def png(frame: np.ndarray) -> bytes:
    """(height, width, 3) uint8, or (height, width) uint16, as a PNG file."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "PNG")
    return buffer.getvalue()


def table_schema(columns: Mapping[str, tuple[str, int]]) -> pa.Schema:
    """The schema of a Parquet table, with the metadata by which Hugging Face's `datasets` knows pictures.

    Args:
      columns: name -> its type, "float32", ... or "image", and how many numbers a row has of it.
    """
    import pyarrow as pa

    fields: list[pa.Field] = []
    features: dict[str, Any] = {}
    for name, (dtype, count) in columns.items():
        if dtype == "image":
            kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
            features[name] = {"_type": "Image"}
        else:
            kind = pa.type_for_alias(dtype)
            features[name] = {"dtype": dtype, "_type": "Value"}
            if count > 1:  # LeRobot takes a single number for a scalar
                kind = pa.list_(kind, count)
                features[name] = {"feature": features[name], "length": count, "_type": "List"}
        fields.append(pa.field(name, kind))
    return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": features}})})
