"""The generation engine: make the layers of a work, each from what lies below it, and put, compare or repair them.

::

    trajectories   simulated, or read
    labels         drawn for them from the episodes' streams, or read
    images         rendered from both

Rollouts, paint, repaint, growth and resuming put what is missing. `regenerate` makes what is there again, and compares
it or puts files back.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dmcvb_gen.dataset.chunks import decode, encode
from dmcvb_gen.dataset.manifest import ArraySpec, Layer, ShardFile, ShardRecord, SubsetRecord
from dmcvb_gen.dataset.writer import file_facts, put, put_back, put_record, read_checked, wrong_bytes
from dmcvb_gen.distractor_state import DistractorState
from dmcvb_gen.errors import StoreError
from dmcvb_gen.generate.inputs import background_source, local_inputs, policy_files
from dmcvb_gen.generate.render import distractor_state_of, label_arrays, paint, paint_modality, renderers, videos_of
from dmcvb_gen.generate.resolve import check_code, check_task_code, code_of_distractor
from dmcvb_gen.generate.works import Setting, Work
from dmcvb_gen.parallel import ProgressCallback, ignore
from dmcvb_gen.policies.actor import Policy, RandomPolicy
from dmcvb_gen.policies.policy_file import load_policy
from dmcvb_gen.policies.simulate import simulate
from dmcvb_gen.storage.store import Store
from dmcvb_gen.tasks import get_task
from dmcvb_gen.tasks.ant_maze import as_maze, fixed_pairs

ANY_BITS = ("opengl",)
"""Renderers whose images may differ from machine to machine: the first shard that is put is the release's."""


Episodes = Mapping[str, np.ndarray]
"""Episodes of a work before they are rendered: arrays by name, at least "physics", (episode, row, physics) float64,
"length" and "action". Rows past an episode's end are zero."""


@dataclass(frozen=True)
class ArrayDifference:
    """Largest and mean absolute difference between an array of a shard and the released one; None if unknown."""

    array: str
    largest: float | None
    mean: float | None


@dataclass(frozen=True)
class ShardOutcome:
    """What became of one layer's shard.

    Attributes:
      episodes: (first, last + 1).
      was: what was wrong with its files, in words; None if nothing was, or the files were not read.
      equal: whether the bytes made are the recorded ones; None if no record was there.
      repaired: True if files were put back.
      differences: of the arrays whose bytes differ; "largest" is None if the released values cannot be read.
    """

    layer: str
    shard: int
    episodes: tuple[int, int]
    was: str | None = None
    equal: bool | None = None
    repaired: bool = False
    differences: tuple[ArrayDifference, ...] = ()

    @classmethod
    def of(cls, layer: Layer, shard: int, **facts: Any) -> ShardOutcome:
        """The outcome of a layer's shard; `facts`: its further attributes."""
        span = layer.episodes_of(shard)
        return cls(layer.name, shard, (span.start, span.stop), **facts)

    def __str__(self) -> str:
        text = f"{self.layer} shard {self.shard} (episodes {self.episodes[0]}:{self.episodes[1]}): "
        if self.was:
            text += f"{self.was}; "
        if self.equal is None:
            return text + "made"
        if self.equal:
            return text + ("repaired" if self.repaired else "regenerated with the same digest")
        text += "MISMATCH: digest differs"
        for difference in self.differences:
            if difference.largest is None:
                text += f"; {difference.array}: the original is not available on this machine"
            elif not difference.largest:
                text += f"; {difference.array}: equal values, only the compression differs"
            else:
                unit = " grey levels" if difference.array.startswith("pixels") else ""
                text += f"; {difference.array}: max {difference.largest:.3g}, mean {difference.mean:.3g}{unit}"
        return text


@dataclass(frozen=True)
class WorkResult:
    """The result of a work.

    Attributes:
      outcomes: of each layer that was made.
      episodes, steps: simulated or rendered, once for each setting.
    """

    outcomes: tuple[ShardOutcome, ...]
    episodes: int
    steps: int


