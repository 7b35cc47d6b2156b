"""Train and score one cell on a release and write its result as JSON; finished parts are kept (see `setup`)."""

from __future__ import annotations

import dataclasses
import functools
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from dmcvb_gen.agents.catalog import Agent, make_encoder, make_policy, make_pretrainer
from dmcvb_gen.agents.data import Normalization, Slice, TrainingData, choose_episodes, load_data
from dmcvb_gen.agents.learners import Policy
from dmcvb_gen.agents.paper import ObservationProbe, StateProbe
from dmcvb_gen.agents.trainer import Curve, TrainSettings, draw, forget, train
from dmcvb_gen.benchmarks.evaluate import Evaluator, Score, protocol, renderer_choice
from dmcvb_gen.benchmarks.goals import goal_cells
from dmcvb_gen.benchmarks.own import AgentData, OwnAgent
from dmcvb_gen.benchmarks.profiles import Profile
from dmcvb_gen.benchmarks.setup import (
    Pretraining,
    Setup,
    data_of_run,
    fingerprint,
    pretraining_of,
    read_result,
    sees_pictures,
)
from dmcvb_gen.benchmarks.suites import BENCHMARKS, Cell
from dmcvb_gen.benchmarks.trained import save_agent
from dmcvb_gen.dataset import Release, Subset
from dmcvb_gen.dataset.writer import subset_digest
from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.files import replacing, sha256_file, write_json
from dmcvb_gen.loaders.source import StepSource
from dmcvb_gen.parallel import ignore
from dmcvb_gen.policies.evaluation import goal_speed
from dmcvb_gen.tasks import get_task
from dmcvb_gen.version import __version__

ProgressCallback = Callable[[str, int], None]
"""Callback that is told what is being done and how many Adam steps were made since the last call."""


class _DataCache:
    """The data of the last parts asked for: cells that follow each other often share them."""

    def __init__(self):
        self._key, self._data = None, None

    def get(
        self,
        setup: Setup,
        release: Release,
        parts: Sequence[Slice],
        pixels: bool,
        stack: int,
        tick: ProgressCallback = ignore,
    ) -> TrainingData:
        """The data of some parts. `tick` is told how far its images are: painting many takes minutes."""
        digests = tuple(subset_digest(release[part.subset].commits) for part in parts)  # a release may have grown
        key = (setup.root, setup.seed, tuple(parts), digests, setup.backgrounds, setup.device, setup.memory)
        if self._key is None or self._key[0] != key or (pixels and not self._key[1]):
            self._key = self._data = None  # free the old pictures before new ones are read
            names = " + ".join(dict.fromkeys(part.subset for part in parts))
            self._data = load_data(
                release,
                parts,
                pixels=pixels,
                seed=setup.seed,
                device=setup.device,
                memory=setup.memory,
                scratch=setup.out,
                tick=lambda share: tick(f"images of {names}, {share:.0%}", 0) if pixels else None,
            )
            self._key = (key, pixels)
        return self._data.with_stack(stack) if pixels else self._data.states_only()


_cache = _DataCache()

INSPECTED = 150_000
"""Held-out transitions that an inspection's error is the mean of, at most (the paper's number)."""
UNIT_EPISODES = 100


