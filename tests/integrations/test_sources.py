"""Readers, HDF5, npz and the replay buffer give the pictures that a subset is about, in the task's order."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import zarr

import dmcvb_gen
from dmcvb_gen.release.export import export
from tests.conftest import stack_channels


def test_readers_stack_the_right_pictures(stored):
    for name, one in stored.items():
        subset = dmcvb_gen.open(str(one.folder))[name]
        length, values, _ = one.episode(1)
        rows = np.maximum(np.arange(5 - 2, 6), 0)
        expected = stack_channels(values["pixels"][rows])
        before = int(subset.lengths[0])
        for held in (True, False):
            np.testing.assert_array_equal(subset.source(in_memory=held)[before + 5]["pixels"], expected)
            np.testing.assert_array_equal(subset.torch("steps", in_memory=held)[before + 5]["pixels"], expected)
        np.testing.assert_array_equal(
            subset.torch("episodes")[1]["pixels"], [stack_channels([row]) for row in values["pixels"]]
        )
        [batch] = subset.batches(10**6)
        chosen = (batch["episode"] == 1) & (batch["step"] == 5)
        np.testing.assert_array_equal(batch["pixels"][chosen][0], expected)
        if len(one.views) > 1:
            two = subset.source(pictures=["follow", "top"], stack=1)[before + 5]["pixels"]
            np.testing.assert_array_equal(two, stack_channels(values["pixels"][5:6][:, [2, 0]]))


@pytest.mark.slow_cases("npz", "replay-buffer")
@pytest.mark.parametrize("to", ["hdf5", "npz", "replay-buffer"])
def test_files_have_the_right_pictures(stored, tmp_path, to):
    for name, one in stored.items():
        [folder] = export(str(one.folder), to, tmp_path, [name])
        length, values, _ = one.episode(0)
        pixels = values["pixels"]
        beside = np.moveaxis(pixels, 1, 3).reshape(len(pixels), *pixels.shape[2:4], -1)
        if to == "hdf5":
            with h5py.File(folder / "data_000.hdf5") as file:
                found = file["observation"][: length + 1].transpose(0, 2, 3, 1)
        elif to == "npz":
            found = np.load(folder / f"000000-{length + 1}.npz")["image"]
        else:
            data = zarr.open_group(str(folder / "replay_buffer.zarr"), mode="r")["data"]
            names = [f"img_{view}" for view in one.views] if len(one.views) > 1 else ["img"]
            found, beside = np.concatenate([data[n][:length] for n in names], axis=-1), beside[:length]
        np.testing.assert_array_equal(found, beside)
