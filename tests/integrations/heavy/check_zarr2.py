"""zarr-python 2 reads the replay buffer as diffusion policy does: run by scripts/test_integrations.sh."""

import json
import sys
from pathlib import Path

import numpy as np
import zarr

assert zarr.__version__.startswith("2."), zarr.__version__
work = Path(sys.argv[1])
for one in json.loads((work / "wanted.json").read_text()):
    stored = np.load(work / one["values"])
    views = [str(view) for view in stored["views"]]
    root = zarr.group(zarr.DirectoryStore(str(Path(one["replay-buffer"]) / "replay_buffer.zarr")))
    data = {name: array[:] for name, array in root["data"].items()}
    ends = root["meta"]["episode_ends"][:]
    assert all(len(value) == ends[-1] for value in data.values())
    for index, (start, end) in enumerate(zip([0, *ends[:-1]], ends, strict=True)):
        for place, view in enumerate(views):
            name = "img" if len(views) == 1 else f"img_{view}"
            np.testing.assert_array_equal(data[name][start:end], stored[f"pixels_{index}"][:-1, place])
        np.testing.assert_array_equal(data["action"][start:end], stored[f"action_{index}"])
        np.testing.assert_array_equal(data["state"][start:end], stored[f"state_{index}"][:-1])
    print(f"zarr {zarr.__version__}: {one['subset']} opens, {len(ends)} episodes", flush=True)
