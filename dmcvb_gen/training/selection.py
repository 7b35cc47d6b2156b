"""Pick the expert, medium and mixed policies from a run's learning curve, as the paper does.

Paper, section 3.1: expert is the first checkpoint with 95 % of the return at convergence, medium the one with 50 %,
mixed eight checkpoints evenly spaced, in training steps, from the start to medium. Mean actions are judged, as the data
are made of them. Returns of mazes are negative, so an expert costs at most 1 / 0.95 of what the return at convergence
does, and medium is the checkpoint whose mean return is nearest to the paper's row of its group (half of the way in a
maze of one's own, which has no row); the paper has no mixed data of mazes. The way begins at 0, or, if returns may be
negative, at the return of random actions. If the return still rises when a run of DMC-VB's walker, cheetah or humanoid
ends, convergence is that of the paper's own run, whose expert has 95 % of it.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pydantic

from dmcvb_gen.errors import DmcvbError, PolicyFileError
from dmcvb_gen.files import write_json
from dmcvb_gen.parallel import ProgressCallback, expect, ignore
from dmcvb_gen.policies.actor import Policy, RandomPolicy
from dmcvb_gen.policies.evaluation import FRESH, evaluate
from dmcvb_gen.policies.header import Evaluation
from dmcvb_gen.policies.paper import medium_return, paper_returns
from dmcvb_gen.policies.policy_file import load_policy, read_header, save_policy
from dmcvb_gen.spec import MAZE_TRAINED_LEVELS, TRAINED_LEVELS, is_maze, task_folder
from dmcvb_gen.storage.errors import storage_errors
from dmcvb_gen.tasks import get_task
from dmcvb_gen.text import pluralize

EXPERT_SHARE, MEDIUM_SHARE, MIXED_COUNT = 0.95, 0.5, 8
MEDIUM_TOLERANCE = 0.1
"""How far (as a share of the way) an accepted medium checkpoint may be from 50 %."""
PAPER_TOLERANCE = 0.2
"""How far (as a share of it) a maze's medium may be from the paper's return."""
CANDIDATES = 8
"""Checkpoints near a medium's return that are measured on fresh episodes."""
MEASURED = 14
"""Checkpoints that are measured, about."""
SEED = 20_000
"""Seed of the fresh episodes."""
BASE_EPISODES = 20
"""Episodes of random actions, which tell where returns start that may be negative."""
COST_SLACK = 0.3
"""How much more (as a share) than an expert a maze's checkpoint may have cost on the way to be measured afresh: one
stuck ant of twenty doubles what they cost."""
CLOSE_ENOUGH = 0.2
"""Share of the tolerance within which no nearer checkpoint is looked for."""
SMOOTHING = 5
"""Evaluations in the moving median of the curve."""
SURE_POINTS = 8
"""Evaluations below which a curve says little of where it ends."""


@dataclass(frozen=True)
class Convergence:
    """Convergence of a curve.

    Attributes:
      value: return at convergence, the mean of the best stretch of a quarter of the curve.
      error: its standard error; of a few evaluations, how much their second half differs from the first.
      converged: False if there is one evaluation, if the return never rose, or if the best quarter is the last
        and lies more than 5 % of the way above the quarter before.
      reason: why not, or why it is not sure.
    """

    value: float
    error: float
    converged: bool
    reason: str = ""

    @property
    def standing(self) -> str:
        """How sure it is, in words."""
        error = "" if math.isnan(self.error) else f" +- {self.error:.1f}"
        sure = "converged" if self.converged else "not converged"
        return f"{self.value:.1f}{error} ({sure}{self.reason and ': '}{self.reason})"


@dataclass(frozen=True)
class Pick:
    """One picked checkpoint: what was aimed at, its place in the curve, and its returns over fresh episodes."""

    name: str
    target: str
    step: int
    estimate: float
    path: str
    evaluation: Evaluation


@dataclass(frozen=True)
class Selection:
    """Result of a selection: the picked checkpoints, and why others could not be picked.

    Attributes:
      base: return at 0 % of the way.
      picks: level -> checkpoints (mixed: eight).
      reasons: level -> why it cannot be picked yet.
    """

    task: str
    base: float
    convergence: Convergence
    picks: dict[str, tuple[Pick, ...]] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)


def smooth(values: Sequence[float]) -> np.ndarray:
    """Moving median, shorter at the ends."""
    values, half = np.asarray(values, float), SMOOTHING // 2
    return np.array([np.median(values[max(0, i - half) : i + half + 1]) for i in range(len(values))])


