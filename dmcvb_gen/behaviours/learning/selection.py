"""Picking behaviour policies from a run, as the paper does: a learning curve in; expert, medium and mixed out.

Paper, section 3.1: expert is the first checkpoint with 95 % of the return at convergence, medium the one
with 50 %, mixed eight checkpoints evenly spaced between 0 and 50 %. Where returns are negative (mazes), a
share of the way is counted from the random policy's return to the converged one.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from dmcvb_gen.behaviours.learning.run_log import read_rows
from dmcvb_gen.behaviours.policies.actor import Policy, random_policy
from dmcvb_gen.behaviours.policies.evaluation import evaluate
from dmcvb_gen.behaviours.policies.header import Evaluation, PolicyHeader
from dmcvb_gen.behaviours.policies.policy_file import load_policy, read_header, save_policy
from dmcvb_gen.errors import DmcvbError, PolicyFileError
from dmcvb_gen.store.manifest import write_json_atomically
from dmcvb_gen.tasks import get_task

LEVELS = ("expert", "medium", "mixed")
MAZE_LEVELS = ("expert", "medium")
"""The paper has no mixed data of mazes."""
EXPERT_SHARE, MEDIUM_SHARE, MIXED_COUNT = 0.95, 0.5, 8
MEDIUM_TOLERANCE = 0.1
"""How far (as a share of the way) an accepted medium checkpoint may be from 50 %."""
MIXED_TOLERANCE = 0.12
"""The same for each of the mixed checkpoints and its target."""
SMOOTHING = 5
"""Evaluations in the moving median of the curve."""
MIN_POINTS = 8
"""Evaluations below which no convergence is claimed."""


@dataclass(frozen=True)
class Convergence:
    """Where a curve ends.

    Attributes:
      value: return at convergence, the mean of the last quarter of the smoothed curve.
      error: its standard error.
      converged: whether the last quarter lies within 5 % of the way of the quarter before.
      reason: why not.
    """

    value: float
    error: float
    converged: bool
    reason: str = ""


@dataclass(frozen=True)
class Pick:
    """One picked checkpoint: its place in the curve, and its returns over fresh episodes once evaluated."""

    name: str
    target: float
    step: int
    estimate: float
    path: str
    evaluation: Evaluation | None = None


@dataclass(frozen=True)
class Selection:
    """What could be picked, and why the rest could not.

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


def smooth(values: Sequence[float], window: int = SMOOTHING) -> np.ndarray:
    """Moving median, shorter at the ends."""
    values, half = np.asarray(values, float), window // 2
    return np.array([np.median(values[max(0, i - half) : i + half + 1]) for i in range(len(values))])


def converge(steps: Sequence[int], returns: Sequence[float], base: float = 0.0) -> Convergence:
    """Estimate the return at convergence from the end of a learning curve.

    The curve is taken over training steps, not evaluations, so that dense evaluations do not weigh more. A
    run that collapsed after its peak converges to its best stretch of a quarter of the run: a policy that
    was reached once can be picked.
    """
    steps, curve = np.asarray(steps, float), smooth(returns)
    if len(curve) < MIN_POINTS:
        return Convergence(
            float(curve[-1]) if len(curve) else float("nan"),
            float("nan"),
            False,
            f"{len(curve)} evaluations, at least {MIN_POINTS} are needed",
        )
    grid = np.linspace(steps[0], steps[-1], 64)
    even = np.interp(grid, steps, curve)
    means = np.convolve(even, np.ones(16) / 16, mode="valid")  # every stretch of a quarter
    best = int(means.argmax())
    value = float(means[best])
    stretch = even[best : best + 16]
    error = float(stretch.std() / np.sqrt(len(stretch) / SMOOTHING))
    way = value - base
    if way <= 0:
        return Convergence(
            value, error, False, f"the return ({value:.1f}) never rose above where it started ({base:.1f})"
        )
    if best == len(means) - 1:
        before = float(even[max(0, best - 16) : best].mean())
        if value - before > 0.05 * way:
            return Convergence(
                value, error, False, f"the return still rises (from {before:.1f} to {value:.1f} in the last quarter)"
            )
    return Convergence(value, error, True)


Point = tuple[int, float, Path | None]
"""Agent step, return, policy file; None where the file was thinned away."""