def run_work(work: Work, threads: int = 1, tick: ProgressCallback = ignore) -> WorkResult:
    """Make the layers of a work.

    Args:
      threads: threads of the physics.
      tick: called with the number of frames rendered since the last call (of steps, without images).

    Raises:
      StoreError: what is read is damaged, other bytes are there, or the place is full or cannot be written.
    """
    first = work.settings[0].record
    check_task_code(first.task, work.trajectories)  # its model is painted, too
    if work.trajectories.name in work.make:
        episodes = simulated_episodes(work, first, threads)
        outcomes = [_settle(work, work.trajectories, episodes.items())]
    else:
        episodes, outcomes = read_shard(work, work.trajectories, ("physics", "length", "action")), []
    if not work.images:
        tick(int((episodes["length"] + 1).sum()))
    for setting in work.settings:
        outcomes += _make_setting(work, setting, episodes, tick)
    count = len(work.settings)
    return WorkResult(tuple(outcomes), count * len(work.episodes), count * int(episodes["length"].sum()))


def _make_setting(work: Work, setting: Setting, episodes: Episodes, tick: ProgressCallback) -> Iterator[ShardOutcome]:
    """The labels and images of one setting."""
    images = [layer for layer in setting.images if layer.name in work.make]
    makes_labels = setting.labels is not None and setting.labels.name in work.make
    if setting.labels is None or not (images or makes_labels):
        return
    record, root = setting.record, local_inputs(work.store, work.inputs)
    backgrounds = background_source(root, record, work.backgrounds)
    if makes_labels:
        check_code(record.distractor.kind, setting.labels.makes, code_of_distractor(record.distractor))
        labels = _drawn_labels(work, record, episodes, backgrounds)
        yield _settle(work, setting.labels, label_arrays(labels, episodes["length"], work.trajectories.rows))
    else:
        labels = _stored_labels(work, setting.labels, episodes)
    for size in dict.fromkeys(layer.arrays[0].shape[0] for layer in images):
        layers = {_plain(layer.arrays[0]): layer for layer in images if layer.arrays[0].shape[0] == size}
        rendered = _rendered(record.model_copy(update={"size": size}), layers, episodes, labels, backgrounds, tick)
        for name, values in rendered:
            yield _settle(work, layers[name], [(layers[name].arrays[0].name, values)])


def _plain(spec: ArraySpec) -> str:
    """ "at84/pixels/top" -> "pixels/top"."""
    head, _, rest = spec.name.partition("/")
    return rest if head.removeprefix("at").isdigit() else spec.name


# -- states and labels ----------------------------------------------------------------------------


