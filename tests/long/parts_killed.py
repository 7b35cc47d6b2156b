"""Parts killed again and again behind a bad network. It takes minutes, so it is run by itself:

python -m pytest tests/long/parts_killed.py

The S3 server, the bad network before it and the parts are processes of their own: none waits for another's thread.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
import urllib.request

import pytest

from dmcvb_gen.dataset.manifest import parse_manifest
from tests.generate.test_cluster import contents, recipe_file, whole  # noqa: F401  (fixtures)
from tests.release.test_publish import CREDENTIALS

SPOILED = 0.04
"""Share of the requests that the network spoils."""
FAULTS = ["drop", "500", "cut", "delay"]
KILLS = 4
DEADLINE = 300
"""Seconds until the parts must be through; on two idle cores they take less than one minute."""


@contextlib.contextmanager
def program(*arguments, **options):
    """A process with all that it starts, ended when the block is left."""
    process = subprocess.Popen([sys.executable, "-m", *map(str, arguments)], start_new_session=True, **options)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def answers(port):
    with contextlib.suppress(OSError):
        socket.create_connection(("127.0.0.1", port), timeout=1).close()
        return True
    return False


def wait_for(condition, seconds, what):
    deadline = time.time() + seconds
    while not condition():
        assert time.time() < deadline, f"no {what} after {seconds} s"
        time.sleep(0.2)


@pytest.fixture
def network(monkeypatch):
    """(URL through a bad network, a way to set its faults, file system past it) of an S3 server with a bucket."""
    s3fs = pytest.importorskip("s3fs")
    pytest.importorskip("moto.server")
    for name, value in CREDENTIALS.items():
        monkeypatch.setenv(name, value)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    quiet = dict(stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    with program("moto.server", "-H", "127.0.0.1", "-p", port, **quiet):
        wait_for(lambda: answers(port), 60, "S3 server")
        with program("tests.faults.proxy", f"127.0.0.1:{port}", stdout=subprocess.PIPE, text=True) as proxy:
            url = f"http://127.0.0.1:{int(proxy.stdout.readline())}"

            def spoil(kinds):
                body = json.dumps({"kinds": kinds, "share": SPOILED, "seed": 7}).encode()
                urllib.request.urlopen(f"{url}/__faults__", body, timeout=30).close()

            direct = s3fs.S3FileSystem(endpoint_url=f"http://127.0.0.1:{port}", skip_instance_cache=True)
            direct.makedirs("bucket", exist_ok=True)
            yield url, spoil, direct


@pytest.mark.slow
def test_parts_killed_end_with_the_same_files(network, recipe_file, whole, tmp_path):  # noqa: F811
    rng, (url, spoil, direct) = random.Random(7), network
    arguments = ["dmcvb_gen", "rollout", "--recipe", recipe_file, "--out", "s3://bucket/quick"]
    arguments += ["--option", f"endpoint_url={url}", "--scratch", tmp_path]

    def committed():
        direct.invalidate_cache()
        return len(direct.find("bucket/quick/commits"))

    with contextlib.ExitStack() as stack:
        log = stack.enter_context(open(tmp_path / "parts.log", "wb"))

        def start(part):
            options = dict(stdout=log, stderr=log, env=os.environ | {"OMP_NUM_THREADS": "1"})
            return stack.enter_context(program(*arguments, "--part", f"{part}/4", **options))

        spoil(FAULTS)
        running, starts, kills, deadline = {part: start(part) for part in (1, 2, 3, 4)}, 4, 0, time.time() + DEADLINE
        while running:
            assert time.time() < deadline, (tmp_path / "parts.log").read_text()[-4000:]
            time.sleep(0.5)
            for part, process in list(running.items()):
                if process.poll() == 0:
                    del running[part]
                elif process.poll() is not None:  # the network was too bad for it
                    running[part], starts = start(part), starts + 1
            if running and kills < KILLS and committed() >= kills:
                time.sleep(rng.random())
                part = rng.choice(sorted(running))
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(running[part].pid, signal.SIGKILL)
                running[part].wait()
                kills, running[part], starts = kills + 1, start(part), starts + 1
        assert kills == KILLS and starts < 40
        command = [sys.executable, "-m", *map(str, arguments), "--finish", "--json"]
        for _ in range(5):
            finishing = subprocess.run(command, capture_output=True, text=True, timeout=120)
            if finishing.returncode == 0:
                break
        assert finishing.returncode == 0 and json.loads(finishing.stdout)["complete"], finishing.stderr
    direct.invalidate_cache()
    there = {path.removeprefix("bucket/quick/"): direct.cat_file(path) for path in direct.find("bucket/quick")}
    assert there == contents(whole)  # the same files to the last byte, and no stray one
    assert parse_manifest(there["manifest.json"]).complete
    assert not [path for path in tmp_path.rglob("*.partial/**/*") if path.is_file() and "/c/" in path.as_posix()]
