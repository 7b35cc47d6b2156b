"""Train a behaviour policy: from what a person gives to a finished run, its curve and, for an own maze, its picks."""

import contextlib
import dataclasses
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmcvb_gen.errors import DmcvbError
from dmcvb_gen.options import Count, Local, Location, Names, Seed, checked
from dmcvb_gen.parallel import ignore
from dmcvb_gen.spec import MazeName, task_folder
from dmcvb_gen.text import as_names

if TYPE_CHECKING:
    from dmcvb_gen.training.run import Run, RunConfig
    from dmcvb_gen.training.selection import Selection


PROBE_SECONDS = 2.0
"""How long a run is tried to say how long it will take."""
PROBED_STEPS = 10_000
"""Shorter runs are not: they are over soon."""
BAR = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"
PAUSE = 10.0
"""Seconds without a step, as while updates are compiled, that say nothing of the time left."""


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
    task: Location | None = None,
    *,
    out: Local | None = None,
    steps: Count | None = None,
    seed: Seed | None = None,
    algo: str | None = None,
    settings: Names = (),
    init_from: Location | None = None,
    evaluate_every: Count | None = None,
    resume: bool = False,
    progress: bool = True,
    notify: Callable[[str], None] = ignore,
) -> TrainedRun:
    """Train a behaviour policy online on states.

    Args:
      task (TASK): Task to learn; of a maze of your own its text file, then checkpoints are selected, too.
      out: Folder of the run. [default: runs/TASK, runs/ring for ring.txt]
      steps: Agent steps (at action repeat 2). [default: the task's]
      seed: Random seed. [default: 0]
      algo: sac, mpo, guided (mazes), or sb3:NAME, with A2C, CrossQ, DDPG, PPO, SAC, TD3, TQC or TRPO. [default: sac; a
        maze's file: guided]
      settings (KEY=VALUE): Override a setting, e.g. learning_rate=0.0003.
      init_from (RUN|FILE): Run or policy file to start from; guided: the policy that walks.
      evaluate_every: Agent steps between evaluations, and so between checkpoints. [default: the task's]
      resume: Resume the run in --out with its own task and settings.

    `notify` is called with what the person should know: what the run will do, a stop.

    Raises:
      Stopped: by Ctrl-C; the run is saved, and the message has the command that goes on.
      DmcvbError: an unknown name, a setting that is wrong, or a folder that holds another run or none to resume.
    """

    from dmcvb_gen.policies.paper import paper_returns
    from dmcvb_gen.progress import ProgressBar
    from dmcvb_gen.storage.places import local_path
    from dmcvb_gen.tasks import typed_task
    from dmcvb_gen.training.run import open_run, read_config
    from dmcvb_gen.training.selection import plot_curve, select_checkpoints
    from dmcvb_gen.training.settings import parse_settings

    found = read_config(out) if resume and out else None
    task_id = found.task if found and not task else typed_task(task)
    maze = own_maze(task_id)
    folder = local_path(out or Path("runs") / (maze.layout if maze else task_id))
    found = read_config(folder) if resume else None
    if resume and found is None:
        raise DmcvbError(f"{folder} holds no run to resume; give its folder with --out, or remove --resume")
    algorithm = algo or (found.algorithm if found else "guided" if maze else "sac")
    given = dict(steps=steps, seed=seed, evaluate_every=evaluate_every, init_from=init_from and str(init_from))
    asked = parse_settings(as_names(settings), algorithm)
    run = open_run(folder, run_config(task_id, algorithm, asked, found, **given), resume)  # type: ignore[arg-type]
    saved = run.saved()
    done, total = saved["step"] if saved else 0, run.config.steps
    if found and total < min(done, found.steps):  # a finished run is a few steps past its own number
        raise DmcvbError(f"{folder} is at step {done:,}, past --steps {total:,}; give more, or leave it out")
    for line in plan_of(run, done):
        notify(line)
    _train(run, done, progress, notify)
    expert = paper_returns(task_id, "expert")
    curve, picked = plot_curve(folder, expert and expert["mean"]), None
    if maze:
        with ProgressBar(progress, unit=" checkpoints", desc="selection") as bar:
            picked = select_checkpoints(folder, progress=bar)
    return TrainedRun(folder, curve, run.step, run.seconds, picked)


