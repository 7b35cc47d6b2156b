"""Depth, segmentation and flow through a release of each family: stored, verified, read, exported; and environments."""

from __future__ import annotations

import json

import imageio.v3 as iio
import numpy as np
import pyarrow.parquet as pq
import pytest

import dmcvb_gen
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.generate.modalities import get_modality
from dmcvb_gen.generate.modalities.depth import SCALE
from dmcvb_gen.generate.modalities.flow import STEP
from dmcvb_gen.generate.modalities.parts import AGENT, BACKGROUND, FLOOR, GOAL, WALL
from dmcvb_gen.generate.repaint import Repainting, repaint
from dmcvb_gen.release.verify import verify
from dmcvb_gen.tasks import get_task
from tests.conftest import invoke, roll_out, short_recipe

MODALITIES = ["depth", "segmentation", "flow", "parts"]


@pytest.mark.slow
@pytest.mark.parametrize("family", ["locomotion", "suite", "maze"])
def test_modalities_go_from_a_release_to_an_export(family, tmp_path, maze_release):
    source = maze_release
    if family != "maze":
        task = {"locomotion": "humanoid-walk", "suite": "hopper-hop"}[family]
        roll_out(short_recipe(tasks=task, settings="dynamic", episodes=2, max_steps=6), source := tmp_path / "source")
    repaint(Repainting(source, tmp_path / "r", size=16, labels=MODALITIES))
    assert verify(tmp_path / "r").sound
    [(name, subset)] = Release.open(tmp_path / "r").subsets.items()
    views = get_task(subset.task).views
    assert len([array for array in subset.arrays if array.partition("/")[0] == "flow"]) == len(views)
    for index in range(2):
        episode = dmcvb_gen.open(str(tmp_path / "r"))[name].episode(index)
        flow = episode["flow" if len(views) == 1 else f"flow/{views[0]}"]
        length = len(flow) - 1
        assert flow.shape == (length + 1, 16, 16, 2) and flow.dtype == np.float32
        assert not flow[-1].any() and np.abs(flow[:-1]).max() > 0 and np.isfinite(flow).all()
    invoke("export", tmp_path / "r", "--to", "npz", "--out", tmp_path / "npz", code=0)
    file = np.load(sorted((tmp_path / "npz").rglob("*.npz"))[-1])
    key = "flow" if len(views) == 1 else f"flow_{views[0]}"
    np.testing.assert_array_equal(file[key], flow)
    assert file[key.replace("flow", "segmentation")].dtype == np.int16
    parts = {BACKGROUND, AGENT, FLOOR} | ({WALL} if family == "maze" else set())
    assert parts <= set(np.unique(np.concatenate([file[k].ravel() for k in file if k.startswith("parts")]))) | {GOAL}
    check_lerobot(tmp_path, file, key)


def check_lerobot(folder, file, flow):
    """LeRobot's frames of the last episode hold what npz's do: exactly, but for 8 bits of flow."""
    invoke("export", folder / "r", "--to", "lerobot", "--out", folder / "lerobot", code=0)
    [info] = [json.loads(path.read_text()) for path in (folder / "lerobot").rglob("info.json")]
    [table] = (folder / "lerobot").rglob("data/*/*.parquet")
    length = len(file["action"]) - 1
    for modality in MODALITIES:
        name = flow.replace("flow", modality)
        feature, kind = info["features"][f"observation.images.{name}"], get_modality(modality)
        assert feature["dtype"] == "image" and feature["info"]["encoding"] == (kind.levels or kind.encoding)
        assert feature["info"].get("is_depth_map", False) == (modality == "depth")
        wanted = (kind.gray if kind.levels else kind.color)(file[name][:length])
        rows = pq.read_table(table)[f"observation.images.{name}"].to_pylist()[-length:]
        found = np.stack([iio.imread(row["bytes"]) for row in rows])
        np.testing.assert_array_equal(found, wanted)
        assert found.shape[1:3] == (16, 16) and list(found.shape[3:]) == [3] * (kind.levels is None)


def test_images_hold_the_values_as_their_encodings_say():
    geom_of, depth_of, flow_of = map(get_modality, ("segmentation", "depth", "flow"))
    segmentation = np.arange(-1, 2**15 - 1, dtype=np.int16)[:, None]
    codes = geom_of.color(segmentation).astype(int) @ [65536, 256, 1]
    assert len(np.unique(codes)) == len(segmentation)  # no two geoms have one color
    np.testing.assert_array_equal(geom_of.gray(segmentation).astype(int) - 1, segmentation)
    flow = np.linspace(-15, 15, 999, dtype=np.float32)[:, None, None].repeat(2, axis=-1)
    assert np.abs((flow_of.color(flow)[..., :2].astype(float) - 128) * STEP - flow).max() <= STEP / 2
    depth = np.abs(flow[..., 0])
    assert np.abs(depth_of.gray(depth) / 1000 - depth).max() <= 0.5001e-3
    grey = depth_of.color(depth)[..., 0]
    assert np.abs(grey - np.where(depth > 0, 255 / (1 + depth / SCALE), 0)).max() <= 0.5001
    assert flow_of.levels is None and "geom" in geom_of.encoding
