"""Where something is missing, what needs it is refused in one line, and all else works."""

import pytest

from tests.conftest import MAIN, python

LABMAZE = f"import sys; sys.modules['labmaze'] = None; {MAIN}"
UNIX = """
import sys
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None  # what imports it fails, as on Windows
import os
calls = ("fork", "getuid", "sysconf", "sysconf_names", "sched_getaffinity", "killpg", "setsid")
for name in (*calls, "O_NOFOLLOW", "O_NONBLOCK"):
    if hasattr(os, name):
        delattr(os, name)
import importlib, pkgutil
import dmcvb_gen
for module in pkgutil.walk_packages(dmcvb_gen.__path__, "dmcvb_gen."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
from dmcvb_gen.agents.data import default_memory
assert default_memory() > 0
for number, task in enumerate(("walker-walk", "ant-maze-tiny:****/*..*/****")):
    dmcvb_gen.rollout(task, levels="random", episodes=1, max_steps=3, size=16, out=f"made{number}", workers=1)
    assert dmcvb_gen.verify(f"made{number}").sound
"""


@pytest.mark.slow
def test_without_labmaze_mazes_are_refused_in_one_line_and_the_walker_walks(tmp_path):
    """labmaze has no wheel for Python 3.13."""
    short = ["--level", "random", "--episodes", 1, "--max-steps", 3, "--size", 8]
    refused = python(LABMAZE, "rollout", "ant-maze-empty7x7", *short, "--out", tmp_path / "maze", code=2)
    [line] = [line for line in refused.stderr.splitlines() if "error" in line]
    assert "labmaze" in line and "3.11 and 3.12" in line and "Traceback" not in refused.stderr
    python(LABMAZE, "rollout", "walker-walk", *short, "--distractor", "dynamic", "--out", tmp_path / "walker")
    python(LABMAZE, "list")
    python(LABMAZE, "verify", tmp_path / "walker")


@pytest.mark.slow
def test_without_what_only_unix_has_every_module_loads_and_both_families_make_data(tmp_path):
    python(UNIX, cwd=tmp_path)
