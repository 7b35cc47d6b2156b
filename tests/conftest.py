"""Shared fixtures: a small release that many tests read."""

import ctypes
import functools
import gc
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl" if os.path.exists("/usr/lib/x86_64-linux-gnu/libEGL.so.1") else "disable")

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from click.testing import CliRunner  # noqa: E402

from dmcvb_gen.cli import main  # noqa: E402
from dmcvb_gen.dataset.chunks import decode  # noqa: E402
from dmcvb_gen.dataset.gate import Release  # noqa: E402
from dmcvb_gen.dataset.manifest import record_path  # noqa: E402
from dmcvb_gen.dataset.writer import finish, put_shard  # noqa: E402
from dmcvb_gen.generate.executors import run_works  # noqa: E402
from dmcvb_gen.generate.plan import make_plan, start  # noqa: E402
from dmcvb_gen.generate.recipe import Recipe, make_recipe  # noqa: E402
from dmcvb_gen.generate.renderer_choice import default_renderer  # noqa: E402
from dmcvb_gen.release.verify import verify_folder  # noqa: E402
from dmcvb_gen.rendering.native import textures  # noqa: E402
from dmcvb_gen.tasks import get_task  # noqa: E402
from dmcvb_gen.tasks.ant_maze.arena import textured_model  # noqa: E402

pytest_plugins = ["tests.compiled_code", "tests.tiers"]

# Tests make hundreds of renderers of mazes in one process, with more textures than a command needs to keep.
textures._packed_levels = functools.lru_cache(maxsize=64)(textures._packed_levels.__wrapped__)


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown():
    """Give memory back from 3 GB on: one process of tests meets more tasks than a command ever does."""
    statm = Path("/proc/self/statm")  # of Linux alone, as is malloc_trim
    if not statm.exists() or int(statm.read_text().split()[1]) < 750_000:  # pages
        return
    for cache in (get_task, default_renderer, textured_model, textures._packed_levels):
        cache.cache_clear()
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)


WALKERS = {"tasks": "walker-walk", "levels": "random", "settings": ["none", "static", "dynamic"]}
WALKERS |= {"episodes": 3, "episodes_per_shard": 2}


def small_recipe(**changes):
    """Walker, random actions, three settings, 3 episodes in shards of 2, small pictures.

    Args:
      changes: fields of the recipe or of its subsets.
    """
    own = {name: changes.pop(name) for name in [*changes] if name in Recipe.model_fields}
    fields = {"name": "small", "seed": 3, "size": 16, "renderer": {"backend": "native"}, "subsets": [WALKERS | changes]}
    return make_recipe(fields | own)


def short_recipe(**changes):
    """As `small_recipe`, with episodes of 20 steps."""
    return small_recipe(**({"max_steps": 20} | changes))


def roll_out(recipe, folder, works=lambda works: works, workers=1, only=(), pixels=True):
    """Make a release in this process (or in workers) and give it as it is then."""
    plan = make_plan(recipe, folder, only, pixels=pixels)
    start(plan)
    for _ in run_works(works(plan.works), workers):
        pass
    return finish(plan.release.store)


TINY_MAZE = "ant-maze-tiny:****/*..*/****"
"""Two cells: even random actions find the goal now and then."""


def maze_recipe(settings=("visible",), **changes):
    """A maze of two cells, random actions, 2 episodes (the second finds the goal) in shards of 1, small pictures."""
    maze = {"tasks": TINY_MAZE, "settings": list(settings), "episodes": 2, "episodes_per_shard": 1}
    return small_recipe(**({"name": "mazes", "seed": 5} | maze | changes))


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


@pytest.fixture
def copy(small_release, tmp_path):
    """Folder of a copy of the small release, to change or to damage."""
    return shutil.copytree(small_release, tmp_path / "copy")


@pytest.fixture(scope="session", params=["walker-walk", TINY_MAZE], ids=["walker", "maze"])
def painted_and_light(request, tmp_path_factory):
    """A folder with a "painted" release of 3 short episodes a setting, and the same made without images, "light"."""
    settings = ["visible", "hidden"] if request.param == TINY_MAZE else ["none", "dynamic"]
    recipe = short_recipe(tasks=request.param, settings=settings, max_steps=6)
    folder = tmp_path_factory.mktemp("images")
    for name in ("painted", "light"):
        roll_out(recipe, folder / name, pixels=name == "painted")
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


def invoke(*words, code=None):
    """Run a command of dmcvb-gen in this process, and give its result; `code` is what it must end with."""
    result = CliRunner().invoke(main, [str(word) for word in words])
    assert code in (None, result.exit_code), (words, result.output)
    return result


def run(*words):
    """What a command of dmcvb-gen prints, which must succeed."""
    return invoke(*words, code=0).stdout


def told(*words, code=0):
    """The facts that a command prints as JSON, which has no NaN."""
    return json.loads(invoke(*words, "--json", code=code).stdout, parse_constant=pytest.fail)


MAIN = "from dmcvb_gen.cli import main; main(prog_name='dmcvb-gen')"  # a command, for `python`


def python(source, *words, code=0, **options):
    """Run Python code in a process of its own, and give what it ended with; `code` is its exit code."""
    command = [sys.executable, "-c", source, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert code in (None, done.returncode), (words, done.stdout, done.stderr)
    return done


def wait(done, seconds=60):
    """Wait until something is true, and say if it is."""
    deadline = time.time() + seconds
    while not done() and time.time() < deadline:
        time.sleep(0.05)
    return done()


def posed(model, state, spec):
    """MuJoCo's own data of a model at the beginning of a stored row, with all that follows from it."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state[: mujoco.mj_stateSize(model, spec)], spec)
    mujoco.mj_forward(model, data)
    return data


def wrong_files(folder):
    """What `verify` says of the files of a release in a folder, without a look at their values."""
    return verify_folder(folder, names=()).findings


def records(release):
    """Layer -> the records of its shards."""
    return {name: release.records(name) for name in release.layers}


def stack_channels(frames):
    """(stack, view, height, width, 3) -> (stack * view * 3, height, width), the oldest frame first."""
    return np.concatenate([view.transpose(2, 0, 1) for frame in frames for view in frame])


def rewrite(folder, name, change):
    """Change arrays of a subset and make all digests again, so that only what the data say can give it away.

    Args:
      change: called with a dict of whole arrays by the reader's names, all shards of each, to change in place.
    """
    release = Release.open(folder)
    store, subset = release.store, release[name]
    specs = [(layer, spec) for layer in subset.layers for spec in layer.arrays]

    def shard_of(layer, spec, number):
        file = release.records(layer.name)[number].files.get(spec.name)
        return decode(layer, spec, store.read(layer.file_path(spec, number), file.bytes) if file else None)

    counts = {layer.name: len(release.records(layer.name)) for layer in subset.layers}
    arrays = {
        spec.name: np.concatenate([shard_of(layer, spec, number) for number in range(counts[layer.name])])
        for layer, spec in specs
    }
    change(arrays)
    for layer in subset.layers:
        for number in range(counts[layer.name]):
            span = layer.episodes_of(number)
            store.delete(record_path(layer.name, number))
            for spec in layer.arrays:
                store.delete(layer.file_path(spec, number))
            put_shard(store, layer, number, [(s.name, arrays[s.name][span.start : span.stop]) for s in layer.arrays])
    store.delete("manifest.json")
    return finish(store)
