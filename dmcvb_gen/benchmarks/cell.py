"""Train and score cells of a release; each result is a JSON file, and one that is there is not made again.

    <out>/encoders/<id>.safetensors, .json   a pre-trained encoder and its learning curve, shared by cells
    <out>/cells/<id>.json                    a cell's scores, curve, settings, times
    <out>/cells/<id>.safetensors             its trained policy (`evaluate.load_agent`)
    <out>/cells/<id>.rollout.png             frames of an evaluation episode
    <out>/cells/<id>.decoder.png             what decoders see through the encoder
    <out>/cells/<id>.log, encoders/<id>.log  the traceback of one that failed

A result carries the fingerprint of all that decides it (cell, budget, digests of data, backgrounds and weights); one
with another fingerprint is made again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import time
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from dmcvb_gen.agents.catalog import Agent, make_encoder, make_policy, make_pretrainer
from dmcvb_gen.agents.data import TrainingData, default_memory, labeled_episodes, load_data
from dmcvb_gen.agents.dino import DinoEncoder
from dmcvb_gen.agents.learners import Learner, Policy
from dmcvb_gen.agents.paper import Autoencoder, StateProbe
from dmcvb_gen.agents.probe import action_probe
from dmcvb_gen.agents.trainer import Budget, Curve, draw, train
from dmcvb_gen.benchmarks.evaluate import SPLIT, Evaluator, Score, TrainedAgent, evaluation_steps, renderer_choice
from dmcvb_gen.benchmarks.plan import BENCHMARKS, ENCODER, Cell, Results, goal_cells
from dmcvb_gen.dataset.gate import Release
from dmcvb_gen.dataset.manifest import canonical_json
from dmcvb_gen.dataset.reader import Subset
from dmcvb_gen.distractors import load_backgrounds
from dmcvb_gen.errors import DmcvbError, first_line
from dmcvb_gen.files import replacing, write_json, write_text
from dmcvb_gen.generate.inputs import video_source
from dmcvb_gen.loaders.painted import DEFAULT_CACHE, Painting, painted_release
from dmcvb_gen.parallel import Needs, ProgressCallback, Workers, ignore, open_pool
from dmcvb_gen.policies.evaluation import goal_scores
from dmcvb_gen.seeding import generators_kept
from dmcvb_gen.tasks import ACTION_REPEAT, get_task
from dmcvb_gen.version import __version__

RESULT_VERSION = 8
PAPER_SIZE = 64
"""Pixels a side of the paper's images."""
INSPECTED = 150_000
"""Held-out transitions that an inspection's error is the mean of, at most (the paper's number)."""


# -- what decides a result --------------------------------------------------------------------------


def open_data(root: str | Path, budget: Budget) -> Release:
    """The release of a run; images that it does not store are rendered when they are read.

    Raises:
      StoreError: there is no release, or it is damaged.
    """
    room = DEFAULT_CACHE if budget.memory is None else min(budget.memory, DEFAULT_CACHE)
    return painted_release(Release.open(root), Painting(backgrounds=budget.backgrounds, cache_bytes=room), True)


def data_digests(release: Release, cell: Cell) -> dict[str, str]:
    """Subset -> SHA-256 of the records of all its shards that are here, of all that a cell learns from."""
    digests = {name: hashlib.sha256() for name in sorted(cell.subsets)}
    for name, digest in digests.items():
        for layer in release[name].layers:
            here = release.here(layer.name)
            for shard, record in release.records(layer.name).items():
                if shard in here:
                    digest.update(f"{layer.name} {shard} ".encode() + canonical_json(record))
    return {name: digest.hexdigest() for name, digest in digests.items()}


def evaluation_of(release: Release, budget: Budget, cell: Cell) -> dict[str, Any]:
    """All that decides the episodes of a cell's evaluation but the policy, as plain values.

    Raises:
      BackgroundError: there are no `val` videos.
    """
    subset, pair = release[cell.policy[0].subset], cell.policy[0].goal_pair
    task = get_task(subset.task).at(subset.record.action_repeat)
    facts = {"task": subset.task, "steps": evaluation_steps(task, budget.episode_steps)}
    facts["goals"] = goal_cells(subset, pair)
    if task.action_repeat != ACTION_REPEAT:
        facts["action_repeat"] = task.action_repeat
    if not cell.agent.sees_state:
        facts |= {"size": subset.record.size, "renderer": renderer_choice(subset), "backgrounds": None}
        if subset.record.distractor.kind != "none":
            source = video_source(release.path, subset.record, budget.backgrounds)
            facts["backgrounds"] = load_backgrounds(source, SPLIT).digest
    return facts


