"""A batch script that makes a release on many machines of a Slurm cluster."""

from __future__ import annotations

import shlex

import click

from dmcvb_gen.cli.common import WORDS

SLURM = """#!/bin/bash
# An array of {count} tasks: sbatch this file. A preempted task is requeued and resumes.
#SBATCH --job-name={name}
#SBATCH --array=1-{count}
#SBATCH --cpus-per-task={workers}
#SBATCH --mem-per-cpu=4G
#SBATCH --requeue
#SBATCH --open-mode=append
set -euo pipefail

if [ "${{SLURM_ARRAY_TASK_ID:?submit this with sbatch}}" = 1 ]; then
  {init}
  finish="{name}-finish-$SLURM_ARRAY_JOB_ID"
  if [ -z "$(squeue --noheader --name="$finish")" ]; then # not there from before a requeue
    sbatch --dependency="afterok:$SLURM_ARRAY_JOB_ID" --job-name="$finish" --requeue --wrap={finish}
  fi
fi
exec {work} --part "$SLURM_ARRAY_TASK_ID/{count}"
"""


def script_for_slurm(count: int, workers: int) -> str:
    """A script for sbatch that makes a release in `count` tasks; each task does its part of the jobs."""
    base = ["dmcvb-gen", "rollout", *_words_without("--slurm-script")]
    return SLURM.format(
        count=count,
        workers=workers if isinstance(workers, int) else 1,
        name="dmcvb-gen",
        init=shlex.join([*base, "--init"]),
        work=shlex.join(base),
        finish=shlex.quote(shlex.join([*base, "--finish"])),
    )


def _words_without(flag: str) -> list[str]:
    """The words of the command line but for a flag and its value."""
    words = list(click.get_current_context().meta[WORDS])
    place = next(index for index, word in enumerate(words) if word == flag or word.startswith(f"{flag}="))
    return words[:place] + words[place + (2 if words[place] == flag else 1) :]
