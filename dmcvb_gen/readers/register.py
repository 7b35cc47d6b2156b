"""Gymnasium names of all tasks and distractors; light, because this runs whenever `dmcvb_gen` is imported."""

from __future__ import annotations

TASKS = ("walker-walk", "cheetah-run", "humanoid-walk")
"""Tasks with an environment (a test holds this equal to the tasks' own list, which would import MuJoCo)."""
SETTINGS = ("none", "static", "dynamic")
NAMESPACE = "dmcvb_gen"


def environment_ids() -> tuple[str, ...]:
    """Registered names: "dmcvb_gen/walker-walk-dynamic-v0", ..."""
    return tuple(f"{NAMESPACE}/{task}-{setting}-v0" for task in TASKS for setting in SETTINGS)


def register() -> None:
    """Register the environments, so that `gymnasium.make` and `make_vec` know them; done once."""
    import gymnasium

    for task in TASKS:
        for setting in SETTINGS:
            name = f"{NAMESPACE}/{task}-{setting}-v0"
            if name in gymnasium.registry:
                continue
            gymnasium.register(
                name,
                entry_point="dmcvb_gen.readers.envs:DistractedEnv",
                vector_entry_point="dmcvb_gen.readers.envs:DistractedVectorEnv",
                kwargs={"task": task, "distractor": setting},
            )
