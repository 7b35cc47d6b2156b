"""The programs in scripts/ run: what they measure has changed under them more than once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"


def run(name: str, *arguments: str) -> str:
    done = subprocess.run([sys.executable, SCRIPTS / name, *arguments], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
def test_both_precisions_are_timed():
    assert "auto takes" in run("bench_training.py", "--precisions", "--updates", "3")


@pytest.mark.slow
def test_a_painted_sample_of_a_shipped_release_has_the_same_digests_twice():
    printed = run("paint_sample.py", "dmcvb-v1-locomotion", "--share", "0.0001")
    assert "painted twice, 0 shards differ" in printed
    painted = subprocess.run(
        [sys.executable, SCRIPTS / "paint_sample.py", "quickstart"], capture_output=True, text=True
    )
    assert painted.returncode == 1 and "regenerate --check" in painted.stderr
