"""Statistics of a release's states, beside the same computed by hand, for both families."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.release.statistics import states_json
from dmcvb_gen.tasks import get_task


@pytest.mark.parametrize("fixture", ["small_release", "small_mazes"])
def test_every_number_of_the_states(fixture, request):
    release = Release.open(request.getfixturevalue(fixture))
    subset = next(iter(release.subsets.values()))
    rows = np.concatenate([subset.episode(int(e))["state"] for e in subset.episodes]).astype(float)
    [(task, told)] = json.loads(states_json(release)).items()
    assert told["steps"] == len(rows) and task == subset.task
    for name, place in get_task(subset.task).state_slices.items():
        np.testing.assert_allclose(told["fields"][name]["mean"], rows.mean(axis=0)[place], rtol=1e-4)
        np.testing.assert_allclose(told["fields"][name]["std"], rows.std(axis=0)[place], rtol=1e-4, atol=1e-12)
