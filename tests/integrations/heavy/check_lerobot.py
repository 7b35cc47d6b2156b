"""LeRobot opens its exports: run by scripts/test_integrations.sh in a venv of LeRobot's own."""

import json
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

work = Path(sys.argv[1])
wanted = json.loads((work / "wanted.json").read_text())
for one in wanted:
    stored = np.load(work / one["values"])
    views = [str(view) for view in stored["views"]]
    dataset = LeRobotDataset(f"local/{Path(one['lerobot']).name}", root=one["lerobot"])
    lengths = [len(stored[f"action_{index}"]) for index in range(2)]
    assert len(dataset) == sum(lengths) and dataset.num_episodes == 2, one
    start = 0
    for index, length in enumerate(lengths):
        for step in (0, length // 2, length - 1):
            item = dataset[start + step]
            for place, view in enumerate(views):
                key = "observation.image" if len(views) == 1 else f"observation.images.{view}"
                found = item[key].numpy().transpose(1, 2, 0) * 255
                gap = np.abs(found - stored[f"pixels_{index}"][step, place])
                assert gap.mean() < 1e-4, (one["subset"], view, gap.mean())
            np.testing.assert_array_equal(item["observation.state"].numpy(), stored[f"state_{index}"][step])
            np.testing.assert_array_equal(item["action"].numpy(), stored[f"action_{index}"][step])
            done = step == length - 1
            assert bool(item["next.done"]) == done
            assert bool(item["next.success"]) == (done and bool(stored[f"terminated_{index}"]))
        start += length
    assert "q99" in dataset.meta.stats["action"], sorted(dataset.meta.stats["action"])
    assert dataset.meta.names["observation.state"][0].endswith(".0"), dataset.meta.names
    print(f"lerobot: {one['subset']} opens, {len(dataset)} frames", flush=True)

dataset, stored = LeRobotDataset("local/causes", root=work / "causes_export"), np.load(work / "causes.npz")
assert dataset.meta.depth_keys == ["observation.images.depth"], dataset.meta.depth_keys
for step in (0, 7):
    for name in stored:
        found = dataset[step][f"observation.images.{name}"].numpy()
        if stored[name].dtype == np.uint8:
            np.testing.assert_array_equal(np.rint(found.transpose(1, 2, 0) * 255), stored[name][step])
        else:
            unit = 1000 if name == "depth" and dataset.depth_output_unit == "m" else 1
            np.testing.assert_allclose(found[0] * unit, stored[name][step], rtol=1e-6)
depth = dataset.meta.stats["observation.images.depth"]
assert 0 < float(depth["mean"].ravel()[0]) <= float(depth["max"].ravel()[0]), depth
print(f"lerobot: images of {', '.join(stored)} as stored", flush=True)
