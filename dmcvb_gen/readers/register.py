"""Gymnasium names of all tasks and distractors; light, because this runs whenever `dmcvb_gen` is imported."""

from __future__ import annotations

TASKS = ("walker-walk", "cheetah-run", "humanoid-walk")
"""Locomotion tasks (a test holds these lists equal to the tasks' own, which would import MuJoCo)."""
SETTINGS = ("none", "static", "dynamic")
_LAYOUTS = ("empty7x7", "easy7x7a", "easy7x7b", "easy7x7c", "medium7x7a", "medium7x7b", "medium7x7c")
MAZES = tuple(f"ant-maze-{layout}" for layout in _LAYOUTS)
GOALS = ("visible", "hidden")
NAMESPACE = "dmcvb_gen"


def environments() -> dict[str, tuple[str, str]]:
    """Registered names -> (task, setting): "dmcvb_gen/walker-walk-dynamic-v0", "dmcvb_gen/ant-maze-...-hidden-v0"."""
    pairs = [(task, setting) for task in TASKS for setting in SETTINGS]
    pairs += [(task, goal) for task in MAZES for goal in GOALS]
    return {f"{NAMESPACE}/{task}-{setting}-v0": (task, setting) for task, setting in pairs}


def environment_ids() -> tuple[str, ...]:
    """The registered names."""
    return tuple(environments())


def register() -> None:
    """Register the environments, so that `gymnasium.make` and `make_vec` know them; done once."""
    import gymnasium

    for name, (task, setting) in environments().items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="dmcvb_gen.readers.envs:DistractedEnv",
                vector_entry_point="dmcvb_gen.readers.envs:DistractedVectorEnv",
                kwargs={"task": task, "distractor": setting},
            )
