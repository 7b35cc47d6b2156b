"""Turn the options of a rollout into a recipe.

`dmcvb-gen rollout` and `dmcvb_gen.rollout` ask here. No option is silently ignored: those that would change nothing are
refused.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from dmcvb_gen.errors import RecipeError, UnknownNameError
from dmcvb_gen.generate.recipe import Recipe, check_options_used, load_recipe, narrow, override, single_recipe
from dmcvb_gen.own_code import BEHAVIOURS, allow, is_own
from dmcvb_gen.spec import (
    ANT_MAZE,
    DIFFICULTY_SCALES,
    FIXED,
    DistractorSetting,
    Level,
    MazeName,
    difficulty_of,
    is_maze,
    task_folder,
)
from dmcvb_gen.text import as_names

EPISODES = 20
"""Default number of episodes of a subset."""
_OVERRIDES = {"episodes", "steps", "max_steps", "episodes_per_shard"}
_OVERRIDES |= {"fixed_goals", "episodes_per_goal", "seed", "size", "split"}
_NOT_WITH_RECIPE = {
    "layouts": "--layout: name the maze by its TASK",
    "reward": "--reward: ask for 'ant-maze-...@geodesic' in the recipe",
    "difficulty": "--difficulty: ask for --distractor dynamic_hard",
    "intensity": "--intensity: ask for --distractor dynamic_0.35",
    "vary": "--vary: ask for --distractor dynamic_camera-color",
    "correlated": "--correlated: ask for --distractor dynamic_camera-color-background-cue0.8",
    "video_count": "--video-count: ask for --distractor dynamic_camera-color-background4",
}
_SEVERAL = ("levels", "distractors", "goals", "layouts", "vary")
_STRENGTHS = ("difficulty", "intensity", "vary", "video_count", "correlated")
"""Options that say how strong distractors are, and which of their parts vary."""
RECIPE_OPTIONS = _OVERRIDES | set(_NOT_WITH_RECIPE)
RECIPE_OPTIONS |= {"levels", "distractors", "goals", "sample", "renderer", "samples", "backgrounds", "behaviour"}
RECIPE_OPTIONS |= {"independent"}
"""Options that say what to make, not where or how."""


def make_request(tasks: Sequence[str] = (), recipe: str | Path | None = None, **given: Any) -> Recipe:
    """The recipe of what was asked for.

    Args:
      tasks: names; with a recipe, those that are taken of it.
      recipe: a YAML file or the name of a shipped recipe.
      given: options of `RECIPE_OPTIONS` that somebody gave, and no defaults.

    Raises:
      DmcvbError: an unknown name, a value that is wrong, or an option that would have no effect.
    """
    given = {name: as_names(value) if name in _SEVERAL else value for name, value in given.items()}
    if "distractors" in given:
        from dmcvb_gen.distractors.registry import typed_setting  # which needs MuJoCo

        given["distractors"] = tuple(map(typed_setting, given["distractors"]))
    tasks = (*tasks, *(_layout_task(layout) for layout in given.get("layouts", ())))
    allow(tasks)  # a person typed these names, so their code may run
    if not tasks and not recipe:
        raise RecipeError("give TASKs or --recipe; `dmcvb-gen list` shows the tasks and recipes")
    if given.get("steps") and given.get("episodes"):
        raise RecipeError("give --episodes or --steps, not both")
    if recipe:
        made = _changed_recipe(load_recipe(recipe), tasks, given)
    else:
        made = _recipe_from_options(tasks, given | {"renderer": given.get("renderer") or renderer_of(tasks)})
    check_options_used(made, given)
    if given.get("sample") and is_own(str(given.get("behaviour") or "")):
        raise RecipeError("--sample has no effect here: a function of your own draws by itself; remove it")
    return made


def background_source(given: str | Path) -> str:
    """--backgrounds as a recipe has it: "builtin", or an absolute folder."""
    return "builtin" if given == "builtin" else str(Path(given).resolve())


def behaviour_source(given: str | Path | None) -> str | None:
    """--behaviour as a recipe has it: an absolute path, or "<module>:<function>", whose code may then run.

    Raises:
      RecipeError: it names a Python file.
    """
    if given is None:
        return None
    if not str(given):
        raise RecipeError("behaviour is empty; leave it out to use the bundled policies")
    module, _, function = str(given).partition(":")
    if module.endswith(".py"):
        name = f"{Path(module).stem}:{function or 'FUNCTION'}"
        raise RecipeError(f"--behaviour {given} is a file; in its folder, give --behaviour {name}")
    if is_own(str(given)):
        allow([str(given)], BEHAVIOURS)  # a person typed its name
        return str(given)
    return str(Path(given).resolve())


def renderer_of(tasks: Sequence[str]) -> str:
    """The default renderer of tasks that are rolled out together: the first one that is not native, if any."""
    from dmcvb_gen.rendering import default_renderer
    from dmcvb_gen.tasks import get_task

    allow(tasks)
    chosen = [default_renderer(get_task(task)) for task in tasks]
    return next((name for name in chosen if name != "native"), "native")


def _changed_recipe(recipe: Recipe, tasks: Sequence[str], given: Mapping[str, Any]) -> Recipe:
    """A recipe, narrowed and overridden by the options that were given beside it; none is ignored."""
    for name, instead in _NOT_WITH_RECIPE.items():
        if name in given:
            raise RecipeError(f"--recipe takes no {instead} instead")
    settings = [DistractorSetting.parse(name).name for name in given.get("distractors", ())] + list(
        given.get("goals", ())
    )
    if tasks or given.get("levels") or settings:
        recipe = narrow(recipe, tasks, given.get("levels", ()), settings)
    changes = {name: given[name] for name in _OVERRIDES & given.keys()} | _sources(given)
    if "renderer" in given or "samples" in given:
        old = recipe.renderer
        backend = given.get("renderer", old.backend)
        kept = old.samples if backend == old.backend else None
        changes["renderer"] = {"backend": backend, "samples": given.get("samples", kept)}
    if given.get("sample"):
        changes["deterministic"] = False
    if given.get("independent"):
        changes["trajectories"] = "independent"
    return override(recipe, **changes) if changes else recipe


def _sources(given: Mapping[str, Any]) -> dict[str, str | None]:
    """Places of files as the recipe has them."""
    found: dict[str, str | None] = {}
    if "behaviour" in given:
        found["behaviour"] = behaviour_source(given["behaviour"])
    if "backgrounds" in given:
        found["backgrounds"] = background_source(given["backgrounds"])
    return found


def _recipe_from_options(tasks: Sequence[str], given: Mapping[str, Any]) -> Recipe:
    levels = tuple(given.get("levels") or ("random",))
    for level in levels:
        Level.parse(level)
    if len({is_maze(task) for task in tasks}) > 1:
        raise RecipeError("mazes and locomotion tasks take different settings; roll them out by a --recipe")
    check_maze_options(tasks, given)
    _check_video_count(given)
    tasks = tuple(rewarded(task, given.get("reward")) for task in tasks)
    goals, distractors = given.get("goals", ()), given.get("distractors", ())
    if is_maze(tasks[0]):
        settings = tuple(dict.fromkeys([*goals, *([FIXED] if given.get("fixed_goals") else [])]))
    else:
        difficulty = _difficulty(given)
        settings = tuple(
            name if "_" in name or name == "none" else DistractorSetting(name, difficulty).name for name in distractors
        )
    subset_fields = {name: given.get(name) for name in ("steps", "episodes_per_shard", "max_steps")}
    subset_fields["episodes"] = given.get("episodes") or (None if given.get("steps") else EPISODES)
    subset_fields["deterministic"] = not given.get("sample")
    name = "-".join(dict.fromkeys([*map(task_folder, tasks), *levels]))
    return single_recipe(
        tasks,
        levels,
        settings,
        name=name[:80].rstrip("-."),
        subset_fields=subset_fields,
        goals={name: given[name] for name in ("fixed_goals", "episodes_per_goal") if name in given},
        renderer={"backend": given["renderer"], "samples": given.get("samples")},
        trajectories="independent" if given.get("independent") else "shared",
        **{name: given[name] for name in ("seed", "size", "split") if name in given},
        **_sources(given),
    )


def _check_video_count(given: Mapping[str, Any]) -> None:
    """Refuse a number of videos that the source does not have."""
    if "video_count" not in given:
        return
    from dmcvb_gen.distractors import load_backgrounds

    count, source = given["video_count"], given.get("backgrounds", "builtin")
    there = len(load_backgrounds(source, given.get("split", "train")).lengths)
    if count > there:
        raise RecipeError(f"--video-count is {count}, but {source} has {there} videos: give {there} or less")


def _difficulty(given: Mapping[str, Any]) -> str:
    """The difficulty that the options of `_STRENGTHS` come to."""
    word, intensity = given.get("difficulty"), given.get("intensity")
    if word and intensity is not None:
        raise RecipeError("give --difficulty or --intensity, not both")
    if "video_count" in given and given.get("vary") and "background" not in given["vary"]:
        raise RecipeError("--video-count has no effect if --vary leaves the background out: remove it")
    if (word or intensity is not None) and "video_count" in given and set(given.get("vary") or ()) == {"background"}:
        flag = "--difficulty" if word else "--intensity"
        raise RecipeError(f"{flag} has no effect if only the background varies and --video-count is given: remove it")
    scale = DIFFICULTY_SCALES[word] if word else intensity
    return difficulty_of(scale, given.get("vary") or (), given.get("video_count"), given.get("correlated"))


def _layout_task(layout: str | Path) -> str:
    from dmcvb_gen.tasks.ant_maze import ANT_MAZE_TASKS, layout_task_id

    if Path(layout).suffix or Path(layout).is_file():
        return layout_task_id(layout)
    task, known = str(MazeName(str(layout))), [name.removeprefix(f"{ANT_MAZE}-") for name in ANT_MAZE_TASKS]
    maze = MazeName.parse(task)
    if maze is None or (maze.rows is None and maze.layout not in known):
        raise UnknownNameError("layout", layout, known)
    return task


def check_maze_options(tasks: Sequence[str], given: Mapping[str, Any]) -> None:
    """Refuse options of mazes that nothing in a request without a recipe takes up, and those not for mazes.

    Args:
      tasks: tasks of one family.
      given: the options that somebody gave.

    Raises:
      RecipeError: one of them has no effect.
    """
    if all(is_maze(task) for task in tasks):
        _check_given_to_mazes(given)
        return
    flags = {"goals": "--goal", "fixed_goals": "--fixed-goals", "reward": "--reward"}
    for name, flag in (flags | {"episodes_per_goal": "--episodes-per-goal"}).items():
        if name in given:
            raise RecipeError(f"{flag} has no effect outside mazes: remove it")
    for name in _STRENGTHS:
        if name in given and all("_" in kind or kind == "none" for kind in given.get("distractors", ())):
            flag = f"--{name.replace('_', '-')}"
            named = [kind for kind in given.get("distractors", ()) if "_" in kind]
            why = f"{named[0]} names its strength itself" if named else "nothing is varied"
            raise RecipeError(f"{flag} has no effect here, {why}: ask for --distractor static or dynamic")


def _check_given_to_mazes(given: Mapping[str, Any]) -> None:
    if given.get("distractors"):
        raise RecipeError(
            "--distractor has no effect in mazes, which vary in style: use --goal visible, hidden or fixed"
        )
    for name in _STRENGTHS:
        if name in given:
            flag = f"--{name.replace('_', '-')}"
            raise RecipeError(f"{flag} has no effect in mazes, which have no distractors: remove it")
    goals: Collection[str] = given.get("goals", ())
    fixed = bool(given.get("fixed_goals")) or FIXED in goals
    if "episodes_per_goal" in given and not fixed:
        raise RecipeError("--episodes-per-goal has no effect without --fixed-goals: add it, or use --episodes")
    if fixed and not set(goals) - {FIXED} and (given.get("episodes") or given.get("steps")):
        raise RecipeError("--episodes and --steps have no effect with fixed goals: use --episodes-per-goal")


def rewarded(task: str, reward: str | None) -> str:
    """A maze's task id with the reward that was asked for.

    Raises:
      RecipeError: the id names another one.
    """
    maze = MazeName.parse(task)
    if maze is None or reward is None or maze.reward == reward:
        return task
    if maze.reward:
        raise RecipeError(f"{task} names its own reward: remove --reward, or the task's @{maze.reward}")
    return f"{task}@{reward}" if reward == "geodesic" else task
