"""The functions that make data: `dmcvb_gen.rollout(...)` does what `dmcvb-gen rollout ...` does.

The options of a command are made from its function: types and defaults from the signature, help from "Args:" in the
docstring (`dmcvb_gen.cli.options` says how). A call that was interrupted resumes if it is made again.
"""

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from annotated_types import Ge, Gt, Lt

from dmcvb_gen.errors import DmcvbError, StoreError
from dmcvb_gen.options import Count, Local, Location, Names, Samples, Seed, Span, Split, checked, progress_bar
from dmcvb_gen.parallel import Workers
from dmcvb_gen.spec import SubsetSpec, is_maze, subset_name
from dmcvb_gen.text import as_names, quoted

if TYPE_CHECKING:
    from dmcvb_gen.generate.paint import RenderResult
    from dmcvb_gen.generate.regenerate import Outcome
    from dmcvb_gen.loaders.release import ReleaseReader


@checked
def rollout(
    tasks: Names = (),
    *,
    recipe: Location | None = None,
    only: Names = (),
    levels: Names = (),
    distractors: Names = (),
    goals: Names = (),
    episodes: Count | None = None,
    max_steps: Count | None = None,
    action_repeat: Literal[1, 2, 4] | None = None,
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
    workers: Workers | None = None,
    episodes_per_shard: Count | None = None,
    out: Location | None = None,
    storage_options: dict[str, Any] | None = None,
    other_versions: bool = False,
    progress: bool = True,
) -> "ReleaseReader":
    """Roll out behaviour policies into a release of episodes, and open it.

    `dmcvb_gen.rollout("walker-walk", levels="expert", distractors="dynamic", episodes=4, out="releases/demo")`

    With a recipe, tasks, levels, distractors and goals select a part of it, and other arguments override its values.
    Without tasks and recipe, the release at `out` resumes from its own recipes.

    Args:
      tasks (TASK): Tasks, all of one family; a maze of your own by its text file.
      recipe (FILE|NAME): Recipe: a YAML file or the name of a shipped one.
      only (PATTERN): Roll out only these subsets, e.g. 'walker-walk/*/static'.
      levels: expert, medium, mixed, random. [default: expert]
      distractors: none, static, dynamic, or at a strength: dynamic_hard, dynamic_camera0.1. [default: none]
      goals: Mazes: visible, hidden, fixed, or fixed3 for 3 fixed pairs of start and goal. [default: visible]
      episodes: Episodes per subset; fixed goals share them. [default: 20]
      max_steps: Longest episode, in steps, at most 5000. [default: 500, mazes 600, at action repeat 2]
      action_repeat: Control steps for which an action is held. [default: 2]
      episode_range (RANGE): Generate only the shards with episodes A to B - 1.
      seed: Random seed of the release. [default: 0]
      size: Width and height of the images, 8 to 1024 pixels. [default: 64]
      renderer: native or opengl. [default: native]
      samples: Samples per pixel; native has 4. [default: 4]
      backgrounds: Background videos: builtin, or a folder. [default: builtin]
      split: Background videos and maze styles: train or val. [default: train]
      behaviour (BEHAVIOUR): Policy instead of the bundled one: a policy file, a training run, an SB3
        zip, a torch state dict (.pt), or a function of your own.
      sample: Sample actions instead of using the policy mean.
      pixels: False: Store no images; `paint` renders them later.
      independent: Simulate separate episodes for each distractor.
      workers: Worker processes. [default: a core each, as far as memory allows]
      episodes_per_shard: Episodes per shard. [default: at most 50, mazes 10]
      out: Folder or URL (s3://bucket/name, gs://, ...). [default: releases/NAME]
      storage_options (NAME=VALUE): Option for the file system (fsspec), e.g. endpoint_url=http://localhost:9000.
      other_versions: Resume even if package versions have changed.

    Raises:
      DmcvbError: an unknown name, a value that is wrong, an option that would have no effect, or no room.
    """
    options = locals()
    from dmcvb_gen.generate.counts import check_room
    from dmcvb_gen.generate.plan import plan_of, run_plan, start
    from dmcvb_gen.loaders.release import ReleaseReader

    plan = plan_of(options)
    check_room(plan)
    start(plan, other_versions)
    with progress_bar(progress, f" {plan.unit}", plan.release.manifest.name) as bar:
        run_plan(plan, workers, bar)
    return ReleaseReader.open(plan.release.place if out is None else str(out), storage_options)


class Made(NamedTuple):
    """Data and the environment that matches them; `val` has the episodes that are held out of `train`."""

    env: Any
    train: Any
    val: Any


