"""Parse a recipe and list its subsets.

::

    name: my-release            # the release's name and version, for its card
    version: 1.0.0
    seed: 0
    size: 64                    # pixels a side
    subsets:                    # every task x level x setting of each entry
      - tasks: [walker-walk, cheetah-run]
        levels: [expert, medium]
        settings: [none, static, dynamic]
        episodes: 20
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from dmcvb_gen.dataset.manifest import MAX_EPISODES, MAX_SHARDS
from dmcvb_gen.errors import RecipeError, UnknownNameError
from dmcvb_gen.files import read_yaml
from dmcvb_gen.rendering.base import check_size
from dmcvb_gen.spec import (
    ANT_MAZE,
    FIXED,
    LOCOMOTION,
    DistractorSetting,
    SubsetSpec,
    distractor_kinds,
    is_maze,
    parse_setting,
)
from dmcvb_gen.storage.places import local_path
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.base import Task

DEFAULT_EPISODES_PER_SHARD = {LOCOMOTION: 50, ANT_MAZE: 10}
"""Episodes a shard: what a worker holds in memory and what a crash can cost."""
NATIVE = "native"
"""The renderer of the package itself, which draws the same bits everywhere."""
COMMAND_LINE = "command line"
"""Where a recipe comes from that options alone describe."""
MAX_STEPS = 5000
"""Longest episode that a recipe may ask for; a shard is held in memory."""
_SHIPPED = resources.files("dmcvb_gen.generate") / "data" / "recipes"


class _Model(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


def _as_tuple(value: Any) -> Any:
    return (value,) if isinstance(value, str) else value


Place = Annotated[str, pydantic.AfterValidator(os.path.expanduser)]
Names = Annotated[tuple[str, ...], pydantic.BeforeValidator(_as_tuple), pydantic.Field(min_length=1)]


class RendererChoice(_Model):
    """Which renderer paints: backend "native" or "opengl"; samples a pixel (None: the renderer's default).

    A recipe that names no backend gets it when it is resolved (`resolve.with_renderer`).
    """

    backend: str | None = None
    samples: Literal[1, 2, 4, 8] | None = None


class SubsetPattern(_Model):
    """Subsets that share everything but their names: all tasks x levels x settings.

    Attributes:
      settings: distractors for locomotion ("none", "static", "dynamic_hard", ...), goal settings for mazes
        ("visible", "hidden", "fixed").
      episodes, steps: size of each subset but those with fixed goals; give one. Steps are for tasks of fixed length.
      policies: level -> policy file or run folder, if not the bundled ones.
      deterministic: take the policies' mean actions, as DMC-VB does; false draws samples. Level random is always drawn.
      max_steps: steps at which the time limit ends an episode, if not the task's own (500, mazes 600).
      fixed_goals, episodes_per_goal: size of a subset with the setting "fixed" (benchmark B3).
    """

    tasks: Names
    levels: Names
    settings: Names
    episodes: int | None = pydantic.Field(default=None, gt=0)
    steps: int | None = pydantic.Field(default=None, gt=0)
    episodes_per_shard: int | None = pydantic.Field(default=None, gt=0, le=1000)
    policies: dict[str, Place] = {}
    deterministic: bool = True
    max_steps: int | None = pydantic.Field(default=None, gt=0, le=MAX_STEPS)
    fixed_goals: int = pydantic.Field(default=5, gt=0)
    episodes_per_goal: int = pydantic.Field(default=10, gt=0)


class Recipe(_Model):
    """A recipe: everything that a release is made from.

    Attributes:
      seed: seed of every random stream.
      size: pixels a side.
      action_repeat: control steps for which an action is held; release's recipes leave out 2.
      trajectories: "shared": the settings of a task and level show the same episodes; "independent": each its own.
      backgrounds: "builtin" or a folder of videos.
      split: which videos (and maze styles): "train" for data, "val" for evaluation.
    """

    name: str = pydantic.Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    version: str = pydantic.Field(default="1.0.0", pattern=r"^\d+\.\d+\.\d+$")
    description: str = ""
    license: str = "CC-BY-4.0"
    authors: tuple[str, ...] = ()
    seed: int = pydantic.Field(default=0, ge=0)
    size: int = 64
    action_repeat: Literal[1, 2, 4] = 2
    renderer: RendererChoice = RendererChoice()
    trajectories: Literal["shared", "independent"] = "shared"
    backgrounds: Place = "builtin"
    split: Literal["train", "val"] = "train"
    subsets: tuple[SubsetPattern, ...] = pydantic.Field(min_length=1)

    @pydantic.model_serializer(mode="wrap")
    def _without_usual_repeat(self, write: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Recipes of DMC-VB's action repeat stay as they were before others could be had, and so their digests."""
        return {name: value for name, value in write(self).items() if (name, value) != ("action_repeat", 2)}


class SubsetRequest(_Model):
    """One subset of a recipe, names checked.

    Attributes:
      name: "<task>/<level>/<setting>".
      episodes_per_shard: None: nearly equal shards, of at most `DEFAULT_EPISODES_PER_SHARD`.
      policy: its policy's file or run folder; None for the bundled ones (or random).
    """

    name: str
    task: str
    level: str
    setting: str
    episodes: int
    max_steps: int
    episodes_per_shard: int | None = None
    policy: str | None = None
    deterministic: bool = False
    episodes_per_goal: int | None = None


def expand(recipe: Recipe) -> tuple[SubsetRequest, ...]:
    """All subsets that a recipe asks for, in its order.

    Raises:
      RecipeError, UnknownNameError: a name, a size or a count that makes no sense.
    """
    check_size(recipe.size)
    requests: dict[str, SubsetRequest] = {}
    for pattern in recipe.subsets:
        for task_id in pattern.tasks:
            task = get_task(task_id).at(recipe.action_repeat)
            for level in pattern.levels:
                for setting in pattern.settings:
                    spec = SubsetSpec.parse(task_id, level, setting)
                    if spec.name in requests and requests[spec.name].task != task_id:
                        raise RecipeError(f"two mazes are called {spec.name.split('/')[0]}; rename the layout of one")
                    if spec.name in requests:
                        raise RecipeError(f"recipe {recipe.name!r} asks for {spec.name} twice; keep one of the entries")
                    requests[spec.name] = _request(pattern, task, spec)
    for pattern in recipe.subsets:
        for level in pattern.policies.keys() - {*pattern.levels} | pattern.policies.keys() & {"random"}:
            raise RecipeError(f"the policy of level {level!r} has no use in this recipe; remove it from policies")
    if (episodes := sum(request.episodes for request in requests.values())) > MAX_EPISODES:
        raise RecipeError(f"recipe {recipe.name!r} comes to {episodes:,} episodes; a release may have {MAX_EPISODES:,}")
    if (shards := sum(map(_shards, requests.values()))) > MAX_SHARDS:
        raise RecipeError(
            f"recipe {recipe.name!r} comes to {shards:,} shards, and a release may have {MAX_SHARDS:,}; give more "
            "episodes_per_shard, or fewer episodes"
        )
    return tuple(requests.values())


def _shards(request: SubsetRequest) -> int:
    most = request.episodes_per_shard or DEFAULT_EPISODES_PER_SHARD[get_task(request.task).family]
    return -(-request.episodes // most)


def _request(pattern: SubsetPattern, task: Task, spec: SubsetSpec) -> SubsetRequest:
    name, level, setting = spec.name, spec.level.value, spec.setting
    per_goal, max_steps = None, pattern.max_steps or task.max_steps
    if task.ends_itself and max_steps > task.max_steps:
        raise RecipeError(f"{name}: {task.id} ends its episodes after {task.max_steps} steps; give no more max_steps")
    if setting == FIXED:
        episodes, per_goal = pattern.fixed_goals * pattern.episodes_per_goal, pattern.episodes_per_goal
    elif pattern.episodes is not None and pattern.steps is not None:
        raise RecipeError(f"{name}: give episodes or steps, not both")
    elif pattern.episodes is not None:
        episodes = pattern.episodes
    elif pattern.steps is None:
        raise RecipeError(f"{name}: say how much: episodes: N (or steps: N)")
    elif spec.goal is not None:
        raise RecipeError(f"{name}: maze episodes vary in length, so give episodes: N instead of steps")
    else:
        episodes = -(-pattern.steps // max_steps)
    return SubsetRequest(
        name=name,
        task=task.id,
        level=level,
        setting=setting,
        episodes=episodes,
        episodes_per_shard=pattern.episodes_per_shard,
        policy=pattern.policies.get(level),
        max_steps=max_steps,
        deterministic=pattern.deterministic and level != "random",
        episodes_per_goal=per_goal,
    )


# -- a recipe made smaller or otherwise -----------------------------------------------------------


def narrow(
    recipe: Recipe, tasks: Sequence[str] = (), levels: Sequence[str] = (), settings: Sequence[str] = ()
) -> Recipe:
    """The recipe of the subsets that have one of the tasks, one of the levels and one of the settings.

    Args:
      tasks, levels, settings: all that the recipe has if nothing is given.

    Raises:
      UnknownNameError: the recipe has no such task, level or setting.
      RecipeError: no subset has all of them.
    """
    wanted = {"tasks": tasks, "levels": levels, "settings": settings}
    for field, given in wanted.items():
        known = {_canonical(value) for pattern in recipe.subsets for value in getattr(pattern, field)}
        for value in given:
            if value not in known:
                raise UnknownNameError(f"{field[:-1]} of recipe {recipe.name}", value, known)
    patterns = []
    for pattern in recipe.subsets:
        kept = {
            field: tuple(v for v in getattr(pattern, field) if not given or _canonical(v) in given)
            for field, given in wanted.items()
        }
        if all(kept.values()):
            policies = {level: path for level, path in pattern.policies.items() if level in kept["levels"]}
            patterns.append(pattern.model_copy(update=kept | {"policies": policies}))
    if not patterns:
        given = ", ".join([*tasks, *levels, *settings])
        raise RecipeError(f"recipe {recipe.name!r} has no subset that is {given} at once; see them with --dry-run")
    return recipe.model_copy(update={"subsets": tuple(patterns)})


def _canonical(setting: str) -> str:
    """ "dynamic_medium" -> "dynamic"; what is no distractor stays."""
    return DistractorSetting.parse(setting).name if setting.split("_")[0] in distractor_kinds() else setting


SUBSET_FIELDS = ("episodes", "episodes_per_shard", "deterministic", "max_steps", "fixed_goals")


def override(recipe: Recipe, **changes: Any) -> Recipe:
    """The recipe with other values: its own fields, and fields of all its subsets that they mean something for.

    Args:
      changes: fields of `Recipe` or `SubsetPattern`; `episodes` takes the place of `steps`, and
        is shared among the fixed goals of a subset that has some (rounded up); `behaviour`: the policy of the one task
        and level that the recipe has.

    Raises:
      RecipeError: a value that is wrong, or that means nothing for this recipe.
    """
    own = {name: value for name, value in changes.items() if name in Recipe.model_fields}
    each = {name: value for name, value in changes.items() if name in SUBSET_FIELDS}
    if "episodes" in each:
        each["steps"] = None
    if "behaviour" in changes:
        each["policies"] = {_one_level(recipe): changes["behaviour"]}
    data = recipe.model_dump(mode="json") | own
    data["subsets"] = [part for pattern in data["subsets"] for part in _overridden(pattern, each)]
    return make_recipe(data, COMMAND_LINE)


def _overridden(pattern: dict[str, Any], each: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A pattern with other values; fixed goals, which count in another way, become a pattern of their own."""
    others = [setting for setting in pattern["settings"] if setting != FIXED]
    parts = [pattern | {key: value for key, value in each.items() if key != "fixed_goals"} | {"settings": others}]
    if FIXED in pattern["settings"]:
        changed = {key: value for key, value in each.items() if key not in ("episodes", "steps")}
        part = pattern | changed | {"settings": [FIXED]}
        if count := each.get("episodes"):
            part["episodes_per_goal"] = -(-count // part["fixed_goals"])
        parts.append(part)
    return [part for part in parts if part["settings"]]


def _one_level(recipe: Recipe) -> str:
    tasks = {task for pattern in recipe.subsets for task in pattern.tasks}
    levels = {level for pattern in recipe.subsets for level in pattern.levels}
    if len(tasks) != 1 or len(levels) != 1 or levels == {"random"}:
        raise RecipeError("--behaviour needs one task and one --level of expert, medium or mixed")
    return levels.pop()


def check_options_used(recipe: Recipe, given: Collection[str]) -> None:
    """Raise RecipeError for an option that changes nothing in any subset of a recipe.

    Args:
      given: options of `dmcvb-gen rollout`, with underscores: "backgrounds", "split", "sample", "independent".
    """
    subsets = [(t, level, s) for p in recipe.subsets for t in p.tasks for level in p.levels for s in p.settings]
    for task, _, _ in subsets:
        get_task(task)  # a wrong name is told before its settings are
    videos = any(parse_setting(task, setting)[0].shows_videos for task, _, setting in subsets)
    mazes = {is_maze(task) for task, _, _ in subsets}
    cures = {
        "backgrounds": (videos, "no subset shows videos; ask for --distractor static or dynamic"),
        "split": (videos or True in mazes, "no subset shows videos; ask for --distractor static or dynamic"),
        "sample": (any(level != "random" for _, level, _ in subsets), "level random is always drawn; ask for another"),
        "independent": (False in mazes, "subsets of mazes always have their own episodes"),
    }
    for name, (heard, cure) in cures.items():
        if name in given and not heard:
            raise RecipeError(f"--{name} has no effect here: {cure}, or remove it")


# -- recipes in files -----------------------------------------------------------------------------


def shipped_recipes() -> tuple[str, ...]:
    """Names of the recipes in the package."""
    return tuple(sorted(path.name.removesuffix(".yaml") for path in _SHIPPED.iterdir() if path.name.endswith(".yaml")))


def load_recipe(source: str | Path) -> Recipe:
    """A recipe from a YAML file, or a shipped one by its name.

    Raises:
      UnknownNameError: a plain name that is no shipped recipe's.
      RecipeError: no such file, not YAML, or a field that is unknown or wrong (named, with what was expected).
    """
    path = local_path(source)
    if not path.is_file() and not path.suffix and path.name == str(source) and str(source) not in shipped_recipes():
        raise UnknownNameError("recipe", source, shipped_recipes())
    shipped = not path.is_file() and str(source) in shipped_recipes()
    try:
        data = read_yaml(_SHIPPED / f"{source}.yaml" if shipped else path)
    except OSError as error:
        raise RecipeError(
            f"cannot read recipe {str(source)!r} ({error.strerror}); give a YAML file or one of the shipped: "
            + ", ".join(shipped_recipes())
        ) from None
    except ValueError as error:
        raise RecipeError(f"{source}: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict):
        raise RecipeError(f"{source} holds no recipe; begin it with `name: mine` and `subsets:`, see docs/recipes.md")
    return make_recipe(data, str(source))


def make_recipe(data: dict[str, Any], where: str = "recipe") -> Recipe:
    """A recipe from plain values.

    Raises:
      RecipeError: a field is unknown or wrong.
    """
    try:
        return Recipe.model_validate(data)
    except pydantic.ValidationError as error:
        # A misspelt field is why another one is missing, so it comes first.
        first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
        place, told = first["loc"], first["msg"]
        if first["type"] == "extra_forbidden":
            model = Recipe if len(place) == 1 else SubsetPattern if place[0] == "subsets" else RendererChoice
            told = str(UnknownNameError("field", place[-1], model.model_fields))
        if where == COMMAND_LINE:  # a recipe's fields have the names of the options
            raise RecipeError(f"--{str(place[-1]).replace('_', '-')} is {first['input']!r}: {told}") from None
        raise RecipeError(f"{where}: {'.'.join(map(str, place)) or 'the top'}: {told}") from None
