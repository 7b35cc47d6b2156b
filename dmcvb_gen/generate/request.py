"""Turn the arguments of a rollout into a recipe; those that would change nothing are refused."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dmcvb_gen.errors import RecipeError, UnknownNameError
from dmcvb_gen.generate.recipe import (
    COMMAND_LINE,
    Recipe,
    check_options_used,
    load_recipe,
    make_recipe,
    narrow,
    override,
)
from dmcvb_gen.own_code import BEHAVIOURS, allow, is_own, refuse_file
from dmcvb_gen.spec import FIXED, GOAL_MODES, VISIBLE, DistractorSetting, Level, is_maze, task_folder
from dmcvb_gen.tasks import get_task, typed_task
from dmcvb_gen.tasks.base import ACTION_REPEAT
from dmcvb_gen.text import as_names

EPISODES = 20
"""Default number of episodes of a subset."""
_SAME_NAME = ("episodes", "max_steps", "action_repeat", "episodes_per_shard", "seed", "size", "split")
RECIPE_OPTIONS = {*_SAME_NAME, "levels", "distractors", "goals", "sample", "renderer", "samples", "backgrounds"}
RECIPE_OPTIONS |= {"behaviour", "independent"}
"""Options that say what to make, not where or how."""
_GOAL = re.compile(rf"{FIXED}([1-9]\d*)")


def make_request(tasks: Sequence[str] = (), recipe: str | Path | None = None, **given: Any) -> Recipe:
    """The recipe of what was asked for.

    Args:
      tasks: names, or text files of mazes; with a recipe, those that are taken of it.
      recipe: a YAML file or the name of a shipped recipe.
      given: options of `RECIPE_OPTIONS` that were given, without defaults.

    Raises:
      DmcvbError: an unknown name, a value that is wrong, or an option that would have no effect.
    """
    given |= {name: as_names(given[name]) for name in ("levels", "distractors", "goals") if name in given}
    if "distractors" in given:
        from dmcvb_gen.distractors.registry import typed_setting  # which needs MuJoCo

        given["distractors"] = tuple(map(typed_setting, given["distractors"]))
    tasks = tuple(map(typed_task, tasks))
    if not tasks and not recipe:
        raise RecipeError("give TASKs or --recipe; `dmcvb-gen list` shows the tasks and recipes")
    settings, fixed_goals = _settings(given)
    changes = {name: given[name] for name in _SAME_NAME if name in given}
    places = {"behaviour": behaviour_source, "backgrounds": background_source}
    changes |= {name: place_of(given[name]) for name, place_of in places.items() if name in given}
    changes |= {"fixed_goals": fixed_goals} if fixed_goals else {}
    if given.get("sample"):
        changes["deterministic"] = False
    if given.get("independent"):
        changes["trajectories"] = "independent"
    if recipe:
        made = load_recipe(recipe)
        if tasks or given.get("levels") or settings:
            made = narrow(made, tasks, given.get("levels", ()), settings)
    else:
        repeat = given.get("action_repeat", ACTION_REPEAT)
        made = _recipe_of(tasks, given.get("levels") or ("expert",), settings, repeat)
    changes |= _renderer(given, made)
    made = override(made, **changes) if changes else made
    check_options_used(made, given)
    if given.get("sample") and is_own(str(given.get("behaviour") or "")):
        raise RecipeError("--sample has no effect: a function of your own draws by itself; remove it")
    return made


def background_source(given: str | Path) -> str:
    """--backgrounds as a recipe has it: "builtin", or an absolute folder."""
    return "builtin" if given == "builtin" else str(Path(given).expanduser().resolve())


def behaviour_source(given: str | Path | None) -> str | None:
    """--behaviour as a recipe has it: an absolute path, or "<module>:<function>", whose code may then run.

    Raises:
      DmcvbError: it names a Python file.
    """
    if given is None:
        return None
    refuse_file("--behaviour", str(given))
    if is_own(str(given)):
        allow([str(given)], BEHAVIOURS)  # a person typed its name
        return str(given)
    return str(Path(given).expanduser().resolve())


def _settings(given: Mapping[str, Any]) -> tuple[list[str], int | None]:
    """The settings that were asked for, and the number of goals of "fixed3"."""
    goals, count = [], None
    for goal in dict.fromkeys(given.get("goals", ())):
        if found := _GOAL.fullmatch(goal):
            goal, count = FIXED, int(found[1])
        if goal not in GOAL_MODES:
            raise UnknownNameError("goal", goal, (*GOAL_MODES, f"{FIXED}N"))
        if goal in goals:
            raise RecipeError(f"--goal {FIXED} is given twice; keep one")
        goals.append(goal)
    return [*(DistractorSetting.parse(name).name for name in given.get("distractors", ())), *goals], count


def _renderer(given: Mapping[str, Any], recipe: Recipe) -> dict[str, Any]:
    """The renderer that was asked for; another one than the recipe's has its own number of samples."""
    old = recipe.renderer
    backend = given.get("renderer", old.backend)
    kept = old.samples if backend == old.backend else None
    chosen = {"backend": backend, "samples": given.get("samples", kept)}
    return {} if chosen == old.model_dump() else {"renderer": chosen}


def _recipe_of(tasks: Sequence[str], levels: Sequence[str], settings: Sequence[str], repeat: int) -> Recipe:
    """The recipe of tasks of one family, with the counts that `override` then changes."""
    for level in levels:
        Level.parse(level)
    mazes = {is_maze(task) for task in tasks}
    if len(mazes) > 1:
        raise RecipeError("mazes and locomotion tasks take different settings; roll them out by a --recipe")
    if strange := [name for name in settings if (name in GOAL_MODES) != (True in mazes)]:
        if True in mazes:
            raise RecipeError("--distractor has no effect in mazes, which vary in style; ask for --goal visible")
        get_task(tasks[0])  # or it is a maze's name, misspelt
        raise RecipeError(f"{tasks[0]} has no goal {strange[0]}; --goal is for mazes, ask for --distractor")
    words = [*map(task_folder, tasks), *levels, *([f"repeat{repeat}"] if repeat != ACTION_REPEAT else [])]
    name = "-".join(dict.fromkeys(words))[:80].rstrip("-.")
    pattern: dict[str, Any] = {"tasks": list(tasks), "levels": list(levels)}
    pattern |= {"settings": list(settings) or [VISIBLE if True in mazes else "none"], "episodes": EPISODES}
    return make_recipe({"name": name, "subsets": [pattern]}, COMMAND_LINE)