@checked
def make(
    name: str,
    *,
    episodes: Annotated[int, Ge(2)] | None = None,
    release: Location | None = None,
    held_out: Annotated[float, Gt(0), Lt(1)] = 0.1,
    seed: Seed = 0,
    environment: dict[str, Any] | None = None,
    **options: Any,
) -> Made:
    """Data and their environment: `env, train, val = dmcvb_gen.make("walker-walk/expert/dynamic", episodes=200)`.

    The data are made at the first call, in a folder of the user's cache, and read from there afterwards. With `release`
    nothing is made.

    Args:
      name: TASK/LEVEL/SETTING; a level may be a union ("medium-expert").
      episodes: Episodes, of each level. [default: those of `rollout`, or all of the release]
      release: Folder or URL of a release to read.
      held_out: Share of the episodes that `val` has; both have one at least.
      seed: Random seed of the data, and of the choice of those episodes.
      environment: Options of `SubsetReader.environment`: stack, split, num_envs, ...
      options: Options of `rollout` for the data: size, max_steps, renderer, workers, ...

    Raises:
      DmcvbError: no such task, level or setting, or the release does not hold them.
    """
    import numpy as np

    from dmcvb_gen.generate.request import EPISODES
    from dmcvb_gen.loaders.release import ReleaseReader
    from dmcvb_gen.loaders.union import UnionReader
    from dmcvb_gen.tasks import typed_task

    try:
        task, level, setting = name.rsplit("/", 2)
    except ValueError:
        raise DmcvbError(f"{name!r} names no subset; give TASK/LEVEL/SETTING: walker-walk/expert/dynamic") from None
    task = typed_task(task)
    name = subset_name(task, level, setting)
    if release is not None:
        if options:
            raise DmcvbError(f"{min(options)} has no effect: with a release, nothing is made; remove it")
        opened = ReleaseReader.open(str(release))
    else:
        if taken := options.keys() & {"tasks", "levels", "distractors", "goals", "out"}:
            raise DmcvbError(f"make() decides {min(taken)} by the name {name!r}; remove it, or call rollout()")
        levels = level.split("-")
        setting = [SubsetSpec.parse(task, one, setting).setting for one in levels][0]
        name, episodes = subset_name(task, level, setting), episodes or EPISODES
        options |= {"goals" if is_maze(task) else "distractors": setting, "seed": seed}
        opened = _cached(task, tuple(levels), episodes, options)
    train, val = [], []
    for part in opened.parts_of(name) or [name]:
        subset = opened[part]
        if len(subset) < (episodes or 0):
            raise DmcvbError(f"{part} of {opened.place} has {len(subset)} of {episodes} episodes; give fewer")
        order = np.random.default_rng(seed).permutation(subset.episodes[:episodes])
        if len(order) < 2:
            raise DmcvbError(f"{part} has {len(order)} episodes; give 2 or more, for train and val")
        count = min(max(1, round(held_out * len(order))), len(order) - 1)
        train.append(subset.part(np.sort(order[count:])))
        val.append(subset.part(np.sort(order[:count])))
    learned, held = (one[0] if len(one) == 1 else UnionReader(opened, one) for one in (train, val))
    return Made(learned.environment(**environment or {}), learned, held)


def _cached(task: str, levels: tuple[str, ...], episodes: int | None, options: dict[str, Any]) -> "ReleaseReader":
    """Roll a task out in the user's cache; a folder for each choice of options but the number of episodes."""
    from dmcvb_gen.policies.archives import cache_folders

    leave_out = ("workers", "progress", "other_versions")
    decide = {key: str(value) for key, value in options.items() if key not in leave_out}
    for key in decide.keys() & {"backgrounds", "behaviour"}:
        path = Path(decide[key])
        decide[key] = str(path.absolute() if path.exists() else path)  # the same words mean others elsewhere
    mark = hashlib.sha256(json.dumps([task, levels, decide], sort_keys=True).encode()).hexdigest()[:12]
    folder = cache_folders()[0].parent / "made" / mark
    try:
        return rollout((task,), levels=levels, episodes=episodes, out=folder, **options)
    except StoreError as error:
        raise StoreError(f"{error}; make() keeps its data in {quoted(folder)}, which may be removed") from None


@checked
def paint(
    release: Location,
    *,
    only: Names = (),
    episode_range: Span | None = None,
    size: Count | None = None,
    views: Names | None = None,
    workers: Workers | None = None,
    backgrounds: Location | None = None,
    progress: bool = True,
) -> "RenderResult":
    """Render the images of a release that has none, and compare them with their known digests.

    Args:
      release: Folder of the release.
      only (PATTERN): Render only these subsets.
      episode_range (RANGE): Use only the shards with episodes A to B - 1.
      size: Width and height, 8 to 1024 pixels. [default: the manifest's]
      views (A,B): Mazes: render only these views, e.g. egocentric. [default: all]
      workers: Worker processes. [default: a core each, as far as memory allows]
      backgrounds (FOLDER): Folder of the background videos, if the release has no copies.

    Raises:
      DmcvbError: nothing matches, a shard is damaged, or the videos are not those of the manifest; a URL is given.
    """
    from dmcvb_gen.generate.paint import Wanted, paint_release
    from dmcvb_gen.generate.request import background_source
    from dmcvb_gen.storage.places import local_path

    wanted = Wanted(size, None if views is None else as_names(views))
    videos = None if backgrounds is None else background_source(backgrounds)
    with progress_bar(progress, " frames") as bar:
        given: dict[str, Any] = dict(workers=workers, backgrounds=videos, progress=bar)
        return paint_release(local_path(release), as_names(only), episode_range, wanted, **given)


