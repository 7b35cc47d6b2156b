"""Validate a release: check its structure, run the benchmarks, and write one page about it all."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from dmcvb_gen.agents.catalog import parse_agent
from dmcvb_gen.agents.data import training_episodes
from dmcvb_gen.benchmarks.checks import Structure, check_structure
from dmcvb_gen.benchmarks.evaluate import SPLIT
from dmcvb_gen.benchmarks.kept import kept_scores, other_scores
from dmcvb_gen.benchmarks.own import OwnAgent
from dmcvb_gen.benchmarks.profiles import Profile, get_profile
from dmcvb_gen.benchmarks.report import release_episodes, write_report
from dmcvb_gen.benchmarks.run import default_threads, planned_steps, run_cells
from dmcvb_gen.benchmarks.setup import Setup, keep_precision, kept_precision, open_data
from dmcvb_gen.benchmarks.suites import BENCHMARKS, Cell, Missing, plan_benchmark
from dmcvb_gen.dataset import Release
from dmcvb_gen.distractors import load_backgrounds
from dmcvb_gen.errors import BackgroundError, DmcvbError
from dmcvb_gen.generate.inputs import video_source
from dmcvb_gen.parallel import ProgressCallback, Workers, ignore
from dmcvb_gen.precision import choose_precision
from dmcvb_gen.release.issue import Issue
from dmcvb_gen.spec import matches, select
from dmcvb_gen.storage.remote import local_path
from dmcvb_gen.text import pluralize

STATE_BC_SHARE = 0.9
"""Of the data's return (mazes: success) that BC(state) should reach on expert data; less draws a warning."""


@dataclass(frozen=True)
class Validation:
    """Result of a validation.

    Attributes:
      structure: result of the structure checks.
      results: (cell, result) of every cell; a result of {"error": ...} failed.
      missing: subsets that the benchmarks would need besides.
      episodes: committed, and asked for by the manifest.
      report: the page. facts: the JSON file beside it.
      kept: page of an earlier run, whose scores stay as this run has none.
    """

    structure: Structure
    results: tuple[tuple[Cell, dict[str, Any]], ...]
    missing: tuple[Missing, ...]
    warnings: tuple[Issue, ...]
    episodes: tuple[int, int]
    report: Path
    facts: Path
    kept: Path | None = None

    @property
    def failed(self) -> tuple[tuple[Cell, str], ...]:
        return tuple((cell, result["error"]) for cell, result in self.results if "error" in result)

    @property
    def sound(self) -> bool:
        """True if the release is sound and every cell could be run."""
        return self.structure.sound and not self.failed

    @property
    def complete(self) -> bool:
        """True if every episode is there."""
        return self.episodes[0] == self.episodes[1]


@dataclass(frozen=True)
class Progress:
    """Callbacks that follow a validation.

    Attributes:
      checking: a tick, told the subset that is checked.
      total: called with the number of Adam steps to come.
      training: called with what is trained and the steps made.
      done: called with each cell and its result.
    """

    checking: ProgressCallback = ignore
    total: Callable[[int], None] = field(default=lambda steps: None)
    training: Callable[[str, int], None] = field(default=lambda what, steps: None)
    done: Callable[[Cell, dict[str, Any]], None] = field(default=lambda cell, result: None)


def only(release: Release, patterns: Sequence[str]) -> Release:
    """A release with the subsets that match, e.g. "walker-walk/expert/*".

    Raises:
      DmcvbError: a pattern matches none.
    """
    names = select([record.name for record in release.manifest.subsets], list(patterns))
    records = tuple(record for record in release.manifest.subsets if record.name in names)
    manifest = release.manifest.model_copy(update={"subsets": records})
    return Release(release.root, manifest, {name: subset for name, subset in release.subsets.items() if name in names})


