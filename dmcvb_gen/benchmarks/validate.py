"""Validate a release: what a person asks for becomes a budget and cells; checks, trainings and the report follow."""

import dataclasses
import inspect
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Ge, Gt, Lt

from dmcvb_gen.errors import DmcvbError, UnknownNameError
from dmcvb_gen.options import Count, Local, Location, Names, Precision, checked, progress_bar, refuse
from dmcvb_gen.parallel import Workers, ignore
from dmcvb_gen.spec import matches
from dmcvb_gen.text import as_names

if TYPE_CHECKING:
    from dmcvb_gen.benchmarks.report import Validation

TRAINING = (
    *("benchmarks", "agents", "profile", "scale", "seed", "train_unsound"),
    *("threads", "device", "precision", "compile", "dino_weights"),
)
"""Options of `validate` that say what is trained, and how."""


@checked
def validate(
    release: Location,
    *,
    profile: str = "smoke",
    scale: Annotated[float, Gt(0), Lt(math.inf)] = 1.0,
    benchmarks: Names = ("b1",),
    agents: Names | None = None,
    only: Names = (),
    out: Local | None = None,
    checks_only: bool = False,
    train_unsound: bool = False,
    workers: Workers | None = None,
    threads: Count | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    precision: Precision = "auto",
    compile: bool = False,
    memory: Annotated[float, Ge(0), Lt(math.inf)] | None = None,
    seed: Annotated[int, Ge(0), Lt(2**31)] = 0,
    dino_weights: Location | None = None,
    backgrounds: Location | None = None,
    progress: bool = True,
    on_score: Callable[..., None] = ignore,
) -> "Validation":
    """Check a release, run the paper's benchmarks on it and write a report.

    Args:
      release (RELEASE): Folder of the release.
      profile: Budget: smoke (no scores), brief, quick or paper.
      scale: Multiply the profile's steps.
      benchmarks: b1, b2, b3, b4.
      agents (A,B): Agents to train, e.g. bc,state-bc,id+bc. [default: the benchmark's]
      only (PATTERN): Use only these subsets, e.g. 'walker-walk/expert/*'.
      out (FOLDER): Folder of the report. [default: reports/NAME, or reports/NAME-checks]
      checks_only: Check the structure and train nothing.
      train_unsound: Run the benchmarks even if a check fails.
      workers: Cells side by side. [default: 2, on one core 1]
      threads: Threads of each worker. [default: cores / workers]
      device: Device that trains.
      precision: Precision of networks that see images; auto takes bfloat16 if the device has instructions for it.
      compile: Compile the losses with torch.compile (for CUDA and long runs).
      memory (GB): Memory for images, of all workers together; ray: of each. [default: half of what is free]
      seed: Random seed of the trainings.
      dino_weights (FILE): Safetensors file with the weights of dino+bc.
      backgrounds (FOLDER): Folder of the background videos, if it has moved.

    `on_score` is called with the budget, a cell and its result, as soon as it is known.

    Raises:
      DmcvbError: there is no release, a name is unknown, the release has no data for a benchmark, this torch finds no
        CUDA device, or the report's folder cannot be written or holds results of another release or budget.
    """
    asked = {name: value for name, value in locals().items() if name in TRAINING}
    import torch

    from dmcvb_gen.benchmarks.cell import open_data, planned_steps, run_cells, with_kept
    from dmcvb_gen.benchmarks.checks import check_structure, seen_warnings
    from dmcvb_gen.benchmarks.plan import BUDGETS
    from dmcvb_gen.benchmarks.report import Validation, claim_folder, plan_validation, report_facts, write_report
    from dmcvb_gen.parallel.cores import default_workers, usable_cores
    from dmcvb_gen.precision import choose_precision
    from dmcvb_gen.storage.places import local_path

    started = time.perf_counter()
    if checks_only:
        usual = {name: parameter.default for name, parameter in inspect.signature(validate).parameters.items()}
        changed = {name: value != usual[name] for name, value in asked.items()}
        refuse("--checks-only trains nothing", benchmark=changed.pop("benchmarks"), **changed)
    names = agent_names(agents, dino_weights)
    # Two cells of one thread each are faster than one of two; an accelerator is not shared.
    workers = workers or default_workers(2 if device == "cpu" else 1)
    if profile not in BUDGETS:
        raise UnknownNameError("profile", profile, BUDGETS)
    if device == "cuda" and not torch.cuda.is_available():
        raise DmcvbError("this torch finds no CUDA device; install a CUDA build of torch or use --device cpu")
    budget = dataclasses.replace(
        BUDGETS[profile].scaled(scale),
        device=device,
        precision=choose_precision(precision, device),
        threads=threads or (max(1, usable_cores() // workers) if isinstance(workers, int) else 1),
        memory=None if memory is None else int(memory * 1e9),
        compile=compile,
        seed=seed,
        dino_weights=dino_weights and str(dino_weights),
        backgrounds=backgrounds and str(backgrounds),
    )
    data, patterns = open_data(release, budget), as_names(only)
    chosen, cells, missing = plan_validation(data, () if checks_only else as_names(benchmarks), names, patterns)
    if backgrounds is not None and not any(subset.record.distractor.shows_videos for subset in chosen.subsets.values()):
        raise DmcvbError("no subset that is validated shows videos, so --backgrounds has no effect: leave it out")
    if patterns:  # a subset that was not asked for is not missing
        asked = [(one, tuple(each for each in one.subsets if matches(each, patterns))) for one in missing]
        missing = [dataclasses.replace(one, subsets=subsets) for one, subsets in asked if subsets]
    name = Path(release).resolve().name + "-checks" * checks_only  # a report of trainings stays as it is
    folder = local_path(out or Path("reports") / name)
    claim_folder(folder, data, budget, training=bool(cells))
    results = []
    with progress_bar(progress, " checks", "structure", scaled=False) as bar:
        structure = check_structure(chosen, budget.backgrounds, bar, workers)
        if structure.sound or train_unsound:
            bar.unit = " steps"
            bar.reset(planned_steps(budget, cells))
            for cell, result in run_cells(release, folder, budget, cells, workers, bar):
                on_score(budget, cell, result)
                results.append((cell, result))
    results.sort(key=lambda pair: cells.index(pair[0]))
    shown = with_kept(results, data, folder, budget)
    warnings = (*structure.warnings, *seen_warnings(data, [cell for cell, _ in shown], budget.backgrounds))
    planned = dict.fromkeys([*cells, *(cell for cell, _ in shown)])
    facts = report_facts(data, chosen, budget, structure, len(planned), shown, missing, warnings)
    facts |= {"seconds": time.perf_counter() - started}
    page = write_report(folder, facts, shown)
    return Validation(structure, tuple(results), warnings, facts["complete"], page)


def agent_names(agents: Names | None, dino_weights: Location | None) -> list[str]:
    """The names of the agents that are asked for, one a text or several with commas.

    Raises:
      DmcvbError: one is unknown, or lacks weights, or none needs those that are given.
    """
    from dmcvb_gen.agents.catalog import parse_agent
    from dmcvb_gen.agents.dino import DinoEncoder

    names = [name.strip() for text in as_names(agents) for name in text.split(",") if name.strip()]
    if any(agent.sees_by_dino for agent in [parse_agent(name) for name in names]):  # all are known
        DinoEncoder.digest(dino_weights)  # read, before any work
    elif dino_weights is not None:
        raise DmcvbError("--dino-weights has no effect: no agent is asked for that needs them; add --agents dino+bc")
    return names
