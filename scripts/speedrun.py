"""Frames and core-minutes until a policy reaches 95 % of the paper's expert: a row of docs/results.md.

    python scripts/speedrun.py walker-walk --seed 0

An evaluation along the way that reaches the goal is confirmed on 100 fresh episodes. Frames count the action repeat
of 2. Core-minutes are processor time of one thread, evaluations and compilation included; other programs do not count.
"""

from __future__ import annotations

import argparse
import datetime
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from dmcvb_gen.dataset.environment import environment
from dmcvb_gen.policies.evaluation import FRESH, evaluate
from dmcvb_gen.policies.paper import paper_returns
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.precision import choose_precision
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.base import ACTION_REPEAT
from dmcvb_gen.training.behaviour import run_config
from dmcvb_gen.training.run import open_run
from dmcvb_gen.training.settings import parse_settings

SHARE, EPISODES, SEED = 0.95, 100, 20_000


class Reached(Exception):
    """The goal was reached and confirmed; its argument is the mean return of fresh episodes."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, help="agent steps at most; the task's budget by default")
    parser.add_argument("--set", dest="pairs", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", help="folder of the run; a temporary one by default")
    given = parser.parse_args()
    torch.set_num_threads(1)
    settings = {"bfloat16": choose_precision("auto") == "bfloat16"} | parse_settings(given.pairs, "sac")
    expert = paper_returns(given.task, "expert")
    if not expert:
        sys.exit(f"{given.task} has no expert in the paper's tables; give walker-walk, cheetah-run or humanoid-walk")
    goal, task = SHARE * expert["mean"], get_task(given.task)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(given.out or scratch) / "run"
        config = run_config(given.task, "sac", settings, steps=given.steps, seed=given.seed)
        run = open_run(folder, config, False)
        began = time.process_time()

        def report(evaluation) -> None:
            minutes, mean = (time.process_time() - began) / 60, evaluation.mean
            print(f"{ACTION_REPEAT * run.step:,} frames, {minutes:.1f} core-minutes: return {mean:.0f}", flush=True)
            if mean < goal:
                return
            newest = max((folder / "checkpoints").glob("[0-9]*.safetensors"))
            fresh = evaluate(load_policy(newest, task), task, EPISODES, SEED, streams=FRESH).mean
            print(f"  {fresh:.0f} on {EPISODES} fresh episodes, {goal:.0f} is wanted", flush=True)
            if fresh >= goal:
                raise Reached(fresh)

        reached = ""
        try:
            run.train(report)
        except Reached as found:
            reached = f"{float(found.args[0]):.0f}"
    minutes, frames = (time.process_time() - began) / 60, ACTION_REPEAT * run.step
    precision = "bfloat16" if settings["bfloat16"] else "float32"
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    command = f"`speedrun.sh {shlex.join(sys.argv[1:])}`"
    amount = (f"{frames:,}", f"{minutes:.1f}") if reached else (f"not in {frames:,}", f"{minutes:.1f}")
    facts = (command, *amount, reached, f"{environment()['cpu']}, {precision}", commit, datetime.date.today())
    print("| " + " | ".join(map(str, facts)) + " |")


if __name__ == "__main__":
    main()
