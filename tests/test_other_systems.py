"""What only Unix has is not needed: without its modules and calls every module loads and both families make data."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

WITHOUT = """
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
    release = dmcvb_gen.rollout(
        tasks=[task], levels=["random"], episodes=1, max_steps=3, size=16, out=f"made{number}", workers=1
    )
    assert dmcvb_gen.verify(f"made{number}").sound
"""


@pytest.mark.slow
def test_without_what_only_unix_has_every_module_loads_and_both_families_make_data(tmp_path):
    done = subprocess.run([sys.executable, "-c", WITHOUT], cwd=tmp_path, capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stderr[-3000:]
