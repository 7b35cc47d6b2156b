"""Run many cells and yield their results as they come; encoders are trained first, each once.

A cell that cannot be run has a result of {"error": one line}; what it raised lies in its log, and the others go on.
"""

from __future__ import annotations

import dataclasses
import time
import traceback
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from dmcvb_gen.agents.data import default_memory
from dmcvb_gen.benchmarks.experiments import ProgressCallback, policy_steps, run_cell, run_pretraining
from dmcvb_gen.benchmarks.profiles import Profile
from dmcvb_gen.benchmarks.setup import Pretraining, Setup, pretraining_of
from dmcvb_gen.benchmarks.suites import Cell
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import write_text
from dmcvb_gen.parallel import Needs, Workers, ignore, open_pool
from dmcvb_gen.parallel.cores import usable_cores

TICK_SECONDS = 0.2
"""Progress is told no more often: an Adam step on states takes less than telling of it."""


def run_cells(
    setup: Setup, cells: Sequence[Cell], workers: Workers = 1, tick: ProgressCallback = ignore
) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Results of cells as they come; those that need no encoder are run beside the encoders' training.

    Args:
      workers: processes (started fresh, never forked), which share the memory for pictures; 1: all in this one; or a
        Ray cluster whose nodes see the release and the report's folder.
      tick: called with what is trained and the number of Adam steps made.

    Raises:
      StoreError: a worker was killed; finished cells are kept.
    """
    encoders = dict.fromkeys(filter(None, map(pretraining_of, cells)))
    setup = dataclasses.replace(setup, run=uuid.uuid4().hex)
    if workers == 1:
        torch.set_num_threads(setup.threads)
    elif isinstance(workers, int):
        setup = share_memory(setup, workers)
    kept = "finished cells are kept: rerun the same command"
    with open_pool(workers, threads=setup.threads, tick=tick, kept=kept, needs=needs_of(setup)) as pool:
        setup = share_node(setup, pool.memory_each())
        for work in encoders:
            pool.submit(work, try_pretraining, setup, work)
        for cell in cells:
            if pretraining_of(cell) is None:
                pool.submit(cell, try_cell, setup, cell)
        for item, result in pool.results():
            if isinstance(item, Cell):
                yield item, result
                continue
            for cell in cells:
                if pretraining_of(cell) != item:
                    continue
                if "error" in result:
                    yield cell, {"error": result["error"]}
                else:
                    pool.submit(cell, try_cell, setup, cell)


def share_memory(setup: Setup, workers: int) -> Setup:
    """The setup of each of several workers: pictures of them all together stay inside the one limit."""
    memory = default_memory(setup.device) if setup.memory is None else setup.memory
    return dataclasses.replace(setup, memory=memory // workers)


def needs_of(setup: Setup) -> Needs:
    """Return the resources of a cell on a cluster; without a number of bytes, its share of a node."""
    if setup.device == "cpu":
        return Needs(cpus=setup.threads, memory=setup.memory)
    return Needs(cpus=setup.threads, gpus=1)  # the bound is of the accelerator's memory, which a cell has alone


def share_node(setup: Setup, memory: int | None) -> Setup:
    """The setup of cells that have `memory` bytes each; pictures take half of them, as they do if one is alone."""
    if setup.memory is not None or memory is None or setup.device != "cpu":
        return setup
    return dataclasses.replace(setup, memory=memory // 2)


def try_cell(setup: Setup, cell: Cell, tick: ProgressCallback = ignore) -> dict[str, Any]:
    """`run_cell`, its errors as a result."""
    return _attempt(run_cell, setup, cell, setup.cells / f"{cell.id}.log", tick)


def try_pretraining(setup: Setup, work: Pretraining, tick: ProgressCallback = ignore) -> dict[str, Any]:
    """`run_pretraining`, its errors as a result."""
    return _attempt(run_pretraining, setup, work, setup.encoders / f"{work.id}.log", tick)


def _attempt(
    function: Callable, setup: Setup, item: Cell | Pretraining, log: Path, tick: ProgressCallback
) -> dict[str, Any]:
    try:
        with _Pace(tick) as paced:
            result = function(setup, item, paced)
    except DmcvbError as error:
        return {"error": str(error)}
    except Exception as error:  # one cell's bug or lack of memory must not cost the hours of the others
        write_text(log, traceback.format_exc())
        first = (str(error).splitlines() or [""])[0]
        return {"error": f"{type(error).__name__}: {first} (all of it in {log})"}
    log.unlink(missing_ok=True)
    return result


class _Pace:
    """A tick that adds steps up and passes them on a few times a second."""

    def __init__(self, tick: ProgressCallback):
        self._tick, self._what, self._steps, self._told = tick, "", 0, time.monotonic()

    def __call__(self, what: str, steps: int) -> None:
        if what != self._what:
            self.tell()
        self._what, self._steps = what, self._steps + steps
        if time.monotonic() - self._told > TICK_SECONDS:
            self.tell()

    def tell(self) -> None:
        if self._what:
            self._tick(self._what, self._steps)
        self._steps, self._told = 0, time.monotonic()

    def __enter__(self) -> _Pace:
        return self

    def __exit__(self, *_) -> None:
        self.tell()


def planned_steps(profile: Profile, cells: Sequence[Cell]) -> int:
    """Adam steps of cells, their encoders and decoders."""
    encoders = set(filter(None, map(pretraining_of, cells)))
    decoders = sum(2 * profile.readout_steps for cell in cells if not (cell.agent.sees_state or cell.agent.own))
    policies = sum(policy_steps(profile, cell.agent) for cell in cells)
    return policies + decoders + len(encoders) * profile.pretrain_steps


def default_workers(device: str) -> int:
    """Cells side by side: two of one thread each are faster than one of two. An accelerator is not shared."""
    return min(2, usable_cores()) if device == "cpu" else 1


def default_threads(workers: int) -> int:
    """Threads of each of `workers` processes."""
    return max(1, usable_cores() // workers)
