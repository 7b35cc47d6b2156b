"""Every task of dm_control's suite through the commands: rollout, verify, regenerate, export, environment."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dmcvb_gen.dataset import open_release
from dmcvb_gen.loaders.envs import DistractedEnv
from dmcvb_gen.rendering import default_renderer
from dmcvb_gen.tasks import get_task
from tests.test_tasks import SUITE
from tests.test_whole_way import run

SIZE = 16


@pytest.mark.slow
@pytest.mark.parametrize("task_id", SUITE)
def test_a_suite_task_goes_the_whole_way(task_id, tmp_path):
    folder, task = tmp_path / "release", get_task(task_id)
    short = ["--level", "random", "--episodes", 2, "--max-steps", 4, "--size", SIZE, "--distractor", "dynamic"]
    run("rollout", task_id, *short, "--out", folder)
    assert json.loads(run("verify", folder, "--json"))["sound"]
    assert "same digest" in run("regenerate", folder, "--check")
    [subset] = open_release(folder).subsets.values()
    values = subset.episode(1)
    assert values["state"].shape[1] == task.state_size and np.isfinite(values["state"]).all()
    assert len(np.unique(values["pixels"].reshape(-1, 3), axis=0)) > 20  # there is something to see
    run("export", folder, "--to", "npz", "--out", tmp_path / "npz")
    assert list((tmp_path / "npz").rglob("*.npz"))
    env = DistractedEnv(task_id, "dynamic", size=SIZE, renderer=default_renderer(task))
    observation, _ = env.reset(seed=0)
    observation, reward, *_ = env.step(np.zeros(task.action_size, np.float32))
    assert np.isfinite(reward) and observation is not None
    env.close()