def make_setup(
    path: str | Path,
    *,
    out: str | Path | None = None,
    profile: str = "smoke",
    scale: float = 1.0,
    workers: Workers = 1,
    threads: int | None = None,
    device: str = "cpu",
    precision: str = "auto",
    memory: float | None = None,
    dino_weights: str | Path | None = None,
    backgrounds: str | Path | None = None,
    training: bool = True,
    **fields: Any,
) -> Setup:
    """Make the settings that all cells of a validation share from a user's arguments.

    Args:
      path: the release's folder.
      out: folder of the report, by default reports/<the release's folder>.
      profile: "smoke", "brief", "quick" or "paper". scale: factor of its steps.
      workers: number of workers that share the cores; each gets as many threads as are left, on a cluster one.
      precision: "auto" takes bfloat16 if the device has instructions for it; a report that goes on keeps to its own.
      memory: gigabytes of pictures held at most, over all workers; None: half of what is free.
      training: False if only the structure is checked, which needs no probe of the precision.
      fields: others of `Setup`.

    Raises:
      DmcvbError: an unknown profile, or a device that is not here.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise DmcvbError("this torch finds no CUDA device; install a CUDA build of torch or use --device cpu")
    sizes, out = get_profile(profile).scaled(scale), out or Path("reports") / Path(path).name
    threads = threads or (default_threads(workers) if isinstance(workers, int) else 1)
    if training:
        kept = kept_precision(out, device) if precision == "auto" else None
        precision = kept or choose_precision(precision, device)
    return Setup(
        root=str(path),
        out=str(out),
        profile=sizes,
        device=device,
        precision=precision if training else "float32",
        threads=threads,
        memory=None if memory is None else int(memory * 1e9),
        dino_weights=None if dino_weights is None else str(dino_weights),
        backgrounds=None if backgrounds is None else str(backgrounds),
        **fields,
    )


def validate(
    path: str | Path,
    setup: Setup,
    *,
    benchmarks: Sequence[str] = ("b1",),
    agents: Sequence[str] = (),
    patterns: Sequence[str] = (),
    workers: Workers = 1,
    train_unsound: bool = False,
    progress: Progress | None = None,
) -> Validation:
    """Check a release, run benchmarks on it and write the report.

    Scores of cells that are not asked for stay in the report. If it has scores and this run has none, as a check fails
    or all cells do, the run's page is "failed.html" beside it.

    Args:
      path: the release's folder.
      setup: profile, report folder, device.
      benchmarks: names of registered benchmarks; none: structure checks alone.
      agents: instead of each benchmark's own.
      patterns: only these subsets.
      workers: subsets checked and cells trained side by side, or a Ray cluster that sees the same folders.
      train_unsound: run the benchmarks even if a structure check fails.

    Raises:
      DmcvbError: there is no release, or a name is unknown, or the release has no data for a benchmark asked for, or
        the report's folder cannot be written, or holds scores that cannot stand beside those of this run.
    """
    started, progress = time.perf_counter(), progress or Progress()
    release = open_data(replace(setup, root=str(path)))
    chosen, cells, missing = plan_validation(release, benchmarks, agents, patterns)
    if patterns:  # a subset that was not asked for is not missing
        asked = [replace(one, subsets=tuple(n for n in one.subsets if matches(n, patterns))) for one in missing]
        missing = [one for one in asked if one.subsets or one.left_out]
    check_writable(setup.out)
    _check_kept_scores(setup, training=bool(cells))
    kept = kept_scores(setup.out)
    others = other_scores(setup, release, cells, kept) if kept else []
    structure = check_structure(chosen, setup.backgrounds, progress.checking, workers)
    results = _run(setup, cells, workers, progress) if structure.sound or train_unsound else []
    none = bool(cells or not structure.sound) and all("error" in result for _, result in results)
    every, shown = (results, cells) if none else ([*results, *others], [*cells, *(cell for cell, _ in others)])
    warnings = (
        *structure.warnings,
        *_learning_warnings(setup, every),
        *_few_warnings(setup.profile, every),
        *_benchmark_warnings(release, shown),
        *_seen_warnings(release, shown, setup.backgrounds),
    )
    report, facts = write_report(
        setup=setup,
        release=chosen,
        structure=structure,
        cells=shown,
        results=every,
        missing=missing,
        warnings=warnings,
        seconds=time.perf_counter() - started,
        name="failed" if kept and none else "report",
    )
    there, asked = (sum(counts.values()) for counts in release_episodes(chosen))
    stays = Path(setup.out) / "report.html" if kept and none else None
    if not stays:  # what failed before is mended
        for suffix in (".html", ".md", ".json"):
            (Path(setup.out) / f"failed{suffix}").unlink(missing_ok=True)
    return Validation(structure, tuple(results), tuple(missing), warnings, (there, asked), report, facts, stays)


def _run(
    setup: Setup, cells: Sequence[Cell], workers: Workers, progress: Progress
) -> list[tuple[Cell, dict[str, Any]]]:
    """The results of cells, in their order."""
    if cells:
        keep_precision(setup)
    progress.total(planned_steps(setup.profile, cells))
    found = {}
    for cell, result in run_cells(setup, cells, workers, progress.training):
        progress.done(cell, result)
        found[cell] = {key: value for key, value in result.items() if key != "kept"}
    return [(cell, found[cell]) for cell in cells if cell in found]


def plan_validation(
    release: Release, benchmarks: Sequence[str], agents: Sequence[str], patterns: Sequence[str]
) -> tuple[Release, list[Cell], list[Missing]]:
    """The subsets that are asked for, the cells of the benchmarks on them, and what is missing for others.

    Raises:
      DmcvbError: a name is unknown, or there are no data for a benchmark.
    """
    chosen = only(release, patterns)
    if not chosen.subsets:
        raise DmcvbError(f"{release.root} has no committed episodes yet; run the rollout first")
    return chosen, *_plan(chosen, benchmarks, agents, release.subsets.keys() - chosen.subsets.keys())


def _plan(
    chosen: Release, benchmarks: Sequence[str], agents: Sequence[str], left_out: Collection[str]
) -> tuple[list[Cell], list[Missing]]:
    """Cells of all benchmarks, and what is missing for others."""
    cells: list[Cell] = []
    missing: list[Missing] = []
    for name in dict.fromkeys(benchmarks):
        found, lacking = plan_benchmark(name, chosen, agents, left_out)
        if not found:
            needs = [f"roll out {', '.join(m.subsets[:4])}: {m.command}" for m in lacking if m.subsets]
            needs += [f"let --only take {', '.join(m.left_out[:4])}" for m in lacking if m.left_out]
            cure = "; ".join(needs) or "roll out a locomotion task"
            raise DmcvbError(f"benchmark {name} has no data in {chosen.root}; {cure}")
        cells += found
        missing += lacking
    used = {cell.agent for cell in cells}
    for agent in used:
        if agent.own:
            OwnAgent.load(agent.own)  # a wrong name is told before any work
    idle = [name for name in agents if (agent := parse_agent(name)).pretrain is None and agent not in used]
    if benchmarks and idle:
        sets = "sets" if len(benchmarks) == 1 else "set"
        has, it = ("has", "it") if len(idle) == 1 else ("have", "them")
        raise DmcvbError(
            f"{' and '.join(benchmarks)} {sets} agents with a pre-trained encoder beside bc, and {' and '.join(idle)} "
            f"{has} none; remove {it}, or add --benchmark b1"
        )
    return cells, missing


def check_writable(folder: str | Path) -> None:
    """Make the report's folder and see that it takes files, before any work.

    Raises:
      DmcvbError: the folder cannot be made or written.
    """
    folder = local_path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise DmcvbError(f"cannot write to {folder} ({error.strerror or error}); choose another --out") from None


def _check_kept_scores(setup: Setup, training: bool) -> None:
    """Raises DmcvbError if the report's folder has scores that this run would replace by others."""
    facts = kept_scores(setup.out)
    if not facts:
        return
    name, seed = facts["profile"].get("name"), facts.get("settings", {}).get("seed")
    if not (training and (name, seed) == (setup.profile.name, setup.seed)):
        raise DmcvbError(f"{setup.out} holds scores of profile {name}, seed {seed}; give another --out")


