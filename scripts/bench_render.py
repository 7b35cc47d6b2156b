"""All renderers on the same frames: frames a second on one thread, how far from OpenGL, and a picture of each.

python scripts/bench_render.py --out render.png
python scripts/bench_render.py --task cartpole-swingup quadruped-walk --settings none dynamic --renderers native
"""

from __future__ import annotations

import argparse
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np  # noqa: E402
from PIL import Image  # noqa: E402

from dmcvb_gen.distractors import DistractorSetting, floor_alpha_for, load_backgrounds, sample_distractors  # noqa: E402
from dmcvb_gen.errors import RenderingError  # noqa: E402
from dmcvb_gen.rendering import make_renderer  # noqa: E402
from dmcvb_gen.seeding import episode_stream  # noqa: E402
from dmcvb_gen.tasks import LOCOMOTION_TASKS, get_task  # noqa: E402


def frames_of(task_id: str, setting: DistractorSetting, episodes: int, steps: int):
    """Physics (frame, physics) and labels of short random episodes."""
    task = get_task(task_id)
    batch = task.batch(episodes)
    batch.reset([np.random.default_rng(i) for i in range(episodes)])
    rng, rows = np.random.default_rng(0), [batch.physics()]
    for _ in range(steps - 1):
        batch.step(rng.uniform(-1, 1, (episodes, task.action_size)))
        rows.append(batch.physics())
    physics = np.stack(rows, axis=1)
    names = ("camera", "color", "background", "style")
    generators = {name: [episode_stream(0, ("bench",), i, name) for i in range(episodes)] for name in names}
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
    parser.add_argument("--renderers", nargs="+", default=["native"])
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--frames", type=int, default=512, help="OpenGL paints an eighth of them")
    parser.add_argument("--out", help="side-by-side PNG: OpenGL, then the others")
    options = parser.parse_args()
    print(f"{'task':20} {'setting':8} {'renderer':8} {'frames/s':>9} {'x opengl':>8} {'diff':>6} {'PSNR':>6}")
    sheet = []
    for task_id in options.task:
        for name in ["none"] if task_id.startswith("ant-maze") else options.settings:
            setting = DistractorSetting.parse(name)
            task, physics, labels = frames_of(task_id, setting, 8, options.frames // 8)
            some = np.arange(0, len(physics), 8)
            common = dict(backgrounds=load_backgrounds(), floor_alpha=floor_alpha_for(task, setting))
            reference = make_renderer("opengl", task, options.size, **common)
            reference.render(physics[:1], labels[:1])
            expected = reference.render(physics[some], labels[some]).astype(float)
            opengl = rate_of(reference, task, physics[some[:8]], labels[some[:8]])
            reference.close()
            print(f"{task_id:20} {name:8} {'opengl':8} {opengl:9.1f}", flush=True)
            row = [expected[len(some) // 2, 0]]
            for choice in options.renderers:
                try:
                    renderer = make_renderer(choice, task, options.size, **common)
                except RenderingError as error:
                    print(f"{task_id:20} {name:8} {choice:8} {error}", flush=True)
                    continue
                difference = renderer.render(physics[some], labels[some]).astype(float) - expected
                rate = rate_of(renderer, task, physics, labels)
                row.append(expected[len(some) // 2, 0] + difference[len(some) // 2, 0])
                renderer.close()
                print(
                    f"{task_id:20} {name:8} {choice:8} {rate:9.0f} {rate / opengl:8.1f} "
                    f"{np.abs(difference).mean():6.2f} {10 * np.log10(255**2 / np.mean(difference**2)):6.1f}",
                    flush=True,
                )
            sheet.append(np.concatenate(row, axis=1))
    if options.out:
        picture = np.concatenate(sheet).astype(np.uint8).repeat(3, axis=0).repeat(3, axis=1)
        Image.fromarray(picture).save(options.out)


if __name__ == "__main__":
    main()
