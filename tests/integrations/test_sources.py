"""Readers give the pictures that a subset is about, in the task's order."""

from __future__ import annotations

import numpy as np

import dmcvb_gen
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
        alone = [stack_channels([row]) for row in values["pixels"]]
        np.testing.assert_array_equal(subset.torch("episodes")[1]["pixels"], alone)
        [batch] = subset.batches(10**6)
        chosen = (batch["episode"] == 1) & (batch["step"] == 5)
        np.testing.assert_array_equal(batch["pixels"][chosen][0], expected)
        if len(one.views) > 1:
            two = subset.source(pictures=["follow", "top"], stack=1)[before + 5]["pixels"]
            np.testing.assert_array_equal(two, stack_channels(values["pixels"][5:6][:, [2, 0]]))
