"""The commands as functions: `dmcvb_gen.rollout(...)` does what `dmcvb-gen rollout ...` does.

The options of a command are made from its function: types and defaults from the signature, help from "Args:" in the
docstring (`dmcvb_gen.cli.options` says how). A call that was interrupted resumes if it is made again.
"""

import inspect
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Ge, Gt, Lt

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.making import paint
from dmcvb_gen.options import (
    Count,
    GoalPictures,
    Local,
    Location,
    Names,
    Precision,
    Span,
    checked,
    progress_bar,
)
from dmcvb_gen.parallel import Workers, ignore
from dmcvb_gen.text import as_names

if TYPE_CHECKING:
    from dmcvb_gen.agents.trainer import Budget
    from dmcvb_gen.benchmarks.report import Validation
    from dmcvb_gen.generate.paint import RenderResult
    from dmcvb_gen.loaders.release import ReleaseReader
    from dmcvb_gen.release.fetch import Moved
    from dmcvb_gen.release.verify import Verification


@checked
def verify(
    release: Location,
    *,
    everything: bool = False,
    backgrounds: Location | None = None,
    workers: Workers | None = None,
    storage_options: dict[str, Any] | None = None,
    progress: bool = True,
) -> "Verification":
    """Check a release: all of a folder; at a URL the manifest, its lists and a sample of files.

    Args:
      release (RELEASE|URL): Folder or URL of the release.
      everything: At a URL: read every file instead of a sample.
      backgrounds (FOLDER): Folder of the background videos, if it has moved.
      workers: Worker processes; at a URL: parallel downloads. [default: 1, at a URL 8]
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.

    Raises:
      DmcvbError: there is no release, nothing is committed, or an option has no effect there.
    """
    from dmcvb_gen.release.verify import THREADS, verify_url
    from dmcvb_gen.release.verify import verify as run
    from dmcvb_gen.storage.places import is_url

    if is_url(str(release)):
        _refuse("at a URL nothing is painted or simulated", backgrounds=backgrounds, executor=not _is_count(workers))
        with progress_bar(progress, " files", scaled=False) as bar:
            return verify_url(str(release), storage_options, everything, bar, workers or THREADS)  # type: ignore[arg-type]
    _refuse(f"{release} is a folder, which is always read whole", all=everything, option=storage_options)
    with progress_bar(progress, " checks", scaled=False) as bar:
        return run(release, None if backgrounds is None else str(backgrounds), bar, workers or 1)


@checked
def publish(
    release: Location,
    url: str,
    *,
    storage_options: dict[str, Any] | None = None,
    repair: bool = False,
    workers: Count = 8,
    pixels: bool = True,
    progress: bool = True,
) -> "Moved":
    """Put a complete release, or an export, at a URL: every file checked, the manifest last.

    Args:
      release (RELEASE): Folder of the release, or of an export.
      url (URL): Where to put it: s3://, gs://, az://, hf:// or file:.
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.
      repair: Compare published files by their digests, and replace those that differ.
      workers: Parallel transfers.
      pixels: False: Publish without images; `paint` renders them again.

    Raises:
      StoreError: the release is not complete or damaged, another version is there, or access is refused.
    """
    from dmcvb_gen.release.publish import publish_folder

    given: dict[str, Any] = dict(pixels=pixels, repair=repair, options=storage_options, workers=workers)
    with progress_bar(progress, " files", scaled=False) as bar:
        return publish_folder(release, url, tick=bar, **given)


@checked
def fetch(
    url: str,
    out: Local,
    *,
    only: Names = (),
    episode_range: Span | None = None,
    paint: bool = False,
    size: Count | None = None,
    views: Names | None = None,
    goal: GoalPictures | None = None,
    storage_options: dict[str, Any] | None = None,
    workers: Count = 8,
    progress: bool = True,
) -> "ReleaseReader":
    """Download a published release, or a part of it, and open it.

    Args:
      url (URL): Where it was published.
      out (FOLDER): Local folder for the release.
      only (PATTERN): Fetch only these subsets.
      episode_range (RANGE): Use only the shards with episodes A to B - 1.
      paint: Then render the images.
      size: Width and height in pixels. [default: the manifest's]
      views (A,B): Mazes: render only these views, e.g. egocentric. [default: all]
      goal: Mazes: render only images with, or without, the goal. [default: both]
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.
      workers: Parallel transfers.

    Raises:
      DmcvbError: no release is there, a file is not what its digest says, `out` holds something else, or no room.
    """
    options = locals()
    from dmcvb_gen.loaders.release import open_for_reading

    download(options)
    return open_for_reading(str(out))


def download(options: Mapping[str, Any], notify: Callable[[str], None] = ignore) -> "tuple[Moved, RenderResult | None]":
    """Fetch as the arguments of `fetch` say: return what was moved and, with `paint`, what was painted."""
    from dmcvb_gen.release.fetch import fetch

    what = (options["url"], options["out"], as_names(options["only"]), options["episode_range"])
    look = {name: options[name] for name in ("size", "views", "goal")}
    if not options["paint"] and any(look.values()):
        raise DmcvbError("--size, --views and --goal have no effect without --paint: add it (in Python, paint=True)")
    given: dict[str, Any] = dict(options=options["storage_options"], workers=options["workers"])
    with progress_bar(options["progress"], "B") as bar:
        moved = fetch(*what, tick=bar, **given)
    if not options["paint"]:
        return moved, None
    chosen = dict(only=options["only"], episode_range=options["episode_range"], progress=options["progress"])
    return moved, paint(options["out"], **chosen, **look, notify=notify)