def converge(steps: Sequence[int], returns: Sequence[float], base: float = 0.0) -> Convergence:
    """Estimate the return at convergence from the end of a learning curve.

    The curve is taken over training steps, not evaluations, so that dense evaluations do not weigh more. A
    run that collapsed after its peak converges to its best stretch of a quarter of the run: a policy that
    was reached once can be picked.
    """
    steps, curve = np.asarray(steps, float), smooth(returns)
    if len(curve) < SURE_POINTS:
        return _of_few(np.asarray(returns, float), base)
    grid = np.linspace(steps[0], steps[-1], 64)
    even = np.interp(grid, steps, curve)
    means = np.convolve(even, np.ones(16) / 16, mode="valid")  # every stretch of a quarter
    best = int(means.argmax())
    value = float(means[best])
    stretch = even[best : best + 16]
    error = float(stretch.std() / np.sqrt(len(stretch) / SMOOTHING))
    way = value - base
    if way <= 0:
        return Convergence(value, error, False, _never_rose(value, base))
    if best == len(means) - 1:
        before = float(even[max(0, best - 16) : best].mean())
        if value - before > 0.05 * way:
            rises = f"the return still rises (from {before:.1f} to {value:.1f} in the last quarter)"
            return Convergence(value, error, False, rises)
    return Convergence(value, error, True)


def _of_few(returns: np.ndarray, base: float) -> Convergence:
    """The convergence of fewer evaluations than `SURE_POINTS`: their second half, beside the first."""
    count, half = len(returns), len(returns) // 2
    if not half:
        value = float(returns[-1]) if count else math.nan
        return Convergence(value, math.nan, False, f"{pluralize(count, 'evaluations')}, at least 2 are needed")
    value, before = float(returns[half:].mean()), float(returns[:half].mean())
    if value <= base:
        return Convergence(value, abs(value - before), False, _never_rose(value, base))
    doubt = f"from {count} evaluations, so a longer run may end higher; {SURE_POINTS} say more"
    return Convergence(value, abs(value - before), True, doubt)


def _never_rose(value: float, base: float) -> str:
    return f"the return ({value:.1f}) never rose above where it started ({base:.1f})"


Point = tuple[int, float, Path]
"""Agent step, return, policy file."""


def read_curve(folder: str | Path) -> list[Point]:
    """Every evaluation of a run, in order of steps, as the checkpoints' headers have them.

    A checkpoint that is being written while we look is left out, and one where the run was stopped, too.

    Raises:
      DmcvbError: there is none.
    """
    curve: list[Point] = []
    for path in sorted((Path(folder) / "checkpoints").glob("*.safetensors")):
        with contextlib.suppress(PolicyFileError):
            header = read_header(path)
            if header.evaluation is not None:
                curve.append((header.agent_step, header.evaluation.mean, path))
    if not curve:
        raise DmcvbError(f"{folder} holds no evaluated checkpoints; give a run folder of train-behaviour that has some")
    return sorted(curve)


def pick_checkpoints(
    task: str, curve: Sequence[Point], base: float, convergence: Convergence, measure: Callable[[Path], Evaluation]
) -> Selection:
    """Pick a task's levels from a curve; every pick is measured on fresh episodes before it is accepted.

    Args:
      task: its id; mazes have no mixed level, and returns that are costs.
      curve: (agent step, return, policy file), in order of steps.
      base: return at 0 % of the way.
      measure: evaluates a policy file on fresh episodes.
    """
    way, check, maze = convergence.value - base, functools.cache(measure), is_maze(task)
    levels = MAZE_TRAINED_LEVELS if maze else TRAINED_LEVELS
    if not way > 0:
        reason = _never_rose(convergence.value, base) if convergence.converged else convergence.reason
        return Selection(task, base, convergence, {}, dict.fromkeys(levels, reason))
    found: dict[str, tuple[Pick, ...] | str] = {}
    if not convergence.converged:
        found["expert"] = f"not converged: {convergence.reason}; train longer (--resume)"
    elif maze and convergence.value < 0:  # 95 % of the way from a random policy's return costs half again as much
        goal = convergence.value / EXPERT_SHARE
        found["expert"] = _expert(curve, goal, COST_SLACK * abs(goal), check)
    else:
        found["expert"] = _expert(curve, base + EXPERT_SHARE * way, 0.02 * way, check)
    last = curve[-1][0] if isinstance(found["expert"], str) else found["expert"][0].step
    before = [point for point in curve if point[0] <= last]
    if (papers := medium_return(task)) is None:
        found["medium"] = _medium(before, base + MEDIUM_SHARE * way, MEDIUM_TOLERANCE * way, check)
    else:
        found["medium"] = _medium(before, papers, PAPER_TOLERANCE * abs(papers), check)
    if not maze:
        found["mixed"] = found["medium"]
        if not isinstance(found["medium"], str):
            found["mixed"] = _mixed(before, found["medium"][0].step, check)
    picks = {level: picked for level, picked in found.items() if not isinstance(picked, str)}
    return Selection(task, base, convergence, picks, {level: why for level, why in found.items() if level not in picks})