def fingerprint(release: Release, budget: Budget, cell: Cell) -> str:
    """SHA-256 of everything that decides a result; of the machine, the precision alone.

    Raises:
      DmcvbError: an encoder's weights or background videos are needed and not there.
    """
    agent = cell.agent
    facts = {"version": RESULT_VERSION, "cell": cell.facts(), "budget": budget.facts()}
    facts |= {"data": data_digests(release, cell), "code": agent.foreign_code()}
    if agent.sees_state:
        facts["budget"].pop("precision")
    if cell.benchmark != ENCODER:
        facts["evaluation"] = evaluation_of(release, budget, cell)
        if agent.sees_by_dino:
            facts["weights"] = DinoEncoder.digest(budget.dino_weights)
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def file_of(out: str | Path, cell: Cell, suffix: str) -> Path:
    """A file of a cell in a report's folder, e.g. its ".json"."""
    return Path(out) / ("encoders" if cell.benchmark == ENCODER else "cells") / f"{cell.id}{suffix}"


def read_result(path: Path, wanted: str) -> dict[str, Any] | None:
    """A result file, or None if there is none with that fingerprint."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        result = json.loads(path.read_text())
        return result if result.get("fingerprint") == wanted else None
    return None


def with_kept(made: Results, release: Release, out: str | Path, budget: Budget) -> Results:
    """Results, and those in a report's folder whose fingerprint is that of their cell on this release, by this budget.

    The first of a cell counts. States know of no distractors, so an agent that sees them has one cell for all settings.
    """
    found = list(made)
    for path in sorted((Path(out) / "cells").glob("*.json")):
        with contextlib.suppress(DmcvbError, OSError, ValueError, LookupError, TypeError, AttributeError):
            result = json.loads(path.read_text())
            cell = Cell.of(result["cell"])
            BENCHMARKS.get(cell.benchmark)
            if result["fingerprint"] == fingerprint(release, budget, cell):
                found.append((cell, result))
    first: dict[tuple, tuple[Cell, dict[str, Any]]] = {}
    for cell, result in found:
        setting = "" if cell.agent.sees_state else cell.setting
        first.setdefault((cell.benchmark, cell.task, setting, cell.label, cell.policy_label), (cell, result))
    return list(first.values())


# -- one cell ---------------------------------------------------------------------------------------

_held: dict[tuple, TrainingData] = {}
"""The data of the last slices asked for: cells that follow each other often share them."""


def policy_steps(budget: Budget, agent: Agent) -> int:
    """Adam steps of a cell's policy."""
    return budget.state_steps if agent.sees_state else budget.pixel_steps


