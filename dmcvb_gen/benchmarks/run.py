"""Running cells: a release, cells and a profile in, one JSON result a cell out; what is done is not done again.

    <out>/encoders/<id>.safetensors, .json   a pre-trained encoder and its learning curve, shared by cells
    <out>/cells/<id>.json                    a cell's scores, curve, settings, times
    <out>/cells/<id>.rollout.png             frames of an evaluation episode
    <out>/cells/<id>.decoder.png             what decoders see through the encoder

A result carries the fingerprint of all that decides it (cell, profile, digests of the data, seed); one with another
fingerprint is made again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import multiprocessing
import os
import resource
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from dmcvb_gen import __version__
from dmcvb_gen.agents.catalog import Agent, make_encoder, make_policy, make_pretrainer
from dmcvb_gen.agents.data import Source, TrainingData, load_data
from dmcvb_gen.agents.learners import ObservationReadout, StateReadout
from dmcvb_gen.agents.trainer import Curve, TrainSettings, draw, forget, hold_out_losses, train
from dmcvb_gen.benchmarks.evaluate import Evaluator
from dmcvb_gen.benchmarks.paper import paper_score
from dmcvb_gen.benchmarks.profiles import Profile
from dmcvb_gen.benchmarks.tables import Cell, Part, slug
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.store import Release, Subset, open_release
from dmcvb_gen.store.manifest import write_json_atomically
from dmcvb_gen.store.writer import subset_digest
from dmcvb_gen.tasks import get_task

RESULT_VERSION = 1
Tick = Callable[[str, int], None]
"""Told what is being done and how many Adam steps were made since the last call."""


@dataclass(frozen=True)
class Setup:
    """What all cells of a run share.

    Attributes:
      root: the release's folder. out: the report's folder.
      device: "cpu" or "cuda". threads: of torch and physics in one process.
      compile: torch.compile the losses.
      memory: bytes of pictures held at most; None: half of what is free.
    """

    root: str
    out: str
    profile: Profile
    seed: int = 0
    device: str = "cpu"
    threads: int = 1
    compile: bool = False
    dino_weights: str | None = None
    backgrounds: str | None = None
    memory: int | None = None

    @property
    def cells(self) -> Path:
        return Path(self.out) / "cells"

    @property
    def encoders(self) -> Path:
        return Path(self.out) / "encoders"


@dataclass(frozen=True)
class Pretraining:
    """An encoder to pre-train; cells that ask for the same one share it."""

    task: str
    setting: str
    agent: Agent
    parts: tuple[Part, ...]

    @property
    def id(self) -> str:
        options = self.agent.name.partition(":")[2]
        labels = "+".join(part.label for part in self.parts)
        return "_".join(slug(p) for p in (self.task, self.setting, self.agent.pretrain, options, labels) if p)


def pretraining_of(cell: Cell) -> Pretraining | None:
    """What a cell's encoder needs; None where it is trained with the policy, or is DINO's."""
    agent = cell.agent
    if agent.pretrain in (None, "dino"):
        return None
    encoder_agent = dataclasses.replace(agent, policy="bc")  # the policy has no part in it
    setting = cell.pretrain_parts[0].subset.split("/")[-1]
    return Pretraining(cell.task, setting, encoder_agent, cell.pretrain_parts)


def fingerprint(setup: Setup, release: Release, work: Cell | Pretraining) -> str:
    """SHA-256 of everything that decides a result, the machine aside."""
    subsets = {part.subset for part in (work.parts if isinstance(work, Pretraining) else ())}
    subsets |= set(work.subsets if isinstance(work, Cell) else ())
    facts = {
        "version": RESULT_VERSION,
        "work": dataclasses.asdict(work),
        "profile": dataclasses.asdict(setup.profile),
        "seed": setup.seed,
        "data": {name: subset_digest(release[name].commits) for name in sorted(subsets)},
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def read_result(path: Path, wanted: str | None = None) -> dict[str, Any] | None:
    """A result file, or None where there is none with that fingerprint."""
    try:
        result = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return result if wanted is None or result.get("fingerprint") == wanted else None


# -- one piece of work ----------------------------------------------------------------------------


class _DataCache:
    """The data of the last parts asked for: cells that follow each other often share them."""

    def __init__(self):
        self._key, self._data = None, None

    def get(self, setup: Setup, release: Release, parts: Sequence[Part], pixels: bool, stack: int) -> TrainingData:
        key = (setup.root, setup.seed, tuple(parts), setup.device, setup.memory)
        if self._key is None or self._key[0] != key or (pixels and not self._key[1]):
            self._key = self._data = None  # free the old pictures before new ones are read
            sources = [Source(release[p.subset], p.share, p.episodes, p.goal_pair) for p in parts]
            self._data = load_data(sources, pixels=pixels, seed=setup.seed, device=setup.device, memory=setup.memory)
            self._key = (key, pixels)
        return self._data.with_stack(stack) if pixels else self._data.states_only()


_cache = _DataCache()


def _settings(setup: Setup, steps: int, half: bool = True, evaluations: int = 1) -> TrainSettings:
    return TrainSettings(
        steps=steps,
        batch_size=setup.profile.batch_size,
        evaluate_every=-(-steps // evaluations),
        half=half,
        decay=setup.profile.decay,
        compile=setup.compile,
        workers=1 if setup.device != "cpu" else 0,
    )


def run_pretraining(setup: Setup, work: Pretraining, tick: Tick = lambda what, steps: None) -> dict[str, Any]:
    """Pre-train an encoder, unless it is there. Gives its facts: curve, seconds."""
    release = open_release(setup.root)
    mark = fingerprint(setup, release, work)
    facts_path, weights_path = setup.encoders / f"{work.id}.json", setup.encoders / f"{work.id}.safetensors"
    done = read_result(facts_path, mark)
    if done and weights_path.exists():
        return done
    data = _cache.get(setup, release, work.parts, True, work.agent.stack)
    torch.manual_seed(setup.seed)
    encoder = make_encoder(work.agent, data)
    learner = make_pretrainer(work.agent, encoder, data).to(setup.device)
    folder = setup.encoders / f"{work.id}.{mark[:12]}.run"
    started = time.perf_counter()
    curve = train(
        learner,
        data,
        _settings(setup, setup.profile.pretrain_steps),
        seed=setup.seed,
        folder=folder,
        tick=lambda steps: tick(f"{work.agent.pretrain} encoder of {work.task}", steps),
    )
    weights_path.parent.mkdir(parents=True, exist_ok=True)
    save_file({name: value.cpu().contiguous() for name, value in encoder.state_dict().items()}, str(weights_path))
    facts = {"fingerprint": mark, "curve": curve, "seconds": time.perf_counter() - started}
    write_json_atomically(facts_path, facts)
    _clear(folder)
    return facts


def _clear(folder: Path) -> None:
    forget(folder)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _load_encoder(setup: Setup, work: Pretraining, encoder: nn.Module) -> None:
    path = setup.encoders / f"{work.id}.safetensors"
    try:
        encoder.load_state_dict(load_file(str(path)))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise DmcvbError(f"cannot read the encoder {path} ({error}); delete it and run again") from None


def run_cell(setup: Setup, cell: Cell, tick: Tick = lambda what, steps: None) -> dict[str, Any]:
    """Train and evaluate one cell, unless its result is there. Gives the result.

    Raises:
      DmcvbError: DINO's weights are missing, the renderer cannot start, or training does not stay finite.
    """
    release = open_release(setup.root)
    mark = fingerprint(setup, release, cell)
    path = setup.cells / f"{cell.id}.json"
    done = read_result(path, mark)
    if done:
        return done
    started = time.perf_counter()
    agent, profile, pixels = cell.agent, setup.profile, not cell.agent.sees_state
    before = pretraining_of(cell)
    pretrained = run_pretraining(setup, before, tick) if before else None
    data = _cache.get(setup, release, cell.policy, pixels, agent.stack)
    torch.manual_seed(setup.seed)
    encoder = make_encoder(agent, data, setup.dino_weights)
    if before:
        _load_encoder(setup, before, encoder)
    policy = make_policy(agent, encoder, data).to(setup.device)
    subset = release[cell.policy[0].subset]
    evaluator = Evaluator(
        subset,
        pixels=pixels,
        normalization=data.normalization,
        stack=agent.stack,
        episodes=profile.episodes,
        max_steps=profile.episode_steps,
        pair=_goal_cells(release, subset, cell.policy[0].goal_pair),
        backgrounds=setup.backgrounds,
        device=setup.device,
        threads=setup.threads,
    )
    steps = policy_steps(profile, agent)
    folder = setup.cells / f"{cell.id}.{mark[:12]}.run"

    def evaluate(learner) -> dict[str, Any]:
        score = evaluator(learner)
        if score.pictures is not None:
            _save_sheet(setup.cells / f"{cell.id}.rollout.png", [score.pictures])
        return {"score": score.facts()}

    label = f"{agent.name} on {cell.task} {cell.policy_label}/{cell.setting}"
    trained = time.perf_counter()
    try:
        curve = train(
            policy,
            data,
            _settings(setup, steps, half=pixels, evaluations=profile.evaluations),
            seed=setup.seed,
            folder=folder,
            evaluate=evaluate,
            tick=lambda made: tick(label, made),
        )
    finally:
        evaluator.close()
    trained = time.perf_counter() - trained
    evaluations = [point for point in curve if "score" in point]
    best = max(evaluations, key=lambda point: point["score"]["mean"])
    inspected = time.perf_counter()
    inspection = inspect(setup, policy.encoder, data, cell, tick) if pixels and profile.readout_steps else None
    inspected = time.perf_counter() - inspected
    setup.cells.mkdir(parents=True, exist_ok=True)
    evaluating = sum(point["score"]["seconds"] for point in evaluations)
    paper = (
        paper_score(cell.task, cell.policy_label, cell.setting, agent.paper_name) if cell.benchmark == "b1" else None
    )
    result = {
        "fingerprint": mark,
        "id": cell.id,
        "cell": cell.facts() | {"policy_label": cell.policy_label},
        "profile": dataclasses.asdict(profile),
        "score": best["score"] | {"step": best["step"]},
        "final": evaluations[-1]["score"],
        "evaluations": len(evaluations),
        "paper": paper and {"mean": paper[0], "stderr": paper[1]},
        "data_return": float(data.returns.mean()),
        "episodes": len(data.lengths),
        "curve": [_thin(point) for point in curve],
        "pretraining": pretrained and {key: pretrained[key] for key in ("curve", "seconds")},
        "inspection": inspection,
        "seconds": {
            "training": trained - evaluating,
            "evaluation": evaluating,
            "inspection": inspected,
            "all": time.perf_counter() - started,
        },
        "steps_per_second": steps / max(trained - evaluating, 1e-9),
        "memory_bytes": _peak_memory(setup.device),
        "machine": {"device": setup.device, "threads": setup.threads, "torch": torch.__version__},
        "generator": f"dmcvb-gen {__version__}",
    }
    write_json_atomically(path, result)
    _clear(folder)
    return result


def _thin(point: dict[str, Any]) -> dict[str, Any]:
    """A point of the curve without the returns of every episode."""
    if "score" not in point:
        return point
    return point | {"score": {key: value for key, value in point["score"].items() if key != "returns"}}


def _goal_cells(release: Release, subset: Subset, pair: int | None) -> tuple | None:
    """The (start, goal) cells of a subset's fixed pair, as the rollout drew them."""
    if pair is None:
        return None
    from dmcvb_gen.tasks.ant_maze import fixed_pairs

    count = int(subset.read("goal_pair").max()) + 1
    return fixed_pairs(get_task(subset.task).layout, count, release.manifest.recipe["seed"])[pair]