def simulated_episodes(work: Work, record: SubsetRecord, threads: int) -> Episodes:
    """Simulate the episodes of a shard."""
    task, makes = get_task(record.task).at(record.action_repeat), work.trajectories.makes
    pairs = None
    if makes["fixed_goals"]:
        per_goal = makes["episodes_per_goal"]
        pairs = fixed_pairs(as_maze(task).layout, makes["fixed_goals"], makes["seed"])
        pairs = pairs * (-(-work.episodes.stop // (per_goal * len(pairs))))  # the last shard is full, too
    files = policy_files(local_inputs(work.store, work.inputs), record)
    return simulate(
        task,
        _policies(record.task, files, tuple(policy.digest for policy in record.policies)),
        list(work.episodes),
        makes["seed"],
        tuple(work.trajectories.makes["streams"]),
        deterministic=record.deterministic,
        goal_pairs=pairs,
        episodes_per_goal=makes["episodes_per_goal"],
        threads=threads,
        max_steps=record.max_steps,
    ).arrays()


@functools.lru_cache(maxsize=4)
def _policies(task_name: str, files: tuple[str, ...], digests: tuple[str, ...]) -> list[Policy]:
    """The policies of a subset (uniform random actions without files), read once in each process.

    Args:
      digests: digests of the policies, so that a file that was replaced is read again.
    """
    task = get_task(task_name)
    loaded = [load_policy(path, task) for path in files]
    for path, policy, digest in zip(files, loaded, digests, strict=True):
        if policy.digest != digest:
            raise StoreError(
                f"{path} is not the policy that the release names (digest {policy.digest[:12]}, asked for "
                f"{digest[:12]}); bring back the file as it was, or give another --out"
            )
    return loaded or [RandomPolicy(task)]


def _drawn_labels(work: Work, record: SubsetRecord, episodes: Episodes, backgrounds: str) -> DistractorState:
    videos = videos_of(record.distractor, backgrounds, record.split)
    streams = (work.trajectories.makes["seed"], tuple(work.trajectories.makes["streams"]), work.episodes)
    return distractor_state_of(record, *streams, episodes["physics"], episodes["length"], videos, episodes["action"])


def _stored_labels(work: Work, layer: Layer, episodes: Episodes) -> DistractorState:
    arrays = read_shard(work, layer, [spec.name for spec in layer.arrays])
    arrays = {name.removeprefix("exogenous/"): values for name, values in arrays.items()}
    return DistractorState(**arrays)[:, : int(episodes["length"].max()) + 1]


def read_shard(work: Work, layer: Layer, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Arrays of a shard that exists, compared with their recorded digests.

    Raises:
      StoreError: a file is missing or has other bytes.
    """
    record = work.known[layer.name]
    return {name: _read_array(work.store, layer, layer.array(name), work.shard, record) for name in names}


def _read_array(store: Store, layer: Layer, spec: ArraySpec, shard: int, record: ShardRecord) -> np.ndarray:
    file = record.files.get(spec.name)
    return decode(layer, spec, read_checked(store, file.at(layer.file_path(spec, shard))) if file else None)


# -- images ---------------------------------------------------------------------------------------


def _rendered(
    record: SubsetRecord,
    layers: Mapping[str, Layer],
    episodes: Episodes,
    labels: DistractorState,
    backgrounds: str,
    tick: ProgressCallback,
) -> Iterator[tuple[str, np.ndarray]]:
    """Image arrays of one size, one at a time: (plain name, (episode, row, ...))."""
    task, length, rows = get_task(record.task), episodes["length"], episodes["physics"].shape[1]
    renderer = renderers.get(record, backgrounds)
    physics = episodes["physics"][:, : labels.background_video.shape[1]]
    pictures = [name for name, layer in layers.items() if "modality" not in layer.makes]
    if pictures:
        yield from paint(task, renderer, physics, labels, length, rows, tick, pictures)
    for name, layer in layers.items():
        if modality := layer.makes.get("modality"):
            view, hidden = name.partition("/")[2] or record.views[0], layer.makes["hidden_goal"]
            yield name, paint_modality(renderer, physics, labels, length, rows, modality, hidden, view)


# -- what becomes of a layer's arrays -------------------------------------------------------------


def _settle(work: Work, layer: Layer, arrays: Iterable[tuple[str, np.ndarray]]) -> ShardOutcome:
    """Put a layer's shard, or compare it with its record, as the work is for; one array is in memory at a time."""
    known = work.known.get(layer.name)
    first_wins = layer.makes.get("renderer", {}).get("name") in ANY_BITS
    files: dict[str, ShardFile] = {}
    differences, was = [], None
    for name, values in arrays:
        spec = layer.array(name)
        data = encode(layer, spec, np.ascontiguousarray(values, dtype=spec.dtype))
        facts, promised = None if data is None else file_facts(data), known.files.get(name) if known else None
        path = layer.file_path(spec, work.shard)
        if promised and work.purpose != "make":
            was = was or _fault(work.store, path, promised)
        if known is not None and facts != promised:
            differences.append(_difference(work, layer, spec, known, values))
        elif data is not None and facts is not None:
            files[name] = _put_file(work, path, data, facts, first_wins)
    if work.purpose != "check" and not differences:
        put_record(work.store, layer, work.shard, ShardRecord(key=layer.job_key(work.shard), files=files))
    equal, repaired = None if known is None else not differences, work.purpose == "repair" and not differences
    return ShardOutcome.of(layer, work.shard, was=was, equal=equal, repaired=repaired, differences=tuple(differences))


def _put_file(work: Work, path: str, data: bytes, facts: ShardFile, first_wins: bool) -> ShardFile:
    if work.purpose == "make":
        return put(work.store, path, data, first_wins=first_wins)
    if work.purpose == "repair" and _fault(work.store, path, facts):
        put_back(work.store, facts.at(path), data)
    return facts


def _fault(store: Store, path: str, file: ShardFile) -> str | None:
    wrong = wrong_bytes(store, file.at(path))
    return f"{path} {wrong}" if wrong else None


def _difference(work: Work, layer: Layer, spec: ArraySpec, known: ShardRecord, values: np.ndarray) -> ArrayDifference:
    try:
        other = _read_array(work.store, layer, spec, work.shard, known)
    except StoreError:
        return ArrayDifference(spec.name, None, None)
    gap = np.abs(values.astype(np.float64) - other.astype(np.float64))
    return ArrayDifference(spec.name, float(gap.max()), float(gap.mean()))
