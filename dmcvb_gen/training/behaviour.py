"""Train a behaviour policy: from what a person gives to a finished run, its curve and, for an own maze, its picks."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.options import Count, Local, Location, Names, Precision, Seed, checked
from dmcvb_gen.parallel import ignore
from dmcvb_gen.spec import MazeName, task_folder
from dmcvb_gen.text import as_names, quoted

if TYPE_CHECKING:
    from dmcvb_gen.training.selection import Selection


SELECTION_EPISODES = 100
"""Fresh episodes that each pick of an own maze is measured on."""


@dataclass(frozen=True)
class TrainedRun:
    """A run that is trained to its end.

    Attributes:
      folder: folder of the run. curve: picture of its evaluations.
      steps: agent steps. seconds: of training, on the clock.
      selection: the picked checkpoints of a maze of one's own; None for a task, see `select_checkpoints`.
    """

    folder: Path
    curve: Path
    steps: int
    seconds: float
    selection: "Selection | None" = None


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """More threads gain nothing at these sizes, and one gives the same bits on every machine."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@_one_thread()
@checked
def train_behaviour(
    task: str | None = None,
    *,
    layout: Location | None = None,
    out: Local | None = None,
    steps: Count | None = None,
    seed: Seed | None = None,
    algo: str | None = None,
    settings: Names = (),
    config: Location | None = None,
    init_from: Location | None = None,
    evaluate_every: Count | None = None,
    precision: Precision = "auto",
    resume: bool = False,
    progress: bool = True,
    notify: Callable[[str], None] = ignore,
) -> TrainedRun:
    """Train a behaviour policy online on states.

    Args:
      task (TASK): Task to learn.
      layout (FILE): Text file of a maze of your own, instead of TASK: learns to walk it (guided) and selects
        checkpoints.
      out: Folder of the run. [default: runs/TASK; with --layout: runs/LAYOUT]
      steps: Agent steps (at action repeat 2). [default: the task's]
      seed: Random seed. [default: 0]
      algo: sac, mpo, guided (mazes), or SB3's sb3-sac, td3, tqc, ppo. [default: sac; --layout: guided]
      settings (KEY=VALUE): Override a setting, e.g. learning_rate=0.0003.
      config (FILE): A YAML file of settings.
      init_from (RUN|FILE): Run or policy file to start from; guided: the guide.
      evaluate_every: Agent steps between evaluations while returns are low.
      precision: sac: precision of hidden layers; auto takes what the processor has instructions for.
      resume: Resume the run in --out with its own settings.

    `notify` is called with what the person should know: the precision, a resumed run without a saved state, a stop.
    For a layout one bar counts the steps of training, evaluations and selection together.

    Raises:
      Stopped: by Ctrl-C; the run is saved, and the message has the command that goes on.
      DmcvbError: an unknown name, a setting that is wrong, or a folder that holds another run or none to resume.
    """

    from dmcvb_gen.policies.paper import paper_returns
    from dmcvb_gen.progress import ProgressBar
    from dmcvb_gen.tasks import get_task
    from dmcvb_gen.training.defaults import parse_settings, run_config
    from dmcvb_gen.training.runs import read_config
    from dmcvb_gen.training.selection import MAZE_CHECKPOINTS, plot_curve
    from dmcvb_gen.training.training import open_run

    task = task_of(task, layout)
    max_steps = get_task(task).max_steps
    named = MazeName.parse(task)
    maze = named if layout else None
    folder = Path(out or Path("runs") / (named.layout if named and (layout or named.rows) else task))
    found = read_config(folder) if resume else None
    if resume and found is None:
        raise DmcvbError(f"{folder} holds no run to resume; give its folder with --out, or remove --resume")
    algorithm = algo or (found.algorithm if found else "guided" if layout else "sac")
    source = None if init_from is None else str(init_from)
    given = dict(steps=steps, seed=seed, evaluate_every=evaluate_every, init_from=source)
    changed = parse_settings(as_names(settings), config, algorithm)
    chosen = _precision(precision, algorithm, changed, found)
    configuration = run_config(task, algorithm, changed | chosen, found, **given)  # type: ignore[arg-type]
    run = open_run(folder, configuration, resume)
    if chosen and precision == "auto":
        name, has = ("bfloat16", "has") if chosen["bfloat16"] else ("float32", "has no")
        notify(f"Computing in {name}: this processor {has} instructions for bfloat16.")
    saved, expert = run.saved(), paper_returns(task, "expert")
    if resume and not saved:
        notify(f"Nothing is saved in {folder} yet, so the run begins at step 0.")
    done, name = saved["step"] if saved else 0, task_folder(task)
    total = configuration.steps
    if found and total < min(done, found.steps):  # a finished run is a few steps past its own number
        raise DmcvbError(f"{folder} is at step {done:,}, past --steps {total:,}; give more, or leave it out")
    if found and total < found.steps:
        notify(f"The run ends at step {total:,} now, not at {found.steps:,}.")
    work: dict[str, float] = dict(total=total, initial=done)
    if maze:  # evaluations and selection take most of its time, so their steps count as well
        each = 1 + run.evaluation_steps()
        selecting = MAZE_CHECKPOINTS * SELECTION_EPISODES * max_steps
        work = dict(total=total * each + selecting, initial=done * each, smoothing=0)  # by turns they have other paces
    picked = None
    with ProgressBar(progress, **work, unit=" steps", unit_scale=True, desc=name) as bar:

        def report(progress: Any) -> None:
            bar.set_postfix_str(_standing(progress, expert), refresh=False)
            if maze:
                bar.update(progress.evaluation.episodes * max_steps)

        run.train(report, bar.update, lambda: notify("\nStopping: the run is being saved."))
        if maze:
            picked = _select(folder, name, bar, SELECTION_EPISODES * max_steps)
    curve = picked and folder / "curve.png"
    return TrainedRun(folder, curve or plot_curve(folder, expert and expert["mean"]), run.step, run.seconds, picked)


