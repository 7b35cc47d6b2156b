"""Functions run in children of one process that has imported everything, one child a call: quick, and free to die.

with Server("tests.faults.store_ops") as server:
    result = server.call("write_shard", {"root": ..., "shard": 1}, root=folder, mode="kill", at=17)
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

TOP = Path(__file__).parents[2]


@dataclass(frozen=True)
class Result:
    """How a call ended.

    Attributes:
      status: "done", "refused" (a DmcvbError), "interrupted", "killed", or "crashed" (anything else: a defect).
      value: what it returned (plain JSON), or the error's text.
      changes: file operations that it made below its root, where it lived to say so.
    """

    status: str
    value: Any = None
    changes: int | None = None


class Server:
    """Calls functions of a module, each in a child of its own."""

    def __init__(self, module: str):
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(TOP), os.environ.get("PYTHONPATH", "")])}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.faults.server", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=TOP,
            env=environment,
        )

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_) -> None:
        self._process.stdin.close()
        self._process.wait(timeout=30)

    def call(
        self,
        function: str,
        arguments: dict[str, Any],
        *,
        root: str | Path,
        mode: str | None = None,
        at: int | None = None,
        seconds: int = 60,
    ) -> Result:
        """Run `function(**arguments)` with a fault of `inject.arm` for changes below `root`; killed after `seconds`."""
        request = dict(
            function=function, arguments=arguments, root=os.path.abspath(root), mode=mode, at=at, seconds=seconds
        )
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return Result(**json.loads(self._process.stdout.readline()))


def _child(module, request: dict[str, Any], pipe: int) -> None:
    """The life of a child: arm the fault, call, say how it ended."""
    import signal

    from dmcvb_gen.errors import DmcvbError
    from tests.faults.inject import arm

    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.alarm(request["seconds"])
    counter = arm(request["root"], request["mode"], request["at"])
    try:
        answer = {"status": "done", "value": getattr(module, request["function"])(**request["arguments"])}
    except DmcvbError as error:
        answer = {"status": "refused", "value": str(error)}
    except KeyboardInterrupt:
        answer = {"status": "interrupted"}
    except BaseException:
        answer = {"status": "crashed", "value": traceback.format_exc()}
    os.write(pipe, json.dumps(answer | {"changes": counter.count}).encode())


def main() -> None:
    """Read requests line by line; fork for each; write how it ended."""
    requests, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)  # nothing that a library prints may mix with the answers
    module = importlib.import_module(sys.argv[1])
    for line in iter(requests.readline, ""):
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                os.close(reading)
                _child(module, json.loads(line), writing)
            finally:
                os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as pipe:
            text = pipe.read()
        os.waitpid(child, 0)
        answers.write((text or json.dumps({"status": "killed"})) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