def _benchmark_warnings(release: Release, cells: Sequence[Cell]) -> Iterator[Issue]:
    for name in dict.fromkeys(cell.benchmark for cell in cells):
        yield from BENCHMARKS.get(name).warnings(release, [cell for cell in cells if cell.benchmark == name])


def _seen_warnings(release: Release, cells: Sequence[Cell], backgrounds: str | None) -> list[Issue]:
    """Evaluation shows what no data show (paper, section 5); data that were painted with it do not tell."""
    learned = dict.fromkeys(part.subset for cell in cells if not cell.agent.sees_state for part in cell.policy)
    found = []
    for record in (release.subsets[name].record for name in learned):
        what, seen = "maze style", record.goal_mode is not None and record.split == SPLIT
        if record.backgrounds:
            with contextlib.suppress(BackgroundError):  # what is not there fails in the cells
                shown = load_backgrounds(video_source(release.path, record, backgrounds), SPLIT).digest
                what, seen = "videos", record.backgrounds.get("digest") == shown
        if seen:
            text = f"painted with the {what} that evaluation shows: its scores are of distractors that were seen"
            found.append(Issue("learning", record.name, text))
    return found


def _few_warnings(profile: Profile, results) -> list[Issue]:
    """Tell of data so few that pictures are shifted, for which a short training is too short."""
    found = {}
    for cell, result in results:
        agent, seen = cell.agent, result.get("transitions")
        end_to_end = not (agent.sees_state or agent.own or agent.pretrain) and len(cell.policy) == 1
        if not (seen and end_to_end and profile.scores and profile.shift_from and cell.benchmark == "b1"):
            continue
        if profile.shifts(profile.pixel_steps, seen):
            passes = profile.pixel_steps * profile.batch_size / seen
            needed = _unshifted(profile, seen, result["episodes"])
            subset = cell.policy[0].subset
            found[subset] = (
                f"{profile.name} passes {passes:.0f} times over {pluralize(result['episodes'], 'episodes')}, so it "
                f"shifts their images and learns more slowly; with {needed:,} episodes or more it does not"
            )
    return [Issue("learning", subset, text) for subset, text in found.items()]