def _peak_memory(device: str) -> int:
    if device.startswith("cuda"):
        return int(torch.cuda.max_memory_allocated())
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def inspect(
    setup: Setup, encoder: nn.Module, data: TrainingData, cell: Cell, tick: Tick = lambda what, steps: None
) -> dict[str, Any]:
    """What a frozen encoder still knows: test errors of decoders of its observations and states (section 5.1)."""
    curves: dict[str, Curve] = {}
    errors: dict[str, float | None] = {}
    readouts = {
        "observation": ObservationReadout(encoder, data.channels, data.frames.size),
        "state": StateReadout(encoder, data.state.shape[1]),
    }
    settings = _settings(setup, setup.profile.readout_steps)
    for name, learner in readouts.items():
        learner.to(setup.device)
        curves[name] = train(
            learner, data, settings, seed=setup.seed, tick=lambda made, n=name: tick(f"{n} decoder", made)
        )
        errors[f"{name}_mse"] = hold_out_losses(learner, data, settings.batch_size).get("test_loss")
    held_out = len(data.hold_out_rows) > 0
    batch = draw(readouts["observation"], data, 8, setup.seed, 0, hold_out=held_out)
    with torch.no_grad(), readouts["observation"].precision():
        seen = readouts["observation"].reconstruct(batch.observation).float()
    newest = slice(-data.frames.channels, None)
    rows = [_to_pictures(pictures[:, newest][:, :3]) for pictures in (batch.observation, seen)]
    _save_sheet(setup.cells / f"{cell.id}.decoder.png", rows)
    return {**errors, "curves": curves, "held_out": held_out}