def _select(folder: Path, name: str, bar: Any, steps: int) -> "Selection":
    """Select a run's checkpoints; the bar goes on by `steps` for each one that is measured."""
    from dmcvb_gen.training.runs import Stopped
    from dmcvb_gen.training.selection import select_checkpoints

    before = bar.n

    class Rest:
        def __call__(self, checkpoint: str) -> None:
            bar.advance(f"{name}, selection", steps)

        def expect(self, count: float) -> None:
            bar.expect(before + count * steps)

    try:
        return select_checkpoints(folder, SELECTION_EPISODES, progress=Rest())
    except KeyboardInterrupt:
        command = f"dmcvb-gen select-checkpoints {quoted(folder)}"
        raise Stopped(f"interrupted; the run is trained, select its checkpoints: {command}") from None


def _standing(progress: Any, expert: Mapping[str, float] | None) -> str:
    """The last evaluation beside the paper's expert, and the pace."""
    mean, pace = progress.evaluation.mean, f"{progress.updates_per_second:.0f} updates/s"
    if not expert:
        return f"return {mean:.1f}, {pace}"
    share = f" ({100 * mean / expert['mean']:.0f} %)" if expert["mean"] > 0 else ""  # mazes' returns are costs
    return f"return {mean:.1f} of the paper's {expert['mean']:.0f}{share}, {pace}"


def task_of(task: str | None, layout: str | Path | None) -> str:
    """The id of the task that a person asked for, whose code may run from now on.

    Raises:
      DmcvbError: a task and a maze are given, or neither.
    """
    from dmcvb_gen.own_code import allow
    from dmcvb_gen.tasks.ant_maze import layout_task_id

    if (task is None) == (layout is None):
        raise DmcvbError("give a TASK, or the file of a maze with --layout")
    task = task or layout_task_id(layout or "")
    allow([task])  # a person typed its name
    return task


def _precision(asked: str, algorithm: str, settings: Mapping[str, Any], found: Any) -> dict[str, bool]:
    """The setting that --precision decides; none if a run is resumed or has one of its own."""
    from dmcvb_gen.precision import choose_precision

    if algorithm != "sac":
        if asked != "auto":
            raise DmcvbError(f"--precision has no effect with --algo {algorithm}: remove it")
        return {}
    if asked == "auto" and (found or "bfloat16" in settings):
        return {}
    if "bfloat16" in settings:
        raise DmcvbError("give --precision or --set bfloat16, not both")
    return {"bfloat16": choose_precision(asked) == "bfloat16"}
