"""What `rollout` needs on many machines: parts, bounds of scratch room, a batch script; and the command `status`."""

from __future__ import annotations

import re
import shlex

import click
from click.core import ParameterSource

from dmcvb_gen.cli.common import format_duration, json_option, print_json, print_table, remote_option
from dmcvb_gen.parallel import Ray, Workers

executor_option = click.option(
    "--executor",
    type=click.Choice(["processes", "ray"]),
    default="processes",
    show_default=True,
    help="Executor that runs the jobs: local processes or Ray.",
)
ray_option = click.option(
    "--ray-address", metavar="ADDRESS", help="Address of the Ray cluster.  [default: RAY_ADDRESS, or a local one]"
)


def make_executor(workers: int, executor: str, address: str | None) -> Workers:
    """The executor that the options ask for.

    Raises:
      click.UsageError: an option has no effect with this executor.
    """
    if executor == "ray":
        context = click.get_current_context(silent=True)
        if context and context.get_parameter_source("workers") == ParameterSource.COMMANDLINE:
            raise click.UsageError(
                "--workers has no effect with --executor ray, which uses every core of the cluster: remove it."
            )
        return Ray(address)
    if address:
        raise click.UsageError("--ray-address has no effect without --executor ray: remove it.")
    return workers


UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}


def parse_part(context, parameter, text):
    """ "2/8" -> (2, 8); a click callback."""
    if text is None:
        return None
    number, slash, count = text.partition("/")
    if not (slash and number.isdigit() and count.isdigit() and 1 <= int(number) <= int(count)):
        raise click.UsageError(f"--part {text!r} is not K/N with K from 1 to N, e.g. 2/8.")
    return int(number), int(count)


def parse_bytes(context, parameter, text):
    """ "20GB" -> 20000000000; a click callback."""
    if text is None:
        return None
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)B?", text.strip().upper())
    if not found or float(found[1]) <= 0:
        raise click.UsageError(f"--scratch-size {text!r} is no size; give bytes, or e.g. 500MB or 20GB.")
    return int(float(found[1]) * UNITS[found[2]])


SLURM = """#!/bin/bash
# An array of {count} tasks: sbatch this file. A task that is taken away is put back into the queue and goes on.
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


def slurm_script(context, count: int, workers: int) -> str:
    """A script for sbatch that makes a release in `count` tasks; each task does its part of the jobs."""
    base = ["dmcvb-gen", "rollout", *_given(context, without=("slurm_script",))]
    name = "dmcvb-gen"
    return SLURM.format(
        count=count,
        workers=workers,
        name=name,
        init=shlex.join([*base, "--init"]),
        work=shlex.join(base),
        finish=shlex.quote(shlex.join([*base, "--finish"])),
    )


def _given(context, without) -> list[str]:
    """The words of a command line, as they were given, but for some options."""
    words = []
    for parameter in context.command.params:
        if parameter.name in without or context.get_parameter_source(parameter.name) != ParameterSource.COMMANDLINE:
            continue
        value = context.params[parameter.name]
        if isinstance(parameter, click.Argument):
            words += value
        elif parameter.is_flag:
            words.append(parameter.opts[-1])
        elif isinstance(value, dict):
            for key, entry in value.items():
                words += [parameter.opts[-1], f"{key}={entry}"]
        else:
            for entry in value if parameter.multiple else (value,):
                words += [parameter.opts[-1], str(entry)]
    return words


@click.command()
@click.argument("place", metavar="RELEASE|URL")
@remote_option
@json_option
def status(place, options, as_json):
    """Show the progress of a release that is being made: shards done and late, steps/s, time left.

    It reads the commit records, so it works from any machine.

    \b
    dmcvb-gen status s3://bucket/mine
    """
    from dmcvb_gen.generate.progress import progress_of
    from dmcvb_gen.generate.target import Target

    found = progress_of(Target.at(place, options))
    if as_json:
        return print_json(found.facts())
    print_table(
        ("subset", "done", "late", "open"),
        [
            (subset.name, f"{subset.done:,}", f"{subset.late:,}", f"{subset.total - subset.done:,}")
            for subset in found.subsets
        ],
        title=f"{found.name}: {found.done:,} of {found.total:,} shards",
    )
    if found.steps_per_second:
        last, left = format_duration(found.silence), format_duration(found.seconds_left)
        rate = f"{found.steps_per_second:,.0f} steps/s"
        click.echo(f"{found.steps:,} steps; {rate}, last shard {last} ago; {left} left")
    if found.late:
        click.echo(
            f"{found.late} shards are late: later ones are done. They are still in progress or their worker died; "
            "rerun the same command to make them"
        )
    if found.done == found.total:
        click.echo("complete" if found.complete else "All shards are done; finish the release with --finish.")
