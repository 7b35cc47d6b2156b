"""A rollout, from the arguments of `dmcvb_gen.rollout` to its digests: request, target, plan, run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.manifest import Manifest
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.counts import check_room
from dmcvb_gen.generate.engine import JobResult
from dmcvb_gen.generate.executors import run_jobs
from dmcvb_gen.generate.plan import Plan, finish, make_plan, prepare
from dmcvb_gen.generate.recipe import Recipe
from dmcvb_gen.generate.request import RECIPE_OPTIONS, make_request
from dmcvb_gen.generate.target import Target
from dmcvb_gen.parallel import ProgressCallback, Workers, ignore
from dmcvb_gen.text import as_names

Options = Mapping[str, Any]
"""Arguments of `dmcvb_gen.rollout` by name; None, False or empty if they are not given."""


@dataclass(frozen=True)
class RolloutResult:
    """The result of running a plan.

    Attributes:
      manifest: manifest of the release; of a part, as it was when the part began.
      steps: transitions that were made now.
      seconds: on the clock.
      seconds_by_part: seconds of all workers together, by part: "physics", "policy", "rendering" and "storage".
    """

    manifest: Manifest
    steps: int
    seconds: float
    seconds_by_part: dict[str, float]


def request_of(options: Options) -> Recipe | None:
    """The recipe that the options ask for; None resumes the release at `out`.

    Raises:
      DmcvbError: an unknown name, a value that is wrong, or an option that would have no effect.
    """
    given = {name: value for name, value in options.items() if name in RECIPE_OPTIONS and _is_given(value)}
    tasks, recipe = as_names(options["tasks"]), options["recipe"]
    if options["out"] and not (tasks or recipe or given):
        return None
    return make_request(tasks, recipe, **given)


def _is_given(value: Any) -> bool:
    return value is not None and value is not False and value not in ((), [])


def target_for(options: Options, request: Recipe | None) -> Target:
    """Return where the release is made: `out`, or by default a folder of its name."""
    place = options["out"] or str(Path("releases") / request.name if request else "")
    workers = options["workers"] if isinstance(options["workers"], int) else 1
    return Target.at(place, options["storage_options"], options["scratch"], options["scratch_size"], workers)


def rollout_plan(options: Options, request: Recipe | None, target: Target) -> Plan:
    """The jobs of a rollout.

    Raises:
      DmcvbError: anything that would fail later, found before any work.
    """
    only, part = as_names(options["only"]), options["part"] or (1, 1)
    plan = make_plan(request, target, only, options["episode_range"], part, options["pixels"])
    _check_shards(options["episodes_per_shard"], plan)
    return plan


def _check_shards(given: int | None, plan: Plan) -> None:
    """Raises StoreError if subsets that are there have larger shards than asked for, which they keep."""
    there = plan.target.manifest() if given else None
    asked = {record.name for record in plan.manifest.subsets}
    for record in there.subsets if there else ():
        if given and record.name in asked and given < record.episodes_per_shard:
            raise StoreError(
                f"{plan.target.place} holds {record.name} with {record.episodes_per_shard} episodes a shard and keeps "
                "them; remove --episodes-per-shard, or choose another --out"
            )


def prepare_rollout(plan: Plan, options: Options, begin: bool = False) -> Plan:
    """Make a plan's release ready for its jobs; see `plan.prepare`.

    Args:
      begin: other machines make the shards, so this one needs no room for them.
    """
    if not begin:
        check_room(plan)
    return prepare(plan, options["other_versions"], begin or bool(options["part"]))


def run_plan(
    plan: Plan,
    workers: Workers = 1,
    progress: ProgressCallback = ignore,
    *,
    finishing: bool = True,
    on_result: Callable[[JobResult], None] = ignore,
) -> RolloutResult:
    """Make every shard of a plan, and write the digests of subsets that are whole.

    Args:
      plan: prepared by `plan.prepare`.
      workers: processes, or a Ray cluster.
      progress: called with the number of frames rendered since the last call.
      finishing: write the digests; False for a part, because other machines make the rest.
      on_result: called with the result of each job.

    Raises:
      StoreError: the disk is full, or another machine has committed other bytes.
    """
    started, steps, seconds = time.monotonic(), 0, dict[str, float]()
    for result in run_jobs(plan.jobs, workers, progress):
        steps += result.steps
        for part, value in result.seconds.items():
            seconds[part] = seconds.get(part, 0.0) + value
        on_result(result)
    manifest = finish(plan) if finishing else plan.manifest
    return RolloutResult(manifest, steps, time.monotonic() - started, seconds)