def _to_pictures(values: torch.Tensor) -> np.ndarray:
    return ((values + 0.5).clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()


def _save_sheet(path: Path, rows: Sequence[np.ndarray]) -> None:
    """Rows of (picture, size, size, 3) uint8 as one PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet = np.concatenate([np.concatenate(list(row), axis=1) for row in rows])
    Image.fromarray(sheet).save(path)


# -- many cells -----------------------------------------------------------------------------------


def run_cells(
    setup: Setup, cells: Sequence[Cell], workers: int = 1, tick: Tick = lambda what, steps: None
) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Results of cells as they come; encoders are trained first, each once, the cells that need none beside them.

    A cell that cannot be run has a result of {"error": message}; the others go on.

    Args:
      workers: processes (started fresh, never forked); 1: all in this one.
    """
    encoders = list(dict.fromkeys(filter(None, map(pretraining_of, cells))))
    if workers == 1:
        torch.set_num_threads(setup.threads)
        failed = {work: error for work in encoders if (error := _try(run_pretraining, setup, work, tick).get("error"))}
        for cell in cells:
            error = failed.get(pretraining_of(cell))
            yield cell, {"error": error} if error else _try(run_cell, setup, cell, tick)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(setup.threads,))
    try:
        running: dict[Future, Pretraining | Cell] = {}

        def submit(members: Iterable[Cell]) -> None:
            running.update({pool.submit(_try, run_cell, setup, cell): cell for cell in members})

        running.update({pool.submit(_try, run_pretraining, setup, work): work for work in encoders})
        submit(cell for cell in cells if pretraining_of(cell) is None)
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                item, result = running.pop(future), future.result()
                if isinstance(item, Cell):
                    tick(item.id, policy_steps(setup.profile, item.agent))
                    yield item, result
                    continue
                tick(f"encoder {item.id}", setup.profile.pretrain_steps)
                after = [cell for cell in cells if pretraining_of(cell) == item]
                if "error" in result:
                    yield from ((cell, {"error": result["error"]}) for cell in after)
                else:
                    submit(after)
    except BrokenProcessPool:
        raise DmcvbError(
            "a worker process was killed (out of memory?); finished cells are kept: run the same command again with "
            "fewer --workers"
        ) from None
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def policy_steps(profile: Profile, agent: Agent) -> int:
    """Adam steps of a cell's policy."""
    if agent.sees_state:
        return profile.state_steps
    return profile.frozen_steps if agent.pretrain else profile.pixel_steps


def planned_steps(profile: Profile, cells: Sequence[Cell]) -> int:
    """Adam steps of cells and their encoders, decoders left out."""
    encoders = set(filter(None, map(pretraining_of, cells)))
    return sum(policy_steps(profile, cell.agent) for cell in cells) + len(encoders) * profile.pretrain_steps


def _start_worker(threads: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    torch.set_num_threads(threads)


def _try(function, *arguments) -> dict[str, Any]:
    try:
        return function(*arguments)
    except DmcvbError as error:
        return {"error": str(error)}


def default_threads(workers: int) -> int:
    """Threads of each of `workers` processes."""
    return max(1, (os.cpu_count() or 1) // workers)
