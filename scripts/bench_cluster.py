"""What many workers cost: steps/s of processes, Ray and parts; requests and bytes a shard; a schedule with failures.

    python scripts/bench_cluster.py --workers 1 2 --jobs 8
    python scripts/bench_cluster.py --schedule            # no measurement: the release's plan for many cores

Steps/s come with the fixed cost: seconds before the first commit beyond a job's own. Requests are counted at a real
S3-protocol server on loopback. The schedule hands jobs to workers as they come free, in the order of the plan, takes
workers away at random and starts them again; job times are drawn around measured ones.
"""

from __future__ import annotations

import argparse
import heapq
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.plan import finish, make_plan, prepare
from dmcvb_gen.generate.recipe import expand, load_recipe, make_recipe
from dmcvb_gen.generate.target import Target
from dmcvb_gen.parallel import Ray
from dmcvb_gen.spec import is_maze
from dmcvb_gen.storage.remote import file_system

TASKS = {"walker": ("walker-walk", "dynamic"), "maze": ("ant-maze-empty7x7", "hidden")}


def bench_recipe(jobs: int, episodes: int, task: str):
    """`jobs` shards of one setting."""
    name, setting = TASKS[task]
    pattern = {"tasks": name, "levels": "expert", "settings": setting}
    counts = {"episodes": jobs * episodes, "episodes_per_shard": episodes}
    return make_recipe({"name": "bench", "subsets": [pattern | counts]})


# -- workers --------------------------------------------------------------------------------------


def run_here(recipe, folder: Path, workers) -> tuple[float, float, int]:
    """(seconds, seconds to the first commit, steps) of making a release in a folder."""
    plan = prepare(make_plan(recipe, folder))
    started, first, steps = time.perf_counter(), None, 0
    for result in run_jobs(plan.jobs, workers):
        first = first or time.perf_counter() - started
        steps += result.steps
    finish(plan)
    return time.perf_counter() - started, first, steps


def run_parts(recipe, folder: Path, workers: int) -> tuple[float, float, int]:
    """The same by `workers` processes that share nothing but a bucket."""
    place = f"file://{folder}"
    plan = prepare(make_plan(recipe, Target.at(place)))
    started, first = time.perf_counter(), None
    command = [sys.executable, "-m", "dmcvb_gen", "rollout", "--out", place]
    quiet = dict(stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    running = [subprocess.Popen([*command, "--part", f"{k + 1}/{workers}"], **quiet) for k in range(workers)]
    while any(process.poll() is None for process in running):
        if first is None and any(folder.glob("commits/**/*.json")):
            first = time.perf_counter() - started
        time.sleep(0.02)
    finish(plan)
    return time.perf_counter() - started, first, plan.steps


def workers_table(options) -> None:
    print(f"{'executor':10} {'workers':>7} {'steps/s':>8} {'first commit s':>14} {'whole s':>8}")
    recipe = bench_recipe(options.jobs, options.episodes, options.task)
    for executor in options.executors:
        for workers in options.workers:
            with tempfile.TemporaryDirectory() as folder:
                out = Path(folder) / "release"
                if executor == "parts":
                    seconds, first, steps = run_parts(recipe, out, workers)
                elif executor == "ray":
                    import ray

                    ray.init(num_cpus=workers, include_dashboard=False, logging_level="ERROR", log_to_driver=False)
                    seconds, first, steps = run_here(recipe, out, Ray())
                    ray.shutdown()
                else:
                    seconds, first, steps = run_here(recipe, out, workers)
            rate = steps / seconds
            print(f"{executor:10} {workers:7} {rate:8.0f} {first:14.1f} {seconds:8.1f}", flush=True)


# -- requests -------------------------------------------------------------------------------------


def requests_table(options) -> None:
    """Requests by kind for beginning, for each shard and for finishing, at moto's server."""
    from moto.server import ThreadedMotoServer

    os.environ |= {"AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_DEFAULT_REGION": "us-east-1"}
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    endpoint = {"endpoint_url": "http://{}:{}".format(*server.get_host_and_port())}
    filesystem, _ = file_system("s3://bucket", endpoint)
    filesystem.mkdir("bucket")
    sent: Counter[str] = Counter()
    filesystem.s3.meta.events.register("before-send.s3", lambda request, **_: sent.update([request.method]))

    def row(task: str, what: str, size: float = 0.0) -> None:
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(sent.items()))
        print(f"{task:8} {what:10} {sent.total():6} {kinds:40} {size / 1e6:8.2f}", flush=True)
        sent.clear()

    print(f"{'task':8} {'what':10} {'all':>6} {'requests':40} {'MB':>8}")
    sent.clear()
    for task in TASKS:
        target = Target.at(f"s3://bucket/{task}", endpoint)
        plan = prepare(make_plan(bench_recipe(4, 1, task), target))
        row(task, "begin")
        made = [commit for result in run_jobs(plan.jobs) for commit in result.commits]
        row(task, "4 shards", sum(file.bytes for commit in made for file in commit.files))
        finish(plan)
        row(task, "finish")
    server.stop()


