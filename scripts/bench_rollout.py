"""Agent steps a second with pixels: the whole rollout against the plain dm_control pixel loop, in the same run.

    python scripts/bench_rollout.py --workers 2
    python scripts/bench_rollout.py --all --workers 2 --episodes 12 --peer-steps 40 --settings dynamic

An agent step is one frame here (two in dm_control's loop, whose pixels are painted at both repeats).

The peer is what a user would write: suite environment, pixels wrapper, 64 x 64, action repeat 2, software
EGL; it renders at both repeats, as that wrapper does, and saves nothing. Ours simulates, paints, compresses
and commits to disk, from process start to finished manifest, and then without the workers' start-up.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time

import numpy as np

os.environ.setdefault("MUJOCO_GL", "egl")
TASKS = ("walker-walk", "cheetah-run", "humanoid-walk")
SUITE = (
    "acrobot-swingup", "ball_in_cup-catch", "cartpole-balance", "cartpole-swingup", "cheetah-run", "dog-walk",
    "finger-spin", "finger-turn_hard", "fish-swim", "hopper-hop", "hopper-stand", "humanoid-stand", "humanoid-walk",
    "humanoid-run", "pendulum-swingup", "point_mass-easy", "quadruped-walk", "reacher-easy", "reacher-hard",
    "swimmer-swimmer6", "walker-stand", "walker-walk", "walker-run",
)  # fmt: skip
"""The tasks of --all: every domain of dm_control's benchmarking set, dog and quadruped."""
MAZE = "ant-maze-medium7x7a"


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


def maze_peer(task_id: str, steps: int, cameras: bool) -> float:
    """Agent steps a second of dm_control's composer loop: 4 cameras, with and without the goal, each control step."""
    import labmaze
    from dm_control import composer
    from dm_control.composer.observation import observable
    from dm_control.locomotion.arenas import labmaze_textures, mazes
    from dm_control.locomotion.props import target_sphere
    from dm_control.locomotion.tasks import random_goal_maze
    from dm_control.locomotion.walkers import ant

    from dmcvb_gen.tasks import get_task

    layout = get_task(task_id).layout
    arena = mazes.MazeWithTargets(
        maze=labmaze.FixedMazeWithRandomGoals(entity_layer=layout.entity_layer, num_spawns=1, num_objects=1),
        xy_scale=2.5,
        skybox_texture=labmaze_textures.SkyBox("sky_02"),
        wall_textures=labmaze_textures.WallTextures("style_02"),
        floor_textures=labmaze_textures.FloorTextures("style_02"),
    )
    walker = ant.Ant()
    walker.root_body.add("camera", name="follow", pos=[-1, 0, 2], xyaxes=[0, -1, 0, 2, 0, 1])
    walker.root_body.add("camera", name="overhead", pos=[0, 0, 3], xyaxes=[0, -1, 0, 1, 0, 0])
    task = random_goal_maze.RepeatSingleGoalMaze(
        walker, arena, target=target_sphere.TargetSphere(radius=0.5, height_above_ground=0.5), contact_termination=False
    )
    walker.observables.egocentric_camera.enabled = False
    if cameras:
        bodies = [
            arena.top_camera,
            *(walker.mjcf_model.find("camera", n) for n in ("egocentric", "follow", "overhead")),
        ]
        for number, camera in enumerate([*bodies, *bodies]):  # hiding the goal does not change what a picture costs
            seen = observable.MJCFCamera(camera, height=64, width=64)
            seen.enabled = True
            task.task_observables[f"camera_{number}"] = seen
    environment = composer.Environment(task, time_limit=60, random_state=0)
    environment.reset()
    rng = np.random.default_rng(0)
    started = time.perf_counter()
    for _ in range(steps):
        action = rng.uniform(-1, 1, 8)
        for _ in range(2):
            environment.step(action)
    return steps / (time.perf_counter() - started)


def maze_physics(task_id: str, workers: int) -> float:
    """Agent steps a second of simulated episodes without pictures."""
    from dmcvb_gen.policies.actor import random_policy
    from dmcvb_gen.policies.simulate import simulate
    from dmcvb_gen.tasks import get_task

    task = get_task(task_id)
    started = time.perf_counter()
    simulate(task, [random_policy(task)], range(32), 0, (task_id, "bench"), threads=workers, max_steps=100)
    return 3200 / (time.perf_counter() - started)


def ours(task_id: str, setting: str, episodes: int, workers: int) -> float:
    """Agent steps a second of the whole command."""
    import json

    folder = tempfile.mkdtemp()
    command = [sys.executable, "-m", "dmcvb_gen", "rollout", task_id, "--level", "random"]
    command += ["--goal" if task_id == MAZE else "--distractor", setting]
    command += ["--episodes", str(episodes), "--episodes-per-shard", str(-(-episodes // (2 * workers)))]
    command += ["--workers", str(workers), "--out", f"{folder}/release", "--json"]
    try:
        started = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        elapsed = time.perf_counter() - started
    finally:
        shutil.rmtree(folder)
    return json.loads(done.stdout)["steps"] / elapsed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", default=list(TASKS), help="suite tasks, or the maze")
    parser.add_argument("--all", action="store_true", help="every task of dm_control's suite that is tested")
    parser.add_argument("--settings", nargs="+", default=["none", "dynamic"])
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--peer-steps", type=int, default=150)
    options = parser.parse_args()
    print(f"{'task':20} {'setting':8} {'peer':>6} {'ours':>7} {'ratio':>6}")
    for task_id in SUITE if options.all else options.task:
        maze = task_id == MAZE
        if maze:
            alone, batched = maze_peer(task_id, 3 * options.peer_steps, False), maze_physics(task_id, options.workers)
            print(
                f"{task_id} state only: peer {alone:.1f}, ours {batched:.1f} agent steps/s, {batched / alone:.1f} times"
            )
        base = maze_peer(task_id, options.peer_steps // 5, True) if maze else peer(task_id, options.peer_steps)
        dog = task_id.startswith("dog")  # OpenGL paints it, so few episodes will do
        if not dog:
            ours(task_id, "visible" if maze else "none", 1 if maze else 2, 1)  # kernels are compiled once a machine
        for setting in ["visible"] if maze else options.settings:
            episodes = options.episodes // 3 if maze else 2 if dog else options.episodes
            whole = ours(task_id, setting, episodes, options.workers)
            print(f"{task_id:20} {setting:8} {base:6.1f} {whole:7.1f} {whole / base:6.1f}", flush=True)


if __name__ == "__main__":
    main()
