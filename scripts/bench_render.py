"""Both renderers on the same frames: frames a second on one thread, and how far native's are from OpenGL's.

python scripts/bench_render.py
python scripts/bench_render.py --task cartpole-swingup quadruped-walk --settings none dynamic
"""

from __future__ import annotations

import argparse
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np  # noqa: E402

from dmcvb_gen.distractors import DistractorSetting, floor_alpha_for, load_backgrounds, sample_distractors  # noqa: E402
from dmcvb_gen.rendering import renderer_class  # noqa: E402
from dmcvb_gen.seeding import STREAMS, episode_stream  # noqa: E402
from dmcvb_gen.spec import is_maze  # noqa: E402
from dmcvb_gen.tasks import LOCOMOTION_TASKS, get_task  # noqa: E402


def frames_of(task_id: str, setting: DistractorSetting, episodes: int, steps: int):
    """Physics (frame, physics) and labels of short random episodes."""
    task = get_task(task_id)
    batch = task.batch(episodes)
    batch.reset([np.random.default_rng(i) for i in range(episodes)])
    rng, rows = np.random.default_rng(0), [batch.physics()]
    for _ in range(steps - 1):
        batch.step(task.from_unit(rng.uniform(-1, 1, (episodes, task.action_size))))
        rows.append(batch.physics())
    physics = np.stack(rows, axis=1)
    generators = {name: [episode_stream(0, ("bench",), i, name) for i in range(episodes)] for name in STREAMS}
    labels = sample_distractors(task, setting, physics, generators, load_backgrounds()).flat()
    return task, physics.reshape(-1, physics.shape[-1]), labels


def rate_of(renderer, task, physics, labels) -> float:
    """View-frames a second on this thread, the best of three; with and without the goal where there is one."""
    goals, best = ([False, True] if task.goal_geoms else [False]), 0.0
    for _ in range(3):
        started = time.perf_counter()
        for hide in goals:
            renderer.render(physics, labels, hide_goal=hide)
        best = max(best, len(goals) * len(task.views) * len(physics) / (time.perf_counter() - started))
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", default=[*LOCOMOTION_TASKS, "ant-maze-medium7x7a"])
    parser.add_argument("--settings", nargs="+", default=["none", "static", "dynamic"])
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--frames", type=int, default=512, help="OpenGL renders an eighth of them")
    options = parser.parse_args()
    print(f"{'task':20} {'setting':8} {'opengl/s':>9} {'native/s':>9} {'times':>6} {'diff':>6} {'PSNR':>6}")
    for task_id in options.task:
        for name in ["none"] if is_maze(task_id) else options.settings:
            setting = DistractorSetting.parse(name)
            task, physics, labels = frames_of(task_id, setting, 8, options.frames // 8)
            some = np.arange(0, len(physics), 8)
            common = dict(backgrounds=load_backgrounds(), floor_alpha=floor_alpha_for(task, setting))
            frames, rates = [], []
            for choice, timed in (("opengl", some[:8]), ("native", np.arange(len(physics)))):
                renderer = renderer_class(choice)(task, options.size, **common)
                frames.append(renderer.render(physics[some], labels[some]).astype(float))
                rates.append(rate_of(renderer, task, physics[timed], labels[timed]))
                renderer.close()
            difference = frames[1] - frames[0]
            print(
                f"{task_id:20} {name:8} {rates[0]:9.1f} {rates[1]:9.0f} {rates[1] / rates[0]:6.1f} "
                f"{np.abs(difference).mean():6.2f} {10 * np.log10(255**2 / np.mean(difference**2)):6.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
