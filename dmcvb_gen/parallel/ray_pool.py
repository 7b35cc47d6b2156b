"""Run functions on a Ray cluster, and give their results as they come; nodes may be lost and added meanwhile.

Only the results travel back (commit records, not data), so the work must leave its data where all nodes can write.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import socket
from collections.abc import Mapping, Sequence
from typing import Any

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.own_code import permissions
from dmcvb_gen.parallel.base import IN_FLIGHT, POLL_SECONDS, Needs, Pool, ProgressCallback, ignore, limit_threads


class RayPool(Pool):
    """One Ray task for each piece of work, repeated if its node is lost; each CPU has `IN_FLIGHT` of them.

    Args:
      address: of the cluster ("ray://host:10001", "auto"); by default what RAY_ADDRESS says, else one on this machine.
      needs: resources of a piece of work, by which Ray places it.
      tick: called with what the functions report, when their result comes.
      threads: threads of the libraries that a piece of work uses.

    Raises:
      DmcvbError: no cluster answers at the address.
    """

    def __init__(
        self, address: str | None = None, needs: Needs | None = None, tick: ProgressCallback = ignore, threads: int = 1
    ):
        import ray

        super().__init__(tick)
        self._ray, self._needs, self._threads = ray, needs or Needs(), threads
        self._ours = not ray.is_initialized()
        if self._ours:
            _check_answers(address or os.environ.get("RAY_ADDRESS"))
            try:
                ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, configure_logging=False)
            except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
                reason = " ".join(str(error).split())[:200]
                raise _nobody(address or "RAY_ADDRESS", reason) from None
        self._running: dict[Any, Any] = {}

    def results(self):
        ray, needs = self._ray, self._needs
        work = ray.remote(
            num_cpus=needs.cpus, num_gpus=needs.gpus, memory=needs.memory, max_retries=-1, retry_exceptions=False
        )(_work)
        while self._waiting or self._running:
            while self._waiting and len(self._running) < self._bound():
                key, function, arguments = self._waiting.popleft()
                told = tuple(permissions().items())
                self._running[work.remote(function, arguments, self._threads, told, os.getcwd())] = key
            done, _ = ray.wait(list(self._running), num_returns=1, timeout=10 * POLL_SECONDS)
            for reference in done:
                key = self._running.pop(reference)
                try:
                    ticks, result = ray.get(reference)
                except ray.exceptions.RayTaskError as error:
                    raise error.cause if isinstance(error.cause, DmcvbError) else error from None
                for facts in ticks:
                    self._tick(*facts)
                yield key, result

    def memory_each(self):
        if self._needs.memory is None:
            share = share_of_node(self._ray.nodes(), self._needs)
            self._needs = dataclasses.replace(self._needs, memory=share)
        return self._needs.memory

    def _bound(self) -> int:
        """Pieces of work that may be handed out to the nodes that there are now."""
        cpus = self._ray.cluster_resources().get("CPU", 1.0)
        return max(1, int(IN_FLIGHT * cpus / self._needs.cpus))

    def close(self, at_once=False):
        for reference in self._running:
            with contextlib.suppress(Exception):  # it may be through, or its node gone
                self._ray.cancel(reference, force=True)
        self._running.clear()
        if self._ours:
            self._ray.shutdown()


def share_of_node(nodes: Sequence[Mapping[str, Any]], needs: Needs) -> int | None:
    """Bytes of memory that a piece of work may take on any node, all those beside it taking as much.

    Args:
      nodes: as `ray.nodes()` lists them.
      needs: the cores and the share of a GPU that it takes.

    Returns:
      The least share of all nodes where it can be placed; None if there is no such node yet.
    """
    shares = []
    for resources in (node["Resources"] for node in nodes if node["Alive"]):
        beside = [resources.get("CPU", 0) / needs.cpus]
        if needs.gpus:
            beside.append(resources.get("GPU", 0) / needs.gpus)
        if min(beside) >= 1 and "memory" in resources:
            shares.append(int(resources["memory"] / int(min(beside))))
    return min(shares, default=None)


def _check_answers(address: str | None) -> None:
    """Raise DmcvbError if no program listens at "host:port". Ray itself would try for minutes."""
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if not colon or not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), timeout=10).close()
    except OSError as error:
        raise _nobody(str(address), error.strerror or str(error)) from None


def _nobody(address: str, reason: str) -> DmcvbError:
    return DmcvbError(
        f"no Ray cluster answers at {address} ({reason}); start one with `ray start --head`, name another in "
        "RAY_ADDRESS, or give a number of --workers"
    )


def _work(
    function, arguments, threads: int, allowed: Sequence[tuple[str, str]], folder: str
) -> tuple[list[tuple], Any]:
    """Run a function and return its progress (numbers are added up) and its result.

    Args:
      allowed: code of the user's own that may run, see `own_code.permissions`; nodes do not inherit it.
      folder: the current folder of who asks, which relative paths begin at.
    """
    if os.path.isdir(folder):
        os.chdir(folder)
    os.environ.update(dict(allowed))
    limit_threads(threads)
    told: list[tuple] = []

    def tell(*facts: Any) -> None:
        if told and len(facts) == 1 and isinstance(facts[0], int):
            told[0] = (told[0][0] + facts[0],)
        else:
            told.append(facts)

    return told, function(*arguments, tick=tell)