def _unshifted(profile: Profile, transitions: int, episodes: int) -> int:
    """The fewest episodes of that length of which a training's share is enough not to shift pictures."""
    each = transitions / training_episodes(episodes)
    needed = episodes
    while profile.shifts(profile.pixel_steps, int(training_episodes(needed) * each)):
        needed += 1
    return needed


def _learning_warnings(setup: Setup, results) -> list[Issue]:
    """Expert data that BC on states cannot learn from is odd."""
    found = []
    for cell, result in results:
        if not setup.profile.scores or "error" in result or cell.agent.name != "state-bc":
            continue
        score, data = result["score"], result["data"]
        if cell.policy_label != "expert":
            continue
        if data["success"] is not None:
            reached, wanted, what = 100 * score["success"], 100 * data["success"], "% of its goals, the data"
        elif score.get("limit") != data.get("limit"):
            continue  # returns of episodes that were cut elsewhere
        else:
            reached, wanted, what = score["mean"], data["mean"], "a return, the data"
        if reached < STATE_BC_SHARE * wanted:
            message = f"BC(state) reaches {reached:.0f} {what} {wanted:.0f} [{setup.profile.name}]"
            found.append(Issue("learning", cell.policy[0].subset, message))
    return found


__all__ = ["Progress", "Setup", "Validation", "check_writable", "default_threads", "only", "validate"]
