"""Codecs and chunks of the pictures: bytes a step, writing, reading whole episodes and random 3-frame stacks.

    python scripts/bench_store.py --episodes 6
    python scripts/bench_store.py --physics --task humanoid-walk --episodes 4    # codecs of the physics states instead

Rolls out a few walker episodes under each distractor setting (random actions), writes the same pictures in
every layout, and prints one row each. Ratios are against plain zstd in the same run.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import zarr

from dmcvb_gen.dataset.schema import create_arrays, picture_spec
from dmcvb_gen.generate.engine import shard_arrays, simulated_episodes
from dmcvb_gen.generate.plan import make_plan
from dmcvb_gen.generate.recipe import make_recipe

LAYOUTS = (
    "zstd",
    "zstd-9",
    "blosc-bitshuffle",
    "time-zstd",
    "time-delta-zstd",
    "width-delta-zstd",
    "width-delta-zstd-9",
    "width-delta-blosc",
    "channel-delta-zstd",
)
CHUNKS = (8, 32, 128, 501)


def pictures(task_id: str, setting: str, episodes: int) -> np.ndarray:
    """(episode, 501, 64, 64, 3) uint8."""
    recipe = make_recipe(
        {
            "name": "bench",
            "subsets": [{"tasks": task_id, "levels": "random", "settings": setting, "episodes": episodes}],
        }
    )
    job = make_plan(recipe, tempfile.mkdtemp()).jobs[0]
    return next(shard_arrays(job, job.subsets[0], simulated_episodes(job)))[1]


def measure(values: np.ndarray, layout: str, chunk: int) -> dict[str, float]:
    folder = Path(tempfile.mkdtemp())
    try:
        group = zarr.create_group(str(folder))
        spec = picture_spec("pixels", values.shape[2])
        create_arrays(group, (spec,), len(values), values.shape[1], len(values), layout, chunk)
        array = group["pixels"]
        started = time.perf_counter()
        array[:] = values
        write = values.nbytes / 1e6 / (time.perf_counter() - started)
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and path.name != "zarr.json")
        started = time.perf_counter()
        for episode in range(len(values)):
            assert np.array_equal(array[episode], values[episode])
        read = len(values) * values.shape[1] / (time.perf_counter() - started)
        rng = np.random.default_rng(0)
        started, count = time.perf_counter(), 150
        for _ in range(count):
            episode, step = rng.integers(len(values)), rng.integers(values.shape[1] - 3)
            array[episode, step : step + 3]
        stacks = count / (time.perf_counter() - started)
        return dict(bytes=size / (len(values) * (values.shape[1] - 1)), write=write, read=read, stacks=stacks)
    finally:
        shutil.rmtree(folder)


def physics_codecs() -> dict[str, tuple]:
    """Name -> lossless filters, applied to an episode's (row, number) float64; the first one is what is stored."""
    from numcodecs import Blosc, Delta, Zstd

    def blosc(level: int, shuffle: int) -> tuple:
        return (Blosc("zstd", level, shuffle),)

    steps = Delta("i8")  # differences of the bits of one step and the next, number by number
    return {
        "zstd 3": (Zstd(3),),
        "zstd 9": (Zstd(9),),
        "zstd 19": (Zstd(19),),
        "bytes shuffled, zstd 3": blosc(3, Blosc.SHUFFLE),
        "bytes shuffled, zstd 9": blosc(9, Blosc.SHUFFLE),
        "bits shuffled, zstd 3": blosc(3, Blosc.BITSHUFFLE),
        "delta, bytes shuffled, zstd 3": (steps, *blosc(3, Blosc.SHUFFLE)),
        "delta, bytes shuffled, zstd 9": (steps, *blosc(9, Blosc.SHUFFLE)),
    }


def measure_physics(task: str, episodes: int) -> None:
    """Print ratio and speed of each codec on the physics states of random episodes of a task, number after number."""
    subset = {"tasks": task, "levels": "random", "episodes": episodes}
    subset["settings"] = "visible" if task.startswith("ant-maze") else "none"
    job = make_plan(make_recipe({"name": "bench", "subsets": [subset]}), tempfile.mkdtemp()).jobs[0]
    made = simulated_episodes(job)
    raw = [made.physics[i, : length + 1] for i, length in enumerate(made.length)]
    total, base = sum(rows.nbytes for rows in raw), None
    print(f"{task}: {total / sum(len(rows) for rows in raw):.0f} B a row before compression")
    for name, codecs in physics_codecs().items():
        size, packing, unpacking = 0, 0.0, 0.0
        for rows in raw:
            ordered = rows if len(codecs) == 1 else np.ascontiguousarray(rows.T)
            started = time.process_time()
            packed = ordered.reshape(-1).view("i8")
            for codec in codecs:
                packed = codec.encode(packed)
            packing += time.process_time() - started
            size += len(packed)
            started = time.process_time()
            values = packed
            for codec in reversed(codecs):
                values = codec.decode(values)
            unpacking += time.process_time() - started
            assert np.array_equal(np.frombuffer(values, "i8"), ordered.reshape(-1).view("i8"))
        base = base or size
        print(
            f"  {name:30} {size / total:5.3f} of the bytes, {size / base:5.3f} of today's, "
            f"packs {total / 1e6 / packing:5.0f} MB/s, unpacks {total / 1e6 / unpacking:5.0f} MB/s"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="walker-walk")
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--settings", nargs="+", default=["none", "static", "dynamic"])
    parser.add_argument("--chunks", nargs="+", type=int, default=list(CHUNKS))
    parser.add_argument("--physics", action="store_true", help="compare codecs of the physics states instead")
    options = parser.parse_args()
    if options.physics:
        return measure_physics(options.task, options.episodes)
    measure(pictures(options.task, "none", 1)[:, :64], "zstd", 32)  # the first call of everything is slow
    print(
        f"{'setting':8} {'layout':22} {'chunk':>5} {'B/step':>7} {'ratio':>6} {'write MB/s':>10} "
        f"{'episode frames/s':>16} {'3-stacks/s':>10}"
    )
    for setting in options.settings:
        values = pictures(options.task, setting, options.episodes)
        base = None
        for layout in LAYOUTS:
            for chunk in options.chunks if layout == LAYOUTS[0] or len(options.chunks) < 3 else options.chunks[1:3]:
                row = measure(values, layout, chunk)
                base = base or row["bytes"]
                print(
                    f"{setting:8} {layout:22} {chunk:5} {row['bytes']:7.0f} {row['bytes'] / base:6.2f} "
                    f"{row['write']:10.0f} {row['read']:16.0f} {row['stacks']:10.0f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
