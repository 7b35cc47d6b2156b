"""A sample of the races of scripts/campaign.py: two commands on one release at once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.parametrize("pair", ["walker/folder/rollout+grow", "maze/folder/rollout+rollout"])
def test_two_commands_at_once_end_in_what_one_order_gives(pair):
    command = [sys.executable, "scripts/campaign.py", "--races", "--pair", pair, "--seed", "1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and f"{pair}: ok" in done.stdout, done.stdout + done.stderr