class CellRun:
    """The training and evaluation of one cell.

    Args:
      root: the release's folder. out: the report's folder.
      tick: told what is being done and how many Adam steps were made since the last call.

    Raises:
      DmcvbError: there is no release, or DINO's weights or the `val` videos are missing.
    """

    def __init__(self, root: str | Path, out: str | Path, budget: Budget, cell: Cell, tick: ProgressCallback = ignore):
        self.root, self.out, self.budget, self.cell, self.tick = str(root), Path(out), budget, cell, tick
        self.release = open_data(root, budget)
        self.mark, self.subset = fingerprint(self.release, budget, cell), self.release[cell.policy[0].subset]
        self._latents: TrainingData | None = None  # of a frozen encoder, for policy and decoders
        # Encoders, and policies whose scores count; DINO's weights are a large file of the user's.
        self.keeps_weights = cell.benchmark == ENCODER or (budget.scores and not cell.agent.sees_by_dino)

    def path(self, suffix: str) -> Path:
        """A file of the cell, e.g. its ".json"."""
        return file_of(self.out, self.cell, suffix)

    @generators_kept()
    def result(self) -> dict[str, Any]:
        """Train and score it, unless its result is there.

        Raises:
          DmcvbError: the renderer cannot start, or training does not stay finite.
        """
        done = read_result(self.path(".json"), self.mark)
        if done and (not self.keeps_weights or self.path(".safetensors").exists()):
            return done
        made = self._pretrain() if self.cell.benchmark == ENCODER else self._train()
        facts = {"id": self.cell.id, "fingerprint": self.mark, "cell": self.cell.facts()}
        facts |= {"budget": self.budget.facts() | {"note": self.budget.note}, **made}
        write_json(self.path(".json"), facts)
        return facts

    def data(self, pixels: bool = True, stack: int = 3) -> TrainingData:
        """The data of the cell's slices; painting many images takes minutes, so they are kept for the next cell."""
        budget, parts = self.budget, self.cell.policy
        digests = tuple(data_digests(self.release, self.cell).items())  # a release may have grown
        key = (self.root, parts, digests, budget.seed, budget.backgrounds, budget.device, budget.memory)
        if not pixels and (key, False) not in _held and (key, True) in _held:
            return _held[key, True].but(frames=None)
        if (key, pixels) not in _held:
            _held.clear()  # free the old pictures before new ones are read
            names = " + ".join(dict.fromkeys(part.subset for part in parts))
            _held[key, pixels] = load_data(
                self.release,
                parts,
                pixels=pixels,
                seed=budget.seed,
                device=budget.device,
                memory=budget.memory,
                scratch=self.out,
                tick=lambda share: self.tick(f"images of {names}, {share:.0%}", 0) if pixels else None,
            )
        return _held[key, pixels].but(stack=stack) if pixels else _held[key, pixels]

    # -- training

    def _pretrain(self) -> dict[str, Any]:
        """Train an encoder and keep it."""
        budget, agent = self.budget, self.cell.agent
        data = self.data(stack=agent.stack)
        if self.cell.pretrain:
            labels = labeled_episodes(self.release, self.cell.policy, self.cell.pretrain, budget.seed)
            data = data.with_labels(labels)
        torch.manual_seed(budget.seed)
        encoder = make_encoder(agent, data.sizes, architecture=budget.network)
        learner = make_pretrainer(agent, encoder, data.sizes, budget.network).to(budget.device)
        steps, label = budget.pixel_steps, f"{agent.pretrain} encoder of {self.cell.task}"
        shift = learner.shifts and budget.shifts(steps, len(data))
        curve = self._fit(learner, data, steps, label, shift=shift)
        with replacing(self.path(".safetensors")) as path:
            save_file({name: value.cpu().contiguous() for name, value in encoder.state_dict().items()}, str(path))
        probe = action_probe(learner, data) if hasattr(learner, "latent_action") else None
        return {"curve": curve, "seconds": curve[-1]["seconds"], "action_probe": probe}

    def _train(self) -> dict[str, Any]:
        """Train a policy, score it and look into its encoder."""
        budget, cell, pixels = self.budget, self.cell, not self.cell.agent.sees_state
        encoder = cell.encoder and CellRun(self.root, self.out, budget, cell.encoder, self.tick)
        pretrained = encoder and encoder.result()
        started = time.perf_counter()
        data = self.data(pixels, cell.agent.stack)
        torch.manual_seed(budget.seed)
        phi = make_encoder(cell.agent, data.sizes, budget.dino_weights, budget.network)
        if encoder:
            _load_encoder(encoder.path(".safetensors"), phi)
        policy = make_policy(cell.agent, phi, data.sizes, budget.network).to(budget.device)
        evaluation = evaluation_of(self.release, budget, cell)
        trained = TrainedAgent(cell.agent, data.sizes, policy, data.normalization, evaluation)
        curve = self._train_policy(policy, trained, data)
        inspection = self.inspect(policy.encoder, data) if pixels and budget.readout_steps else None
        return self._facts(data, curve) | {
            "pretraining": pretrained and {key: pretrained[key] for key in ("curve", "seconds", "action_probe")},
            "inspection": inspection,
            "seconds": time.perf_counter() - started,
        }

    def _train_policy(self, policy: Policy, trained: TrainedAgent, data: TrainingData) -> Curve:
        budget, agent = self.budget, self.cell.agent
        steps, frozen = policy_steps(budget, agent), agent.pretrain is not None
        shift = budget.frozen_shift if frozen else budget.shifts(steps, len(data))
        if frozen:
            data = self._encoded(policy.encoder, data, steps * budget.batch_size)
        evaluator = Evaluator(
            self.subset,
            pixels=trained.pixels,
            stack=agent.stack,
            episodes=budget.episodes,
            max_steps=budget.episode_steps,
            pair=goal_cells(self.subset, self.cell.policy[0].goal_pair),
            backgrounds=budget.backgrounds,
            threads=budget.threads,
        )
        with contextlib.closing(evaluator):
            best = -math.inf

            def evaluate(_: Learner) -> dict[str, Any]:
                nonlocal best
                score = evaluator.score(trained)
                if self.keeps_weights and score.mean > best:  # the policy whose score counts
                    trained.save(self.path(".safetensors"), budget.network)
                best = max(best, score.mean)
                if score.pictures is not None:
                    _save_sheet(self.path(".rollout.png"), [score.pictures])
                return {"score": score.facts()}

            label = f"{agent.name} on {self.cell.place}"
            return self._fit(policy, data, steps, label, shift=shift, evaluate=evaluate)

    def _fit(self, learner: Learner, data: TrainingData, steps: int, label: str, **options: Any) -> Curve:
        return train(learner, data, self.budget, steps, tick=lambda made: self.tick(label, made), **options)

    def _encoded(self, encoder: nn.Module, data: TrainingData, draws: int) -> TrainingData:
        """Data of a frozen encoder: latents are computed once if that pays and the budget does not shift pictures.

        Args:
          draws: how many transitions will be drawn; if there are more rows than that, each is encoded as it is drawn.
        """
        if self.budget.frozen_shift or draws < len(data.state):
            return data
        dtype = torch.bfloat16 if self.budget.precision == "bfloat16" else torch.float32
        if data.latent is None and self._latents is None:
            self._latents = data.encoded(encoder, dtype, lambda share: self.tick(f"encoding, {share:.0%}", 0))
        return self._latents or data

    def _facts(self, data: TrainingData, curve: Curve) -> dict[str, Any]:
        """The facts of a result, without encoder, inspection and time."""
        cell, budget, subset = self.cell, self.budget, self.subset
        evaluations = [point for point in curve if "score" in point]
        best = max(evaluations, key=lambda point: point["score"]["mean"])
        like_paper = subset.record.action_repeat == ACTION_REPEAT
        like_paper &= cell.agent.sees_state or subset.record.size == PAPER_SIZE
        paper = BENCHMARKS.get(cell.benchmark).paper_score(cell) if like_paper else None
        return {
            "labels": {"policy": cell.policy_label, "encoder": cell.pretrain_label},
            "score": best["score"] | {"step": best["step"]},
            "final": evaluations[-1]["score"],
            "evaluations": len(evaluations),
            "paper": paper and {"mean": paper[0], "stderr": paper[1]},
            "data": _brief(data_score(subset, data).facts()),
            "episodes": len(data.lengths),
            "transitions": len(data),
            "evaluation": evaluation_of(self.release, budget, cell),
            "renderers": {"data": subset.record.renderer["name"], "evaluation": renderer_choice(subset)["name"]},
            "curve": [point | {"score": _brief(point["score"])} if "score" in point else point for point in curve],
            "machine": {"device": budget.device, "threads": budget.threads, "torch": torch.__version__},
            "generator": f"dmcvb-gen {__version__}",
        }

    # -- what an encoder knows

    def inspect(self, encoder: nn.Module, data: TrainingData) -> dict[str, Any]:
        """Measure what a frozen encoder still knows: test errors of decoders of its latents (section 5.1)."""
        budget, steps = self.budget, self.budget.readout_steps
        torch.manual_seed(budget.seed)
        pictures = Autoencoder(encoder.requires_grad_(False), data.sizes, budget.network)
        readouts = {"observation": pictures, "state": StateProbe(encoder, data.sizes)}
        draws = len(readouts) * (steps * budget.batch_size + min(len(data.hold_out_rows), INSPECTED))
        data, found = self._encoded(encoder, data, draws), dict[str, Any]()
        for name, learner in readouts.items():
            learner.to(budget.device)
            self._fit(learner, data, steps, f"{name} decoder", shift=budget.frozen_shift)
            self.tick("test errors of the decoders", 0)
            found[f"{name}_mse"] = test_error(learner, data, budget.batch_size)
        batch = draw(pictures, data, 8, budget.seed, 0, hold_out=len(data.hold_out_rows) > 0)
        with torch.no_grad(), pictures.precision():
            seen = pictures.predict(batch).float()
        newest = slice(-data.frames.channels, None)
        rows = [_to_pictures(row[:, newest][:, :3]) for row in (batch.observation, seen)]
        _save_sheet(self.path(".decoder.png"), rows)
        return found


