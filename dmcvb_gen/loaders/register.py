"""Gymnasium names of all tasks and distractors, registered as soon as both packages are imported, in either order.

This runs whenever `dmcvb_gen` is imported, so it imports nothing itself: who only reads, or asks for --help, neither
needs Gymnasium nor waits for it.
"""

from __future__ import annotations

import importlib.util
import sys
from typing import TYPE_CHECKING, Any

from dmcvb_gen.spec import DISTRACTOR_KINDS, GOAL_MODES, MazeName

if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec
    from types import ModuleType

TASKS = ("walker-walk", "cheetah-run", "humanoid-walk")
"""Locomotion tasks (a test holds these lists equal to the tasks' own, which would import MuJoCo)."""
SUITE = (
    "acrobot-swingup",
    "ball_in_cup-catch",
    "cartpole-balance",
    "cartpole-swingup",
    "finger-spin",
    "finger-turn_hard",
    "fish-swim",
    "hopper-hop",
    "hopper-stand",
    "humanoid-run",
    "humanoid-stand",
    "pendulum-swingup",
    "point_mass-easy",
    "quadruped-walk",
    "reacher-easy",
    "reacher-hard",
    "swimmer-swimmer6",
    "walker-run",
    "walker-stand",
)
"""More tasks of dm_control's suite that have names; every other one is an argument of `DistractedEnv`."""
_LAYOUTS = ("empty7x7", "easy7x7a", "easy7x7b", "easy7x7c", "medium7x7a", "medium7x7b", "medium7x7c")
MAZES = tuple(str(MazeName(layout)) for layout in _LAYOUTS)
NAMESPACE = "dmcvb_gen"
ENTRY_POINT = "dmcvb_gen.loaders.envs:DistractedEnv"
VECTOR_ENTRY_POINT = "dmcvb_gen.loaders.envs:DistractedVectorEnv"


def environment_id(task: str, setting: str) -> str:
    """The name of an environment: "dmcvb_gen/walker-walk-dynamic-v0", "dmcvb_gen/ant-maze-easy7x7a-hidden-v0"."""
    return f"{NAMESPACE}/{task}-{setting}-v0"


def environments() -> dict[str, tuple[str, str]]:
    """Registered names -> (task, setting)."""
    pairs = [(task, setting) for task in (*TASKS, *SUITE) for setting in DISTRACTOR_KINDS]
    pairs += [(task, goal) for task in MAZES for goal in GOAL_MODES]
    return {environment_id(task, setting): (task, setting) for task, setting in pairs}


def register() -> None:
    """Register the environments, so that `gymnasium.make` and `make_vec` know them; done once."""
    import gymnasium

    for name, (task, setting) in environments().items():
        if name not in gymnasium.registry:
            scene = {"task": task, "distractor": setting}
            gymnasium.register(name, ENTRY_POINT, vector_entry_point=VECTOR_ENTRY_POINT, kwargs=scene)


def register_with_gymnasium() -> None:
    """`register` now if Gymnasium is imported already, else when it is."""
    if "gymnasium" in sys.modules:
        register()
    elif not any(isinstance(finder, _GymnasiumFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _GymnasiumFinder())


class _GymnasiumFinder:
    """Finds `gymnasium` as the other finders do, once, and calls `register` after it was loaded."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                register()

            spec.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return spec