@checked
def export(
    release: Location,
    to: str,
    out: Local,
    *,
    only: Names = (),
    episode_range: Span | None = None,
    merge: bool = False,
    video: bool = False,
    workers: Workers = 1,
    storage_options: dict[str, Any] | None = None,
    progress: bool = True,
) -> list[Path]:
    """Write subsets in another format, a folder for each; the folders.

    Args:
      release (RELEASE|URL): Folder or URL of the release.
      to: Format, for example hdf5, minari, lerobot, rlds or rerun.
      out (FOLDER): Output folder, one folder per subset.
      only (PATTERN): Export only these subsets.
      episode_range (RANGE): Export only episodes A to B - 1.
      merge: lerobot: write all subsets as the tasks of one data set.
      video: lerobot: store images as mp4 (smaller, lossy) instead of PNG.
      workers: Worker processes, one subset each.
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.

    Raises:
      DmcvbError: no such format or subset, or a package is not installed.
    """
    from dmcvb_gen.release.export import export as run

    given: dict[str, Any] = dict(merge=merge, video=video, workers=workers, storage_options=storage_options)
    with progress_bar(progress, " episodes", scaled=False) as bar:
        return run(str(release), to, out, as_names(only), episode_range, tick=bar, **given)


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

    Raises:
      DmcvbError: there is no release, a name is unknown, or the release has no data for a benchmark.
    """
    options = locals()
    from dmcvb_gen.agents.catalog import split_agents

    options["agents"] = split_agents(agents) if isinstance(agents, str) else as_names(agents)
    if checks_only:
        usual = {name: parameter.default for name, parameter in inspect.signature(validate).parameters.items()}
        _refuse("checks_only trains nothing", **{name: options[name] != usual[name] for name in TRAINING})
    return run_validation(validation_budget(options), options)


def validation_budget(options: Mapping[str, Any]) -> "Budget":
    """Make the budget of all trainings from the arguments of `validate`; mistakes in others are told, too."""
    from dmcvb_gen.agents.catalog import parse_agent
    from dmcvb_gen.benchmarks.cell import default_workers
    from dmcvb_gen.benchmarks.report import make_budget, plan_validation
    from dmcvb_gen.dataset import Release

    release, agents = Release.open(options["release"]), as_names(options["agents"])
    chosen = [parse_agent(agent) for agent in agents]
    if options["dino_weights"] is not None and not any(agent.ready_encoder for agent in chosen):
        raise DmcvbError("--dino-weights has no effect: no agent is asked for that needs them; add --agents dino+bc")
    if options["dino_weights"] is None and any(agent.ready_encoder for agent in chosen):
        raise DmcvbError(next(agent.ready_encoder.missing for agent in chosen if agent.ready_encoder))
    benchmarks = () if options["checks_only"] else as_names(options["benchmarks"])
    plan_validation(release, benchmarks, agents, as_names(options["only"]))
    given = {name: options[name] for name in ("profile", "scale", "threads", "device", "precision", "compile")}
    given |= {name: options[name] for name in ("memory", "seed", "dino_weights", "backgrounds")}
    return make_budget(workers=options["workers"] or default_workers(options["device"]), **given)


def run_validation(
    budget: "Budget", options: Mapping[str, Any], on_score: Callable[[Any, dict[str, Any]], None] = ignore
) -> "Validation":
    """Run what the arguments of `validate` ask for.

    Args:
      on_score: called with each cell and its result, as soon as it is there.
    """
    from dmcvb_gen.benchmarks.cell import default_workers
    from dmcvb_gen.benchmarks.report import Progress
    from dmcvb_gen.benchmarks.report import validate as run

    with progress_bar(options["progress"], " checks", "structure", scaled=False) as bar:

        def train(steps: int) -> None:
            bar.unit = " steps"
            bar.reset(steps)

        return run(
            options["release"],
            options["out"] or Path("reports") / Path(options["release"]).name,
            budget,
            benchmarks=() if options["checks_only"] else as_names(options["benchmarks"]),
            agents=as_names(options["agents"]),
            patterns=as_names(options["only"]),
            workers=options["workers"] or default_workers(budget.device),
            train_unsound=options["train_unsound"],
            progress=Progress(checking=bar, total=train, training=bar.advance, done=on_score),
        )


# -- what they share ------------------------------------------------------------------------------


def _is_count(workers: Workers | None) -> bool:
    return workers is None or isinstance(workers, int)


def _refuse(reason: str, **given: Any) -> None:
    """Raises DmcvbError if one of the options is given."""
    for name, value in given.items():
        if value:
            raise DmcvbError(f"--{name} has no effect: {reason}; remove it")