def run_config(
    task_id: str, algorithm: str, settings: dict[str, Any], found: "RunConfig | None" = None, **given: Any
) -> "RunConfig":
    """Return the config of a run: the given values, else those of the run to resume, else the task's defaults.

    Args:
      settings: given settings, checked.
      found: the configuration of the run to go on with. If `given` differs from it the result does too, and
        `open_run` refuses it.
      given: steps, seed, evaluate_every, init_from; None if not given.
    """
    from dmcvb_gen.training.run import RunConfig
    from dmcvb_gen.training.settings import default_run

    given = {name: value for name, value in given.items() if value is not None}
    if found and found.algorithm == algorithm:
        return dataclasses.replace(found, task=task_id, settings=found.settings | settings, **given)
    defaults = default_run(task_id, algorithm) | {"seed": 0} | given
    return RunConfig(task=task_id, algorithm=algorithm, **defaults | {"settings": defaults["settings"] | settings})


def own_maze(task_id: str) -> MazeName | None:
    """The name of a maze of one's own; None of other tasks."""
    maze = MazeName.parse(task_id)
    return maze if maze and maze.rows else None


def plan_of(run: "Run", done: int = 0) -> list[str]:
    """What a run will do, a sentence a line: its steps, how many are random, its core time, the return to expect.

    Args:
      done: agent steps that it has made already.
    """
    from dmcvb_gen.policies.bundled import bundled_names, bundled_policies
    from dmcvb_gen.policies.policy_file import read_header

    config, settings = run.config, run.settings
    random = 0 if config.init_from else getattr(settings, "warmup_steps", getattr(settings, "learning_starts", 0))
    how = [task_folder(config.task), config.algorithm]
    if hasattr(settings, "bfloat16"):
        how.append("bfloat16" if settings.bfloat16 else "float32")
    steps = [f"{config.steps:,} agent steps"]
    if random > done:
        steps.append(f"{random:,} of them random")
    if done:
        steps.append(f"{done:,} of them done")
    lines = [f"{', '.join(how)}: {', '.join(steps)}."]
    if config.steps - done >= PROBED_STEPS:
        left = probe(run) * (config.steps - done)
        time_left = f"{math.ceil(left / 60)} min" if left < 5400 else f"{left / 3600:.1f} h"
        lines.append(f"About {time_left} of one core, without evaluations (from a two-second try).")
    if bundled_names(config.task, "expert"):
        known = read_header(bundled_policies(config.task, "expert")[0])
        if known.evaluation:
            after = f"after {known.agent_step:,} agent steps"
            lines.append(f"To expect: {known.evaluation.mean:.0f}, as the package's own expert has {after}.")
    return lines


class _Enough(Exception):
    """A try has lasted long enough."""


def probe(run: "Run") -> float:
    """Seconds an agent step of a run that learns, measured on its own loop in a folder that goes."""
    from dmcvb_gen.seeding import generators_kept
    from dmcvb_gen.training.run import Run

    names = {field.name for field in dataclasses.fields(run.settings)}
    early = dict(compile=False, warmup_steps=run.settings.simulations, learning_starts=run.settings.simulations)
    settings = run.config.settings | {name: value for name, value in early.items() if name in names}
    config = dataclasses.replace(run.config, settings=settings, evaluate_every=10**12, init_from=None)
    began: list[float] = []

    def tick(steps: int) -> None:
        began.append(time.perf_counter())
        if began[-1] - began[0] > PROBE_SECONDS:
            raise _Enough

    with tempfile.TemporaryDirectory() as folder, generators_kept():
        tried = Run(folder, config)
        tried.tick = tick
        with contextlib.suppress(_Enough):
            tried.algorithm.train(tried)
    return (began[-1] - began[0]) / max(len(began) - 1, 1) / run.settings.simulations


def _train(run: "Run", done: int, progress: bool, notify: Callable[[str], None]) -> None:
    """Train a run under a bar of 80 columns, which shows the last evaluation beside the paper's expert."""
    from dmcvb_gen.policies.paper import paper_returns
    from dmcvb_gen.progress import ProgressBar
    from dmcvb_gen.seeding import generators_kept

    name, expert = task_folder(run.config.task), paper_returns(run.config.task, "expert")
    work: dict[str, Any] = dict(total=run.config.steps, initial=done, smoothing=0, unit=" steps", unit_scale=True)
    with ProgressBar(progress, **work, desc=name, bar_format=BAR) as bar, generators_kept():
        last = time.monotonic()

        def tick(steps: int) -> None:
            nonlocal last
            now = time.monotonic()
            if now - last > PAUSE and not bar.disable:
                bar.unpause()
            bar.update(steps)
            last = now

        def report(evaluation: Any) -> None:
            nonlocal last
            last = time.monotonic()  # an evaluation is no pause: others follow, and take as long
            beside = f"/{expert['mean']:.0f}" if expert else ""
            bar.set_postfix_str(f"return {evaluation.mean:.0f}{beside}", refresh=False)

        run.train(report, tick, lambda: notify("\nStopping: the run is being saved."))
