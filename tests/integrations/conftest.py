"""What exports are measured against: the pictures that a subset is about, read with zarr alone."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import zarr

VIEWS = ("top", "egocentric", "follow", "overhead")
"""Of mazes, in the order in which policies see them (SPEC, section 3)."""


@dataclass(frozen=True)
class Stored:
    """A subset as it lies on the disk."""

    folder: Path
    name: str

    @property
    def views(self):
        return VIEWS if self.name.startswith("ant-maze") else ("pixels",)

    def episode(self, index):
        """(length, arrays by name, "pixels" (L + 1, view, size, size, 3)), without the goal where it must be hidden."""
        task, level, setting = self.name.split("/")
        own = self.folder / f"{self.name}.zarr"  # mazes share no trajectories among settings
        root = zarr.open_group(str(own if own.is_dir() else self.folder / f"{task}/{level}.zarr"), mode="r")
        group, images = root["trajectories"], root[setting]
        length = int(group["length"][index])
        shown = "pixels_hidden_goal" if self.name.endswith(("hidden", "fixed")) else "pixels"
        names = [f"{shown}_{view}" for view in VIEWS] if len(self.views) > 1 else ["pixels"]
        values = {name: group[name][index, :length] for name in ("action", "reward")}
        values["state"] = group["state"][index, : length + 1]
        values["pixels"] = np.stack([images[name][index, : length + 1] for name in names], axis=1)
        return length, values, bool(group["terminated"][index])


@pytest.fixture(scope="session")
def stored(small_release, small_mazes):
    """Subsets of a walker and of a maze, all kinds of pictures, name -> `Stored`."""
    found = [Stored(small_release, "walker-walk/random/static")]
    found += [Stored(small_mazes, f"ant-maze-tiny/random/{goal}") for goal in ("visible", "hidden", "fixed")]
    return {one.name: one for one in found}
