"""The commands as functions: `dmcvb_gen.rollout(...)` does what `dmcvb-gen rollout ...` does.

The options of a command are made from its function: types and defaults from the signature, help from "Args:" in the
docstring (`dmcvb_gen.cli.options` says how). A call that was interrupted resumes if it is made again.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.options import (
    Between,
    Count,
    Difficulty,
    GoalPictures,
    Local,
    Location,
    Names,
    Part,
    Precision,
    Reward,
    Samples,
    Seed,
    Share,
    Span,
    Split,
    checked,
)
from dmcvb_gen.parallel import Workers, ignore
from dmcvb_gen.parallel.cores import usable_cores
from dmcvb_gen.text import as_names, quoted

if TYPE_CHECKING:
    from dmcvb_gen.agents.trainer import Budget
    from dmcvb_gen.benchmarks.report import Validation
    from dmcvb_gen.generate.paint import RenderResult
    from dmcvb_gen.generate.regenerate import Outcome
    from dmcvb_gen.loaders.release import ReleaseReader
    from dmcvb_gen.progress import ProgressBar
    from dmcvb_gen.release.fetch import Moved
    from dmcvb_gen.release.verify import Verification


@checked
def rollout(
    tasks: Names = (),
    *,
    recipe: Location | None = None,
    only: Names = (),
    levels: Names = (),
    distractors: Names = (),
    difficulty: Difficulty | None = None,
    intensity: Share | None = None,
    vary: Names = (),
    video_count: Count | None = None,
    correlated: Share | None = None,
    goals: Names = (),
    fixed_goals: Count | None = None,
    episodes_per_goal: Count | None = None,
    layouts: Names = (),
    reward: Reward | None = None,
    episodes: Count | None = None,
    steps: Count | None = None,
    max_steps: Count | None = None,
    episode_range: Span | None = None,
    seed: Seed | None = None,
    size: int | None = None,
    renderer: str | None = None,
    samples: Samples | None = None,
    backgrounds: Location | None = None,
    split: Split | None = None,
    behaviour: Location | None = None,
    sample: bool = False,
    pixels: bool = True,
    independent: bool = False,
    workers: Workers = 1,
    episodes_per_shard: Count | None = None,
    out: Location | None = None,
    storage_options: dict[str, Any] | None = None,
    scratch: Local | None = None,
    scratch_size: Count | None = None,
    part: Part | None = None,
    other_versions: bool = False,
    progress: bool = True,
) -> "ReleaseReader":
    """Roll out behaviour policies into a release of episodes, and open it.

    `dmcvb_gen.rollout("walker-walk", levels="expert", distractors="dynamic", episodes=4, out="releases/demo")`

    With a recipe, tasks, levels, distractors and goals select a part of it, and other arguments override its values.
    Without tasks and recipe, the release at `out` resumes from its own manifest.

    Args:
      tasks (TASK): Tasks, all of one family.
      recipe (FILE|NAME): Recipe: a YAML file or the name of a shipped one.
      only (PATTERN): Roll out only these subsets, e.g. 'walker-walk/*/static'.
      levels: expert, medium, mixed, random. [default: random]
      distractors: none, static, dynamic, or at a strength: dynamic_hard, dynamic_0.35. [default: none]
      difficulty: Strength of the distractors. [default: medium]
      intensity: Scale of the distractors instead of a difficulty: easy is 0.1, medium 0.2, hard 0.3.
      vary (PART,...): Vary only these parts: camera, color, background, shake, light. [default: the first three]
      video_count: Background videos in use. [default: by the difficulty]
      correlated (RHO): dynamic: also show a spurious cue that correlates with the last action.
      goals: Mazes: visible, hidden or fixed. [default: visible]
      fixed_goals: Mazes: this many fixed (start, goal) pairs (B3).
      episodes_per_goal: Mazes: episodes of each fixed pair. [default: 10]
      layouts: Mazes: name or text file of a layout, instead of TASK.
      reward: Mazes: DMC-VB's distance to the goal, or the shortest path.
      episodes: Episodes per subset. [default: 20]
      steps: Steps per subset, instead of --episodes.
      max_steps: Longest episode, in steps. [default: 500, mazes 600]
      episode_range (RANGE): Generate only the shards with episodes A to B - 1.
      seed: Random seed of the release. [default: 0]
      size: Width and height of the images, in pixels. [default: 64]
      renderer: native or opengl. [default: native if it paints the tasks]
      samples: Samples per pixel: 1, 2, 4 or 8; native has 4. [default: 4]
      backgrounds: Background videos: builtin, or a folder. [default: builtin]
      split: Background videos and maze styles: train or val. [default: train]
      behaviour (BEHAVIOUR): Policy instead of the bundled one: a policy file, a training run, an SB3
        zip, a torch state dict (.pt), or a function of your own.
      sample: Sample actions instead of using the policy mean.
      pixels: False: Store no images; `paint` renders them later.
      independent: Simulate separate episodes for each distractor.
      workers: Worker processes.
      episodes_per_shard: Episodes per shard. [default: 50, mazes 10]
      out: Folder or URL (s3://bucket/name, gs://, ...). [default: releases/NAME]
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.
      scratch: With a URL: local folder for unfinished shards. [default: the system's]
      scratch_size (BYTES): Maximum scratch space, e.g. 20GB. [default: half of what is free]
      part (K/N): Run only part K of N: every N-th job, starting with the K-th.
      other_versions: Resume even if package versions have changed.

    Raises:
      DmcvbError: an unknown name, a value that is wrong, an option that would have no effect, or no room.
    """
    options = locals()
    from dmcvb_gen.generate.rollout import prepare_rollout, request_of, rollout_plan, run_plan, target_for
    from dmcvb_gen.loaders.release import open_for_reading

    request = request_of(options)
    target = target_for(options, request)
    plan = prepare_rollout(rollout_plan(options, request, target), options)
    with progress_bar(progress, f" {plan.unit}", plan.manifest.name) as bar:
        run_plan(plan, workers, bar, finishing=part is None)
    return open_for_reading(target.place if out is None else str(out), storage_options)  # a place lacks a URL's "#..."


@checked
def paint(
    release: Location,
    *,
    only: Names = (),
    episodes: Span | None = None,
    size: Count | None = None,
    views: Names | None = None,
    goal: GoalPictures | None = None,
    workers: Workers = 1,
    backgrounds: Location | None = None,
    progress: bool = True,
    notify: Callable[[str], None] = ignore,
) -> "RenderResult":
    """Render the images of a release that has none, and compare them with their known digests.

    Args:
      release: Folder of the release.
      only (PATTERN): Render only these subsets.
      episodes (RANGE): Use only the shards with episodes A to B - 1.
      size: Width and height in pixels. [default: the manifest's]
      views (A,B): Mazes: render only these views, e.g. egocentric. [default: all]
      goal: Mazes: render only images with, or without, the goal. [default: both]
      workers: Worker processes.
      backgrounds (FOLDER): Folder of the background videos, if the release has no copies.

    `notify` is called with each difference to the environment that made the release, before rendering.

    Raises:
      DmcvbError: nothing matches, a shard is damaged, or the videos are not those of the manifest; a URL is given.
    """
    from dmcvb_gen.generate.paint import paint_release
    from dmcvb_gen.storage.remote import is_url, local_path, public

    if is_url(str(release)):
        url = public(str(release))
        raise DmcvbError(
            f"{url} is a URL; give a local one, or fetch and render it: dmcvb-gen fetch {quoted(url)} --paint --out "
            "FOLDER"
        )
    release = local_path(release)
    with progress_bar(progress, " frames") as bar:
        config = _render_config(size, views, goal, backgrounds, workers, bar, notify)
        return paint_release(release, as_names(only), episodes, config)


@checked
def repaint(
    release: Location,
    *,
    only: Names = (),
    distractor: str | None = None,
    difficulty: Difficulty | None = None,
    size: int | None = None,
    renderer: str | None = None,
    samples: Samples | None = None,
    backgrounds: Location | None = None,
    split: Split | None = None,
    labels: Names = (),
    name: str | None = None,
    out: Local,
    workers: Workers = 1,
    progress: bool = True,
) -> "ReleaseReader":
    """Give episodes new images, from their stored physics states, in a new release; open that.

    Args:
      release (RELEASE): Folder of the release.
      only (PATTERN): Render only these subsets.
      distractor: none, static, dynamic, or at a strength: dynamic_hard, dynamic_0.35. [default: the subset's own]
      difficulty: Strength of the distractors. [default: the subset's own; medium with --distractor]
      size: Width and height in pixels. [default: the subset's own]
      renderer: native or opengl. [default: the subset's own]
      samples: Samples per pixel: 1, 2, 4 or 8.
      backgrounds (FOLDER): Background videos: builtin, or a folder. [default: the recipe's]
      split: Background videos and maze styles. [default: the recipe's]
      labels: Also store a modality: depth, segmentation, parts, flow (optical flow to the next frame) or your own.
      name: Name of the new release. [default: NAME-repainted]
      out (FOLDER): Folder of the new release.
      workers: Worker processes.

    Raises:
      DmcvbError: nothing fits, a shard is damaged, or `out` cannot be used.
    """
    from dmcvb_gen.distractors.registry import typed_setting
    from dmcvb_gen.generate.repaint import Repainting
    from dmcvb_gen.generate.repaint import repaint as run
    from dmcvb_gen.loaders.release import open_for_reading

    look = (distractor and typed_setting(distractor), difficulty, size, renderer, samples, _videos(backgrounds), split)
    with progress_bar(progress, " frames") as bar:
        run(Repainting(release, out, as_names(only), *look, tuple(dict.fromkeys(as_names(labels))), name), workers, bar)
    return open_for_reading(str(out))


@checked
def regenerate(
    release: Location | None = None,
    *,
    manifest: Location | None = None,
    only: Names = (),
    episodes: Span | None = None,
    check: bool = False,
    out: Local | None = None,
    backgrounds: Location | None = None,
    workers: Workers = 1,
    progress: bool = True,
) -> "Outcome":
    """Make a release's shards again from its manifest alone, bit for bit: to repair, to check, or into `out`.

    Args:
      release (RELEASE): Folder of the release.
      manifest (NAME|FILE): A shipped manifest, a manifest's file or the files.tar.xz of a card, instead of a release.
      only (PATTERN): Regenerate only these subsets.
      episodes (RANGE): Use only the shards with episodes A to B - 1.
      check: Compare digests and change nothing.
      out (FOLDER): Write the shards to this folder instead.
      backgrounds (FOLDER): Folder of the background videos, if it has moved.
      workers: Worker processes.

    Raises:
      DmcvbError: there is no such release, or its shards cannot be made here.
    """
    from dmcvb_gen.generate.regenerate import Regeneration
    from dmcvb_gen.generate.shipped import manifest_source

    if (release is None) == (manifest is None):
        raise DmcvbError("give a RELEASE, or a manifest with --manifest")
    add = "add --out FOLDER (in Python, out=FOLDER)"
    if manifest is not None and check:
        raise DmcvbError(
            "remove --check: with --manifest, digests are always compared" + ("" if out else f"; and {add}")
        )
    if manifest is not None and not out:
        raise DmcvbError(f"a manifest alone has no shards to repair: {add}")
    if check and out:
        raise DmcvbError("give --check or --out, not both")
    videos = None if backgrounds is None else str(backgrounds)
    with ExitStack() as stack:
        source = release if manifest is None else stack.enter_context(manifest_source(manifest))
        assert source is not None
        bar = stack.enter_context(progress_bar(progress, " frames"))
        work = Regeneration(source, as_names(only), episodes, videos, workers)
        return work.remake(out, bar) if out else work.check(bar) if check else work.repair(bar)


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
    """Check a release: all of a folder; at a URL the manifest, index, commit records and a sample of files.

    Args:
      release (RELEASE|URL): Folder or URL of the release.
      everything: At a URL: read every file instead of a sample.
      backgrounds (FOLDER): Folder of the background videos, if it has moved.
      workers: Worker processes; at a URL: parallel downloads. [default: 1, at a URL 8]
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.

    Raises:
      DmcvbError: there is no release, nothing is committed, or an option has no effect there.
    """
    from dmcvb_gen.release.verify import verify as run
    from dmcvb_gen.release.verify_url import WORKERS, verify_url
    from dmcvb_gen.storage.remote import is_url

    if is_url(str(release)):
        _refuse("at a URL nothing is painted or simulated", backgrounds=backgrounds, executor=not _is_count(workers))
        with progress_bar(progress, " files", scaled=False) as bar:
            return verify_url(str(release), storage_options, everything, bar, workers or WORKERS)  # type: ignore[arg-type]
    _refuse(f"{release} is a folder, which is always read whole", all=everything, option=storage_options)
    with progress_bar(progress, " checks", scaled=False) as bar:
        return run(release, None if backgrounds is None else str(backgrounds), bar, workers or 1)


@checked
def publish(
    release: Location,
    url: str,
    *,
    storage_options: dict[str, Any] | None = None,
    take_over: bool = False,
    repair: bool = False,
    workers: Count = 8,
    pixels: bool = True,
    progress: bool = True,
) -> "Moved":
    """Put a complete release, or an export, at a URL: every file checked, the manifest last.

    Args:
      release (RELEASE): Folder of the release, or of an export.
      url (URL): Where to put it: s3://, gs://, hf:// or any fsspec URL.
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.
      take_over: Publish even if another upload has claimed the URL.
      repair: Compare published files by their digests, and replace those that differ.
      workers: Parallel transfers.
      pixels: False: Publish without images; `paint` renders them again.

    Raises:
      StoreError: the release is not complete or damaged, another version is there, or access is refused.
    """
    from dmcvb_gen.release.publish import publish_folder

    given: dict[str, Any] = dict(
        pixels=pixels, take_over=take_over, repair=repair, options=storage_options, workers=workers
    )
    with progress_bar(progress, " files", scaled=False) as bar:
        return publish_folder(release, url, tick=bar, **given)


@checked
def fetch(
    url: str,
    out: Local,
    *,
    only: Names = (),
    episodes: Span | None = None,
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
      episodes (RANGE): Use only the shards with episodes A to B - 1.
      paint: Render the images of each shard as it arrives.
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
    from dmcvb_gen.release.fetch import fetch, fetch_and_paint

    what = (options["url"], options["out"], as_names(options["only"]), options["episodes"])
    look = (options["size"], options["views"], options["goal"])
    given: dict[str, Any] = dict(options=options["storage_options"], workers=options["workers"])
    if not options["paint"]:
        if any(look):
            raise DmcvbError(
                "--size, --views and --goal have no effect without --paint: add it (in Python, paint=True)"
            )
        with progress_bar(options["progress"], "B") as bar:
            return fetch(*what, tick=bar, **given), None
    with (
        progress_bar(options["progress"], "B", "fetched") as moved,
        progress_bar(options["progress"], " frames", "painted") as frames,
    ):
        painter = _render_config(*look, None, usable_cores(), frames, notify)
        return fetch_and_paint(*what, painter=painter, tick=moved, **given)


@checked
def export(
    release: Location,
    to: str,
    out: Local,
    *,
    only: Names = (),
    episodes: Span | None = None,
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
      episodes (RANGE): Export only episodes A to B - 1.
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
        return run(str(release), to, out, as_names(only), episodes, tick=bar, **given)


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
    scale: Annotated[float, Between(0, open=True)] = 1.0,
    benchmarks: Names = ("b1",),
    agents: Names = (),
    only: Names = (),
    out: Local | None = None,
    checks_only: bool = False,
    train_unsound: bool = False,
    workers: Workers | None = None,
    threads: Count | None = None,
    device: Annotated[str, ("cpu", "cuda")] = "cpu",
    precision: Precision = "auto",
    compile: bool = False,
    memory: Annotated[float, Between(0)] | None = None,
    seed: Annotated[int, Between(0, 2**31 - 1)] = 0,
    dino_weights: Location | None = None,
    backgrounds: Location | None = None,
    progress: bool = True,
) -> "Validation":
    """Check a release, run the paper's benchmarks on it and write a report.

    Args:
      release (RELEASE): Folder of the release.
      profile: Budget: smoke (no scores), brief, quick or paper.
      scale: Multiply the profile's steps.
      benchmarks: b1, b2, b3, ablations.
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
    from dmcvb_gen.dataset import open_release

    release, agents = open_release(options["release"]), as_names(options["agents"])
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


def _videos(backgrounds: Location | None) -> str | None:
    from dmcvb_gen.generate.request import background_source

    return None if backgrounds is None else background_source(backgrounds)


def _render_config(size, views, goal, backgrounds, workers, bar, notify) -> Any:
    from dmcvb_gen.generate.paint import RenderConfig, RenderOverrides

    overrides = RenderOverrides(size, None if views is None else as_names(views), goal)
    return RenderConfig(overrides, workers, _videos(backgrounds), bar, notify)


@contextmanager
def progress_bar(shown: bool, unit: str, name: str | None = None, scaled: bool = True) -> "Iterator[ProgressBar]":
    """A bar on standard error; drawn if `shown`."""
    from dmcvb_gen.progress import ProgressBar

    with ProgressBar(shown, unit=unit, unit_scale=scaled, desc=name) as bar:
        yield bar
