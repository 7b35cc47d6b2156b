"""Parts killed again and again behind a bad network. It takes many minutes, so it is run by itself:

python -m pytest tests/long/parts_killed.py
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time

import pytest

from dmcvb_gen.store.manifest import parse_manifest
from tests.test_cluster import contents, recipe_file, s3_server, whole  # noqa: F401  (fixtures)

SPOILED = 0.04
"""Share of the requests that the network spoils."""


@pytest.mark.slow
def test_parts_killed_end_with_the_same_files(s3_server, recipe_file, whole, tmp_path):  # noqa: F811
    rng = random.Random(7)
    proxy, direct, environment = s3_server
    proxy.fault = lambda method, path: rng.choice(["drop", "500", "cut"]) if rng.random() < SPOILED else None
    command = [sys.executable, "-m", "dmcvb_gen", "rollout", "--recipe", str(recipe_file), "--out", "s3://bucket/quick"]
    command += ["--option", f"endpoint_url={proxy.url}", "--scratch", str(tmp_path)]
    commits = "bucket/quick/commits"

    def start(part):
        quiet = dict(stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        return subprocess.Popen([*command, "--part", f"{part}/4"], env=environment, start_new_session=True, **quiet)

    def count():
        direct.invalidate_cache()
        return len(direct.find(commits))

    running, kills, deadline = {part: start(part) for part in (1, 2, 3, 4)}, 0, time.time() + 600
    while running and time.time() < deadline:
        time.sleep(1)  # the server lives in this process, and is asked by all
        committed = count() if kills < 4 else 0
        for part, process in list(running.items()):
            if process.poll() == 0:
                del running[part]
            elif process.poll() is not None:
                running[part] = start(part)  # the network was too bad for it
            elif kills < 4 and committed >= kills and rng.random() < 0.3:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                kills, running[part] = kills + 1, start(part)
    assert kills == 4 and not running
    finishing = subprocess.run([*command, "--finish", "--json"], env=environment, capture_output=True, text=True)
    proxy.fault = lambda method, path: None
    assert json.loads(finishing.stdout)["complete"], finishing.stderr
    direct.invalidate_cache()
    there = {path.removeprefix("bucket/quick/"): direct.cat_file(path) for path in direct.find("bucket/quick")}
    assert there == contents(whole)  # the same files to the last byte, and no stray one
    assert parse_manifest(there["manifest.json"]).complete
    assert not [path for path in tmp_path.rglob("worker-*") if path.is_file()]