def _expert(curve: Sequence[Point], goal: float, slack: float, check: Callable) -> tuple[Pick, ...] | str:
    """The first checkpoint whose mean return is `goal` or more (paper, section 3.1), or why there is none."""
    # Returns of the curve's few episodes are noisy: start a little below the line, fresh episodes decide.
    candidates = [point for point in curve if point[1] >= goal - slack]
    for step, value, path in candidates:
        evaluation = check(path)
        if evaluation.mean >= goal:
            return (Pick("expert", f"return {goal:.1f}", step, value, str(path), evaluation),)
    return f"none of {len(candidates)} candidates held {goal:.1f} over fresh episodes; train longer (--resume)"


def _medium(curve: Sequence[Point], goal: float, tolerance: float, check: Callable) -> tuple[Pick, ...] | str:
    """The checkpoint whose return is nearest to `goal`, or why there is none within the tolerance."""
    # A few episodes may lie about a checkpoint, its neighbors about a steep curve: either may name it.
    smoothed = smooth([value for _, value, _ in curve])
    away = [min(abs(value - goal), abs(even - goal)) for (_, value, _), even in zip(curve, smoothed, strict=True)]
    order = sorted(range(len(curve)), key=away.__getitem__)[:CANDIDATES]
    near = [curve[index] for index in order if away[index] <= 1.5 * tolerance]
    best, off = None, tolerance
    for step, value, path in near:
        evaluation = check(path)
        if abs(evaluation.mean - goal) <= off:
            best = Pick("medium", f"return {goal:.1f}", step, value, str(path), evaluation)
            off = abs(evaluation.mean - goal)
        if off <= CLOSE_ENOUGH * tolerance:
            break
    if best:
        return (best,)
    closest = min((value for _, value, _ in curve), key=lambda value: abs(value - goal))
    return f"no checkpoint held {goal:.1f} +- {tolerance:.1f} (nearest {closest:.1f}); evaluate more often"


def _mixed(curve: Sequence[Point], last: int, check: Callable) -> tuple[Pick, ...] | str:
    """Eight checkpoints evenly spaced in training steps from step 0 to `last`, or which is missing.

    The rule, for every task and algorithm: for i from 0 to 6 the checkpoint before medium, not yet taken, whose step is
    nearest to i / 7 of medium's step, and off by at most 1 / 7 of it; then medium. Returns decide nothing, so
    checkpoints before any learning are among them.
    """
    *free, medium = [point for point in curve if point[0] <= last]
    goals, chosen = np.linspace(0, last, MIXED_COUNT), list[Point]()
    for index, goal in enumerate(goals[:-1]):
        point = min(free, key=lambda point: abs(point[0] - goal), default=None)
        if point is None or abs(point[0] - goal) > goals[1]:
            return f"no checkpoint near step {goal:.0f} (number {index + 1} of {MIXED_COUNT}); evaluate more often"
        free.remove(point)
        chosen.append(point)
    return tuple(
        Pick(f"mixed_{index}", f"step {goal:.0f}", step, value, str(path), check(path))
        for index, (goal, (step, value, path)) in enumerate(zip(goals, [*chosen, medium], strict=True))
    )


def select_checkpoints(
    folder: str | Path, episodes: int = 100, progress: ProgressCallback = ignore, convergence: float | None = None
) -> Selection:
    """Pick expert, medium and mixed from a run folder and write them into its `selected/` folder.

    Also writes selection.json and curve.png. Works on a running run too; what cannot be picked yet is said
    in `reasons`, and earlier picks of that level are left alone.

    Args:
      progress: called with the name of each checkpoint that is evaluated on fresh episodes.
      convergence: return at convergence that another run of the task has shown, instead of this one's.

    Raises:
      DmcvbError: the folder holds no run.
      StoreError: it cannot be written to.
    """
    folder = Path(folder)
    curve = read_curve(folder)
    task = get_task(read_header(curve[0][2]).task)
    base = 0.0
    if task.return_range[0] < 0:
        base = evaluate(RandomPolicy(task), task, min(episodes, BASE_EPISODES), SEED, streams=FRESH).mean
    measured: dict[str, Policy] = {}

    def measure(path: Path) -> Evaluation:
        expect(progress, max(len(measured) + 1, MEASURED))
        progress(f"step {int(path.stem):,}")
        policy = measured[str(path)] = load_policy(path, task)
        return evaluate(policy, task, episodes, SEED, streams=FRESH)

    end = converge([step for step, _, _ in curve], [value for _, value, _ in curve], base)
    paper = None if is_maze(task.id) else paper_returns(task.id, "expert")
    if convergence is not None:
        end = Convergence(convergence, math.nan, True, "as was given")
    elif paper and end.value > base and not end.converged and len(curve) >= SURE_POINTS:
        end = Convergence(paper["mean"] / EXPERT_SHARE, math.nan, True, f"in the paper's run; here {end.reason}")
    selection = pick_checkpoints(task.id, curve, base, end, measure)
    expect(progress, len(measured))
    with storage_errors(folder, "write to"):
        _write(folder, curve, selection, measured)
    plot_curve(folder, selection=selection)
    return selection


