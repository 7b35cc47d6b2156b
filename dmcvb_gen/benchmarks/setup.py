"""Settings that all cells of a validation share, and the file names and fingerprints of their results.

    <out>/encoders/<id>.safetensors, .json   a pre-trained encoder and its learning curve, shared by cells
    <out>/cells/<id>.json                    a cell's scores, curve, settings, times
    <out>/cells/<id>.safetensors             its trained policy (`trained.load_agent`)
    <out>/cells/<id>.rollout.png             frames of an evaluation episode
    <out>/cells/<id>.decoder.png             what decoders see through the encoder
    <out>/cells/<id>.log, encoders/<id>.log  the traceback of one that failed

A result carries the fingerprint of all that decides it (cell, profile, digests of data, backgrounds and weights, seed);
one with another fingerprint is made again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmcvb_gen.agents.catalog import Agent
from dmcvb_gen.benchmarks.evaluate import protocol
from dmcvb_gen.benchmarks.goals import goal_cells
from dmcvb_gen.benchmarks.own import OwnAgent
from dmcvb_gen.benchmarks.profiles import Profile
from dmcvb_gen.benchmarks.suites import Cell, Slice, slug
from dmcvb_gen.dataset import Release, open_release
from dmcvb_gen.dataset.writer import subset_digest
from dmcvb_gen.files import write_json
from dmcvb_gen.loaders.painted import DEFAULT_CACHE, PaintedSubset, Painting, painted_release
from dmcvb_gen.spec import is_maze

RESULT_VERSION = 3


@dataclass(frozen=True)
class Setup:
    """Settings that all cells of a run share.

    Attributes:
      root: the release's folder. out: the report's folder.
      device: "cpu" or "cuda". threads: of torch and physics in one process.
      compile: torch.compile the losses.
      precision: "float32" or "bfloat16", of losses on pictures.
      memory: bytes of pictures held at most, over all workers (on a cluster: by each cell); None: half of what is free
        (on a cluster: of a cell's share of its node).
      run: label of one run's cells, so that a process opens the release for the first of them; "": for each.
    """

    root: str
    out: str
    profile: Profile
    seed: int = 0
    device: str = "cpu"
    threads: int = 1
    compile: bool = False
    precision: str = "float32"
    dino_weights: str | None = None
    backgrounds: str | None = None
    memory: int | None = None
    run: str = ""

    @property
    def cells(self) -> Path:
        return Path(self.out) / "cells"

    @property
    def encoders(self) -> Path:
        return Path(self.out) / "encoders"


def open_data(setup: Setup) -> Release:
    """The release of a run; images that it does not store are rendered when they are read.

    Raises:
      StoreError: there is no release, or it is damaged.
    """
    room = DEFAULT_CACHE if setup.memory is None else min(setup.memory, DEFAULT_CACHE)
    return painted_release(open_release(setup.root), Painting(backgrounds=setup.backgrounds, cache_bytes=room), True)


_opened: dict[str, Release] = {}
"""The release of the last run that a cell of this process belonged to."""


def data_of_run(setup: Setup) -> Release:
    """`open_data`, once for all cells of a run: of a large release it takes a second.

    Releases that are painted on reading are opened each time, as each of their subsets keeps pictures.
    """
    if setup.run not in _opened:
        _opened.clear()
        release = open_data(setup)
        if not setup.run or any(isinstance(subset, PaintedSubset) for subset in release.subsets.values()):
            return release
        _opened[setup.run] = release
    return _opened[setup.run]


@dataclass(frozen=True)
class Pretraining:
    """An encoder to pre-train; cells that ask for the same one share it."""

    task: str
    setting: str
    agent: Agent
    parts: tuple[Slice, ...]

    @property
    def id(self) -> str:
        options = self.agent.name.partition(":")[2]
        labels = "+".join(part.label for part in self.parts)
        return "_".join(slug(p) for p in (self.task, self.setting, self.agent.pretrain, options, labels) if p)


def pretraining_of(cell: Cell) -> Pretraining | None:
    """Return the pre-training of a cell's encoder; None if it is trained with the policy, or comes from a file."""
    if cell.agent.pretrain is None or cell.agent.ready_encoder:
        return None
    setting = cell.pretrain_parts[0].subset.split("/")[-1]
    return Pretraining(cell.task, setting, cell.agent.pretraining, cell.pretrain_parts)


def sees_pictures(agent: Agent) -> bool:
    """Return True if an agent is evaluated on pictures."""
    return OwnAgent.load(agent.own).pixels if agent.own else not agent.sees_state


def fingerprint(setup: Setup, release: Release, work: Cell | Pretraining) -> str:
    """SHA-256 of everything that decides a result; of the machine, the precision alone.

    Raises:
      DmcvbError: an encoder's weights or background videos are needed and not there.
    """
    subsets = {part.subset for part in (work.parts if isinstance(work, Pretraining) else ())}
    subsets |= set(work.subsets if isinstance(work, Cell) else ())
    facts = {
        "version": RESULT_VERSION,
        "work": dataclasses.asdict(work) | {"agent": work.agent.facts()},
        "profile": dataclasses.asdict(setup.profile),
        "seed": setup.seed,
        "data": {name: subset_digest(release[name].commits) for name in sorted(subsets)},
    }
    if not (work.agent.sees_state or work.agent.own):
        facts["precision"] = setup.precision
    if code := work.agent.foreign_code():
        facts["code"] = code
    if isinstance(work, Cell):
        subset, pair = release[work.policy[0].subset], work.policy[0].goal_pair
        facts["evaluation"] = protocol(
            subset,
            None if pair is None else goal_cells(subset, pair),
            setup.backgrounds,
            pictures=sees_pictures(work.agent),
            max_steps=setup.profile.episode_steps,
        )
        if setup.profile.readout_steps and not (work.agent.sees_state or work.agent.own):  # `state_units` are of them
            facts["units"] = sorted(subset_digest(s.commits) for s in release.subsets.values() if s.task == work.task)
        if is_maze(work.task):
            facts["speed"] = "straight"  # results of before measured the data's along the path
        if work.agent.own:
            own = OwnAgent.load(work.agent.own)
            facts["own"] = own.digest
            if own.learns and (helpers := own.helpers):
                facts["own_modules"] = helpers
        if work.agent.ready_encoder:
            facts[work.agent.pretrain] = work.agent.ready_encoder.digest(setup.dino_weights)
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


PRECISION_FILE = "precision.json"
"""What `--precision auto` took when the report was begun: a report that goes on keeps to it."""


def kept_precision(out: str | Path, device: str) -> str | None:
    """The precision in which a report's networks compute on a device; None if it has not begun."""
    found = (read_result(Path(out) / PRECISION_FILE) or {}).get(device)
    return found if found in ("float32", "bfloat16") else None


def keep_precision(setup: Setup) -> None:
    """Note the precision of a report that begins."""
    path = Path(setup.out) / PRECISION_FILE
    write_json(path, (read_result(path) or {}) | {setup.device: setup.precision})


def read_result(path: Path, wanted: str | None = None) -> dict[str, Any] | None:
    """A result file, or None if there is none with that fingerprint."""
    try:
        result = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    if not isinstance(result, dict):
        return None
    return result if wanted is None or result.get("fingerprint") == wanted else None