# -- schedule -------------------------------------------------------------------------------------


def simulate_schedule(
    seconds: np.ndarray, workers: int, lost_per_hour: float, restart: float, rng: np.random.Generator
) -> tuple[float, float]:
    """(hours until all is committed, share of work that was lost) of handing jobs to workers as they come free.

    Args:
      seconds: (job,) of one core, in the order in which they are handed out.
      lost_per_hour: chance of a worker to be taken away in an hour; it is back after `restart` seconds, and its job
        is done again.
    """
    free = [(0.0, worker) for worker in range(workers)]
    heapq.heapify(free)
    end = lost = 0.0
    waiting = list(seconds[::-1])
    while waiting:
        at, worker = heapq.heappop(free)
        job = waiting.pop()
        alive = rng.exponential(3600 / lost_per_hour) if lost_per_hour else np.inf
        if alive < job:
            waiting.append(job)
            lost += alive
            heapq.heappush(free, (at + alive + restart, worker))
            continue
        end = max(end, at + job)
        heapq.heappush(free, (at + job, worker))
    return end / 3600, lost / seconds.sum()


def planned_jobs(maze_steps: float) -> dict[str, list[float]]:
    """Steps of each job of the whole release, all settings that share its episodes together.

    Args:
      maze_steps: mean length of a maze's episode.
    """
    recipe, steps = load_recipe("dmcvb-v1"), {"locomotion": [], "mazes": []}
    shared: dict[tuple, int] = {}
    for request in expand(recipe):
        maze = is_maze(request.task)
        key = (request.task, request.level, request.setting if maze else "", request.episodes)
        shared[key] = shared.get(key, 0) + 1
        if shared[key] > 1:
            continue
        length = maze_steps if maze else request.max_steps
        settings = 1 if maze else sum(r.task == request.task and r.level == request.level for r in expand(recipe))
        for first in range(0, request.episodes, request.episodes_per_shard):
            episodes = min(request.episodes_per_shard, request.episodes - first)
            steps["mazes" if maze else "locomotion"].append(episodes * length * settings)
    return steps


def schedule_table(options) -> None:
    """The whole release on 2, 64 and 1,000 cores, at measured rates."""
    rng = np.random.default_rng(0)
    jobs, plan = [], planned_jobs(options.maze_steps)
    for task, rate in (("locomotion", options.locomotion_rate), ("mazes", options.maze_rate)):
        steps = np.array(plan[task])
        jobs.append(rng.normal(1, 0.15, len(steps)).clip(0.5) * steps / rate)
        print(f"{task}: {len(steps):,} jobs of {jobs[-1].mean():.0f} s, {jobs[-1].sum() / 3600:.0f} core-hours")
    seconds = np.concatenate(jobs)
    print(f"{'cores':>6} {'lost/h':>6} {'hours':>8} {'ideal':>8} {'work lost':>9}")
    for cores in (2, 64, 1000):
        for lost_per_hour in (0.0, 0.1, 1.0):
            hours, lost = simulate_schedule(seconds, cores, lost_per_hour, options.restart, rng)
            ideal = seconds.sum() / cores / 3600
            print(f"{cores:6} {lost_per_hour:6.1f} {hours:8.2f} {ideal:8.2f} {lost:9.2%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--executors", nargs="+", default=["processes", "ray", "parts"])
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--jobs", type=int, default=8)
    parser.add_argument("--episodes", type=int, default=4, help="a job")
    parser.add_argument("--task", choices=list(TASKS), default="walker")
    parser.add_argument("--requests", action="store_true", help="count requests only")
    parser.add_argument("--schedule", action="store_true", help="simulate the schedule only")
    parser.add_argument("--locomotion-rate", type=float, default=330.0, help="steps/s of a core and setting")
    parser.add_argument("--maze-rate", type=float, default=52.0)
    parser.add_argument("--maze-steps", type=float, default=250.0, help="mean length of a maze's episode")
    parser.add_argument("--restart", type=float, default=120.0, help="seconds until a lost worker is back")
    options = parser.parse_args()
    if options.schedule:
        schedule_table(options)
    elif options.requests:
        requests_table(options)
    else:
        workers_table(options)


if __name__ == "__main__":
    main()
