"""Plan and run a rollout: a recipe and a place go in; works, and in the end the release, come out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen.dataset.gate import Release, read_recipes
from dmcvb_gen.dataset.manifest import COPY
from dmcvb_gen.dataset.writer import begin, check_agree, check_versions, finish, write_provenance
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.executors import run_works
from dmcvb_gen.generate.recipe import Recipe
from dmcvb_gen.generate.request import RECIPE_OPTIONS, make_request
from dmcvb_gen.generate.resolve import Resolution, resolve
from dmcvb_gen.generate.works import Work, check_makeable, episodes_left, works_of
from dmcvb_gen.options import refuse
from dmcvb_gen.parallel import ProgressCallback, Workers, ignore
from dmcvb_gen.storage.store import Store, open_store
from dmcvb_gen.text import as_names


@dataclass(frozen=True)
class Plan:
    """Everything a rollout will do.

    Attributes:
      release: what is asked for, and where.
      resolution: the recipe; None to go on with what is there.
      works: what is left to do.
      chosen: subset -> episodes that this rollout is about, whether they are there or not.
      there: whether a release is there already.
    """

    release: Release
    resolution: Resolution | None
    works: tuple[Work, ...]
    chosen: Mapping[str, int]
    there: bool

    @property
    def unit(self) -> str:
        """What a progress bar counts: frames, or steps if no images are rendered."""
        return "frames" if any(work.images for work in self.works) else "steps"


def plan_of(options: Mapping[str, Any]) -> Plan:
    """The plan of the arguments of `rollout` by name; None, False or empty if they are not given.

    Raises:
      DmcvbError: anything that would fail later, found before any work.
    """
    request = request_of(options)
    place = options["out"] or str(Path("releases") / request.name if request else "")
    store = open_store(place, options["storage_options"])
    return make_plan(request, store, as_names(options["only"]), options["episode_range"], pixels=options["pixels"])


def request_of(options: Mapping[str, Any]) -> Recipe | None:
    """The recipe that the options ask for; None resumes the release at `out`.

    Raises:
      DmcvbError: an unknown name, a value that is wrong, or an option that would have no effect.
    """
    given = {name: value for name, value in options.items() if name in RECIPE_OPTIONS and _is_given(value)}
    tasks, recipe = as_names(options["tasks"]), options["recipe"]
    if options["out"] and not (tasks or recipe or given):
        refuse("a release goes on as it was begun", no_pixels=not options["pixels"])
        return None
    return make_request(tasks, recipe, **given)


def _is_given(value: Any) -> bool:
    return value is not None and value is not False and value not in ((), [])


def make_plan(
    recipe: Recipe | None,
    out: str | Path | Store,
    only: Sequence[str] = (),
    episodes: tuple[int, int] | None = None,
    part: tuple[int, int] = (1, 1),
    pixels: bool = True,
) -> Plan:
    """Check a recipe and list its works.

    Args:
      recipe: None goes on with the release that is there, from its own recipes.
      out: the release's folder, URL or store; what is there already is left out of the works.
      only: subset patterns such as "walker-walk/*/static"; a part of the recipe is rolled out.
      episodes: (first, last + 1) of a part of each subset; the shards that hold any of them are rolled out.
      part: see `works_of`.
      pixels: store images; without, `generate.paint` can add them later.

    Raises:
      DmcvbError: anything that would fail later, found before any work.
    """
    store = out if isinstance(out, Store) else open_store(out)
    if not store.writable:
        raise store.read_only()
    if store.size(COPY) is not None:
        raise StoreError(f"{store.place} is a copy of a release and does not grow; choose another --out")
    old = read_recipes(store)
    there = Release.in_making(store) if old else None
    if recipe is not None:
        resolution = resolve(recipe, there, pixels)
        check_agree([*old, resolution.resolved])
        release = Release(store, resolution.resolved, None, False, None)
    elif there is not None:
        resolution, release = None, there
    else:
        raise StoreError(f"{store.place} holds no release to go on with; give TASKs or --recipe")
    works = works_of(release, only, episodes, part=part)
    check_makeable(release.manifest, {setting.record.name for work in works for setting in work.settings})
    everything = works_of(release, only, episodes, wanted=lambda layer, shard: True)
    return Plan(release, resolution, works, episodes_left(everything), there is not None)


def start(plan: Plan, other_versions: bool = False, command: str = "rollout") -> None:
    """Create the release: its recipe, policies and videos; or get it ready to go on.

    Args:
      other_versions: go on although packages have other versions here than where the release was begun.

    Raises:
      StoreError: what is there contradicts this recipe or was begun with other versions, or it cannot be written.
    """
    if plan.works and plan.there and not other_versions:
        check_versions(plan.release.store)
    if plan.resolution is not None:
        begin(plan.release.store, plan.resolution.resolved, plan.resolution.files)
    if plan.works or not plan.there:
        write_provenance(plan.release.store, command)


def run_plan(
    plan: Plan, workers: Workers | None = None, progress: ProgressCallback = ignore, *, finishing: bool = True
) -> tuple[Release, int]:
    """Make every shard of a plan, and write the manifest of subsets that are whole.

    Args:
      plan: started by `start`.
      workers: see `run_works`.
      progress: called with the number of frames rendered since the last call.
      finishing: write the manifest; False for a part, because other machines make the rest.

    Returns:
      The release as it is now, and the number of transitions that were made now.

    Raises:
      StoreError: the disk is full, or another machine has put other bytes.
    """
    steps = sum(result.steps for result in run_works(plan.works, workers, progress))
    return finish(plan.release.store) if finishing else plan.release, steps
