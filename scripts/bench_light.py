"""What a release weighs without its pictures, and what painting them costs where it arrives.

    python scripts/bench_light.py --bytes                  # bytes a step with pictures and without, of all tasks
    python scripts/bench_light.py --travel --mbits 10 100 1000
    python scripts/bench_light.py --batches                # training batches/s, stored and painted on reading

`--travel` fetches the same episodes painted, and without pictures and painted as they come, from a server on loopback
that sends no faster than asked for. Releases are made in a temporary folder by bundled expert policies.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import os
import shutil
import tempfile
import threading
import time
from pathlib import Path

from dmcvb_gen.dataset import Subset, open_release
from dmcvb_gen.dataset.pictures import picture_of
from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.paint import RenderConfig, without_pictures
from dmcvb_gen.generate.plan import finish, make_plan, prepare
from dmcvb_gen.generate.recipe import make_recipe
from dmcvb_gen.loaders.painted import open_painted
from dmcvb_gen.loaders.release import ReleaseReader, SubsetReader, open_for_reading
from dmcvb_gen.release.fetch import fetch, fetch_and_paint
from dmcvb_gen.spec import is_maze

PIECE = 64 * 1024
"""Bytes that the slow server sends between two looks at the clock."""
MAZE_SETTINGS, SETTINGS = ["visible"], ["none", "static", "dynamic"]


def make(folder: Path, tasks: list[str], settings: list[str], episodes: int, per_shard: int) -> Path:
    """A release of expert episodes."""
    pattern = {"tasks": tasks, "levels": "expert", "settings": settings, "episodes": episodes}
    recipe = make_recipe({"name": "bench", "subsets": [pattern | {"episodes_per_shard": per_shard}]})
    plan = prepare(make_plan(recipe, folder))
    for _ in run_jobs(plan.jobs):
        pass
    finish(plan)
    return folder


# -- bytes ----------------------------------------------------------------------------------------


def bytes_of(subset: Subset) -> tuple[float, float]:
    """(bytes a step of pictures, of everything else)."""
    folders = {subset.paths[name] for name in subset.arrays if picture_of(name)}
    start, pictures, others = f"{subset.name}.zarr/", 0, 0
    for commit in subset.commits.values():
        for file in commit.files:
            shown = file.path.removeprefix(start).split("/c/")[0] in folders
            pictures, others = pictures + file.bytes * shown, others + file.bytes * (not shown)
    return pictures / subset.steps, others / subset.steps


def bytes_table(options) -> None:
    print(f"{'subset':44} {'with':>8} {'without':>8} {'share':>6}   bytes a step")
    for task in options.tasks:
        settings = MAZE_SETTINGS if is_maze(task) else SETTINGS
        with tempfile.TemporaryDirectory() as folder:
            release = open_release(make(Path(folder), [task], settings, options.episodes, options.episodes))
            for name, subset in release.subsets.items():
                pictures, others = bytes_of(subset)
                share = others / (pictures + others)
                print(f"{name:44} {pictures + others:8.0f} {others:8.0f} {share:6.1%}", flush=True)


# -- travelling -----------------------------------------------------------------------------------


class Line:
    """A line of so many bits a second that all connections share."""

    def __init__(self, mbits: float):
        self._rate, self._free, self._lock = mbits * 1e6 / 8, 0.0, threading.Lock()

    def wait(self, size: int) -> None:
        """Return when `size` bytes more have gone through."""
        with self._lock:
            self._free = max(self._free, time.perf_counter()) + size / self._rate
            until = self._free
        time.sleep(max(0.0, until - time.perf_counter()))


class SlowFiles(http.server.BaseHTTPRequestHandler):
    """Files of a folder, or ranges of them, over a `Line`."""

    protocol_version = "HTTP/1.1"

    def __init__(self, folder: Path, line: Line, *arguments):
        self.folder, self.line = folder, line
        super().__init__(*arguments)

    def log_message(self, *arguments):
        pass

    def do_GET(self):
        path = self.folder / self.path.lstrip("/")
        if not path.is_file():
            self.send_response(404)
            self.send_header("Content-Length", "0")
            return self.end_headers()
        data, asked = path.read_bytes(), self.headers.get("Range")
        if asked:
            first, _, last = asked.removeprefix("bytes=").partition("-")
            whole, data = len(data), data[int(first) : int(last) + 1 if last else None]
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {first}-{int(first) + len(data) - 1}/{whole}")
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        for start in range(0, len(data) if self.command == "GET" else 0, PIECE):
            piece = data[start : start + PIECE]
            self.line.wait(len(piece))
            self.wfile.write(piece)

    do_HEAD = do_GET


def travel_table(options) -> None:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        make(root / "painted", [options.task], [options.setting], options.episodes, options.per_shard)
        without_pictures(root / "painted", root / "light")
        steps = next(iter(open_release(root / "painted").subsets.values())).steps
        print(
            f"{options.episodes} episodes of {options.task} {options.setting}, {steps:,} steps; {os.cpu_count()} cores"
        )
        print(f"{'Mbit/s':>7} {'painted MB':>10} {'seconds':>8} {'light MB':>9} {'fetched and painted s':>21}")
        for mbits in options.mbits:
            handler = functools.partial(SlowFiles, root, Line(mbits))
            server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
            threading.Thread(target=server.serve_forever, daemon=True).start()
            url, spent = f"http://127.0.0.1:{server.server_address[1]}", {}
            for kind in ("painted", "light"):
                started = time.perf_counter()
                if kind == "painted":
                    moved = fetch(f"{url}/{kind}", root / "here")
                else:
                    painter = RenderConfig(workers=options.workers)
                    moved, done = fetch_and_paint(f"{url}/{kind}", root / "here", painter=painter)
                    assert done.known == done.shards and not done.differing
                spent[kind] = time.perf_counter() - started, moved.bytes / 1e6
                shutil.rmtree(root / "here")
            server.shutdown()
            (long, much), (short, little) = spent["painted"], spent["light"]
            print(f"{mbits:7.0f} {much:10.1f} {long:8.1f} {little:9.1f} {short:21.1f}", flush=True)


# -- training -------------------------------------------------------------------------------------


def batches_table(options) -> None:
    with tempfile.TemporaryDirectory() as folder:
        root = str(make(Path(folder), [options.task], [options.setting], options.episodes, options.per_shard))
        print(f"{options.episodes} episodes of {options.task} {options.setting}, batches of {options.batch}")
        painted = next(iter(open_painted(root).subsets.values()))
        fresh = next(iter(open_painted(root, distractors="resample").subsets.values()))
        stored = next(iter(open_for_reading(root).subsets.values()))
        for name, subset in {
            "stored": stored,
            "painted, first epoch": painted,
            "painted, kept": painted,
            "fresh distractors": fresh,
        }.items():
            started = time.perf_counter()
            count = sum(1 for _ in subset.batches(options.batch, seed=0))
            print(f"{name:22} {count / (time.perf_counter() - started):8.1f} batches/s", flush=True)
        rate = painter_rate(open_painted(root))
        print(f"{'painter alone':22} {rate / options.batch:8.1f} batches/s of new images, one process")
        for name, subset in {"stored": stored, "fresh distractors": fresh}.items():
            found = loader_rate(subset, options)
            share = f", {found / (rate * options.workers):.0%} of the painter times the workers" * (subset is fresh)
            print(f"{name}, {options.workers} workers {found / options.batch:8.1f} batches/s{share}", flush=True)


def painter_rate(release: ReleaseReader) -> float:
    """Images a second that one process renders, and nothing else."""
    subset = next(iter(release.subsets.values()))
    subset.painted(int(subset.episodes[0]))  # backgrounds are decoded
    started = time.perf_counter()
    count = sum(len(subset.painted(int(episode))["pixels"]) for episode in subset.episodes[1:])
    return count / (time.perf_counter() - started)


def loader_rate(subset: SubsetReader, options) -> float:
    """Steps a second out of a `DataLoader`, in the second epoch, when its workers have started."""
    from torch.utils.data import DataLoader

    data = subset.torch("stream", batch_size=options.batch)
    loader = DataLoader(data, batch_size=None, num_workers=options.workers, persistent_workers=True)
    for epoch in range(1, 3):  # nothing of them is kept from elsewhere
        data.set_epoch(epoch)
        started = time.perf_counter()
        count = sum(len(batch["action"]) for batch in loader)
    return count / (time.perf_counter() - started)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bytes", action="store_true")
    parser.add_argument("--travel", action="store_true")
    parser.add_argument("--batches", action="store_true")
    tasks = ["walker-walk", "cheetah-run", "humanoid-walk", "ant-maze-empty7x7", "ant-maze-medium7x7a"]
    parser.add_argument("--tasks", nargs="+", default=tasks, help="of --bytes")
    parser.add_argument("--task", default="walker-walk", help="of --travel and --batches")
    parser.add_argument("--setting", default="dynamic")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--per-shard", type=int, default=5, help="episodes")
    parser.add_argument("--mbits", type=float, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="that paint, or feed training")
    parser.add_argument("--batch", type=int, default=256)
    options = parser.parse_args()
    for asked, table in (
        (options.bytes, bytes_table),
        (options.travel, travel_table),
        (options.batches, batches_table),
    ):
        if asked:
            table(options)


if __name__ == "__main__":
    main()