def read_curve(folder: Path) -> list[Point]:
    """Every evaluation of a run, in order of steps: those of progress.csv and of the checkpoints' own headers.

    A checkpoint that is being written while we look is left out.
    """
    curve: dict[int, Point] = {
        int(row["step"]): (int(row["step"]), float(row["return_mean"]), None) for row in read_rows(folder)
    }
    for path in (Path(folder) / "checkpoints").glob("*.safetensors"):
        try:
            header = read_header(path)
        except PolicyFileError:
            continue
        if header.evaluation is not None:
            curve[header.agent_step] = (header.agent_step, header.evaluation.mean, path)
    return [curve[step] for step in sorted(curve)]


def pick_checkpoints(
    curve: Sequence[Point],
    base: float,
    convergence: Convergence,
    measure: Callable[[Path], Evaluation],
    task: str = "",
    levels: Sequence[str] = LEVELS,
) -> Selection:
    """Pick levels from a curve; every pick is measured on fresh episodes before it is accepted.

    Args:
      curve: (agent step, return, policy file), in order of steps.
      base: return at 0 % of the way.
      measure: evaluates a policy file on fresh episodes.
      levels: what to pick, of `LEVELS`.
    """
    picks: dict[str, tuple[Pick, ...]] = {}
    reasons: dict[str, str] = {}
    way = convergence.value - base
    check = functools.cache(measure)

    def share(value: float) -> float:
        return (value - base) / way

    curve = [point for point in curve if point[2] is not None]
    if not curve or not way > 0:
        reason = convergence.reason or "the run has no evaluated checkpoint yet"
        return Selection(task, base, convergence, {}, {level: reason for level in levels})
    if not convergence.converged:
        reasons["expert"] = f"not converged: {convergence.reason}; train longer (--resume)"
    else:
        # Returns of 20 episodes are noisy: start a little below the line, fresh episodes decide.
        candidates = [point for point in curve if share(point[1]) >= EXPERT_SHARE - 0.02]
        for step, value, path in candidates:
            evaluation = check(path)
            # Beyond sampling error: a policy that falls now and then has a wide spread and is not an expert yet.
            error = evaluation.std / np.sqrt(evaluation.episodes)
            if share(evaluation.mean - 2 * error) >= EXPERT_SHARE:
                picks["expert"] = (Pick("expert", EXPERT_SHARE, step, value, str(path), evaluation),)
                break
        else:
            reasons["expert"] = (
                f"none of {len(candidates)} candidates held {EXPERT_SHARE:.0%} of {convergence.value:.1f} "
                "over fresh episodes; train longer (--resume)"
            )
    expert_step = picks["expert"][0].step if "expert" in picks else curve[-1][0]
    before = [point for point in curve if point[0] <= expert_step]

    def nearest(target: float, tolerance: float, taken: set[Path]) -> Pick | None:
        close = sorted(before, key=lambda point: abs(share(point[1]) - target))
        for step, value, path in close[:6]:
            if path in taken or abs(share(value) - target) > tolerance * 1.5:
                continue
            evaluation = check(path)
            if abs(share(evaluation.mean) - target) <= tolerance:
                return Pick("", target, step, value, str(path), evaluation)
        return None

    medium = nearest(MEDIUM_SHARE, MEDIUM_TOLERANCE, set())
    if medium is None:
        got = min((abs(share(value) - MEDIUM_SHARE), share(value)) for _, value, _ in before)[1]
        reasons["medium"] = (
            f"no checkpoint held {MEDIUM_SHARE:.0%} +- {MEDIUM_TOLERANCE:.0%} of the way (nearest {got:.0%}); "
            "evaluate more often"
        )
    else:
        picks["medium"] = (Pick("medium", MEDIUM_SHARE, medium.step, medium.estimate, medium.path, medium.evaluation),)
    if "mixed" not in levels:
        return Selection(task, base, convergence, picks, reasons)
    chosen, taken = [], set()
    for index, target in enumerate(np.linspace(0, MEDIUM_SHARE, MIXED_COUNT)):
        found = nearest(float(target), MIXED_TOLERANCE, taken)
        if found is None:
            reasons["mixed"] = (
                f"no checkpoint near {target:.0%} of the way (number {index + 1} of {MIXED_COUNT}); evaluate more often"
            )
            break
        taken.add(Path(found.path))
        chosen.append(Pick(f"mixed_{index}", float(target), found.step, found.estimate, found.path, found.evaluation))
    else:
        picks["mixed"] = tuple(chosen)
    return Selection(task, base, convergence, picks, reasons)


