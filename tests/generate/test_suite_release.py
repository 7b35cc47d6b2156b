"""Every task of dm_control's suite through the commands: train, rollout, verify, regenerate, validate, export, env."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.generate.renderer_choice import default_renderer
from dmcvb_gen.loaders.envs import DistractedEnv
from dmcvb_gen.tasks import get_task
from tests.conftest import run
from tests.tasks.test_tasks import SUITE

SIZE = 16
TINY = ("warmup_steps=8", "simulations=4", "batch_size=8", "actor_hidden=[8]", "critic_hidden=[8]")


@pytest.mark.full
@pytest.mark.parametrize("task_id", SUITE)
def test_a_suite_task_goes_the_whole_way(task_id, tmp_path):
    folder, task = tmp_path / "release", get_task(task_id)
    settings = [f"--set={pair}" for pair in (*TINY, "compile=false", "bfloat16=false")]
    run("train-behaviour", task_id, "--steps", 16, *settings, "--out", tmp_path / "run")
    newest = max((tmp_path / "run" / "checkpoints").glob("[0-9]*.safetensors"))
    short = ["--level", "expert", "--behaviour", newest, "--episodes", 2, "--max-steps", 4, "--size", SIZE]
    run("rollout", task_id, *short, "--distractor", "dynamic", "--out", folder)
    assert json.loads(run("verify", folder, "--json"))["sound"]
    assert "same digest" in run("regenerate", folder, "--check")
    [subset] = Release.open(folder).subsets.values()
    values = subset.episode(1)
    assert values["state"].shape[1] == task.state_size and np.isfinite(values["state"]).all()
    assert len(np.unique(values["pixels"].reshape(-1, 3), axis=0)) > 20  # there is something to see
    few = ["--profile", "smoke", "--agents", "state-bc", "--workers", 1, "--out", tmp_path / "report"]
    run("validate", folder, *few)
    [result] = json.loads((tmp_path / "report" / "report.json").read_text())["results"]
    assert np.isfinite(result["score"]["returns"]).all() and result["cell"]["task"] == task_id
    run("export", folder, "--to", "npz", "--out", tmp_path / "npz")
    assert list((tmp_path / "npz").rglob("*.npz"))
    env = DistractedEnv(task_id, "dynamic", size=SIZE, renderer=default_renderer(task))
    observation, _ = env.reset(seed=0)
    observation, reward, *_ = env.step(np.zeros(task.action_size, np.float32))
    assert np.isfinite(reward) and np.isfinite(observation["state"]).all()
    env.close()