def _write(folder: Path, curve: Sequence[Point], selection: Selection, policies: Mapping[str, Policy]) -> None:
    """Write the picks and selection.json into a run's folder.

    The header of a picked policy also says what it was picked for, and has the whole learning curve of its run.
    """
    shown = {"steps": [step for step, _, _ in curve], "returns": [round(value, 2) for _, value, _ in curve]}
    for level, picks in selection.picks.items():
        for pick in picks:
            policy = policies[pick.path]
            why = {"target": pick.target, "convergence": round(selection.convergence.value, 2)}
            facts = {"level": level, "evaluation": pick.evaluation}
            facts["training"] = policy.header.training | {"selection": why, "curve": shown}
            header = policy.header.model_copy(update=facts)
            save_policy(folder / "selected" / f"{pick.name}.safetensors", header, policy.weights)
    write_json(folder / "selection.json", selection_json(selection))


def selection_json(selection: Selection) -> dict:
    """A selection as plain values; None for numbers that are not known."""
    plain = json.loads(pydantic.TypeAdapter(Selection).dump_json(selection))
    picks, reasons = plain.pop("picks"), plain.pop("reasons")
    levels = {level: {"picks": picks.get(level, []), "reason": reasons.get(level)} for level in TRAINED_LEVELS}
    return plain | {"levels": levels}


def plot_curve(folder: str | Path, expert: float | None = None, selection: Selection | None = None) -> Path:
    """Draw a run's learning curve into its folder as curve.png.

    Args:
      expert: mean return of the paper's expert, drawn beside it.
      selection: its picks are marked.

    Returns:
      The picture's path.
    """
    from matplotlib.figure import Figure  # not pyplot, whose backend is the caller's

    path, curve = Path(folder) / "curve.png", read_curve(folder)
    steps, returns = [step for step, _, _ in curve], [value for _, value, _ in curve]
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, returns, color="0.75", linewidth=1, label="evaluations along the way")
    axes.plot(steps, smooth(returns), color="tab:blue", label="smoothed")
    if expert is not None:
        axes.axhline(expert, color="0.3", linestyle="--", linewidth=1, label=f"the paper's expert, {expert:.0f}")
    if selection:
        _mark_picks(axes, selection, steps)
    axes.set(xlabel="agent steps", ylabel="episode return", title=task_folder(read_header(curve[0][2]).task))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.legend(loc="lower right")
    axes.grid(alpha=0.3)
    with storage_errors(path, "write to"):
        figure.savefig(path, dpi=110)
    return path


def _mark_picks(axes: Any, selection: Selection, steps: Sequence[int]) -> None:
    end = selection.convergence.value
    axes.axhline(end, color="tab:blue", linestyle=":", linewidth=1)
    axes.text(steps[0], end, f" convergence {end:.0f}", va="bottom")
    axes.set_xscale("function", functions=(np.sqrt, np.square))  # medium is within the first tenth
    axes.set_xlim(0, steps[-1])
    axes.locator_params(axis="x", nbins=5)
    # Medium is often the last of the mixed: its ring goes around that one.
    looks = {"mixed": ("tab:red", 5, True), "medium": ("tab:orange", 9, False), "expert": ("tab:green", 7, True)}
    for level, (color, size, filled) in looks.items():
        picks = selection.picks.get(level, ())
        points = [(pick.step, pick.evaluation.mean, pick.evaluation.std) for pick in picks]
        if points:
            look = dict(color=color, markersize=size, markerfacecolor=color if filled else "none", capsize=2, zorder=3)
            axes.errorbar(*zip(*points, strict=True), fmt="o", label=f"{level} (fresh episodes)", **look)