def select_checkpoints(
    folder: str | Path, episodes: int = 100, seed: int = 20_000, deterministic: bool = True
) -> Selection:
    """Pick expert, medium and mixed from a run folder and write them into its `selected/` folder.

    Also writes selection.json and curve.png. Works on a running run too; what cannot be picked yet is said
    in `reasons`, and earlier picks of that level are left alone.

    Raises:
      DmcvbError: the folder holds no run.
    """
    folder = Path(folder)
    curve = read_curve(folder)
    files = [path for _, _, path in curve if path]
    if not files:
        raise DmcvbError(f"{folder} holds no evaluated checkpoints; give a run folder of train-behaviour")
    task = get_task(read_header(files[0]).task)
    mazes = task.return_range[1] <= 0
    base = evaluate(random_policy(task), task, episodes, seed)[0].mean if mazes else 0.0
    measured: dict[Path, tuple[Policy, Evaluation]] = {}

    def measure(path: Path) -> Evaluation:
        if path not in measured:
            policy = load_policy(path, task)
            measured[path] = policy, evaluate(policy, task, episodes, seed, deterministic)[0]
        return measured[path][1]

    for attempt in range(5):
        convergence = converge([step for step, _, _ in curve], [value for _, value, _ in curve], base)
        try:
            levels = MAZE_LEVELS if mazes else LEVELS
            selection = pick_checkpoints(curve, base, convergence, measure, task.id, levels)
            break
        except PolicyFileError:
            curve, before = read_curve(folder), files
            files = [path for _, _, path in curve if path]
            # The run may have thinned a checkpoint away since the curve was read; a damaged one is a real error.
            if attempt == 4 or set(before) <= set(files):
                raise
    for level, picks in selection.picks.items():
        for pick in picks:
            policy = measured[Path(pick.path)][0]
            header: PolicyHeader = policy.header.model_copy(update={"level": level, "evaluation": pick.evaluation})
            save_policy(folder / "selected" / f"{pick.name}.safetensors", header, policy.weights)
    write_json_atomically(folder / "selection.json", selection_json(selection))
    plot_selection(curve, selection, folder / "curve.png")
    return selection


def selection_json(selection: Selection) -> dict:
    """A selection as plain values."""
    levels = {}
    for level in LEVELS:
        picks = [
            asdict(pick) | {"evaluation": pick.evaluation and pick.evaluation.model_dump()}
            for pick in selection.picks.get(level, ())
        ]
        levels[level] = {"picks": picks, "reason": selection.reasons.get(level)}
    return {
        "task": selection.task,
        "base": selection.base,
        "convergence": asdict(selection.convergence),
        "levels": levels,
    }


def plot_selection(curve: Sequence[Point], selection: Selection, path: Path) -> None:
    """The learning curve with the picks marked, a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    steps = [step for step, _, _ in curve]
    returns = [value for _, value, _ in curve]
    figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
    axes.plot(steps, returns, color="0.75", linewidth=1, label="evaluations along the way")
    axes.plot(steps, smooth(returns), color="tab:blue", label="smoothed")
    axes.axhline(selection.convergence.value, color="tab:blue", linestyle=":", linewidth=1)
    axes.text(steps[0], selection.convergence.value, f" convergence {selection.convergence.value:.0f}", va="bottom")
    colors = {"expert": "tab:green", "medium": "tab:orange", "mixed": "tab:red"}
    for level, picks in selection.picks.items():
        axes.errorbar(
            [pick.step for pick in picks],
            [pick.evaluation.mean for pick in picks],
            [pick.evaluation.std for pick in picks],
            fmt="o",
            color=colors[level],
            capsize=2,
            label=f"{level} (fresh episodes)",
        )
    axes.set(xlabel="agent steps", ylabel="episode return", title=selection.task)
    axes.legend(loc="lower right")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
