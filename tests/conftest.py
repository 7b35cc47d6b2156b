"""Shared fixtures: a small release that many tests read."""

from __future__ import annotations

import functools
import os

os.environ.setdefault("MUJOCO_GL", "egl" if os.path.exists("/usr/lib/x86_64-linux-gnu/libEGL.so.1") else "disable")

import numpy as np  # noqa: E402
import pytest  # noqa: E402
import zarr  # noqa: E402

from dmcvb_gen.dataset import open_release  # noqa: E402
from dmcvb_gen.dataset.manifest import parse_commit, write_json_atomically  # noqa: E402
from dmcvb_gen.dataset.writer import finish_release  # noqa: E402
from dmcvb_gen.files import sha256_file  # noqa: E402
from dmcvb_gen.generate.executors import run_jobs  # noqa: E402
from dmcvb_gen.generate.plan import finish, make_plan, prepare  # noqa: E402
from dmcvb_gen.generate.recipe import make_recipe  # noqa: E402
from dmcvb_gen.rendering.native import textures  # noqa: E402

pytest_plugins = ["tests.compiled_code", "tests.tiers"]

# Tests make hundreds of renderers of mazes in one process, with more textures than a command needs to keep.
textures._packed_levels = functools.lru_cache(maxsize=64)(textures._packed_levels.__wrapped__)


def small_recipe(**changes):
    """Walker, random actions, three settings, 3 episodes in shards of 2, small pictures."""
    fields = {
        "name": "small",
        "seed": 3,
        "size": 16,
        "renderer": {"backend": "native"},
        "subsets": [
            {
                "tasks": "walker-walk",
                "levels": "random",
                "settings": ["none", "static", "dynamic"],
                "episodes": 3,
                "episodes_per_shard": 2,
            }
        ],
    }
    return make_recipe(fields | changes)


def roll_out(recipe, folder, jobs=lambda jobs: jobs, workers=1, only=()):
    """Make a release in this process (or in workers) and give its finished manifest."""
    plan = prepare(make_plan(recipe, folder, only))
    for _ in run_jobs(jobs(plan.jobs), workers):
        pass
    return finish(plan)


TINY_MAZE = "ant-maze-tiny:****/*..*/****"
"""Two cells: even random actions find the goal now and then."""


def maze_recipe(settings=("visible",), **changes):
    """A maze of two cells, random actions, 2 episodes in shards of 1, small pictures."""
    pattern = {"tasks": TINY_MAZE, "levels": "random", "settings": list(settings), "episodes": 2}
    fields = {"name": "mazes", "size": 16, "renderer": {"backend": "native"}}
    return make_recipe(fields | {"subsets": [pattern | {"episodes_per_shard": 1} | changes]})


@pytest.fixture(scope="session")
def maze_release(tmp_path_factory):
    """Folder of a finished small release of a maze."""
    folder = tmp_path_factory.mktemp("maze") / "release"
    roll_out(maze_recipe(), folder)
    return folder


@pytest.fixture(scope="session")
def small_release(tmp_path_factory):
    """Folder of a finished small release."""
    folder = tmp_path_factory.mktemp("release") / "small"
    roll_out(small_recipe(), folder)
    return folder


@pytest.fixture(scope="session")
def small_mazes(tmp_path_factory):
    """Folder of a finished release of a maze: goal visible, hidden, and fixed with the start; 2 short episodes each."""
    pattern = {"tasks": TINY_MAZE, "levels": "random", "episodes_per_shard": 1, "max_steps": 100}
    subsets = [
        pattern | {"settings": ["visible", "hidden"], "episodes": 2},
        pattern | {"settings": ["fixed"], "fixed_goals": 2, "episodes_per_goal": 1},
    ]
    folder = tmp_path_factory.mktemp("mazes") / "mazes"
    roll_out(small_recipe(name="mazes", subsets=subsets), folder)
    return folder


def stack_channels(frames):
    """(stack, view, height, width, 3) -> (stack * view * 3, height, width), the oldest frame first."""
    return np.concatenate([view.transpose(2, 0, 1) for frame in frames for view in frame])


def rewrite(folder, name, change):
    """Change arrays of a subset and make all digests again, so that only what the data say can give it away."""
    change(zarr.open_group(str(folder / f"{name}.zarr"), mode="r+", use_consolidated=False))
    for path in sorted((folder / "commits" / name).glob("*.json")):
        commit = parse_commit(path.read_text())
        files = [
            file.model_copy(update={"bytes": at.stat().st_size, "sha256": sha256_file(at)})
            for file in commit.files
            if (at := folder / file.path).exists()
        ]
        write_json_atomically(path, commit.model_copy(update={"files": tuple(files)}))
    finish_release(folder, open_release(folder).manifest)
