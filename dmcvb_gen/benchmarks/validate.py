"""The public door to a validation: what a person asks for becomes a budget and a run of `report`."""

import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Ge, Gt, Lt

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.options import Count, Local, Location, Names, Precision, checked, progress_bar, refuse
from dmcvb_gen.parallel import Workers, ignore
from dmcvb_gen.text import as_names

if TYPE_CHECKING:
    from dmcvb_gen.benchmarks.report import Validation

TRAINING = (
    *("agents", "profile", "scale", "seed", "train_unsound"),
    *("threads", "device", "precision", "compile", "dino_weights"),
)
"""Options of `validate`, beside the benchmarks, that say what is trained, and how."""


@checked
def validate(
    release: Location,
    *,
    profile: str = "smoke",
    scale: Annotated[float, Gt(0), Lt(math.inf)] = 1.0,
    benchmarks: Names = ("b1",),
    agents: Names = (),
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
      benchmarks: b1, b2, b3, b4, ablations.
      agents (A,B): Agents to train, e.g. bc,state-bc,id+bc. [default: the benchmark's]
      only (PATTERN): Use only these subsets, e.g. 'walker-walk/expert/*'.
      out (FOLDER): Folder of the report. [default: reports/NAME]
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
      DmcvbError: there is no release, a name is unknown, or the release has no data for a benchmark.
    """
    given = locals()
    from dmcvb_gen.agents.catalog import parse_agent, split_agents
    from dmcvb_gen.benchmarks import report
    from dmcvb_gen.benchmarks.cell import default_workers

    if checks_only:
        usual = {name: parameter.default for name, parameter in inspect.signature(validate).parameters.items()}
        changed = {name: given[name] != usual[name] for name in TRAINING}
        refuse("--checks-only trains nothing", benchmark=benchmarks != usual["benchmarks"], **changed)
    names = [name for text in as_names(agents) for name in split_agents(text)]
    encoders = [agent.ready_encoder for agent in map(parse_agent, names) if agent.ready_encoder]
    if dino_weights is not None and not encoders:
        raise DmcvbError("--dino-weights has no effect: no agent is asked for that needs them; add --agents dino+bc")
    if dino_weights is None and encoders:
        raise DmcvbError(encoders[0].missing)
    workers = workers or default_workers(device)
    told = ("profile", "scale", "threads", "device", "precision", "compile", "memory", "seed")
    told += ("dino_weights", "backgrounds")
    budget = report.make_budget(workers=workers, **{name: given[name] for name in told})
    with progress_bar(progress, " checks", "structure", scaled=False) as bar:

        def train(steps: int) -> None:
            bar.unit = " steps"
            bar.reset(steps)

        return report.validate(
            release,
            out or Path("reports") / Path(release).name,
            budget,
            benchmarks=() if checks_only else as_names(benchmarks),
            agents=names,
            patterns=as_names(only),
            workers=workers,
            train_unsound=train_unsound,
            progress=report.Progress(
                checking=bar, total=train, training=bar.advance, done=lambda *found: on_score(budget, *found)
            ),
        )
