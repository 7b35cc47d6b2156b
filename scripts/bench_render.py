"""Both renderers on the same frames: frames a second on one thread, how far apart, and a picture of both.

python scripts/bench_render.py --out render.png
"""

from __future__ import annotations

import argparse
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np  # noqa: E402
from PIL import Image  # noqa: E402

from dmcvb_gen.distractors import DistractorSetting, floor_alpha_for, load_backgrounds, make_exogenous  # noqa: E402
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
    labels = make_exogenous(task, setting, physics, generators, load_backgrounds()).flat()
    return task, physics.reshape(-1, physics.shape[-1]), labels


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", default=list(LOCOMOTION_TASKS))
    parser.add_argument("--settings", nargs="+", default=["none", "static", "dynamic"])
    parser.add_argument("--samples", nargs="+", type=int, default=[1, 2, 4])
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--frames", type=int, default=512, help="of warp; OpenGL paints an eighth of them")
    parser.add_argument("--out", help="side-by-side PNG: OpenGL, then warp at each number of samples")
    options = parser.parse_args()
    print(
        f"{'task':14} {'setting':8} {'opengl/s':>9} {'samples':>7} {'warp/s':>8} {'ratio':>6} {'diff':>6} {'PSNR':>6}"
    )
    sheet = []
    for task_id in options.task:
        for name in options.settings:
            setting = DistractorSetting.parse(name)
            task, physics, labels = frames_of(task_id, setting, 8, options.frames // 8)
            some = np.arange(0, len(physics), 8)
            common = dict(backgrounds=load_backgrounds(), floor_alpha=floor_alpha_for(task, setting))
            reference = make_renderer("opengl", task, options.size, **common)
            reference.render(physics[:1], labels[:1])
            started = time.perf_counter()
            expected = reference.render(physics[some], labels[some])[:, 0].astype(float)
            opengl = len(some) / (time.perf_counter() - started)
            reference.close()
            row = [expected[len(some) // 2]]
            for samples in options.samples:
                renderer = make_renderer("warp", task, options.size, samples=samples, **common)
                renderer.render(physics, labels)
                started = time.perf_counter()
                pictures = renderer.render(physics, labels)[:, 0]
                warp = len(physics) / (time.perf_counter() - started)
                renderer.close()
                difference = pictures[some].astype(float) - expected
                psnr = 10 * np.log10(255**2 / np.mean(difference**2))
                print(
                    f"{task_id:14} {name:8} {opengl:9.1f} {samples:7} {warp:8.0f} {warp / opengl:6.1f} "
                    f"{np.abs(difference).mean():6.2f} {psnr:6.1f}",
                    flush=True,
                )
                row.append(pictures[some[len(some) // 2]])
            sheet.append(np.concatenate(row, axis=1))
    if options.out:
        picture = np.concatenate(sheet).astype(np.uint8).repeat(3, axis=0).repeat(3, axis=1)
        Image.fromarray(picture).save(options.out)


if __name__ == "__main__":
    main()