def train_settings(
    setup: Setup, steps: int, transitions: int, pixels: bool = True, evaluations: int = 1, frozen: bool = False
) -> TrainSettings:
    """Return a profile's training settings for a part of a cell.

    Args:
      transitions: number of those that it learns from.
      frozen: on an encoder that does not learn.
    """
    return TrainSettings(
        steps=steps,
        batch_size=setup.profile.batch_size if pixels else setup.profile.state_batch_size,
        evaluate_every=-(-steps // evaluations),
        half=pixels and setup.precision == "bfloat16",
        rate=setup.profile.rate if pixels else 1.0,
        shift=setup.profile.frozen_shift if frozen else setup.profile.shifts(steps, transitions),
        decay=setup.profile.decay,
        muon=pixels and setup.profile.muon,
        compile=setup.compile,
        workers=1 if setup.device != "cpu" else 0,
    )


def policy_steps(profile: Profile, agent: Agent) -> int:
    """Adam steps of a cell's policy; those of a user's own agent are not known."""
    if agent.own:
        return 0
    if agent.sees_state:
        return profile.state_steps
    return profile.frozen_steps if agent.pretrain else profile.pixel_steps


# -- encoders -------------------------------------------------------------------------------------


def run_pretraining(setup: Setup, work: Pretraining, tick: ProgressCallback = ignore) -> dict[str, Any]:
    """Pre-train an encoder, unless it is there. Gives its facts: curve, seconds.

    Raises:
      DmcvbError: training does not stay finite.
    """
    release = data_of_run(setup)
    mark = fingerprint(setup, release, work)
    facts_path, weights_path = setup.encoders / f"{work.id}.json", setup.encoders / f"{work.id}.safetensors"
    done = read_result(facts_path, mark)
    if done and weights_path.exists():
        return done
    data, network = _cache.get(setup, release, work.parts, True, work.agent.stack, tick), setup.profile.network
    torch.manual_seed(setup.seed)
    encoder = make_encoder(work.agent, data.sizes, architecture=network)
    learner = make_pretrainer(work.agent, encoder, data.sizes, network).to(setup.device)
    folder = setup.encoders / f"{work.id}.{mark[:12]}.run"
    curve = train(
        learner,
        data,
        train_settings(setup, setup.profile.pretrain_steps, len(data)),
        seed=setup.seed,
        folder=folder,
        tick=lambda steps: tick(f"{work.agent.pretrain} encoder of {work.task}", steps),
    )
    with replacing(weights_path) as path:
        save_file({name: value.cpu().contiguous() for name, value in encoder.state_dict().items()}, str(path))
    facts = {"fingerprint": mark, "curve": curve, "seconds": curve[-1]["seconds"]}
    write_json(facts_path, facts)
    _clear(folder)
    return facts


def _clear(folder: Path) -> None:
    """Remove the states of a cell's trainings, the decoders' too."""
    for place in (*(path for path in folder.glob("*") if path.is_dir()), folder):
        forget(place)
        if place.is_dir() and not any(place.iterdir()):
            place.rmdir()


def _load_encoder(setup: Setup, work: Pretraining, encoder: nn.Module) -> None:
    path = setup.encoders / f"{work.id}.safetensors"
    try:
        encoder.load_state_dict(load_file(str(path)))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise DmcvbError(f"cannot read the encoder {path} ({error}); delete it and run again") from None


def encoded(
    setup: Setup, encoder: nn.Module, data: TrainingData, draws: int, tick: ProgressCallback = ignore
) -> TrainingData:
    """Data of a frozen encoder: its latents are computed once if that pays and the profile does not shift pictures.

    Args:
      draws: how many transitions will be drawn; if there are more rows than that, each is encoded as it is drawn.
    """
    if setup.profile.frozen_shift or draws < len(data.state):
        return data
    dtype = torch.bfloat16 if setup.precision == "bfloat16" else torch.float32
    return data.encoded(encoder, dtype, lambda share: tick(f"encoding, {share:.0%}", 0))


# -- a cell ---------------------------------------------------------------------------------------


def run_cell(setup: Setup, cell: Cell, tick: ProgressCallback = ignore) -> dict[str, Any]:
    """Train and evaluate one cell, unless its result is there. Gives the result.

    A ready policy of the user's is scored each time: its score hangs on more than its code, and costs one evaluation.
    A kept result of an own agent that learns has "kept": True.

    Raises:
      DmcvbError: DINO's weights are missing, the renderer cannot start, or training does not stay finite.
    """
    release = data_of_run(setup)
    mark = fingerprint(setup, release, cell)
    path = setup.cells / f"{cell.id}.json"
    own = OwnAgent.load(cell.agent.own) if cell.agent.own else None
    done = None if own and not own.learns else read_result(path, mark)
    if done:
        return done | {"kept": True} if own else done
    if own:
        return _run_own(setup, cell, own, release, mark)
    started = time.perf_counter()
    before, pixels = pretraining_of(cell), not cell.agent.sees_state
    pretrained = run_pretraining(setup, before, tick) if before else None
    data = _cache.get(setup, release, cell.policy, pixels, cell.agent.stack, tick)
    policy = _make_policy(setup, cell, before, data)
    folder = setup.cells / f"{cell.id}.{mark[:12]}.run"
    subset = release[cell.policy[0].subset]
    curve, trained = _train_policy(setup, cell, subset, data, policy, folder, tick)
    kept = _save_trained(setup, cell, policy, data)
    inspected = time.perf_counter()
    looked_into = pixels and setup.profile.readout_steps
    inspection = inspect(setup, policy.encoder, data, cell, folder, tick) if looked_into else None
    ended, evaluating = time.perf_counter(), sum(point["score"]["seconds"] for point in curve if "score" in point)
    before_stop = max(0.0, curve[-1]["seconds"] - trained)
    decoding = sum(points[-1]["seconds"] for points in inspection["curves"].values()) if inspection else 0.0
    before_stop += max(0.0, decoding - (ended - inspected))
    seconds = {
        "training": curve[-1]["seconds"] - evaluating,
        "evaluation": evaluating,
        "inspection": max(decoding, ended - inspected),
        "all": before_stop + ended - started,
    }
    digests = {name: subset_digest(release[name].commits) for name in cell.subsets}
    result = {"fingerprint": mark, "seed": setup.seed, "digests": digests}
    result |= _facts(setup, cell, subset, data, curve, seconds)
    result["pretraining"] = pretrained and {key: pretrained[key] for key in ("curve", "seconds")}
    result |= {"inspection": inspection, "policy_file": kept}
    write_json(path, result)
    _clear(folder)
    return result


def _run_own(setup: Setup, cell: Cell, own: OwnAgent, release: Release, mark: str) -> dict[str, Any]:
    """The cell of a user's own agent: its policy is trained by the user's code, if at all, and scored by ours.

    Raises:
      DmcvbError: its policy gives no actions.
    """
    started, subset = time.perf_counter(), release[cell.policy[0].subset]
    data = _cache.get(setup, release, cell.policy, False, own.stack)
    sources = []
    for part in cell.policy:
        episodes, held = choose_episodes(release[part.subset], part, setup.seed)
        views = "agents" if own.pixels else ()
        sources.append(StepSource(release[part.subset], episodes[~held], views, own.stack))
    policy = own.policy(AgentData(tuple(sources), cell.task, cell.setting, setup.seed))
    trained = time.perf_counter() - started
    evaluator = _evaluator(setup, cell, subset, pixels=own.pixels, stack=own.stack)
    try:
        score = evaluator.score(policy)
    finally:
        evaluator.close()
    if score.pictures is not None:
        _save_sheet(setup.cells / f"{cell.id}.rollout.png", [score.pictures])
    curve = [{"step": 0, "seconds": trained, "score": score.facts()}]
    everything = time.perf_counter() - started
    seconds = {"training": trained, "evaluation": score.seconds, "inspection": 0.0, "all": everything}
    digests = {name: subset_digest(release[name].commits) for name in cell.subsets}
    result = {"fingerprint": mark, "seed": setup.seed, "digests": digests}
    result |= _facts(setup, cell, subset, data, curve, seconds) | {"pretraining": None, "inspection": None}
    write_json(setup.cells / f"{cell.id}.json", result)
    return result


def _evaluator(setup: Setup, cell: Cell, subset: Subset, **options: Any) -> Evaluator:
    """The evaluation of a cell."""
    pair = cell.policy[0].goal_pair
    return Evaluator(
        subset,
        episodes=setup.profile.episodes,
        max_steps=setup.profile.episode_steps,
        pair=None if pair is None else goal_cells(subset, pair),
        backgrounds=setup.backgrounds,
        device=setup.device,
        threads=setup.threads,
        **options,
    )


def _make_policy(setup: Setup, cell: Cell, before: Pretraining | None, data: TrainingData) -> Policy:
    torch.manual_seed(setup.seed)
    encoder = make_encoder(cell.agent, data.sizes, setup.dino_weights, setup.profile.network)
    if before:
        _load_encoder(setup, before, encoder)
    return make_policy(cell.agent, encoder, data.sizes, setup.profile.network).to(setup.device)


def _train_policy(
    setup: Setup, cell: Cell, subset: Subset, data: TrainingData, policy: Policy, folder: Path, tick: ProgressCallback
) -> tuple[Curve, float]:
    """Train a cell's policy, with its online evaluations; gives the curve and the seconds since it was last stopped."""
    profile, pixels = setup.profile, not cell.agent.sees_state
    evaluator = _evaluator(setup, cell, subset, pixels=pixels, normalization=data.normalization, stack=cell.agent.stack)

    def evaluate(learner) -> dict[str, Any]:
        score: Score = evaluator(learner)
        if score.pictures is not None:
            _save_sheet(setup.cells / f"{cell.id}.rollout.png", [score.pictures])
        return {"score": score.facts()}

    label = f"{cell.agent.name} on {cell.task} {cell.policy_label}/{cell.setting}"
    frozen = cell.agent.pretrain is not None
    steps = policy_steps(profile, cell.agent)
    settings = train_settings(setup, steps, len(data), pixels, profile.evaluations, frozen)
    if frozen:
        data = encoded(setup, policy.encoder, data, settings.steps * settings.batch_size, tick)
    started = time.perf_counter()
    try:
        curve = train(
            policy,
            data,
            settings,
            seed=setup.seed,
            folder=folder,
            evaluate=evaluate,
            tick=lambda made: tick(label, made),
        )
    finally:
        evaluator.close()
    return curve, time.perf_counter() - started


def _save_trained(setup: Setup, cell: Cell, policy: Policy, data: TrainingData) -> str | None:
    """Keep the policy beside its result, unless its score is noise or its encoder is a large file of the user's.

    Gives the file's SHA-256: a later run with another seed or profile writes over it.
    """
    if not setup.profile.scores or cell.agent.ready_encoder:
        return None
    path = setup.cells / f"{cell.id}.safetensors"
    save_agent(path, policy, cell.agent, data.sizes, setup.profile.network, data.normalization)
    return sha256_file(path)


def _facts(
    setup: Setup, cell: Cell, subset: Subset, data: TrainingData, curve: Curve, seconds: dict[str, float]
) -> dict[str, Any]:
    """Return the facts of a result, without encoder and inspection."""
    agent, profile = cell.agent, setup.profile
    evaluations = [point for point in curve if "score" in point]
    best = max(evaluations, key=lambda point: point["score"]["mean"])
    paper = BENCHMARKS.get(cell.benchmark).paper_score(cell)
    return {
        "id": cell.id,
        "cell": cell.facts() | {"policy_label": cell.policy_label, "pretrain_label": cell.pretrain_label},
        "profile": dataclasses.asdict(profile),
        "score": best["score"] | {"step": best["step"]},
        "final": evaluations[-1]["score"],
        "evaluations": len(evaluations),
        "paper": paper and {"mean": paper[0], "stderr": paper[1]},
        "data": dataclasses.asdict(data_score(subset, data)),
        "episodes": len(data.lengths),
        "transitions": len(data),
        "evaluation": protocol(
            subset,
            None if cell.policy[0].goal_pair is None else goal_cells(subset, cell.policy[0].goal_pair),
            setup.backgrounds,
            pictures=sees_pictures(agent),
            max_steps=profile.episode_steps,
        ),
        "renderers": {"data": subset.record.renderer["name"], "evaluation": renderer_choice(subset)["name"]},
        "curve": [_thin(point) for point in curve],
        "seconds": seconds,
        "steps_per_second": policy_steps(profile, agent) / max(seconds["training"], 1e-9),
        "memory_bytes": _peak_memory(setup.device),
        "machine": {
            "device": setup.device,
            "threads": setup.threads,
            "precision": setup.precision,
            "torch": torch.__version__,
        },
        "generator": f"dmcvb-gen {__version__}",
    }


@dataclass(frozen=True)
class DataScore:
    """Score of the episodes that a policy learned from.

    Attributes:
      mean: mean of the returns.
      success: share that reached the goal (mazes), else None. speed: towards it of those, m/s (mazes), else None.
      limit: agent steps that they were cut at.
    """

    mean: float
    success: float | None
    speed: float | None
    limit: int


def data_score(subset: Subset, data: TrainingData) -> DataScore:
    """The score of training data, in the measures that policies are scored in."""
    task = get_task(subset.task)
    success = speed = None
    part = task.state_slices.get("target_vector")
    if part is not None:
        ends = np.cumsum(data.lengths + 1) - 1
        first = torch.as_tensor(ends - data.lengths, device=data.device)
        normal = data.normalization
        to_goal = data.state[first][:, part].cpu() * normal.std[part].cpu() + normal.mean[part].cpu()
        distance = to_goal.norm(dim=1).numpy()
        reached = (data.discount[torch.as_tensor(ends - 1, device=data.device)] == 0).cpu().numpy()
        success, speed = float(reached.mean()), goal_speed(distance, data.lengths, reached, task)
    return DataScore(float(data.returns.mean()), success, speed, subset.record.max_steps)


def _thin(point: dict[str, Any]) -> dict[str, Any]:
    """A point of the curve without the returns of every episode."""
    if "score" not in point:
        return point
    return point | {"score": {key: value for key, value in point["score"].items() if key != "returns"}}


def _peak_memory(device: str) -> int:
    if device.startswith("cuda"):
        return int(torch.cuda.max_memory_allocated())
    try:
        import resource
    except ImportError:  # Windows does not say
        return 0
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


# -- what an encoder knows ------------------------------------------------------------------------


def inspect(
    setup: Setup, encoder: nn.Module, data: TrainingData, cell: Cell, folder: Path, tick: ProgressCallback = ignore
) -> dict[str, Any]:
    """Measure what a frozen encoder still knows: test errors of decoders of its observations and states (section 5.1).

    Args:
      folder: folder of the decoders' states while they train, a folder each.
    """
    curves: dict[str, Curve] = {}
    torch.manual_seed(setup.seed)  # of the readouts' weights, also where training has just been resumed
    readouts = {
        "observation": ObservationProbe(encoder, data.sizes, setup.profile.network),
        "state": StateProbe(encoder, data.sizes),
    }
    settings = train_settings(setup, setup.profile.readout_steps, len(data), frozen=True)
    inspected = min(len(data.hold_out_rows), INSPECTED)
    draws = len(readouts) * settings.steps * settings.batch_size + inspected
    data = encoded(setup, encoder, data, draws, tick)
    for name, learner in readouts.items():
        learner.to(setup.device)
        curves[name] = train(
            learner,
            data,
            settings,
            seed=setup.seed,
            folder=folder / name,
            tick=lambda made, n=name: tick(f"{n} decoder", made),
        )
    errors = _test_errors(readouts, data, setup, cell.task, tick)
    held_out = len(data.hold_out_rows) > 0
    batch = draw(readouts["observation"], data, 8, setup.seed, 0, hold_out=held_out)
    with torch.no_grad(), readouts["observation"].precision():
        seen = readouts["observation"].predict(batch).float()
    newest = slice(-data.frames.channels, None)
    rows = [_to_pictures(pictures[:, newest][:, :3]) for pictures in (batch.observation, seen)]
    _save_sheet(setup.cells / f"{cell.id}.decoder.png", rows)
    return {**errors, "curves": curves, "held_out": held_out}


@torch.no_grad()
def _test_errors(
    readouts: dict[str, Any], data: TrainingData, setup: Setup, task: str, tick: ProgressCallback
) -> dict[str, Any]:
    """Errors of decoders on the held-out transitions, at most 150,000 of them, evenly spread, each encoded once.

    Returns:
      "observation_mse" and "state_mse": mean squared errors. "state_l1": state field -> mean absolute error, in the
      standard deviations of `state_units`. All None if nothing is held out.
    """
    rows = data.hold_out_rows
    rows = rows[:: max(1, -(-len(rows) // INSPECTED))]
    if not len(rows):
        return {"observation_mse": None, "state_mse": None, "state_l1": None}
    squared, absolute = dict.fromkeys(readouts, 0.0), torch.zeros(data.state.shape[1], device=data.device)
    for few in rows.split(setup.profile.batch_size):
        tick("test errors of the decoders", 0)
        batch = data.transitions(few)
        with readouts["state"].precision():
            if batch.latent is None:
                batch = dataclasses.replace(batch, latent=readouts["state"].encoder(batch.observation))
            for name, learner in readouts.items():
                squared[name] += float(learner.losses(batch)["loss"]) * len(few)
            absolute += (readouts["state"].predict(batch) - batch.state).abs().sum(dim=0)
    scale = data.normalization.std.cpu() / state_units(setup, task)
    each = absolute.cpu() * scale / len(rows)
    fields = {name: float(each[part].mean()) for name, part in get_task(task).state_slices.items()}
    return {f"{name}_mse": total / len(rows) for name, total in squared.items()} | {"state_l1": fields}


@functools.lru_cache(maxsize=8)
def state_units(setup: Setup, task: str) -> torch.Tensor:
    """(state,) standard deviations of a task's states over all levels of the release, floored at 1e-3.

    One normalization for all levels, so that errors of agents that learned from different levels compare. A level
    counts by up to 100 episodes of its first setting, as the settings of a level often share their trajectories.
    """
    first: dict[str, Subset] = {}
    for subset in data_of_run(setup).subsets.values():
        if subset.task == task:
            first.setdefault(subset.level, subset)
    parts = []
    for subset in first.values():
        few, lengths = subset.episodes[:UNIT_EPISODES], subset.lengths[:UNIT_EPISODES]
        states = subset.read("state", few)
        parts += [values[: length + 1] for values, length in zip(states, lengths, strict=True)]
    return Normalization.of(torch.from_numpy(np.concatenate(parts)).float()).std


def _to_pictures(values: torch.Tensor) -> np.ndarray:
    return ((values.float() + 0.5).clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()


def _save_sheet(path: Path, rows: Sequence[np.ndarray]) -> None:
    """Rows of (picture, size, size, 3) uint8 as one PNG."""
    sheet = np.concatenate([np.concatenate(list(row), axis=1) for row in rows])
    with replacing(path) as temporary:
        Image.fromarray(sheet).save(temporary, format="PNG")


__all__ = ["DataScore", "data_score", "inspect", "policy_steps", "run_cell", "run_pretraining", "train_settings"]
