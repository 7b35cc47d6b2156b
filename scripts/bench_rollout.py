"""Agent steps a second with pixels: the whole rollout against the plain dm_control pixel loop, in the same run.

    python scripts/bench_rollout.py --workers 2
    python scripts/bench_rollout.py --task finger-spin --workers 2 --episodes 12 --peer-steps 40 --settings dynamic

The peer is what a user would write: suite environment, pixels wrapper, 64 x 64, action repeat 2, software EGL; it
renders at both repeats, as that wrapper does, and saves nothing. Ours simulates, paints, compresses and commits to
disk, from process start to finished manifest.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time

import numpy as np

os.environ.setdefault("MUJOCO_GL", "egl")
TASKS = ("walker-walk", "cheetah-run", "humanoid-walk")


def peer(task_id: str, steps: int) -> float:
    """Agent steps a second of dm_control's own loop."""
    from dm_control import suite
    from dm_control.suite.wrappers import pixels

    environment = suite.load(*task_id.split("-", 1))
    environment = pixels.Wrapper(environment, pixels_only=False, render_kwargs=dict(height=64, width=64, camera_id=0))
    rng, size = np.random.default_rng(0), environment.action_spec().shape
    environment.reset()
    started = time.perf_counter()
    for _ in range(steps):
        action = rng.uniform(-1, 1, size)
        for _ in range(2):
            environment.step(action)
    return steps / (time.perf_counter() - started)


def ours(task_id: str, setting: str, episodes: int, workers: int) -> float:
    """Agent steps a second of the whole command."""
    command = [sys.executable, "-m", "dmcvb_gen", "rollout", task_id, "--level", "random", "--distractor", setting]
    command += ["--episodes", str(episodes), "--episodes-per-shard", str(-(-episodes // (2 * workers)))]
    with tempfile.TemporaryDirectory() as folder:
        command += ["--workers", str(workers), "--out", f"{folder}/release", "--json"]
        started = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        elapsed = time.perf_counter() - started
    return json.loads(done.stdout)["steps"] / elapsed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", default=list(TASKS), help="tasks of dm_control's suite")
    parser.add_argument("--settings", nargs="+", default=["none", "dynamic"])
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--peer-steps", type=int, default=150)
    options = parser.parse_args()
    print(f"{'task':20} {'setting':8} {'peer':>6} {'ours':>7} {'ratio':>6}")
    for task_id in options.task:
        base = peer(task_id, options.peer_steps)
        ours(task_id, "none", 2, 1)  # kernels are compiled once a machine
        for setting in options.settings:
            whole = ours(task_id, setting, options.episodes, options.workers)
            print(f"{task_id:20} {setting:8} {base:6.1f} {whole:7.1f} {whole / base:6.1f}", flush=True)


if __name__ == "__main__":
    main()
