"""Gymnasium names of all tasks and distractors; light, because this runs whenever `dmcvb_gen` is imported."""

from __future__ import annotations

from dmcvb_gen.names import DISTRACTOR_KINDS, GOAL_MODES

TASKS = ("walker-walk", "cheetah-run", "humanoid-walk")
"""Locomotion tasks (a test holds these lists equal to the tasks' own, which would import MuJoCo)."""
_LAYOUTS = ("empty7x7", "easy7x7a", "easy7x7b", "easy7x7c", "medium7x7a", "medium7x7b", "medium7x7c")
MAZES = tuple(f"ant-maze-{layout}" for layout in _LAYOUTS)
NAMESPACE = "dmcvb_gen"
ENTRY_POINT = "dmcvb_gen.readers.envs:DistractedEnv"
VECTOR_ENTRY_POINT = "dmcvb_gen.readers.envs:DistractedVectorEnv"


def environment_id(task: str, setting: str) -> str:
    """The name of an environment: "dmcvb_gen/walker-walk-dynamic-v0", "dmcvb_gen/ant-maze-easy7x7a-hidden-v0"."""
    return f"{NAMESPACE}/{task}-{setting}-v0"


def environments() -> dict[str, tuple[str, str]]:
    """Registered names -> (task, setting)."""
    pairs = [(task, setting) for task in TASKS for setting in DISTRACTOR_KINDS]
    pairs += [(task, goal) for task in MAZES for goal in GOAL_MODES]
    return {environment_id(task, setting): (task, setting) for task, setting in pairs}


def environment_ids() -> tuple[str, ...]:
    """The registered names."""
    return tuple(environments())


def register() -> None:
    """Register the environments, so that `gymnasium.make` and `make_vec` know them; done once."""
    try:
        import gymnasium
    except ImportError:
        return  # whoever only reads needs no environments

    for name, (task, setting) in environments().items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=ENTRY_POINT,
                vector_entry_point=VECTOR_ENTRY_POINT,
                kwargs={"task": task, "distractor": setting},
            )
