"""The commands as functions: `dmcvb_gen.rollout(...)` does what `dmcvb-gen rollout ...` does.

Names, defaults and errors are those of the commands; `dmcvb-gen COMMAND --help` explains every option. A call that
was interrupted resumes if it is made again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmcvb_gen.errors import DmcvbError

if TYPE_CHECKING:
    from dmcvb_gen.benchmarks.validate import Validation
    from dmcvb_gen.generate.paint import RenderResult
    from dmcvb_gen.generate.regenerate import Outcome
    from dmcvb_gen.loaders.release import ReleaseReader
    from dmcvb_gen.parallel import Workers
    from dmcvb_gen.release.fetch import Moved
    from dmcvb_gen.release.verify import Verification

Names = str | Sequence[str]
"""One name or several."""


def rollout(
    tasks: Names = (),
    *,
    levels: Names | None = None,
    distractors: Names | None = None,
    out: str | Path | None = None,
    recipe: str | Path | None = None,
    only: Names = (),
    difficulty: str | None = None,
    intensity: float | None = None,
    vary: Names | None = None,
    video_count: int | None = None,
    correlated: float | None = None,
    goals: Names | None = None,
    fixed_goals: int | None = None,
    episodes_per_goal: int | None = None,
    layouts: Names | None = None,
    reward: str | None = None,
    episodes: int | None = None,
    steps: int | None = None,
    max_steps: int | None = None,
    episodes_per_shard: int | None = None,
    seed: int | None = None,
    size: int | None = None,
    renderer: str | None = None,
    samples: int | None = None,
    backgrounds: str | Path | None = None,
    split: str | None = None,
    behaviour: str | Path | None = None,
    sample: bool = False,
    independent: bool = False,
    pixels: bool = True,
    workers: Workers = 1,
    device: str = "cpu",
    storage_options: dict[str, Any] | None = None,
    other_versions: bool = False,
    progress: bool = True,
) -> ReleaseReader:
    """Roll out behaviour policies into a release of episodes, and open it.

    `dmcvb_gen.rollout("walker-walk", levels="expert", distractors="dynamic", episodes=4, out="releases/demo")`

    Args:
      tasks: a name or several; so are levels, distractors, only, goals and layouts.
      levels: expert, medium, mixed or random.
      distractors: none, static, dynamic, or at a strength: dynamic_0.35.
      only: patterns of subsets.
      goals: of mazes: visible or hidden.
      layouts: of mazes: names or text files.
      out: folder or URL of the release, by default releases/<name>. Without tasks and recipe, that release resumes.
      recipe: a YAML file or the name of a shipped recipe; other arguments narrow or override it.
      difficulty: easy, medium (the default) or hard; or intensity, the scale of the distractors, above 0 and up to 1.
      vary: parts that vary, of camera, color and background; all by default. video_count: background videos in use.
      correlated: above 0 and up to 1: a spurious cue in the colors that correlates so with the last action.
      episodes: of each subset, 20 by default; or steps, in agent steps.
      size: width and height of the images, 64 pixels by default.
      behaviour: a policy file, a training run, an SB3 zip, a torch state dict or "module:function".
      sample: draw actions instead of taking the policy's mean.
      pixels: False stores no images; `paint` renders them later.
      workers: processes, or a `dmcvb_gen.parallel.Ray` cluster.
      progress: show a bar.

    Raises:
      DmcvbError: an unknown name, a value that is wrong, an option that would have no effect, or no room.
    """
    from dmcvb_gen.generate.estimate import raw_bytes
    from dmcvb_gen.generate.plan import make_plan, prepare
    from dmcvb_gen.generate.request import make_request
    from dmcvb_gen.generate.rollout import run_plan
    from dmcvb_gen.generate.target import Target
    from dmcvb_gen.loaders.release import open_for_reading

    several = dict(levels=levels, distractors=distractors, goals=goals, layouts=layouts, vary=vary)
    given: dict[str, Any] = {name: _names(value) for name, value in several.items() if value is not None}
    single = dict(
        difficulty=difficulty,
        intensity=intensity,
        video_count=video_count,
        correlated=correlated,
        fixed_goals=fixed_goals,
        episodes_per_goal=episodes_per_goal,
        reward=reward,
        episodes=episodes,
        steps=steps,
        max_steps=max_steps,
        episodes_per_shard=episodes_per_shard,
        seed=seed,
        size=size,
        renderer=renderer,
        samples=samples,
        backgrounds=backgrounds,
        split=split,
        behaviour=behaviour,
        sample=sample or None,
        independent=independent or None,
    )
    given |= {name: value for name, value in single.items() if value is not None}
    tasks = _names(tasks)
    resuming = bool(out) and not (tasks or layouts or recipe or given)
    chosen = None if resuming else make_request(tasks, recipe, device=device, **given)
    place = str(out) if out else str(Path("releases") / (chosen.name if chosen else ""))
    target = Target.at(place, storage_options, workers=workers if isinstance(workers, int) else 1)
    plan = make_plan(chosen, target, _names(only), device if chosen else None, None, (1, 1), pixels)
    plan = prepare(plan, 0 if target.uploads else raw_bytes(plan), other_versions)
    with _bar(progress, " frames", plan.manifest.name) as bar:
        run_plan(plan, workers, bar)
    return open_for_reading(place, storage_options)


def paint(
    release: str | Path,
    *,
    only: Names = (),
    episodes: tuple[int, int] | None = None,
    size: int | None = None,
    views: Names | None = None,
    goal: str | None = None,
    backgrounds: str | Path | None = None,
    workers: Workers = 1,
    device: str = "cpu",
    progress: bool = True,
) -> RenderResult:
    """Render the images of a release that has none, and compare them with their known digests.

    Args:
      episodes: (first, last + 1): the shards that hold any of them.
      size: width and height instead of the manifest's; the release becomes another one, as with views and goal.
      views: to render, instead of the manifest's.
      goal: of mazes: visible or hidden, instead of the manifest's.

    Raises:
      DmcvbError: nothing matches, a shard is damaged, or the videos are not those of the manifest.
    """
    from dmcvb_gen.generate.paint import paint_release

    with _bar(progress, " frames") as bar:
        config = _render_config(size, views, goal, backgrounds, workers, device, bar)
        return paint_release(release, _names(only), episodes, config)


def repaint(
    release: str | Path,
    *,
    out: str | Path,
    only: Names = (),
    distractor: str | None = None,
    difficulty: str | None = None,
    size: int | None = None,
    renderer: str | None = None,
    samples: int | None = None,
    backgrounds: str | Path | None = None,
    split: str | None = None,
    labels: Names = (),
    name: str | None = None,
    workers: Workers = 1,
    device: str = "cpu",
    progress: bool = True,
) -> ReleaseReader:
    """Give episodes new images, from their stored physics states, in a new release; open that.

    Args:
      labels: "depth" and "segmentation", stored beside the images.
      name: of the new release.

    Raises:
      DmcvbError: nothing fits, a shard is damaged, or `out` cannot be used.
    """
    from dmcvb_gen.generate.repaint import Repainting
    from dmcvb_gen.generate.repaint import repaint as run
    from dmcvb_gen.generate.request import background_source
    from dmcvb_gen.loaders.release import open_for_reading

    videos = None if backgrounds is None else background_source(backgrounds)
    what = (_names(only), distractor, difficulty, size, renderer, samples, videos, split, device, _names(labels), name)
    with _bar(progress, " frames") as bar:
        run(Repainting(release, out, *what), workers, bar)
    return open_for_reading(str(out))


def regenerate(
    release: str | Path | None = None,
    *,
    manifest: str | Path | None = None,
    out: str | Path | None = None,
    only: Names = (),
    episodes: tuple[int, int] | None = None,
    check: bool = False,
    backgrounds: str | Path | None = None,
    device: str | None = None,
    workers: Workers = 1,
    progress: bool = True,
) -> Outcome:
    """Make a release's shards again from its manifest alone, bit for bit: to repair, to check, or into `out`.

    Args:
      manifest: a manifest's file or the name of a shipped one, instead of a release; needs `out`.
      check: compare digests and change nothing.

    Raises:
      DmcvbError: there is no such release, or its shards cannot be made here.
    """
    from dmcvb_gen.generate.regenerate import Regeneration
    from dmcvb_gen.generate.shipped import manifest_source

    if (release is None) == (manifest is None) or (manifest is not None and not out) or (check and out):
        raise DmcvbError("give a release, or a manifest with out=FOLDER; give check or out, not both")
    videos = None if backgrounds is None else str(backgrounds)
    with contextlib.ExitStack() as stack:
        source = stack.enter_context(manifest_source(manifest)) if manifest is not None else release
        assert source is not None
        bar = stack.enter_context(_bar(progress, " frames"))
        work = Regeneration(source, _names(only), episodes, videos, device, workers)
        return work.remake(out, bar) if out else work.check(bar) if check else work.repair(bar)


def verify(
    release: str | Path,
    *,
    everything: bool = False,
    backgrounds: str | Path | None = None,
    workers: Workers | None = None,
    storage_options: dict[str, Any] | None = None,
    progress: bool = True,
) -> Verification:
    """Check that a release is what it says; at a URL manifest, index, commit records and a sample of files.

    Args:
      everything: at a URL, read every file.
      workers: 1 process by default; at a URL 8 parallel downloads.

    Raises:
      DmcvbError: there is no release, nothing is committed, or an option has no effect there.
    """
    from dmcvb_gen.release.verify import verify as run
    from dmcvb_gen.release.verify_url import WORKERS, verify_url
    from dmcvb_gen.storage.remote import is_url

    if is_url(str(release)):
        if backgrounds is not None or not isinstance(workers, int | None):
            raise DmcvbError("backgrounds and Ray have no effect at a URL, where nothing is painted: remove them")
        with _bar(progress, " files") as bar:
            downloads = workers if isinstance(workers, int) else WORKERS
            return verify_url(str(release), storage_options, everything, bar, downloads)
    if everything or storage_options:
        raise DmcvbError(f"{release} is no URL, and is read whole: remove everything and storage_options")
    with _bar(progress, " checks") as bar:
        return run(release, None if backgrounds is None else str(backgrounds), bar, workers or 1)


def publish(
    release: str | Path,
    url: str,
    *,
    pixels: bool = True,
    take_over: bool = False,
    workers: int = 8,
    storage_options: dict[str, Any] | None = None,
    progress: bool = True,
) -> Moved:
    """Put a complete release, or an export, at a URL: every file checked, the manifest last.

    Args:
      pixels: False publishes without images.
      take_over: publish even if another upload has claimed the URL.
      workers: parallel transfers.

    Raises:
      StoreError: the release is not complete or damaged, another version is there, or access is refused.
    """
    from dmcvb_gen.release.publish import publish_folder

    with _bar(progress, " files") as bar:
        given = dict(pixels=pixels, take_over=take_over, options=storage_options, workers=workers)
        return publish_folder(release, url, tick=bar, **given)  # type: ignore[arg-type]


def fetch(
    url: str,
    out: str | Path,
    *,
    only: Names = (),
    episodes: tuple[int, int] | None = None,
    paint: bool = False,
    size: int | None = None,
    views: Names | None = None,
    goal: str | None = None,
    workers: int = 8,
    storage_options: dict[str, Any] | None = None,
    progress: bool = True,
) -> ReleaseReader:
    """Download a published release, or a part of it, and open it.

    Args:
      episodes: (first, last + 1): the shards that hold any of them.
      paint: render the images of each shard as it arrives; `size`, `views` and `goal` are its.
      workers: parallel transfers.

    Raises:
      DmcvbError: no release is there, a file is not what its digest says, `out` holds something else, or no room.
    """
    import os

    from dmcvb_gen.loaders.release import open_for_reading
    from dmcvb_gen.release.fetch import fetch as run
    from dmcvb_gen.release.fetch import fetch_and_paint

    given: dict[str, Any] = dict(options=storage_options, workers=workers)
    if not paint and (size or views or goal):
        raise DmcvbError("size, views and goal say what to paint: add paint=True")
    with _bar(progress, "B") as moved, _bar(progress and paint, " frames") as painted:
        if paint:
            config = _render_config(size, views, goal, None, os.cpu_count() or 1, "cpu", painted)
            fetch_and_paint(url, out, _names(only), episodes, painter=config, tick=moved, **given)
        else:
            run(url, out, _names(only), episodes, tick=moved, **given)
    return open_for_reading(str(out))


def export(
    release: str | Path,
    to: str,
    out: str | Path,
    *,
    only: Names = (),
    episodes: tuple[int, int] | None = None,
    merge: bool = False,
    video: bool = False,
    workers: Workers = 1,
    storage_options: dict[str, Any] | None = None,
    progress: bool = True,
) -> list[Path]:
    """Write subsets in another format ("hdf5", "minari", "lerobot", "rlds", "rerun", ...); the folders.

    Args:
      release: a folder or URL.
      episodes: (first, last + 1); all by default.
      merge: lerobot: all subsets as the tasks of one data set.
      video: lerobot: images as mp4.

    Raises:
      DmcvbError: no such format or subset, or a package is not installed.
    """
    from dmcvb_gen.release.export import export as run

    given: dict[str, Any] = dict(merge=merge, video=video, workers=workers, storage_options=storage_options)
    with _bar(progress, " episodes") as bar:
        return run(str(release), to, out, _names(only), episodes, tick=bar, **given)


def validate(
    release: str | Path,
    *,
    profile: str = "smoke",
    benchmarks: Names = ("b1",),
    agents: Names = (),
    only: Names = (),
    out: str | Path | None = None,
    checks_only: bool = False,
    train_unsound: bool = False,
    workers: Workers | None = None,
    progress: bool = True,
    **options: Any,
) -> Validation:
    """Check a release, run the paper's benchmarks on it and write a report.

    Args:
      profile: "smoke" (no scores), "brief", "quick" or "paper".
      benchmarks: "b1", "b2", "b3", "ablations".
      agents: instead of each benchmark's own, e.g. "bc", "id+bc"; "module:name" is an agent of your own.
      out: folder of the report, by default reports/<the release's folder>.
      checks_only: check the structure and train nothing.
      options: scale, seed, threads, device, precision, compile, memory, dino_weights, backgrounds: as the command's.

    Raises:
      DmcvbError: there is no release, a name is unknown, or the release has no data for a benchmark.
    """
    from dmcvb_gen.benchmarks.run import default_workers
    from dmcvb_gen.benchmarks.validate import Progress, make_setup
    from dmcvb_gen.benchmarks.validate import validate as run

    chosen = workers or default_workers(options.get("device", "cpu"))
    setup = make_setup(release, out=out, profile=profile, workers=chosen, training=not checks_only, **options)
    with _bar(progress, " checks", "structure") as checks, _bar(progress and not checks_only, " steps") as steps:
        told = Progress(checking=checks, total=steps.expect, training=steps.told)
        return run(
            release,
            setup,
            benchmarks=() if checks_only else _names(benchmarks),
            agents=_names(agents),
            patterns=_names(only),
            workers=chosen,
            train_unsound=train_unsound,
            progress=told,
        )


# -- what they share ------------------------------------------------------------------------------


def _names(value: Names) -> tuple[str, ...]:
    """One name or several -> several."""
    return (value,) if isinstance(value, str) else tuple(map(str, value))


def _render_config(size, views, goal, backgrounds, workers, device, bar) -> Any:
    from dmcvb_gen.generate.paint import RenderConfig, RenderOverrides
    from dmcvb_gen.generate.request import background_source

    overrides = RenderOverrides(size, None if views is None else _names(views), goal)
    videos = None if backgrounds is None else background_source(backgrounds)
    return RenderConfig(overrides, workers, device, videos, bar)


class _Bar:
    """A progress callback that draws a bar, also in a notebook."""

    def __init__(self, bar: Any):
        self._bar = bar

    def __call__(self, done: int | str = 1) -> None:
        if isinstance(done, str):
            self._bar.set_description(done, refresh=False)
        self._bar.update(1 if isinstance(done, str) else done)

    def expect(self, count: float) -> None:
        self._bar.total = count
        self._bar.refresh()

    def told(self, what: str, steps: int) -> None:
        self._bar.set_description(what, refresh=False)
        self._bar.update(steps)


@contextlib.contextmanager
def _bar(shown: bool, unit: str, name: str | None = None) -> Iterator[_Bar]:
    from tqdm.auto import tqdm

    with tqdm(disable=not shown, unit=unit, unit_scale=True, desc=name) as bar:
        yield _Bar(bar)