def test_error(learner: Learner, data: TrainingData, size: int) -> float | None:
    """The loss on held-out transitions, at most 150,000 of them, evenly spread; None if nothing is held out."""
    rows = data.hold_out_rows
    rows = rows[:: max(1, -(-len(rows) // INSPECTED))]
    losses = [float(learner.metrics(data.transitions(few))["loss"]) * len(few) for few in rows.split(size)]
    return sum(losses) / len(rows) if len(rows) else None


def _load_encoder(path: Path, encoder: nn.Module) -> None:
    try:
        encoder.load_state_dict(load_file(str(path)))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise DmcvbError(f"cannot read the encoder {path} ({error}); delete it and run again") from None


def data_score(subset: Subset, data: TrainingData) -> Score:
    """The score of training data, in the measures that policies are scored in."""
    task = get_task(subset.task).at(subset.record.action_repeat)
    ends, normal = np.cumsum(data.lengths + 1) - 1, data.normalization
    start = (data.state[ends - data.lengths] * normal.std + normal.mean).cpu().numpy()
    reached = (data.discount[ends - 1] == 0).cpu().numpy()
    success, speed = goal_scores(task, start, data.lengths, reached)
    return Score.of(data.returns, success=success, speed=speed, limit=subset.record.max_steps)


def _brief(score: dict[str, Any]) -> dict[str, Any]:
    """The facts of a score without the returns of every episode."""
    return {key: value for key, value in score.items() if key != "returns"}


def _to_pictures(values: torch.Tensor) -> np.ndarray:
    return ((values.float() + 0.5).clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()


def _save_sheet(path: Path, rows: Sequence[np.ndarray]) -> None:
    """Rows of (picture, size, size, 3) uint8 as one PNG."""
    sheet = np.concatenate([np.concatenate(list(row), axis=1) for row in rows])
    with replacing(path) as temporary:
        Image.fromarray(sheet).save(temporary, format="PNG")


# -- many cells -------------------------------------------------------------------------------------


def run_cells(
    root: str | Path,
    out: str | Path,
    budget: Budget,
    cells: Sequence[Cell],
    workers: Workers = 1,
    tick: ProgressCallback = ignore,
) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Results of cells as they come; those that need no encoder are run beside the encoders' training.

    A cell that cannot be run has a result of {"error": one line}; what it raised lies in its log, and the others go on.

    Args:
      workers: processes (started fresh, never forked), which share the memory for pictures; 1: all in this one; or a
        Ray cluster whose nodes see the release and the report's folder.
      tick: called with what is trained and the number of Adam steps made.

    Raises:
      StoreError: a worker was killed; finished cells are kept.
    """
    before = torch.get_num_threads()
    if workers == 1:
        torch.set_num_threads(budget.threads)
    elif isinstance(workers, int):
        memory = default_memory(budget.device) if budget.memory is None else budget.memory
        budget = dataclasses.replace(budget, memory=memory // workers)
    needs = Needs(cpus=budget.threads, gpus=1)  # the bound is of the accelerator's memory, which a cell has alone
    if budget.device == "cpu":
        needs = Needs(cpus=budget.threads, memory=budget.memory)
    kept = "finished cells are kept: rerun the same command"
    with (
        open_pool(workers, threads=budget.threads, tick=tick, kept=kept, needs=needs) as pool,
        contextlib.ExitStack() as after,
    ):
        after.callback(torch.set_num_threads, before)
        after.callback(_held.clear)  # pictures that this process held
        share = pool.memory_each()
        if budget.memory is None and share is not None and budget.device == "cpu":
            budget = dataclasses.replace(budget, memory=share // 2)  # pictures take half, as they do if one is alone
        waiting = [cell for cell in cells if cell.encoder]
        for cell in (*dict.fromkeys(cell.encoder for cell in waiting), *cells):
            if cell and cell not in waiting:
                pool.submit(cell, try_cell, root, out, budget, cell)
        for cell, result in pool.results():
            if cell.benchmark != ENCODER:
                yield cell, result
                continue
            for later in [one for one in waiting if one.encoder == cell]:
                if "error" in result:
                    yield later, {"error": result["error"]}
                else:
                    pool.submit(later, try_cell, root, out, budget, later)


def try_cell(
    root: str | Path, out: str | Path, budget: Budget, cell: Cell, tick: ProgressCallback = ignore
) -> dict[str, Any]:
    """The result of a cell, its errors as a result."""
    log = file_of(out, cell, ".log")
    try:
        result = CellRun(root, out, budget, cell, tick).result()
    except DmcvbError as error:
        return {"error": str(error)}
    except Exception as error:  # one cell's bug or lack of memory must not cost the hours of the others
        with contextlib.suppress(OSError):  # of a full disk, about which the error is
            write_text(log, traceback.format_exc())
        return {"error": f"{type(error).__name__}: {first_line(error)} (all of it in {log})"}
    log.unlink(missing_ok=True)
    return result


def planned_steps(budget: Budget, cells: Sequence[Cell]) -> int:
    """Adam steps of cells, their encoders and decoders."""
    encoders = {cell.encoder for cell in cells} - {None}
    decoders = sum(2 * budget.readout_steps for cell in cells if not cell.agent.sees_state)
    policies = sum(policy_steps(budget, cell.agent) for cell in cells)
    return policies + decoders + len(encoders) * budget.pixel_steps