@checked
def repaint(
    release: Location,
    *,
    only: Names = (),
    distractor: str | None = None,
    size: int | None = None,
    renderer: str | None = None,
    samples: Samples | None = None,
    backgrounds: Location | None = None,
    split: Split | None = None,
    labels: Names = (),
    name: str | None = None,
    out: Local,
    workers: Workers | None = None,
    progress: bool = True,
) -> "ReleaseReader":
    """Give episodes new images, from their stored physics states, in a new release; open that.

    Args:
      release (RELEASE): Folder of the release.
      only (PATTERN): Render only these subsets.
      distractor: none, static, dynamic, or at a strength: dynamic_hard, dynamic_0.35. [default: the subset's own]
      size: Width and height, 8 to 1024 pixels. [default: the subset's own]
      renderer: native or opengl. [default: the subset's own]
      samples: Samples per pixel.
      backgrounds (FOLDER): Background videos: builtin, or a folder. [default: the recipe's]
      split: Background videos and maze styles. [default: the recipe's]
      labels: Also store a modality: depth, segmentation, parts, flow (optical flow to the next frame) or your own.
      name: Name of the new release. [default: NAME-repainted]
      out (FOLDER): Folder of the new release.
      workers: Worker processes. [default: a core each, as far as memory allows]

    Raises:
      DmcvbError: nothing fits, a shard is damaged, or `out` cannot be used.
    """
    from dmcvb_gen.dataset.manifest import check_name
    from dmcvb_gen.distractors.registry import typed_setting
    from dmcvb_gen.generate.repaint import Repainting
    from dmcvb_gen.generate.repaint import repaint as run
    from dmcvb_gen.generate.request import background_source
    from dmcvb_gen.loaders.release import ReleaseReader

    videos = None if backgrounds is None else background_source(backgrounds)
    setting = None if distractor is None else typed_setting(distractor)
    look = (setting, size, renderer, samples, videos, split, as_names(labels), name and check_name(name))
    with progress_bar(progress, " frames") as bar:
        run(Repainting(release, out, as_names(only), *look), workers, bar)
    return ReleaseReader.open(str(out))


@checked
def regenerate(
    release: Location | None = None,
    *,
    manifest: Location | None = None,
    only: Names = (),
    episode_range: Span | None = None,
    check: bool = False,
    out: Local | None = None,
    backgrounds: Location | None = None,
    workers: Workers | None = None,
    progress: bool = True,
) -> "Outcome":
    """Regenerate a release's shards from its manifest alone, bit for bit: to repair, to check, or into `out`.

    Args:
      release (RELEASE): Folder of the release.
      manifest (NAME|FILE): A shipped manifest, or a file of one, instead of a release.
      only (PATTERN): Regenerate only these subsets.
      episode_range (RANGE): Use only the shards with episodes A to B - 1.
      check: Compare digests and change nothing.
      out (FOLDER): Write the shards to this folder instead.
      backgrounds (FOLDER): Folder of the background videos, if it has moved.
      workers: Worker processes. [default: a core each, as far as memory allows]

    Raises:
      DmcvbError: there is no such release, or its shards cannot be made here.
    """
    from dmcvb_gen.generate.regenerate import Regeneration, remake
    from dmcvb_gen.generate.request import background_source
    from dmcvb_gen.generate.shipped import load_shipped
    from dmcvb_gen.storage.places import local_path

    if (release is None) == (manifest is None):
        raise DmcvbError("give a RELEASE, or a manifest with --manifest")
    if check and (manifest or out):
        raise DmcvbError("remove --check: with --manifest or --out, digests are always compared")
    if manifest is not None and not out:
        raise DmcvbError("a manifest alone has no shards to repair: add --out FOLDER (in Python, out=FOLDER)")
    videos = None if backgrounds is None else background_source(backgrounds)
    out = None if out is None else local_path(out)
    how = Regeneration(release or "", as_names(only), episode_range, videos, workers)
    with progress_bar(progress, " frames") as bar:
        if manifest is not None:
            assert out is not None
            return remake(load_shipped(manifest), out, None, how, bar)
        return how.remake(out, bar) if out else how.check(bar) if check else how.repair(bar)
